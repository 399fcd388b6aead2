"""What a result of `identify` is held against: the oracle, output error, the noise.

The oracle is the structure that made the data, its parameters fitted to the noisy training record
by least squares of the free run (output error), from the true parameters and the known initial
state, and scored on the test record. It knows what nobody knows; what it misses is what the noise
costs. Where the disturbance is no white noise (a drift, an unrecorded force), least squares are not
the best that can be done, and luck may put output error a little ahead. Only the backlash needs
more than derivatives: there Nelder and Mead's search goes on from the least-squares fit, and the
one with the smaller training error is kept. Speeds from an encoder are fitted as they are, by the
smooth structure to the counted output.

Output error is `identify(model="oe")` in orders 1 to 4 learned on the first four fifths of each
record; the order that does best on the last fifth is fitted again to everything.
"""

from __future__ import annotations

import hashlib
import math
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from sewfast import Dataset, FitError, Model, identify

from .families import Case, rms
from .simulators import FloatArray

ORDERS = (1, 2, 3, 4)
SHORT = 800
"""Samples of a short record."""
HELD_OUT = 0.2
STEP = 1e-5
"""Of the finite differences, as a share of each parameter."""


@dataclass(frozen=True)
class References:
    """Of one case.

    Attributes
    ----------
    digest : str
        Of its records: a kept reference is used only for the same data.
    noise : float
        Root mean square of the noise on the training output.
    oracle, oe : float
        Test error [output unit].
    oe_order : int
    gain : float or None
        True steady gain of a motor.
    range_gain : float or None
        The same between the ends of the recorded input, as the record itself shows it.
    oracle_gain_error, oe_gain_error : float or None
        Relative errors of it.
    hindsight : float or None
        Least test error of output error with 2, 3 and 4 past outputs and inputs, of short records.
    """

    digest: str
    noise: float
    oracle: float
    oe: float
    oe_order: int
    gain: float | None = None
    range_gain: float | None = None
    oracle_gain_error: float | None = None
    oe_gain_error: float | None = None
    hindsight: float | None = None

    def to_json(self) -> dict[str, Any]:
        return asdict(self)


def references(case: Case) -> References:
    """Oracle and output error of a case; the cost is up to some seconds."""
    theta = refitted(case)
    order, linear = output_error(case)
    found: dict[str, float | None] = {}
    if case.gain_probe is not None and case.range_probe is not None:
        gain = _gain(case.truth.run(case.truth.theta, case.gain_probe), case.gain_probe)
        whole = case.truth.run(case.truth.theta, case.range_probe)
        found |= {"gain": gain, "range_gain": _gain(whole, case.range_probe)}
        own = _gain(case.truth.run(theta, case.gain_probe), case.gain_probe)
        found["oracle_gain_error"] = abs(own / gain - 1)
        found["oe_gain_error"] = gain_error(case, linear, gain, case.gain_probe)
    if case.samples <= SHORT:
        found["hindsight"] = min(_in_hindsight(case, order) for order in (2, 3, 4))
    return References(
        digest(case), case.noise, oracle_error(case, theta), score(case, linear), order, **found
    )  # fmt: skip


def _in_hindsight(case: Case, order: int) -> float:
    try:
        return score(case, identify(case.training, model="oe", na=order, nb=order))
    except FitError:
        return math.inf


def digest(case: Case) -> str:
    """Of all records of a case, to 10 significant digits."""
    total = hashlib.sha256()
    for r in (*case.train, *case.test):
        for x in (r.u, r.y):
            # rounded, so that another compiler's last bit makes no other case
            scale = 1e-10 * (np.abs(x).max() or 1.0)
            total.update(np.round(x / scale).astype(np.int64).tobytes())
    return total.hexdigest()[:16]


# --- the oracle -----------------------------------------------------------------------------------


def refitted(case: Case) -> FloatArray:
    """Parameters of the true structure that fit the noisy training records best."""
    from scipy.optimize import least_squares, minimize

    truth, start = case.truth, case.truth.theta
    # relative parameters: they differ by many orders of size
    scale = np.abs(start)
    sd = case.noise or 1.0

    def residuals(p: FloatArray) -> FloatArray:
        theta = start + scale * (p - 1)
        with np.errstate(all="ignore"):
            errors = np.concatenate([truth.simulate(r, theta) - r.y for r in case.train]) / sd
        # a step that leaves the stable region is refused, not followed
        return np.clip(np.nan_to_num(errors, nan=1e6), -1e6, 1e6)

    # the true parameters are kept where the fit cannot do better (a test without noise)
    best = np.ones(len(start))
    fit = least_squares(residuals, best, x_scale="jac", diff_step=STEP, max_nfev=40)
    if fit.cost < _cost(residuals, best):
        best = fit.x
    if truth.kinked:
        polished = minimize(
            lambda p: _cost(residuals, p),
            best,
            method="Nelder-Mead",
            options={"initial_simplex": _simplex(best), "maxfev": 600, "xatol": 1e-6},
        )
        if polished.fun < _cost(residuals, best):
            best = polished.x
    return start + scale * (best - 1)


def _cost(residuals: Any, p: FloatArray) -> float:
    r = residuals(p)
    return 0.5 * float(r @ r)


def _simplex(p: FloatArray) -> FloatArray:
    return np.vstack([p, p + 0.003 * np.eye(len(p))])


def oracle_error(case: Case, theta: FloatArray) -> float:
    """Test error of the true structure with these parameters."""
    return _pooled([(case.truth.simulate(r, theta) - r.y)[case.n :] for r in case.test])


# --- models ---------------------------------------------------------------------------------------


def score(case: Case, model: Model) -> float:
    """Test error of a model: free run from the initial state that the first n outputs give, and
    scored after them; infinite where the model runs away.
    """
    errors = []
    for r in case.test:
        seen = np.where(np.arange(len(r.y)) < case.n, r.y, np.nan)
        try:
            (run,) = model.simulate(case.dataset(r.u, seen), init=case.n)
        except FitError:
            return math.inf
        errors.append((run - r.y)[case.n :])
    return _pooled(errors)


def gain_error(case: Case, model: Model, gain: float, probe: FloatArray) -> float:
    """Relative error of a motor's steady gain, by the same two steps for truth and model."""
    try:
        (run,) = model.simulate(case.dataset(probe, np.zeros(len(probe))), init=0)
    except FitError:
        return math.inf
    return abs(_gain(run, probe) / gain - 1)


def _gain(y: FloatArray, probe: FloatArray) -> float:
    u = probe if probe.ndim == 1 else probe[:, 0]
    half = len(u) // 2
    return float((y[-1] - y[half - 1]) / (u[-1] - u[0]))


def output_error(case: Case) -> tuple[int, Model]:
    """The order that does best on the last fifth, and the model of this order from everything."""
    data = case.training
    parts = [(e.u, e.y, round((1 - HELD_OUT) * len(e.y))) for e in data.experiments]
    fitted = Dataset.concat(case.dataset(u[:k], y[:k]) for u, y, k in parts)
    held = Dataset.concat(case.dataset(u[k:], y[k:]) for u, y, k in parts)
    errors = {}
    for order in ORDERS:
        try:
            model = _linear(fitted, order)
            errors[order] = model.validate(held, init=case.n).simulation.rmse
        except FitError:
            continue
    if not errors:
        raise FitError(f"{case.family}/{case.seed}: no order of output error could be fitted")
    best = min(errors, key=errors.__getitem__)
    return best, _linear(data, best)


def _linear(data: Dataset, order: int) -> Model:
    return identify(data, model="oe", na=order, nb=order + 1)


def _pooled(errors: list[FloatArray]) -> float:
    return rms(np.concatenate(errors))
