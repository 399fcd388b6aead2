"""The report: one self-contained HTML page from the artefacts of an experiment.

Read in this order: `artefacts` (the files of a folder), `pictures`, `page`, `commissioned` (the
page of a commissioning).
"""

from __future__ import annotations

import os
from pathlib import Path

from .. import plotting, storage
from . import artefacts, commissioned, page

__all__ = ["report"]


def report(folder: str | os.PathLike[str]) -> Path:
    """Write `report.html` into a result folder, from its files; nothing is computed again.

    Parameters
    ----------
    folder : path
        A folder of `sewfast demo --out DIR` or `sewfast commission --out DIR`: see
        docs/CONVENTIONS.md for the layouts.

    Returns
    -------
    Path
        The page: one HTML file that loads nothing, with one script that its policy allows by hash;
        an existing one is replaced.

    Raises
    ------
    DataError, ModelFileError
        If the folder has no results, or a file in it is missing or damaged; the error names it.
    SettingError
        If matplotlib or Jinja2 is not installed.
    """
    plotting.require()
    target = Path(folder) / "report.html"
    if commissioned.is_commissioning(Path(folder)):
        text = page.fill("commissioning.html", commissioned.context(Path(folder)))
    else:
        text = page.render(artefacts.load(folder))
    storage.replace(target, text)
    return target
