"""`identify`: from a data set to a model."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Literal

from ..arrays import require_whole
from ..dataset import Dataset, diagnose, require_dataset
from ..dataset.experiment import in_effect
from ..dataset.faults import Fault, sound
from ..dataset.pieces import LARGEST_FITTED, require_fittable, require_sane, thinned
from ..dynamic_model import INIT
from ..errors import DataError, FitError, Interrupted, SettingError
from ..evidence import with_training_evidence
from ..kinds import KINDS, Kind, spelled
from ..models import Model
from ..models.files import STRUCTURED
from ..progress import shown_in_notebooks
from ..threads import Workers, available, require_workers
from ..validation import doubling
from . import further, grey_box, lagged, linear, mixture
from .blocks import unseen
from .folds import (
    TEXTS,
    UNSEEN_DATA,
    Split,
    tried,
    unstable_verdict,
    verdict,
    what_to_record,
)
from .outputs import OUTPUTS
from .rest import for_loops
from .task import SHARES, Clock, Progress, Provenance, Task, with_provenance
from .training import Structure

_KINDS: dict[str, Callable[[Task], Model]] = {
    "auto": mixture.searched,
    "arx": linear.arx,
    "iv": linear.iv,
    "oe": linear.oe,
    "grey_box": grey_box.grey_box,
    "neural_oe": lagged.neural_oe,
    "neural_ss": partial(mixture.searched, wants_network=True),
    "paper": lagged.paper,
    **{cls.kind: lagged.identified_as(cls) for cls in STRUCTURED},
}
_FIT = "iterations of the fit"
NETWORKS = ("neural_oe", "neural_ss")
_SEARCHED = ("auto", "neural_ss")
"""Kinds without given lags: their structure is searched."""
_PAPER = {"na": 2, "nb": 2, "nk": 1, "hidden": 8}


@shown_in_notebooks("identify")
def identify(
    data: Dataset,
    *,
    model: Kind | Model = "auto",
    preset: Literal["paper"] | None = None,
    na: int | None = None,
    nb: int | None = None,
    nk: int | None = None,
    nx: int | None = None,
    hidden: int | None = None,
    output: Literal["linear", "saturation", "abs"] | None = None,
    starts: int | None = None,
    seed: int = 0,
    iterations: int | None = None,
    validation: Dataset | None = None,
    threads: int | None = None,
    workers: Workers | None = None,
    time_budget: float | None = None,
    select: bool = True,
    progress: Progress | None = None,
) -> Model:
    """Identify a model from recordings.

    Without further settings many structures are tried (docs/choosing-a-model.md), and the model
    says why it was chosen and whether it is good enough: `print(model)`, `model.training["choice"]`
    and `["verdict"]`. `model.alternatives` has the next choices.

    Parameters
    ----------
    data : Dataset
        Training data: inputs complete; outputs that are NaN were not measured and have no weight.
        With weights, the minimised costs and the errors on held-out data are weighted
        (a sample of weight 0 counts as not measured); starts, scalings, output functions, the guard
        and the evidence stored with the model ignore them. `iv` takes no weights between 0 and the
        largest.
    model : {"auto", "arx", "iv", "oe", "grey_box", "neural_oe", "neural_ss"} or Model
        `arx`: least squares of the one-step error. `iv`: refined instrumental variables, which
        measurement noise does not bias. `oe`: linear output error. `grey_box`: the equations of a
        motor from its command to its speed, with a network of `hidden` units beside them (None: 4
        units if they are credibly better on held-out data). `neural_oe`: the lagged network,
        trained in free run from the linear output-error model. `neural_ss`: the state-space
        network. `auto`: one of `oe`, `neural_ss`, `neural_oe` and, for speeds, `grey_box`, by the
        free-run error on held-out data; on little data the midmean of several models, an
        `Ensemble`. A kind requested by name is always returned. A model is trained further on
        these data, in its own structure.
    preset : "paper" or None
        The paper's network (docs/CONVENTIONS.md): no linear start, fixed scaling and orders.
    na, nb : int or None
        Past outputs and past inputs in the regressor of a lagged model; None: 2, but `na` = 1 for a
        Hammerstein-Wiener model if that does about as well.
    nk : int or None
        Delay [samples]. None: 1 for a lagged model, but for `oe` the best one if the inputs move
        once only; a search uses 1 unless the data suggest another delay. A plant of a control loop
        needs 1 or more.
    nx : int or None
        States of `neural_ss`; None: searched.
    hidden : int or None
        Hidden units of a network; None: searched, 8 for `neural_oe`.
    output : {"linear", "saturation", "abs"} or None
        Output function of `neural_ss`; None: `linear`, or another if the data suggest it and it is
        better.
    starts : int or None
        Random starts of a network's training. None: by the amount of data; 4 for `neural_oe`, 8
        for the preset `paper`, which has no linear model to start from.
    seed : int
        Seed of the starts. It gives the same model at any number of threads and with any workers,
        unless a time budget ends the work.
    iterations : int or None
        At most this many per start; None: by the amount of data, 100 for a lagged model.
    validation : Dataset or None
        Data for selection only, not for fitting. None holds out blocks in turn (of
        `neural_oe` two of eight).
    threads : int or None
        None uses every core, or as many as the environment variable SEWFAST_THREADS allows.
    workers : executor or None
        Where the starts of `auto` and `neural_ss` are trained: a `concurrent.futures.Executor`, a
        Dask client, or anything with `map(function, jobs)`. None: threads of this process.
    time_budget : float or None
        Time for everything, including linear fits and evidence [s]; the best model so far is
        returned, with a note on what was cut short.
    select : bool
        Whether data are held out to stop the training of `neural_oe` and to choose its weight
        decay. False trains on all data to the last iteration, for comparisons of methods.
    progress : callable(done, total, best_cost) or None
        Called from the calling thread from time to time, counting each stage from its start.
        If left out, a notebook shows a progress bar; None shows nothing.

    Returns
    -------
    Model
        Its provenance is in `training`.

    Raises
    ------
    DataError
        If an input is NaN, data never move, or are too short for the orders; if the output is the
        input times a number, or input and output are exchanged.
    SettingError
        If a setting is out of its range or contradicts another.
    FitError
        If no usable model was found.
    Interrupted
        On Ctrl-C; `best` is the best model so far.

    Notes
    -----
    Output-error identification: Ljung, *System Identification*, 2nd ed., section 4.2; the lagged
    network and its training: paper, Eq. 2 to 4; the state-space network: M. Schoukens, arXiv
    2103.14516.
    """
    if isinstance(model, Model):
        _require_alone(na=na, nb=nb, nk=nk, nx=nx, hidden=hidden, output=output, preset=preset)
        kind = "further"
    else:
        kind = str(model).replace("-", "_")
        if kind not in _KINDS or kind == "paper":
            raise SettingError(
                f"model: expected {', '.join(map(spelled, KINDS))} or a model to train further, "
                f"received {model!r}"
            )
    if preset is not None:
        kind = _preset(preset, kind, {"na": na, "nb": nb, "nk": nk, "hidden": hidden})
        starts = 8 if starts is None else starts
    _require_settings(
        na=na, nb=nb, nk=nk, nx=nx, hidden=hidden, starts=starts, seed=seed,
        iterations=iterations, threads=threads,
    )  # fmt: skip
    _require_meaning(kind, na=na, nb=nb, nk=nk, nx=nx, output=output, time_budget=time_budget)
    require_workers(workers)
    if progress is not None and not callable(progress):
        raise SettingError(
            name="progress", expected="a function of done, total and best cost",
            received=repr(progress), remedy="or leave it out",
        )  # fmt: skip
    if not isinstance(select, bool):
        raise SettingError(f"select: expected True or False, received {select!r}")
    clock = Clock(time_budget)
    task = Task(
        data=_in_effect(data, "data"),
        validation=None if validation is None else _in_effect(validation, "validation"),
        **{name: n for name, n in (("na", na), ("nb", nb)) if n is not None},
        nk=nk,
        nx=nx,
        hidden=hidden,
        output=output,
        starts=starts,
        seed=seed,
        iterations=iterations,
        threads=available() if threads is None else threads,
        progress=progress if kind in _SEARCHED else clock.limited(progress, SHARES.fit, _FIT),
        workers=workers,
        clock=clock,
        select=select,
        is_order_given=na is not None,
    )
    _require_data(task, kind)
    used, faults = sound(task.data)
    if used is not task.data:
        task = replace(task, data=used)
        _require_data(task, kind)
    # a budget buys models: whether the record is sound has to be known in any case
    clock.begin()
    if isinstance(model, Model):
        found = _within_budget(partial(further.trained, model), task)
        if found.core is model.core:
            # stopped before its first step: it keeps the evidence from its own data
            return _with_losses(found, clock)
    else:
        asked = _KINDS[kind]
        if kind == "auto" and any(f.kind == "unstable" for f in faults):
            asked = _unstable
        found = _within_budget(asked, task)
    said = [*found.training.get("notes", []), *(f.warning for f in faults if f.kind not in _JUDGED)]
    if said:
        found = with_provenance(found, {"notes": said})
    try:
        if "verdict" not in found.training:
            own = _verdict(found, task)
            found = with_provenance(found, {"verdict": own})
        found = _judged_by(found, faults)
        excerpt = _excerpt(found, task.data, clock)
        if not clock.can_close:
            clock.lose("evidence")
        else:
            found = with_training_evidence(found, excerpt)
        return for_loops(_with_losses(found, clock), excerpt)
    except KeyboardInterrupt:
        raise Interrupted(found) from None


def seeded(
    data: Dataset, *, iterations: int | None = None, progress: Progress | None = None
) -> Callable[[int, Progress | None], Model]:
    """A function of a seed and a progress callback that trains one network.
    Each network equals that of `identify(data, model="neural_oe", starts=1, select=False)` bit by
    bit, without evidence and verdict. The linear model at which all start is fitted here, once,
    which takes longer than three networks; `progress` is that of this fit. `iterations` limits the
    linear fits and each network. Raises the errors of `identify`.
    """
    task = Task(
        _in_effect(data, "data"), starts=1, iterations=iterations, progress=progress, select=False
    )
    _require_data(task, "neural_oe")
    networks = lagged.Networks.of(task)

    def train(seed: int, progress: Progress | None = None) -> Model:
        own = replace(task, seed=seed, progress=progress, began=time.perf_counter())
        return replace(networks, task=own).unselected()

    return train


def _in_effect(data: Dataset, what: str) -> Dataset:
    require_dataset(data, what)
    return in_effect(data)


def _unstable(task: Task) -> Model:
    """The plant that a loop held, or what the search finds: if its poles are stable, or if the
    record is that of a joint, whose friction a linear model can take for an unstable pole.
    """
    if grey_box.is_joint(task):
        return mixture.searched(task)
    return linear.held_by_a_loop(task) or mixture.searched(task)


def _within_budget(identified: Callable[[Task], Model], task: Task) -> Model:
    """The model, or the best one when the time is up; Ctrl-C goes on to the caller."""
    too_short = FitError(
        f"time_budget: expected time for at least one iteration, received "
        f"{task.clock.budget} s; give more, fewer data, or leave the budget out"
    )
    try:
        return identified(task)
    except Interrupted as e:
        if not task.clock.over(SHARES.fit, _FIT):
            raise
        # without a step these are still their linear start
        begins_linear = e.best.kind in (*NETWORKS, *(cls.kind for cls in STRUCTURED))
        if begins_linear and e.best.training.get("iterations") == 0:
            raise too_short from None
        best: Model = e.best
        return best
    except KeyboardInterrupt:
        if not task.clock.over(SHARES.fit, _FIT):
            raise
        raise too_short from None


def _with_losses(model: Model, clock: Clock) -> Model:
    """The model with a note on what a time budget cut short, and the grade that it has."""
    if not clock.lost:
        return model
    grade = model.training.get("verdict", {}).get("grade", "unknown")
    note = (
        f"the time budget cut short: {', '.join(clock.lost)}; the result, graded {grade}, depends "
        "on the speed of the machine and on what else runs on it"
    )
    record = {"seconds": clock.budget, "lost": list(clock.lost), "grade": grade}
    notes = [*model.training.get("notes", []), note]
    return with_provenance(model, {"notes": notes, "time_budget": record})


def _excerpt(model: Model, data: Dataset, clock: Clock) -> Dataset:
    """The data for the evidence stored with a model; fewer of them if time is short."""
    # samples times parameters whose evidence takes a second of a slow processor
    evidence_rate, least_evidence = 2.5e5, 2_000
    if clock.budget is None:
        return data
    left = max(0.0, clock.left(clock.budget))
    width = max(
        (len(m.core.theta) for m in model.members or (model,) if m.kind[:2] == "ne"), default=10
    )
    return thinned(data, max(least_evidence, round(left * evidence_rate / width)))


_JUDGED = ("unstable", "late_input", "changes")
"""Faults of a record that the verdict names, and the notes so need not."""


def _judged_by(model: Model, faults: Sequence[Fault]) -> Model:
    """The model with a verdict that is no better than its record allows."""
    own: Provenance = model.training["verdict"]
    for fault in faults:
        grade, evidence = own["grade"], own["text"].partition(": ")[2]
        if fault.kind in ("late_input", "changes"):
            # it may fit, with a delay that the plant does not have, or one part
            grade = "poor" if grade in ("good", "fair") else grade
            text = f"{TEXTS[grade]}: {fault.text} ({evidence})"
        elif fault.kind == "unstable" and grade in ("poor", "useless") and doubling(model) is None:
            # a free run that explains the record would show that the pole is none of the plant's
            grade = "useless"
            text = f"useless: {fault.text}, and no free run describes it ({evidence})"
        else:
            continue
        own = {**own, "grade": grade, "text": text, "next": [fault.remedy]}
    return with_provenance(model, {"verdict": own})


def _verdict(model: Model, task: Task) -> Provenance:
    """The verdict on a kind requested by name, on validation data; of a linear model else on
    blocks of the record, each by a fit to the rest. (The others have judged themselves by what they
    held out.) Else it is that on the training data, which hardly prove a model wrong: "fair" at
    best, unless it is a given model that was trained further.
    """
    data, validation = task.data, task.validation
    is_linear, trial = model.kind in ("arx", "iv", "oe"), None
    part = Split(data, validation or data, is_given=validation is not None)
    where = UNSEEN_DATA if part.is_given else "its own training data"
    if doubling(model) is not None:
        return unstable_verdict(model, part, where)
    if is_linear and not part.is_given:
        orders = model.orders
        alike = replace(task, na=orders["na"], nb=orders["nb"], nk=orders["nk"])
        trial = unseen(model, alike, _KINDS[model.kind])
        where = where if trial is None else UNSEEN_DATA
    found = verdict(model, data, trial or tried(model, part), where=where)
    is_seen = where != UNSEEN_DATA and not model.training.get("trained_further")
    if is_seen and found["grade"] == "good":
        found["grade"] = "fair"
        measured = found["text"].partition(": ")[2]
        found["text"] = (
            f"{TEXTS['fair']}: judged by no data but those that it was fitted to; {measured}"
        )
        found["next"] = ["give validation data", *what_to_record(data)]
    if is_linear and found["grade"] != "useless":
        slowest, longest = linear.time_constant(model.core), max(len(e) for e in data.experiments)
        # a real integrator is not a superfluous pole
        if slowest > linear.UNSEEN * longest and diagnose(data).find("integrator") is None:
            found["grade"] = "poor"
            measured = found["text"].partition(": ")[2]
            found["text"] = (
                f"{TEXTS['poor']}: its slowest pole takes {slowest * data.Ts:.3g} s, longer than "
                f"the record can show, so that its steady gain is a guess; {measured}"
            )
            found["next"].insert(0, "lower na, or leave model out and let the search choose")
    return found


def _preset(preset: str, kind: str, orders: Mapping[str, int | None]) -> str:
    if preset != "paper":
        raise SettingError(f"preset: expected 'paper' or none, received {preset!r}")
    if kind not in ("auto", "neural_oe"):
        raise SettingError(
            f"preset 'paper' is a network: expected model neural-oe, received {kind}"
        )
    other = {k: v for k, v in orders.items() if v not in (None, _PAPER[k])}
    if other:
        raise SettingError(
            "preset 'paper' fixes na = 2, nb = 2, nk = 1, hidden = 8; received "
            f"{', '.join(f'{k} = {v}' for k, v in other.items())}; leave them out, or leave out "
            "the preset"
        )
    return "paper"


def _require_alone(**settings: object) -> None:
    """Refuse settings of the structure for a model that is trained further."""
    for name, value in settings.items():
        if value is not None:
            raise SettingError(
                f"{name}: a model that is trained further keeps its own structure, received "
                f"{value!r}; leave it out, or name a kind of model"
            )


def _require_settings(**settings: object) -> None:
    least = {"nk": 0, "seed": 0}
    most = {"na": 100, "nb": 100, "nk": 1000, "nx": 100, "hidden": 1000, "seed": 2**64 - 1}
    for name, value in settings.items():
        if value is None and name != "seed":
            continue
        require_whole(name, value, least.get(name, 1), most.get(name, 1_000_000))


def _require_meaning(
    kind: str,
    *,
    na: int | None,
    nb: int | None,
    nk: int | None,
    nx: int | None,
    output: str | None,
    time_budget: float | None,
) -> None:
    """Refuse settings that this kind of model does not have."""
    searched = kind in _SEARCHED
    of_the_other = {"na": na, "nb": nb} if searched else {"nx": nx, "output": output}
    if kind == "grey_box":
        of_the_other = {"na": na, "nb": nb, "nk": nk, "nx": nx, "output": output}
    for name, value in of_the_other.items():
        if value is not None:
            remedy = "give nx, or name a lagged model" if searched else "give na, nb and hidden"
            remedy = "give hidden, or name another kind" if kind == "grey_box" else remedy
            raise SettingError(f"{name}: model {kind} has none, received {value!r}; {remedy}")
    if output is not None and output not in OUTPUTS:
        raise SettingError(f"output: expected one of {', '.join(OUTPUTS)}, received {output!r}")
    if time_budget is None:
        return
    is_number = isinstance(time_budget, (int, float)) and not isinstance(time_budget, bool)
    if not is_number or not 0.0 < time_budget < math.inf:
        raise SettingError(
            f"time_budget: expected seconds above 0, received {time_budget!r}; or leave it out"
        )


def _require_data(task: Task, kind: str) -> None:
    """Require sound data with whole regressors, and more samples than parameters."""
    data, inputs = task.data, task.data.n_inputs
    data.require_measured()
    data.require_excited()
    require_fittable(data)
    if kind == "neural_ss":
        smallest = Structure(task.nx or 1, 1, task.hidden or 2, 0.0)
        lag, parameters = task.na, smallest.parameters(inputs)
    else:
        lag = max(task.na, task.orders["nk"] + task.nb - 1)
        regressors = task.na + task.nb * inputs
        parameters = regressors + 1
        if kind in ("neural_oe", "paper"):
            parameters += task.hidden_or_usual * (regressors + 2)
    _require_longer(data, lag + INIT)
    usable = sum(len(e) - e.unmeasured - lag for e in data.experiments)
    if usable < 2 * parameters:
        raise DataError(
            f"{data.source}: expected at least {2 * parameters} samples for {parameters} "
            f"parameters, received {usable}; record longer, or lower the orders"
        )
    if kind == "paper" and inputs != 1:
        raise DataError(f"preset 'paper' has one input, the data have {inputs}")
    if task.validation is not None:
        task.validation.require_measured()
        require_sane(task.validation, LARGEST_FITTED)
        Dataset.concat([data, task.validation])
        _require_longer(task.validation, INIT)


def _require_longer(data: Dataset, least: int) -> None:
    for e in data.experiments:
        if len(e) - e.unmeasured <= least:
            raise DataError(
                f"{e.name} [{e.range_text}]: expected more than {least} samples, received "
                f"{e.counted}; record longer, lower the orders, or leave this experiment out"
            )
