"""The live view: what a running record or run looks like while it happens."""

from .feed import Feed
from .kind import Kind
from .make import View
from .view import open_view

__all__ = ["Feed", "Kind", "View", "open_view"]
