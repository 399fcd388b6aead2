"""How many threads work is spread over unless a caller says so."""

from __future__ import annotations

import os

from .errors import SettingError

VARIABLE = "SEWFAST_THREADS"
"""Environment variable with the most threads that are taken unasked."""


def available() -> int:
    """The processors that this process may use, at most as many as `SEWFAST_THREADS` allows.

    Raises
    ------
    SettingError
        Where the variable holds something else than a whole number of 1 or more.
    """
    may = getattr(os, "sched_getaffinity", None)
    here = len(may(0)) if may is not None else os.cpu_count() or 1
    most = os.environ.get(VARIABLE, "").strip()
    return min(here, _most(most)) if most else here


def _most(text: str) -> int:
    if not (text.isdecimal() and int(text) >= 1):
        raise SettingError(
            f"{VARIABLE}: expected a whole number of 1 or more, received {text!r}; unset it to use "
            "every processor"
        )
    return int(text)
