"""The exceptions of the package: one family, each also of the built-in kind a caller expects."""

from __future__ import annotations

import unicodedata
from typing import Any


class SewfastError(Exception):
    """Anything that sewfast refuses; the message says what was expected, what came, what to do."""


class DataError(SewfastError, ValueError):
    """A recording or an array cannot be used."""


class SettingError(SewfastError, ValueError):
    """A setting is outside its range or contradicts another."""


class FitError(SewfastError, RuntimeError):
    """An identification or a tuning found no usable answer."""


class ModelFileError(SewfastError, ValueError):
    """A model or controller file is damaged, of an unknown kind or of an unknown version."""


class LinkError(SewfastError, OSError):
    """A port or the device behind it failed, or the device tripped.

    Attributes
    ----------
    recording
        What a run had brought until then, where there was one: a `Recording` or a `ClosedLoopRun`.
    """

    recording: Any = None


class Interrupted(KeyboardInterrupt):
    """Ctrl-C stopped long work; ``best`` is its best result so far.

    Parameters
    ----------
    best
        What the work had reached: a model or a controller, usable as it is.
    """

    def __init__(self, best: Any) -> None:
        super().__init__("interrupted; the best result so far is kept")
        self.best = best


def printable(name: str) -> str:
    """A name without control characters: a file must not steer the terminal that it is shown on."""
    shown = (c.isprintable() or unicodedata.category(c) == "Zs" for c in name)
    return "".join(c if keep else ascii(c)[1:-1] for c, keep in zip(name, shown, strict=True))
