"""`MoveTable`: the reference that makes a machine follow a known move, for one controller.

`sewfast.plan` makes it from models, `sewfast.learn` improves it on the machine, and
`run(..., table=...)` plays it wherever the controller runs.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np

from .. import storage
from ..arrays import FloatArray
from ..errors import DataError, SettingError
from ..storage import Fields
from ..tables import Shown
from .controller import SampledController

COLUMNS = ("reference", "planned", "setpoint", "u", "y")
_NUMBERS = ("number", "error", "largest", "predicted")


@dataclass(frozen=True)
class Repetition:
    """One repetition of a move on a machine.

    Attributes
    ----------
    number : int
        Counted from 1.
    error, largest : float
        Measured tracking error, rms and largest [y].
    predicted : float or None
        The rms error that was expected of it [y].
    outcome : str
        ``first``, ``better``, ``undone`` (worse than the best, which is played again), ``repeated``
        (the best once more).
    """

    number: int
    error: float
    largest: float
    predicted: float | None
    outcome: str

    def to_dict(self) -> dict[str, Any]:
        """Everything as JSON values."""
        return {name: getattr(self, name) for name in (*_NUMBERS, "outcome")}

    @classmethod
    def read(cls, part: Fields) -> Repetition:
        """One of a file."""
        part.require_only((*_NUMBERS, "outcome"))
        return cls(
            part.integer("number"), part.number("error"), part.number("largest"),
            part.optional_number("predicted"), part.text("outcome"),
        )  # fmt: skip


@dataclass(frozen=True, eq=False)
class MoveTable(storage.Stored, Shown):
    """The table of a known move; entry k belongs to the time k Ts.

    Attributes
    ----------
    reference : array, shape (N,)
        What the output shall follow [y].
    setpoint : array, shape (N,)
        The reference that the controller gets so that it does [y].
    planned : array, shape (N,)
        `setpoint` before any learning [y].
    correction : array, shape (M,)
        What was learned, as hats on `planned`, one every four samples [y]; empty if nothing was.
    u, y : array, shape (N,)
        The command and the output that the models expect of the plan, their mean [u, y].
    controller : Controller or StateFeedback
        The only one that it is made for.
    name : str
        Name of the reference.
    errors : sequence of (float, float)
        Tracking error of each model without the table and with it, rms [y].
    limited : float
        Share of the samples at a limit of the command, the most of any model.
    repetitions : sequence of Repetition
        What was done on the machine, in order.
    """

    FORMAT: ClassVar[str] = "sewfast.table"
    VERSION: ClassVar[int] = 1

    reference: FloatArray
    setpoint: FloatArray
    planned: FloatArray
    u: FloatArray
    y: FloatArray
    controller: SampledController
    name: str = "reference"
    errors: tuple[tuple[float, float], ...] = ()
    limited: float = 0.0
    correction: FloatArray = field(default_factory=lambda: np.empty(0))
    repetitions: tuple[Repetition, ...] = ()

    @property
    def Ts(self) -> float:
        """Sample time [s]."""
        return self.controller.Ts

    @property
    def units(self) -> dict[str, str]:
        """The unit of each column by name."""
        u, y = self.controller.u_unit, self.controller.y_unit
        return {"t": "s", "r": y, "setpoint": y, "y": y, "u": u}

    @property
    def expected(self) -> tuple[float, float]:
        """Tracking error of the models without the table and with it, rms over all of them [y]."""
        before, after = np.sqrt(np.mean(np.square(self.errors), axis=0))
        return float(before), float(after)

    def columns(self) -> dict[str, FloatArray]:
        """t, r, setpoint, y, u by name, for a file or a plot."""
        t: FloatArray = np.arange(len(self.reference), dtype=np.float64) * self.Ts
        values = (t, self.reference, self.setpoint, self.y, self.u)
        return dict(zip(self.units, values, strict=True))

    def require(self, controller: SampledController) -> None:
        """Raise `SettingError` for another controller than the one that it is made for."""
        own, other = (
            {k: v for k, v in c.to_dict().items() if k != "notes"}
            for c in (self.controller, controller)
        )
        if own == other:
            return
        names = [name for name in own if own[name] != other.get(name)]
        if own["Ts"] != other["Ts"]:
            raise SettingError(
                name="table", expected=f"one at the controller's sample time of {controller.Ts} s",
                received=f"one at {self.Ts} s", remedy="plan it again",
            )  # fmt: skip
        raise SettingError(
            name="table", expected="the one of this controller",
            received=f"that of one with another {', '.join(names)}",
            remedy="plan it again for this controller, or run that one",
        )  # fmt: skip

    def to_dict(self) -> dict[str, Any]:
        """Everything as JSON values."""
        return {
            "name": self.name,
            "controller": {"version": self.controller.VERSION, **self.controller.to_dict()},
            "errors": [{"without": before, "with": after} for before, after in self.errors],
            "limited": self.limited,
            **{name: getattr(self, name).tolist() for name in (*COLUMNS, "correction")},
            "repetitions": [one.to_dict() for one in self.repetitions],
        }

    def plot(self, ax: Any = None, *, file: str | os.PathLike[str] | None = None) -> Any:
        """Draw the reference with the expected output, the error and the command in three panels.

        Parameters
        ----------
        ax, file
            As for `Drawing.plot`.
        """
        from ..plotting import Trace, loop_drawing

        trace = Trace.of(self.columns(), "model", "expected")
        limits = (self.controller.u_min, self.controller.u_max)
        return loop_drawing([trace], self.units["y"], self.units["u"], limits).plot(ax, file)

    def __str__(self) -> str:
        unit = self.units["y"] or "y"
        lines = [f"table of {self.name}, {len(self.reference) * self.Ts:g} s"]
        if self.errors:
            before, after = self.expected
            lines.append(
                f"  expected  error {after:.4g} {unit} rms, {before:.4g} without the table, on "
                f"{len(self.errors)} model{'s' * (len(self.errors) > 1)}"
            )
        if self.limited > 0.0:
            lines.append(
                f"  limits    at one of the command {100.0 * self.limited:.1f} % of the time: the "
                "move asks for more than the drive has (sewfast profile)"
            )
        lines += [f"  {line}" for line in repetition_lines(self.repetitions, unit)]
        return "\n".join(lines)


def repetition_lines(repetitions: Sequence[Repetition], unit: str) -> list[str]:
    """A line for each repetition."""

    def line(one: Repetition) -> str:
        expected = "" if one.predicted is None else f", expected {one.predicted:.4g}"
        return (
            f"repetition {one.number:2}  error {one.error:.4g} {unit} rms{expected}: {one.outcome}"
        )

    return [line(one) for one in repetitions]


def table_of(given: Any) -> MoveTable:
    """The argument, if it is a table; raises `DataError`."""
    if isinstance(given, MoveTable):
        return given
    raise DataError(
        name="table", expected="a MoveTable", received=type(given).__name__,
        remedy="make one with sewfast.plan, or read one with sewfast.load_table",
    )  # fmt: skip
