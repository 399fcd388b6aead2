"""The live view: what a running record or run looks like while it happens."""

from .feed import Feed
from .view import Kind, View, open_view

__all__ = ["Feed", "Kind", "View", "open_view"]
