"""Progress of long work: on a terminal, in a notebook, in a pipe."""

from __future__ import annotations

import logging
import math
import sys
import threading
from types import ModuleType
from typing import Any

import numpy as np
import pytest

import sewfast
from plants import bent_data
from sewfast import progress
from sewfast.progress import Progress, shown_in_notebooks

Cell = list[dict[str, str]]


class Handle:
    """IPython's display handle, as far as it is used here."""

    cell: Cell

    def display(self, content: dict[str, str], raw: bool) -> None:
        assert raw
        self.cell.append(content)

    def update(self, content: dict[str, str], raw: bool) -> None:
        assert raw
        self.cell[-1] = content


class Shell:
    def __init__(self, kernel: object) -> None:
        self.kernel = kernel


@pytest.fixture
def cell(monkeypatch: pytest.MonkeyPatch) -> Cell:
    """What stands below a cell of a notebook in which this test runs."""
    shown: Cell = []
    ipython, display = ModuleType("IPython"), ModuleType("IPython.display")
    vars(ipython)["get_ipython"] = lambda: Shell(object())
    vars(display)["DisplayHandle"] = type("DisplayHandle", (Handle,), {"cell": shown})
    monkeypatch.setitem(sys.modules, "IPython", ipython)
    monkeypatch.setitem(sys.modules, "IPython.display", display)
    monkeypatch.setattr(progress, "_FIRST_BAR", 0.0)
    monkeypatch.setattr(progress, "_BETWEEN", 0.0)
    return shown


def test_a_notebook_shows_a_bar_that_goes_when_the_work_ends(cell: Cell) -> None:
    with Progress("identify") as bar:
        bar(250, 1000, 1.5)
        assert len(cell) == 1
        assert 'value="0.250"' in cell[0]["text/html"]
        assert "250/1000  best 1.5" in cell[0]["text/html"]
        bar(500, 1000, "<stage>")
        assert len(cell) == 1
        assert "&lt;stage&gt;" in cell[0]["text/html"]
    assert cell == [{"text/html": "", "text/plain": ""}]


def test_quick_work_leaves_nothing_in_a_notebook(
    cell: Cell, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(progress, "_FIRST_BAR", 60.0)
    with Progress("identify") as bar:
        bar(1, 2, 1.0)
    assert cell == []


def test_identify_and_tune_show_a_bar_in_a_notebook_unless_progress_is_given(cell: Cell) -> None:
    data = bent_data(600, noise=0.05)
    model = sewfast.identify(data, model="neural_oe", na=1, nb=1, hidden=2, starts=1)
    assert len(cell) == 1
    sewfast.identify(data, model="neural_oe", na=1, nb=1, hidden=2, starts=1, progress=None)
    assert len(cell) == 1
    steps: list[int] = []

    def given(done: int, total: int, best: float) -> None:
        steps.append(done)

    sewfast.identify(data, model="neural_oe", na=1, nb=1, hidden=2, starts=1, progress=given)
    assert steps
    assert len(cell) == 1
    sewfast.tune(model, np.ones(100), evaluations=20)
    assert len(cell) == 2


def test_work_within_other_work_shows_no_bar_of_its_own(cell: Cell) -> None:
    @shown_in_notebooks("inner")
    def inner(progress: Any = None) -> bool:
        return progress is not None

    @shown_in_notebooks("outer")
    def outer(progress: Any = None) -> bool:
        progress(1, 2, "stage")
        return inner()

    assert not outer()
    assert len(cell) == 1
    assert inner()


def test_another_thread_shows_no_bar(cell: Cell) -> None:
    @shown_in_notebooks("work")
    def work(progress: Any = None) -> None:
        found.append(progress)

    found: list[Any] = []
    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    assert found == [None]


def test_without_a_notebook_functions_show_nothing(capsys: pytest.CaptureFixture[str]) -> None:
    assert not progress.in_notebook()

    @shown_in_notebooks("work")
    def work(progress: Any = None) -> bool:
        return progress is not None

    assert not work()
    assert capsys.readouterr().err == ""


def test_a_terminal_of_ipython_is_no_notebook(monkeypatch: pytest.MonkeyPatch) -> None:
    ipython = ModuleType("IPython")
    vars(ipython)["get_ipython"] = object
    monkeypatch.setitem(sys.modules, "IPython", ipython)
    assert not progress.in_notebook()


@pytest.mark.parametrize(
    ("call", "expected"),
    [
        (lambda p: p(3, 4, 0.5), "work: 75 %, best 0.5, "),
        (lambda p: p(3, 4, "training"), "work: 75 %, training, "),
        (lambda p: p(3, 4, math.inf), "work: 75 %, "),
        (lambda p: p.count(1, 4), "work: 25 %, "),
        (lambda p: p.say("a stage"), "work: a stage, "),
    ],
)
def test_a_pipe_gets_a_line_now_and_then(
    call: Any, expected: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    clock = iter([0.0, 1.0, 11.0, 12.0, 17.0])
    monkeypatch.setattr(progress.time, "monotonic", lambda: next(clock))
    with Progress("work") as shown:
        for _ in range(4):
            call(shown)
    lines = capsys.readouterr().err.splitlines()
    assert [line.removeprefix(expected) for line in lines] == ["11 s", "17 s"]


def test_the_log_has_lines_where_it_is_turned_on(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    @shown_in_notebooks("identify")
    def work(progress: Any = None) -> None:
        if progress is not None:
            progress(1, 4, 2.5)

    monkeypatch.setattr(progress, "_FIRST_LINE", 0.0)
    work()
    assert caplog.messages == []
    caplog.set_level(logging.INFO, "sewfast")
    work()
    assert [m.partition(" in ")[0] for m in caplog.messages] == [
        "identify: 25 %, best 2.5, 0 s", "identify: done",
    ]  # fmt: skip
    caplog.clear()
    work(progress=None)
    assert [m.partition(" in ")[0] for m in caplog.messages] == ["identify: done"]


def test_quiet_progress_shows_nothing(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(progress, "_FIRST_LINE", 0.0)
    with Progress("identify", quiet=True) as shown:
        shown(1, 2, 1.0)
        shown.say("stage")
    assert capsys.readouterr().err == ""
