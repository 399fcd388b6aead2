"""`run_demo`: the paper's experiment on a virtual machine, stage by stage."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any, TypeAlias

from sewfast import __version__, storage
from sewfast.commissioning import Commissioning
from sewfast.commissioning.checkpoint import prepare
from sewfast.commissioning.result import first_taken, numbers_in
from sewfast.control.controller import Controller, paper_controller
from sewfast.control.loop import ClosedLoopRun
from sewfast.errors import SettingError
from sewfast.machine import VirtualMachine
from sewfast.models import Model
from sewfast.plotting import require
from sewfast.progress import shown_in_notebooks
from sewfast.recording import Recording
from sewfast.report import report
from sewfast.report.artefacts import (
    FORMAT,
    VERSION,
    drawing_file,
    prediction_file,
    recording_file,
    run_file,
)
from sewfast.rules import Fopdt
from sewfast.signals import excitation
from sewfast.storage import write_table
from sewfast.tuning.search import TuningResult

from . import loops
from .loops import ExperimentDrive, drive_of

# --- The result folder: complete files only, results.json last ------------------------------------


_FOLDERS = ("recordings", "models", "controllers", "predictions", "runs", "check", "commissioning")


def require_own(folder: Path, *, overwrite: bool) -> None:
    """Raise `SettingError` for a folder with files of anything but an earlier experiment."""
    # of any version: results of older versions are replaced as well
    if overwrite or numbers_in(folder / "results.json").get("format") == FORMAT:
        return
    place = first_taken(folder, (*_FOLDERS, "results.json", "report.html"))
    if place is not None:
        raise SettingError(
            f"{place}: expected a folder of an earlier experiment or one without such files, "
            "there are some and no results.json; choose another folder, or overwrite them "
            "(--overwrite)"
        )


def abandon(folder: Path) -> None:
    """Remove the folder if it is empty."""
    with suppress(OSError):
        folder.rmdir()


def write(
    folder: Path,
    results: Mapping[str, Any],
    *,
    recordings: Mapping[str, Recording],
    models: Mapping[str, Model],
    controllers: Mapping[str, Controller],
    predictions: Mapping[str, Mapping[str, Any]],
    runs: Mapping[tuple[str, str], ClosedLoopRun],
    drawings: Mapping[str, str],
    commissioning: Commissioning | None = None,
) -> None:
    """Replace the artefacts of an earlier experiment. The report refuses a folder without
    `results.json`, so an interruption in between leaves no mixture that looks complete.
    """
    for name in ("results.json", "report.html"):
        (folder / name).unlink(missing_ok=True)
    for name in _FOLDERS:
        (folder / name).mkdir(exist_ok=True)
    for name, recording in recordings.items():
        recording.save(folder / recording_file(name))
    for name, model in models.items():
        model.save(folder / "models" / f"{name}.json")
    for name, controller in controllers.items():
        controller.save(folder / "controllers" / f"{name}.json")
    for name, columns in predictions.items():
        write_table(folder / prediction_file(name), columns)
    for key, loop in runs.items():
        write_table(folder / run_file(*key), loop.columns())
    for name, svg in drawings.items():
        storage.replace(folder / drawing_file(name), svg)
    if commissioning is not None:
        commissioning.save(folder / "commissioning", overwrite=True)
    storage.write(folder / "results.json", FORMAT, VERSION, results)


# --- run_demo -------------------------------------------------------------------------------------


Progress: TypeAlias = Callable[[int, int, str], object]
"""Called with the stages done, their total, and the present stage."""

STAGES = (
    "recording the machine",
    "paper's network",
    "linear models",
    "closed-loop recording",
    "default network",
    "scores",
    "report card",
    "commissioning",
    "paper's gains",
    "writing",
)


class _Clock:
    """Reports progress and measures the time of each stage."""

    def __init__(self, progress: Progress | None) -> None:
        self._progress = progress
        self._began: list[float] = []

    def enter(self, stage: str) -> None:
        if self._progress is not None:
            self._progress(len(self._began), len(STAGES), stage)
        self._began.append(time.perf_counter())

    def finish(self) -> None:
        if self._progress is not None:
            self._progress(len(STAGES), len(STAGES), "done")

    @property
    def seconds(self) -> float:
        return time.perf_counter() - self._began[0]

    def stages(self) -> dict[str, float]:
        ends = [*self._began[1:], time.perf_counter()]
        pairs = zip(STAGES, self._began, ends, strict=False)
        return {stage: end - began for stage, began, end in pairs}


@shown_in_notebooks("demo")
def run_demo(
    out: str | os.PathLike[str],
    seed: int = 0,
    *,
    machine: str = "virtual",
    overwrite: bool = False,
    progress: Progress | None = None,
) -> dict[str, Any]:
    """Carry out the paper's experiment: excite, record, identify, validate, commission, report.

    The machine is served on a port and used like hardware (docs/PROTOCOL.md).

    Parameters
    ----------
    out : path
        Result folder (docs/CONVENTIONS.md); artefacts of an earlier experiment are replaced when
        this one is finished.
    seed : int
        Seed of the random signals, of the networks' initial weights and of the search for gains.
    machine : str
        `virtual`, or `virtual:SEED` for another machine of the type.
    overwrite : bool
        Whether to replace files of these names that are not from an experiment.
    progress : callable(done, total, stage), optional
        Called as each stage begins, and at the end. By default a notebook shows a bar; None shows
        nothing.

    Returns
    -------
    dict
        The values of `results.json`.

    Raises
    ------
    SettingError
        For an unknown machine, an invalid seed, a folder with other files, or if the report's
        packages are missing.
    DataError
        If the folder cannot be created.
    Interrupted
        On Ctrl-C; an earlier experiment in the folder stays unchanged.
    """
    require()
    plant = VirtualMachine.from_name(machine)
    excitation("random", seed)  # refuses an invalid seed before the folder is created
    target = Path(out)
    require_own(target, overwrite=overwrite)
    prepare(target)
    try:
        with drive_of(plant) as drive:
            return _carry_out(target, drive, seed, _Clock(progress))
    except BaseException:
        abandon(target)
        raise


def _carry_out(target: Path, drive: ExperimentDrive, seed: int, clock: _Clock) -> dict[str, Any]:
    """Run the stages one after the other; write the folder at the end."""
    clock.enter("recording the machine")
    recorded = loops.open_loop(drive, seed)
    lo_hi = recorded["chirp_lo_hi"]
    speed = loops.speed_numbers(lo_hi)

    clock.enter("paper's network")
    models = {"paper": loops.paper(recorded, seed)}
    ideal = loops.ideal_cost(drive.machine, seed)

    clock.enter("linear models")
    models["arx_raw"] = loops.arx_raw(recorded)
    models["arx"] = loops.linear(recorded, "arx", loops.PAPER_RECORDS)
    models["oe"] = loops.linear(recorded, "oe", loops.PAPER_RECORDS)

    clock.enter("closed-loop recording")
    fopdt = loops.first_order(recorded["step"])
    coarse = loops.coarse_controller(fopdt, Ts=drive.Ts, counts_per_rev=drive.counts_per_rev)
    recorded["closed_loop"] = loops.closed_loop(drive, coarse)

    clock.enter("default network")
    models["oe_all"] = loops.linear(recorded, "oe", loops.ALL_RECORDS)
    models["neural_oe"] = loops.neural(recorded, seed)

    clock.enter("scores")
    scored = loops.scores(models, recorded)

    clock.enter("report card")
    check, drawings = loops.report_card(models["neural_oe"], recorded["random"])

    clock.enter("commissioning")
    found = loops.commissioned(drive, seed)
    runs = loops.commissioned_runs(found)

    clock.enter("paper's gains")
    paper_runs = loops.paper_runs(drive)

    clock.enter("writing")
    tuned, tuning = found.controller, found.tuning
    assert tuned is not None
    assert tuning is not None
    controllers = {"paper": paper_controller(), "coarse": coarse, "tuned": tuned}
    identification = loops.identification_numbers(models, scored, speed["difference"]["cost_floor"])
    identification["paper"]["cost_ideal"] = ideal
    results = {
        "sewfast": __version__,
        "machine": drive.name,
        "link": drive.numbers(),
        "seed": seed,
        "counts_per_rev": drive.counts_per_rev,
        "speed": speed,
        "identification": identification,
        "check": check,
        **_controller_numbers(fopdt, controllers, tuning),
        "commissioning": found.numbers(),
        "control": loops.control_numbers(runs),
        "paper_gains": loops.paper_numbers(paper_runs) | {"readings": loops.readings()},
        "seconds": clock.seconds,
        "stages": clock.stages(),
    }
    write(
        target,
        results,
        recordings=recorded,
        models=models,
        controllers=controllers,
        predictions=loops.predictions(scored),
        runs=runs | paper_runs,
        drawings=drawings,
        commissioning=found,
    )
    report(target)
    clock.finish()
    return results


def _controller_numbers(
    fopdt: Fopdt, controllers: dict[str, Controller], tuning: TuningResult
) -> dict[str, Any]:
    """First-order fit, gains and tuning, for `results.json`."""
    names = ("K", "T", "L", "offset", "u_low", "u_high", "fit_percent")
    ratio = fopdt.L / fopdt.T
    return {
        "fopdt": {name: getattr(fopdt, name) for name in names},
        "table_1": {
            "ratio": ratio,
            "ratio_used": min(max(ratio, 0.1), 1.0),
            "in_range": 0.1 <= ratio <= 1.0,
        },
        "gains": {name: _gains(c) for name, c in controllers.items()},
        "limits": {"u_min": tuning.controller.u_min, "u_max": tuning.controller.u_max},
        "tuning": {
            "evaluations": tuning.evaluations,
            "cost": tuning.cost,
            "start_cost": tuning.start_cost,
            "termination": tuning.termination,
        },
    }


def _gains(controller: Controller) -> dict[str, float | None]:
    """Gains in standard form, null for no integral action."""
    values = controller.to_dict()
    gains = controller.gains.to("standard").to_dict()
    kept = {name: gains[name] for name in ("Kp", "Ti", "Td")}
    kept["Ti"] = None if kept["Ti"] == float("inf") else kept["Ti"]
    return kept | {name: values[name] for name in ("alpha", "beta", "N", "filter_samples")}
