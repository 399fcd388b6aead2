"""Studio: from a recording to a driven machine on a local page; its files are the command line's.

Read in this order: `project` and `step` say what is done with recordings, `tuning` and `search`
what the numbers of a controller do, `loops` its Bode plots, `commissioning` and `driving` what
moves a machine; each step is a call of the public API and can be copied. `messages` is what a page
may send, `steps` what answers it, `uploads` how a file comes in; `jobs` runs the long ones (`work`)
in a process of their own. `server` shows all of it to a browser on this machine and to nobody else,
by a `session` for each page; `line` is its end of `bench`, the process that owns a drive's port.
`page` holds what the browser loads, `widgets` shows two of its views in a notebook.
"""

from .commissioning import Commission
from .project import Project, make_demo
from .server import Studio
from .step import Step
from .tuning import Tuning

__all__ = ["Commission", "Project", "Step", "Studio", "Tuning", "make_demo"]
