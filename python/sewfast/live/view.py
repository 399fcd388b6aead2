"""`open_view`: a view in a process of its own, for as long as a `with` lasts."""

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
from typing import Any

from ..errors import SettingError
from .feed import Feed
from .kind import Kind
from .make import make, settled

CLOSE_S = 0.5
"""For which the end of a `with` waits for a view that hangs [s]."""

START_S = 20.0
"""For which its beginning waits for a view to be there [s]."""

_PROGRAM = "import sys; sys.path[:] = {path!r}; from sewfast.live.viewer import main; main()"


@dataclass(frozen=True)
class Shown:
    """A view that is there.

    Attributes
    ----------
    port : int
        Of its server; 0 where it has none.
    """

    port: int


@contextmanager
def open_view(kind: str | Kind, feed: Feed, *, own_process: bool = True) -> Iterator[Shown | None]:
    """Show a feed while the `with` lasts.

    The view is a process of its own with a lower priority, so that it shares neither Python's
    interpreter lock with the link nor, where both want it, the processor. Leaving the `with`
    closes the feed and waits for the last frame, half a second at most: stop the drive before.

    Parameters
    ----------
    kind : str or Kind
        `auto` (a terminal plot where standard error is a terminal, else nothing), `terminal`,
        `none`, `plotjuggler[:HOST:PORT]`, `foxglove[:PORT]`.
    feed : Feed
        Nothing may be put into it before the view is there.
    own_process : bool
        False: a thread instead, as on systems that cannot hand memory on (Windows).

    Yields
    ------
    Shown or None
        None where nothing is shown.

    Raises
    ------
    SettingError
        On entry: for another kind, `terminal` where standard error is none, a host without an
        address, a port that is taken, a missing package, a view that does not start.
    """
    asked = kind if isinstance(kind, Kind) else Kind.parse(kind)
    chosen = settled(asked)
    with contextlib.ExitStack() as open_things:
        open_things.callback(feed.close)
        shown = None
        try:
            if chosen.name != "none":
                start = _process if own_process and _can_hand_on() else _thread
                shown = open_things.enter_context(start(chosen, feed))
        except SettingError as e:
            # nobody asked for this view
            if asked.name != "auto":
                raise
            tell(e)
        yield shown


def _can_hand_on() -> bool:
    """Whether another process can be given memory."""
    return os.name != "nt" and bool(sys.executable)


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
    """The viewer; the pipe's end is its own from here on."""
    try:
        return subprocess.Popen(
            [sys.executable, "-c", _PROGRAM.format(path=sys.path), str(memory),
             json.dumps(feed.description), json.dumps(asdict(kind))],
            stdin=pipe, stdout=subprocess.PIPE, stderr=_stderr(), pass_fds=[memory],
            # Ctrl-C is for the record, which then closes the view
            start_new_session=True, env={**os.environ, "PYTHONIOENCODING": _encoding()},
        )  # fmt: skip
    except OSError as e:
        raise SettingError(
            f"expected another process for the live view, received {e}; use --live none"
        ) from e
    finally:
        os.close(pipe)


def _stderr() -> int | None:
    """Standard error as Python has it, where that is a file of the system."""
    try:
        return sys.stderr.fileno()
    except (AttributeError, OSError, ValueError):
        return None


def _encoding() -> str:
    return getattr(sys.stderr, "encoding", None) or "utf-8"


def _answer(program: subprocess.Popen[bytes]) -> Shown:
    assert program.stdout is not None
    with program.stdout as pipe:
        ready, _, _ = select.select([pipe], [], [], START_S)
        line = pipe.readline() if ready else b""
    refusal = "expected the live view to start, received nothing from it; use --live none"
    said: dict[str, Any] = json.loads(line) if line else {"error": refusal}
    if "error" in said:
        raise SettingError(said["error"])
    return Shown(said["port"])


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
            tell(e)


def tell(e: Exception) -> None:
    """A failure of a view costs the record one line."""
    # standard error may be the very terminal that has gone away
    with contextlib.suppress(OSError, ValueError):
        print(f"the live view ended early: {type(e).__name__}: {e}", file=sys.stderr, flush=True)
