"""The exceptions of the package: one family, each also of the built-in kind that callers expect."""

from __future__ import annotations

import errno
import unicodedata
from typing import Any, TypeVar


class SewfastError(Exception):
    """Base class of all errors; the message has the expected and received values and a remedy.

    It can be raised with its fields, from which the message is made:
    ``name: expected ..., received ...; remedy``. It can also be raised with a whole message of this
    form, from which the fields are read, as for errors of the compiled core.

    Attributes
    ----------
    name : str or None
        Name of the refused item: an argument, a column, a file, a port.
    expected, received, remedy : str or None
        Expected value, received value, what to do.
    cause : Cause or None
        What is wrong with the machine, if a run shows it (`sewfast.cause_of`).

    Examples
    --------
    >>> error = SewfastError(name="u", expected="one column", received="two", remedy="use u[:, 0]")
    >>> str(error)
    'u: expected one column, received two; use u[:, 0]'
    >>> SewfastError("expected 1 or 2 as mode, got 3").received
    '3'
    """

    name: str | None
    expected: str | None
    received: str | None
    remedy: str | None
    cause: Any

    def __init__(
        self,
        message: str = "",
        *,
        name: str | None = None,
        expected: str | None = None,
        received: str | None = None,
        remedy: str | None = None,
        cause: Any = None,
    ) -> None:
        self.cause = cause
        if expected is not None:
            message = f"expected {expected}"
            # a line break in a file's name must not break the message
            message = f"{printable(name)}: {message}" if name else message
            message += f", received {received}" if received else ""
            message += f"; {remedy}" if remedy else ""
            found: tuple[str | None, ...] = (name or None, expected, received, remedy)
        else:
            found = _fields(str(message))
        super().__init__(message)
        self.name, self.expected, self.received, self.remedy = found

    def explain(self, cause: Any) -> None:
        """Put the cause into the message, in place of a remedy for any cause."""
        message = str(self)
        if self.remedy and message.endswith(self.remedy):
            message = message[: -len(self.remedy)].rstrip("; ")
        self.args = (f"{message}; {cause}",)
        self.cause, self.remedy = cause, str(cause)


def _fields(message: str) -> tuple[str | None, ...]:
    """Name, expected, received and remedy of a message; all None for one of another shape."""
    name, shaped, rest = f": {message}".partition(": expected ")
    if not shaped:
        return None, None, None, None
    marks = [rest.find(mark) for mark in (", received ", ", got ", "; received ", "; got ")]
    at = min((m for m in marks if m >= 0), default=-1)
    if at < 0:
        expected, _, remedy = rest.partition("; ")
        expected, _, received = expected.partition(", ")
    else:
        expected, received = rest[:at], rest[at + 2 :].partition(" ")[2]
        ends = [i for i in range(len(received)) if received.startswith("; ", i)]
        # text in quotes can contain a semicolon
        end = next((i for i in ends if received.count("'", 0, i) % 2 == 0), len(received))
        received, remedy = received[:end], received[end + 2 :]
    return name[2:] or None, expected, received or None, remedy or None


class DataError(SewfastError, ValueError):
    """A recording or an array cannot be used."""


class SettingError(SewfastError, ValueError):
    """A setting is outside its range or contradicts another."""


class FitError(SewfastError, RuntimeError):
    """An identification or a tuning found no usable result."""


class ModelFileError(SewfastError, ValueError):
    """A model or controller file is damaged, of an unknown kind or of an unknown version."""


class LinkError(SewfastError, OSError):
    """A port or the device behind it failed, or the device tripped.

    Attributes
    ----------
    recording
        The data of the run up to then, if there was one: a `Recording` or a `ClosedLoopRun`.
    """

    recording: Any = None


class Interrupted(KeyboardInterrupt):
    """Ctrl-C stopped long work; ``best`` is its best result so far.

    Parameters
    ----------
    best
        The best result so far: a model or a controller, usable as it is.
    """

    def __init__(self, best: Any) -> None:
        super().__init__("interrupted; the best result so far is kept")
        self.best = best


Kind = TypeVar("Kind", bound=SewfastError)


def located(kind: type[Kind], place: object, error: BaseException) -> Kind:
    """The error of a part with its place put before the name."""
    if not isinstance(error, SewfastError) or error.expected is None:
        return kind(f"{place}: {error}")
    name = f"{place}: {error.name}" if error.name else f"{place}"
    return kind(name=name, expected=error.expected, received=error.received, remedy=error.remedy)


def unreadable(kind: type[Kind], path: object, error: BaseException) -> Kind:
    """The error for a file that is missing or cannot be read."""
    received = getattr(error, "strerror", None) or str(error)
    remedy = "check the name and the folder"
    return kind(
        name=f"{path}", expected="a file that can be read", received=received, remedy=remedy
    )


_REMEDIES = {
    errno.EISDIR: "name a file in it",
    errno.EINVAL: "choose another name",
    errno.ELOOP: "choose another name",
    errno.ENXIO: "start what reads the pipe first",
    errno.ENAMETOOLONG: "choose a shorter name",
    errno.ENOSPC: "free some space or write elsewhere",
    errno.EDQUOT: "free some space or write elsewhere",
}


def unwritable(
    kind: type[Kind], path: object, error: BaseException, remedy: str | None = None
) -> Kind:
    """The error for a file that cannot be written; by default with a remedy for its cause."""
    received = getattr(error, "strerror", None) or str(error)
    number = getattr(error, "errno", None) or 0
    remedy = remedy or _REMEDIES.get(number, "choose a folder that exists and is writable")
    return kind(
        name=f"{path}", expected="a file that can be written", received=received, remedy=remedy
    )


def not_installed(package: str, purpose: str, install: str = "") -> SettingError:
    """The error for a missing optional package, with its purpose and how to install it."""
    return SettingError(
        name=package, expected=f"it installed for {purpose}", received="none",
        remedy=f'pip install "{install or package}"',
    )  # fmt: skip


def printable(name: str) -> str:
    """A name without control characters: a file must not be able to control the terminal."""
    shown = (c.isprintable() or unicodedata.category(c) == "Zs" for c in name)
    return "".join(c if keep else ascii(c)[1:-1] for c, keep in zip(name, shown, strict=True))
