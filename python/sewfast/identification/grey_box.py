"""The grey box: a motor's or a joint's equations, with a network if held-out data need one."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from .. import _core
from ..arrays import gram
from ..dataset import Dataset, Experiment, FloatArray
from ..dataset.pieces import thinned
from ..dynamic_model import INIT
from ..errors import DataError, FitError, SettingError
from ..models import Model
from ..models.grey_box import MOST_UNITS, GreyBox
from ..motorfit import PLACE, estimated, joint, rad_per_second, records_of
from ..motorfit.estimation import Normal, minimised
from ..motorfit.joint import changed, weights
from ..progress import TimeUp
from ..units import is_position, revolutions_per_second
from .folds import (
    TRIAL,
    WORTH_IT,
    Errors,
    Split,
    compared,
    errors_of,
    free_runs,
    judged_without,
    later_part,
)
from .task import HIDDEN, SHARES, Look, Pool, Provenance, R, Task, finite

TERMS = ("lag", "delay", "coulomb", "offset", "drop", "stribeck", "limit")
IF_CLEAR = ("sag",)
"""Terms of a motor without effects over the turn."""
STARTS = 2
"""Random starts of the network; the best one is kept."""
EXCERPT, POLISHING = 8_000, 10
"""Samples on which the starts are trained, and iterations of the best one on all samples."""
MOST_FITTED = 100_000
"""Samples to which equations are fitted. In blocks of some hundred, friction was lost in a limit of
current (`virtual:5`, 10,000 of 30,000 samples: error 28 instead of 5.8 RPM, in half the time)."""
ARGUMENTS, OUTPUTS = 3.0, 0.1
"""Prior standard deviations of the weights, in units of the scales. They keep a network small where
the record gives no information, and count as much as a single residual."""
CREDIBLE = 2.0
"""Standard errors by which the network has to reduce the held-out error."""
NOISES = tuple(10.0**e for e in range(-10, -1))
"""Process noises to try, in squares of the scales."""
UNEXPLAINED = 0.01
"""Most of the variance that the equations of a joint may leave, to rule out an unstable plant."""


def grey_box(task: Task) -> Model:
    """The motor, with a network if that is credibly better on held-out data."""
    require_equations(task.data)
    if task.hidden is not None and task.hidden > MOST_UNITS:
        raise SettingError(
            name="hidden", expected=f"1 to {MOST_UNITS} units beside a motor",
            received=str(task.hidden), remedy="identify with model neural_ss for more",
        )  # fmt: skip
    motors = Motors(task.seed, task.iterations_or_usual)
    hidden, tried = task.hidden or 0, list[Provenance]()
    part = later_part(task.data, task.validation) if task.select else None
    if task.hidden is not None and part is not None and part.is_given:
        part = None  # nothing to choose, and validation data judge the model itself

    def look(*_: object) -> None:
        if task.progress is not None:
            task.progress(0, task.iterations_or_usual, math.inf)

    found: MotorCandidate | None = None
    try:
        try:
            if part is not None:
                found = motors.alone(part, look)
                tried = [found.held_out()]
                more = motors.beside(found, part, look, task.hidden or HIDDEN)
                tried.append(more.held_out())
                found = more if task.hidden or _is_better(more, found) else found
                hidden = found.hidden
        except DataError:
            # too short to hold a part out, which a given structure does not need
            if task.hidden is None:
                raise
            found = None
        core = motors.fitted(task.data, hidden, look)
    except TimeUp:
        # without time for all data, the motor of the earlier part
        if found is None:
            raise
        core = found.core
    known: Provenance = {
        "initial_state": "estimated",
        "cost": cost_of(core, task.data),
        "cost_horizon": "free run",
        "cost_unit": "output unit squared",
        "structure": {"hidden": hidden},
        "tried": tried,
    }
    model = task.model(GreyBox, core, known)
    if part is None or found is None:
        return model
    return judged_without(model, task.model(GreyBox, found.core, {}), task.data, part)


def require_equations(data: Dataset) -> None:
    """Raise `DataError` unless there is one input, `SettingError` without a unit of the output."""
    if data.n_inputs != 1:
        raise DataError(
            name="inputs", expected="one input, the motor's command",
            received=", ".join(data.input_names), remedy="choose its column",
        )  # fmt: skip
    unit = data.output_unit
    if revolutions_per_second(unit) is None and not is_position(unit):
        raise SettingError(
            name="output_unit",
            expected="a speed in rpm, rev/s, rad/s or deg/s, or an angle or a length",
            received=repr(unit),
            remedy="name the unit of the output, or identify another kind of model",
        ) from None  # fmt: skip


def is_joint(task: Task) -> bool:
    """Whether a joint that nothing pulls explains the output as a position, in free run."""
    data = thinned(task.data, MOST_FITTED)
    if data.n_inputs != 1 or not (is_position(data.output_unit) or not data.output_unit):
        return False
    look = task.clock.limited(task.progress, SHARES.joint, "the equations of a joint")
    try:
        fit = joint.fitted(data, _at_any_time(look), integrates=True)
    except (DataError, FitError, SettingError, TimeUp):
        return False
    spread = np.nanvar(np.concatenate([e.y for e in data.experiments]))
    left: float = fit.core.settings["residual_variance"]
    # cogging, too, pulls away from where it balances
    return not {"gravity", "cogging"} & {*fit.terms} and left < UNEXPLAINED * spread


# --- Motors with and without a network ------------------------------------------------------------


@dataclass(frozen=True)
class MotorCandidate:
    """The motor's equations, with or without a network, and their errors on held-out data."""

    core: _core.GreyBox
    errors: Errors

    @property
    def hidden(self) -> int:
        units: int = self.core.settings["hidden"]
        return units

    @property
    def rmse(self) -> float:
        """Error on held-out data."""
        return self.errors.rmse

    def held_out(self) -> Provenance:
        """What a choice between both records."""
        return {"hidden": self.hidden, "held_out_rmse": finite(self.rmse)}

    def to_json(self) -> Provenance:
        """The candidate's row of the table."""
        return {"kind": "grey_box", "hidden": self.hidden, "free_run_rmse": finite(self.rmse)}


@dataclass(frozen=True)
class Motors:
    """Fits of motors; networks beside them are drawn from `seed`, in at most `iterations`."""

    seed: int
    iterations: int
    integrates: bool = False
    """Whether an output without a unit is a position, as it integrates."""

    def fitted(self, data: Dataset, hidden: int, look: Look | None = None) -> _core.GreyBox:
        """A motor's parameters, a network of `hidden` units beside it, and the process noise."""
        core = self._equations(data, look)
        return _with_noise(self._with_network(core, data, hidden, look) if hidden else core, data)

    def alone(self, part: Split, look: Look | None = None) -> MotorCandidate:
        """A motor without a network."""
        return _judged(self._equations(part.fitted, look), part)

    def _equations(self, data: Dataset, look: Look | None) -> _core.GreyBox:
        """The equations alone, at the least-squares solution of the free run."""
        if revolutions_per_second(data.output_unit) is not None:
            return _motor(data, look)
        inside = joint.is_commanded(data)
        return joint.fitted(data, _at_any_time(look), integrates=not inside).core

    def beside(
        self, motor: MotorCandidate, part: Split, look: Look | None = None, hidden: int = HIDDEN
    ) -> MotorCandidate:
        """The same motor with a network."""
        return _judged(self._with_network(motor.core, part.fitted, hidden, look), part)

    def candidate(self, part: Split, pool: Pool, until: float | None) -> MotorCandidate | None:
        """A motor fitted to a part; None if the data are not those of a motor.
        It is first fitted without a network, which is the result if time is short.
        """
        try:
            require_equations(part.fitted)
        except SettingError:
            if part.fitted.output_unit or not self.integrates:
                return None
        except DataError:
            return None
        plain = pool.map(
            lambda part, look: or_none(lambda: self.alone(part, look)),
            [part], until=until, what="the equations of a motor",
        )[0]  # fmt: skip
        if plain is None:
            return None
        fuller = self._beside(plain, part, pool, until)
        return fuller if fuller is not None and _is_better(fuller, plain) else plain

    def _beside(
        self, motor: MotorCandidate, part: Split, pool: Pool, until: float | None
    ) -> MotorCandidate | None:
        return pool.map(
            lambda part, look: or_none(lambda: self.beside(motor, part, look)),
            [part], until=until, what="a network beside the motor",
        )[0]  # fmt: skip

    def _with_network(
        self, core: _core.GreyBox, data: Dataset, hidden: int, look: Look | None
    ) -> _core.GreyBox:
        """Motor and network together, at the least-squares solution of the free run. The network
        begins without effect. Its starts are trained on an excerpt, the best one on all data.
        """
        part, asked, begun = thinned(data, EXCERPT), _at_any_time(look), []
        for i in range(STARTS):
            rng = np.random.default_rng(self.seed + i)
            weights = rng.standard_normal((hidden, 4)) * [0.5, 1.5, 1.5, 0.0]
            start = np.concatenate([core.theta, weights.ravel()])
            try:
                one = trained_from(core, start, part, self.iterations, look)
                asked()
            except TimeUp:
                # cut short, it fits this part and nothing else: as it began, it has no effect
                one = changed(core, theta=start)
            begun.append(one)
        best = min(begun, key=lambda c: cost_of(c, part))
        if part is data:
            return best
        with contextlib.suppress(TimeUp):
            return trained_from(best, best.theta, data, min(POLISHING, self.iterations), look)
        return best


def or_none(found: Callable[[], R]) -> R | None:
    """What is found; None if the fit fails because the data are not those of a motor."""
    try:
        return found()
    except (DataError, FitError, SettingError, np.linalg.LinAlgError):
        return None


def _judged(core: _core.GreyBox, part: Split) -> MotorCandidate:
    core = _with_noise(core, part.fitted)
    return MotorCandidate(core, errors_of(free_runs(core, part), part))


def _is_better(more: MotorCandidate, alone: MotorCandidate) -> bool:
    """Whether a network makes the motor credibly better."""
    ratio, deviation = compared(more.errors, alone.errors)
    return ratio < min(-CREDIBLE * deviation, math.log(WORTH_IT))


# --- Their fits -----------------------------------------------------------------------------------


def _at_any_time(look: Callable[[int, int, float], object] | None) -> Callable[[], object]:
    """`look` without arguments: it checks for the end but shows no progress."""
    return (lambda: None) if look is None else lambda: look(0, 0, math.inf)


def _motor(data: Dataset, look: Look | None = None) -> _core.GreyBox:
    """The equations alone, at the least-squares solution of the free run."""
    found = estimated(records_of(data, None, None), TERMS, _at_any_time(look), if_clear=IF_CLEAR)
    state, records = found.state, found.records
    free = [n for n in state.names() if n not in ("k_b", "delay")]
    y, model = found.problem.outcome(state)
    unit = rad_per_second(data.output_unit)
    commands = np.concatenate([p.u for p in records.pieces])
    return _core.GreyBox(
        values=state.theta,
        free=[PLACE[n] for n in free],
        Ts=data.Ts,
        steps=found.problem.steps,
        mean=records.mean,
        unit=unit,
        speed_scale=float(np.std(y)),
        command_scale=float(np.std(commands)),
        residual_variance=max(float(np.mean((y - model) ** 2)), 1e-18 * float(np.var(y))) / unit**2,
        process_noise=NOISES[len(NOISES) // 2],
        theta=np.array([state.value(n) for n in free]),
    )


def trained_from(
    core: _core.GreyBox, start: FloatArray, data: Dataset, iterations: int, look: Look | None = None
) -> _core.GreyBox:
    """Descend from the motor's parameters and the weights to the least squares of the free run.
    The prior holds weights near 0 as if each had been measured once.
    """
    asked, free = _at_any_time(look), len(core.settings["free"])
    motor, hidden = start[:free], (len(start) - free) // 4
    prior = np.tile([1.0 / ARGUMENTS] * 3 + [1.0 / OUTPUTS], hidden)
    prior = np.concatenate([np.zeros(free), prior]) * math.sqrt(core.settings["residual_variance"])
    if core.settings["position"]:
        pieces = joint.pieces_of(data).experiments
        squares = np.concatenate([weights(e) ** 2 for e in pieces])
        prior *= math.sqrt(float(squares[squares > 0.0].mean()))  # the residuals are weighted
        return joint.descended(core, start, pieces, asked, iterations, prior).core
    states = [state for _, _, _, state in _runs(core, data)]
    low = np.full(len(start), -np.inf)
    for j, value in enumerate(motor):  # parameters above 0 stay there
        low[j] = 1e-3 * value if value > 0.0 else -np.inf

    def at(x: FloatArray) -> _core.GreyBox | None:
        try:
            return changed(core, theta=x)
        except SettingError:
            return None

    def normal(x: FloatArray) -> Normal:
        asked()
        own = at(x)
        assert own is not None
        cost, slope, total = float((prior * x) @ (prior * x)), prior**2 * x, np.diag(prior**2)
        for e, state in zip(data.experiments, states, strict=True):
            y, rows = own.jacobian(e.u, state)
            known = weights(e)
            error, rows = (known * (y - np.nan_to_num(e.y))), known[:, None] * rows[:, : len(x)]
            cost += float(error @ error)
            whole = gram(np.c_[rows, error])
            slope, total = slope + whole[:-1, -1], total + whole[:-1, :-1]
        return cost, slope, total

    def cost(x: FloatArray) -> float:
        asked()
        own = at(x)
        if own is None:
            return math.inf
        return float((prior * x) @ (prior * x)) + joint.squares(
            own, data.experiments, np.stack(states)
        )

    count = sum(int(np.isfinite(e.y).sum()) for e in data.experiments)
    bounds = (low, np.full(len(start), np.inf))
    found = minimised(normal, cost, start, bounds, count, iterations=iterations)
    best = changed(core, theta=found.x)
    residual = 2.0 * cost_of(best, data)
    return changed(best, residual_variance=max(residual, 1e-300))


def _runs(
    core: _core.GreyBox, data: Dataset
) -> Iterator[tuple[Experiment, FloatArray, FloatArray, FloatArray]]:
    """Experiments with their free run, error (NaN where not measured) and initial state."""
    for e in data.experiments:
        first = e.initial_samples(INIT)
        state = core.estimate_initial_state(e.u[:first], e.y[:first])
        run = core.simulate(e.u, state)
        yield e, run, e.y - run, state


def cost_of(core: _core.GreyBox, data: Dataset) -> float:
    """J of the free run [output unit squared]; infinite if it diverges."""
    try:
        pairs = [(weights(e), error) for e, _, error, _ in _runs(core, data)]
    except FitError:
        return math.inf
    squares = sum(float(np.sum((w * np.nan_to_num(error)) ** 2)) for w, error in pairs)
    return 0.5 * squares / max(sum(float(w @ w) for w, _ in pairs), 1e-300)


def _with_noise(core: _core.GreyBox, data: Dataset) -> _core.GreyBox:
    """The model with the process noise that has the least one-step error."""
    part: Sequence[tuple[Experiment, FloatArray]] = [
        (e, state) for e, _, _, state in _runs(core, data)
    ]

    def one_step(noise: float) -> float:
        own, total, left = changed(core, process_noise=noise), 0.0, TRIAL
        for e, state in part:
            n = min(left, len(e))
            left -= n
            if n:
                y = e.y[:n]
                error = weights(e)[:n] * np.nan_to_num(own.predict(e.u[:n], y, state, 1) - y)
                total += float(error @ error)
        return total

    return changed(core, process_noise=min(NOISES, key=one_step))
