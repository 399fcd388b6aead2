"""`SampledController`, the base class of controllers, and the PID `Controller`."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, ClassVar, TypeVar

from numpy.typing import ArrayLike

from .. import _core, storage
from ..arrays import FloatArray
from ..errors import SettingError
from ..gains import Gains, real, vector, whole
from ..storage import Fields
from ..tables import Shown
from ..units import counts_per_unit
from .biquad import MOST, NUMBERS, Biquad
from .feedforward import Feedforward

if TYPE_CHECKING:
    from ..models.rest import Rest

GAIN_NAMES = ("Kp", "Ti", "Td")
NOTCH_NAMES = ("notch_frequency", "notch_depth", "notch_width")
SETTINGS = (
    "alpha", "beta", "N", "Tt", "filter_samples", "filter_time", "observer_time", "r_rate",
)  # fmt: skip
"""Variables of a search besides the gains, those of a schedule's points and the notches."""

"""Version of the files; version 1 had no observer, ramp or schedule, version 2 no biquads, and
version 3 no feedforward. Version 4 is that of other kinds."""

_UNBOUNDED = {
    "N": math.inf,
    "Tt": math.inf,
    "u_min": -math.inf,
    "u_max": math.inf,
    "slew": math.inf,
    "r_rate": math.inf,
}
"""Meaning of null in a file, as JSON has no infinity."""
_FIRST_REALS = ("Ts", "alpha", "beta", "N", "Tt", "u_min", "u_max", "slew", "filter_time")
_REALS = (*_FIRST_REALS, "observer_time", "r_rate")
_OTHERS = ("version", "gains", "u_unit", "y_unit", "filter_samples", "counts_per_rev", "notes")


_Kind = TypeVar("_Kind", bound="SampledController")


class SampledController(storage.Stored, Shown):
    """Base class of all kinds of controllers, for `run`, `tune` and drives. A kind has its settings
    as fields, and implements the members that raise NotImplementedError here.
    """

    KIND: ClassVar[str]
    """Its name in files."""
    FORMAT: ClassVar[str] = "sewfast.controller"
    VERSION: ClassVar[int] = 4
    """Version of its files."""
    LOOP: ClassVar[str] = "speed"
    """What its references are: of the output, or ``position``, its integral."""

    if TYPE_CHECKING:
        # declared as properties, as the fields of a frozen dataclass are read-only
        @property
        def Ts(self) -> float: ...
        @property
        def u_min(self) -> float: ...
        @property
        def u_max(self) -> float: ...
        @property
        def counts_per_rev(self) -> float | None: ...
        @property
        def notes(self) -> str: ...
        @property
        def u_unit(self) -> str: ...
        @property
        def y_unit(self) -> str: ...

    @property
    def counts_per_unit(self) -> float:
        """Encoder counts per second at an output of one unit; 0 for ideal feedback."""
        if self.counts_per_rev is None:
            return 0.0
        return counts_per_unit(self.counts_per_rev, self.y_unit)

    @property
    def feedforward(self) -> Feedforward | None:
        """The command that a model needs for the reference; None for kinds that have none."""
        return None

    @property
    def pace(self) -> float:
        """An estimate of the plant's time constant from the controller alone [s]."""
        raise NotImplementedError

    def core(self) -> _core._Controller:
        """The compiled controller, at rest."""
        raise NotImplementedError

    def about(self: _Kind, rest: Rest) -> _Kind:
        """The same controller for deviations from a level of command and output.

        Raises
        ------
        SettingError
            For a gain schedule, which depends on the output itself, about another level than zero.
        """
        if rest.is_zero:
            return self
        if getattr(self, "schedule", ()) and rest.y != 0.0 and not rest.near_zero:
            raise SettingError(
                name="schedule", expected="constant gains for a plant that does not rest at 0",
                received=f"a schedule over the output, with a rest at {rest.y:g}",
                remedy="leave the schedule out, or identify the model from data that begin at 0",
            )  # fmt: skip
        low, high = self.u_min - rest.u[0], self.u_max - rest.u[0]
        lead = self.feedforward
        changes = {} if lead is None else {"feedforward": lead.about(rest)}
        return replace(self, u_min=low, u_max=high, **changes)  # type: ignore[type-var]

    def limited(self: _Kind, volt: float) -> _Kind:
        """The same controller with commands of at most `volt` [u], as its integral then knows."""
        low, high = max(self.u_min, -volt), min(self.u_max, volt)
        if (low, high) == (self.u_min, self.u_max):
            return self
        return replace(self, u_min=low, u_max=high)  # type: ignore[type-var]

    def early(self, reference: ArrayLike) -> FloatArray:
        """The reference as a step of the compiled controller takes it: with a feedforward `preview`
        samples early, otherwise in time.
        """
        lead = self.feedforward
        return vector("reference", reference) if lead is None else lead.early(reference)

    def sent(self) -> tuple[int, list[float]]:
        """Number of the kind and its parameters, as sent to a device (docs/PROTOCOL.md)."""
        raise NotImplementedError

    @classmethod
    def read(cls, fields: Fields) -> SampledController:
        """The controller in a file.

        Raises
        ------
        SewfastError
            For a field that is missing or unknown, or a setting outside its range.
        """
        raise NotImplementedError

    @classmethod
    def first(cls, plant: Any, **settings: Any) -> SampledController:
        """The start of a search on a model.

        Settings are limits, encoder, units, the length of a filter or None, the middle of the
        recorded output or None, and notes.

        Raises
        ------
        SettingError
            For a plant or a setting that does not suit the kind.
        """
        raise NotImplementedError

    def with_values(self: _Kind, values: Mapping[str, float], notes: str) -> _Kind:
        """The same controller with values of a search, by name."""
        raise NotImplementedError

    def to_dict(self) -> dict[str, Any]:
        """Everything as JSON values."""
        raise NotImplementedError


@dataclass(frozen=True)
class Controller(SampledController):
    """A sampled 2-DOF PID with limits, anti-windup and feedback filter (paper Eq. 9, Fig. 16).

    Parameters
    ----------
    gains : Gains
        In any form; they carry the units of the command and of the output.
    Ts : float
        Sample time [s].
    alpha, beta : float
        Shares of the reference subtracted in the proportional and the derivative term; negative
        values feed the reference forward.
    N : float
        The derivative is filtered with time constant `Td/N`; inf for no filter.
    Tt : float
        Time constant of back-calculation [s]; 0 stops the integral while the command is limited.
    u_min, u_max : float
        Limits of the command [u]; infinite for none.
    slew : float
        Largest change of the command [u/s]; inf for none.
    filter_samples : int
        Moving average in the feedback, 1 to 64 samples; 1 for none.
    filter_time : float
        First-order lag in the feedback after it [s]; 0 for none.
    observer_time : float
        Time constant of the alpha-beta observer in the feedback after that [s]; 0 for none.
    r_rate : float
        Largest change of the reference used by the controller [y/s]; inf for none.
    schedule : sequence of (float, Gains)
        Gains over the magnitude of the filtered output [y]: up to 8 points with increasing speeds
        of 0 or more. Kp, Kp/Ti and Kp Td are linear between them and held outside. If it is not
        empty, `gains` is not used.
    biquads : sequence of Biquad
        Up to 4 filters, one after the other, on the reference and on the filtered output:
        `Biquad.notch(60.0)` and the like.
    feedforward : Feedforward or None
        The command that a model needs for the reference, which then arrives early; None for none.
    counts_per_rev : float or None
        The encoder that measures a model's output; None for ideal feedback. A machine has its own.
    notes : str
        Where it comes from.

    Raises
    ------
    SettingError
        For a setting outside its range.
    """

    KIND: ClassVar[str] = "pid"
    VERSION: ClassVar[int] = 5

    gains: Gains
    Ts: float = 0.001
    alpha: float = 0.0
    beta: float = 0.0
    N: float = math.inf
    Tt: float = 0.0
    u_min: float = -math.inf
    u_max: float = math.inf
    slew: float = math.inf
    filter_samples: int = 1
    filter_time: float = 0.0
    observer_time: float = 0.0
    r_rate: float = math.inf
    schedule: tuple[tuple[float, Gains], ...] = ()
    biquads: tuple[Biquad, ...] = ()
    feedforward: Feedforward | None = None
    counts_per_rev: float | None = None
    notes: str = ""

    def __post_init__(self) -> None:
        for name in _REALS:
            object.__setattr__(self, name, real(name, getattr(self, name)))
        if not isinstance(self.gains, Gains):
            raise SettingError(
                name="gains", expected="Gains", received=repr(self.gains),
                remedy="make them with Gains.standard, Gains.parallel or Gains.per_sample",
            )  # fmt: skip
        object.__setattr__(self, "schedule", _points(self.schedule))
        object.__setattr__(self, "biquads", _sections(self.biquads))
        self._check_gains(self.gains)
        for _, gains in self.schedule:
            self._check_gains(gains)
        object.__setattr__(self, "filter_samples", whole("filter_samples", self.filter_samples))
        if not (self.feedforward is None or isinstance(self.feedforward, Feedforward)):
            raise SettingError(
                name="feedforward", expected="a Feedforward, or None",
                received=repr(self.feedforward),
            )  # fmt: skip
        if self.counts_per_rev is not None:
            object.__setattr__(self, "counts_per_rev", real("counts_per_rev", self.counts_per_rev))
        if not isinstance(self.notes, str):
            raise SettingError(name="notes", expected="text", received=repr(self.notes))
        _ = (self.core(), self.counts_per_unit)

    def _check_gains(self, gains: Gains) -> None:
        if gains.Ts is not None and not math.isclose(gains.Ts, self.Ts, rel_tol=1e-9):
            raise SettingError(
                name="gains", expected=f"some for the controller's sample time of {self.Ts} s",
                received=f"per-sample gains at {gains.Ts} s",
                remedy="convert them with gains.to('standard')",
            )  # fmt: skip
        units, others = (gains.u_unit, gains.y_unit), (self.gains.u_unit, self.gains.y_unit)
        if units != others:
            raise SettingError(
                name="schedule", expected=f"one in the gains' units {others[0]} and {others[1]}",
                received=f"{units[0]} and {units[1]}", remedy="convert one of them",
            )  # fmt: skip

    @property
    def u_unit(self) -> str:
        """Unit of the command, that of the gains."""
        return self.gains.u_unit

    @property
    def y_unit(self) -> str:
        """Unit of the output, that of the gains."""
        return self.gains.y_unit

    @property
    def pace(self) -> float:
        """An estimate of the plant's time constant from the controller alone [s]."""
        Ti = self.gains.to("standard").Ti
        return Ti if math.isfinite(Ti) else 50.0 * self.Ts

    def core(self) -> _core.Controller:
        """The compiled controller, at rest: `step(r, y, feedforward)` gives a sample's command.

        `set_design(other.core())` changes its settings and `set_manual(u)`, `set_automatic()` its
        mode during a run, without a bump. `core().single()` is the same in single precision, bit
        by bit what a microcontroller computes.
        """
        gains = self.gains.to("standard")
        return _core.Controller(
            Kp=gains.Kp,
            Ti=gains.Ti,
            Td=gains.Td,
            filter_samples=self.filter_samples,
            schedule=self.schedule_rows(),
            biquads=self.sections(),
            feedforward=None if self.feedforward is None else self.feedforward.core(),
            **{name: getattr(self, name) for name in _REALS},
        )

    def schedule_rows(self) -> list[tuple[float, float, float, float]]:
        """Speed [y], Kp [u/y], Ti [s], Td [s] of each point of the schedule."""
        standard = [(speed, gains.to("standard")) for speed, gains in self.schedule]
        return [(speed, g.Kp, g.Ti, g.Td) for speed, g in standard]

    def sections(self) -> list[tuple[float, float, float, float]]:
        """Coefficients of each biquad at the controller's sample time: `Biquad.coefficients`."""
        return [biquad.coefficients(self.Ts) for biquad in self.biquads]

    def with_values(self, values: Mapping[str, float], notes: str) -> Controller:
        """The same controller with values of a search, by name; its gains in standard form."""
        changes: dict[str, Any] = {name: values[name] for name in SETTINGS if name in values}
        if "filter_samples" in changes:
            changes["filter_samples"] = int(changes["filter_samples"])
        if self.schedule:
            changes["schedule"] = tuple(
                (speed, _standard(point, values, [f"{gain}[{k}]" for gain in GAIN_NAMES]))
                for k, (speed, point) in enumerate(self.schedule)
            )
        if self.biquads:
            changes["biquads"] = tuple(_notch(b, k, values) for k, b in enumerate(self.biquads))
        gains = _standard(self.gains, values, GAIN_NAMES)
        return replace(self, gains=gains, notes=notes, **changes)

    def to_dict(self) -> dict[str, Any]:
        """Everything as JSON values; null means no such limit or filter."""
        values = {name: bounded(getattr(self, name)) for name in _REALS}
        return {
            "kind": self.KIND,
            "gains": _gains_to_dict(self.gains),
            "u_unit": self.gains.u_unit,
            "y_unit": self.gains.y_unit,
            **values,
            "filter_samples": self.filter_samples,
            "schedule": [{"speed": v, "gains": _gains_to_dict(g)} for v, g in self.schedule],
            "biquads": [biquad.to_dict() for biquad in self.biquads],
            "feedforward": None if self.feedforward is None else self.feedforward.to_dict(),
            "counts_per_rev": self.counts_per_rev,
            "notes": self.notes,
        }

    @classmethod
    def read(cls, fields: Fields) -> Controller:
        """The controller in a file of versions 1 to 3 or 5."""
        version = fields.integer("version")
        reals = _FIRST_REALS if version == 1 else _REALS
        later = (("schedule",) if version > 1 else ()) + (("biquads",) if version > 2 else ())
        later += ("kind", "feedforward") if version > 3 else ()
        fields.require_only((*_OTHERS, *reals, *later))
        units = {"u_unit": fields.text("u_unit"), "y_unit": fields.text("y_unit")}
        return cls(
            gains=_gains(fields.object("gains"), units),
            filter_samples=fields.integer("filter_samples"),
            schedule=_schedule(fields, units) if version > 1 else (),
            biquads=_biquads(fields) if version > 2 else (),
            feedforward=_feedforward(fields) if version > 3 else None,
            counts_per_rev=fields.optional_number("counts_per_rev"),
            notes=fields.text("notes"),
            **{name: unbounded(fields, name, _UNBOUNDED) for name in reals},
        )

    def __str__(self) -> str:
        u, y = self.gains.u_unit or "u", self.gains.y_unit or "y"
        lag = f", then a lag of {self.filter_time:g} s" if self.filter_time else ""
        if self.observer_time:
            lag += f", then an observer of {self.observer_time:g} s"
        ramp = "" if math.isinf(self.r_rate) else f", ramp of {self.r_rate:g} {y}/s"
        gains = [f"  gains     {self.gains}"]
        if self.schedule:
            gains = [f"  gains     at {speed:g} {y}: {g}" for speed, g in self.schedule]
        encoder = "ideal" if self.counts_per_rev is None else f"{self.counts_per_rev:g} counts/rev"
        windup = (
            "conditional integration" if self.Tt == 0 else f"back-calculation, Tt {self.Tt:g} s"
        )
        lines = [
            f"2-DOF PID at {self.Ts:g} s from {y} to {u}",
            *gains,
            f"  reference alpha {self.alpha:.6g}, beta {self.beta:.6g}{ramp}",
            f"  derivative filter N {self.N:.6g}",
            f"  limits    {self.u_min:g} to {self.u_max:g} {u}, slew {self.slew:g} {u}/s; {windup}",
            f"  feedback  {encoder}, mean of {self.filter_samples} samples{lag}",
            *(f"  biquad    {biquad}" for biquad in self.biquads),
            *([f"  forward   {self.feedforward}"] if self.feedforward else []),
        ]
        return "\n".join([*lines, f"  notes     {self.notes}"] if self.notes else lines)


def _notch(own: Biquad, k: int, values: Mapping[str, float]) -> Biquad:
    """Biquad number `k` with its values replaced by those of the search."""
    names = [f"{name}[{k}]" for name in NOTCH_NAMES]
    if not any(name in values for name in names):
        return own
    return Biquad.notch(
        *(values.get(name, x) for name, x in zip(names, own.numbers, strict=True))
    )  # fmt: skip


def _standard(own: Gains, values: Mapping[str, float], names: Sequence[str]) -> Gains:
    """The gains in standard form, with those replaced that have a value under their name."""
    standard = own.to("standard")
    kept = (standard.Kp, standard.Ti, standard.Td)
    Kp, Ti, Td = (values.get(name, own) for name, own in zip(names, kept, strict=True))
    return Gains.standard(Kp, Ti, Td, u_unit=own.u_unit, y_unit=own.y_unit)


def pid_of(controller: SampledController, use: str) -> Controller:
    """The controller as a PID, for code that supports no other kind; `use` names that code."""
    if isinstance(controller, Controller):
        return controller
    raise SettingError(
        name="controller", expected="a PID (Controller)", received=type(controller).__name__,
        remedy=f"{use} supports no other kind; run(controller, model) simulates it",
    )  # fmt: skip


def _schedule(fields: Fields, units: Mapping[str, str]) -> tuple[tuple[float, Gains], ...]:
    points = fields.objects("schedule")
    for point in points:
        point.require_only(("speed", "gains"))
    return tuple((p.number("speed"), _gains(p.object("gains"), units)) for p in points)


def _feedforward(fields: Fields) -> Feedforward | None:
    if fields.any("feedforward") is None:
        return None
    return Feedforward.read(fields.object("feedforward"))


def _biquads(fields: Fields) -> tuple[Biquad, ...]:
    found = []
    for part in fields.objects("biquads"):
        kind = part.text("kind")
        names = NUMBERS.get(kind)
        if names is None:
            raise part.refuse("kind", ", ".join(NUMBERS), kind)
        part.require_only(("kind", *names))
        found.append(Biquad(kind, tuple(part.number(name) for name in names)))
    return tuple(found)


def _gains(part: Fields, units: Mapping[str, str]) -> Gains:
    form = part.text("form")
    names = Gains.fields_of(form)
    if names is None:
        raise part.refuse("form", "standard, parallel or per_sample", form)
    part.require_only(("form", *names))
    values = [unbounded(part, name, {"Ti": math.inf}) for name in names]
    return Gains(form, *values, **units)  # type: ignore[arg-type]


def _gains_to_dict(gains: Gains) -> dict[str, Any]:
    return {name: bounded(value) for name, value in gains.to_dict().items()}


def _points(schedule: Any) -> tuple[tuple[float, Gains], ...]:
    """The schedule as pairs of a speed and gains; raise for anything else."""
    try:
        points = [(speed, gains) for speed, gains in schedule]
    except (TypeError, ValueError) as error:
        raise SettingError(
            name="schedule", expected="(speed, Gains) pairs", received=repr(schedule),
            remedy="give () for constant gains",
        ) from error  # fmt: skip
    for _, gains in points:
        if not isinstance(gains, Gains):
            raise SettingError(
                name="schedule", expected="Gains beside each speed", received=repr(gains),
                remedy="make them with Gains.standard, Gains.parallel or Gains.per_sample",
            )  # fmt: skip
    return tuple((real("speed", speed), gains) for speed, gains in points)


def _sections(biquads: Any) -> tuple[Biquad, ...]:
    """The biquads as a tuple; raise for anything else."""
    given = (biquads,) if isinstance(biquads, Biquad) else biquads
    if not isinstance(given, (tuple, list)) or not all(isinstance(b, Biquad) for b in given):
        raise SettingError(
            name="biquads", expected="a list of them", received=repr(biquads),
            remedy="for example biquads=[Biquad.notch(60.0)]",
        )  # fmt: skip
    if len(given) > MOST:
        raise SettingError(name="biquads", expected=f"at most {MOST}", received=str(len(given)))
    return tuple(given)


def unbounded(fields: Fields, name: str, infinite: Mapping[str, float]) -> float:
    """The number of a field, or infinity for null."""
    if name in infinite and fields.any(name) is None:
        return infinite[name]
    return fields.number(name)


def bounded(value: Any) -> Any:
    """The value, or None for infinity, which JSON lacks."""
    return None if isinstance(value, float) and math.isinf(value) else value


def paper_controller() -> Controller:
    """The paper's controller: Kp .02, Ki .02, Kd .5 per sample of 1 ms, alpha .4, beta .2.

    The paper leaves the form open; only as per-sample gains in V/RPM within +-10 V do they track on
    its own plant, and they depend on that limit: without it the loop is unstable. Raw feedback.
    """
    return Controller(
        gains=Gains.per_sample(0.02, 0.02, 0.5, Ts=0.001),
        alpha=0.4,
        beta=0.2,
        u_min=-10.0,
        u_max=10.0,
        counts_per_rev=1572.0,
        notes="gains of the paper, read as per-sample gains",
    )
