"""`Checkpoint`: the recordings of a commissioning as files, each written as soon as it is made."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from ..control.controller import SampledController
from ..control.loop import ClosedLoopRun
from ..control.machine import RecordedRun
from ..errors import DataError, SettingError
from ..recordfile import save_columns
from ..recordfile.reader import RecordedFile, read_header, read_recording
from ..recordfile.writer import ENDING, require_replaceable
from ..recording import Recording
from ..report.commissioned import file_name
from ..storage import making, require_writable

STAGES = (
    "first motion",
    "step response",
    "small signals",
    "limits",
    "closed loop",
    "training",
    "tuning",
    "verification",
)

FOLDER = "unfinished"
"""A separate folder, so that a killed commissioning never mixes with an earlier complete one."""
_MARK = "commissioning"
"""The setting by which these files are recognised."""


@dataclass
class Checkpoint:
    """Saves each recording, so that a killed process or a power failure loses none.
    The files lie in the subfolder `unfinished` of the commissioning's `folder` until
    `Commissioning.save` replaces them by tables; with `resume` those that an earlier attempt left
    there are reused. `device` and `conditions` are stored with the recordings.
    """

    folder: Path
    device: Mapping[str, Any]
    conditions: Mapping[str, Any]
    resume: bool = False
    _has_warned: bool = field(default=False, init=False)

    def begin(self) -> None:
        """Create the folder, and delete the files of an earlier commissioning unless it resumes."""
        try:
            if not self.resume:
                clear(self.folder)
        except OSError as error:
            raise DataError(
                name=str(self.folder / FOLDER),
                expected="recordings of an earlier commissioning that can be taken away",
                received=error.strerror, remedy="choose another folder",
            ) from error  # fmt: skip
        prepare(self.folder / FOLDER)

    def keep(
        self, stage: str, name: str, key: str, recording: Recording, run: ClosedLoopRun | None
    ) -> None:
        """Write or replace a recording. If that fails, warn once: it is also in memory."""
        columns = recording.columns()
        del columns["t"]
        own: dict[str, Any] = {}
        if run is not None:
            own = {"controller": run.controller.to_dict()}
            columns |= {"r": run.r, "speed": run.y, "feedback": run.feedback}
        settings = {_MARK: {"stage": stage, "key": key, **self.conditions}, **own}
        header = recording.header(device=self.device, **settings)
        units = {"r": "RPM", "speed": "RPM", "feedback": "RPM"}
        known = {**header.columns, **{n: u for n, u in units.items() if n in columns}}
        try:
            save_columns(self._place(stage, name), replace(header, columns=known), columns)
        except DataError as error:
            if not self._has_warned:
                self._has_warned = True
                warnings.warn(
                    f"{error}; the commissioning goes on, its recordings are in memory alone",
                    RuntimeWarning,
                    stacklevel=2,
                )

    def _place(self, stage: str, name: str) -> Path:
        if stage == STAGES[-1]:
            # a reference can have the name of an excitation
            name = f"{stage}_{name}"
        return self.folder / FOLDER / f"{file_name(name)}{ENDING}"

    def found(self, stage: str, name: str, key: str) -> Recording | None:
        """The complete recording of an earlier attempt with the same key; None without one."""
        file = self._found(stage, name, key)
        if file is None:
            return None
        c, header = file.columns, file.header
        return Recording(
            c["u"], c["counts"], c["y"], c.get("speed_true"), header.Ts,
            float(header.counts_per_rev or 0.0), name,
        )  # fmt: skip

    def found_run(
        self, stage: str, name: str, key: str, controller: SampledController, plant: str
    ) -> RecordedRun | None:
        """The same for a closed loop."""
        file, recording = self._found(stage, name, key), self.found(stage, name, key)
        if file is None or recording is None:
            return None
        c = file.columns
        t = np.arange(len(c["u"]), dtype=np.float64) * recording.Ts
        return RecordedRun(
            t, c["r"], c["u"], c["speed"], c["feedback"], controller, plant, name, recording
        )

    def _found(self, stage: str, name: str, key: str) -> RecordedFile | None:
        if not self.resume:
            return None
        try:
            file = read_recording(self._place(stage, name))
        except (DataError, OSError):
            return None
        known = file.header.settings.get(_MARK, {})
        same = {"key": key, **self.conditions}
        is_same = all(known.get(name) == value for name, value in same.items())
        return file if file.complete and is_same else None


def prepare(folder: Path) -> None:
    """Create the folder, before the machine moves."""
    try:
        with making(folder):
            require_writable(folder / "report.html", DataError)
    except OSError as error:
        raise DataError(
            name=str(folder), expected="a folder that can be made", received=error.strerror,
            remedy="choose one that is writable",
        ) from error  # fmt: skip


def clear(folder: Path) -> None:
    """Delete the files: of an earlier commissioning, or of one that has been saved as tables."""
    place = folder / FOLDER
    for file in _inside(place):
        if _is_own(file):
            file.unlink()
    with suppress(OSError):
        # a folder with other files stays
        place.rmdir()


def require_repeatable(folder: Path) -> None:
    """Refuse (`SettingError`) a folder with files other than recordings of a virtual machine."""
    for file in _inside(folder / FOLDER):
        if not _is_own(file):
            raise SettingError(
                name=str(file), expected="a folder with recordings of a commissioning alone",
                received="another file",
                remedy="choose another folder, or overwrite them (--overwrite)",
            )  # fmt: skip
        require_replaceable(file, overwrite=False)


def _inside(place: Path) -> list[Path]:
    return sorted(place.iterdir()) if place.is_dir() else []


def _is_own(file: Path) -> bool:
    """Whether it is such a file, or the temporary file of one whose process was killed."""
    if not file.is_file():
        return False
    if file.name.startswith(".") and f"{ENDING}." in file.name and file.suffix == ".tmp":
        return True
    try:
        return file.suffix == ENDING and _MARK in read_header(file).settings
    except DataError:
        return False
