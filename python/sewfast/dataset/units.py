"""Names and units of columns."""

from __future__ import annotations

from typing import TYPE_CHECKING, Protocol

from ..errors import DataError

if TYPE_CHECKING:
    from .dataset import Dataset


class HasUnits(Protocol):
    """A data set or a model."""

    @property
    def input_units(self) -> tuple[str, ...]: ...
    @property
    def output_unit(self) -> str: ...


def require_same_units(one: HasUnits, other: Dataset) -> None:
    """Raise `DataError` where a unit is known on both sides and differs."""
    mine = (*one.input_units, one.output_unit)
    for unit, received in zip(mine, (*other.input_units, other.output_unit), strict=True):
        if unit and received and unit != received:
            raise DataError(
                f"{other.source}: expected the unit {unit!r}, received {received!r}; convert "
                "the data"
            )


def lettered(text: str) -> str:
    r"""A text for a figure as it is: a dollar begins no formula there, as `$\frac{1}{` is none."""
    return text.replace("$", r"\$")


def labelled(name: str, unit: str) -> str:
    """`name [unit]`, or the name alone where the unit is unknown."""
    return f"{name} [{unit}]" if unit else name
