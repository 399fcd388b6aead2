"""The report: one self-contained HTML page from the artefacts of an experiment.

Read in this order: `artefacts` (the files of a folder), `pictures`, `page`, `commissioned` (the
page of a commissioning).
"""

from __future__ import annotations

import os
from pathlib import Path

from .. import plotting, storage
from ..errors import ModelFileError, SewfastError
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
    from jinja2 import UndefinedError

    place = Path(folder)
    commissioning = commissioned.is_commissioning(place)
    try:
        if commissioning:
            text = page.fill("commissioning.html", commissioned.context(place))
        else:
            text = page.render(artefacts.load(place))
    except SewfastError:
        raise
    except (
        LookupError,
        TypeError,
        ValueError,
        AttributeError,
        ArithmeticError,
        UndefinedError,
    ) as e:
        name = commissioned.NUMBERS if commissioning else "results.json"
        raise ModelFileError(
            name=str(place / name), expected="the numbers that sewfast wrote there",
            received=f"one that is missing or of another kind ({e})",
            remedy="make the folder again with the command that made it",
        ) from e  # fmt: skip
    target = place / "report.html"
    storage.replace(target, text)
    return target
