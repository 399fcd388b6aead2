"""A co-simulation FMU as a machine: a plant from Modelica, Simulink or any other tool.

FMPy loads it, in a separate process. An FMU is a program: it runs with the user's rights.
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

from ..control.benches import SteppedBench
from ..errors import ModelFileError, SettingError, not_installed
from .fmu_process import FmuProcess

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
        Sample time [s], and communication step of the FMU.
    input : str, optional
        Variable that takes the command; by default the only input.
    speed, angle, counts : str, optional
        Variables to measure, at least one; by default the only output is the speed. Counts are
        read, or computed from the angle, or from the integral of the speed.
    speed_unit, angle_unit : str, optional
        Units of those if the FMU states none: `RPM`, `rad/s`, `deg/s`, `rev/s`; `rad`, `deg`,
        `rev`.
    counts_per_rev : float
        Encoder counts per turn.
    start : mapping, optional
        Initial values of further variables.
    timeout : float
        Longest time for the FMU to start, or for a step [s].

    Raises
    ------
    ModelFileError
        For a file that is not an FMU, is damaged, malicious or for another platform.
    SettingError
        For missing variables or unknown units, and without FMPy.
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
            raise SettingError(
                name="Ts", expected="a time above 0 s", received=repr(Ts), remedy="0.001 is usual"
            )
        if not self.timeout > 0.0:
            raise SettingError(
                name="timeout", expected="a time above 0 s", received=repr(timeout),
                remedy="60 is usual",
            )  # fmt: skip
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
                name=str(self.path), expected="an input as input=", received=repr(input),
                remedy=f"it has inputs {self._names('input')}",
            )  # fmt: skip
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
                name=str(self.path), expected="an FMU whose model description is valid",
                received=" ".join(said[:2])[:300] or type(error).__name__, remedy="export it again",
            ) from error  # fmt: skip
        if found.coSimulation is None:
            raise ModelFileError(
                name=str(self.path), expected="an FMU for co-simulation",
                received="one for model exchange only",
                remedy="export it for co-simulation, with its solver",
            )  # fmt: skip
        name = found.coSimulation.modelIdentifier
        if not re.fullmatch(r"\w+", name):
            raise ModelFileError(
                name=str(self.path), expected="a name of letters, digits and _ as modelIdentifier",
                received=repr(name[:80]), remedy="do not use it",
            )  # fmt: skip
        own, present = self._fmpy.platform, self._fmpy.supported_platforms(self._folder)
        tuple_name = getattr(self._fmpy, "platform_tuple", own)
        if not {own, tuple_name} & set(present):
            got = ", ".join(present) or "none"
            raise ModelFileError(
                name=str(self.path), expected=f"a binary for {tuple_name}", received=str(got),
                remedy="export it for this platform, or compile its sources",
            )  # fmt: skip
        return found

    def _only(self, causality: str, options: str) -> str:
        names = [v.name for v in self._variables.values() if v.causality == causality]
        if len(names) != 1:
            raise SettingError(
                name=str(self.path), expected=f"{options} among {len(names)} {causality}s",
                received="none", remedy=f"name one of {self._names(causality)}",
            )  # fmt: skip
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
                name=str(self.path), expected=f"a real variable {name!r}", received=str(got),
                remedy=f"it has inputs {self._names('input')} and outputs {self._names('output')}",
            )  # fmt: skip
        return int(found.valueReference)

    def _factor(
        self, name: str | None, unit: str | None, known: Mapping[str, float], option: str
    ) -> float:
        if name is None:
            return 1.0
        unit = unit or self._variables[name].unit
        if unit not in known:
            raise SettingError(
                name=str(self.path), expected=f"the unit of {name} as one of {', '.join(known)}",
                received=unit or "none", remedy=f"give {option}=",
            )  # fmt: skip
        return known[unit]

    def reset(self) -> None:
        """Start a new run of the FMU.

        Raises
        ------
        SettingError
            If the FMU refuses, crashes, or does not answer in time.
        """
        self._measured = self._process.begin()
        self._sample, self._turned = 0, 0.0
        self._require_finite()

    def step(self, u: float) -> None:
        """Hold a command for one sample.

        Raises
        ------
        SettingError
            If the FMU refuses the step, crashes, or does not answer in time.
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
        """Encoder counts."""
        counts, angle, _ = self._measured
        if self._counts is not None:
            return counts
        turned = self._turned if self._angle is None else angle * self._turns
        return math.floor(turned * self.counts_per_rev)

    @property
    def speed_rpm(self) -> float:
        """True speed [RPM]; NaN if the FMU does not provide it."""
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
        Largest command in either direction; larger ones are clipped.
    limit : float
        Speed above which it stops by itself [RPM].
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
    """The machine of `FILE.fmu?volt=24&input=u&speed=w`, the arguments of `fmu_bench` by name."""
    path, _, query = text.partition("?")
    given: dict[str, Any] = {}
    for part in filter(None, query.split("&")):
        name, _, value = part.partition("=")
        if name not in (*_NUMBERS, *_NAMES):
            raise SettingError(
                name=str(path), expected=f"arguments among {', '.join((*_NUMBERS, *_NAMES))}",
                received=repr(name), remedy=f"as in {path}?volt=24&speed=w",
            )  # fmt: skip
        try:
            given[name] = float(value) if name in _NUMBERS else value
        except ValueError:
            raise SettingError(
                name=str(path), expected=f"{name} as a number", received=repr(value)
            ) from None
    if "volt" not in given:
        raise SettingError(
            name=str(path), expected="the largest command that it takes", received="none",
            remedy="add ?volt=24",
        )  # fmt: skip
    return fmu_bench(path, **given)


def _library() -> Any:
    try:
        import fmpy
    except ImportError as error:
        raise not_installed("fmpy", "an FMU", "sewfast[fmi]") from error
    return fmpy


def _require_fmu(path: Path) -> None:
    """Refuse a file that is not an FMU or would do harm when unpacked; nothing is executed."""
    # most bytes of all files of an FMU, unpacked
    most_bytes = 2 * 1024**3
    most_files = 20_000
    # most bytes of a model description
    most_xml = 64 * 1024**2
    try:
        with zipfile.ZipFile(path) as archive:
            entries = archive.infolist()
            described = [e for e in entries if e.filename == "modelDescription.xml"]
            if len(described) != 1:
                raise ModelFileError(
                    name=str(path), expected="an FMU with one modelDescription.xml",
                    received=str(len(described)), remedy="export it again",
                )  # fmt: skip
            if described[0].file_size > most_xml:
                raise ModelFileError(
                    name=str(path), expected=f"a modelDescription.xml of at most {most_xml} bytes",
                    received=str(described[0].file_size),
                    remedy="export it without what is not needed",
                )  # fmt: skip
            with archive.open(described[0]) as file:
                text = file.read(most_xml)
    except ModelFileError:
        raise
    except OSError as error:
        raise ModelFileError(
            name=str(path), expected="a file that can be read",
            received=str(error.strerror or error), remedy="check the name",
        ) from error  # fmt: skip
    except (zipfile.BadZipFile, NotImplementedError, RuntimeError, ValueError, EOFError) as error:
        raise ModelFileError(
            name=str(path), expected="an FMU, which is a zip file", received=str(error),
            remedy="export it again",
        ) from error  # fmt: skip
    if b"<!DOCTYPE" in text or b"<!ENTITY" in text:
        raise ModelFileError(
            name=str(path), expected="a model description without entities", received="some",
            remedy="an FMU needs none",
        )  # fmt: skip
    # FMI requires UTF-8: in another encoding, which could hide entities, no version is found
    version = re.search(rb"""\bfmiVersion\s*=\s*["']([^"']{0,20})""", text)
    if version is None or not re.fullmatch(rb"[12]\.0|3\..*", version[1]):
        raise ModelFileError(
            name=str(path), expected="an FMU of version 1.0, 2.0 or 3.0",
            received="none" if version is None else version[1].decode(errors="replace"),
            remedy="export it as 2.0 or 3.0",
        )  # fmt: skip
    size = sum(e.file_size for e in entries)
    if size > most_bytes or len(entries) > most_files:
        raise ModelFileError(
            name=str(path), expected=f"at most {most_files} files of {most_bytes} bytes",
            received=f"{len(entries)} of {size}", remedy="export it without what is not needed",
        )  # fmt: skip
    for entry in entries:
        place = PurePosixPath(entry.filename.replace("\\", "/"))
        link = entry.external_attr >> 28 == 0xA
        if place.is_absolute() or ".." in place.parts or ":" in entry.filename or link:
            raise ModelFileError(
                name=str(path), expected="files within the FMU", received=repr(entry.filename[:80]),
                remedy="do not use it",
            )  # fmt: skip
