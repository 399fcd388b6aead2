"""One recording of a fleet: how it is listed, read, and turned into a row."""

from __future__ import annotations

import csv
import hashlib
import io
import math
import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from sewfast.control.controller import Controller
from sewfast.dataset import Dataset
from sewfast.dataset.faults import faults
from sewfast.errors import SettingError, SewfastError, printable
from sewfast.evidence import Residuals, estimate
from sewfast.identification import identify
from sewfast.models import Model
from sewfast.readers import read, read_table
from sewfast.storage import file_bytes
from sewfast.validation import validate

from .table import Row

READABLE = (
    ".csv", ".mat", ".npz", ".parquet", ".mcap", ".log", ".jsonl", ".ndjson",
    ".mf4", ".mdf", ".tdms", ".ulg", ".wpilog", ".bag", ".bbl", ".bfl",
)  # fmt: skip
"""Endings of recordings and logs in a folder; a manifest can list any file."""
TRAINED = 0.7
"""Share of a recording for identification; the figures are computed on the rest."""


# --- Jobs -----------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Job:
    """One recording and how it is read."""

    file: str
    path: str
    inputs: tuple[str, ...]
    output: str | None
    Ts: float | None = None

    def fingerprint(self) -> list[Any]:
        """Values that change if the file changes."""
        try:
            stat = os.stat(self.path)
        except (OSError, ValueError):  # a name with the character 0 is a ValueError
            return [None, None, *self.inputs, self.output, self.Ts]
        return [stat.st_size, stat.st_mtime_ns, *self.inputs, self.output, self.Ts]


def jobs_of(
    recordings: Any,
    inputs: str | Sequence[str] | None,
    output: str | None,
    Ts: float | None,
    tables: Sequence[Path] = (),
) -> list[Job]:
    """The jobs of a fleet; `tables` are results of a fleet, not recordings."""
    names = (inputs,) if isinstance(inputs, str) else tuple(inputs or ())
    if isinstance(recordings, str | os.PathLike):
        root = Path(recordings)
        if root.is_dir():
            results = {table.resolve() for table in tables}
            files = sorted(
                p
                for p in root.rglob("*")
                # hidden files belong to an editor or the operating system
                if p.suffix.lower() in READABLE
                and not p.name.startswith(".")
                and p.resolve() not in results
            )
            jobs = [
                Job(printable(p.relative_to(root).as_posix()), str(p), names, output, Ts)
                for p in files
                if p.is_file()
            ]
        else:
            jobs = list(_manifest(root, names, output, Ts))
    elif isinstance(recordings, Sequence) and all(
        isinstance(p, str | os.PathLike) for p in recordings
    ):
        jobs = [Job(printable(str(p)), os.fspath(p), names, output, Ts) for p in recordings]
    else:
        raise SettingError(
            name="recordings", expected="a folder, a manifest or a list of files",
            received=printable(f"{recordings!r:.200}"), remedy="name the folder",
        )  # fmt: skip
    if not jobs:
        raise SettingError(
            f"expected recordings ({', '.join(READABLE)}), got none in {recordings}; name a folder "
            "that holds some, or a manifest"
        )
    seen: set[str] = set()
    for job in jobs:
        if bool(job.inputs) != bool(job.output):
            raise SettingError(
                name=f"inputs, output of {job.file}",
                expected="both, or neither to recognise them by their names",
                received=f"{', '.join(job.inputs) or None} and {job.output}",
                remedy="name the other one as well",
            )  # fmt: skip
        if job.file in seen:
            raise SettingError(
                f"expected every recording once, got {job.file} twice; remove one of them"
            )
        seen.add(job.file)
    return jobs


def _manifest(
    path: Path, inputs: tuple[str, ...], output: str | None, Ts: float | None
) -> Iterator[Job]:
    try:
        text = file_bytes(path, SettingError).decode("utf-8-sig")
    except (SettingError, UnicodeDecodeError) as error:
        raise SettingError(
            f"{path}: expected a folder, or a manifest in CSV, got none that can be read ({error})"
        ) from error
    head = text.partition("\n")[0]
    # a spreadsheet where the comma is the decimal mark writes semicolons
    semicolons = ";" in head and "," not in head
    rows = csv.DictReader(io.StringIO(text), delimiter=";" if semicolons else ",")
    known = ("file", "inputs", "output", "Ts")
    try:
        names = tuple(rows.fieldnames or ())
        if "file" not in names or not set(names) <= set(known):
            raise SettingError(
                f"{path}: expected a manifest with a column file and any of inputs, output, Ts, "
                f"got {', '.join(names)[:200] or 'nothing'}"
            )
        for row in rows:
            yield _listed(path, rows.line_num, row, inputs, output, Ts)
    except csv.Error as error:
        raise SettingError(
            f"{path}, line {rows.line_num}: expected a line of CSV, got one that cannot be read: "
            f"{error}; correct the line"
        ) from error


def _listed(
    path: Path, number: int, row: Mapping[Any, str], inputs: tuple[str, ...],
    output: str | None, Ts: float | None,
) -> Job:  # fmt: skip
    """The recording of one line of a manifest."""
    try:
        own = float(row["Ts"].replace(",", ".")) if row.get("Ts") else Ts
    except ValueError:
        raise SettingError(
            f"{path}, line {number}: expected Ts as a number of seconds, got {row['Ts']!r}"
        ) from None
    file = row["file"]
    if not file or None in row:
        found = "more cells than columns" if file else "none"
        raise SettingError(
            f"{path}, line {number}: expected the name of a file, and a cell for each column, "
            f"got {found}; correct the line"
        )
    names = tuple(row["inputs"].split(";")) if row.get("inputs") else inputs
    return Job(printable(file), str(path.parent / file), names, row.get("output") or output, own)


# --- One recording --------------------------------------------------------------------------------


def row_of(job: Job, settings: Mapping[str, Any], controller: Controller | None) -> Row:
    """The row of one recording; an error becomes its message."""
    try:
        return _identified(job, settings, controller)
    except SewfastError as error:
        return Row(job.file, "failed", str(error))
    except Exception as error:  # one recording must not end the work on thousands of others
        return Row(job.file, "failed", f"{type(error).__name__}: {error}")


def _identified(job: Job, settings: Mapping[str, Any], controller: Controller | None) -> Row:
    data = _read(job)
    samples = sum(len(e.y) for e in data.experiments)
    cut = int(TRAINED * samples)
    model = identify(
        data.slice(f"0:{cut}"), model=settings["model"], seed=settings["seed"], threads=1
    )
    held = data.slice(f"{cut}:{samples}")
    scores = validate(model, held).simulation
    runs = zip(held.experiments, model.simulate(held), strict=True)
    noise = float(np.nanstd(np.concatenate([e.y - run for e, run in runs])))
    quantities: dict[str, Any] = {}
    if not model.members and model.kind in ("arx", "oe", "iv"):
        quantities = _physical(model, data.slice(f"0:{cut}"))
    gains: dict[str, Any] = {}
    if controller is not None:
        from sewfast.tuning import tune

        settled = {"seed": settings["seed"], "threads": 1, "feedforward": "none"}
        tuned = tune(model, start=controller, **settled).pid
        standard = tuned.gains.to("standard")
        gains = {"Kp": standard.Kp, "Ti": standard.Ti, "Td": standard.Td}
    return Row(
        job.file,
        samples=samples,
        Ts=data.Ts,
        kind=model.kind,
        fit_percent=float(scores.fit_percent),
        rmse=float(scores.rmse),
        noise=noise,
        message="; ".join(
            [
                *(fault.with_remedy for fault in faults(data)),
                *(w for note in data.notes if (w := note.removeprefix("warning: ")) != note),
            ]
        ),
        verdict=str(model.training.get("verdict", {}).get("text", "")),
        parameters=hashlib.sha256(model.theta.tobytes()).hexdigest()[:16],
        **quantities,
        **gains,
    )


def _read(job: Job) -> Dataset:
    table = read_table(job.path)
    if job.inputs:
        return read(table, inputs=job.inputs, output=job.output, Ts=job.Ts)
    return read(table, Ts=job.Ts)


def _physical(model: Model, data: Dataset) -> dict[str, float]:
    """Gain and average residence time of a linear model, with their standard errors.
    The residence time is Ts (B'(1)/B(1) - A'(1)/A(1)) for G = B/A in the delay operator; a pole and
    a zero that nearly cancel do not affect it. The errors follow from the parameters' covariance by
    linear propagation.
    """
    found = estimate(model, Residuals.of(model, data))
    theta, na, nk = model.theta, model.orders["na"], model.orders["nk"]
    inputs = len(model.input_names)

    def quantities(values: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
        a, b = values[:na], values[na : len(values) - 1].reshape(inputs, -1)
        b, total, final = b[0], 1.0 + float(a.sum()), float(b[0].sum())
        if total == 0.0 or final == 0.0:
            return np.full(2, math.nan)
        later = nk + np.arange(len(b))
        residence = later @ b / final - np.arange(1, na + 1) @ a / total
        return np.array([final / total, model.Ts * residence])

    value = quantities(theta)
    errors = np.full(2, math.nan)
    if found is not None:
        steps = 1e-6 * np.maximum(np.abs(theta), 1e-3)
        slopes = np.array(
            [
                (quantities(theta + step * axis) - quantities(theta - step * axis)) / (2.0 * step)
                for step, axis in zip(steps, np.eye(len(theta)), strict=True)
            ]
        )
        with np.errstate(invalid="ignore"):
            errors = np.sqrt(np.diag(slopes.T @ found.covariance @ slopes))
    return {
        "gain": float(value[0]),
        "gain_error": float(errors[0]),
        "residence_time": float(value[1]),
        "residence_time_error": float(errors[1]),
    }
