"""The position loop of `tune(loop="position")`.

Three questions, one after the other, all answered by runs on every model. Which gains of both loops
hold a position stiffest, within the limits of Ms? How fast may a move land so that no stop passes
its angle? How much of the drive's rates leaves the feedback room for that?
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from .. import _core
from ..control.controller import Controller
from ..control.loop import cores_about, each_plant
from ..control.margins import loop_path, sampled
from ..control.position import RATES, SMOOTHED, PositionController
from ..errors import FitError, SettingError
from ..gains import Gains
from ..moves import Reach
from .objective import LARGEST_MS
from .robustness import HAIR
from .verdict import LIVELY

if TYPE_CHECKING:
    from .search import TuningResult
    from .task import TuningTask

GAINS = tuple(float(g) for g in np.geomspace(2.0, 200.0, 41))
"""Position gains that are tried [1/s]; steps of an eighth."""
SOFTER = (1.0, 0.8, 0.64)
"""Factors on Kp of the speed loop that are tried under the position loop."""
SLOWER = (1.0, 1.6, 2.5, 4.0)
"""The same on Ti: the position loop does the work of the integral."""
SHARES = (0.95, 0.9, 0.85, 0.8, 0.7, 0.6, 0.5)
"""Parts of what the models can do."""
LANDINGS = (0.0, 10.0, 20.0, 30.0, 40.0, 60.0, 80.0)
"""Last parts of a move [counts]."""
DYING = 6.0
"""Time constants of the position loop, 1/gain, in which they are passed: what braking has made
swing is then down to a quarter of a per cent."""
SPEEDS = (0.1, 0.25, 0.5, 0.75, 0.95)
"""Speeds of the stops, as parts of the largest known one."""
BEFORE, AFTER = 0.3, 0.4
"""How long a stop's speed is held before it, and how long it is followed beyond braking and landing
[s]."""
LOAD = 0.1
"""The load that is held, as a part of the command's range."""


@dataclass(frozen=True)
class PositionTuning:
    """The position loop that a search found.

    Attributes
    ----------
    controller : PositionController
        Over the speed loop with the gains that suit it.
    yields : float
        Deviation while a position is held against a command of a tenth of the limits' range, rms
        on the plant and variation that gives way most [counts].
    error : float
        Error of the position after the profile, rms over the stops on the worst plant [counts].
    passed, off : float
        How far a stop went beyond its angle, and how far from it a shaft rests, at most over all
        plants as they are and with further delay [counts].
    Ms_position, Ms : float
        Largest sensitivity of the position loop, broken at its error, and of both loops together,
        broken at the plant's input, over all linear plants; NaN if there is none.
    tried : int
        Settings tried.
    """

    controller: PositionController
    yields: float
    error: float
    passed: float
    off: float
    Ms_position: float
    Ms: float
    tried: int

    def to_json(self) -> dict[str, Any]:
        """Everything but the speed loop as JSON values."""
        names = ("yields", "error", "passed", "off", "Ms_position", "Ms")
        known = {name: getattr(self, name) for name in names}
        known = {n: x if math.isfinite(x) else None for n, x in known.items()}
        own = self.controller
        settings = ("gain", "share", "fastest", "smoothing", "landing", "creep")
        return {name: getattr(own, name) for name in settings} | known | {"tried": self.tried}

    def __str__(self) -> str:
        own = self.controller
        return (
            f"gain {own.gain:.4g} 1/s, {100.0 * own.share:.3g} % of the drive's rates; stops on "
            f"the models within {self.off:.3g} counts, passed by {self.passed:.3g} at most; Ms "
            f"{self.Ms_position:.3f} of the position, {self.Ms:.3f} of both loops"
            + ("" if self.passed <= 1.0 else "; NO setting keeps every stop from passing its angle")
        )


@dataclass(frozen=True)
class _Judged:
    """What a set of stops shows [counts]."""

    error: float
    passed: float
    off: float
    swing: float
    yields: float

    @property
    def is_clean(self) -> bool:
        """Whether no stop passes its angle by more than a count."""
        return self.passed <= 1.0


def with_position(task: TuningTask, speed: Controller) -> PositionTuning:
    """The position loop over a speed loop that was tuned on the same plants.

    Raises
    ------
    SettingError
        If there is no steady speed to take Ms at.
    FitError
        If no gain keeps the limits of Ms.
    """
    reach = Reach.of(task.plants, u_min=speed.u_min, u_max=speed.u_max, share=1.0)
    rates, fastest = _core.position_rates(reach.core())
    rise = max(max(up, down) for _, up, down in rates) / (reach.jerk * speed.Ts)
    first = PositionController(
        speed, gain=GAINS[0], fastest=fastest, rates=tuple(rates[:RATES]), share=SHARES[0],
        # an even mean delays a goal that moves by whole samples
        smoothing=2 * int(min(max(1.0, round(0.5 * rise)), SMOOTHED // 2)), creep=fastest,
        notes="position loop tuned by simulated stops" + task.assumed,
    )  # fmt: skip
    stiff = list(_within_limits(task, first))
    if not stiff:
        raise FitError(
            name="loop", expected=f"a position gain with Ms up to {LARGEST_MS:g}",
            received=f"none from {GAINS[0]:g} to {GAINS[-1]:g} 1/s over this speed loop",
            remedy="tune a calmer speed loop: --constraint Ms=1.5",
        )  # fmt: skip
    held = [
        max(one.yields for one in _stops(task, [law], task.variations, AFTER)) for law, *_ in stiff
    ]
    # each plant is taken as it is and with further delay: with less gain it could not brake as its
    # model says
    later = [(1.0, 0), (1.0, max((delay for _, delay in task.variations), default=0))]
    # the shortest way first, then the stiffest loop, then the shortest landing
    tried, least = 0, None
    for share, k, landing in itertools.product(SHARES, np.argsort(held).tolist(), LANDINGS):
        law, own, both = stiff[k]
        law = replace(_landed(law, landing), share=share)
        judged = _stops(task, [law], later, AFTER + ending(law))[0]
        tried += 1
        if least is None or judged.passed < least[1].passed:
            least = (law, judged, held[k], own, both)
        if judged.is_clean:
            break
    assert least is not None
    law, judged, yields, own, both = least
    return PositionTuning(
        law, yields, judged.error, judged.passed, judged.off, own, both, len(stiff) + tried
    )


def ending(law: PositionController) -> float:
    """How long a stop from the largest speed brakes and lands [s]."""
    rows = law.rows()
    tops = [*(v for v, _, _ in rows[1:]), law.fastest]
    braking = sum(
        max(0.0, min(top, law.fastest) - v) / down
        for (v, _, down), top in zip(rows, tops, strict=True)
    )
    return braking + DYING / law.gain


def sound_speed_loop(task: TuningTask, result: TuningResult) -> Controller:
    """The speed loop of a search, if a position loop may stand on it.

    Raises
    ------
    SettingError
        For one of another kind or unfit, models that are poor, and plants whose output is no speed
        that is 0 at rest.
    """
    if result.grade in ("poor", "useless"):
        raise SettingError(
            name="loop", expected="models that predict the drive", received=f"{result.grade} ones",
            remedy="record and identify it as `sewfast check` says; a shaft that must stop at an "
            "angle is braked as its models say",
        )  # fmt: skip
    result.verdict.require_fit()
    speed = result.controller
    if not isinstance(speed, Controller) or speed.schedule:
        raise SettingError(
            name="loop", expected="a PID with constant gains under a position loop",
            received="a gain schedule" if isinstance(speed, Controller) else type(speed).__name__,
            remedy="leave out the kind of the controller, or its schedule",
        )  # fmt: skip
    if task.rest.y != 0.0 and not task.rest.near_zero:
        raise SettingError(
            name="loop", expected="a speed that is 0 at rest", received=f"{task.rest.y:g}",
            remedy="a position loop needs a drive that stands without a command",
        )  # fmt: skip
    return speed


def _within_limits(
    task: TuningTask, first: PositionController
) -> Iterator[tuple[PositionController, float, float]]:
    """Gains of both loops, for each speed loop the largest of the position within the limits of Ms,
    with the Ms of the position loop and of both. A speed loop keeps its limit by itself; a position
    loop around one at the limit may go on to what a verdict calls lively.
    """
    own = first.speed.gains.to("standard")
    for softer, slower in itertools.product(SOFTER, SLOWER):
        gains = Gains.standard(
            softer * own.Kp, slower * own.Ti, own.Td, u_unit=own.u_unit, y_unit=own.y_unit
        )
        speed = replace(first.speed, gains=gains)
        best = None
        for gain in GAINS:
            peaks = _sensitivities(task, speed, gain)
            if not (peaks[0] <= HAIR * LARGEST_MS and peaks[1] <= HAIR * LIVELY):
                break
            best = (replace(first, speed=speed, gain=gain), *peaks)
        if best is not None:
            yield best


def _sensitivities(task: TuningTask, speed: Controller, gain: float) -> tuple[float, float]:
    """Largest Ms of the position loop and of both loops over the task's linear plants."""
    own = both = 0.0
    for plant, level in task.loops.looked_at:
        fraction = sampled(plant, speed.Ts, level)
        path = loop_path(speed, speed=level, position=gain)
        own = max(own, _core.position_sensitivity(path, *fraction))
        both = max(both, _core.margins(path, *fraction)["Ms"])
    if not task.loops.looked_at:
        raise SettingError(
            name="loop", expected="a steady speed of the models, to take Ms at",
            received="none", remedy="give Constraints(plant=...), a linear model of the same drive",
        )  # fmt: skip
    return own, both


def _landed(law: PositionController, landing: float) -> PositionController:
    """The controller with a landing [counts]."""
    if landing == 0.0:
        return replace(law, landing=0.0, creep=law.fastest)
    return replace(law, landing=landing, creep=landing * law.gain / (law.counts_per_unit * DYING))


def _stops(
    task: TuningTask, made: Sequence[PositionController],
    variations: Sequence[tuple[float, int]], after: float,
) -> list[_Judged]:  # fmt: skip
    """Stops of position loops over one speed loop, on all plants in these variations, followed for
    the time `after` [s].
    """
    one, rest = made[0], task.rest
    assert one.counts_per_rev is not None
    designs = [(c.gain, c.rows(), c.smoothing, c.landing, c.creep) for c in made]
    found = _core.judge_stops(
        cores_about(rest, each_plant(task.plants)),
        one.speed.about(rest).core(), designs,
        counts_per_unit=one.counts_per_unit, fastest=one.fastest, turn=one.counts_per_rev,
        speeds=[part * one.fastest for part in SPEEDS], before=round(BEFORE / one.Ts),
        after=round(after / one.Ts), load=LOAD * (one.u_max - one.u_min),
        variations=list(variations),
    )  # fmt: skip
    return [_Judged(*row) for row in found]
