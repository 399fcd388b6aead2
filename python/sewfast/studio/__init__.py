"""Studio: look, identify and validate on a local page; the results are the command line's files.

`project` says what the steps are, each a call of the public API; `server` shows them to a browser
on this machine and to nobody else; `page` holds what the browser loads.
"""

from .project import Project, Step
from .server import Studio

__all__ = ["Project", "Step", "Studio"]
