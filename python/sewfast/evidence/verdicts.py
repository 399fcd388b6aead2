"""The lines of the report card: from evidence to figures with limits and verdicts.

The limits are stated in docs/report-card.md.
"""

from __future__ import annotations

import math

import numpy as np

from .. import _core
from ..arrays import in_unit
from ..dataset import Dataset, FloatArray
from ..dataset.faults import faults
from ..dataset.standing import SIGMAS, standing
from ..dynamic_model import DynamicModel
from ..validation import FAIR, Scores, judged
from .card import Line, Verdict
from .operating import OperatingRange
from .parameters import Criteria, Parameters, StoredInformation
from .portmanteau import LEVEL, ResidualTest
from .residuals import HorizonScores, Residuals, fit_text
from .simulation_bands import Bands

SMALL = 0.1
"""Part of the rms error above which a detected dependence is a failure, not a warning."""
OUTSIDE, FAR_OUTSIDE = 0.05, 0.2

_FOUND = {
    "parameters": (
        "the same kind of model with other parameters fits these data better: gain or time "
        "constants differ from the training data; the plant has changed, or the model is a "
        "compromise between regimes"
    ),
    "autocorrelation": (
        "the noise model is too simple: predictions one step ahead do not use all that past "
        "errors tell; raise na and nb, or take model oe, which assumes nothing about the noise"
    ),
    "input": (
        "the input still explains part of the residual: dynamics or delay are missing; raise the "
        "orders (na, nb, nx), check nk, or allow a nonlinear model"
    ),
    "squared_input": (
        "the square of the input explains part of the residual: an even nonlinearity is missing; "
        "allow a network, or more hidden units"
    ),
    "cubed_input": (
        "the cube of the input explains part of the residual: an odd nonlinearity (saturation, "
        "dead zone, friction) is missing; allow a network, or more hidden units"
    ),
    "output": (
        "powers of the computed output explain part of the residual: a nonlinearity of the plant "
        "or the sensor is missing; allow a network, more states or more hidden units"
    ),
    "squares": (
        "the residual is larger where the input is: a nonlinearity is missing there, or the noise "
        "grows with the amplitude"
    ),
    "product": (
        "the product of past residual and input explains part of the residual: noise acts inside "
        "a nonlinear loop, or the gain drifts over the record; compare records from different "
        "times"
    ),
    "feedback": (
        "the input follows past residuals: either the data come from a closed loop, where "
        "past inputs "
        "carry noise and their correlation does not condemn the model, or dynamics are missing"
    ),
}
_PASSED = {
    "parameters": "the parameters found in training are those of these data",
    "autocorrelation": "the residual is white: nothing of it can be predicted from its own past",
    "input": "nothing of the input is left in the residual: the linear dynamics are complete",
    "squared_input": "no even nonlinearity is left in the residual",
    "cubed_input": "no odd nonlinearity of the input is left in the residual",
    "output": "no function of the computed output is left in the residual",
    "squares": "the residual is as large for small inputs as for large ones",
    "product": "no product of past residual and input is left in the residual",
    "feedback": "the input does not respond to the residual: recorded in open loop",
}


def accuracy(scores: HorizonScores, unit: str, noise: float, share: float) -> list[Line]:
    """Lines on the free run (judged) and on errors some steps ahead (information).
    `noise` is the white measurement noise of the output (NaN if unknown), `share` the part
    explained by the motion of the input [%].
    """
    free = scores.pooled["free run"]
    found = [_free_run(free, unit, judged(free.fit_percent, free.rmse, noise, share))]
    text = (
        "started from measured outputs each time: the model's own errors have no time to grow, "
        "while the noise of these outputs counts in full; it says little about a model that has "
        "to run alone"
    )
    for name, s in scores.pooled.items():
        if name != "free run":
            found.append(Line(f"{name} ahead", s.rmse, fit_text(s, unit), "", "info", text))
    return found + _worst(scores, unit)


def _free_run(free: Scores, unit: str, found: tuple[str, str]) -> Line:
    grade, resting = found
    verdict, meaning = _GRADES[grade]
    if grade == "good" and free.fit_percent < FAIR:
        meaning = "the model alone follows the output; what is left is measurement noise"
    if grade == "useless" and free.fit_percent < 0.0:
        meaning = meaning.replace("hardly better", "worse")
    if resting:
        meaning = f"the model follows the output{resting}; record with more moves of the input"
    shown = fit_text(free, unit)
    return Line("free run", free.rmse, shown, f"fit >= {FAIR:g} %", verdict, meaning)


_GRADES: dict[str, tuple[Verdict, str]] = {
    "good": (
        "ok",
        "the model alone, from the inputs, follows the output: what tuning and simulation need",
    ),
    "fair": ("ok", "the model alone, from the inputs, follows the output, though not closely"),
    "poor": (
        "warn",
        "the model follows the output loosely; look where the error is large (the plot), and "
        "whether the data contain what drives the plant",
    ),
    "useless": (
        "fail",
        "useless here: hardly better than a constant; do not tune on it: check columns, delay and "
        "orders, or record with a larger excitation",
    ),
    "": ("info", "the output is constant here: only the error's size says something"),
}


def _worst(scores: HorizonScores, unit: str) -> list[Line]:
    single = [
        (s.rmse, n) for s, n in zip(scores.experiments["free run"], scores.names, strict=True) if s
    ]
    if len(single) < 2:
        return []
    rmse, name = max(single)
    text = f"the experiment with the largest error is {name}; to_json() lists every one"
    return [Line("worst experiment", rmse, f"{rmse:.4g} {unit}".rstrip(), "", "info", text)]


def generalisation(here: Scores, training: Scores) -> Line:
    """Line on the free-run error on new data compared with that on the training data."""
    growth, large_growth = 1.5, 3.0
    ratio = here.rmse / training.rmse if training.rmse > 0.0 else math.inf
    verdict: Verdict = "ok" if ratio <= growth else "warn" if ratio <= large_growth else "fail"
    meaning = {
        "ok": "the error is about as large as on the training data",
        "warn": "the error is larger than on the training data: these data hold something "
        "new, or the model has learnt noise; compare with a smaller model",
        "fail": "the error is several times that on the training data: do not use the model here; "
        "train on data like these as well",
    }[verdict]
    return Line("error over training", ratio, f"{ratio:.3g}", f"<= {growth:g}", verdict, meaning)


_NO_OFFSET: tuple[Verdict, str] = "ok", "no offset between model and data"
_OFFSET: tuple[Verdict, str] = (
    "warn",
    "the model is off by a constant here; a sensor's or an amplifier's zero may have moved",
)


def bias(residuals: Residuals) -> Line:
    """Line on the mean residual, without the initial state's effect, compared with chance."""
    ones, mean = residuals.constants, residuals.mean
    length = max(float(sum(one @ one for one in ones)), 1e-300)
    columns = residuals.columns([one[:, None] for one in ones])
    error = math.sqrt(_core.coloured_information(columns, spent=0.0)[0, 0]) / length
    power = residuals_power(residuals)
    shown = f"{mean:.3g} +- {2.58 * error:.2g} {residuals.unit}".rstrip()
    share = mean**2 / max(power, 1e-300)
    if 2.58 * error > math.sqrt(power):
        # an integrator, or a record no longer than the model's memory
        text = "nothing to test: the initial state explains a constant as well"
        return Line("mean residual", mean, "not tested", "99 % about 0", "info", text)
    if abs(mean) <= 2.58 * error:
        verdict, text = _NO_OFFSET
    elif share < SMALL**2:
        verdict, text = (
            "ok",
            "a small offset, which matters little compared with the rest of the residual",
        )
    else:
        verdict, text = _OFFSET
    return Line("mean residual", mean, shown, "99 % about 0", verdict, text)


def residuals_power(residuals: Residuals) -> float:
    return sum(float(r.error @ r.error) for r in residuals.runs) / residuals.n


def correlation(t: ResidualTest) -> Line:
    limit = f"p >= {LEVEL:g}"
    if not math.isfinite(t.p_value):
        text = (
            "nothing to test: the residual or the input does not move, or there are too few samples"
        )
        return Line(t.title, math.nan, "not tested", limit if t.judges else "", "info", text)
    shown = "p < 1e-12" if t.p_value < 1e-12 else f"p = {t.p_value:.2g}"
    if not t.judges:
        text = _PASSED[t.name] if t.passed else _INFORMS.get(t.name, _FOUND[t.name])
        return Line(t.title, t.p_value, shown, "", "info", text)
    if t.passed:
        return Line(t.title, t.p_value, shown, limit, "ok", _PASSED[t.name])
    gain = 1.0 - math.sqrt(1.0 - t.explained)
    text = f"{_FOUND[t.name]} (worth {100 * gain:.2g} % of the error)"
    if gain < SMALL:
        return Line(t.title, t.p_value, shown, limit, "warn", f"detected, but small: {text}")
    return Line(t.title, t.p_value, shown, limit, "fail", text)


_INFORMS = {
    "autocorrelation": (
        "the residual is coloured, which an output-error model allows: disturbances and noise have "
        "their own dynamics"
    )
}


def parameters(p: StoredInformation) -> list[Line]:
    """Lines on samples per parameter and conditioning."""
    condition = 1e8
    samples_per_parameter = 10.0
    ratio = p.samples / max(p.effective, 1e-12)
    enough = ratio >= samples_per_parameter
    size = Line(
        "samples per parameter", ratio,
        f"{p.samples} / {p.effective:.1f} effective of {p.number}",
        f">= {samples_per_parameter:g}", "ok" if enough else "warn",
        "enough data for a model of this size"
        if enough
        else "too few samples for a model of this size: it learns noise; record longer or take a "
        "smaller model",
    )  # fmt: skip
    sound = p.condition <= condition
    if sound:
        text = "the data determine the parameters"
    elif p.undetermined:
        text = (
            f"{p.undetermined} direction(s) in parameter space change nothing in these data; "
            "the output "
            "is as good, but single parameters mean nothing: take a smaller model to read them"
        )
    else:
        text = "nearly the same output comes from other parameters; do not read single parameters"
    shown = f"{p.condition:.2g}" if math.isfinite(p.condition) else "infinite"
    return [
        size,
        Line(
            "conditioning",
            p.condition,
            shown,
            f"<= {condition:.0e}",
            "ok" if sound else "info",
            text,
        ),
    ]


def looseness(p: Parameters) -> Line:
    """Line on parameters that could as well be zero."""
    loose = p.loose()
    shown = f"{len(loose)} of {len(p.values)}"
    named = ", ".join(loose[:5]) + (", .." if len(loose) > 5 else "")
    text = "every parameter is larger than its standard error" if not loose else (
        f"standard error larger than the value: {named}; zero would fit as well"
    )  # fmt: skip
    return Line("parameters near 0", float(len(loose)), shown, "", "info", text)


def information(c: Criteria, unit: str) -> Line:
    """Line with the criteria, for comparing models of the same data."""
    shown = f"AIC {c.aic:.6g}, BIC {c.bic:.6g}"
    squared = f"{unit}²" if unit else ""
    text = (
        f"to compare models of the same data, the smaller the better; AICc {c.aicc:.6g}, "
        f"FPE {c.fpe:.4g} {squared}".rstrip()
        + f", {c.parameters:.1f} effective parameters"
    )
    return Line("information criteria", c.aic, shown, "", "info", text)


def coverage(b: Bands) -> Line:
    """Line on the measured coverage of the bands; its limits test honesty, not accuracy."""
    low, high = (0.88, 0.99)
    value = b.coverage
    limit = f"{100 * low:.0f} to {100 * high:.0f} %"
    name = f"inside {100 * b.level:g} % bands"
    if not math.isfinite(value):
        return Line(name, value, "not measured", limit, "info", "no output was measured here")
    if b.level != 0.95:
        low, high, limit = b.level - 0.07, min(1.0, b.level + 0.04), ""
    verdict: Verdict = "ok" if low <= value <= high else "fail" if value < 0.8 else "warn"
    text = "the bands describe the error to expect correctly"
    if value < low:
        text = (
            "fewer samples lie inside than promised: noise or operating range differ from the "
            "training data; do not rely on the bands here"
        )
    elif value > high:
        text = "more samples lie inside than promised: the bands are wider than need be here"
    return Line(name, value, f"{100 * value:.1f} %", limit, verdict, text)


def region(outside: float, farthest: float) -> Line:
    """Line on the share of samples unlike any in the training data; NaN without a region."""
    name, limit = "outside training region", f"<= {100 * OUTSIDE:g} %"
    if math.isnan(outside):
        text = (
            "the model stores no training region, or one of an older version: identify it again, "
            "or give its training data as well"
        )
        return Line(name, math.nan, "not known", limit, "info", text)
    shown = f"{100 * outside:.2f} %"
    if outside <= OUTSIDE:
        return Line(name, outside, shown, limit, "ok", "the model is used where it was trained")
    text = "some samples are unlike any in the training data: the model extrapolates there"
    if outside > FAR_OUTSIDE:
        text = (
            "the model is used where it was not trained: trust it only as far as it was "
            "compared with measurements; record such operation and identify again"
        )
    text += f" (up to {farthest:.3g} times the region's bound)"
    return Line(name, outside, shown, limit, "warn", text)


def record(data: Dataset) -> list[Line]:
    """A line for each fault of the record itself, as `look` and `identify` name it."""
    return [
        Line("record", math.nan, fault.kind.replace("_", " "), "none",
             "warn" if fault.is_of_plant else "fail", fault.with_remedy)
        for fault in faults(data)
    ]  # fmt: skip


def rest(model: DynamicModel, data: Dataset) -> list[Line]:
    """A line if a record stands still at another level than that at which loops begin."""
    stored = model.training.get("rest") or {}
    u, y = tuple(stored.get("u", [0.0] * data.n_inputs)), float(stored.get("y", 0.0))
    unit = data.output_unit
    near_zero = bool(stored.get("near_zero", y == 0.0 and not any(u)))
    for found in map(standing, data.experiments):
        if found is None or found.u != u or abs(found.y - y) <= SIGMAS * found.scatter:
            continue
        if found.near_zero and near_zero:
            continue
        text = (
            "the record stands still there, and loops on the model begin at "
            f"{in_unit(f'{y:.4g}', unit)}: identify it again on this record; a model file of an "
            "earlier version begins at 0"
        )
        return [
            Line(
                "rest", found.y - y, in_unit(f"{found.y:.4g}", unit),
                in_unit(f"{y:.4g}", unit), "warn", text,
            )
        ]  # fmt: skip
    return []


def operation(found: OperatingRange) -> list[Line]:
    """Lines on stability, gain and bandwidth over the operating range."""
    known = [p for p in found.points if p.known] or list(found.points)
    wild = [p for p in known if not p.is_stable]
    integrating = [p for p in wild if np.abs(p.poles).max(initial=0.0) < 1.0 + 1e-9]
    largest = max(float(np.abs(p.poles).max(initial=0.0)) for p in known)
    verdict: Verdict = "ok" if not wild else "info" if len(integrating) == len(wild) else "fail"
    text = {
        "ok": "every operating point that the training data came near is stable",
        "info": "the model integrates its input, as a position does: it rests at any output, and "
        "errors of its input add up",
        "fail": f"{len(wild) - len(integrating)} of {len(known)} operating points are "
        "unstable: a loop tuned there is tuned on a plant that does not exist; train on data from "
        "there",
    }[verdict]
    limit = "" if verdict == "info" else "< 1"
    lines = [Line("largest pole", largest, _pole(largest), limit, verdict, text)]
    none = "an integrator has none" if integrating else "not defined over the operating range"
    for i, name in enumerate(found.input_names):
        here = [p for p, j in zip(found.points, found.varied, strict=True) if j == i]
        here = [p for p in here if p.known] or here
        gains = np.array([p.dc_gain[i] for p in here])
        lines.append(_spread_line(f"gain from {name}", gains, found.gain_unit(i), none))
        widths = np.array([p.bandwidth(i) for p in here])
        lines.append(_spread_line(f"bandwidth from {name}", widths, "Hz", none))
    return lines


def _pole(size: float) -> str:
    """A magnitude to six digits; one that would round to 1 as its distance from 1."""
    left = 1.0 - size
    if 1e-9 < abs(left) < 1e-5:
        return f"1 {'-' if left > 0.0 else '+'} {abs(left):.2g}"
    return f"{size:.6g}"


def _spread_line(name: str, values: FloatArray, unit: str, none: str) -> Line:
    known = values[np.isfinite(values)]
    if len(known) == 0:
        return Line(name, math.nan, "none", "", "info", none)
    low, high = float(known.min()), float(known.max())
    same = f"{low:.4g}" == f"{high:.4g}"
    shown = (f"{low:.4g} {unit}" if same else f"{low:.4g} to {high:.4g} {unit}").rstrip()
    same = high - low <= 0.1 * max(abs(low), abs(high))
    text = (
        "nearly the same over the operating range: one set of gains is enough"
        if same
        else "varies over the operating range: check the loop at both ends, or schedule gains"
    )
    return Line(name, high - low, shown, "", "info", text)
