"""`open_view`: the kinds of views, each in its own process."""

from __future__ import annotations

import contextlib
import json
import os
import select
import subprocess
import sys
import threading
import time
import unicodedata
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from typing import Any, Protocol, TextIO

import numpy as np

from ..errors import SettingError
from .feed import SPEED, Feed

# --- ViewKind: a view by its name on the command line ---------------------------------------------


KINDS = ("auto", "terminal", "none", "plotjuggler[:HOST:PORT]", "foxglove[:PORT]")

PLOTJUGGLER_PORT = 9870
FOXGLOVE_PORT = 8765

LOCAL = "127.0.0.1"
"""An address that only this computer reaches."""


@dataclass(frozen=True)
class ViewKind:
    """A view by name: `auto`, `terminal`, `none`, `plotjuggler` or `foxglove`. Streams have an
    address, `host` and `port`: that of PlotJuggler, or of the Foxglove server. The port is 0 for
    views without one, and for a Foxglove server on any free port.
    """

    name: str
    host: str = ""
    port: int = 0

    @classmethod
    def parse(cls, text: str) -> ViewKind:
        """The view named by a text such as `plotjuggler:HOST:PORT`; see `KINDS`. Raises
        `SettingError` for any other text, or a port outside 1 to 65535 (Foxglove: 0 to 65535).
        """
        if not isinstance(text, str):
            raise _refusal(text)
        name, _, rest = text.partition(":")
        if text in ("auto", "terminal", "none"):
            return cls(text)
        if name == "plotjuggler":
            return cls(name, *_host_and_port(text, rest))
        if name == "foxglove":
            return cls(name, LOCAL, _port(text, rest, 0) if rest else FOXGLOVE_PORT)
        raise _refusal(text)


def _host_and_port(text: str, rest: str) -> tuple[str, int]:
    if not rest:
        return LOCAL, PLOTJUGGLER_PORT
    host, _, port = rest.rpartition(":")
    if not host:
        raise _refusal(text)
    # an IPv6 address stands in brackets, to separate its colons from the port's
    return host.strip("[]"), _port(text, port, 1)


def _port(text: str, port: str, least: int) -> int:
    if not (port.isascii() and port.isdigit() and least <= int(port) <= 65535):
        raise _refusal(text)
    return int(port)


def _refusal(text: str) -> SettingError:
    return SettingError(
        f"expected a live view out of {', '.join(KINDS)}, received {text!r}; for example "
        f"plotjuggler:{LOCAL}:{PLOTJUGGLER_PORT}"
    )


# --- The process of a view: it reads the feed's memory, and the notes from a pipe -----------------


def main() -> None:
    """Show a feed until the pipe on standard input ends.
    The arguments are the descriptor of the memory, the feed and the kind as JSON. The answer on
    standard output is a line of JSON: the view's port, or why there is none.
    """
    with contextlib.suppress(AttributeError, OSError):
        # lower priority than the link's when both need the processor
        os.nice(5)
    feed = Feed.attached(int(sys.argv[1]), json.loads(sys.argv[2]))
    try:
        view = make(ViewKind(**json.loads(sys.argv[3])), feed)
    except SettingError as e:
        print(json.dumps({"error": str(e)}), flush=True)
        return
    print(json.dumps({"port": getattr(view, "port", 0)}), flush=True)
    threading.Thread(target=_listen, args=(feed,), daemon=True).start()
    if view is None:
        return
    try:
        view.run(feed)
    except Exception as e:
        report_failure(e)


def _listen(feed: Feed) -> None:
    for line in sys.stdin:
        feed.say(json.loads(line))
    feed.close()


# --- open_view: a view in its own process for the duration of a with ------------------------------


CLOSE_S = 0.5
"""Longest wait at the end of a `with` for a view that hangs [s]."""


_PROGRAM = "import sys; sys.path[:] = {path!r}; from sewfast.live.view import main; main()"


@dataclass(frozen=True)
class Shown:
    """A running view; `port` is that of its server, 0 without one."""

    port: int


@contextmanager
def open_view(
    kind: str | ViewKind, feed: Feed, *, own_process: bool = True
) -> Iterator[Shown | None]:
    """Show a feed for the duration of a `with`.

    The view is a separate process with a lower priority, so that it does not hold up the link by
    Python's interpreter lock or by using the processor. Leaving the `with` closes the feed and
    waits for the last line, half a second at most: stop the drive before.

    Parameters
    ----------
    kind : str or ViewKind
        `auto` (a status line if standard error is a terminal, else nothing), `terminal`, `none`,
        `plotjuggler[:HOST:PORT]`, `foxglove[:PORT]`.
    feed : Feed
        Must stay empty until the view has started.
    own_process : bool
        False: a thread instead, as on systems that cannot share the memory (Windows).

    Yields
    ------
    Shown or None
        None if nothing is shown.

    Raises
    ------
    SettingError
        On entry: for another kind, `terminal` if standard error is not one, a host without an
        address, a port that is taken, a missing package, a view that does not start.
    """
    asked = kind if isinstance(kind, ViewKind) else ViewKind.parse(kind)
    chosen = resolve(asked)
    with contextlib.ExitStack() as open_things:
        open_things.callback(feed.close)
        shown = None
        try:
            if chosen.name != "none":
                can_share = os.name != "nt" and bool(sys.executable)
                start = _process if own_process and can_share else _thread
                shown = open_things.enter_context(start(chosen, feed))
        except SettingError as e:
            # a view that the user did not ask for must not stop the record
            if asked.name != "auto":
                raise
            report_failure(e)
        yield shown


@contextmanager
def _process(kind: ViewKind, feed: Feed) -> Iterator[Shown]:
    ours, theirs = os.pipe()
    os.set_blocking(theirs, False)
    try:
        with feed.share(theirs) as memory:
            program = _started(kind, feed, memory, ours)
            try:
                yield _answer(program)
            finally:
                feed.close()
                os.close(theirs)
                theirs = -1
                _end(program)
    finally:
        if theirs >= 0:
            os.close(theirs)


def _started(kind: ViewKind, feed: Feed, memory: int, pipe: int) -> subprocess.Popen[bytes]:
    """Start the viewer, which takes over the read end of the pipe."""
    encoding = getattr(sys.stderr, "encoding", None) or "utf-8"
    try:
        return subprocess.Popen(
            [sys.executable, "-c", _PROGRAM.format(path=sys.path), str(memory),
             json.dumps(feed.description), json.dumps(asdict(kind))],
            stdin=pipe, stdout=subprocess.PIPE, stderr=_stderr(), pass_fds=[memory],
            # keep Ctrl-C for the record, which then closes the view
            start_new_session=True,
            env={**os.environ, "PYTHONIOENCODING": encoding},
        )  # fmt: skip
    except OSError as e:
        raise SettingError(
            f"expected another process for the live view, received {e}; use --live none"
        ) from e
    finally:
        os.close(pipe)


def _stderr() -> int | None:
    """The descriptor of Python's standard error, if it has one."""
    try:
        return sys.stderr.fileno()
    except (AttributeError, OSError, ValueError):
        return None


def _answer(program: subprocess.Popen[bytes]) -> Shown:
    assert program.stdout is not None
    with program.stdout as pipe:
        # longest wait at its beginning for the view to start [s]
        ready, _, _ = select.select([pipe], [], [], 20.0)
        line = pipe.readline() if ready else b""
    refusal = "live: expected a view that starts, received none; use --live none"
    answer: dict[str, Any] = json.loads(line) if line else {"error": refusal}
    if "error" in answer:
        raise SettingError(answer["error"])
    return Shown(answer["port"])


def _end(program: subprocess.Popen[bytes]) -> None:
    try:
        program.wait(CLOSE_S)
    except subprocess.TimeoutExpired:
        program.kill()
        program.wait()


@contextmanager
def _thread(kind: ViewKind, feed: Feed) -> Iterator[Shown]:
    view = make(kind, feed)
    assert view is not None
    failures: list[Exception] = []

    def run() -> None:
        try:
            view.run(feed)
        except Exception as e:
            failures.append(e)

    thread = threading.Thread(target=run, name="live view", daemon=True)
    thread.start()
    try:
        yield Shown(getattr(view, "port", 0))
    finally:
        feed.close()
        thread.join(CLOSE_S)
        for e in failures:
            report_failure(e)


def report_failure(e: Exception) -> None:
    """Print a failure of a view, which must not stop the record."""
    # standard error can be the terminal that has vanished
    with contextlib.suppress(OSError, ValueError):
        print(f"the live view ended early: {type(e).__name__}: {e}", file=sys.stderr, flush=True)


# --- make: the view of a kind ---------------------------------------------------------------------


class View(Protocol):
    def run(self, feed: Feed) -> None:
        """Show the feed until it is closed; runs in its own thread or process."""
        ...


def resolve(kind: ViewKind) -> ViewKind:
    """Replace `auto` by `terminal`, if standard error is one, or `none`."""
    terminal = sys.stderr is not None and sys.stderr.isatty()
    if kind.name == "auto":
        return ViewKind("terminal" if terminal else "none")
    if kind.name == "terminal" and not terminal:
        raise SettingError(
            "the live view expected standard error to be a terminal, received a file or a pipe; "
            "use --live none or auto"
        )
    return kind


def make(kind: ViewKind, feed: Feed) -> View | None:
    """The view of a kind; None for `none`."""
    kind = resolve(kind)
    if kind.name == "terminal":
        return TerminalView(sys.stderr)
    if kind.name == "plotjuggler":
        from .stream import PlotJugglerView

        return PlotJugglerView(kind.host, kind.port)
    if kind.name == "foxglove":
        from .stream import FoxgloveView

        return FoxgloveView(kind.host, kind.port, feed.title)
    return None


# --- The view on a terminal: a status line, overwritten in place ----------------------------------


# --- Tty: writing to a terminal without blocking on it --------------------------------------------


class Tty:
    """The terminal behind a text stream, standard error. It is opened a second time if the system
    allows: only then can writes be non-blocking without making the terminal non-blocking for all
    who share it. Otherwise a write waits as long as the terminal is blocked.
    """

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream.fileno()
        try:
            flags = os.O_WRONLY | os.O_NOCTTY | os.O_NONBLOCK
            self._fd = os.open(os.ttyname(self._stream), flags)
        except (OSError, AttributeError):
            self._fd = os.dup(self._stream)
        self.encoding = stream.encoding or "ascii"

    @property
    def columns(self) -> int:
        """Width of the terminal; 80 if it is unknown."""
        try:
            return os.get_terminal_size(self._stream).columns or 80
        except OSError:
            return 80

    def write(self, text: str, wait: Callable[[], bool]) -> None:
        """Write a text; while the terminal takes none of it, `wait` decides whether to go on."""
        rest = memoryview(text.encode(self.encoding, "replace"))
        while rest:
            if written := self._write_some(rest):
                rest = rest[written:]
            elif not wait():
                return

    def _write_some(self, rest: memoryview) -> int:
        """Bytes written; 0 if the terminal took none for a moment."""
        # on Windows, select works for sockets only
        # longest wait before it is checked whether to wait on [s]
        if os.name != "nt" and not select.select([], [self._fd], [], 0.05)[1]:
            return 0
        try:
            return os.write(self._fd, rest)
        except BlockingIOError:
            return 0

    def close(self) -> None:
        os.close(self._fd)


# --- The status line ------------------------------------------------------------------------------


def status(feed: Feed, width: int) -> str:
    """Progress, missing samples, and as many of the newest values as there is room for."""
    if feed.end == 0:
        return fitted(f"{feed.title}: waiting for the first sample", width)
    now = f"{feed.end * feed.Ts:.2f}"
    planned = f" of {feed.n * feed.Ts:.2f}" if feed.n is not None else ""
    line = f"{now}{planned} s   {_received(feed)}"
    for part in _values(feed):
        if len(line) + 3 + len(part) <= width:
            line += f"   {part}"
    return fitted(line, width)


def _received(feed: Feed) -> str:
    if not feed.missing:
        return "all samples received"
    gaps = f"{feed.gaps} gap{'s' * (feed.gaps != 1)}"
    # round down: an incomplete record must not read as 100 %
    share = np.floor(1e4 * feed.received / feed.end) / 100
    return f"{share:.2f} % received ({feed.missing} missing, {gaps})"


def _values(feed: Feed) -> list[str]:
    """The newest known values of speed and command."""
    newest = feed.read(max(feed.end - 50, 0), feed.end)
    found = []
    for name in (SPEED, "u"):
        known = newest[name][~np.isnan(newest[name])] if name in newest else np.empty(0)
        if len(known):
            digits = 0 if name == SPEED else 2
            found.append(f"{name} {known[-1]:.{digits}f} {feed.columns[name]}".rstrip())
    return found


def fitted(line: str, width: int) -> str:
    """A line without characters that could move the cursor, cut to `width` cells."""
    kept = "".join(c if _is_one_cell(c) else "?" for c in line)
    return kept if len(kept) <= width else kept[: max(width - 1, 0)] + "~"


def _is_one_cell(c: str) -> bool:
    wide = unicodedata.east_asian_width(c) in "WF" or unicodedata.combining(c)
    return c.isprintable() and not wide


# --- TerminalView: the status line while the feed is open -----------------------------------------


class TerminalView:
    """A status line on a terminal, with the feed's notes written above it.
    It moves the cursor only by carriage returns, which every terminal knows, and changes no mode:
    however the program ends, nothing has to be restored.
    """

    def __init__(self, stream: TextIO) -> None:
        self._tty = Tty(stream)
        self._noted = 0
        self._line = ""

    def run(self, feed: Feed) -> None:
        """Write until the feed is closed, then once more."""
        try:
            # time between two lines [s]
            while not feed.closed.wait(0.1):
                self._write(feed)
            self._write(feed, end="\r\n")
        finally:
            self._tty.close()

    def _write(self, feed: Feed, end: str = "") -> None:
        # a terminal breaks a line that fills its last column
        width = self._tty.columns - 1
        notes = [(number, fitted(text, width)) for number, text in feed.notes(self._noted)]
        line = status(feed, width)
        if not (notes or end or line != self._line):
            return
        before = min(len(self._line), width)
        above = "".join(f"\r{text:{before}}\r\n" for _, text in notes)
        blank = 0 if notes else before
        self._line, self._noted = line, notes[-1][0] if notes else self._noted
        self._tty.write(f"{above}\r{line:{blank}}{end}", self._patience(feed))

    def _patience(self, feed: Feed) -> Callable[[], bool]:
        ended: list[float] = []

        def wait() -> bool:
            if feed.closed.is_set() and not ended:
                ended.append(time.monotonic())
            # longest wait for a blocked terminal once the record has ended [s]
            return not ended or time.monotonic() - ended[0] < 0.2

        return wait
