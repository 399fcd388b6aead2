"""`VirtualDevice`: the virtual sewing machine behind a port, as a context manager."""

from __future__ import annotations

import ipaddress
import os
import shutil
import tempfile
import warnings
import weakref
from collections.abc import Mapping
from contextlib import ExitStack
from pathlib import Path
from typing import Any, Literal, TypeAlias

from .._core import DeviceServer
from ..errors import LinkError, SettingError, unwritable
from ..gains import real
from ..machine import VirtualMachine
from ..storage import require_writable
from .ports import Unique

__all__ = ["VirtualDevice"]

Faults: TypeAlias = "str | Mapping[str, float | tuple[float, float]]"


class VirtualDevice(Unique):
    """The virtual sewing machine served on a port, with the state machine of a real device.

    It is served from construction until `stop`, the end of the `with` block, or the end of the
    interpreter, by a thread without the interpreter.

    Parameters
    ----------
    machine
        ``virtual`` or ``virtual:SEED``.
    fast
        While a session is open, time advances only by the host's credit, as fast as the port
        allows.
    faults
        Faults to inject: ``"drop=.001,flip=1e-4,stall=1e-4:0.2"``, or a mapping from kind to rate
        or to (rate, seconds). Kinds are drop, flip, duplicate, reorder, delay, stall, reset,
        unplug; rates are per frame.
    seed
        Seed of the faults.
    baud
        Bits a second that the port carries each way; None for no limit.
    endpoint
        ``"pty"`` or ``"tcp"``; None takes a pty if the system has them.
    link
        Symbolic link to the pty; None makes one in a temporary folder. The name stays the same when
        the port is unplugged and comes back.
    address
        HOST:PORT to listen on; port 0 takes a free one.
    anyone
        Whether other computers can reach `address`. Anyone who reaches the port can start the
        motor; there is no password.
    once
        End when the first host has disconnected.
    duration
        End after this time [s].
    fault_log, trace
        Files for one line of JSON for each fault, and for each change of the output or of the
        connection.

    Raises
    ------
    SettingError
        For an invalid setting.
    LinkError
        If the port or a file cannot be opened, `link` names something that exists, or other
        computers can reach `address` and `anyone` is not set.

    Warns
    -----
    UserWarning
        If other computers can reach the port.
    """

    def __init__(
        self,
        machine: str = "virtual",
        *,
        fast: bool = False,
        faults: Faults = "",
        seed: int = 0,
        baud: int | None = None,
        endpoint: Literal["pty", "tcp"] | None = None,
        link: str | os.PathLike[str] | None = None,
        address: str = "127.0.0.1:0",
        anyone: bool = False,
        once: bool = False,
        duration: float | None = None,
        fault_log: str | os.PathLike[str] | None = None,
        trace: str | os.PathLike[str] | None = None,
    ) -> None:
        plant = VirtualMachine.from_name(machine)
        pty = _checked_endpoint(endpoint, link) == "pty"
        _check_range("seed", seed, 0, 2**64 - 1)
        if baud is not None:
            _check_range("baud", baud, *(300, 100_000_000))
        if duration is not None and not 0.0 < real("duration", duration) < 1e9:
            raise SettingError(name="duration", expected="above 0 s", received=repr(duration))
        _require_switches(fast=fast, once=once, anyone=anyone)
        if not isinstance(address, str):
            raise SettingError(
                name="address", expected="HOST:PORT", received=repr(address), remedy="port 0 is any"
            )
        with ExitStack() as pipes:
            for name, place in (("link", link), ("fault_log", fault_log), ("trace", trace)):
                _require_place(name, place, pipes)
            if pty and link is not None:
                _require_free(Path(link))
            folder = tempfile.mkdtemp(prefix="sewfast-") if pty and link is None else None
            try:
                self._server = DeviceServer(
                    plant.core,
                    name=plant.name.split("?")[0],
                    pty=pty,
                    link=Path(folder, "port") if folder is not None else _path(link),
                    address=address,
                    anyone=anyone,
                    fast=fast,
                    baud=baud,
                    faults=_faults_text(faults),
                    seed=seed,
                    once=once,
                    duration=duration,
                    fault_log=_path(fault_log),
                    trace=_path(trace),
                )
            except BaseException:
                _end(None, folder)
                raise
        self._end = weakref.finalize(self, _end, self._server, folder)
        if anyone and not pty and not _is_loopback(self.port):
            warnings.warn(
                f"{self.port}: anyone who can reach this port can start the motor; restrict access "
                "by a firewall or an SSH tunnel",
                stacklevel=2,
            )

    @property
    def port(self) -> str:
        """Address for the host: a path, or ``socket://HOST:PORT``."""
        return self._server.port

    @property
    def running(self) -> bool:
        """Whether the device is being served."""
        return not self._server.wait(0.0)

    def wait(self, timeout: float) -> bool:
        """Wait at most `timeout` seconds for the end of serving; return whether it has ended."""
        return self._server.wait(real("timeout", timeout))

    def stop(self) -> None:
        """End serving and remove the port; a second time does nothing.

        Raises
        ------
        LinkError
            If serving had failed.
        """
        self._end()

    def cause(self, fault: str, seconds: float | None = None) -> None:
        """Cause a fault: stall, reset and unplug at once, others with the next frame to the host.

        Parameters
        ----------
        fault
            Its kind.
        seconds
            How long a stall lasts or the port is gone; None for the default.

        Raises
        ------
        SettingError
            For an unknown kind or an invalid time.
        """
        if not isinstance(fault, str):
            raise SettingError(
                name="fault", expected="its name", received=repr(fault), remedy="as in 'unplug'"
            )
        if seconds is not None and not 0.0 < real("seconds", seconds) <= 60.0:
            raise SettingError(
                name="seconds", expected="above 0 and at most 60 s", received=repr(seconds)
            )
        self._server.cause(fault, seconds)

    @property
    def faults(self) -> dict[str, int]:
        """Faults so far by kind, both directions together."""
        to_host, to_device = self._server.faults().values()
        return {kind: count + to_device[kind] for kind, count in to_host.items()}

    @property
    def statistics(self) -> dict[str, int]:
        """Figures of serving so far.

        Numbers of ``samples``, of samples ``late`` by a period or more, the largest delay [us], how
        often the clock was ``set_back`` because it could not catch up, bytes to the host, hosts
        ``refused`` because one was connected.
        """
        return self._server.statistics()

    @property
    def problem(self) -> str | None:
        """Why a log file ended early; None if none did."""
        return self._server.problem()

    def trace(self) -> list[dict[str, Any]]:
        """The server's log of the output, oldest first.

        Each entry has ``event`` (on, off, connected, gone, stalled, unplugged, plugged, reset),
        ``device_us``, ``seconds`` (since the server began), ``state``, and, from the last intact
        heartbeat before it, ``heartbeat_us``, ``heartbeat_seconds`` and ``watchdog_us``, None if
        there was none since the boot. ``late_us`` is the server's own largest delay since that
        heartbeat for lack of a processor: the device's clock is the server's and hides it.
        """
        return self._server.trace()

    def __enter__(self) -> VirtualDevice:
        return self

    def __exit__(self, *exception: object) -> None:
        self.stop()

    def __repr__(self) -> str:
        return f"<VirtualDevice on {self.port}>"


def _end(server: DeviceServer | None, folder: str | None) -> None:
    try:
        if server is not None:
            server.stop()
    finally:
        if folder is not None:
            shutil.rmtree(folder, ignore_errors=True)


def _is_loopback(port: str) -> bool:
    host = port.removeprefix("socket://").rpartition(":")[0].strip("[]")
    return ipaddress.ip_address(host).is_loopback


def _path(path: str | os.PathLike[str] | None) -> Path | None:
    return None if path is None else Path(path)


def _require_switches(**values: object) -> None:
    for name, value in values.items():
        if not isinstance(value, bool):
            raise SettingError(name=name, expected="True or False", received=repr(value))


def _require_place(name: str, place: object, pipes: ExitStack) -> None:
    """Refuse a file that cannot be created, before creating anything. Raises `SettingError` for
    anything but a file name, and `LinkError` if its folder does not exist or a log file cannot be
    written. A pipe stays open in `pipes`: who reads it would take its closing for the end.
    """
    if place is None:
        return
    if not isinstance(place, (str, os.PathLike)) or not os.fspath(place):
        raise SettingError(name=name, expected="a file's name", received=repr(place))
    if not Path(place).parent.is_dir():
        raise LinkError(
            name=os.fspath(place), expected=f"a folder that exists for {name}",
            received=f"none at {Path(place).parent}", remedy="create it, or name another one",
        )  # fmt: skip
    if name == "link":
        return
    if Path(place).is_file() or not Path(place).exists():
        require_writable(place, LinkError)
        return
    try:
        # without O_NONBLOCK, it would wait for somebody to read a pipe
        pipes.callback(os.close, os.open(place, os.O_WRONLY | getattr(os, "O_NONBLOCK", 0)))
    except OSError as e:
        raise unwritable(LinkError, place, e) from e


def _require_free(link: Path) -> None:
    """Refuse to replace what exists by a link, except a dangling one of a killed device."""
    if link.is_symlink() and link.exists():
        raise LinkError(
            name=str(link), expected="a free name",
            received=f"a link to {os.readlink(link)}, which exists",
            remedy="choose another name, end the device that has this one, or remove the link",
        )  # fmt: skip


def _checked_endpoint(endpoint: str | None, link: object) -> str:
    endpoint = endpoint or ("pty" if os.name == "posix" else "tcp")
    if endpoint not in ("pty", "tcp"):
        raise SettingError(name="endpoint", expected="'pty' or 'tcp'", received=repr(endpoint))
    if link is not None and endpoint != "pty":
        raise SettingError(
            name="link", expected="one only to a pty", received=f"{link!r} with endpoint 'tcp'"
        )
    return endpoint


def _check_range(name: str, value: int, low: int, high: int) -> None:
    whole = isinstance(value, int) and not isinstance(value, bool)
    if not whole or not low <= value <= high:
        raise SettingError(
            name=name, expected=f"a whole number from {low} to {high}", received=repr(value)
        )


def _faults_text(faults: Faults) -> str:
    if isinstance(faults, str):
        return faults
    if not isinstance(faults, Mapping):
        raise SettingError(
            name="faults", expected="text or a mapping", received=repr(faults),
            remedy="as in 'drop=.001' or {'drop': 0.001}",
        )  # fmt: skip
    items = []
    for kind, value in faults.items():
        rate, *seconds = value if isinstance(value, tuple) else (value,)
        items.append(f"{kind}={rate!r}" + "".join(f":{s!r}" for s in seconds))
    return ",".join(items)
