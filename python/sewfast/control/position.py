"""`PositionController`: a position loop over a PID.

The arithmetic is that of `sewfast_control::position`, on models, on every `Machine` of this process
and, in single precision, on devices. It works in counts: they are 0 where a run begins.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import TYPE_CHECKING, Any, ClassVar

from numpy.typing import ArrayLike

from .. import _core
from ..arrays import FloatArray
from ..errors import SettingError
from ..gains import real, vector, whole
from ..storage import Fields
from .controller import Controller, SampledController, pid_of

if TYPE_CHECKING:
    from ..models.rest import Rest

RATES, SMOOTHED = 8, 31
"""The most rows of rates, and the longest mean of a profile in samples: what the law has room for.
"""
FIELDS = (
    "version", "kind", "speed", "gain", "fastest", "rates", "share", "smoothing", "landing",
    "creep", "notes",
)  # fmt: skip


@dataclass(frozen=True)
class PositionController(SampledController):
    """A position loop over a PID for the speed, which stays as it is.

    A move has a profile whose speed, acceleration and jerk are what the drive can do. Its speed is
    the reference of the speed loop, with that loop's own feedforward; `gain` times the distance
    between the profile, as late as the counts, and the counts is added to it. Within one count of a
    goal at which the profile stands the integral lets go of this distance, so that dry friction
    makes nothing hunt.

    Parameters
    ----------
    speed : Controller
        The speed loop. It needs an encoder: the position is its counts.
    gain : float
        Speed over position error [1/s].
    fastest : float
        Largest speed of a move, and the largest from which a stop may begin [y].
    rates : sequence of (float, float, float)
        Up to 8 speeds [y], growing from 0, each with the largest rates away from rest and towards
        it that the drive has from there on [y/s].
    share : float
        Part of these rates that a profile uses, above 0 to 1: the rest is the feedback's.
    smoothing : int
        Samples in which a rate comes up, 1 to 31: a mean of the profile, which bounds its jerk. If
        they are odd, a goal that moves is followed half a sample late.
    landing, creep : float
        The last part of a move [counts] and the speed at which it is passed [y]: what braking makes
        swing dies away before the goal. 0 for no such part.
    notes : str
        Where it comes from.

    Raises
    ------
    SettingError
        For a setting outside its range, or a speed loop without encoder.

    Notes
    -----
    Profiles by a mean of samples: Biagiotti and Melchiorri, *FIR filters for online trajectory
    planning with time- and frequency-domain specifications*, Control Engineering Practice 20, 2012.
    """

    KIND: ClassVar[str] = "position"
    LOOP: ClassVar[str] = "position"

    speed: Controller
    gain: float
    fastest: float
    rates: tuple[tuple[float, float, float], ...]
    share: float = 1.0
    smoothing: int = 1
    landing: float = 0.0
    creep: float = 1.0
    notes: str = ""

    def __post_init__(self) -> None:
        object.__setattr__(self, "speed", pid_of(self.speed, "a position loop"))
        for name in ("gain", "fastest", "share", "landing", "creep"):
            object.__setattr__(self, name, real(name, getattr(self, name)))
        object.__setattr__(self, "smoothing", whole("smoothing", self.smoothing))
        rows = tuple(tuple(real("rate", x) for x in row) for row in self.rates)
        object.__setattr__(self, "rates", rows)
        if not 0.0 < self.share <= 1.0:
            raise SettingError(
                name="share", expected="a part above 0, at most 1", received=f"{self.share:g}"
            )
        if self.speed.counts_per_rev is None:
            raise SettingError(
                name="speed", expected="one with an encoder, whose counts are the position",
                received="one without", remedy="tune it with counts_per_rev (--counts-per-rev)",
            )  # fmt: skip
        if not isinstance(self.notes, str):
            raise SettingError(name="notes", expected="text", received=repr(self.notes))
        if any(len(row) != 3 for row in rows):
            raise SettingError(
                name="rates", expected="(speed, rate away from rest, rate towards it) rows",
                received=repr(self.rates),
            )  # fmt: skip
        _ = self.core()

    @property
    def Ts(self) -> float:
        """Sample time, that of the speed loop [s]."""
        return self.speed.Ts

    @property
    def u_min(self) -> float:
        """Least command, that of the speed loop [u]."""
        return self.speed.u_min

    @property
    def u_max(self) -> float:
        """Largest command, that of the speed loop [u]."""
        return self.speed.u_max

    @property
    def counts_per_rev(self) -> float | None:
        """Encoder counts per turn, those of the speed loop."""
        return self.speed.counts_per_rev

    @property
    def u_unit(self) -> str:
        """Unit of the command."""
        return self.speed.u_unit

    @property
    def y_unit(self) -> str:
        """Unit of the speed."""
        return self.speed.y_unit

    @property
    def pace(self) -> float:
        """That of the speed loop [s]."""
        return self.speed.pace

    def about(self, rest: Rest) -> PositionController:
        """The same for deviations from a level of the command.

        Raises
        ------
        SettingError
            For a plant that does not stand at rest: its position would move on.
        """
        if rest.y != 0.0 and not rest.near_zero:
            raise SettingError(
                name="plant", expected="one whose speed is 0 at rest", received=f"{rest.y:g}",
                remedy="a position loop needs a drive that stands without a command",
            )  # fmt: skip
        return replace(self, speed=self.speed.about(rest))

    def core(self) -> Any:
        """The compiled loop, at rest: `step(r, y)` takes a goal [counts], early by the preview
        (`early`), and the counted speed [y], and gives a sample's command.
        """
        return self._loop()

    def _loop(
        self, stop: tuple[int, float, float, bool] | None = None, *, releases: bool = False
    ) -> _core.PositionController:
        """The compiled loop for one run. With `stop`, the samples before it, the angle and the turn
        [counts] and whether it goes onward, references are speeds until then.
        """
        return _core.PositionController(
            self.speed.core(), gain=self.gain, counts_per_unit=self.counts_per_unit,
            fastest=self.fastest, rates=self.rows(), smoothing=self.smoothing,
            landing=self.landing, creep=self.creep, releases=releases, stop=stop,
        )  # fmt: skip

    def rows(self) -> list[tuple[float, float, float]]:
        """The rates of a profile: this share of the drive's, within the ramp of the speed loop."""
        most, part = self.speed.r_rate, self.share
        return [(v, min(part * up, most), min(part * down, most)) for v, up, down in self.rates]

    def limited(self, volt: float) -> PositionController:
        return replace(self, speed=self.speed.limited(volt))

    def early(self, reference: ArrayLike) -> FloatArray:
        """Goals as the compiled loop takes them, early by the preview; the last value stays."""
        early: FloatArray = self.core().early(vector("reference", reference))
        return early

    @classmethod
    def first(cls, plant: Any, **settings: Any) -> PositionController:
        """A search needs its speed loop first.

        Raises
        ------
        SettingError
            Always.
        """
        raise SettingError(
            name="controller", expected="the kind of a speed loop", received=repr(cls.KIND),
            remedy="tune(models, loop='position') tunes a PID and the position loop over it",
        )  # fmt: skip

    def to_dict(self) -> dict[str, Any]:
        """Everything as JSON values."""
        rows = [{"speed": v, "up": up, "down": down} for v, up, down in self.rates]
        return {
            "kind": self.KIND,
            "speed": {"version": self.speed.VERSION, **self.speed.to_dict()},
            "gain": self.gain, "fastest": self.fastest, "rates": rows, "share": self.share,
            "smoothing": self.smoothing, "landing": self.landing, "creep": self.creep,
            "notes": self.notes,
        }  # fmt: skip

    @classmethod
    def read(cls, fields: Fields) -> PositionController:
        """The controller in a file."""
        fields.require_only(FIELDS)
        rows = fields.objects("rates")
        for row in rows:
            row.require_only(("speed", "up", "down"))
        return cls(
            speed=_speed_in(fields.object("speed")),
            gain=fields.number("gain"),
            fastest=fields.number("fastest"),
            rates=tuple((r.number("speed"), r.number("up"), r.number("down")) for r in rows),
            share=fields.number("share"),
            smoothing=fields.integer("smoothing"),
            landing=fields.number("landing"),
            creep=fields.number("creep"),
            notes=fields.text("notes"),
        )

    def __str__(self) -> str:
        y = self.y_unit or "y"
        down = [rate for _, _, rate in self.rates]
        lines = [
            f"position loop, gain {self.gain:.4g} 1/s, up to {self.fastest:.5g} {y}",
            f"  profile   {100.0 * self.share:.3g} % of {min(down):.4g} to {max(down):.4g} {y}/s "
            f"towards rest, jerk over {self.smoothing} samples; the last {self.landing:.3g} counts "
            f"at {self.creep:.3g} {y}",
        ]
        notes = [f"  notes     {self.notes}"] if self.notes else []
        return "\n".join([*lines, *notes, f"over a {self.speed}"])


@dataclass(frozen=True)
class Playing(PositionController):
    """A position controller for one run, as the `follow` of a machine takes it. With `stop`, the
    samples before it, the angle and the turn [counts] and whether it goes onward, references are
    speeds until then; otherwise they are goals [counts].
    """

    stop: tuple[int, float, float, bool] | None = None
    releases: bool = False

    @classmethod
    def of(cls, controller: PositionController, **run: Any) -> Playing:
        """The controller with what it does in a run; one that is playing already stays as it is."""
        if isinstance(controller, Playing) and not run:
            return controller
        own = {one.name: getattr(controller, one.name) for one in fields(PositionController)}
        return cls(**own, **run)

    def core(self) -> Any:
        return self._loop(self.stop, releases=self.releases)

    def on_device(
        self, r: FloatArray, counts: FloatArray, volt: float
    ) -> tuple[FloatArray, FloatArray]:
        """Places and goals of a device, which steps the same law in single precision and within
        its limit of the command, from the references and the counts of the run; NaN before a stop.
        """
        core = self.limited(volt).core()
        _, place, goal = core.single(self.early(r)[: len(counts)], counts)
        return place, goal


def _speed_in(fields: Fields) -> Controller:
    """The speed loop inside a file."""
    version = fields.integer("version")
    if version > Controller.VERSION:
        raise fields.refuse("version", f"at most {Controller.VERSION}", version)
    if (kind := fields.values.get("kind", Controller.KIND)) != Controller.KIND:
        raise fields.refuse("kind", repr(Controller.KIND), repr(kind))
    return Controller.read(fields)


def require_position(controller: Any, call: str) -> PositionController:
    """The controller, if it has a position loop; raises `SettingError`."""
    if isinstance(controller, PositionController):
        return controller
    kind = isinstance(controller, SampledController)
    raise SettingError(
        name="controller", expected="a PositionController",
        received="a controller without a position loop" if kind else type(controller).__name__,
        remedy="tune one with loop='position' (sewfast tune --loop position)"
        if kind
        else f"the order is {call}",
    )  # fmt: skip
