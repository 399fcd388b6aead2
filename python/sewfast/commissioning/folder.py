"""The folder of a commissioning, and its numbers as JSON."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from .. import __version__, storage
from ..analysis.analysis import NUMBERS as ANALYSIS
from ..control.controller import Controller
from ..control.loop import ClosedLoopRun
from ..errors import DataError, SettingError
from ..report.commissioned import FORMAT, NUMBERS, VERSION, run_file
from ..writers import write_table
from .slow import Thinning
from .taken import clear, prepare, require_repeatable
from .verification import Comparison

if TYPE_CHECKING:
    from .result import Commissioning


# --- The numbers of a commissioning as JSON values ------------------------------------------------


_FOPDT = ("K", "T", "L", "offset", "u_low", "u_high", "fit_percent")


def numbers(c: Commissioning) -> dict[str, Any]:
    """`commissioning.json`; null where there is nothing yet."""
    return {
        "machine": c.machine,
        "verdict": c.verdict,
        "stage": c.stage,
        "reason": c.reason,
        "seconds": dict(c.seconds),
        "recordings": {name: len(r) * r.Ts for name, r in c.recordings.items()},
        "motion": None if c.motion is None else dict(vars(c.motion)),
        "fopdt": None if c.fopdt is None else {n: getattr(c.fopdt, n) for n in _FOPDT},
        "small_signals": _small_signals(c),
        "acceleration_rpm_per_s": c.acceleration,
        "turn_load_v_rms": None if c.turn_load is None else c.turn_load.rms,
        "models": {"members": 0 if c.models is None else len(c.models.members)}
        | {"levels_rmse_rpm": list(c.rmse), "kind": _kind(c)},
        "rival": None
        if c.rival is None
        else {"order": c.rival.model.orders["na"], "levels_rmse_rpm": c.rival.rmse},
        "second_opinion": _opinion(c),
        "simulated_at_s": c.sample_time,
        "notes": list(c.notes),
        "controllers": {
            name: _gains(controller)
            for name, controller in (("first", c.first), ("tuned", c.controller))
            if controller is not None
        },
        "tuning": None
        if c.tuning is None
        else {
            "evaluations": c.tuning.evaluations,
            "cost": c.tuning.cost,
            "start_cost": c.tuning.start_cost,
            "termination": c.tuning.termination,
            "constraints": str(c.tuning.constraints),
        },
        "cost": None if c.cost is None else dict(vars(c.cost)),
        "met": None if c.met is None else dict(c.met),
        "evidence": {
            name: {"verdict": judged.verdict, "lines": [x.to_json() for x in judged.lines]}
            for name, judged in (("report card", c.card), ("closed loops", c.judgement))
            if judged is not None
        },
        "predicted_cost": c.predicted_cost,
        "measured_cost": c.measured_cost,
        "references": {x.reference: _comparison(x) for x in c.comparisons},
    }


def _small_signals(c: Commissioning) -> dict[str, Any] | None:
    """Order and first-order description of the machine about a working speed; its resonance."""
    found = c.small_signal
    if found is None:
        return None
    fopdt, resonance = found.fopdt, found.resonance
    return {
        "order": found.model.orders["na"],
        "fopdt": None if fopdt is None else {n: getattr(fopdt, n) for n in ("K", "T", "L")},
        "resonance": None if resonance is None else dict(vars(resonance)),
    }


def _kind(c: Commissioning) -> str | None:
    return None if c.models is None else c.models.members[0].kind


def _opinion(c: Commissioning) -> dict[str, Any] | None:
    """What the gains tuned on models, rival and both cost on either; null where a loop diverges."""
    opinion = None if c.tuning is None else c.tuning.opinion
    if opinion is None:
        return None
    on_models, on_rival = ([x if np.isfinite(x) else None for x in row] for row in opinion.costs)
    return {"on_models": on_models, "on_rival": on_rival, "taken": opinion.pick}


def _gains(controller: Controller) -> dict[str, Any]:
    """As in its file, in standard form, infinity as null."""
    return {**controller.to_dict(), "gains": controller.gains.to("standard").to_dict()}


def _comparison(c: Comparison) -> dict[str, Any]:
    return {
        "predicted": run_numbers(c.predicted),
        "measured": None if c.measured is None else run_numbers(c.measured),
        "apart_rmse_rpm": c.apart,
        "disagreement_rmse_rpm": c.disagreement,
    }


def run_numbers(found: ClosedLoopRun) -> dict[str, float | None]:
    """What a run's metrics are called in result files."""
    told = found.metrics()
    return {
        "rmse_rpm": told["rmse"],
        "max_abs_rpm": told["max_abs"],
        "rise_time_ms": told["rise_time_ms"],
        "overshoot_percent": told["overshoot_percent"],
        "effort_v": told["u_rms"],
        "chatter_v": told["du_rms"],
        "saturated": told["saturated"],
    }


# --- The folder of a commissioning: every artefact written whole, commissioning.json last ---------


_FOLDERS = ("recordings", "models", "controllers", "runs", "analysis")
_SHORT = 5.0
"""References of up to this are analysed on [s]."""


def require_own(folder: Path, *, overwrite: bool) -> None:
    """Refuse a folder whose files would be lost and are of no commissioning of a virtual machine.

    Raises
    ------
    SettingError
    """
    if not overwrite:
        require_repeatable(folder)
        _require_own_artefacts(folder)


def _require_own_artefacts(folder: Path) -> None:
    if _may_be_replaced(folder):
        return
    place = first_taken(folder, (*_FOLDERS, NUMBERS, "results.json", "report.html"))
    if place is not None:
        raise SettingError(
            f"{place}: expected a folder without such files, or one of a virtual machine's "
            "commissioning, which can be repeated; choose another folder, or overwrite them "
            "(--overwrite)"
        )


def first_taken(folder: Path, names: Iterable[str]) -> Path | None:
    """The first of these that is a file, or a folder with something in it."""
    for name in names:
        place = folder / name
        if place.is_file() or (place.is_dir() and any(place.iterdir())):
            return place
    return None


def _may_be_replaced(folder: Path) -> bool:
    found = numbers_in(folder / NUMBERS)
    return found.get("format") == FORMAT and str(found.get("machine", "")).startswith("virtual")


def numbers_in(file: Path) -> dict[str, Any]:
    """What a file of results says, as far as it is one: nothing where it is damaged or missing."""
    try:
        found = json.loads(file.read_bytes())
    except (OSError, ValueError):
        return {}
    return found if isinstance(found, dict) else {}


def write(found: Commissioning, folder: Path, *, overwrite: bool) -> Path:
    """Put the artefacts in place of those of an earlier commissioning; then the page.

    Without `commissioning.json` a folder is refused by the report: an interruption in between
    leaves no mixture that looks whole. What was written there as the recordings came stays until
    then.
    """
    if not overwrite:
        _require_own_artefacts(folder)
    prepare(folder)
    for name in (NUMBERS, ANALYSIS, "report.html"):
        (folder / name).unlink(missing_ok=True)
    for name in _FOLDERS:
        place = folder / name
        place.mkdir(exist_ok=True)
        # artefacts of an earlier one that this one has not would pass for its own
        for old in place.iterdir():
            if old.suffix in (".csv", ".json", ".npz", ".svg"):
                old.unlink()
    _artefacts(found, folder)
    _analysis(found, folder)
    storage.write(folder / NUMBERS, FORMAT, VERSION, {"sewfast": __version__, **numbers(found)})
    own = found.taken_in is not None and found.taken_in.resolve() == folder.resolve()
    if own and found.is_verified:
        # of any other there is something to resume
        with suppress(OSError):
            # they hold nothing that the tables have not; the page is worth more than their absence
            clear(folder)
    return _page(folder)


def _artefacts(found: Commissioning, folder: Path) -> None:
    """What the machine's minutes were for, a few kB, comes first: a disk may be full by the tables.

    A table that has no room does not keep the others from being written.

    Raises
    ------
    DataError
        For the first table that could not be written, once all others are.
    """
    for name, controller in (("tuned", found.controller), ("first", found.first)):
        if controller is not None:
            controller.save(folder / "controllers" / f"{name}.json")
    if found.models is not None:
        found.models.save(folder / "models" / "ensemble.json")
    tables: list[Callable[[], object]] = [
        partial(recording.save, folder / "recordings" / f"{name}.csv")
        for name, recording in found.recordings.items()
    ]
    tables += [
        partial(write_table, folder / run_file(c.reference, kind), loop.columns())
        for c in found.comparisons
        for kind, loop in (("predicted", c.predicted), ("measured", c.measured))
        if loop is not None
    ]
    failures: list[Exception] = []
    for table in tables:
        try:
            table()
        except (OSError, DataError) as error:
            failures.append(error)
    if failures:
        raise DataError(
            f"{failures[0]}; {len(failures)} of {len(tables)} tables could not be written, the "
            f"controllers and models are in {folder}: free some space and save again"
        ) from failures[0]


def _analysis(found: Commissioning, folder: Path) -> None:
    """The loop from every side, for the page; an extra as that one is."""
    from ..analysis import analyse

    if found.controller is None or found.models is None:
        return
    runs = [c.predicted for c in found.comparisons]
    references = [r.r for r in runs if r.t[-1] <= _SHORT] or [r.r for r in runs[:1]] or None
    coarse = Thinning.between(found.models.members[0].Ts, found.controller.Ts)
    with suppress(SettingError):
        analyse(
            coarse.coarse(found.controller), found.models, references=references
        ).save(folder, png=False)  # fmt: skip


def _page(folder: Path) -> Path:
    from ..report import report

    try:
        return report(folder)
    except SettingError:
        # the page is an extra; `sewfast report DIR` writes it once its packages are there
        return folder / NUMBERS
