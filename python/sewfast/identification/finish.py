"""From the chosen candidate to the model: all starts, all data, one model or an ensemble."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from .. import _core
from ..models.ensemble import EnsembleCore
from .candidate import Candidate, judged, members
from .folds import Split, held_out_error
from .plan import FINAL_OPERATIONS
from .search import Search
from .training import Structure, Training, train

ENOUGH_TO_CHOOSE_BY = 2_000
"""Held-out samples from which on a single best start may be taken instead of the median."""
ABOUT_AS_WELL = 1.1
"""More starts are taken although their error is this much larger: a short tail is noisy."""

LEAST_AGREEING = 3
"""So many starts have to agree where held-out data are too short to tell the best one."""
BY_FAR = 0.2
"""Part of the linear model's error below which the network wins by far."""


@dataclass(frozen=True)
class Finished:
    """What becomes the model.

    Attributes
    ----------
    cores : tuple of NeuralSS
        One, or the members of a median.
    candidate : Candidate
        Before anything was learned from the held-out part.
    was_refitted : bool
        Whether the held-out part was learned from in the end.
    """

    cores: tuple[_core.NeuralSS, ...]
    candidate: Candidate
    was_refitted: bool


def finish(search: Search, best: Candidate) -> Finished:
    """Train the chosen structure with all its starts, then on all data."""
    final = _finally_trained(search, best)
    cores = _one_or_all(search, final)
    refitted = _refitted(search, final.structure, cores)
    return Finished(tuple(refitted or cores), final, bool(refitted))


def _finally_trained(search: Search, best: Candidate) -> Candidate:
    """More starts, more iterations and more data, as long as there is time and it helps."""
    task, plan, split_ = search.task, search.plan, search.split
    if task.clock.over():
        return best
    training = search.training(best.structure, plan.final_starts, plan.final_iterations)
    training = training.affordable(best.structure, FINAL_OPERATIONS)
    trained = judged(best.structure, train(task, best.structure, training), search.trial)
    final = trained if trained.error <= ABOUT_AS_WELL * best.error else best
    if len(split_.fitted) == len(search.trial.fitted) or task.clock.over():
        return final
    begun = final.members[: plan.final_starts]
    everything = Training(
        split_.fitted,
        split_.held,
        None,
        len(begun),
        plan.all_iterations,
        initial=begun,
        memory=search.memory(split_.fitted, best.structure.output),
    )
    everything = everything.affordable(best.structure, FINAL_OPERATIONS)
    whole = judged(best.structure, train(task, best.structure, everything), split_)
    before = judged(best.structure, final.starts, split_)
    return whole if whole.error <= before.error else before


def _one_or_all(search: Search, final: Candidate) -> list[_core.NeuralSS]:
    """The best start where held-out data are long enough to tell it, else all that count."""
    cores = final.members
    if len(cores) < 3:
        return cores[:1]
    if search.split.scored < ENOUGH_TO_CHOOSE_BY:
        return cores
    alone = held_out_error(cores[0], search.split)
    together = held_out_error(EnsembleCore(tuple(cores), "median"), search.split)
    return cores[:1] if alone <= together else cores


def _refitted(
    search: Search, structure: Structure, cores: Sequence[_core.NeuralSS]
) -> list[_core.NeuralSS]:
    """A few more iterations on all data, the held-out part included; none where time is up."""
    task = search.task
    if search.split.is_given or task.clock.over():
        return []
    training = Training(
        task.data,
        None,
        None,
        len(cores),
        search.plan.refit_iterations,
        initial=cores,
        memory=search.memory(task.data, structure.output),
    )
    starts = train(task, structure, training)
    if len(starts) < len(cores) or task.clock.over() or not any(s.is_sound for s in starts):
        return []
    kept = members(starts)
    return [] if len(kept) < min(len(cores), LEAST_AGREEING) else [s.model for s in kept]


# --- the network against the linear model --------------------------------------------------------


def ratios(search: Search, best: Candidate, order: int, worth: float) -> list[float]:
    """The network's error over the linear model's on every fold, the newest first.

    Forward chaining: both are fitted again to what comes before each fold, and the worst of the
    starts that count stands for the network, so that a win by luck of the start is none. A fold
    with too few samples for the network says nothing. Where the median wins the newest fold by far
    nothing else is asked, and nothing after a fold that is lost (not below `worth`).
    """
    linear = search.linear_errors[order]
    newest = _ratio(best.error, linear[0])
    if newest < BY_FAR:
        return [newest]
    found = [_ratio(_worst(best, search.trial), linear[0])]
    for fold in range(1, len(search.folds)):
        if found[-1] >= worth or search.task.clock.over():
            break
        if search.is_affordable(best.structure, fold):
            tried = search.trial_on(best.structure, fold)
            found.append(_ratio(_worst(tried, search.folds[fold]), linear[fold]))
    return found


def _worst(candidate: Candidate, fold: Split) -> float:
    errors = (held_out_error(core, fold) for core in candidate.members)
    return max(candidate.error, *errors, 0.0)


def _ratio(error: float, linear: float) -> float:
    return error / linear if linear > 0.0 else 1.0
