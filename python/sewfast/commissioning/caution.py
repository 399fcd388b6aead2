"""Caution: new gains meet the machine in steps, on a short hold, before anything longer is run."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass

import numpy as np

from ..control.controller import Controller
from ..control.loop import ClosedLoopRun, run
from ..dataset import FloatArray
from ..errors import FitError
from ..models import Ensemble
from .bench import Bench
from .demands import Demands
from .gains import scaled
from .refusal import Refusal
from .slow import Thinning
from .small_signal import LEVEL, SmallSignal

SHARES = (0.25, 0.5, 1.0)
"""Of the gains, one hold after the other."""
HOLD = 0.4
"""How long the level is held [s], at least; a swing is told from that."""
SETTLE = 0.2
"""Least time after the ramp, before that [s]."""
PERIODS = 100
"""Samples that it is held at the least."""
CHATTER = 0.12
"""Standard deviation of a quiet loop's command at a held speed, over the largest command."""
EXPECTED = 2.0
"""Times the models' own, which is the encoder's, that it may be in any case."""
RAILED = 0.05
"""Share of the held samples at a limit."""
BACK = 0.5
"""Of the gains that swung, what is kept."""


@dataclass(frozen=True)
class Swing:
    """What a loop that swings does while it should hold a speed.

    Attributes
    ----------
    share : float
        Of the gains.
    frequency : float
        [Hz]
    command, railed : float
        Standard deviation of the command [V], share of samples at a limit.
    """

    share: float
    frequency: float
    command: float
    railed: float


def held(demands: Demands, fastest: float, Ts: float) -> tuple[FloatArray, int]:
    """A reference to a working speed [RPM], and the sample from which it has settled."""
    level = LEVEL * demands.speed
    rise = max(round(2.0 * level / fastest / Ts), 20)
    settle = rise + max(round(0.5 * rise), round(SETTLE / Ts), PERIODS // 2)
    hold = max(round(HOLD / Ts), PERIODS)
    return level * np.minimum(1.0, np.arange(settle + hold) / rise), settle


def swing_of(
    found: ClosedLoopRun, settled: int, share: float = 1.0, expected: float = 0.0
) -> Swing | None:
    """Whether the command swings at a held speed; None for a quiet loop.

    `expected` is what models say of its standard deviation [V].
    """
    u, limits = found.u[settled:], found.controller
    u = u[np.isfinite(u)]
    reach = 0.5 * (limits.u_max - limits.u_min)
    railed = float(np.mean((u >= limits.u_max - 1e-9) | (u <= limits.u_min + 1e-9)))
    k = np.arange(len(u))
    # what still settles is no swing
    rest = u - np.polyval(np.polyfit(k, u, 2), k)
    deviation = float(rest.std())
    if deviation <= max(CHATTER * reach, EXPECTED * expected) and railed <= RAILED:
        return None
    power = np.abs(np.fft.rfft(rest * np.hanning(len(rest)))) ** 2
    at = 1 + int(np.argmax(power[1:]))
    return Swing(share, at / (len(u) * found.Ts), deviation, railed)


def cautious(
    bench: Bench,
    controller: Controller,
    demands: Demands,
    fastest: float,
    name: str,
    small: SmallSignal | None,
    models: Ensemble | None = None,
    thinning: Thinning | None = None,
) -> tuple[Controller, Swing | None]:
    """The gains that hold a speed quietly, of those asked for, and the swing that was met.

    `models` know how far the encoder's counts alone move the command; they run at the samples that
    `thinning` leaves.

    Raises
    ------
    Refusal
        Where a quarter of the gains swings already.
    """
    r, settled = held(demands, fastest, bench.Ts)
    for share in SHARES:
        tried = scaled(controller, share)
        expected = 0.0
        if models is not None:
            expected = _chatter(tried, models, r, settled, thinning or Thinning())
        found = bench.follow(tried, r, f"{name}_{100 * share:g}").run
        swing = swing_of(found, settled, share, expected)
        if swing is None:
            continue
        kept = BACK * share
        if kept < SHARES[0]:
            raise Refusal(
                f"expected a quiet loop at {r[-1]:.4g} RPM under a quarter of the gains, it swings "
                f"at {swing.frequency:.3g} Hz ({swing.command:.3g} V rms): {cause(swing, small)}"
            )
        return scaled(controller, kept), swing
    return controller, None


def _chatter(
    controller: Controller, models: Ensemble, r: FloatArray, settled: int, thinning: Thinning
) -> float:
    """Standard deviation of the command at the held speed, the largest of any model [V]."""
    with suppress(FitError):
        coarse, k = thinning.coarse(controller), thinning.k
        return max(float(run(coarse, m, r[::k]).u[settled // k :].std()) for m in models.members)
    return 0.0


def cause(swing: Swing, small: SmallSignal | None) -> str:
    """What makes a loop swing, as far as it is known, and what to do."""
    remedy = "stiffen the shaft or the coupling, take the play out of it, or ask for less speed"
    if small is not None and small.resonance is not None:
        return f"the machine has {small.resonance}; {remedy}"
    if swing.frequency > 15.0:
        return f"a shaft or coupling that gives, play in it, or a belt; {remedy}"
    return (
        "friction, play, or a delay that the step response does not show; see the recording, and "
        "look for play and for a drive with a filter or a controller of its own"
    )
