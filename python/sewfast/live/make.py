"""`make`: the view of a kind."""

from __future__ import annotations

import sys
from typing import Protocol

from ..errors import SettingError
from .feed import Feed
from .kind import Kind


class View(Protocol):
    """What shows a feed."""

    def run(self, feed: Feed) -> None:
        """Show the feed until it is closed; has a thread or a process to itself."""
        ...


def settled(kind: Kind) -> Kind:
    """What `auto` stands for here.

    Raises
    ------
    SettingError
        For `terminal` where standard error is none.
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
        As `settled`; for a host without an address, a port that is taken, a missing package.
    """
    kind = settled(kind)
    if kind.name == "terminal":
        from .terminal import TerminalView

        return TerminalView(sys.stderr)
    if kind.name == "plotjuggler":
        from .plotjuggler import PlotJugglerView

        return PlotJugglerView(kind.host, kind.port)
    if kind.name == "foxglove":
        from .foxglove import FoxgloveView

        return FoxgloveView(kind.host, kind.port, feed.title)
    return None
