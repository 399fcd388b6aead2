"""Long steps, each in a process of its own: a crash or an endless search leaves the server alone.

The server sends the step and keeps the pipe open; its end, by a cancel or with the server, ends the
work. Progress and the result come back by another pipe. Both carry pickles, which only these two
processes write.
"""

from __future__ import annotations

import _thread
import math
import os
import pickle
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO, Any

from ..errors import Interrupted, SettingError
from .bench import said

BETWEEN_REPORTS = 0.05
"""Seconds between two messages of a step's progress."""

GRACE = 0.4
"""Seconds that a cancelled step has to hand over its best so far, before its process is ended."""

LAST_WORDS = 5.0
"""Seconds that a step has to end by itself where the server is gone."""

CANCELLED = "cancelled; nothing was written"
LATE = "cancelled after its files had been written; they are whole"

_PROGRAM = "import sys; sys.path[:] = {path!r}; from sewfast.studio.jobs import main; main()"


class Jobs:
    """At most one long step at a time.

    Parameters
    ----------
    folder : Path
        The project.
    tell : callable(event)
        Takes progress and results; called in a thread of its own.
    """

    def __init__(self, folder: Path, tell: Callable[[dict[str, Any]], None]) -> None:
        self.folder, self._tell = folder, tell
        self._lock = threading.Lock()
        self._program: subprocess.Popen[bytes] | None = None
        self._ear: threading.Thread | None = None
        self._cancelled = self._writes = self._wrote = False

    def start(
        self, event: str, step: str, *arguments: Any,
        finish: Callable[[Any], dict[str, Any]] | None = None,
    ) -> None:  # fmt: skip
        """Begin a function of `work`; what it returns becomes an event.

        Parameters
        ----------
        event : str
            Name of the event with the result.
        step : str
            Name of the function.
        *arguments
            Of the function after the project and the report.
        finish : callable, optional
            Makes what pages hear of what the function returned.

        Raises
        ------
        SettingError
            Where another step is running.
        """
        with self._lock:
            if self._ear is not None and self._ear.is_alive():
                raise SettingError(
                    expected="nothing else under way", received="a job that runs",
                    remedy="cancel it or wait for its end",
                )  # fmt: skip
            self._cancelled = self._writes = self._wrote = False
            program = self._program = subprocess.Popen(
                [sys.executable, "-c", _PROGRAM.format(path=sys.path)],
                stdin=subprocess.PIPE, stdout=subprocess.PIPE,
                # Ctrl-C is for the server, whose end is the end of this
                start_new_session=True,
            )  # fmt: skip
            self._ear = threading.Thread(
                target=self._listen, args=(program, event, finish), daemon=True
            )
            self._ear.start()
        assert program.stdin is not None
        with suppress(OSError, ValueError):  # it has ended already, and the listener says so
            program.stdin.write(pickle.dumps((self.folder, event, step, arguments)))
            program.stdin.flush()

    def cancel(self) -> None:
        """End the step; within `GRACE` it may hand over what it has."""
        with self._lock:
            program = self._program
            if program is None or self._cancelled:
                return
            self._cancelled = True
            assert program.stdin is not None
            with suppress(OSError):
                program.stdin.close()
        self._end_soon(program)

    def _end_soon(self, program: subprocess.Popen[bytes]) -> None:
        def end() -> None:
            # files that are being written become whole first
            if self._writes and program.poll() is None:
                self._end_soon(program)
            else:
                program.kill()

        timer = threading.Timer(GRACE, end)
        timer.daemon = True
        timer.start()

    def close(self) -> None:
        """Cancel, and wait for the end."""
        self.cancel()
        if self._ear is not None:
            self._ear.join()

    def _listen(
        self,
        program: subprocess.Popen[bytes],
        event: str,
        finish: Callable[[Any], dict[str, Any]] | None,
    ) -> None:
        found: dict[str, Any] | None = None
        assert program.stdout is not None
        assert program.stdin is not None
        with program.stdout as pipe, suppress(EOFError, pickle.UnpicklingError, OSError):
            while True:
                kind, value = pickle.load(pipe)
                if kind == "progress":
                    self._tell(value)
                elif kind == "writes":
                    self._writes, self._wrote = value, True
                else:
                    found = {kind: value}
        program.wait()
        with suppress(OSError):
            program.stdin.close()
        if found is None:
            found = {
                "error": CANCELLED if self._cancelled and not self._wrote else
                LATE if self._cancelled else
                f"the process of this step ended without a result (exit {program.returncode}); the "
                "studio goes on: try again, with less data or a simpler model"
            }  # fmt: skip
        elif found.get("error") == CANCELLED and self._wrote:
            found = {"error": LATE}
        elif "found" in found and finish is not None:
            try:
                found = {"found": finish(found["found"])}
            except Exception as e:
                found = {"error": said(e)}
        # whoever hears of the end may begin the next step at once
        self._ear = None
        self._tell({"event": event, **found})


class Report:
    """Progress of a step, in its process.

    Parameters
    ----------
    send : callable(kind, value)
    event : str
        Of which step.
    """

    def __init__(self, send: Callable[[str, Any], None], event: str) -> None:
        self._send, self._event = send, event
        self._sent, self._stage = -math.inf, ""
        self.cancelled = threading.Event()
        self.lock = threading.Lock()

    def __call__(self, done: int, total: int, best: float | str) -> None:
        if self.cancelled.is_set():
            raise KeyboardInterrupt
        before = self._stage
        self._stage = str(best).split(" ")[0] if isinstance(best, str) else ""
        if self._stage != before or time.monotonic() - self._sent > BETWEEN_REPORTS:
            self._sent = time.monotonic()
            self._send("progress", {
                "event": "progress", "of": self._event, "done": done, "total": total, "best": best
            })  # fmt: skip

    @contextmanager
    def writing(self) -> Iterator[None]:
        """Nothing interrupts what is done inside, so that files are whole or not there."""
        with self.lock:
            if self.cancelled.is_set():
                raise KeyboardInterrupt
            self._send("writes", True)
            yield
            self._send("writes", False)


def main() -> None:
    """Do the step that comes by standard input; end with that pipe."""
    from . import work

    asked: IO[bytes] = sys.stdin.buffer
    # whatever else is printed must not get between two messages
    out = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)
    sending = threading.Lock()

    def send(kind: str, value: Any) -> None:
        body = pickle.dumps((kind, value))
        with sending:
            out.write(body)
            out.flush()

    if hasattr(os, "nice"):
        os.nice(5)  # a slider of the page goes ahead of a search
    folder, event, step, arguments = pickle.load(asked)
    report, done = Report(send, event), threading.Event()

    def watch() -> None:
        asked.read()
        with report.lock:
            if done.is_set():
                return
            report.cancelled.set()
            _thread.interrupt_main()
        time.sleep(LAST_WORDS)
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()
    try:
        result = ("found", getattr(work, step)(folder, report, *arguments))
    except (KeyboardInterrupt, Interrupted):  # whoever passes it on makes one of the two of it
        result = ("error", CANCELLED)
    except Exception as e:
        result = ("error", said(e))
    done.set()
    with suppress(KeyboardInterrupt, OSError):
        send(*result)
    os._exit(0)  # nothing is left to do, and threads of a search may still run
