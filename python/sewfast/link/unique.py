"""`Unique`: what is open in one place cannot be in two."""

from __future__ import annotations

from typing import Any, NoReturn, SupportsIndex

from ..errors import SettingError


class Unique:
    """Base of what owns a port: a copy would close the original's when it goes."""

    def __reduce_ex__(self, protocol: SupportsIndex) -> NoReturn:
        raise _refusal(self)


def _refusal(owner: Any) -> SettingError:
    name = type(owner).__name__
    return SettingError(
        f"expected one owner of a port, got a copy of a {name}; pass the {name} itself on, or "
        "connect in the process that uses it"
    )
