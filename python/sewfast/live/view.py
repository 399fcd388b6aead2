"""`open_view`: the kinds of views, each in its own process."""

from __future__ import annotations

import contextlib
import json
import os
import select
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from typing import Any, Protocol

from ..errors import SettingError
from .feed import Feed

# --- Kind: a view by its name on the command line -------------------------------------------------


KINDS = ("auto", "terminal", "none", "plotjuggler[:HOST:PORT]", "foxglove[:PORT]")

PLOTJUGGLER_PORT = 9870
FOXGLOVE_PORT = 8765

LOCAL = "127.0.0.1"
"""An address that only this computer reaches."""


@dataclass(frozen=True)
class Kind:
    """A view by name; streams have an address.

    Attributes
    ----------
    name : str
        `auto`, `terminal`, `none`, `plotjuggler` or `foxglove`.
    host : str
        Address of PlotJuggler, or of the Foxglove server.
    port : int
        Port of the stream; 0 for views without one, and for a Foxglove server on any free port.
    """

    name: str
    host: str = ""
    port: int = 0

    @classmethod
    def parse(cls, text: str) -> Kind:
        """The view named by a text such as `plotjuggler:HOST:PORT`; see `KINDS`.

        Raises
        ------
        SettingError
            For any other text, or a port outside 1 to 65535 (Foxglove: 0 to 65535).
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


_NICE = 5
"""Lower priority than the link's when both need the processor."""


def main() -> None:
    """Show a feed until the pipe on standard input ends.

    The arguments are the descriptor of the memory, the feed and the kind as JSON. The answer on
    standard output is a line of JSON: the view's port, or why there is none.
    """
    with contextlib.suppress(AttributeError, OSError):
        os.nice(_NICE)
    feed = Feed.attached(int(sys.argv[1]), json.loads(sys.argv[2]))
    try:
        view = make(Kind(**json.loads(sys.argv[3])), feed)
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

START_S = 20.0
"""Longest wait at its beginning for the view to start [s]."""

_PROGRAM = "import sys; sys.path[:] = {path!r}; from sewfast.live.view import main; main()"


@dataclass(frozen=True)
class Shown:
    """A running view.

    Attributes
    ----------
    port : int
        Port of its server; 0 without one.
    """

    port: int


@contextmanager
def open_view(kind: str | Kind, feed: Feed, *, own_process: bool = True) -> Iterator[Shown | None]:
    """Show a feed for the duration of a `with`.

    The view is a separate process with a lower priority, so that it does not hold up the link by
    Python's interpreter lock or by using the processor. Leaving the `with` closes the feed and
    waits for the last line, half a second at most: stop the drive before.

    Parameters
    ----------
    kind : str or Kind
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
    asked = kind if isinstance(kind, Kind) else Kind.parse(kind)
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
def _process(kind: Kind, feed: Feed) -> Iterator[Shown]:
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


def _started(kind: Kind, feed: Feed, memory: int, pipe: int) -> subprocess.Popen[bytes]:
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
        ready, _, _ = select.select([pipe], [], [], START_S)
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
def _thread(kind: Kind, feed: Feed) -> Iterator[Shown]:
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
    """Shows a feed."""

    def run(self, feed: Feed) -> None:
        """Show the feed until it is closed; runs in its own thread or process."""
        ...


def resolve(kind: Kind) -> Kind:
    """Replace `auto` by `terminal` or `none`.

    Raises
    ------
    SettingError
        For `terminal` if standard error is not a terminal.
    """
    terminal = sys.stderr is not None and sys.stderr.isatty()
    if kind.name == "auto":
        return Kind("terminal" if terminal else "none")
    if kind.name == "terminal" and not terminal:
        raise SettingError(
            "the live view expected standard error to be a terminal, received a file or a pipe; "
            "use --live none or auto"
        )
    return kind


def make(kind: Kind, feed: Feed) -> View | None:
    """The view of a kind; None for `none`.

    Raises
    ------
    SettingError
        As `resolve`; for a host without an address, a port that is taken, a missing package.
    """
    kind = resolve(kind)
    if kind.name == "terminal":
        from .terminal import TerminalView

        return TerminalView(sys.stderr)
    if kind.name == "plotjuggler":
        from .stream import PlotJugglerView

        return PlotJugglerView(kind.host, kind.port)
    if kind.name == "foxglove":
        from .stream import FoxgloveView

        return FoxgloveView(kind.host, kind.port, feed.title)
    return None
