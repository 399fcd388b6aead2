"""The result folder: every artefact written whole, `results.json` last."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

from .. import jsonfile
from ..commissioning import Commissioning
from ..commissioning.folder import first_taken, numbers_in
from ..control import Controller
from ..errors import SettingError
from ..loop import ClosedLoopRun
from ..models import Model
from ..recording import Recording
from ..report.artefacts import (
    FORMAT,
    VERSION,
    drawing_file,
    prediction_file,
    recording_file,
    run_file,
)
from ..writers import write_table

_FOLDERS = ("recordings", "models", "controllers", "predictions", "runs", "check", "commissioning")


def require_own(folder: Path, *, overwrite: bool) -> None:
    """Refuse a folder whose files would be lost and are of no experiment, which can be repeated.

    Raises
    ------
    SettingError
    """
    if overwrite or _is_result(folder):
        return
    place = first_taken(folder, (*_FOLDERS, "results.json", "report.html"))
    if place is not None:
        raise SettingError(
            f"{place}: expected a folder of an earlier experiment or one without such files, "
            "there are some and no results.json; choose another folder, or overwrite them "
            "(--overwrite)"
        )


def _is_result(folder: Path) -> bool:
    # of any version: what an older one has left is replaced as well
    return numbers_in(folder / "results.json").get("format") == FORMAT


def abandon(folder: Path) -> None:
    """Take the folder away again where nothing has been put into it."""
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
    """Put the artefacts in place of those of an earlier experiment.

    Without `results.json` a folder is refused by the report: an interruption in between leaves no
    mixture that looks whole.
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
        jsonfile.replace(folder / drawing_file(name), svg)
    if commissioning is not None:
        commissioning.save(folder / "commissioning", overwrite=True)
    jsonfile.write(folder / "results.json", FORMAT, VERSION, results)
