"""The process in which an FMU runs: a crash there, or an endless step, becomes an error here.

Requests and answers are structs over the process's standard input and output.
"""

from __future__ import annotations

import contextlib
import json
import math
import os
import select
import signal
import struct
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NoReturn

from ..errors import SettingError

_REQUEST = struct.Struct("<cd")
"""`r` for a new run or `s` for a step, and the command."""
_ANSWER = struct.Struct("<?3d")
"""Whether it succeeded, and the measured variables; after a failure, the first is the size of the
message that follows."""


class FmuProcess:
    """An FMU, unpacked in `folder`, in a separate process, advanced by requests.
    `path` is for messages. `input` is the reference of the variable that takes the command,
    `measured` those of three variables to read after every step (None reads as NaN), and `start`
    holds initial values of further variables by reference. `Ts` is in seconds, and so is `timeout`,
    the longest time of a call.
    """

    def __init__(
        self,
        path: Path,
        folder: str,
        *,
        input: int,
        measured: Sequence[int | None],
        start: Mapping[int, float],
        Ts: float,
        timeout: float,
    ) -> None:
        self.path, self.Ts, self.timeout = path, Ts, timeout
        given = json.dumps([folder, input, list(measured), list(start.items()), Ts])
        program = f"from {__name__} import serve; serve()"
        self._process = subprocess.Popen(
            [sys.executable, "-c", program, given],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, bufsize=0,
            start_new_session=True,  # keep Ctrl-C for the caller
            env={**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))},
        )  # fmt: skip
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._requests, self._answers = self._process.stdin, self._process.stdout
        self._ended: BaseException | None = None

    def begin(self) -> tuple[float, ...]:
        """Begin a run; return the variables at its beginning."""
        return self._ask(b"r", 0.0, "an instance that begins")

    def step(self, u: float, sample: int) -> tuple[float, ...]:
        """Hold a command for a sample; return the variables after it. Raises as `begin`."""
        return self._ask(b"s", u, f"a step of {self.Ts:g} s from {sample * self.Ts:g} s")

    def close(self) -> None:
        with contextlib.suppress(OSError):
            self._requests.close()
        try:
            # time for an FMU to end by itself [s]
            self._process.wait(0.0 if self._ended else 5.0)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self._answers.close()

    def _ask(self, kind: bytes, u: float, what: str) -> tuple[float, ...]:
        if self._ended is not None:
            raise self._ended  # stopping the machine afterwards raises the same reason
        try:
            self._requests.write(_REQUEST.pack(kind, u))
            until = time.monotonic() + self.timeout
            good, *values = _ANSWER.unpack(self._read(_ANSWER.size, until))
            if good:
                return tuple(values)
            said = self._read(int(values[0]), until).decode(errors="replace")
        except TimeoutError:
            self._fail(what, f"no answer within {self.timeout:g} s", "give a longer timeout=")
        except (BrokenPipeError, EOFError):
            code = self._process.wait()
            how = f"code {code}"
            if code < 0:
                with contextlib.suppress(ValueError):
                    how = signal.Signals(-code).name
            self._fail(what, f"a process that ended ({how})", "its binary is faulty")
        except BaseException as error:
            self._ended = error
            self._process.kill()
            raise
        remedy = (
            "give a Ts that its solver can do"
            if kind == b"s"
            else "export it again, with its binary for this system"
        )
        self._fail(what, said.strip() or "an error without a message", remedy)

    def _fail(self, what: str, received: str, remedy: str) -> NoReturn:
        self._process.kill()
        self._ended = SettingError(
            name=str(self.path),
            expected=what,
            received=received[:400],
            remedy=f"{remedy}; or try the FMU in the tool that exported it",
        )
        raise self._ended

    def _read(self, size: int, until: float) -> bytes:
        whole = b""
        while len(whole) < size:
            # only POSIX can wait for pipes; elsewhere an endless step is not ended
            if os.name == "posix":
                left = until - time.monotonic()
                if not select.select([self._answers], [], [], max(left, 0.0))[0]:
                    raise TimeoutError
            part = self._answers.read(size - len(whole))
            if not part:
                raise EOFError
            whole += part
        return whole


# --- In the process -------------------------------------------------------------------------------


def serve() -> None:
    """Answer requests until the input ends; `sys.argv[1]` holds the arguments of `FmuProcess`."""
    answers = os.fdopen(os.dup(1), "wb", buffering=0)
    os.dup2(2, 1)  # an FMU's own output goes to the user
    _end_with_the_caller()
    folder, taken, measured, start, Ts = json.loads(sys.argv[1])
    slave, sample = _Slave(folder), 0
    while len(request := os.read(0, _REQUEST.size)) == _REQUEST.size:
        kind, u = _REQUEST.unpack(request)
        try:
            if kind == b"r":
                sample = 0
                slave.begin([*start, (taken, 0.0)])
            else:
                slave.set(taken, u)
                slave.fmu.doStep(sample * Ts, Ts)
                sample += 1
            values = [math.nan if v is None else slave.get(v) for v in measured]
            answers.write(_ANSWER.pack(True, *values))
        except Exception as error:
            said = str(error).encode()[:2000]
            answers.write(_ANSWER.pack(False, len(said), 0.0, 0.0) + said)
    slave.end()


def _end_with_the_caller() -> None:
    """End this process when the caller is killed, even within an endless step."""
    if sys.platform == "linux":
        import ctypes

        set_parent_death_signal = 1
        ctypes.CDLL(None).prctl(set_parent_death_signal, int(signal.SIGKILL))


class _Slave:
    """An instance in FMPy, of any version of FMI."""

    def __init__(self, folder: str) -> None:
        import fmpy

        self._fmpy, self._folder = fmpy, folder
        self._description = fmpy.read_model_description(folder)
        self._three = self._description.fmiVersion.startswith("3.")
        self.fmu: Any = None

    def begin(self, values: Sequence[tuple[int, float]]) -> None:
        self.end()
        fmu = self._fmpy.instantiate_fmu(self._folder, self._description, "CoSimulation")
        self.fmu = fmu
        *start, taken = values
        for reference, value in start:
            self.set(reference, value)
        if self._description.fmiVersion.startswith("1."):
            fmu.initialize()
            return
        if self._description.fmiVersion.startswith("2."):
            fmu.setupExperiment(startTime=0.0)
        fmu.enterInitializationMode()
        self.set(*taken)
        fmu.exitInitializationMode()

    def get(self, reference: int) -> float:
        read = self.fmu.getFloat64 if self._three else self.fmu.getReal
        return float(read([reference])[0])

    def set(self, reference: int, value: float) -> None:
        (self.fmu.setFloat64 if self._three else self.fmu.setReal)([reference], [value])

    def end(self) -> None:
        if self.fmu is not None:
            fmu, self.fmu = self.fmu, None
            fmu.terminate()
            fmu.freeInstance()
