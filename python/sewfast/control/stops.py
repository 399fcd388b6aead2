"""Runs of a position loop: `stop_at` and `follow_positions`, and their `PositionRun`.

On models, virtual machines, every `Machine` of this process and devices.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, Literal, TypeAlias

import numpy as np
from numpy.typing import ArrayLike

from .. import _core
from ..arrays import FloatArray, known_until
from ..errors import DataError, SettingError
from ..gains import real, vector
from ..machine import VirtualMachine
from ..models import Model
from ..plotting import Drawing, Plotted, draw, legend
from ..recording import require_finite
from ..units import counts_of, duration, position_unit
from .benches import MachineBench, guarded, machine_of
from .loop import check_fits, common_rest, plant_name, require_units, single_core
from .machine import is_streaming
from .position import Playing, PositionController, require_position

if TYPE_CHECKING:
    from .machine import Machine

Way: TypeAlias = Literal["onward", "shortest"]
"""Without turning back, or by the shorter way."""
WAYS = ("onward", "shortest")
FARTHEST = 2.0**50
"""Largest count that is told from its neighbours with room."""
LONGEST = 10_000_000
"""Most samples after a stop."""


def _within(name: str, counts: FloatArray | float) -> None:
    if np.any(np.abs(counts) > FARTHEST):
        raise SettingError(
            name=name, expected=f"a place within {FARTHEST:.3g} counts",
            received=f"{float(np.max(np.abs(counts))):.3g} counts", remedy="give it in its turn",
        )  # fmt: skip


@dataclass(frozen=True, eq=False)
class PositionRun(Plotted):
    """A run of a position loop; entry k is measured and computed at `t[k]`.

    Attributes
    ----------
    t : array, shape (N,)
        Time [s].
    r : array, shape (N,)
        What was asked for: speeds before a stop [y], NaN after it; or goals [counts].
    u : array, shape (N,)
        Command after its limits [u].
    y, feedback : array, shape (N,)
        Speed, and the measured speed after the feedback filter [y].
    counts : array, shape (N,)
        The encoder's counts since the beginning of the run.
    position : array, shape (N,)
        The true position of a model or a virtual machine [counts]; of another machine its counts.
    place, goal : array, shape (N,)
        The profile's position at that time, and where it goes [counts]; NaN before a stop. A stop
        goes to a later turn than at first if the drive brakes less than its models.
    start : int
        The sample at which the stop, or the first move, begins.
    controller : PositionController
    plant, name : str
        Names of the plant and of what was asked for.
    unit : str
        Unit of positions in texts and pictures.
    """

    t: FloatArray
    r: FloatArray
    u: FloatArray
    y: FloatArray
    feedback: FloatArray
    counts: FloatArray
    position: FloatArray
    place: FloatArray
    goal: FloatArray
    start: int
    controller: PositionController
    plant: str
    name: str
    unit: str = "deg"
    is_stop: bool = field(default=True, repr=False)

    @property
    def Ts(self) -> float:
        """Sample time [s]."""
        return self.controller.Ts

    @property
    def units(self) -> dict[str, str]:
        """The unit of each column by name."""
        u, y = self.controller.u_unit, self.controller.y_unit
        counted = dict.fromkeys(("counts", "position", "place", "goal"), "counts")
        asked = y if self.is_stop else "counts"
        return {"t": "s", "r": asked, "u": u, "y": y, "feedback": y, **counted}

    def columns(self) -> dict[str, FloatArray]:
        """t, r, u, y, feedback, counts, position, place, goal by name, for a file."""
        return {name: getattr(self, name) for name in self.units}

    def _in_unit(self, counts: float) -> float:
        assert self.controller.counts_per_rev is not None
        return counts / counts_of(1.0, self.unit, self.controller.counts_per_rev)

    def metrics(self) -> dict[str, float | None]:
        """How the goal was met, of a stop or of the last move.

        Returns
        -------
        dict
            `off`, how far the shaft rests from its goal, mean over the last tenth of the move, and
            `passed`, how far it went beyond it at most [unit]; `counts_off`, the encoder's last
            count minus the goal; `turns` from the stop or the last change of the goal on; `time`
            until it stays within one count [s], None if it never does; `rest_counts`, peak to peak
            of the counts in the later half of the time for which the profile stands, None if it
            never stood; `rms`, error after the
            profile [unit]; `u_rms`, `du_rms` (change from sample to sample) [u]. After samples that
            a link has lost, `time` and `rest_counts` are None, and the others NaN.
        """
        per_rev = self.controller.counts_per_rev
        assert per_rev is not None
        first = self.start
        if not self.is_stop:
            first = int(np.max(np.flatnonzero(np.diff(self.goal)), initial=self.start - 1)) + 1
        position, goal = self.position[first:], float(self.goal[-1])
        way = math.copysign(1.0, goal - position[0])
        tail = max(1, len(position) // 10)
        late = np.abs(self.counts[first:] - goal) > 1.0
        settled = int(np.max(np.flatnonzero(late), initial=-1)) + 1
        moving = np.flatnonzero(self.place[first:] != goal)
        stood = self.counts[first + int(np.max(moving, initial=-1)) + 1 :]
        # the first half is the feedback's
        stood = stood[len(stood) // 2 :]
        error = self.place[self.start :] - self.position[self.start :]
        found = _core.effort(self.u, u_min=self.controller.u_min, u_max=self.controller.u_max)
        passed = max(0.0, float(np.max(way * (position - goal)))) if self._is_known else math.nan
        return {
            "off": self._in_unit(float(np.mean(position[-tail:])) - goal),
            "passed": self._in_unit(passed),
            "counts_off": float(self.counts[-1]) - goal,
            "turns": float(np.sum(np.abs(np.diff(position)))) / per_rev,
            "time": settled * self.Ts if self._is_known and settled < len(late) else None,
            "rest_counts": float(np.ptp(stood)) if len(stood) else None,
            "rms": self._in_unit(float(np.sqrt(np.mean(error**2)))),
            "u_rms": found["u_rms"],
            "du_rms": found["du_rms"],
        }

    @property
    def _is_known(self) -> bool:
        """Whether it is known where the profile went: a link that lost samples lost that, too."""
        return bool(np.isfinite(self.goal[-1]))

    @property
    def warnings(self) -> list[str]:
        """What a stop onward, or the last move, did that its models do not."""
        if not self._is_known:
            lost = known_until(self.counts)
            return [
                f"lost samples from {lost} on: how it met its goal is unknown; see the line "
                "(sewfast doctor) and run it again"
            ]
        m, unit = self.metrics(), self.unit
        count = abs(self._in_unit(1.0))
        found = []
        remedy = "use less of what they can do (share), or identify it again"
        if self.is_stop and np.any(np.diff(self.goal[self.start :])):
            found.append(
                "went on to a later turn, as it would have passed its goal: the drive brakes less "
                f"than its models; {remedy}"
            )
        if (passed := m["passed"]) is not None and passed > 2.0 * count:
            found.append(
                f"passed its goal by {passed:.3g} {unit}: the drive brakes less than its models; "
                f"{remedy}"
            )
        if m["time"] is None and m["rest_counts"] is not None:
            found.append(f"does not stay within a count: rests {m['off']:.3g} {unit} off")
        return found

    def drawing(self) -> Drawing:
        """Speed, way left, error about the goal and command over the time."""
        t, y = self.t, self.controller.y_unit or "y"
        per_rev = self.controller.counts_per_rev or 1.0
        place, goal = self.place, self.goal
        per_sample = self.Ts * self.controller.counts_per_unit

        def speed(ax: Any) -> None:
            asked = np.diff(place, prepend=place[0]) / per_sample
            draw(ax, t, self.y, "machine", "speed")
            draw(ax, t, asked, "reference", "profile")
            ax.set_ylabel(f"speed [{y}]")
            legend(ax)

        def left(ax: Any) -> None:
            draw(ax, t, (goal - self.position) / per_rev, "machine")
            draw(ax, t, (goal - place) / per_rev, "reference")
            ax.set_ylabel("way left [turns]")

        def error(ax: Any) -> None:
            off = (self.position - goal) * self._in_unit(1.0)
            draw(ax, t, off, "machine")
            ax.axhline(0.0, color="black", linewidth=0.8)
            near = abs(self._in_unit(max(12.0, 1.2 * self.controller.landing)))
            ax.set_ylim(-near, near)
            ax.set_ylabel(f"from the goal [{self.unit}]")

        def command(ax: Any) -> None:
            draw(ax, t, self.u, "command", held=True)
            ax.set_ylabel(f"command [{self.controller.u_unit or 'u'}]")
            ax.set_xlabel("time [s]")

        rows = tuple((panel,) for panel in (speed, left, error, command))
        return Drawing(rows, (1.9, 1.6, 1.6, 1.6))

    def __str__(self) -> str:
        m, unit = self.metrics(), self.unit
        if not self._is_known:
            return f"{self.name} on {self.plant}\n  stops     unknown: samples were lost"
        came = "not within a count" if m["time"] is None else f"after {duration(m['time'])}"
        rest = (
            "at rest   the profile has not come to rest: run it for longer"
            if m["rest_counts"] is None
            else f"at rest   {m['rest_counts']:.4g} counts peak to peak"
        )
        return "\n".join(
            [
                f"{self.name} on {self.plant}",
                f"  stops     {m['off']:.3f} {unit} from it {came}, {m['turns']:.3f} turns; passed "
                f"by {m['passed']:.3f} {unit}",
                f"  error     {m['rms']:.3f} {unit} rms after the profile",
                f"  {rest}",
                f"  command   {m['u_rms']:.4g} {self.controller.u_unit or 'u'} rms, "
                f"{m['du_rms']:.4g} from sample to sample",
            ]
        )


HOLD, AFTER = 0.5, 1.0
"""How long a run holds its speed before a stop, and goes on after it, by default [s]."""

_POSITION = re.compile(r"\s*([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)\s*([^\d\s].*?)\s*")


def position_of(text: str) -> tuple[float, str]:
    """A position with its unit, such as ``90deg``.

    Raises
    ------
    SettingError
        Without a number, or without a unit that `sewfast.units` knows.
    """
    match = _POSITION.fullmatch(text) if isinstance(text, str) else None
    if match is None:
        raise SettingError(
            name="position", expected="a number with a unit: deg, rad, turns or counts",
            received=repr(text), remedy="for example '90deg' or '0.25turns'",
        )  # fmt: skip
    return float(match[1]), position_unit(match[2])


def stop_at(
    controller: PositionController,
    on: Model | VirtualMachine | Machine,
    angle: str,
    *,
    speed: float | None = None,
    reference: ArrayLike | None = None,
    way: Way = "onward",
    zero: float = 0.0,
    after: float = AFTER,
    release: bool = False,
    disturbance: ArrayLike | None = None,
    **drive: Any,
) -> PositionRun:
    """Run a drive at a speed, and stop it at an angle of its turn.

    Parameters
    ----------
    controller : PositionController
    on : Model, VirtualMachine or Machine
        The plant, from rest. A `Machine` is run by its `follow`, with the position loop computed
        there: for a drive on its device, in single precision.
    angle : str
        With its unit, such as ``90deg``, ``1.57rad``, ``.25turns`` or ``393counts``.
    speed : float, optional
        Speed from which it stops, negative for backwards [y]; 0 from rest. By default half of the
        controller's `fastest`.
    reference : array, shape (N,), optional
        In place of it, speeds that are followed before the stop [y].
    way : "onward" or "shortest"
        Onward, the angle that is reached first without turning back, at no more than the present
        speed; the shaft goes forwards if it stands. Or the one that is nearest to where it can be
        at rest first, for which it may turn back.
    zero : float
        The encoder's count at the angle 0: counts are 0 where a run begins.
    after : float
        How long the run goes on from the stop on [s].
    release : bool
        Whether the command goes to 0 once the shaft has come to rest; by default the loop holds it.
    disturbance : array, shape (N,), optional
        For a model: a command added after the limiter, unknown to the controller [u].
    **drive
        For a drive: `file`, `live`, `overwrite`, `watch` and `cancel` as for its `follow`. Its
        `stop_at` begins the stop sooner.

    Raises
    ------
    SettingError
        For a controller without a position loop, a speed beyond its `fastest`, an angle without a
        unit, a machine without counts, a device without positions, sample times or units that
        disagree.
    FitError
        If the loop diverges.
    LinkError
        From a machine that ended the run.
    """
    position = require_position(controller, "stop_at(controller, plant, '90deg')")
    per_rev = position.counts_per_rev
    assert per_rev is not None
    value, unit = position_of(angle)
    if way not in WAYS:
        raise SettingError(name="way", expected=" or ".join(WAYS), received=repr(way))
    after = real("after", after)
    if not position.Ts <= after <= LONGEST * position.Ts:
        raise SettingError(
            name="after",
            expected=f"a time from a sample to {LONGEST * position.Ts:g} s",
            received=f"{after:g}",
        )
    if reference is not None and speed is not None:
        raise SettingError(
            name="speed", expected="no reference beside it", received="both",
            remedy="leave one of them out",
        )  # fmt: skip
    if reference is None:
        wanted = 0.5 * position.fastest if speed is None else real("speed", speed)
        _require_reach(position, [wanted])
        hold = round(HOLD / position.Ts)
        before = _core.approach(position.rows(), wanted, hold=hold, Ts=position.Ts)
        name = f"stop at {angle} from {wanted:.5g} {position.y_unit}".rstrip()
    else:
        before, name = vector("reference", reference).copy(), f"stop at {angle}"
        _require_reach(position, before)
        steepest = position.Ts * max(max(up, down) for _, up, down in position.rows())
        if len(before) > 1 and not abs(before[-1] - before[-2]) <= steepest:
            raise SettingError(
                name="reference", expected="a speed that the drive has before the stop, changing "
                f"by at most {steepest:.4g} {position.y_unit} a sample",
                received=f"{abs(before[-1] - before[-2]):.4g} at its end",
                remedy="hold the last speed for as long as the drive needs to reach it",
            )  # fmt: skip
    start = len(before)
    r = np.append(before, np.full(round(after / position.Ts), before[-1] if start else 0.0))
    counts = real("zero", zero) + counts_of(value, unit, per_rev)
    _within("angle", counts)
    stop = (start, counts, per_rev, way == "onward")
    found = _played(position, on, r, name, stop, release, disturbance, drive)
    return replace(found, unit=unit)


def follow_positions(
    controller: PositionController,
    on: Model | VirtualMachine | Machine,
    goals: ArrayLike,
    *,
    unit: str,
    release: bool = False,
    disturbance: ArrayLike | None = None,
    name: str = "positions",
    **drive: Any,
) -> PositionRun:
    """Go from goal to goal, from rest.

    A goal that stands is gone to in the least time within what the drive can do; one that moves as
    the drive can, such as the samples of an S-curve, is followed as it is.

    Parameters
    ----------
    controller : PositionController
    on : Model, VirtualMachine or Machine
        As for `stop_at`.
    goals : array, shape (N,)
        A goal for each sample, counted from where the run begins.
    unit : str
        Their unit: ``deg``, ``rad``, ``turns`` or ``counts``.
    release : bool
        Whether the command goes to 0 once the shaft has come to rest, until the next goal; by
        default the loop holds it.
    disturbance : array, shape (N,), optional
        As for `stop_at`.
    name : str
        In texts.
    **drive
        As for `stop_at`.

    Raises
    ------
    SettingError, FitError, LinkError
        As `stop_at`.
    DataError
        For goals that are empty or not finite.
    """
    position = require_position(controller, "follow_positions(controller, plant, goals)")
    assert position.counts_per_rev is not None
    known = position_unit(unit)
    r = vector("goals", goals) * counts_of(1.0, known, position.counts_per_rev)
    if not len(r):
        raise DataError(
            name="goals", expected="one for each sample", received="none",
            remedy="a goal that stands for a second has a second of samples",
        )  # fmt: skip
    require_finite("goals", r)
    _within("goals", r)
    found = _played(position, on, r, name, None, release, disturbance, drive)
    return replace(found, unit=known)


def _require_reach(controller: PositionController, speeds: Sequence[float] | FloatArray) -> None:
    most = float(np.max(np.abs(speeds), initial=0.0))
    if not most <= controller.fastest:
        raise SettingError(
            name="speed", expected=f"at most {controller.fastest:.5g} {controller.y_unit}, up to "
            "which the rates of the drive are known", received=f"{most:.5g}",
            remedy="stop from a lower speed, or record and tune up to this one",
        )  # fmt: skip


def _played(
    controller: PositionController, on: Any, r: FloatArray, name: str,
    stop: tuple[int, float, float, bool] | None, release: bool, disturbance: ArrayLike | None,
    drive: Mapping[str, Any],
) -> PositionRun:  # fmt: skip
    """The run on a plant of any kind."""
    start = 0 if stop is None else stop[0]
    if isinstance(on, MachineBench):
        on = on.machine
    shown = r.copy()
    if stop is not None:
        shown[start:] = np.nan
    t = np.arange(len(r), dtype=np.float64) * controller.Ts
    playing = Playing.of(controller, stop=stop, releases=release)
    if drive and not is_streaming(on):
        raise SettingError(
            name=", ".join(drive), expected="a drive", received=type(on).__name__,
            remedy="leave it out",
        )  # fmt: skip
    common: dict[str, Any] = {
        "t": t,
        "r": shown,
        "start": start,
        "controller": controller,
        "name": name,
    }
    if isinstance(on, (Model, VirtualMachine)):
        check_fits(controller, on)
        rest = common_rest([on])
        if disturbance is not None and not isinstance(on, Model):
            raise SettingError(
                name="disturbance", expected="one on a model only", received="one on a machine",
                remedy="load a virtual machine by its set_load",
            )  # fmt: skip
        _require_counts(controller, on)
        load = None if disturbance is None else vector("disturbance", disturbance)
        if load is not None and not (len(load) == len(r) and np.isfinite(load).all()):
            raise DataError(
                name="disturbance", expected=f"{len(r)} finite numbers, one for each sample",
                received=f"{len(load)}", remedy="0 where there is no load",
            )  # fmt: skip
        record: dict[str, Any] = _core.position_run(
            single_core(on, rest), playing.about(rest).core(), r,
            counts_per_unit=controller.counts_per_unit,
            disturbance=load,
        )  # fmt: skip
        record["u"] = record["u"] + rest.u[0]
        return PositionRun(**common, **record, plant=plant_name(on), is_stop=stop is not None)
    if disturbance is not None:
        raise SettingError(
            name="disturbance", expected="none on a machine", received="one",
            remedy="run it on a model",
        )  # fmt: skip
    machine = machine_of(on)
    _require_counts(controller, machine)
    require_units(controller, ("", "RPM"))
    run = guarded(machine).follow(playing, r, name, **drive)
    # the stop may have been asked for sooner
    made = run.controller.stop if isinstance(run.controller, Playing) else stop
    if made is not None and made != stop:
        start = made[0]
        shown[start:] = np.nan
        common |= {"start": start, "name": f"{name}, asked for at sample {start}"}
    counts, place, goal = run.recording.counts, run.place, run.goal
    if place is None or goal is None:
        place, goal = _replayed(playing, counts, r, start)
    return PositionRun(
        **common, u=run.u, y=run.y, feedback=run.feedback, counts=counts, position=counts.copy(),
        place=place, goal=goal, plant=machine.name, is_stop=stop is not None,
    )  # fmt: skip


def _replayed(
    controller: Playing, counts: FloatArray, r: FloatArray, start: int
) -> tuple[FloatArray, FloatArray]:
    """Where the profile was and went [counts], NaN before `start`: the loop again, on the counts
    that it got.
    """
    core, per_sample = controller.core(), controller.Ts * controller.counts_per_unit
    moved = np.diff(counts, prepend=counts[:1])
    place, goal = np.full(len(counts), np.nan), np.full(len(counts), np.nan)
    early = controller.early(r).tolist()
    for k, (asked, more) in enumerate(zip(early, moved.tolist(), strict=True)):
        core.step(asked, more / per_sample)
        if k >= start:
            place[k], goal[k] = core.place, core.goal
    return place, goal


def _require_counts(controller: PositionController, on: Any) -> None:
    """Raise `SettingError` for a machine whose encoder is not the one that was tuned with."""
    theirs = None if isinstance(on, Model) else getattr(on, "counts_per_rev", None)
    if isinstance(on, Model) or theirs == controller.counts_per_rev:
        return
    raise SettingError(
        name="on", expected=f"a machine that counts {controller.counts_per_rev:g} to a turn",
        received="no counts" if theirs is None else f"{theirs:g}",
        remedy="tune with counts_per_rev of this machine (--counts-per-rev)",
    )  # fmt: skip
