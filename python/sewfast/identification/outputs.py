"""Output functions suggested by the data: a sensor that rectifies, or one with a limit."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .. import _core
from ..dataset import Dataset, FloatArray
from ..dynamic_model import INIT
from ..errors import FitError
from .task import Look, Pairs

OUTPUTS = ("linear", "saturation", "abs")


@dataclass(frozen=True)
class Output:
    """An output function in the data's units; see docs/CONVENTIONS.md, State space."""

    name: str
    low: float = 0.0
    high: float = 0.0

    def parameters(self, mean: float, scale: float) -> FloatArray:
        """As the core takes them, in scaled units."""
        # width of a corner, relative to the output's scale
        corner = 0.03
        if self.name == "abs":
            return np.array([corner])
        if self.name == "saturation":
            # a part of the data can be constant, without a scale of its own
            low, high = ((v - mean) / (scale or 1.0) for v in (self.low, self.high))
            return np.array([low, high, corner])
        return np.zeros(0)


LINEAR = Output("linear")
ABS = Output("abs")


def suggested(data: Dataset) -> list[Output]:
    """Output functions to try, always including the linear one."""
    found = [LINEAR]
    if _changes_sign(data) and _may_be_rectified(_known(data)):
        found.append(ABS)
    saturated = saturation(data)
    return found if saturated is None else [*found, saturated]


def named(name: str, data: Dataset) -> Output:
    """The function of that name, its limits from the data."""
    if name == "saturation":
        return saturation(data) or Output(name, *data.output_range)
    return Output(name)


def saturation(data: Dataset) -> Output | None:
    """Limits at the ends of the range at which the output piles up; other ends are free."""
    y = _known(data)
    low, high = float(y.min()), float(y.max())
    width = high - low
    is_low, is_high = _piles(y - low, width), _piles(high - y, width)
    if not (is_low or is_high):
        return None
    bottom = float(np.median(y[y <= low + width / 100.0])) if is_low else low - width
    top = float(np.median(y[y >= high - width / 100.0])) if is_high else high + width
    return Output("saturation", bottom, top)


def scale_of(data: Dataset, output: Output) -> tuple[float, float]:
    """Mean and scale of the output for the core."""
    y = _known(data)
    if output.name == "abs":
        return 0.0, float(np.sqrt(np.mean(y**2)))
    return float(y.mean()), float(y.std())


def _known(data: Dataset) -> FloatArray:
    y: FloatArray = np.concatenate([e.y for e in data.experiments])
    return y[~np.isnan(y)]


def _piles(distance: FloatArray, width: float) -> bool:
    """Whether samples pile up within a hundredth of the range, but not next to it."""
    at = float(np.mean(distance <= width / 100.0))
    beside = float(np.mean((distance > width / 100.0) & (distance <= width / 20.0))) / 4.0
    # least share of the samples within a hundredth of the range from its end that forms a pile
    # least density of a pile relative to its surroundings
    return at >= 0.02 and at > 4.0 * beside


def _changes_sign(data: Dataset) -> bool:
    """Whether an input is clearly on both sides of zero: only then can the output lose a sign."""
    u = np.concatenate([e.u for e in data.experiments])
    low, high = u.min(axis=0), u.max(axis=0)
    return bool((np.minimum(-low, high) > 0.2 * np.maximum(-low, high)).any())


def _may_be_rectified(y: FloatArray) -> bool:
    """Whether the output is never clearly below zero, and often but not permanently at zero."""
    top = float(y.max())
    # part of the range by which noise takes a rectified output below zero
    if top <= 0.0 or float(y.min()) < -0.03 * top:
        return False
    # part of the range within which an output counts as zero
    return bool(np.mean(y <= 0.05 * top) > 0.005)


# --- a linear start behind a rectifier ----------------------------------------------------------


def rectified_start(
    data: Dataset, order: int, nk: int, look: Look | None = None
) -> _core.LinearModel | None:
    """The linear model whose magnitude is closest to a rectified output.
    Alternating projections (Fienup 1982): the model's sign is applied to the measured magnitude,
    and output error is fitted to the result. The first signs are those of the input through
    low-pass filters with several time constants.
    """
    # iterations of all first guesses; of the better two
    first_rounds, rounds = 2, 12
    # most samples of all experiments together: every round of the search for signs is a fit
    share = min(1.0, 2_000 / len(data))
    lengths = [max(2 * INIT, round(share * len(e))) for e in data.experiments]
    pairs: Pairs = [(e.u[:n], e.y[:n]) for e, n in zip(data.experiments, lengths, strict=True)]
    # poles of the low-pass filters whose sign is the first guess of the output's
    guesses = [
        [_sign(_low_pass(u, memory)) for u, _ in pairs]
        for memory in (0.0, 0.5, 0.8, 0.9, 0.95, 0.98)
    ]
    tried = [_restored(pairs, g, order, nk, first_rounds, look) for g in guesses]
    likely = sorted(tried, key=lambda t: t.error)[:2]
    tried = [_restored(pairs, t.signs, order, nk, rounds - first_rounds, look, t) for t in likely]
    return min(tried, key=lambda t: t.error).model


@dataclass(frozen=True)
class _Restored:
    """A model, its squared error, and its signs of the output."""

    error: float
    model: _core.LinearModel | None
    signs: list[FloatArray]


def _restored(
    pairs: Pairs,
    signs: list[FloatArray],
    order: int,
    nk: int,
    rounds: int,
    look: Look | None,
    best: _Restored | None = None,
) -> _Restored:
    best = best or _Restored(np.inf, None, signs)
    for _ in range(rounds):
        signed = [(u, y * s) for (u, y), s in zip(pairs, signs, strict=True)]
        try:
            fit = _core.fit_oe(
                signed, na=order, nb=order + 1, nk=nk, max_iterations=15, progress=look
            )
            runs = [_run(fit, i, u) for i, (u, _) in enumerate(signed)]
        except FitError:
            break
        error = sum(
            float(np.nansum((np.abs(run) - np.abs(y)) ** 2))
            for run, (_, y, *_) in zip(runs, pairs, strict=True)
        )
        following = [_sign(run) for run in runs]
        if error < best.error:
            best = _Restored(error, fit.model, following)
        if all(np.array_equal(a, b) for a, b in zip(signs, following, strict=True)):
            break
        signs = following
    return best


def _run(fit: _core.LinearFit, i: int, u: FloatArray) -> FloatArray:
    run: FloatArray = fit.model.simulate(u, np.ascontiguousarray(fit.initial_states[i]))
    return run


def _sign(x: FloatArray) -> FloatArray:
    signs: FloatArray = np.where(x >= 0.0, 1.0, -1.0)
    return signs


def _low_pass(u: FloatArray, memory: float) -> FloatArray:
    """The inputs' sum, each over its standard deviation, through a first-order filter."""
    spread = np.where(u.std(axis=0) > 0.0, u.std(axis=0), 1.0)
    x = (u / spread).sum(axis=1)
    y: FloatArray = np.empty_like(x)
    last = 0.0
    for k, value in enumerate(x):
        last = memory * last + (1.0 - memory) * float(value)
        y[k] = last
    return y
