"""A page's steps on a project; the long ones each in a process, so that a crash stays there.

The server sends the step and keeps the pipe open; the end of the pipe, by a cancel or with the
server, ends the work. Progress and result come back by another pipe. Both carry pickles, which only
these two processes write.
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
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any

import numpy as np

from sewfast.errors import Interrupted, SettingError

from .loops import shown_loop, shown_response
from .project import CONTROLLER_FORMAT, MODEL_FORMAT, Project, checked_name
from .requests import COMMISSIONED, Commission, Step, carry_out
from .tuning import Found, Search, Tuning
from .words import error_text

if TYPE_CHECKING:
    from sewfast.dataset import FloatArray
    from sewfast.frequency import FrequencyResponse


BETWEEN_REPORTS = 0.05
"""Time between two messages of a step's progress [s]."""

GRACE = 0.4
"""Time for a cancelled step to return its best result so far before its process is killed [s]."""

LAST_WORDS = 5.0
"""Time for a step to end by itself after the server has ended [s]."""

CANCELLED = "cancelled; nothing was written"
LATE = "cancelled after its files had been written; they are complete"

_PROGRAM = "import sys; sys.path[:] = {path!r}; from sewfast_studio.jobs import main; main()"


class Jobs:
    """At most one long step at a time, on the project in `folder`.
    `tell(event)` takes progress and results; it is called in its own thread.
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
        """Start the function `step` of the `STEPS`; its result becomes the event named `event`.
        `arguments` follow the project and the report; `finish` converts the result for the pages.
        Raises `SettingError` if another step is running.
        """
        with self._lock:
            if self._ear is not None and self._ear.is_alive():
                raise SettingError(
                    expected="no other step running", received="a job that runs",
                    remedy="cancel it or wait for its end",
                )  # fmt: skip
            self._cancelled = self._writes = self._wrote = False
            program = self._program = subprocess.Popen(
                [sys.executable, "-c", _PROGRAM.format(path=sys.path)],
                stdin=subprocess.PIPE, stdout=subprocess.PIPE,
                # keep Ctrl-C for the server, whose end ends this process
                start_new_session=True,
            )  # fmt: skip
            self._ear = threading.Thread(
                target=self._listen, args=(program, event, finish), daemon=True
            )
            self._ear.start()
        assert program.stdin is not None
        with suppress(OSError, ValueError):  # it has ended already, which the listener reports
            program.stdin.write(pickle.dumps((self.folder, event, step, arguments)))
            program.stdin.flush()

    def cancel(self) -> None:
        """End the step; within `GRACE` it can return its best result so far."""
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
            # wait for files that are being written
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
                found = {"error": error_text(e)}
        # reset it first: the next step can start as soon as the event is sent
        self._ear = None
        self._tell({"event": event, **found})


class Report:
    """Progress of a step, in its process. `send(kind, value)` takes it; `event` names the step."""

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
        """Protect the writing of files from a cancel, so that they are complete or absent."""
        with self.lock:
            if self.cancelled.is_set():
                raise KeyboardInterrupt
            self._send("writes", True)
            yield
            self._send("writes", False)


def main() -> None:
    """Run the step that arrives on standard input; end with that pipe."""
    asked: IO[bytes] = sys.stdin.buffer
    # keep other output out of the stream of messages
    out = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)
    sending = threading.Lock()

    def send(kind: str, value: Any) -> None:
        body = pickle.dumps((kind, value))
        with sending:
            out.write(body)
            out.flush()

    if hasattr(os, "nice"):
        os.nice(5)  # a slider of the page has priority over a search
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
        result = ("found", STEPS[step](folder, report, *arguments))
    except (KeyboardInterrupt, Interrupted):  # the API may have converted one into the other
        result = ("error", CANCELLED)
    except Exception as e:
        result = ("error", error_text(e))
    done.set()
    with suppress(KeyboardInterrupt, OSError):
        send(*result)
    os._exit(0)  # do not wait for threads of a search that may still run


# --- The steps, as calls of the public API --------------------------------------------------------


def identify(folder: Path, report: Report, step: Step) -> dict[str, Any]:
    """A model from a recording, written to the step's file."""
    return Project(folder).identify(step, report, report.writing)


def bode(
    folder: Path, report: Report, step: Step, reference: str | None, segment: int | None
) -> tuple[FrequencyResponse, dict[str, Any], Any]:
    """A measured response and its view for the page; fitting a shaft takes seconds."""
    report(0, 2, "response")
    response = Project(folder).bode(step, reference, segment)
    report(1, 2, "shaft")
    return response, *shown_response(response)


def tune(
    folder: Path, report: Report, model: str, controller: str | None, notches: Any,
    values: dict[str, Any], search: Search,
) -> Found:  # fmt: skip
    """A search that starts from the present values."""
    return Project(folder).tuning(model, controller, notches).search(values, search, report)


def front(
    folder: Path, report: Report, model: str, controller: str | None, notches: Any,
    values: dict[str, Any], search: Search,
) -> dict[str, Any]:  # fmt: skip
    """The trade-offs around the present values."""
    return Project(folder).tuning(model, controller, notches).front(values, search, report)


def commission(folder: Path, report: Report, asked: Commission) -> dict[str, Any]:
    """The commissioning of a virtual machine into the folder `commissioned`."""
    from sewfast.machine import VirtualMachine

    machine = VirtualMachine.from_name(asked.machine)
    return carry_out(asked, machine, folder, report, writing=report.writing)


def write_report(folder: Path, report: Report) -> dict[str, Any]:
    """The HTML report of a commissioning."""
    from sewfast.report import report as write

    report(0, 1, "report")
    with report.writing():
        written = write(folder / COMMISSIONED)
    return {
        "file": written.relative_to(folder).as_posix(),
        "python": f"from sewfast.report import report\n\nprint(report({COMMISSIONED!r}))\n",
        "commands": f"sewfast report {COMMISSIONED}\n",
    }


STEPS: dict[str, Callable[..., Any]] = {
    step.__name__: step for step in (identify, bode, tune, front, commission, write_report)
}
"""The long steps by name."""

# --- Steps: the requests of a page or a widget for steps on a project -----------------------------


KEPT = 4
"""Number of measured responses that are kept, to draw over a loop."""

Curves = Mapping[str, "FloatArray"]


class Steps:
    """Carries out the steps on a project; `jobs` runs the long ones."""

    def __init__(self, project: Project, jobs: Jobs) -> None:
        self.project, self.jobs = project, jobs
        self._responses: dict[int, FrequencyResponse] = {}
        self._last = 0

    def do(self, name: str, fields: dict[str, Any]) -> Any:
        """Carry out a checked message; return JSON values, or these and curves.
        Raises `SewfastError` for a refusal.
        """
        if name.startswith("tune") or name == "loop":
            return self._tune(name, fields)
        if name == "cancel":
            return self.jobs.cancel()
        if name == "commission":
            return self.jobs.start("commissioned", "commission", Commission.parse(fields))
        if name == "report":
            if not (self.project.folder / COMMISSIONED).is_dir():
                raise SettingError(
                    f"expected a folder {COMMISSIONED}, there is none; commission a machine first"
                )
            return self.jobs.start("reported", "write_report")
        step = Step.parse(fields)
        if name == "columns":
            return self.project.columns(step)
        if name == "bode":
            return self._bode(step, fields.get("reference") or None, fields.get("segment"))
        if name == "identify":
            # both refuse before the work starts
            self.project.place_for(step.model_file, MODEL_FORMAT, replace=step.replace)
            copies = self._copies(step, name)
            return self.jobs.start(
                "identified", name, step, finish=lambda found: {**found, **copies}
            )
        return {**getattr(self.project, name)(step), **self._copies(step, name)}

    def _bode(self, step: Step, reference: str | None, segment: int | None) -> None:
        # the filter of resampling looks ahead, which hides the delay; a response needs every sample
        step = replace(step, resample=None, mask=(), hold=False)
        copies = {
            "python": self.project.python(step, "bode", reference, segment),
            "commands": self.project.commands(step, "bode", reference, segment),
        }

        def finish(found: tuple[FrequencyResponse, dict[str, Any], Curves]) -> dict[str, Any]:
            response, shown, curves = found
            self._last += 1
            self._responses[self._last] = response
            self._responses.pop(self._last - KEPT, None)
            drawn = {name: values.tolist() for name, values in curves.items()}
            return {"response": self._last, **shown, "curves": drawn, **copies}

        self.jobs.start("responded", "bode", step, reference, segment, finish=finish)

    def _tune(self, name: str, fields: dict[str, Any]) -> Any:
        tuning = self.project.tuning(
            fields["model"], fields.get("controller"), _notches(fields.get("notches", []))
        )
        values = fields.get("values", {})
        if name == "loop":
            response = self._responses.get(fields.get("response") or 0)
            return shown_loop(tuning, values, response)
        if name == "tune_open":
            return tuning.opened()
        if name == "tune_move":
            return tuning.move(values, noise=fields.get("noise", False))
        if name == "tune_verdict":
            return tuning.verdict(values)
        if name == "tune_judge":
            return tuning.judged(values, fields.get("weights"))
        if name in ("tune_search", "tune_front"):
            return self._search(tuning, name, values, fields)
        file = checked_name(fields.get("file"))
        if name == "tune_save":
            replace = fields.get("replace", False)
            self.project.save_controller(tuning, values, file, replace=replace)
        return {"python": tuning.python(values, file), "commands": tuning.commands(values, file)}

    def _search(
        self, tuning: Tuning, name: str, values: dict[str, Any], fields: dict[str, Any]
    ) -> None:
        names = ("evaluations", "seed", "seconds", "weights", "constraints")
        search = Search(**{k: fields[k] for k in names if fields.get(k) is not None})
        tuning.check(search)
        tuning.controller(values)
        model, start = fields["model"], fields.get("controller")
        notches = _notches(fields.get("notches", []))
        project, task = self.project, (model, start, notches, values, search)
        follow = (
            project.follow(model, MODEL_FORMAT),
            (lambda: None) if start is None else project.follow(start, CONTROLLER_FORMAT),
        )

        def of() -> dict[str, Any]:
            """Where a page takes it: the same model and start, by their names at the end."""
            return dict(zip(("model", "start"), (now() for now in follow), strict=True))

        def found(result: Found) -> dict[str, Any]:
            names, here = of(), tuning
            if names != {"model": model, "start": start}:
                here = project.tuning(names["model"], names["start"], notches)
            return {**here.keep(result), **names}

        if name == "tune_search":
            self.jobs.start("searched", "tune", *task, finish=found)
        else:
            self.jobs.start("traded", "front", *task, finish=lambda front: {**front, **of()})

    def _copies(self, step: Step, name: str) -> dict[str, str]:
        return {
            "python": self.project.python(step, name),
            "commands": self.project.commands(step, name),
        }


def _notches(rows: list[list[float]]) -> tuple[tuple[float, float, float], ...]:
    for row in rows:
        if len(row) != 3 or not np.isfinite(row).all():
            raise SettingError(
                f"notches: expected frequency, depth and width of each, received {row!r:.60}"
            )
    return tuple((float(f), float(depth), float(width)) for f, depth, width in rows)
