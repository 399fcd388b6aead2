"""The live view: what a running record or run looks like while it happens.

Read in this order: `feed` (the newest samples, between the link's thread and a view), `view` (the
views, each in a process of its own), `terminal`, `stream` (PlotJuggler and Foxglove).
"""

from .feed import Feed
from .view import Kind, View, open_view

__all__ = ["Feed", "Kind", "View", "open_view"]
