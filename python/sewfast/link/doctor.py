"""`examine`: what is wrong with a port and the device behind it, with remedies; nothing moves."""

from __future__ import annotations

import os
from collections.abc import Iterator
from typing import Any

from ..errors import LinkError, SettingError
from . import system
from .checkup import Metered, checkup
from .diagnosis import Diagnosis, Finding
from .failures import NO_PORT
from .ports import list_ports, open_port

ECHOES = 200
LATENCY_TIMER_MS = 2


def examine(url: str, *, baud: int = 115_200, echoes: int = ECHOES) -> Diagnosis:
    """Examine a port and the device behind it.

    The device is greeted and asked, never armed. To greet it opens a new session, which ends a run
    of another host.

    Parameters
    ----------
    url : str
        A serial port's path, a COM name or ``socket://host:port``.
    baud : int
        Bits per second of a serial port.
    echoes : int
        Messages sent to and fro, 10 or more; loss below one in so many is not found.

    Raises
    ------
    SettingError
        For a url, baud or count that cannot be; whatever is wrong with port or device is a finding.
    """
    if isinstance(echoes, bool) or not isinstance(echoes, int) or echoes < 10:
        raise SettingError(f"expected 10 or more echoes, got {echoes!r}; {ECHOES} suits most")
    return Diagnosis(url, tuple(_findings(url, baud, echoes)))


def _findings(url: str, baud: int, echoes: int) -> Iterator[Finding]:
    """The findings, until one makes the next impossible."""
    try:
        port = Metered(open_port(url, baud))
    except LinkError as error:
        yield _unopened(url, error)
        return
    try:
        yield _opened(url)
        yield from _latency(url)
        try:
            yield from checkup(port, echoes)
        except LinkError as error:
            yield _failure("device", error)
    finally:
        port.close()


# --- the port -------------------------------------------------------------------------------------


def _failure(name: str, error: LinkError) -> Finding:
    found, _, remedy = str(error).rpartition("; ")
    return Finding(name, "fail", found or remedy, remedy if found else "")


def _unopened(url: str, error: LinkError) -> Finding:
    """Why a port does not open: permission, who has it, which others there are."""
    finding = _failure("port", error)
    if url.startswith("socket://"):
        return finding
    if not os.path.exists(url):
        if "socket://" in finding.remedy:
            return finding  # an address, whatever ports there are
        others = ", ".join(p.path for p in list_ports()) or "none"
        return _with(finding, f"{finding.remedy}; ports there are: {others}", others=others)
    if os.name != "nt" and not (found := system.access(url)).allowed:
        vid, pid = _usb(url)
        remedy = system.permission_remedy(found, vid, pid)
        measured = f"{url} belongs to {found.owner} with mode {found.mode}; you may not open it"
        return Finding("port", "fail", measured, remedy, {"group": found.group})
    if NO_PORT in str(error):
        return finding  # who has /dev/null open is every program there is
    if held := system.holders(url):
        return _with(finding, f"end {_named(held)}, which has it open", holders=held)
    return finding


def _with(finding: Finding, remedy: str, **values: Any) -> Finding:
    return Finding(finding.name, finding.verdict, finding.measured, remedy, values)


def _usb(url: str) -> tuple[int | None, int | None]:
    real = os.path.realpath(url)
    for port in list_ports():
        if os.path.realpath(port.path) == real:
            return port.vid, port.pid
    return None, None


def _named(held: list[tuple[int, str]]) -> str:
    return ", ".join(f"{name} (process {number})" for number, name in held)


def _opened(url: str) -> Finding:
    if url.startswith("socket://"):
        return Finding("port", "ok", "connected")
    if held := system.holders(url):
        return Finding(
            "port", "warn", f"opens, but {_named(held)} has it open too and takes bytes away",
            "end that program (a serial monitor, ModemManager)", {"holders": held},
        )  # fmt: skip
    return Finding("port", "ok", "opens, and nobody else is seen to have it open")


def _latency(url: str) -> Iterator[Finding]:
    """Only for adapters that have such a timer; read after opening, which tries to shorten it."""
    if url.startswith("socket://") or (found := system.latency_timer(url)) is None:
        return
    milliseconds, file = found
    values = {"latency_timer_ms": milliseconds}
    if milliseconds <= LATENCY_TIMER_MS:
        yield Finding("latency timer", "ok", f"{milliseconds} ms", values=values)
        return
    yield Finding(
        "latency timer", "warn", f"{milliseconds} ms: the adapter holds bytes back for that long",
        f"echo 1 | sudo tee {file}, or setserial {url} low_latency; for good by a udev rule: "
        'ACTION=="add", SUBSYSTEM=="usb-serial", DRIVER=="ftdi_sio", ATTR{latency_timer}="1"',
        values,
    )  # fmt: skip
