"""`Validation`: free-run and one-step errors of a model on data."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from . import _core
from .dataset import Dataset, Experiment, FloatArray, labelled, require_dataset
from .dataset.experiment import in_effect, mean_square, weights_of, without_weightless
from .dataset.outliers import white_noise
from .dynamic_model import INIT, DynamicModel, require_init
from .errors import DataError, FitError, SettingError
from .plotting import Drawing, Plotted, fit_panels, stacked
from .tables import Table, percent, significant

GOOD, FAIR, POOR = 90.0, 70.0, 30.0
"""Least fit of the free run [%] for a model to be good, fair, poor; below, it is useless."""


@dataclass(frozen=True)
class Scores:
    """Scores of an error series. The fit is 100 (1 - |y - yhat| / |y - mean(y)|) in Euclidean
    norms, NaN for constant y; `rmse` and the largest magnitude `max_abs` are in the unit of the
    output. With weights, rmse is sqrt(sum w e^2 / sum w), means are weighted, and norms are of
    sqrt(w) times their argument; the largest magnitude is not weighted.
    """

    rmse: float
    fit_percent: float
    max_abs: float

    @classmethod
    def of(cls, y: FloatArray, yhat: FloatArray, weights: FloatArray | None = None) -> Scores:
        """Scores of `yhat` against `y`; all arrays (N,), weights not all 0."""
        root = 1.0 if weights is None else np.sqrt(weights)
        total = len(y) if weights is None else weights.sum()
        mean = y.mean() if weights is None else (weights * y).sum() / total
        error, spread = np.linalg.norm(root * (y - yhat)), np.linalg.norm(root * (y - mean))
        fit = 100.0 * (1.0 - error / spread) if spread > 0.0 else math.nan
        return cls(float(error / math.sqrt(total)), float(fit), float(np.abs(y - yhat).max()))

    def to_json(self) -> dict[str, float | None]:
        """As JSON values: None where a score is undefined."""
        return {k: v if math.isfinite(v) else None for k, v in asdict(self).items()}


@dataclass(frozen=True, eq=False, repr=False)
class ExperimentErrors:
    """Series and scores of one experiment; its first `init` samples are not scored.
    The measured outputs of these determine the state. `y`, `simulated` and `one_step` (N,) are
    reference, free run and one-step prediction [output unit]; NaN in y is not scored. `weights`
    (N,) has the weight of each sample; with None, all are equal.
    """

    name: str
    range_text: str
    init: int
    y: FloatArray
    simulated: FloatArray
    one_step: FloatArray
    weights: FloatArray | None = None

    @property
    def error(self) -> FloatArray:
        """Free-run error y - yhat, shape (N,)."""
        return self.y - self.simulated

    @property
    def scored_error(self) -> FloatArray:
        """The same, NaN where it is not scored."""
        error = self.error
        error[: self.init] = np.nan
        return error

    @property
    def one_step_error(self) -> FloatArray:
        return self.y - self.one_step

    @property
    def unmeasured(self) -> int:
        """Number of samples after the initial ones that are not scored because y is NaN."""
        return int(np.isnan(self.y[self.init :]).sum())

    @property
    def n(self) -> int:
        return len(self.y) - self.init - self.unmeasured

    def scored(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """y, free run and one-step prediction at the scored samples."""
        known = self._known()
        return self.y[known], self.simulated[known], self.one_step[known]

    def scored_weights(self) -> FloatArray | None:
        """Weights of the scored samples; None if all are equal."""
        return None if self.weights is None else self.weights[self._known()]

    def _known(self) -> NDArray[np.intp]:
        return np.flatnonzero(~np.isnan(self.y[self.init :])) + self.init

    @property
    def simulation_scores(self) -> Scores:
        y, simulated, _ = self.scored()
        return Scores.of(y, simulated, self.scored_weights())

    @property
    def one_step_scores(self) -> Scores:
        y, _, one_step = self.scored()
        return Scores.of(y, one_step, self.scored_weights())


@dataclass(frozen=True, eq=False)
class Validation(Plotted):
    """Errors of a model on data, in free run (the main score) and one step ahead.

    Attributes
    ----------
    simulation, one_step : Scores
        Scores over all experiments together; the fit is relative to their common mean.
    experiments : tuple of ExperimentErrors
        Series and scores of each.
    n : int
        Samples scored.
    init : int
        Measured outputs before the scored ones in each experiment, which determine the initial
        state. 0: from rest.
    unmeasured : int
        Number of later samples without a measured output, which are not scored.
    unit : str
        Unit of the errors.
    notes : tuple of str
        Remarks for the reader, such as inputs beyond the range of the training data.
    Ts : float or None
        Sample time of the data [s].
    without_input : float
        Root mean square error of the free run with the inputs at rest (`without_input`) [unit].
    ahead : int or None
        Samples after which the free run of an unstable model began anew; None for other models.
    """

    simulation: Scores
    one_step: Scores
    experiments: tuple[ExperimentErrors, ...]
    n: int
    init: int
    unit: str
    model: str
    against: str
    notes: tuple[str, ...] = ()
    Ts: float | None = None
    without_input: float = math.inf
    ahead: int | None = None

    @property
    def unmeasured(self) -> int:
        return sum(e.unmeasured for e in self.experiments)

    @property
    def noise(self) -> float:
        """White measurement noise of the scored output [unit]; NaN if unknown."""
        return noise_of([e.y for e in self.experiments], [e.scored_error for e in self.experiments])

    @property
    def grade(self) -> str:
        """`good`, `fair`, `poor` or `useless` by the free run; empty if y is constant."""
        return self._graded()[0]

    def _graded(self) -> tuple[str, str]:
        s = self.simulation
        share = by_input(s.rmse, self.without_input)
        grade, resting = judged(s.fit_percent, s.rmse, self.noise, share)
        # nobody has seen an unstable plant run freely
        return ("fair" if grade == "good" and self.ahead is not None else grade), resting

    @property
    def verdict(self) -> str:
        """The grade in a sentence."""
        # scored samples below which a verdict has little evidence
        few = f"; {self.n} samples are few to judge by" if self.n < 100 else ""
        return self._judged() + few

    def _judged(self) -> str:
        grade, resting = self._graded()
        fit = f"fit {self.simulation.fit_percent:.1f} % in free run{resting}"
        if grade == "good" and self.simulation.fit_percent < GOOD:
            return f"good enough to tune a controller on: {fit}, and what is left is noise"
        constant = "" if resting else f", {_beside_a_constant(self.simulation)}"
        return {
            "": "the output is constant here: only the size of the error says something",
            "good": f"good enough to tune a controller on: {fit}",
            "fair": f"good enough for a first, cautious controller: {fit}",
            "poor": f"not good enough to tune a controller on: {fit}",
            "useless": f"useless here{constant}: {fit}; check the columns, or record data like "
            "these and identify again",
        }[grade]

    def to_json(self) -> dict[str, Any]:
        """Scores as JSON values."""
        return {
            "simulation": self.simulation.to_json(),
            "one_step": self.one_step.to_json(),
            "n": self.n,
            "init": self.init,
            "unmeasured": self.unmeasured,
            "unit": self.unit,
            "against": self.against,
            "grade": self.grade or None,
            "verdict": self.verdict,
            "experiments": [
                {
                    "name": e.name,
                    "range": e.range_text,
                    "n": e.n,
                    "unmeasured": e.unmeasured,
                    "simulation": e.simulation_scores.to_json(),
                    "one_step": e.one_step_scores.to_json(),
                }
                for e in self.experiments
            ],
            "notes": list(self.notes),
        }

    def drawing(self) -> Drawing:
        """Draw the measured output, the free run over it, and both errors below."""
        s, unit = self.simulation, f" {self.unit}" if self.unit else ""
        fit = f"fit {s.fit_percent:.2f} %, " if math.isfinite(s.fit_percent) else ""
        panels = fit_panels(
            self.Ts,
            [e.y for e in self.experiments],
            {"free run": [e.simulated for e in self.experiments]},
            {
                "free run": [e.error for e in self.experiments],
                "one step ahead": [e.one_step_error for e in self.experiments],
            },
            label=labelled(self.against, self.unit),
            unit=self.unit,
            title=f"{fit}error {significant(s.rmse)}{unit} rms",
        )
        return stacked(panels, (2.6, 1.7))

    def _repr_html_(self) -> str:
        unit = f" [{self.unit}]" if self.unit else ""
        rows = [("free run", self.simulation), ("one step ahead", self.one_step)]
        if len(self.experiments) > 1:
            rows += [
                (f"{e.name} [{e.range_text}], free run", e.simulation_scores)
                for e in self.experiments
            ]
        return Table(
            f"{self.model} against {self.against}{unit}, {self.n} samples scored",
            ("", f"rms error{unit}", "fit", f"largest error{unit}"),
            tuple(
                (name, significant(s.rmse), percent(s.fit_percent), significant(s.max_abs))
                for name, s in rows
            ),
        ).to_html([*(f"note: {n}" for n in self.notes), f"verdict: {self.verdict}"])

    def __repr__(self) -> str:
        s = self.simulation
        return f"Validation(free run: rmse={s.rmse:.4g}, fit={s.fit_percent:.2f} %, n={self.n})"

    def __str__(self) -> str:
        missing = f", {self.unmeasured} not measured" if self.unmeasured else ""
        state = f"initial state from the first {self.init} samples" if self.init else "from rest"
        unit = f" [{self.unit}]" if self.unit else ""
        data = ", ".join(f"{e.name} [{e.range_text}]" for e in self.experiments)
        lines = [
            f"{self.model} against {self.against}{unit} on {data}",
            f"{self.n} samples scored{missing}, {state}",
            f"{'':18}{'rmse' + unit:>16}{'fit [%]':>10}{'largest' + unit:>16}",
            _row("free run", self.simulation),
            _row("one step ahead", self.one_step),
        ]
        if len(self.experiments) > 1:
            lines += [
                _row(f"  {i + 1}, free run", e.simulation_scores)
                for i, e in enumerate(self.experiments)
            ]
        notes = [f"note: {n}" for n in self.notes]
        return "\n".join([*lines, *notes, f"verdict: {self.verdict}"])


def noise_of(outputs: Sequence[FloatArray], errors: Sequence[FloatArray] = ()) -> float:
    """White measurement noise of outputs (N,), pooled; NaN if unknown.
    It is in the free runs' `errors` too (NaN: not scored), and there nothing tells it in advance:
    what their own past tells is no white noise, but a hum, a drift, or what the model lacks.
    """
    found = [white_noise(y) for y in outputs]
    known = [n for n in found if math.isfinite(n)]
    noise = math.sqrt(sum(n * n for n in known) / len(known)) if known else math.nan
    return min(noise, _core.innovation(list(errors))) if errors else noise


def grade_of(fit: float, rmse: float, noise: float) -> str:
    """`good`, `fair`, `poor` or `useless`; empty for a constant output.
    The grade is that of the fit to the output without its white measurement noise, which no model
    explains. If the output itself is hardly larger than its noise, that is no evidence, so a fit
    below `POOR` is useless in any case. `fit` is that of the free run [%]; its error `rmse` and the
    output's `noise` are in one unit.
    """
    if not math.isfinite(fit):
        return ""
    if fit < POOR:
        return "useless"
    own = _without_noise(fit, rmse, noise)
    return "good" if own >= GOOD else "fair" if own >= FAIR else "poor"


def _without_noise(fit: float, rmse: float, noise: float) -> float:
    """The fit [%] to the output without independent noise, which adds its variance to that of the
    error and to that of the output.
    """
    if not noise > 0.0:
        return fit
    if rmse <= noise:
        return 100.0
    lost = (1.0 - (noise / rmse) ** 2) / ((1.0 - fit / 100.0) ** -2 - (noise / rmse) ** 2)
    return 100.0 * (1.0 - math.sqrt(lost))


def _beside_a_constant(scores: Scores) -> str:
    worse = scores.fit_percent < 0.0
    return "worse than a constant" if worse else "hardly better than a constant"


def by_input(error: float, resting: float) -> float:
    """Part explained by the input's motion [%]: 100 (1 - error of the free run / error at rest).
    It equals the fit if only the input moves the output. A ramp, a decay to rest or different
    levels of recordings are explained by the initial state alone.
    """
    if not math.isfinite(error):
        return math.nan
    return 100.0 * (1.0 - error / resting) if resting > 0.0 else 0.0


def judged(fit: float, error: float, noise: float, share: float) -> tuple[str, str]:
    """The grade, and a remark if the input explains too small a part of the fit.
    `fit` is that of the free run [%]; its `error` and the output's white measurement noise `noise`
    are in one unit. `share` is the part explained by the input's motion [%], from `by_input`.
    """
    by_fit, grade = grade_of(fit, error, noise), grade_of(min(fit, share), error, noise)
    if grade == by_fit:
        return grade, ""
    return grade, (
        f", but the moves of the input bring {max(share, 0.0):.0f} % of it: the rest follows from "
        "where each recording begins"
    )


def largest_pole(model: DynamicModel) -> float:
    """Modulus of a linear model's largest pole; 0 for other kinds."""
    return float(max(map(abs, getattr(model, "poles", ())), default=0.0))


def doubling(model: DynamicModel) -> int | None:
    """Samples in which the free run of an unstable linear model doubles; None for other models."""
    largest = largest_pole(model)
    return max(1, round(math.log(2.0) / math.log(largest))) if largest > 1.0 else None


def scored_runs(model: DynamicModel, data: Dataset, init: int) -> list[FloatArray]:
    """Free runs over all experiments, as `simulate`. Those of an unstable model would leave all
    bounds, as its plant would: they begin anew whenever they have doubled, from the state that the
    measured outputs before give, as many or `INIT`.
    """
    ahead = doubling(model)
    if ahead is None:
        return model.simulate(data, init=init)
    return [_restarted(model, e, ahead) for e in data.experiments]


def _restarted(model: DynamicModel, e: Experiment, ahead: int) -> FloatArray:
    before = min(max(INIT, ahead), len(e))
    least = min(INIT, before)
    places = range(before, max(len(e), before + 1), ahead)
    counts = [int(np.isfinite(e.y[at - before : at]).sum()) for at in places]
    # where too few outputs are known a run goes on, at the beginning from the first that are
    kept = [(at, n) for at, n in zip(places, counts, strict=True) if 2 * n >= least]
    if not kept:
        raise DataError(
            f"{e.name}: expected {least} measured outputs among {before} samples to begin a free "
            "run of an unstable model with, received fewer; give a longer range"
        )
    first = kept[0][0] - before
    edges = [first, *(at for at, _ in kept[1:]), len(e)]
    y = np.empty(len(e))
    for (at, n), (begin, end) in zip(kept, itertools.pairwise(edges), strict=True):
        window = e.cut(at - before, end)
        run = model.core.simulate(window.u, model.initial_state(window, n))
        y[begin:end] = run[begin - end :]
    y[:first] = y[first]  # little is known there, and little scored
    return y


def without_input(model: DynamicModel, data: Dataset, init: int) -> float:
    """`free_run_error` with the inputs held at their means after the initial samples.
    An experiment that begins at rest would have stayed there: the mean of a single step is nearly
    the step itself.
    """
    means = np.mean(np.concatenate([e.u for e in data.experiments]), axis=0)
    held = []
    for e in data.experiments:
        u = e.u.copy()
        u[e.initial_samples(init) :] = means
        held.append(replace(e, u=u))

    def run() -> list[FloatArray]:
        runs = scored_runs(model, replace(data, experiments=tuple(held)), init)
        rests = [model.standing(e) for e in data.experiments]
        return [y if s is None else np.full(len(y), s.y) for y, s in zip(runs, rests, strict=True)]

    return _error(run, data, init)


def free_run_error(model: DynamicModel, data: Dataset, init: int) -> float:
    """Weighted rms error of the free run [output unit]; infinite if the run diverges."""
    return _error(lambda: scored_runs(model, data, init), data, init)


def _error(simulated: Callable[[], list[FloatArray]], data: Dataset, init: int) -> float:
    try:
        runs = simulated()
    except (DataError, FitError):
        return math.inf
    squares, weights = [], []
    for e, run in zip(data.experiments, runs, strict=True):
        first = e.initial_samples(init)
        squares.append((e.y - run)[first:] ** 2)
        weights.append(weights_of(e)[first:])
    return math.sqrt(mean_square(np.concatenate(squares), np.concatenate(weights)))


def validate(
    model: DynamicModel, data: Dataset, *, init: int = INIT, against: str | None = None
) -> Validation:
    """Score a model on data that it was not trained on.

    Parameters
    ----------
    model : Model
    data : Dataset
        Inputs must be complete. Samples whose output is NaN are not scored, but counted in
        `unmeasured`. With weights, errors and fits are weighted (`Scores`), and a sample of weight
        0 counts as not measured; the measurement noise ignores weights.
    init : int
        The first `init` measured outputs of each experiment determine the initial state; samples up
        to the last of them are not scored. 0 starts from rest and scores every sample.
    against : str or None
        Name of a channel to score against instead of the measured output (a virtual machine's
        true speed).

    Raises
    ------
    DataError
        If the data do not match the model, an input is NaN, or nothing is left to score.
    FitError
        If the model is unstable on this input.
    """
    require_dataset(data, "data")
    require_init(init)
    if not isinstance(model, DynamicModel):
        raise SettingError(
            name="model", expected="a model", received=type(model).__name__,
            remedy="identify one, or read one with sewfast.load_model",
        )  # fmt: skip
    data.require_measured()
    given, data = data, in_effect(data)
    for e in data.experiments:
        if len(e) - e.unmeasured <= init:
            raise DataError(
                f"{e.name}: expected more than init = {init} samples, received {e.counted}: "
                "nothing is left to score; lower init (--init) or give a longer range"
            )
    series = zip(
        given.experiments,
        data.experiments,
        scored_runs(model, data, init),
        model.predict(data, init=init),
        strict=True,
    )
    found = tuple(
        ExperimentErrors(
            e.name,
            e.range_text,
            first := e.initial_samples(init),
            _target(whole, against, first),
            simulated,
            one_step,
            e.weights,
        )
        for whole, e, simulated, one_step in series
    )
    y, simulated, one_step = (
        np.concatenate(c) for c in zip(*(e.scored() for e in found), strict=True)
    )
    all_alike = all(e.weights is None for e in found)
    weights = None if all_alike else np.concatenate([e.scored_weights() for e in found])
    return Validation(
        Scores.of(y, simulated, weights),
        Scores.of(y, one_step, weights),
        found,
        len(y),
        init,
        data.output_unit or model.output_unit,
        model.title,
        against or data.output_name,
        tuple(_beyond_training(model, data)),
        data.Ts,
        without_input(model, data, init) if against is None else math.inf,
        doubling(model),
    )


def _target(experiment: Experiment, against: str | None, first: int) -> FloatArray:
    """The reference of the scores, NaN where it has no weight."""
    if against is None:
        return without_weightless(experiment).y
    if against not in experiment.channels:
        raise DataError(
            name=experiment.name, expected=f"a channel {against!r}",
            received=", ".join(experiment.channels) or "none", remedy="name one of its channels",
        )  # fmt: skip
    if experiment.removed is not None:
        raise DataError(
            name=f"{experiment.name}: channel {against!r}",
            expected="the output without an offset taken off",
            received="one with it off, unlike the channel",
            remedy="compare it with data.restore(model.simulate(data))",
        )  # fmt: skip
    target = experiment.channels[against]
    if experiment.weights is not None:
        target = np.where(experiment.weights == 0.0, np.nan, target)
    if np.isnan(target[first:]).all():
        raise DataError(
            name=f"{experiment.name}: channel {against!r}", expected="a value at a scored sample",
            received="NaN at all of them", remedy="score against another",
        )  # fmt: skip
    return target


def _beyond_training(model: DynamicModel, data: Dataset) -> list[str]:
    """Notes on inputs that exceed their training range by more than a hundredth of it, and on how
    an unstable model runs.
    """
    notes = []
    if (ahead := doubling(model)) is not None:
        notes.append(
            f"the model is unstable, as its plant has to be: its free run begins anew every "
            f"{ahead} samples, in which it doubles"
        )
    known = model.training.get("input_range", [])
    for name, (low, high), (least, most) in zip(
        data.input_names, known, data.input_range, strict=False
    ):
        margin = 0.01 * (high - low)
        if least < low - margin or most > high + margin:
            notes.append(
                f"{name} spans {least:g} to {most:g}, the training data {low:g} to "
                f"{high:g}: the model extrapolates"
            )
    return notes


def _row(label: str, s: Scores) -> str:
    return f"{label:18}{s.rmse:16.6g}{s.fit_percent:10.2f}{s.max_abs:16.6g}"
