"""Studio: from a recording to a driven machine on a local page; its files are the command line's.

Read in this order: `requests` (a step on a recording, a commissioning), `project` (the steps and
uploads), `tuning` (the settings of a controller, their effect, a search), `loops` (Bode plots),
`driving` (the steps on a drive); each step is a call of the public API and can be copied. `jobs`
answers a page and runs long steps in a separate process. `server` serves all of it to browsers
on this computer only, with a `session` for each page, which checks its messages; `line` is its
client of `bench`, the process that owns a drive's port. `page` holds the files for the browser,
`widgets` shows two of its views in a notebook. `command` adds `sewfast studio`.
"""

from typing import TYPE_CHECKING

from sewfast.plugins import on_first_use as _on_first_use

if TYPE_CHECKING:
    from .project import Project, make_demo
    from .requests import Commission, Step
    from .server import Studio
    from .tuning import Tuning

__all__ = ["Commission", "Project", "Step", "Studio", "Tuning", "make_demo"]

if not TYPE_CHECKING:  # a misspelt name is an error for type checkers
    __getattr__, __dir__ = _on_first_use(
        __name__,
        {
            "project": "Project make_demo",
            "requests": "Commission Step",
            "server": "Studio",
            "tuning": "Tuning",
        },
    )
