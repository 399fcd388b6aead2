"""The process that a view runs in: it reads the feed's memory, and lines of status from a pipe."""

from __future__ import annotations

import contextlib
import json
import os
import sys
import threading

from ..errors import SettingError
from .feed import Feed
from .kind import Kind
from .make import make
from .view import tell

_NICE = 5
"""The link goes first where both want the processor."""


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
        _answer({"error": str(e)})
        return
    _answer({"port": getattr(view, "port", 0)})
    threading.Thread(target=_listen, args=(feed,), daemon=True).start()
    if view is None:
        return
    try:
        view.run(feed)
    except Exception as e:
        tell(e)


def _answer(value: dict[str, object]) -> None:
    print(json.dumps(value), flush=True)


def _listen(feed: Feed) -> None:
    for line in sys.stdin:
        feed.say(json.loads(line))
    feed.close()
