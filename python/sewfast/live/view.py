"""`open_view`: a view in a thread of its own, for as long as a `with` lasts."""

from __future__ import annotations

import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import Protocol

from ..errors import SettingError
from .feed import Feed
from .kind import Kind

CLOSE_S = 0.5
"""For which the end of a `with` waits for a view that hangs [s]."""


class View(Protocol):
    """What shows a feed."""

    def run(self, feed: Feed) -> None:
        """Show the feed until it is closed; called in a thread of its own."""
        ...


@contextmanager
def open_view(kind: str | Kind, feed: Feed) -> Iterator[View | None]:
    """Show a feed while the `with` lasts.

    Whatever the view does, it costs the record nothing: it runs in a daemon thread, and a failure
    of it is one line on standard error at the end. Leaving the `with` closes the feed and waits
    for the last frame, half a second at most: stop the drive before.

    Parameters
    ----------
    kind : str or Kind
        `auto` (a terminal plot where standard error is a terminal, else nothing), `terminal`,
        `none`, `plotjuggler[:HOST:PORT]`, `foxglove[:PORT]`.
    feed : Feed

    Yields
    ------
    View or None
        None where nothing is shown.

    Raises
    ------
    SettingError
        On entry: for another kind, `terminal` where standard error is none, a host without an
        address, a port that is taken, a missing package.
    """
    view = _make(Kind.parse(kind) if isinstance(kind, str) else kind, feed)
    if view is None:
        try:
            yield None
        finally:
            feed.close()
        return
    failures: list[Exception] = []
    thread = threading.Thread(
        target=_run, args=(view, feed, failures), name="live view", daemon=True
    )
    thread.start()
    try:
        yield view
    finally:
        feed.close()
        thread.join(CLOSE_S)
        for e in failures:
            _tell(e)


def _tell(e: Exception) -> None:
    # standard error may be the very terminal that has gone away
    with suppress(OSError, ValueError):
        print(f"the live view ended early: {type(e).__name__}: {e}", file=sys.stderr, flush=True)


def _run(view: View, feed: Feed, failures: list[Exception]) -> None:
    try:
        view.run(feed)
    except Exception as e:
        failures.append(e)


def _make(kind: Kind, feed: Feed) -> View | None:
    terminal = sys.stderr is not None and sys.stderr.isatty()
    if kind.name == "terminal" and not terminal:
        raise SettingError(
            "the live view expected standard error to be a terminal, received a file or a pipe; "
            "use --live none or auto"
        )
    if kind.name in ("auto", "terminal") and terminal:
        from .terminal import TerminalView

        return TerminalView(sys.stderr)
    if kind.name == "plotjuggler":
        from .plotjuggler import PlotJugglerView

        return PlotJugglerView(kind.host, kind.port)
    if kind.name == "foxglove":
        from .foxglove import FoxgloveView

        return FoxgloveView(kind.host, kind.port, feed.title)
    return None
