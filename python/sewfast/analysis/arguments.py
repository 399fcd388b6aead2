"""Arguments of `analyse`, checked: numbers, kinds, changes."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, TypeVar

from ..errors import SettingError
from ..gains import real
from .changes import Change

T = TypeVar("T")


def finite(name: str, value: Any) -> float:
    """The value as a finite float.

    Raises
    ------
    SettingError
        For anything else, by name.
    """
    number = real(name, value)
    if not math.isfinite(number):
        raise SettingError(f"expected a finite number for {name}, got {value!r}")
    return number


def finite_each(name: str, values: Any) -> list[float]:
    """The values as finite floats, one at least.

    Raises
    ------
    SettingError
        For what is no sequence of numbers, or an empty one.
    """
    try:
        given = [] if isinstance(values, str) else list(values)
    except TypeError:
        given = []
    if not given:
        raise SettingError(f"expected a list of numbers for {name}, got {values!r}")
    return [finite(name, value) for value in given]


def required(name: str, value: Any, kind: type[T]) -> T:
    """The value, which is of that kind; the kind's defaults where it is None.

    Raises
    ------
    SettingError
        For anything else.
    """
    if not (value is None or isinstance(value, kind)):
        raise SettingError(
            f"expected {kind.__name__} for {name}, got {type(value).__name__}; for example "
            f"{name}={kind.__name__}()"
        )
    return kind() if value is None else value


def each_change(changes: Any) -> Sequence[Change] | None:
    """The changes, or None for the usual ones.

    Raises
    ------
    SettingError
        For what is no sequence of changes.
    """
    if changes is None:
        return None
    try:
        given = list(changes)
    except TypeError:
        given = [changes]
    for one in given:
        if not isinstance(one, Change):
            raise SettingError(
                f"expected a list of changes, got {one!r} in it; for example "
                "changes=[sewfast.analysis.changes.gain(0.5)]"
            )
    return given
