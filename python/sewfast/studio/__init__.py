"""Studio: from a recording to a driven machine on a local page; its files are the command line's.

`project`, `commissioning` and `driving` say what the steps are, each a call of the public API;
`tuning` what a controller's numbers do; `messages` what a page may ask for; `server` shows all of
it to a browser on this machine and to nobody else; `line` is its end of `bench`, the process that
owns a drive's port; `page` holds what the browser loads.
"""

from .commissioning import Commission
from .project import Project, Step, make_demo
from .server import Studio
from .tuning import Tuning

__all__ = ["Commission", "Project", "Step", "Studio", "Tuning", "make_demo"]
