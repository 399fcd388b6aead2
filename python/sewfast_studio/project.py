"""A project folder and its steps: each is a call of the public API and can be copied."""

from __future__ import annotations

import errno
import os
import re
import secrets
import threading
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext, suppress
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO

import numpy as np

from sewfast.errors import SettingError, SewfastError, unwritable

from .requests import (
    COMMISSIONED,
    Step,
    commands,
    envelope,
    require,
    require_writable,
    script,
)
from .words import advice, spoken

if TYPE_CHECKING:
    from sewfast.dataset import Dataset
    from sewfast.frequency import FrequencyResponse
    from sewfast.readers import Table

    from .tuning import Tuning


SHOWN_ROWS, SHOWN_COLUMNS = 5, 40
"""Rows and columns of a file that are shown before anything is chosen."""
RECORDINGS = (
    ".csv", ".tsv", ".txt", ".log", ".jsonl", ".ndjson", ".json", ".npz", ".mat", ".parquet",
    ".mcap",
)  # fmt: skip
LARGEST = 512 * 2**20
"""Most bytes of a recording."""

KEPT = 4
"""Models with their first controllers that are cached, for pages that use different ones."""

GRADES = {"ok": "good", "info": "good", "warn": "warn", "fail": "bad"}
"""Chips of the page for the verdicts of a report card."""

WARNS = "warning: "
"""Before a note on what was left out or assumed, which a person has to see."""

_ARTEFACTS = ("controllers", "models")
"""Subfolders of a commissioning with documents."""

DEMO_MEMBERS, DEMO_SAMPLES = 4, 8000

MODEL_FORMAT, CONTROLLER_FORMAT = "sewfast.model", "sewfast.controller"
LARGEST_DOCUMENT = 16 * 2**20
"""Most bytes of a JSON file."""

Progress = Callable[[int, int, float], None]


def make_demo(folder: str | os.PathLike[str]) -> None:
    """Fill a folder for the demo: four records of the virtual machine, and an ensemble of models.
    Raises `ModelFileError` if the folder is not writable.
    """
    from sewfast import signals
    from sewfast.control.record import record
    from sewfast.identification import identify
    from sewfast.machine import VirtualMachine
    from sewfast.models import Ensemble

    members = []
    for k in range(DEMO_MEMBERS):
        excitation = signals.excitation("saturating", k)[:DEMO_SAMPLES]
        recording = record(VirtualMachine(seed=1), excitation, name=f"record {k + 1}")
        recording.save(Path(folder) / f"record-{k + 1}.csv")
        members.append(identify(recording.dataset(), model="oe", seed=k))
    Ensemble.of(members).save(Path(folder) / "drive.json")


class Project:
    """A folder with recordings, models and controllers in the files of the command line.

    Parameters
    ----------
    place : path
        The folder, or one recording or model in it.
    demo : bool
        Whether the page begins with the model, as in the demo.
    port : str, optional
        Port of a drive; the page then begins with the drive.

    Raises
    ------
    SettingError
        If there is no such folder or file.
    """

    def __init__(
        self, place: str | os.PathLike[str] = ".", *, demo: bool = False, port: str | None = None
    ) -> None:
        path = Path(place).resolve()
        if not path.exists():
            raise SettingError(f"{place}: expected a folder, a recording or a model, there is none")
        self.folder = path if path.is_dir() else path.parent
        self.first = None if path.is_dir() else path.name
        self.demo, self.port = demo, port
        self._formats: dict[Path, tuple[int, str]] = {}
        self._tunings: dict[object, Tuning] = {}
        self._last: tuple[object, Table] | None = None
        self._lock = threading.Lock()
        if self.first is not None and self.first not in self.documents(MODEL_FORMAT):
            self.path_of(self.first)

    def recordings(self) -> list[str]:
        """Names of the recordings in the folder itself, sorted.

        A link to another place is not part of the project. Names with `:` are left out: on the
        command line it separates file and columns, so a copied command could not name the file.
        """
        return sorted(
            entry.name
            for entry in _files(self.folder)
            if entry.suffix.lower() in RECORDINGS
            and ":" not in entry.name
            # models, controllers and results state their format, logs do not
            and not (entry.suffix.lower() == ".json" and self._format_of(entry))
        )

    def documents(self, format: str) -> list[str]:
        """Names of the JSON files of a format, sorted: in the folder and in `commissioned`."""
        places = [self.folder, *(self.folder / COMMISSIONED / name for name in _ARTEFACTS)]
        return sorted(
            entry.relative_to(self.folder).as_posix()
            for place in places
            for entry in _files(place)
            if entry.suffix == ".json" and self._format_of(entry) == format
        )

    def _format_of(self, path: Path) -> str:
        """The format of a file, cached until the file changes."""
        from sewfast import storage

        try:
            found = path.stat()
        except OSError:  # it was removed meanwhile
            return ""
        if self._formats.get(path, (0, ""))[0] != found.st_mtime_ns:
            small = found.st_size <= LARGEST_DOCUMENT
            self._formats[path] = (found.st_mtime_ns, storage.format_of(path) if small else "")
        return self._formats[path][1]

    def document(self, name: Any, format: str) -> Path:
        """The path of one of `documents`. Raises `SettingError` for any other name."""
        if name not in self.documents(format):
            raise SettingError(
                f"{str(name)[:80]!r}: expected a {format.removeprefix('sewfast.')} in the project "
                "folder, it is not there; put it back, or choose another one"
            )
        return self.folder / str(name)

    def follow(self, name: str, format: str) -> Callable[[], str]:
        """What one of `documents` is called by then: a person may rename it during a long step."""
        content = self.document(name, format).read_bytes()

        def now() -> str:
            names = self.documents(format)
            with suppress(OSError):  # one that goes meanwhile
                if name not in names:
                    return next(n for n in [*names, name] if n == name or self._is(n, content))
            return name

        return now

    def _is(self, name: str, content: bytes) -> bool:
        return (self.folder / name).read_bytes() == content

    def path_of(self, name: str) -> Path:
        """The path of one of `recordings`. Raises `SettingError` for any other name, and for a file
        that is too large.
        """
        if name not in self.recordings():
            raise SettingError(
                f"{name[:80]!r}: expected a recording in the project folder "
                f"({', '.join(RECORDINGS)}); put the file there"
            )
        path = self.folder / name
        if path.stat().st_size > LARGEST:
            raise SettingError(f"{name}: expected at most {LARGEST >> 20} MB; cut it first")
        return path

    def state(self) -> dict[str, Any]:
        from sewfast import signals

        return {
            "folder": self.folder.name or str(self.folder),
            "gone": not self.folder.is_dir(),
            "recordings": self.recordings(),
            "first": self.first,
            "demo": self.demo,
            "port": self.port,
            "models": self.documents(MODEL_FORMAT),
            "controllers": self.documents(CONTROLLER_FORMAT),
            "excitations": list(signals.EXCITATIONS),
            "references": list(signals.REFERENCES),
        }

    # --- Tuning -----------------------------------------------------------------------------------

    def tuning(
        self, model: Any, controller: Any = None, notches: Sequence[Sequence[float]] = ()
    ) -> Tuning:
        """A model with its first controller; the same object until one of the files changes.

        Parameters
        ----------
        model : str
            Name of a model file in the folder.
        controller : str, optional
            Name of a controller file; None for the first controller of `sewfast.tune`.
        notches : sequence of (frequency [Hz], depth, width)
            Added to that controller.

        Raises
        ------
        SettingError, ModelFileError, FitError
        """
        from sewfast.control.files import load_pid
        from sewfast.models import load_model

        from .tuning import Tuning

        paths = [self.document(model, MODEL_FORMAT)]
        if controller is not None:
            paths.append(self.document(controller, CONTROLLER_FORMAT))
        stamp = " ".join(f"{path.name} {path.stat().st_mtime_ns}" for path in paths)
        key = (*paths, stamp, *map(tuple, notches))
        with self._lock:
            found = self._tunings.pop(key, None)
            if found is None:
                start = load_pid(paths[1]) if controller is not None else None
                found = Tuning(load_model(paths[0]), str(model), start, notches, stamp)
            self._tunings[key] = found
            if len(self._tunings) > KEPT:
                del self._tunings[next(iter(self._tunings))]
            return found

    def open_ahead(self) -> None:
        """Open the model that the page shows first, while a browser still loads the page."""
        with suppress(Exception):  # the page asks for it again, and says why not
            models = self.documents(MODEL_FORMAT)
            if models and (self.demo or self.first in models):
                self.tuning(self.first if self.first in models else models[0])

    def place_for(self, file: str, format: str, *, replace: bool = False) -> Path:
        """The path of a model or controller to write, a new file; with `replace` also that of one.
        Raises `SettingError` for the name of another file.
        """
        path = self.folder / checked_name(file)
        taken = path.is_symlink() or path.exists()
        if taken and not (replace and file in self.documents(format) and not path.is_symlink()):
            raise SettingError(f"file: expected a new name, {file} is there already; choose one")
        return path

    def save_controller(
        self, tuning: Tuning, values: dict[str, Any], file: str, *, replace: bool = False
    ) -> None:
        """Write a controller into the folder; see `place_for`."""
        place = self.place_for(file, CONTROLLER_FORMAT, replace=replace)
        tuning.controller(values).save(place)

    # --- Steps ------------------------------------------------------------------------------------

    def columns(self, step: Step) -> dict[str, Any]:
        """Columns of a recording, and its input and output where names and units show them."""
        from sewfast.readers import roles

        table = self._table(step.file)
        found, shown = roles(table), table.names[:SHOWN_COLUMNS]
        return {
            "names": list(table.names),
            "inputs": [] if found is None else [found.input],
            "output": None if found is None else found.output,
            "encoder": table.counts_per_rev is not None and "counts" in table,
            "units": [table.unit(name) for name in shown],
            "rows": [
                [float(table[name][k]) if k < len(table[name]) else None for name in shown]
                for k in range(SHOWN_ROWS)
            ],
        }

    def look(self, step: Step) -> dict[str, Any]:
        """The signals, with the summary of `sewfast look`."""
        found = looked_at(self._read(step))
        said = [advice(text) for text in found["advice"]]
        return {**found, "text": spoken(found["text"]), "advice": said}

    def identify(
        self,
        step: Step,
        progress: Progress | None = None,
        writing: Callable[[], AbstractContextManager[None]] = nullcontext,
    ) -> dict[str, Any]:
        """A model from the recording, written to the step's file."""
        from sewfast.identification import identify

        require_writable(self.folder)
        place = self.place_for(step.model_file, MODEL_FORMAT, replace=step.replace)
        data = self._read(step)
        model = identify(data, model=step.model, seed=step.seed, progress=progress)
        with writing():
            model.save(place)
        choice = model.training.get("choice", {})
        return {
            "text": str(model),
            "file": step.model_file,
            "candidates": choice.get("candidates", []),
            "chosen": choice.get("chosen", model.kind),
            **self.validate(step),
        }

    def validate(self, step: Step) -> dict[str, Any]:
        """Measured output and free run, with the report card of `sewfast check`."""
        from sewfast.evidence import check
        from sewfast.models import load_model
        from sewfast.validation import validate

        if not self.documents(MODEL_FORMAT):
            raise SettingError("expected a model in the project folder; identify one first")
        model = load_model(self.document(step.model_file, MODEL_FORMAT))
        data = self._read(step)
        found, card = validate(model, data), check(model, data)
        errors = found.experiments[0]
        pairs = (("measured", errors.y), ("free run", errors.simulated))
        curves = [{"name": n, "unit": found.unit, **envelope(c, data.Ts)} for n, c in pairs]
        unexplained = envelope(errors.y - errors.simulated, data.Ts)
        return {
            "fit": found.simulation.fit_percent,
            "rmse": found.simulation.rmse,
            "unit": found.unit,
            # the verdict of the whole card: a model with a good fit can fail another check
            "verdict": spoken(card.summary),
            "grade": GRADES[card.verdict],
            "lines": [{**line.to_json(), "meaning": spoken(line.meaning)} for line in card.lines],
            "free_run": curves,
            "error": {"name": "error", "unit": found.unit, **unexplained},
        }

    def bode(
        self, step: Step, reference: str | None = None, segment: int | None = None
    ) -> FrequencyResponse:
        """The frequency response of a recording.

        Parameters
        ----------
        step : Step
        reference : str, optional
            Column with the controller's reference: without it a record under feedback is biased.
        segment : int, optional
            Samples; see `sewfast.bode`.
        """
        from sewfast.commissioning import bode, unsmoothed
        from sewfast.readers import read

        columns = self._columns(step, reference)
        data = unsmoothed(self.folder / step.file, read(self._table(step.file), **columns))
        return bode(step.changed(data), reference=reference, segment=segment)

    def python(
        self, step: Step, name: str, reference: str | None = None, segment: int | None = None
    ) -> str:
        """A script that repeats the step, to run in the project folder."""
        return script(step, name, self._columns(step, reference), reference, segment)

    def commands(
        self, step: Step, name: str, reference: str | None = None, segment: int | None = None
    ) -> str:
        """The same for a shell in the project folder."""
        return commands(step, name, self._columns(step), reference, segment)

    def _read(self, step: Step) -> Dataset:
        from sewfast.readers import read

        return step.changed(read(self._table(step.file), **self._columns(step)))

    def _columns(self, step: Step, reference: str | None = None) -> dict[str, Any]:
        return step.columns(self._table(step.file), reference)

    def _table(self, file: str) -> Table:
        """All columns of a recording. The last one is kept: to look at it takes it four times."""
        from sewfast.readers import read_table

        path = self.path_of(file)
        version = (path, path.stat().st_mtime_ns, path.stat().st_size)
        with self._lock:
            if self._last is None or self._last[0] != version:
                self._last = None
                try:
                    table = read_table(path)
                except SewfastError as e:
                    # a page knows the file by its name in the folder
                    raise type(e)(str(e).replace(str(path), file)) from e
                self._last = (version, replace(table, path=Path(file)))
            return self._last[1]


def looked_at(data: Dataset) -> dict[str, Any]:
    """The signals of a data set to draw, with the summary of `sewfast look`."""
    summary = data.summary()
    experiment = data.experiments[0]
    curves = [
        {"name": name, "unit": unit, **envelope(np.asarray(values, dtype=float), data.Ts)}
        for name, unit, values in [
            *zip(data.input_names, data.input_units, experiment.u.T, strict=True),
            (data.output_name, data.output_unit, experiment.y),
        ]
    ]
    notes = [note.removeprefix(WARNS) for note in data.notes if note.startswith(WARNS)]
    return {"text": str(summary), "advice": [*notes, *summary.advice], "curves": curves}


def _files(place: Path) -> list[Path]:
    """Files of a folder, without links to other places; none if it was removed."""

    def is_own(entry: Path) -> bool:
        try:
            return entry.name.isprintable() and entry.is_file() and entry.resolve().parent == place
        except OSError:  # a link into a folder that this user cannot read
            return False

    try:
        return [entry for entry in place.iterdir() if is_own(entry)]
    except OSError:
        return []


def checked_name(file: Any) -> str:
    """The plain name of a controller to write, without a folder; others raise `SettingError`."""
    fits = isinstance(file, str) and re.fullmatch(r"[A-Za-z0-9_][A-Za-z0-9_.-]{0,60}\.json", file)
    require(bool(fits), "file", "a plain name that ends in .json", file)
    return str(file)


# --- Upload: a recording sent by a page, piece by piece, into the project folder ------------------


LONGEST_NAME = 100
"""Most bytes of a file's name."""


class Upload:
    """A file that arrives in pieces; it appears under its name when it is complete.
    `file` is a new, plain name without a folder, `size` the announced number of bytes. Raises
    `SettingError` for a name that is taken or not a recording's, or a size out of range.
    """

    def __init__(self, folder: Path, file: str, size: int) -> None:
        self.file, self.size, self.received = checked_recording_name(file), size, 0
        if not 0 < size <= LARGEST:
            raise SettingError(
                f"{file}: expected 1 byte to {LARGEST >> 20} MB, received "
                f"{'an empty file' if not size else f'{size / 2**20:.6g} MB'}"
            )
        self._place = folder / file
        self._require_new()
        # hidden and without a recording's ending, so that it is not used before it is complete
        self._part = folder / f".{secrets.token_hex(8)}.part"
        try:
            self._out: BinaryIO = self._part.open("xb")
        except OSError as e:
            raise self._refusal(e) from e

    def _require_new(self) -> None:
        if self._place.exists() or self._place.is_symlink():
            raise SettingError(
                f"{self.file}: expected a new name, there is such a file, which is not replaced; "
                "rename one of them"
            )

    def add(self, piece: bytes) -> int:
        """Write the next piece; return the bytes received so far. Raises `SettingError` for more
        bytes than announced, or if it cannot be written; then the file is deleted.
        """
        self.received += len(piece)
        if self.received > self.size:
            self.abandon()
            raise SettingError(
                f"{self.file}: expected {self.size} bytes, received more; upload it again"
            )
        try:
            self._out.write(piece)
        except OSError as e:
            self.abandon()
            raise self._refusal(e) from e
        return self.received

    def finish(self) -> str:
        """Give the complete file its name, and return the name.
        Raises `SettingError` for fewer bytes than announced, a name taken meanwhile, or a model, a
        controller or another file that states its format; then the file is deleted.
        """
        from sewfast import storage

        try:
            if self.received != self.size:
                raise SettingError(
                    f"{self.file}: expected {self.size} bytes, received {self.received}; upload it "
                    "again"
                )
            self._out.close()
            if found := storage.format_of(self._part):
                raise SettingError(
                    f"{self.file}: expected a recording, received a file of the format {found}; "
                    "copy it into the project folder"
                )
            try:
                os.link(self._part, self._place)  # unlike a rename, it replaces nothing
            except FileExistsError:
                self._require_new()
            except OSError:  # a file system without hard links
                self._require_new()
                self._part.rename(self._place)
        except OSError as e:
            raise self._refusal(e) from e
        finally:
            self.abandon()
        return self.file

    def abandon(self) -> None:
        """Delete the part received so far."""
        with suppress(OSError):
            self._out.close()
        with suppress(OSError):
            self._part.unlink()

    def _refusal(self, error: OSError) -> SettingError:
        full = error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
        remedy = "make room in the project folder" if full else "change the rights of the folder"
        return unwritable(SettingError, self.file, error, f"{remedy}, then upload it again")


def checked_recording_name(file: Any) -> str:
    """The plain name of an uploaded recording, without a folder; others raise `SettingError`."""
    fits = (
        isinstance(file, str)
        and file.isprintable()
        and not file.startswith((".", "~"))
        and not set(file) & set('/\\:*?"<>|')
        and Path(file).suffix.lower() in RECORDINGS
        and len(file.encode()) <= LONGEST_NAME
    )
    require(fits, "file", f"a plain name that ends in {', '.join(RECORDINGS)}", file)
    return str(file)
