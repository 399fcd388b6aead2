"""The report: one self-contained HTML page from the artefacts of an experiment.

Read in this order: `artefacts` (what a folder holds), `pictures`, `page`, `commissioned` (the page
of a commissioning).
"""

from __future__ import annotations

import os
from pathlib import Path

from .. import plotting, storage
from . import artefacts, commissioned, page

__all__ = ["report"]


def report(folder: str | os.PathLike[str]) -> Path:
    """Write `report.html` into a result folder, from what lies there; nothing is computed anew.

    Parameters
    ----------
    folder : path
        What `sewfast demo --out DIR` or `sewfast commission --out DIR` left: see
        docs/CONVENTIONS.md for the layouts.

    Returns
    -------
    Path
        The page: one HTML file that loads nothing, its one script named by its hash; an existing
        one is replaced.

    Raises
    ------
    DataError, ModelFileError
        Where the folder holds no results, or a file in it is missing or damaged; it is named.
    SettingError
        Where matplotlib or Jinja2 is not installed.
    """
    plotting.require()
    target = Path(folder) / "report.html"
    if commissioned.is_commissioning(Path(folder)):
        text = page.fill("commissioning.html", commissioned.context(Path(folder)))
    else:
        text = page.render(artefacts.load(folder))
    storage.replace(target, text)
    return target
