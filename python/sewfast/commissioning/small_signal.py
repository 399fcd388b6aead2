"""Small signals about a working speed: how fast the machine answers, and whether a shaft swings.

A step response says little of the first milliseconds and nothing of a resonance: friction, load and
the current limit are in it. A small random command about a held speed shows the linear dynamics
that a controller's gains meet, delay, electrical pole and shaft, within a few seconds.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from .. import _core
from ..control import Fopdt, fit_fopdt
from ..dataset import Dataset, FloatArray
from ..errors import DataError, FitError
from ..identification.folds import Errors, Split, compared, errors_of, folds, free_runs
from ..identification.task import arrays, wrap
from ..models import LinearOE, Model
from ..recording import Recording
from .bench import Bench
from .demands import Demands
from .motion import Motion

LEVEL = 0.5
"""Of the top speed, at which the machine is shaken."""
SIZE = 0.1
"""Of the largest command: small against what friction and the current limit bend."""
SAMPLES, LONGEST = 4_000, 12.0
"""Samples that are shaken; not longer than that [s]."""
HOLD = 2
"""Samples that each random value is held: power up to a quarter of the sample rate."""
ITERATIONS = 60
ORDERS = (1, 2, 3, 4, 5)
LEAST_GAIN = math.log(1.005)
"""A difference in error that counts as none, however well it is known."""
SWINGS = 0.3
"""Damping ratio below which a pair of poles is a resonance."""
LOWEST, HIGHEST = 2.0, 0.4
"""Frequencies looked at: from so many Hz to that share of the sample rate."""
LEAST_FIT = 90.0
"""Percent at which the model's own step response is one of first order with dead time."""


@dataclass(frozen=True)
class Resonance:
    """A pair of lightly damped poles.

    Attributes
    ----------
    frequency : float
        Undamped [Hz].
    damping : float
        Ratio.
    """

    frequency: float
    damping: float

    def __str__(self) -> str:
        return f"a resonance near {self.frequency:.3g} Hz (damping ratio {self.damping:.2g})"


@dataclass(frozen=True, eq=False)
class SmallSignal:
    """The machine about a working speed.

    Attributes
    ----------
    model : Model
        Command [V] to speed [RPM], of the simplest order that explains the record.
    resonance : Resonance or None
        The least damped one.
    fopdt : Fopdt or None
        The model's step response as first order with dead time; None where it is none.
    """

    model: Model
    resonance: Resonance | None
    fopdt: Fopdt | None


def small_signal(
    bench: Bench, demands: Demands, motion: Motion, fopdt: Fopdt
) -> SmallSignal | None:
    """Shake the machine about half its top speed; None where that shows nothing."""
    u, settled = shaking(demands, motion, fopdt, bench.Ts)
    return explained(bench.excite(u, "small_signals"), settled, fopdt)


def shaking(
    demands: Demands, motion: Motion, fopdt: Fopdt, Ts: float
) -> tuple[FloatArray, int]:  # fmt: skip
    """The command [V], and the sample from which it is random."""
    held = min(motion.command(LEVEL * demands.speed), (1.0 - SIZE) * demands.u_max)
    settle = max(1, round(min(4.0 * fopdt.T, LONGEST) / Ts))
    samples = int(min(SAMPLES, max(500, LONGEST / Ts)))
    size = SIZE * demands.u_max
    random = _core.prbs(
        duration=samples * Ts, Ts=Ts, low=held - size, high=held + size, hold=HOLD * Ts,
        seed=demands.seed,
    )  # fmt: skip
    return np.concatenate([np.full(settle, held), random]), settle


def explained(recording: Recording, settled: int, fopdt: Fopdt) -> SmallSignal | None:
    """The simplest linear model of the shaken part."""
    counts, per = recording.counts, 60.0 / (recording.counts_per_rev * recording.Ts)
    speed = np.diff(counts, prepend=counts[0]) * per
    data = Dataset.from_arrays(
        recording.u[settled:], speed[settled:], recording.Ts,
        input_units="V", output_unit="RPM", name=recording.name,
    )  # fmt: skip
    part = folds(data)[0]
    tried = {order: fitted(part, order) for order in ORDERS}
    found = {order: fit for order, fit in tried.items() if fit is not None}
    if not found or not min(errors.rmse for _, errors in found.values()) < part.spread:
        return None
    order = simplest(found)
    core = found[order][0]
    model = wrap(LinearOE, core, data)
    resonance = _resonance(core, recording.Ts)
    return SmallSignal(model, resonance, _first_order(core, recording.Ts, fopdt))


def fitted(part: Split, order: int) -> tuple[_core.LinearModel, Errors] | None:
    """The better of output error and instrumental variables: a resonance makes local minima."""
    tried = []
    for fit in (_core.fit_oe, _core.fit_iv):
        try:
            model = fit(
                arrays(part.fitted), na=order, nb=order + 1, nk=1, max_iterations=ITERATIONS
            ).model
        except (DataError, FitError):
            continue
        tried.append((model, errors_of(free_runs(model, part), part)))
    return min(tried, key=lambda t: t[1].rmse, default=None)


def simplest(found: dict[int, tuple[_core.LinearModel, Errors]]) -> int:
    """The least order whose error is not credibly above the lowest."""
    best = min(found, key=lambda o: found[o][1].rmse)
    for order in sorted(found):
        ratio, deviation = compared(found[order][1], found[best][1])
        if ratio <= max(deviation, LEAST_GAIN):
            return order
    return best


def _resonance(core: _core.LinearModel, Ts: float) -> Resonance | None:
    """Of the lightly damped pairs of poles within the frequencies looked at, the highest peak."""
    poles = core.poles()[:, 0] + 1j * core.poles()[:, 1]
    found: list[tuple[float, Resonance]] = []
    for p in poles[poles.imag > 0.0]:
        s = np.log(p) / Ts
        resonance = Resonance(float(abs(s)) / (2.0 * math.pi), float(-s.real / abs(s)))
        is_seen = LOWEST <= resonance.frequency <= HIGHEST / Ts and resonance.damping < SWINGS
        # the pair's share of the response at its own frequency: its residue over its distance
        others = np.prod(p - poles[np.abs(poles - p) > 0.0])
        peak = abs(np.polyval(core.b[0], p) / others) / max(1.0 - abs(p), 1e-9)
        if is_seen:
            found.append((float(peak), resonance))
    return max(found, key=lambda f: f[0], default=(0.0, None))[1]


def _first_order(core: _core.LinearModel, Ts: float, recorded: Fopdt) -> Fopdt | None:
    """First order with dead time of the model's step response, over five recorded constants."""
    u = _core.step(duration=6.0 * recorded.T, Ts=Ts, at=0.5 * recorded.T, low=0.0, high=1.0)
    try:
        y = core.simulate(u[:, None], np.zeros(core.na)) - core.simulate(
            np.zeros((len(u), 1)), np.zeros(core.na)
        )
        found = fit_fopdt(u, y, Ts=Ts)
    except (DataError, FitError):
        return None
    return found if found.K > 0.0 and found.fit_percent >= LEAST_FIT else None
