"""Commissionings cut short: what is tested is what is done, not how well the controller does."""

from __future__ import annotations

import functools
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest

from sewfast import identification
from sewfast.commissioning import training

SMALL: dict[str, Any] = {"members": 2, "evaluations": 25, "seed": 1}


@contextmanager
def short() -> Iterator[None]:
    """Networks that are trained for 15 iterations."""
    with pytest.MonkeyPatch.context() as patch:
        quick = functools.partial(identification.seeded, iterations=15)
        patch.setattr(training, "seeded", quick)
        yield
