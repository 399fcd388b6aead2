"""Ports: bytes to and from a device over a serial line or a network; their failures and remedies.

Read in this order: `Port`, the base class; `SerialPort`, `SocketPort`, `UdpPort`; the table
`TRANSPORTS` with a row for each, and `open_port`. A new transport is a class (its address, how it
carries bytes, the meaning of its failures) and a row.
"""

from __future__ import annotations

import errno
import math
import os
import re
import select
import socket
import stat
import time
from abc import ABC, abstractmethod
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, Literal, NoReturn, SupportsIndex, TypeAlias
from urllib.parse import urlsplit

from ..errors import LinkError, SettingError, not_installed

try:
    import termios

    _TERMINAL: tuple[type[Exception], ...] = (termios.error,)
except ImportError:  # Windows
    _TERMINAL = ()

FAILURES: tuple[type[Exception], ...] = (OSError, ValueError, TypeError, *_TERMINAL)
"""Exceptions from opening, reading and writing a port: pyserial's own is an OSError, a port closed
by another thread raises a TypeError, a cable pulled while it is set up a termios.error."""

_MISSING = {errno.ENOENT, errno.ENXIO, errno.ENODEV}
_DENIED = {errno.EACCES, errno.EPERM}
_BUSY = {errno.EBUSY, errno.EAGAIN, errno.EWOULDBLOCK}
_NO_TERMINAL = {errno.ENOTTY, errno.EINVAL, errno.EISDIR}
_UNREACHABLE = {errno.EHOSTUNREACH, errno.ENETUNREACH, errno.EHOSTDOWN, errno.ENETDOWN}

Texts: TypeAlias = tuple[str, str, str]
"""Texts of a failure: expected, received, remedy."""

A_PORT = "a serial port"
"""The expectation in the error for a file, a folder or a device of another kind."""


def explain(url: str, doing: Literal["open", "read", "write"], error: BaseException) -> LinkError:
    """The `LinkError` to raise for a failure of a port."""
    if isinstance(error, LinkError):
        return LinkError(
            name=url, expected="an open port", received=str(error), remedy="connect again"
        )
    number, kind = _number(error), transport_of(url) or SerialPort
    meant = kind.opening if doing == "open" else kind.losing
    expected, received, remedy = meant(url, number, error)
    return LinkError(
        name=url, expected=expected, received=f"{received} ({_plain(error)})", remedy=remedy
    )


def _number(error: BaseException) -> int | None:
    """The operating system's number of an error; pyserial often gives it only in the text."""
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


# --- `Unique`: objects that own a port ------------------------------------------------------------


class Unique:
    """Base class of the owners of a port: a deleted copy would close the original's port."""

    def __reduce_ex__(self, protocol: SupportsIndex) -> NoReturn:
        name = type(self).__name__
        raise SettingError(
            name="port", expected="one owner", received=f"a copy of a {name}",
            remedy=f"pass the {name} itself on, or connect in the process that uses it",
        )  # fmt: skip


# --- Ports ----------------------------------------------------------------------------------------


CHUNK = 65_536
"""Most bytes to read at once."""
WRITE_TIMEOUT = 1.0
CONNECT_TIMEOUT = 5.0


class Port(Unique, ABC):
    """Bytes in and out; every failure is a `LinkError`. A transport defines the form of its
    addresses (`form`) and whether they are devices of this computer (`is_local`), opens, reads,
    writes and closes, and explains its failures (`opening`, `losing`). `url` is the address as
    given, for messages; `baud` is in bits per second, and a socket only stores the number.
    """

    form: ClassVar[str]
    is_local: ClassVar[bool] = False

    def __init__(self, url: str, baud: int) -> None:
        self.url = url
        self.baud = baud
        self._patience = CONNECT_TIMEOUT
        self._open()

    @abstractmethod
    def _open(self) -> None: ...

    @abstractmethod
    def read(self, timeout: float) -> bytes:
        """The bytes received, as soon as there are any; empty after `timeout` seconds without one.
        Raises `LinkError` if the port vanished, the other side closed it, or it is closed.
        """

    @abstractmethod
    def write(self, data: bytes) -> None:
        """Write all of `data`; `LinkError` if the port vanished or takes no bytes for a second."""

    @abstractmethod
    def fileno(self) -> int:
        """Its descriptor, for code outside the interpreter; `LinkError` if the port is closed."""

    @abstractmethod
    def close(self) -> None:
        """Close it; a second time does nothing, and nothing is raised."""

    @property
    def max_rate(self) -> float:
        """Bits per second that it carries; inf if there is no limit."""
        return self.baud

    def describe(self) -> str:
        return "connected"

    @staticmethod
    def opening(url: str, number: int | None, error: BaseException) -> Texts:
        """Expected, received and remedy for a port that does not open, by the system's `number`."""
        return "a port that opens", "one that does not", "`sewfast ports` lists what is connected"

    @staticmethod
    def losing(url: str, number: int | None, error: BaseException) -> Texts:
        """The same for a port that was open."""
        if isinstance(error, TimeoutError) or "timeout" in str(error).lower():
            remedy = "check that the device runs; unplug it if it hangs"
            return "the port to take bytes", f"none taken within {WRITE_TIMEOUT:g} s", remedy
        if number in (errno.ECONNRESET, errno.EPIPE) or isinstance(error, ConnectionError):
            remedy = "see why it ended, then connect again"
            return "an open connection", "one that the other side ended", remedy
        return "an open port", "one that vanished", "check cable and supply, then connect again"

    def reopen(self, timeout: float = CONNECT_TIMEOUT) -> None:
        """Close the port and open it again. `timeout` is the longest wait for the other side of a
        socket [s], for each of its addresses. Raises `LinkError` if it is not there (yet).
        """
        self.close()
        self._patience = timeout
        self._open()

    def _write(self, descriptor: int, data: bytes) -> None:
        left, deadline = memoryview(data), time.monotonic() + WRITE_TIMEOUT
        while left:
            try:
                left = left[os.write(descriptor, left) :]
            except BlockingIOError:
                rest = max(0.0, deadline - time.monotonic())
                if not select.select((), (descriptor,), (), rest)[1]:
                    raise TimeoutError(f"{len(left)} of {len(data)} bytes not taken") from None


class SerialPort(Port):
    """A serial device by its path or COM name, opened exclusively."""

    form = "a serial port's path (/dev/ttyUSB0), a COM name (COM3)"
    is_local = True
    _serial: Any = None

    def describe(self) -> str:
        return "opens, and no other program seems to have it open"

    @staticmethod
    def opening(url: str, number: int | None, error: BaseException) -> Texts:
        if number in _BUSY or (os.name == "nt" and number in _DENIED):
            remedy = "close the other program (a serial monitor, ModemManager, another sewfast)"
            return "a port that nobody else uses", "one in use", remedy
        if number in _MISSING:
            remedy = "plug the cable in and see `sewfast ports`"
            if re.fullmatch(r"[^/\\]+:\d+", url):
                remedy = f"an address is written socket://{url}"
            return "a serial port of this name", "none", remedy
        if number in _DENIED:
            return "a port that you may open", "no permission", _permission(url)
        if number in _NO_TERMINAL:
            remedy = "`sewfast ports` lists what is connected"
            return A_PORT, "something else", remedy
        if isinstance(error, ValueError):
            remedy = "give a rate that the adapter offers, such as 115200"
            return "a baud rate of this port", "another", remedy
        remedy = "unplug it, plug it in again and retry"
        return "a serial port that opens", "one that does not", remedy

    def _open(self) -> None:
        module = _pyserial()
        try:
            self._serial = module.Serial(
                self.url, self.baud, timeout=0, write_timeout=WRITE_TIMEOUT, exclusive=True
            )
        except FAILURES as error:
            raise explain(self.url, "open", error) from error
        # only Linux has it, and only some drivers there
        with suppress(AttributeError, *FAILURES):
            self._serial.set_low_latency_mode(True)

    def read(self, timeout: float) -> bytes:
        try:
            data = _read(self._serial, timeout)
        except FAILURES as error:
            raise explain(self.url, "read", error) from error
        if data is None:
            raise explain(self.url, "read", OSError("it is ready, but holds nothing"))
        return data

    def write(self, data: bytes) -> None:
        try:
            if os.name == "nt":
                _require(self._serial).write(data)
            else:
                self._write(_require(self._serial).fileno(), data)
        except FAILURES as error:
            raise explain(self.url, "write", error) from error

    def fileno(self) -> int:
        return int(_require(self._serial).fileno())

    def close(self) -> None:
        if self._serial is not None:
            # a vanished port cannot be closed
            with suppress(*FAILURES):
                self._serial.close()
            self._serial = None


class NetworkPort(Port):
    """A socket that is connected to one address, `scheme://host:port`."""

    _socket: socket.socket | None = None

    @property
    def max_rate(self) -> float:
        return math.inf

    def _open(self) -> None:
        address = _address(self.url)
        try:
            self._socket = self._connected(address)
            self._socket.setblocking(False)
        except FAILURES as error:
            self.close()
            raise explain(self.url, "open", error) from error

    @abstractmethod
    def _connected(self, address: tuple[str, int]) -> socket.socket: ...

    @abstractmethod
    def _received(self, connection: socket.socket) -> bytes:
        """Read from a socket that is ready."""

    @abstractmethod
    def _sent(self, connection: socket.socket, data: bytes) -> None: ...

    def read(self, timeout: float) -> bytes:
        try:
            connection = _require(self._socket)
            if not select.select((connection,), (), (), timeout)[0]:
                return b""
            return self._received(connection)
        except BlockingIOError:
            return b""
        except FAILURES as error:
            raise explain(self.url, "read", error) from error

    def write(self, data: bytes) -> None:
        try:
            self._sent(_require(self._socket), data)
        except FAILURES as error:
            raise explain(self.url, "write", error) from error

    def fileno(self) -> int:
        return int(_require(self._socket).fileno())

    def close(self) -> None:
        if self._socket is not None:
            with suppress(*FAILURES):
                self._socket.close()
            self._socket = None

    @staticmethod
    def opening(url: str, number: int | None, error: BaseException) -> Texts:
        server = "a device that listens there"
        if number == errno.ECONNREFUSED:
            return server, "nobody", "start it (`sewfast device` for a virtual one)"
        if isinstance(error, TimeoutError) or number in _UNREACHABLE:
            return server, "no answer", "check the address, the network and the firewall"
        return server, "no such way", "check host and port"


class SocketPort(NetworkPort):
    """A TCP connection."""

    form = "socket://HOST:PORT"

    def _connected(self, address: tuple[str, int]) -> socket.socket:
        connection = socket.create_connection(address, self._patience)
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        return connection

    def _received(self, connection: socket.socket) -> bytes:
        data = bytes(connection.recv(CHUNK))
        if not data:
            raise ConnectionError("the other side closed it")
        return data

    def _sent(self, connection: socket.socket, data: bytes) -> None:
        connection.settimeout(WRITE_TIMEOUT)
        try:
            connection.sendall(data)
        finally:
            connection.setblocking(False)


DATAGRAM = 1200
"""Most bytes of a datagram: with any header it passes every network unfragmented."""


class UdpPort(NetworkPort):
    """Datagrams to and from one address; those from other addresses are ignored.
    Each holds whole frames, so that losing one damages no frame of another. The frames' sequence
    numbers show what the network loses, repeats or delivers late, as on any port.
    """

    form = "udp://HOST:PORT"

    def _connected(self, address: tuple[str, int]) -> socket.socket:
        failed: OSError | None = None
        host, port = address
        ways = socket.getaddrinfo(host, port, type=socket.SOCK_DGRAM)
        for family, kind, protocol, _, place in ways:
            found = socket.socket(family, kind, protocol)
            try:
                found.connect(place)
            except OSError as error:
                found.close()
                failed = error
            else:
                return found
        raise failed or OSError("no address")

    def _received(self, connection: socket.socket) -> bytes:
        return bytes(connection.recv(CHUNK))

    def _sent(self, connection: socket.socket, data: bytes) -> None:
        for datagram in _datagrams(data):
            self._write(connection.fileno(), datagram)

    @staticmethod
    def losing(url: str, number: int | None, error: BaseException) -> Texts:
        # the other computer refuses only when the first datagram arrives
        if number == errno.ECONNREFUSED:
            return NetworkPort.opening(url, number, error)
        return NetworkPort.losing(url, number, error)


def _datagrams(data: bytes) -> Iterator[bytes]:
    """The bytes in pieces of whole frames; a frame ends with a zero."""
    start = 0
    while start < len(data):
        end = min(start + DATAGRAM, len(data))
        if end < len(data):
            end = data.rfind(b"\0", start, end) + 1 or end
        yield data[start:end]
        start = end


TRANSPORTS: dict[str, type[Port]] = {"": SerialPort, "socket": SocketPort, "udp": UdpPort}
"""Transports by the scheme before `://` in an address; without one, it is a serial port."""


def transport_of(url: str) -> type[Port] | None:
    """The transport of an address; None for any other name."""
    scheme, separated, _ = url.partition("://")
    if separated:
        return TRANSPORTS.get(scheme) if scheme else None
    return SerialPort if url and url.split(":")[0] != "virtual" else None


def is_port(text: str) -> bool:
    """Whether a text names a port rather than a file or a virtual machine."""
    kind = transport_of(text)
    if kind is not SerialPort:
        return kind is not None
    if text.startswith("/dev/") or re.fullmatch(r"COM\d+", text, re.IGNORECASE):
        return True
    try:
        return stat.S_ISCHR(Path(text).stat().st_mode)
    except (OSError, ValueError):
        return False


def open_port(url: str, baud: int = 115_200) -> Port:
    """Open a port by its address.

    Parameters
    ----------
    url : str
        A device's path, a COM name, ``socket://host:port`` (TCP) or ``udp://host:port``.
    baud : int
        Bits per second of a serial port.

    Raises
    ------
    LinkError
        If it cannot be opened; the message says why and what to do.
    SettingError
        For a name that is no address, or if pyserial is not installed.
    """
    if not isinstance(baud, int) or isinstance(baud, bool) or baud <= 0:
        raise SettingError(
            name="baud", expected="a whole number above 0", received=repr(baud), remedy="try 115200"
        )
    if not isinstance(url, str):
        raise SettingError(
            name="port", expected="its name as text", received=repr(url),
            remedy="as in '/dev/ttyUSB0' or 'socket://localhost:5000'",
        )  # fmt: skip
    kind = transport_of(url)
    if kind is None:
        *others, last = (transport.form for transport in TRANSPORTS.values())
        raise SettingError(
            name="port", expected=f"{', '.join(others)} or {last}", received=repr(url),
            remedy="`sewfast ports` lists the serial ports",
        )  # fmt: skip
    return kind(url, baud)


@dataclass(frozen=True)
class PortInfo:
    """A serial port of this computer.

    Parameters
    ----------
    path : str
        Its address for `open_port`.
    description : str
    vid, pid : int or None
        Of a USB port.
    serial_number : str or None
        Of a USB port.
    problem : str or None
        Why it cannot be opened and what to do; None if no problem is known.
    """

    path: str
    description: str
    vid: int | None
    pid: int | None
    serial_number: str | None
    problem: str | None

    @property
    def can_open(self) -> bool:
        """Whether no problem with opening it is known."""
        return self.problem is None


def list_ports() -> list[PortInfo]:
    """The serial ports of this computer, by path.

    They are not opened: opening alone would restart many boards.

    Raises
    ------
    SettingError
        If pyserial is not installed.
    """
    _pyserial()
    from serial.tools.list_ports import comports

    ports = [
        PortInfo(p.device, p.description, p.vid, p.pid, p.serial_number, _problem(p.device))
        for p in comports()
    ]
    return sorted(ports, key=lambda p: p.path)


def _problem(path: str) -> str | None:
    if os.name == "nt" or os.access(path, os.R_OK | os.W_OK):
        return None
    kind = PermissionError if os.path.exists(path) else FileNotFoundError
    return str(explain(path, "open", kind(None, "permission denied")))


def _pyserial() -> Any:
    try:
        import serial
    except ImportError as error:
        purpose = "a serial port (socket://HOST:PORT works without)"
        raise not_installed("pyserial", purpose, "sewfast[link]") from error
    return serial


def _permission(url: str) -> str:
    """The remedy of a denied port: join its group, whose name differs between distributions."""
    group = "dialout"
    try:
        import grp

        found = os.stat(url)
        if stat.S_IMODE(found.st_mode) & stat.S_IWGRP:
            group = grp.getgrgid(found.st_gid).gr_name
    except (ImportError, OSError, KeyError):
        pass
    return f"join its group (sudo usermod -aG {group} $USER) and log in again"


def _address(url: str) -> tuple[str, int]:
    scheme = url.partition("://")[0]
    try:
        parts = urlsplit(url)
        host, port = parts.hostname, parts.port
    except ValueError:
        host = port = None
    if not host or not port or parts.path not in ("", "/"):
        raise SettingError(
            name="port", expected=f"{scheme}://HOST:PORT with a port of 1 to 65535",
            received=repr(url), remedy=f"as in {scheme}://localhost:5000",
        )  # fmt: skip
    return host, port


def _read(port: Any, timeout: float) -> bytes | None:
    """The bytes received; None if the port is ready but empty: its device is gone."""
    _require(port)
    if os.name == "nt":
        port.timeout = timeout
        first = port.read(1)
        port.timeout = 0
        return bytes(first) + bytes(port.read(CHUNK)) if first else b""
    if not select.select((port.fd,), (), (), timeout)[0]:
        return b""
    try:
        return os.read(int(port.fd), CHUNK) or None
    except BlockingIOError:
        return b""


def _require(port: Any) -> Any:
    if port is None:
        raise LinkError(
            name="port", expected="an open one", received="a closed one", remedy="connect again"
        )
    return port
