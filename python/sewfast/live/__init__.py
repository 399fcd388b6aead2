"""The live view of a running record or run.

Read in this order: `feed` (the newest samples, between the link's thread and a view), `view` (the
views, each in its own process; the one on a terminal), `stream` (PlotJuggler and Foxglove).
"""

from .feed import Feed
from .view import View, ViewKind, open_view

__all__ = ["Feed", "View", "ViewKind", "open_view"]
