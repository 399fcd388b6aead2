"""`Artefacts`: the files of an experiment's result folder, read and checked."""

from __future__ import annotations

import os
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from .. import storage
from ..arrays import known_until
from ..errors import DataError, ModelFileError
from ..readers import read_table

FORMAT = "sewfast.results"
VERSION = 1
RECORDINGS = (
    "step", "chirp_lo_hi", "chirp_hi_lo", "random", "saturating", "saturating_2", "closed_loop",
)  # fmt: skip
SCORED = ("chirp_lo_hi", "chirp_hi_lo", "random", "saturating")
"""Records in `results.json`; `saturating` is the second saturating one, not used for training."""
MODELS = ("paper", "neural_oe", "oe", "oe_all", "arx", "arx_raw")
REFERENCES = ("trapezoid", "chirp_hi_lo", "chirp_lo_hi", "random")
PLANTS = ("model", "machine")
DRAWINGS = ("residuals", "bands", "bode", "poles", "region")
"""Figures of the report card."""
_ALIVE = re.compile(
    r"<\s*(script|foreignobject|image)|\son\w+\s*=|javascript:|href=\"[^#]", re.IGNORECASE
)

Columns: TypeAlias = Mapping[str, NDArray[np.float64]]

_RECORDING = ("t", "u", "counts", "y", "speed_true")
_RUN = ("t", "r", "u", "y", "feedback")


def drawing_file(name: str) -> str:
    """Path in the folder of a figure of the report card."""
    return f"check/{name}.svg"


def recording_file(record: str) -> str:
    """Path in the folder of a recording."""
    return f"recordings/{record}.csv"


def prediction_file(record: str) -> str:
    """Path in the folder of the models' predictions of a scored record."""
    return f"predictions/{record}.npz"


def run_file(reference: str, plant: str) -> str:
    """Path in the folder of a closed loop."""
    return f"runs/{reference}_{plant}.npz"


def record_of(scored: str) -> str:
    return "saturating_2" if scored == "saturating" else scored


@dataclass(frozen=True, eq=False)
class Artefacts:
    """The content of the report: `results` is `results.json`; `recordings` have t [s], u [V],
    counts, y (speed from counts), speed_true [RPM]; `predictions` of a record have
    `MODEL_simulation`, `MODEL_one_step` [RPM]; `runs` by (reference, plant) have t, r, u, y (true
    speed), feedback; `drawn` are the report card's figures as SVG, none in older results.
    """

    folder: Path
    results: Mapping[str, Any]
    recordings: Mapping[str, Columns]
    predictions: Mapping[str, Columns]
    runs: Mapping[tuple[str, str], Columns]
    drawn: Mapping[str, str]

    def value(self, path: str) -> Any:
        """One value of `results.json` by its dotted path; a missing one is a `ModelFileError`."""
        found: Any = self.results
        for key in path.split("."):
            if not isinstance(found, Mapping) or key not in found:
                raise ModelFileError(
                    f"{self.folder / 'results.json'}: expected a value {path!r}, found none; "
                    "run `sewfast demo` again"
                )
            found = found[key]
        return found

    def number(self, path: str) -> float | None:
        """One number of `results.json` by its dotted path; None if it is null there."""
        found = self.value(path)
        if found is None:
            return None
        if isinstance(found, bool) or not isinstance(found, (int, float)):
            raise ModelFileError(
                f"{self.folder / 'results.json'}: expected a number at {path!r}, received "
                f"{found!r}; run `sewfast demo` again"
            )
        return float(found)


def load(folder: str | os.PathLike[str]) -> Artefacts:
    """Read a result folder."""
    folder = Path(folder)
    if not folder.is_dir():
        raise DataError(
            f"{folder}: expected a folder with results, found none; `sewfast demo --out DIR` "
            "makes one"
        )
    if not (folder / "results.json").is_file():
        raise DataError(
            f"{folder}: expected a result folder, found no results.json in it; "
            "`sewfast demo --out DIR` makes one"
        )
    results = storage.read(folder / "results.json", FORMAT, {VERSION})
    predicted = [f"{m}_{kind}" for m in MODELS for kind in ("simulation", "one_step")]
    recordings = {r: _columns(folder, recording_file(r), _RECORDING) for r in RECORDINGS}
    predictions = {r: _columns(folder, prediction_file(r), predicted) for r in SCORED}
    for r, columns in predictions.items():
        _require_alike(folder / prediction_file(r), columns, recordings[record_of(r)])
    runs = [(r, p) for r in REFERENCES for p in PLANTS]
    runs += [("paper_gains", "eq8"), ("paper_gains", "machine")]
    return Artefacts(
        folder,
        results,
        recordings,
        predictions,
        {key: _columns(folder, run_file(*key), _RUN) for key in runs},
        {name: drawing(folder / drawing_file(name)) for name in _drawings(results)},
    )


def _drawings(results: Mapping[str, Any]) -> list[str]:
    """The report card's figures that the results name."""
    check = results.get("check")
    named = check.get("figures", []) if isinstance(check, Mapping) else []
    return [name for name in DRAWINGS if isinstance(named, list) and name in named]


def drawing(path: Path) -> str:
    """An SVG without active content; anything else is a `DataError`."""
    try:
        text = storage.file_bytes(path).decode()
    except (DataError, UnicodeDecodeError) as e:
        raise DataError(
            f"{path}: expected by the report, cannot be read ({e}); run `sewfast demo` again"
        ) from e
    if not text.startswith("<svg") or _ALIVE.search(text):
        raise DataError(
            f"{path}: expected a drawing as `sewfast demo` writes it, received something else; "
            "run `sewfast demo` again"
        )
    return text


def _require_alike(path: Path, columns: Columns, recording: Columns) -> None:
    received, expected = (len(next(iter(c.values()))) for c in (columns, recording))
    if received != expected:
        raise DataError(
            f"{path}: expected {expected} samples, as many as the recording, received {received}; "
            "run `sewfast demo` again"
        )


def _columns(folder: Path, name: str, needed: tuple[str, ...] | list[str]) -> Columns:
    """The needed columns of one file, finite and of one length."""
    path = folder / name
    if not path.is_file():
        raise DataError(f"{path}: expected by the report, found none; run `sewfast demo` again")
    table = read_table(path)
    columns = {n: table[n] for n in needed}
    lengths = {n: len(c) for n, c in columns.items()}
    if len(set(lengths.values())) > 1:
        raise DataError(f"{path}: expected columns of one length, received {lengths}")
    if min(lengths.values()) < 2:
        raise DataError(f"{path}: expected at least 2 samples, received {min(lengths.values())}")
    for n, column in columns.items():
        if (k := known_until(column)) < len(column):
            raise DataError(
                f"{path}: expected finite values, received {column[k]} in column {n!r}, sample {k};"
                " run `sewfast demo` again"
            )
    return columns


# --- Names of models, records and references on the page ------------------------------------------


MODEL = {
    "paper": "paper's network",
    "neural_oe": "default network",
    "oe": "linear output error",
    "oe_all": "linear output error, all records",
    "arx": "ARX, smoothed speed",
    "arx_raw": "ARX, differenced counts",
}

RECORD = {
    "step": "step",
    "chirp_lo_hi": "chirp Lo-Hi",
    "chirp_hi_lo": "chirp Hi-Lo",
    "random": "random",
    "saturating": "saturating",
}

REFERENCE = {
    "trapezoid": "trapezoid",
    "chirp_hi_lo": "chirp Hi-Lo",
    "chirp_lo_hi": "chirp Lo-Hi",
    "random": "random",
}
