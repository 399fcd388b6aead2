"""Lagged models: the paper's network, networks from a linear model, static curves."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from .. import _core
from ..dataset import Dataset, Experiment
from ..errors import FitError, Interrupted
from ..models import LinearOE, Model, NeuralOE
from ..models.base import Fitted, StructuredModel
from .folds import (
    LEAST_HELD_OUT,
    WORTH_IT,
    Errors,
    Split,
    compared,
    errors_of,
    free_runs,
    judged_without,
    later_part,
)
from .linear import is_misled, oe, raised
from .task import (
    SHARES,
    Progress,
    Provenance,
    Task,
    arrays,
    completed,
    finite,
    fit_provenance,
    free_run_rmse,
    sources,
    wrap,
)

DECAYS = (1e-2, 1e-4)
"""Weight decays of the default network, the strongest first."""
_LINEAR_FITS = "linear fits at which the network begins"


def paper(task: Task) -> Model:
    """The paper's network, from random starts and in its fixed scaling."""
    fit = _core.fit_neural_oe(
        arrays(task.data),
        [] if task.validation is None else arrays(task.validation),
        **_options(task),
        linear=None,
        u_mean=np.zeros(1),
        u_scale=np.full(1, 10.0),
        y_mean=0.0,
        y_scale=1000.0,
        saturate=0.2,
        initial_state="measured",
        weight_decay=0.0,
    )
    known = _provenance(fit, task.seed) | {"preset": "paper", "initial_state": "measured"}
    return completed(task.model(NeuralOE, fit.model, known))


def neural_oe(task: Task) -> Model:
    """The network, trained in free run from the linear output-error model. The result is always a
    trained network. If the held-out blocks stop the training before its first step, because no step
    is better there than the linear model, the network is trained on all data instead, with a note.
    """
    networks = Networks.of(task)
    return networks.selected() if task.select else networks.unselected()


def _options(task: Task) -> dict[str, Any]:
    """Settings of a network's training that every network of a task shares."""
    return {
        **task.fit_options(), "hidden": task.hidden_or_usual, "seed": task.seed,
        "starts": 4 if task.starts is None else task.starts, "threads": task.threads,
    }  # fmt: skip


def _provenance(fit: _core.NeuralFit, seed: int) -> Provenance:
    costs = [finite(c) for c in fit.start_costs.tolist()]
    provenance: Provenance = {"initial_state": "estimated", "cost_unit": "scaled output squared"}
    provenance |= {"seed": seed, "starts": len(costs), "start": fit.start, "start_costs": costs}
    return fit_provenance(fit) | provenance | {"validation_cost": fit.validation_cost}


@dataclass(frozen=True)
class Networks:
    """Lagged networks of one task, all trained in free run from the same linear model.
    `linear` is the linear output error of the data, with which a network is compared. The training
    starts at `start`: `linear`, or a smaller model if that one is misled.
    """

    task: Task
    linear: _core.LinearModel
    start: _core.LinearModel

    @classmethod
    def of(cls, task: Task) -> Networks:
        """The networks of a task, whose linear models are fitted here."""
        brief = replace(
            task, progress=task.clock.limited(task.progress, SHARES.choice, _LINEAR_FITS)
        )
        try:
            linear = _linear(brief)
            return cls(task, linear, _start(brief, linear))
        except Interrupted as stopped:
            # a network requested by name is not replaced by a linear model
            raise KeyboardInterrupt from stopped

    def unselected(self) -> Model:
        """The network trained on all data to the last iteration."""
        known = {"weight_decay": DECAYS[-1], "selected": False}
        return self._model(self._trained(self.task.data, None, DECAYS[-1]), known)

    def selected(self) -> Model:
        """The network that held-out data choose, compared there with the linear model."""
        fitted, held = self.task.data, self.task.validation
        if held is None:
            lag = max(self.task.na, self.task.orders["nk"] + self.task.nb)
            fitted, held = _with_blocks_held_out(fitted, lag)
        network, decays = self._best(fitted, held)
        choice = self._compared(network, held)
        known: Provenance = {"samples_fitted": len(fitted), **decays}
        if len(network.trace) < 2 or _is_still_linear(choice):
            # a strong decay would pull the network back to its linear part
            network, fitted = self._trained(self.task.data, None, DECAYS[-1]), self.task.data
            # J is in scaled units: a linear model without error needs no step
            # J in scaled units below which a linear model explains everything
            if len(network.trace) < 2 and network.cost > 1e-6:
                raise FitError(
                    f"{self.task.data.source}: expected a network that does better than its linear "
                    "start, found none; ask for model oe, or give more iterations or starts"
                )
            choice["reason"] += "; no step of the training did better on held-out blocks"
            known |= {"samples_fitted": len(self.task.data), "weight_decay": DECAYS[-1]}
        is_better, known["choice"] = choice.pop("is_better"), choice
        if not is_better:
            share = f"below {100 * WORTH_IT:.0f} % of its error"
            bound = f"not credibly better than the linear model ({share})"
            known["notes"] = [f"{bound}: consider model oe"]
        model = self._model(network, known)
        if held is None or fitted is self.task.data:
            return model
        return judged_without(model, model, self.task.data, Split(fitted, held))

    def _trained(self, data: Dataset, held: Dataset | None, decay: float) -> _core.NeuralFit:
        """A network of some of the data, stopped by others if there are any."""
        fit = _core.fit_neural_oe(
            arrays(data),
            [] if held is None else arrays(held),
            **_options(self.task),
            linear=self.start,
            u_mean=None,
            u_scale=None,
            y_mean=None,
            y_scale=None,
            saturate=1.0,
            initial_state="estimated",
            weight_decay=decay,
        )
        if fit.termination == "interrupted":
            own = replace(self, task=replace(self.task, data=data))
            known = {"weight_decay": decay, "samples_fitted": len(data)}
            raise Interrupted(own._model(fit, known))
        return fit

    def _model(self, fit: _core.NeuralFit, extra: Provenance) -> Model:
        known = _provenance(fit, self.task.seed)
        return self.task.model(NeuralOE, fit.model, known | extra)

    def _best(self, data: Dataset, held: Dataset | None) -> tuple[_core.NeuralFit, Provenance]:
        """The network with the strongest weight decay that does about as well as the best.
        Held-out blocks lie where the drive has been before; elsewhere a smoother network is safer
        (the one-standard-error rule: Hastie, Tibshirani, Friedman 2009, section 7.10). A network
        that diverges or does not forget its initial state is chosen only if all do.
        """
        decays = DECAYS if held is not None else DECAYS[:1]
        fits = [self._trained(data, held, decay) for decay in decays]
        errors = [math.sqrt(2.0 * (f.validation_cost or 0.0)) for f in fits]
        able = [i for i, f in enumerate(fits) if f.sound] or list(range(len(fits)))
        # largest ratio to the best held-out error for which a stronger weight decay is chosen
        bound = 1.25 * min(errors[i] for i in able)
        chosen = next(i for i in able if errors[i] <= bound)
        tried = [
            {"weight_decay": d, "held_out_error": e or None, "sound": f.sound}
            for d, e, f in zip(decays, errors, fits, strict=True)
        ]
        return fits[chosen], {"weight_decay": decays[chosen], "weight_decays": tried}

    def _compared(self, network: _core.NeuralFit, held: Dataset | None) -> Provenance:
        """Free-run errors on data not trained on, the choice and its reason."""
        asked = "a lagged network was asked for"
        if held is None:
            short = f"too short to hold out blocks of {LEAST_HELD_OUT} samples to compare on"
            reason = f"{asked}; the record is {short}"
            return {"chosen": "neural_oe", "reason": reason, "is_better": False}
        data = self.task.data
        rmse = {
            "oe": free_run_rmse(wrap(LinearOE, self.linear, data), held),
            "neural_oe": free_run_rmse(wrap(NeuralOE, network.model, data), held),
        }
        is_better = network.sound and rmse["neural_oe"] < WORTH_IT * rmse["oe"]
        ratio = rmse["neural_oe"] / rmse["oe"] if rmse["oe"] > 0.0 else 1.0
        reason = (
            f"{asked}; its free-run error on data not trained on is {100 * ratio:.1f} % of the "
            "linear model's"
        )
        if not network.sound:
            reason += "; it runs away on larger inputs or does not forget its initial state"
        return {
            "chosen": "neural_oe",
            "reason": reason,
            "is_better": is_better,
            "free_run_rmse": {k: finite(v) for k, v in rmse.items()},
            "held_out": sources(held),
        }


def _is_still_linear(choice: Provenance) -> bool:
    """Whether the network still has the linear model's error on held-out blocks."""
    rmse = choice.get("free_run_rmse", {})
    network, linear = rmse.get("neural_oe"), rmse.get("oe")
    if network is None or linear is None:
        return False
    # relative difference of two errors below which the network is still its linear start
    return bool(abs(network - linear) <= 1e-6 * linear)


def _linear(task: Task) -> _core.LinearModel:
    """Output error, within its share of the time budget; ARX if there is no time at all."""
    try:
        best: _core.LinearModel = oe(task).core
    except KeyboardInterrupt as e:
        if not task.clock.over(SHARES.choice, _LINEAR_FITS):
            raise
        if not isinstance(e, Interrupted):
            return _core.fit_arx(arrays(task.data), **task.orders, offset=True)
        best = e.best.core
    return best


def _start(task: Task, linear: _core.LinearModel) -> _core.LinearModel:
    """The start of the training: the linear model, or a smaller one if that one is misled. Networks
    that start at a slow pole which the drive does not have (`linear.is_misled`) rarely leave it.
    """
    orders = task.orders
    na, nb = orders["na"] - 1, orders["nb"] - 1
    part = later_part(task.data, task.validation)
    if na < 1 or nb < 1 or part is None or task.clock.over(SHARES.choice, _LINEAR_FITS):
        return linear
    learned = arrays(part.fitted)
    models = []
    for a, b in ((na, nb), (orders["na"], orders["nb"])):
        try:
            fit = _core.fit_oe(learned, **task.fit_options(na=a, nb=b))
            if fit.termination == "interrupted":
                raise KeyboardInterrupt
        except FitError:
            return linear
        except KeyboardInterrupt:
            # Ctrl-C, or the end of the linear fits' share of a time budget
            if not task.clock.over(SHARES.choice, _LINEAR_FITS):
                raise
            return linear
        models.append(fit.model)
    smaller, own = models
    return raised(smaller, orders["na"]) if is_misled(own, smaller, part) else linear


def _with_blocks_held_out(data: Dataset, lag: int) -> tuple[Dataset, Dataset | None]:
    """The data without two of eight blocks of every experiment, and these, unless too short."""
    blocks = 8
    # blocks held out for selection: inside the record, away from both ends of a chirp
    held_out = (2, 5)
    kept: list[Experiment] = []
    held: list[Experiment] = []
    for e in data.experiments:
        edges = [round(i * len(e) / blocks) for i in range(blocks + 1)]
        if edges[1] < LEAST_HELD_OUT + lag:
            return data, None
        held += [e.cut(edges[i], edges[i + 1]) for i in held_out]
        starts, stops = (0, *(i + 1 for i in held_out)), (*held_out, blocks)
        kept += [e.cut(edges[i], edges[j]) for i, j in zip(starts, stops, strict=True)]
    # pieces in which enough outputs were measured
    able = [[e for e in some if len(e) - e.unmeasured > LEAST_HELD_OUT] for some in (kept, held)]
    if not all(able):
        return data, None
    fitted, judged = (replace(data, experiments=tuple(some)) for some in able)
    return fitted, judged


# --- Static curves: kinds with several structures, chosen on held-out data, then fitted to all ----


_CHOICE = "structures"


class _Stopped(Exception):
    """Ctrl-C during the choice, with the best fit so far."""

    def __init__(self, structure: Mapping[str, int], fit: Fitted) -> None:
        super().__init__()
        self.structure, self.fit = structure, fit


def identified_as(cls: type[StructuredModel]) -> Callable[[Task], Model]:
    """`identify` for one kind."""

    def identified(task: Task) -> Model:
        structures = cls.structures(task.hidden)
        tried: list[Provenance] = []

        def fit(data: Dataset, structure: Mapping[str, int], progress: Progress | None) -> Fitted:
            options = {**task.orders, **structure, "max_iterations": task.iterations_or_usual}
            return cls.fitted(arrays(data), **options, progress=progress)

        def model(structure: Mapping[str, int], fit: Fitted) -> Model:
            note = {"initial_state": "estimated", "cost_unit": "output unit squared"}
            known = fit_provenance(fit) | note | {"structure": dict(structure), "tried": tried}
            return task.model(cls, fit.model, known)

        part = later_part(task.data, task.validation)
        try:
            chosen, without = _chosen(task, part, structures, fit, tried)
        except _Stopped as stopped:
            raise Interrupted(model(stopped.structure, stopped.fit)) from None
        found = completed(model(chosen, fit(task.data, chosen, task.progress)))
        if part is None or without is None:
            return found
        return judged_without(found, model(chosen, without), task.data, part)

    return identified


def _chosen(
    task: Task,
    part: Split | None,
    structures: tuple[Mapping[str, int], ...],
    fit: Callable[[Dataset, Mapping[str, int], Progress | None], Fitted],
    tried: list[Provenance],
) -> tuple[Mapping[str, int], Fitted | None]:
    """The structure with the least held-out error, or a simpler one that does about as well, and
    its fit to the rest of the data.
    Unless the order was given, one pole less is tried too: a superfluous pole follows trends and
    spoils the steady gain. If the share of a time budget is used up, it is the best so far.
    """
    if part is None or (part.is_given and len(structures) == 1):
        return structures[-1], None
    progress = task.clock.limited(task.progress, SHARES.choice, _CHOICE)
    best = structures[0]
    kept: Fitted | None = None
    least: Errors | None = None

    def tested(structure: Mapping[str, int]) -> tuple[Fitted, Errors] | None:
        try:
            found = fit(part.fitted, structure, progress)
        except FitError:
            return None
        if found.termination == "interrupted":
            if kept is None and found.iterations and not task.clock.over(SHARES.choice, _CHOICE):
                raise _Stopped(structure, found)
            raise KeyboardInterrupt
        errors = errors_of(free_runs(found.model, part), part)
        tried.append({**structure, "held_out_rmse": finite(errors.rmse)})
        return found, errors

    try:
        for structure in structures:
            found = tested(structure)
            if found and (least is None or compared(found[1], least)[0] < math.log(WORTH_IT)):
                best, (kept, least) = structure, found
        if least is not None and task.na > 1 and not task.is_order_given:
            smaller = {**best, "na": task.na - 1}
            found = tested(smaller)
            if found:
                ratio, deviation = compared(found[1], least)
                if ratio <= max(deviation, -math.log(WORTH_IT)):
                    best, kept = smaller, found[0]
    except KeyboardInterrupt:
        if task.clock.over(SHARES.choice, _CHOICE):
            return best, kept
        if kept is None:
            raise
        raise _Stopped(best, kept) from None
    return best, kept
