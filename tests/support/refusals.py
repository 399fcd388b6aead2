"""An error that is expected with its fields, whatever words the message puts around them."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager

import pytest

from sewfast import SewfastError


@contextmanager
def refuses(kind: type[SewfastError], **fields: str) -> Iterator[None]:
    """Require an error of a kind, and of each named field that the pattern is found in it."""
    with pytest.raises(kind) as caught:
        yield
    for field, pattern in fields.items():
        value = getattr(caught.value, field)
        assert value is not None, f"no {field} in: {caught.value}"
        assert re.search(pattern, value, re.DOTALL), f"{field} {value!r} in: {caught.value}"
