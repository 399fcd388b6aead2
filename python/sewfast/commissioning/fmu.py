"""A co-simulation FMU as a machine: a plant from Modelica, Simulink or any other tool.

FMPy loads it, in a process of its own. An FMU is a program: it runs with the user's rights.
"""

from __future__ import annotations

import math
import os
import re
import shutil
import tempfile
import weakref
import zipfile
from collections.abc import Mapping
from pathlib import Path, PurePosixPath
from typing import Any

from ..control.machine import SteppedBench
from ..errors import ModelFileError, SettingError
from .fmu_process import FmuProcess

MOST_BYTES = 2 * 1024**3
"""Of all files of an FMU, unpacked."""
MOST_FILES = 20_000
MOST_XML = 64 * 1024**2
"""Bytes of a model description."""
_TURNS = {"rad": 1.0 / (2.0 * math.pi), "deg": 1.0 / 360.0, "turn": 1.0, "rev": 1.0}
_RPM = {
    "RPM": 1.0, "rpm": 1.0, "1/min": 1.0, "rev/min": 1.0, "rad/s": 30.0 / math.pi,
    "deg/s": 1.0 / 6.0, "rev/s": 60.0, "Hz": 60.0,
}  # fmt: skip


class FmuMachine:
    """A co-simulation FMU that is advanced one sample at a time (`sewfast.commissioning.Stepped`).

    Parameters
    ----------
    path : path
        FMU of version 1.0, 2.0 or 3.0 with a binary for this platform.
    Ts : float
        Sample time [s]; the FMU is asked for steps of it.
    input : str, optional
        Variable that takes the command; the only input where there is one.
    speed, angle, counts : str, optional
        Variables to measure, at least one; where none is named, the only output is the speed.
        Counts are read as they are, else made from the angle, else from the integral of the speed.
    speed_unit, angle_unit : str, optional
        Units of those where the FMU states none: `RPM`, `rad/s`, `deg/s`, `rev/s`; `rad`, `deg`,
        `rev`.
    counts_per_rev : float
        Encoder counts per turn.
    start : mapping, optional
        Values of further variables at the beginning.
    timeout : float
        Longest time that the FMU may take to begin, or for a step [s].

    Raises
    ------
    ModelFileError
        For a file that is no FMU, is damaged, hostile or for another platform.
    SettingError
        For variables that are not there, units that are not known, and without FMPy.
    """

    def __init__(
        self,
        path: str | os.PathLike[str],
        *,
        Ts: float,
        counts_per_rev: float,
        input: str | None = None,
        speed: str | None = None,
        angle: str | None = None,
        counts: str | None = None,
        speed_unit: str | None = None,
        angle_unit: str | None = None,
        start: Mapping[str, float] | None = None,
        timeout: float = 60.0,
    ) -> None:
        self.path, self.timeout = Path(path), float(timeout)
        self.Ts, self.counts_per_rev = float(Ts), float(counts_per_rev)
        if not (self.Ts > 0.0 and math.isfinite(self.Ts)):
            raise SettingError(f"Ts: expected a time above 0 s, received {Ts!r}; 0.001 is usual")
        if not self.timeout > 0.0:
            raise SettingError(
                f"timeout: expected a time above 0 s, received {timeout!r}; 60 is usual"
            )
        _require_fmu(self.path)
        self._fmpy = _library()
        self._folder = tempfile.mkdtemp(prefix="sewfast-fmu-")
        weakref.finalize(self, shutil.rmtree, self._folder, ignore_errors=True)
        self._description = self._described()
        self._variables = {v.name: v for v in self._description.modelVariables}
        if speed is None and angle is None and counts is None:
            speed = self._only("output", "speed=, angle= or counts=")
        input = input or self._only("input", "input=")
        self._input = self._reference(input)
        if self._variables[input].causality != "input":
            raise SettingError(
                f"{self.path}: expected an input as input=, got {input!r}; it has inputs "
                f"{self._names('input')}"
            )
        self._counts = None if counts is None else self._reference(counts)
        self._angle = None if angle is None else self._reference(angle)
        self._speed = None if speed is None else self._reference(speed)
        self._turns = self._factor(angle, angle_unit, _TURNS, "angle_unit")
        self._rpm = self._factor(speed, speed_unit, _RPM, "speed_unit")
        self._start = {self._reference(n): float(v) for n, v in (start or {}).items()}
        self._read = (self._counts, self._angle, self._speed)
        self._process = FmuProcess(
            self.path, self._folder, input=self._input, measured=self._read, start=self._start,
            Ts=self.Ts,
            timeout=self.timeout,
        )  # fmt: skip
        self._end = weakref.finalize(self, self._process.close)  # before its folder goes
        self._sample = 0
        self._turned = 0.0
        self.reset()

    def _described(self) -> Any:
        try:
            with zipfile.ZipFile(self.path) as archive:
                archive.extractall(self._folder)
            found = self._fmpy.read_model_description(self._folder)
        except Exception as error:
            said = str(error).strip().splitlines()
            raise ModelFileError(
                f"{self.path}: expected an FMU whose model description is valid, got "
                f"{' '.join(said[:2])[:300] or type(error).__name__}; export it again"
            ) from error
        if found.coSimulation is None:
            raise ModelFileError(
                f"{self.path}: expected an FMU for co-simulation, got one for model exchange only; "
                "export it for co-simulation, with its solver"
            )
        name = found.coSimulation.modelIdentifier
        if not re.fullmatch(r"\w+", name):
            raise ModelFileError(
                f"{self.path}: expected a name of letters, digits and _ as modelIdentifier, got "
                f"{name[:80]!r}; do not use it"
            )
        own, present = self._fmpy.platform, self._fmpy.supported_platforms(self._folder)
        tuple_name = getattr(self._fmpy, "platform_tuple", own)
        if not {own, tuple_name} & set(present):
            got = ", ".join(present) or "none"
            raise ModelFileError(
                f"{self.path}: expected a binary for {tuple_name}, got {got}; export it for this "
                "platform, or compile its sources"
            )
        return found

    def _only(self, causality: str, options: str) -> str:
        names = [v.name for v in self._variables.values() if v.causality == causality]
        if len(names) != 1:
            raise SettingError(
                f"{self.path}: expected {options} among {len(names)} {causality}s, received none; "
                f"name one of {self._names(causality)}"
            )
        return str(names[0])

    def _names(self, causality: str) -> str:
        names = [v.name for v in self._variables.values() if v.causality == causality]
        names = names or list(self._variables)
        return ", ".join(names[:8]) + (", ..." if len(names) > 8 else "")

    def _reference(self, name: str) -> int:
        found = self._variables.get(name)
        if found is None or found.type not in ("Real", "Float64"):
            got = "none" if found is None else f"one of type {found.type}"
            raise SettingError(
                f"{self.path}: expected a real variable {name!r}, got {got}; it has inputs "
                f"{self._names('input')} and outputs {self._names('output')}"
            )
        return int(found.valueReference)

    def _factor(
        self, name: str | None, unit: str | None, known: Mapping[str, float], option: str
    ) -> float:
        if name is None:
            return 1.0
        unit = unit or self._variables[name].unit
        if unit not in known:
            raise SettingError(
                f"{self.path}: expected the unit of {name} as one of {', '.join(known)}, got "
                f"{unit or 'none'}; give {option}="
            )
        return known[unit]

    def reset(self) -> None:
        """A new run: the FMU is begun again.

        Raises
        ------
        SettingError
            Where the FMU refuses, crashes, or does not answer in time.
        """
        self._measured = self._process.begin()
        self._sample, self._turned = 0, 0.0
        self._require_finite()

    def step(self, u: float) -> None:
        """Hold a command for one sample.

        Raises
        ------
        SettingError
            Where the FMU refuses the step, crashes, or does not answer in time.
        """
        before = self.speed_rpm
        self._measured = self._process.step(u, self._sample)
        self._sample += 1
        self._require_finite()
        if self._speed is not None:
            self._turned += 0.5 * (before + self.speed_rpm) * self.Ts / 60.0

    def _require_finite(self) -> None:
        for reference, value in zip(self._read, self._measured, strict=True):
            if reference is not None and not math.isfinite(value):
                name = next(n for n, v in self._variables.items() if v.valueReference == reference)
                raise SettingError(
                    name=str(self.path), expected=f"a finite value of {name}",
                    received=f"{value} at {self._sample * self.Ts:g} s",
                    remedy="its model has run away: give smaller commands, a shorter Ts or other "
                    "start values",
                )  # fmt: skip

    @property
    def counts(self) -> float:
        """What the encoder shows."""
        counts, angle, _ = self._measured
        if self._counts is not None:
            return counts
        turned = self._turned if self._angle is None else angle * self._turns
        return math.floor(turned * self.counts_per_rev)

    @property
    def speed_rpm(self) -> float:
        """True speed [RPM]; not a number where the FMU does not show it."""
        return self._measured[2] * self._rpm

    def close(self) -> None:
        """End the FMU."""
        self._end()


def fmu_bench(
    path: str | os.PathLike[str],
    *,
    volt: float,
    Ts: float = 0.001,
    counts_per_rev: float = 4096.0,
    limit: float = math.inf,
    **variables: Any,
) -> SteppedBench:
    """A co-simulation FMU as a machine for `record`, `run` and `commission`.

    Parameters
    ----------
    path, Ts, counts_per_rev
        As of `FmuMachine`.
    volt : float
        Largest command that it takes to either side; larger ones are clipped.
    limit : float
        Speed beyond which it stops by itself [RPM].
    **variables
        Further arguments of `FmuMachine`: `input`, `speed`, `angle`, `counts`, units, `start`,
        `timeout`.

    Returns
    -------
    SteppedBench

    Raises
    ------
    ModelFileError, SettingError
        As `FmuMachine`.
    """
    machine = FmuMachine(path, Ts=Ts, counts_per_rev=counts_per_rev, **variables)
    return SteppedBench(machine, Ts, counts_per_rev, volt, Path(path).stem, limit)


_NUMBERS = ("volt", "Ts", "counts_per_rev", "limit", "timeout")
_NAMES = ("input", "speed", "angle", "counts", "speed_unit", "angle_unit")


def is_fmu(text: str) -> bool:
    """Whether a text of the command line names an FMU: `FILE.fmu`, `FILE.fmu?speed=w&volt=24`."""
    return text.partition("?")[0].lower().endswith(".fmu")


def fmu_of(text: str) -> SteppedBench:
    """The machine of `FILE.fmu?volt=24&input=u&speed=w`, the arguments of `fmu_bench` by name.

    Raises
    ------
    ModelFileError, SettingError
        As `fmu_bench`, and for arguments that are none.
    """
    path, _, query = text.partition("?")
    given: dict[str, Any] = {}
    for part in filter(None, query.split("&")):
        name, _, value = part.partition("=")
        if name not in (*_NUMBERS, *_NAMES):
            raise SettingError(
                f"{path}: expected arguments among {', '.join((*_NUMBERS, *_NAMES))}, received "
                f"{name!r}; as in {path}?volt=24&speed=w"
            )
        try:
            given[name] = float(value) if name in _NUMBERS else value
        except ValueError:
            raise SettingError(f"{path}: expected {name} as a number, received {value!r}") from None
    if "volt" not in given:
        raise SettingError(
            f"{path}: expected the largest command that it takes, received none; add ?volt=24"
        )
    return fmu_bench(path, **given)


def _library() -> Any:
    try:
        import fmpy
    except ImportError as error:
        raise SettingError(
            "expected the FMPy package to run an FMU, got none; pip install 'sewfast[fmi]'"
        ) from error
    return fmpy


def _require_fmu(path: Path) -> None:
    """Refuse what is no FMU or would do harm as it is unpacked; nothing of it is executed."""
    try:
        with zipfile.ZipFile(path) as archive:
            entries = archive.infolist()
            described = [e for e in entries if e.filename == "modelDescription.xml"]
            if len(described) != 1:
                raise ModelFileError(
                    f"{path}: expected an FMU with one modelDescription.xml, got {len(described)}; "
                    "export it again"
                )
            if described[0].file_size > MOST_XML:
                raise ModelFileError(
                    f"{path}: expected a modelDescription.xml of at most {MOST_XML} bytes, got "
                    f"{described[0].file_size}; export it without what is not needed"
                )
            with archive.open(described[0]) as file:
                text = file.read(MOST_XML)
    except ModelFileError:
        raise
    except OSError as error:
        raise ModelFileError(
            f"{path}: cannot be read ({error.strerror or error}); check the name"
        ) from error
    except (zipfile.BadZipFile, NotImplementedError, RuntimeError, ValueError, EOFError) as error:
        raise ModelFileError(
            f"{path}: expected an FMU, which is a zip file, got {error}; export it again"
        ) from error
    if b"<!DOCTYPE" in text or b"<!ENTITY" in text:
        raise ModelFileError(
            f"{path}: expected a model description without entities, got some; an FMU needs none"
        )
    # FMI asks for UTF-8: in another encoding, which could hide entities, no version is found
    version = re.search(rb"""\bfmiVersion\s*=\s*["']([^"']{0,20})""", text)
    if version is None or not re.fullmatch(rb"[12]\.0|3\..*", version[1]):
        raise ModelFileError(
            f"{path}: expected an FMU of version 1.0, 2.0 or 3.0, got "
            f"{'none' if version is None else version[1].decode(errors='replace')}; export it as "
            "2.0 or 3.0"
        )
    size = sum(e.file_size for e in entries)
    if size > MOST_BYTES or len(entries) > MOST_FILES:
        raise ModelFileError(
            f"{path}: expected at most {MOST_FILES} files of {MOST_BYTES} bytes, got "
            f"{len(entries)} of {size}; export it without what is not needed"
        )
    for entry in entries:
        place = PurePosixPath(entry.filename.replace("\\", "/"))
        link = entry.external_attr >> 28 == 0xA
        if place.is_absolute() or ".." in place.parts or ":" in entry.filename or link:
            raise ModelFileError(
                f"{path}: expected files within the FMU, got {entry.filename[:80]!r}; do not use it"
            )
