"""A terminal in which a page's reader types: `sewfast ...`, `export NAME=VALUE`, a trailing `&`.

What ends by itself is called in the test's own process: to start an interpreter for each of some
hundred commands takes longer than most of them.
"""

from __future__ import annotations

import os
import shlex
import subprocess
from collections.abc import Callable
from pathlib import Path
from types import TracebackType

from cli import PROGRAM, call, environment
from documents import Command


class Terminal:
    """Runs commands one after the other; those in the background end with the block.

    Parameters
    ----------
    page : str
        For messages.
    export : callable
        Sets a variable of the environment.
    """

    def __init__(self, page: str, export: Callable[[str, str], None]) -> None:
        self._page = page
        self._export = export
        self._background: list[subprocess.Popen[str]] = []

    def run(self, command: Command) -> None:
        """Run it; it must end as the page shows, well where the page shows nothing."""
        program, *arguments = shlex.split(os.path.expandvars(command.text))
        if program == "export":
            name, _, value = arguments[0].partition("=")
            return self._export(name, value)
        assert program == "sewfast", f"{self._page}: only sewfast is run here: {command.text!r}"
        if arguments[-1] == "&":
            return self._begin(arguments[:-1])
        done = call(Path.cwd(), *arguments)
        said = f"{self._page}: {command.text}\n{done.out}{done.err}"
        assert done.code == (2 if command.refusal_is_shown else 0), said
        if command.shown:
            printed = done.err if command.refusal_is_shown else done.out
            assert command.shows(printed), f"{said}\nshown:\n{command.shown}"
        return None

    def _begin(self, arguments: list[str]) -> None:
        """Start it and wait for its first line, by which it says that it is there."""
        started = subprocess.Popen(
            [*PROGRAM, *arguments], env=environment(), stdout=subprocess.PIPE,
            stderr=subprocess.PIPE, text=True,
        )  # fmt: skip
        self._background.append(started)
        assert started.stdout is not None
        assert started.stdout.readline(), f"{self._page}: {started.communicate()[1]}"

    def __enter__(self) -> Terminal:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        for started in self._background:
            started.terminate()
        for started in self._background:
            _, errors = started.communicate(timeout=30)
            assert error is not None or started.returncode == 0, errors
