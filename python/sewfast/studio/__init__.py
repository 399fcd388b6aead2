"""Studio: look, identify, validate and tune on a local page; its files are the command line's.

`project` says what the steps are, each a call of the public API; `tuning` what a controller's
numbers do; `server` shows both to a browser on this machine and to nobody else; `page` holds what
the browser loads.
"""

from .project import Commission, Project, Step, make_demo
from .server import Studio
from .tuning import Tuning

__all__ = ["Commission", "Project", "Step", "Studio", "Tuning", "make_demo"]
