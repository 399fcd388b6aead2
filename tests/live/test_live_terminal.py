"""The status line on a real pseudo-terminal: what a user sees, and what happens when it hangs."""

from __future__ import annotations

import contextlib
import os
import signal
import struct
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest

from sewfast.errors import SettingError
from sewfast.live import Feed, open_view

fcntl = pytest.importorskip("fcntl", reason="needs pseudo-terminals")
termios = pytest.importorskip("termios", reason="needs pseudo-terminals")
pyte = pytest.importorskip("pyte", reason="needs the test extra")

ROOT = Path(__file__).resolve().parents[2]


class Terminal:
    """A terminal on standard error, with a screen that can be looked at."""

    def __init__(self, columns: int, rows: int, monkeypatch: pytest.MonkeyPatch) -> None:
        self._patch = monkeypatch
        self._ours, self.theirs = os.openpty()
        self.screen = pyte.Screen(columns, rows)
        self._stream = pyte.ByteStream(self.screen)
        self._lock = threading.Lock()
        self.output = b""
        self.resize(columns, rows)
        self._reader: threading.Thread | None = None

    def resize(self, columns: int, rows: int) -> None:
        fcntl.ioctl(self._ours, termios.TIOCSWINSZ, struct.pack("HHHH", rows, columns, 0, 0))
        with self._lock:
            self.screen.resize(rows, columns)

    def read(self) -> None:
        """Read in the background, as a terminal does."""
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def attach(self, encoding: str = "utf-8", *, reading: bool = True) -> None:
        """Become standard error, once the test itself runs: pytest has its own before that."""
        stream = open(self.theirs, "w", encoding=encoding, closefd=False)  # noqa: SIM115
        self._patch.setattr(sys, "stderr", stream)
        if reading:
            self.read()

    def fill(self) -> None:
        """Write until it takes no more."""
        pen = os.open(os.ttyname(self.theirs), os.O_WRONLY | os.O_NONBLOCK)
        with contextlib.suppress(BlockingIOError):
            while True:
                os.write(pen, b"x" * 100)
        os.close(pen)

    def hang_up(self) -> None:
        """Go away, as a terminal whose window is closed."""
        os.close(self._ours)

    def _read(self) -> None:
        while True:
            try:
                chunk = os.read(self._ours, 65536)
            except OSError:  # the other side is closed
                return
            if not chunk:
                return
            self.output += chunk
            with self._lock:
                self._stream.feed(chunk)

    @property
    def reading(self) -> bool:
        return self._reader is not None and self._reader.is_alive()

    def finish(self) -> list[str]:
        """Lines of the screen once all was written, without the empty ones at the end."""
        os.close(self.theirs)
        if self._reader is not None:
            self._reader.join(60)
        os.close(self._ours)
        return "\n".join(line.rstrip() for line in self.screen.display).rstrip().split("\n")


@pytest.fixture
def terminal(monkeypatch: pytest.MonkeyPatch) -> Terminal:
    """80 x 24."""
    return Terminal(80, 24, monkeypatch)


def play(feed: Feed, seconds: float = 0.5) -> None:
    """Two seconds of samples within so many seconds, with a gap in them."""
    t = 0.001 * np.arange(2000)
    for first in range(0, 2000, 10):
        if first == 1000:
            feed.say("gap of 50 samples at 1.000 s")
        if not 1000 <= first < 1050:
            part = slice(first, first + 10)
            feed.put(first, {"u": 5 * np.sin(9 * t[part]), "counts": np.floor(9e3 * t[part] ** 2)})
        time.sleep(seconds / 200)


def feed(n: int | None = 2000) -> Feed:
    return Feed({"u": "V", "counts": ""}, 0.001, n, "record sine", counts_per_rev=1572)


def test_record_without_a_sample_leaves_one_line(terminal: Terminal) -> None:
    terminal.attach()
    with open_view("auto", feed()) as view:
        assert view is not None
    assert terminal.finish() == ["record sine: waiting for the first sample"]


def test_what_happened_stands_above_the_last_status(terminal: Terminal) -> None:
    terminal.attach()
    f = feed()
    began = time.monotonic()
    with open_view("terminal", f):
        play(f)
    passed = time.monotonic() - began
    gap, line = terminal.finish()
    assert gap == "gap of 50 samples at 1.000 s"
    assert line.startswith("2.00 of 2.00 s   97.50 % received (50 missing, 1 gap)   speed ")
    assert 1 <= terminal.output.count(b"\r") <= passed / 0.1 + 6


def test_no_mode_of_the_terminal_is_changed(terminal: Terminal) -> None:
    """Nothing hidden, no other screen: whatever ends the program, nothing is to be restored."""
    before = termios.tcgetattr(terminal.theirs)
    terminal.attach()
    f = feed()
    with open_view("terminal", f):
        play(f, 0.25)
    assert termios.tcgetattr(terminal.theirs) == before
    terminal.finish()
    assert b"\x1b" not in terminal.output
    assert terminal.screen.cursor.x == 0


def test_what_was_above_the_line_stays_there(terminal: Terminal) -> None:
    terminal.attach()
    sys.stderr.write("$ sewfast record\n")
    sys.stderr.flush()
    f = feed()
    with open_view("terminal", f):
        play(f, 0.3)
    sys.stderr.write("written to sine.mcap\n")
    sys.stderr.flush()
    first, gap, line, last = terminal.finish()
    assert (first, gap) == ("$ sewfast record", "gap of 50 samples at 1.000 s")
    assert line.startswith("2.00 of 2.00 s")
    assert last == "written to sine.mcap"


@pytest.mark.parametrize("size", [(50, 20), (140, 45), (30, 24), (80, 8)])
def test_resize(terminal: Terminal, size: tuple[int, int]) -> None:
    terminal.attach()
    f = feed()
    with open_view("terminal", f):
        play(f, 0.3)
        terminal.resize(*size)
        f.say("resized")
        time.sleep(0.3)
    lines = terminal.finish()
    assert all(len(line) <= size[0] for line in lines)
    # a terminal that was made narrower may keep the last character of the longer line before
    assert lines[-2].split()[0] == "resized"
    assert lines[-1].startswith("2.00 of 2.00 s")


def test_other_encodings(terminal: Terminal) -> None:
    terminal.attach("ascii")
    f = feed()
    with open_view("terminal", f):
        f.say("\u03c9 = 3\x1b[2J")
        time.sleep(0.3)
    assert terminal.finish()[0] == "? = 3?[2J"
    assert terminal.output.isascii()


@pytest.mark.parametrize("where", ["process", "thread", "shared"])
def test_blocked_terminal_holds_nothing_up(
    terminal: Terminal, monkeypatch: pytest.MonkeyPatch, where: str
) -> None:
    """Nobody reads: puts go on, and the end comes; also where it cannot be opened anew."""
    terminal.attach(reading=False)
    terminal.fill()
    if where == "shared":
        monkeypatch.setattr(os, "ttyname", _no_name)
    f = feed(None)
    with open_view("terminal", f, own_process=where == "process"):
        for k in range(30):
            for first in range(0, 1000, 10):
                f.put(1000 * k + first, {"u": np.zeros(10), "counts": np.zeros(10)})
            f.say("x" * 1000)
            time.sleep(0.02)
        assert f.received == 30_000
        began = time.monotonic()
    assert time.monotonic() - began < 30
    # what still waits for a shared terminal is let go
    terminal.hang_up()
    for thread in threading.enumerate():
        if thread.name == "live view":
            thread.join(60)
            assert not thread.is_alive()


def _no_name(_: int) -> str:
    raise OSError("no name")


def test_shared_terminal_is_written_to(terminal: Terminal, monkeypatch: pytest.MonkeyPatch) -> None:
    """Where it cannot be opened anew."""
    monkeypatch.setattr(os, "ttyname", _no_name)
    terminal.attach()
    f = feed()
    with open_view("terminal", f, own_process=False):
        play(f, 0.3)
    gap, line = terminal.finish()
    assert gap == "gap of 50 samples at 1.000 s"
    assert line.startswith("2.00 of 2.00 s")


def test_terminal_that_goes_away_costs_the_record_nothing(terminal: Terminal) -> None:
    terminal.attach(reading=False)
    f = feed()
    with open_view("terminal", f):
        terminal.hang_up()
        play(f, 0.3)
    assert f.received == 1950


def test_not_a_terminal_is_silent(
    monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    f = feed()
    with open_view("auto", f) as view:
        play(f, 0.1)
    assert view is None
    assert f.closed.is_set()
    assert capfd.readouterr() == ("", "")


def test_terminal_that_is_none_is_refused() -> None:
    with (
        pytest.raises(SettingError, match="standard error to be a terminal"),
        open_view("terminal", feed()),
    ):
        pass


def test_error_of_the_record_goes_through(terminal: Terminal) -> None:
    terminal.attach()
    f = feed()

    def record() -> None:
        with open_view("terminal", f):
            play(f, 0.1)
            raise OSError("unplugged")

    with pytest.raises(OSError, match="unplugged"):
        record()
    assert "gap of 50 samples at 1.000 s" in terminal.finish()


@pytest.mark.parametrize("kind", ["auto", "terminal"])
def test_view_that_does_not_start(
    terminal: Terminal, monkeypatch: pytest.MonkeyPatch, kind: str
) -> None:
    """Refused where it was asked for; else the record goes on with a line."""
    terminal.attach()
    monkeypatch.setattr(sys, "executable", "/nowhere/python")
    f = feed()
    asked = pytest.raises(SettingError, match="expected another process for the live view")
    with asked if kind == "terminal" else contextlib.nullcontext(), open_view(kind, f) as view:
        play(f, 0.1)
        assert view is None
    assert f.closed.is_set()
    terminal.finish()
    assert (b"the live view ended early" in terminal.output) == (kind == "auto")


def test_failing_view_costs_a_line(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def fail(*_: object) -> None:
        raise ValueError("broken")

    monkeypatch.setattr("sewfast.live.stream.PlotJugglerView._send", fail)
    f = feed()
    with open_view("plotjuggler", f, own_process=False):
        play(f, 0.1)
    assert f.received == 1950
    assert "the live view ended early: ValueError: broken" in capsys.readouterr().err


PROGRAM = """
import time, numpy as np
from sewfast.live import Feed, open_view
feed = Feed({"u": "V"}, 0.001, None, "endless")
with open_view("auto", feed):
    for first in range(0, 1_000_000, 10):
        feed.put(first, {"u": np.sin(np.arange(first, first + 10) / 300)})
        time.sleep(0.005)
"""


def test_ctrl_c_leaves_the_last_line(terminal: Terminal) -> None:
    terminal.read()
    process = subprocess.Popen(
        [sys.executable, "-c", PROGRAM],
        stderr=terminal.theirs,
        env={**os.environ, "PYTHONUTF8": "1"},
        cwd=ROOT,
    )
    deadline = time.monotonic() + 60
    while terminal.output.count(b"\r") < 3 and time.monotonic() < deadline:
        time.sleep(0.05)
    process.send_signal(signal.SIGINT)
    assert process.wait(60) != 0
    lines = terminal.finish()
    first = next(k for k, line in enumerate(lines) if line.startswith("Traceback"))
    assert "all samples received" in lines[first - 1]
    assert b"\x1b" not in terminal.output
    assert lines[-1] == "KeyboardInterrupt"


def test_view_ends_with_a_program_that_was_killed(terminal: Terminal) -> None:
    terminal.read()
    process = subprocess.Popen(
        [sys.executable, "-c", PROGRAM],
        stderr=terminal.theirs,
        env={**os.environ, "PYTHONUTF8": "1"},
        cwd=ROOT,
    )
    deadline = time.monotonic() + 60
    while terminal.output.count(b"\r") < 3 and time.monotonic() < deadline:
        time.sleep(0.05)
    process.kill()
    process.wait()
    # the terminal ends once nobody holds it open: neither program nor view
    lines = terminal.finish()
    assert "all samples received" in lines[-1]
    assert not terminal.reading
