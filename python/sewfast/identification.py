"""`identify`: from a data set to a model."""

from __future__ import annotations

import os
from collections.abc import Callable
from typing import Literal, TypeAlias

from . import recipes
from .dataset import Dataset, require_dataset
from .errors import DataError, SettingError
from .evidence import remembered
from .models import Model
from .models.base import INIT
from .recipes import Progress, Task

Kind: TypeAlias = Literal["auto", "arx", "iv", "oe", "neural_oe", "neural-oe"]

_RECIPES: dict[str, Callable[[Task], Model]] = {
    "auto": recipes.auto,
    "arx": recipes.arx,
    "iv": recipes.iv,
    "oe": recipes.oe,
    "neural_oe": recipes.neural_oe,
    "paper": recipes.paper,
}
_STARTS = {"paper": 8}
_USUAL_STARTS = 4


def identify(
    data: Dataset,
    *,
    model: Kind = "auto",
    preset: Literal["paper"] | None = None,
    na: int = 2,
    nb: int = 2,
    nk: int = 1,
    hidden: int = 8,
    starts: int | None = None,
    seed: int = 0,
    iterations: int = 100,
    validation: Dataset | None = None,
    threads: int | None = None,
    progress: Progress | None = None,
) -> Model:
    """Identify a model from recordings.

    Parameters
    ----------
    data : Dataset
        Training data: inputs complete; outputs that are NaN were not measured and have no weight.
    model : {"auto", "arx", "iv", "oe", "neural_oe"}
        `arx`: least squares of the one-step error. `iv`: refined instrumental variables, which
        measurement noise does not bias. `oe`: linear output error. `neural_oe`: the
        network, trained in free run from the linear output-error model. `auto`: `oe` or
        `neural_oe`, whichever has the smaller free-run error on data not trained on.
    preset : "paper" or None
        The paper's network (docs/CONVENTIONS.md): no linear start, fixed scaling and orders.
    na, nb, nk : int
        Past outputs, past inputs and delay [samples] in the regressor.
    hidden : int
        Hidden units of the network.
    starts : int or None
        Random starts of the network's training; the best one is kept. None: 4, for the preset
        `paper`, which has no linear model to start from, 8.
    seed : int
        Of the starts. A seed gives the same model at any number of threads.
    iterations : int
        At most this many per start.
    validation : Dataset or None
        Data to select on: when training stops, which start, which kind. None holds out two of
        eight blocks of every experiment; these are learned from in the end.
    threads : int or None
        None uses every core.
    progress : callable(done, total, best_cost) or None
        Called from the calling thread now and then, once through for each stage.

    Returns
    -------
    Model
        With its provenance in `training`.

    Raises
    ------
    DataError
        Where an input is NaN, data never move, or are too short for the orders.
    SettingError
        Where a setting is out of its range or contradicts another.
    FitError
        Where no usable model was found.
    Interrupted
        On Ctrl-C; `best` is the best model so far.

    Notes
    -----
    Output-error identification: Ljung, *System Identification*, 2nd ed., section 4.2; the network
    and its training: paper, Eq. 2 to 4.
    """
    kind = str(model).replace("-", "_")
    if kind not in _RECIPES or kind == "paper":
        raise SettingError(f"model: expected auto, arx, iv, oe or neural-oe, received {model!r}")
    if preset is not None:
        kind = _preset(preset, kind, (na, nb, nk, hidden))
    starts = _STARTS.get(kind, _USUAL_STARTS) if starts is None else starts
    threads = _cores() if threads is None else threads
    task = Task(data, validation, na, nb, nk, hidden, starts, seed, iterations, threads, progress)
    _require_settings(task)
    _require_data(task, kind)
    return remembered(_RECIPES[kind](task), data)


def _preset(preset: str, kind: str, orders: tuple[int, ...]) -> str:
    if preset != "paper":
        raise SettingError(f"preset: expected 'paper' or none, received {preset!r}")
    if kind not in ("auto", "neural_oe"):
        raise SettingError(
            f"preset 'paper' is a network: expected model neural-oe, received {kind}"
        )
    if orders != (2, 2, 1, 8):
        raise SettingError(
            "preset 'paper' fixes na = 2, nb = 2, nk = 1, hidden = 8; received "
            f"{', '.join(map(str, orders))}; leave them out, or leave out the preset"
        )
    return "paper"


def _require_settings(task: Task) -> None:
    least = {"na": 1, "nb": 1, "nk": 0, "hidden": 1, "starts": 1, "seed": 0}
    least |= {"iterations": 1, "threads": 1}
    most = {"na": 100, "nb": 100, "nk": 1000, "hidden": 1000, "seed": 2**64 - 1}
    for name, low in least.items():
        value, high = getattr(task, name), most.get(name, 1_000_000)
        if isinstance(value, bool) or not isinstance(value, int) or not low <= value <= high:
            raise SettingError(
                f"{name}: expected a whole number from {low} to {high}, received {value!r}"
            )


def _require_data(task: Task, kind: str) -> None:
    require_dataset(task.data, "data")
    task.data.require_measured()
    task.data.require_excited()
    _require_enough(task, kind)
    if kind == "paper" and task.data.n_inputs != 1:
        raise DataError(f"preset 'paper' has one input, the data have {task.data.n_inputs}")
    if task.validation is not None:
        require_dataset(task.validation, "validation")
        task.validation.require_measured()
        Dataset.concat([task.data, task.validation])
        _require_longer(task.validation, INIT)


def _require_longer(data: Dataset, least: int) -> None:
    for e in data.experiments:
        if len(e) - e.unmeasured <= least:
            raise DataError(
                f"{e.name} [{e.range_text}]: expected more than {least} samples, received "
                f"{e.counted}; record longer, lower the orders, or leave this experiment out"
            )


def _require_enough(task: Task, kind: str) -> None:
    """Every experiment holds whole regressors; all together more samples than parameters."""
    lag = max(task.na, task.nk + task.nb - 1)
    _require_longer(task.data, lag + INIT)
    regressors = task.na + task.nb * task.data.n_inputs
    parameters = regressors + 1
    if kind in ("neural_oe", "paper"):
        parameters += task.hidden * (regressors + 2)
    usable = sum(len(e) - e.unmeasured - lag for e in task.data.experiments)
    if usable < 2 * parameters:
        raise DataError(
            f"{task.data.source}: expected at least {2 * parameters} samples for {parameters} "
            f"parameters, received {usable}; record longer, or lower the orders"
        )


def _cores() -> int:
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1
