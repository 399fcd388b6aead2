"""Ctrl-C: it interrupts a command once, and ends the process in time whatever the command does."""

from __future__ import annotations

import _thread
import atexit
import os
import signal
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from types import FrameType
from typing import Any

from ..written import discard, written
from .output import INTERRUPTED

SIGNALS = tuple(getattr(signal, n) for n in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, n))
"""Ctrl-C, the end of a session or a shutdown, a closed terminal: each acts as Ctrl-C."""
GRACE = 0.7
"""Time for a command to end by itself [s]; Ctrl-C is to take no longer than a second."""

_pressed = _is_patient = False
_end_at = 0.0


def listen() -> None:
    """Interrupt the command at the first signal, end the process `GRACE` later, ignore further
    ones; a signal that a background job ignores stays ignored.
    """
    for number in SIGNALS:
        if signal.getsignal(number) in (signal.default_int_handler, signal.SIG_DFL):
            signal.signal(number, _press)
    # an interrupt in a finaliser or a callback is lost there; the process still ends in time
    told = sys.unraisablehook
    sys.unraisablehook = lambda lost: None if _pressed else told(lost)


def is_pressed() -> bool:
    """Whether a signal has come: whatever the command raises since then is its consequence."""
    return _pressed


def deaf() -> None:
    """Ignore the signals from now on: the command is done, and its exit code is known."""
    for number in SIGNALS:
        signal.signal(number, signal.SIG_IGN)


def leave(code: int) -> None:
    """End the process of an interrupted command at once: where the import of a library was
    interrupted, what is left of it can abort the interpreter as it ends.
    """
    with suppress(Exception):
        atexit._run_exitfuncs()
    for stream in (sys.stdout, sys.stderr):
        with suppress(Exception):  # a closed pipe
            stream.flush()
    os._exit(code)


@contextmanager
def patient() -> Iterator[None]:
    """Leave a command the time to stop a motor, and then that to end."""
    global _end_at, _is_patient
    _is_patient = True
    try:
        yield
    finally:
        _is_patient, _end_at = False, time.monotonic() + GRACE


def _press(number: int, frame: FrameType | None) -> None:
    global _end_at, _pressed
    deaf()
    _pressed = True
    # while a drive is open, its motor is to stop first
    _end_at = time.monotonic() + (10.0 if _is_patient else GRACE)
    # no threading.Thread: the interrupted code can hold the locks that starting one needs
    _thread.start_new_thread(_end, ())
    raise KeyboardInterrupt


def _end() -> None:
    """End the process once its time is over, with a message and without leftovers."""
    while time.monotonic() < _end_at:
        time.sleep(0.02)
    discard()
    processes: Any = sys.modules.get("multiprocessing")
    for process in () if processes is None else processes.active_children():
        process.kill()
    name = next((word for word in sys.argv[1:] if not word.startswith("-")), "")
    os.write(2, f"sewfast {name}: {told()}\n".encode())
    os._exit(INTERRUPTED)


def told() -> str:
    """The message of an interrupted command: what it wrote."""
    files: dict[Path, list[Path]] = {}
    for path in written():
        files.setdefault(path.parent, []).append(path)
    names = [
        f"{len(paths)} files in {_shown(folder)}"
        if len(paths) > 3
        else ", ".join(map(_shown, paths))
        for folder, paths in files.items()
    ]
    return f"interrupted; {'written: ' + '; '.join(names) if names else 'nothing was written'}"


def _shown(path: Path) -> str:
    """A path as in a command: relative if it lies in the working folder."""
    try:
        return str(path.relative_to(Path.cwd()))
    except (ValueError, OSError):
        return str(path)
