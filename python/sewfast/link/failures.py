"""Failures of a port: what the operating system says, as one `LinkError` with what to do."""

from __future__ import annotations

import errno
import os
import re
import stat
from typing import Literal

from ..errors import LinkError

try:
    import termios

    _TERMINAL: tuple[type[Exception], ...] = (termios.error,)
except ImportError:  # Windows
    _TERMINAL = ()

FAILURES: tuple[type[Exception], ...] = (OSError, ValueError, TypeError, *_TERMINAL)
"""What opening, reading and writing a port can raise: pyserial's own kind is an OSError, a port
closed under it is a TypeError, a cable pulled while it is set up a termios.error."""

_MISSING = {errno.ENOENT, errno.ENXIO, errno.ENODEV}
_DENIED = {errno.EACCES, errno.EPERM}
_BUSY = {errno.EBUSY, errno.EAGAIN, errno.EWOULDBLOCK}
_NO_TERMINAL = {errno.ENOTTY, errno.EINVAL, errno.EISDIR}
_UNREACHABLE = {errno.EHOSTUNREACH, errno.ENETUNREACH, errno.EHOSTDOWN, errno.ENETDOWN}

_BUSY_TEXT = (
    "a port that nobody else uses",
    "it is in use",
    "close the other program (a serial monitor, ModemManager, another sewfast)",
)

NO_PORT = "expected a serial port, it is something else"
"""In the message about a file, a folder or a device of another kind."""


def explain(url: str, doing: Literal["open", "read", "write"], error: BaseException) -> LinkError:
    """The error as it is raised: expected, received, remedy."""
    if isinstance(error, LinkError):
        return LinkError(f"{url}: expected an open port, {error}; connect again")
    number = _number(error)
    texts = _opening(url, number, error) if doing == "open" else _losing(number, error)
    expected, received, remedy = texts
    return LinkError(f"{url}: expected {expected}, {received} ({_plain(error)}); {remedy}")


def _opening(url: str, number: int | None, error: BaseException) -> tuple[str, str, str]:
    if url.startswith("socket://"):
        return _connecting(number, error)
    if number in _BUSY or (os.name == "nt" and number in _DENIED):
        return _BUSY_TEXT
    if number in _MISSING:
        remedy = "plug the cable in and see `sewfast ports`"
        if re.fullmatch(r"[^/\\]+:\d+", url):
            remedy = f"an address is written socket://{url}"
        return "a serial port of this name", "there is none", remedy
    if number in _DENIED:
        return "a port that you may open", "permission was denied", _permission(url)
    if number in _NO_TERMINAL:
        remedy = "see `sewfast ports` for what there is"
        return "a serial port", "it is something else", remedy
    if isinstance(error, ValueError):
        remedy = "give a rate that the adapter offers, such as 115200"
        return "a baud rate of this port", "it takes another", remedy
    return "a serial port that opens", "it did not", "unplug it, plug it in again and retry"


def _connecting(number: int | None, error: BaseException) -> tuple[str, str, str]:
    server = "a device that listens there"
    if number == errno.ECONNREFUSED:
        return server, "nobody does", "start it (`sewfast device` for a virtual one)"
    if isinstance(error, TimeoutError) or number in _UNREACHABLE:
        return server, "nothing answered", "check the address, the network and the firewall"
    return server, "there is no such way", "check host and port"


def _losing(number: int | None, error: BaseException) -> tuple[str, str, str]:
    if isinstance(error, TimeoutError) or "timeout" in str(error).lower():
        remedy = "check that the device runs; unplug it if it hangs"
        return "the port to take bytes", f"it took none within {1:g} s", remedy
    if number in (errno.ECONNRESET, errno.EPIPE) or isinstance(error, ConnectionError):
        remedy = "see why it ended, then connect again"
        return "an open connection", "the other side ended it", remedy
    remedy = "check cable and supply, then connect again"
    return "an open port", "it vanished", remedy


def _permission(url: str) -> str:
    """Linux gives serial ports to a group; its name differs between distributions."""
    group = "dialout"
    try:
        import grp

        found = os.stat(url)
        if stat.S_IMODE(found.st_mode) & stat.S_IWGRP:
            group = grp.getgrgid(found.st_gid).gr_name
    except (ImportError, OSError, KeyError):
        pass
    return f"join its group (sudo usermod -aG {group} $USER) and log in again"


def _number(error: BaseException) -> int | None:
    """The operating system's number of an error; pyserial often keeps it in the text only."""
    if isinstance(error, OSError) and error.errno is not None:
        return error.errno
    if error.args and isinstance(error.args[0], int):
        return error.args[0]
    if isinstance(error, FileNotFoundError):
        return errno.ENOENT
    if isinstance(error, PermissionError):
        return errno.EACCES
    found = re.search(r"\[Errno (\d+)\]|Error\((\d+),|^\((\d+),|: \((\d+),", str(error))
    return int(next(filter(None, found.groups()))) if found else None


def _plain(error: BaseException) -> str:
    number = _number(error)
    if number is not None:
        return os.strerror(number)
    text = getattr(error, "strerror", None) or str(error)
    return str(text).strip() or type(error).__name__
