"""Ports: bytes to a device and back, over a serial line or a network; how each fails, what to do.

Read in this order: `Port`, what every transport has; `SerialPort`, `SocketPort`, `UdpPort`; the
table `TRANSPORTS`, in which a transport is one row, and `open_port`. A new one is a class and its
row: its address, how it carries bytes, what its failures mean.
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
"""What opening, reading and writing a port can raise: pyserial's own kind is an OSError, a port
closed under it is a TypeError, a cable pulled while it is set up a termios.error."""

_MISSING = {errno.ENOENT, errno.ENXIO, errno.ENODEV}
_DENIED = {errno.EACCES, errno.EPERM}
_BUSY = {errno.EBUSY, errno.EAGAIN, errno.EWOULDBLOCK}
_NO_TERMINAL = {errno.ENOTTY, errno.EINVAL, errno.EISDIR}
_UNREACHABLE = {errno.EHOSTUNREACH, errno.ENETUNREACH, errno.EHOSTDOWN, errno.ENETDOWN}

Texts: TypeAlias = tuple[str, str, str]
"""Of a failure: expected, received, remedy."""

A_PORT = "a serial port"
"""What is expected instead of a file, a folder or a device of another kind."""


def explain(url: str, doing: Literal["open", "read", "write"], error: BaseException) -> LinkError:
    """The error as it is raised: expected, received, remedy."""
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


# --- `Unique`: what is open in one place cannot be in two -----------------------------------------


class Unique:
    """Base of what owns a port: a copy would close the original's when it goes."""

    def __reduce_ex__(self, protocol: SupportsIndex) -> NoReturn:
        raise _refusal(self)


def _refusal(owner: Any) -> SettingError:
    name = type(owner).__name__
    return SettingError(
        name="port", expected="one owner", received=f"a copy of a {name}",
        remedy=f"pass the {name} itself on, or connect in the process that uses it",
    )  # fmt: skip


# --- Ports ----------------------------------------------------------------------------------------


CHUNK = 65_536
"""Bytes asked for at once; a port gives what it has."""
WRITE_TIMEOUT = 1.0
CONNECT_TIMEOUT = 5.0


class Port(Unique, ABC):
    """Bytes in and out; every way it can fail is a `LinkError`.

    A transport says how its addresses are written (`form`) and whether they are devices of this
    computer (`is_local`), opens, reads, writes and closes, and knows what its failures mean
    (`opening`, `losing`).

    Parameters
    ----------
    url : str
        What was asked for, as messages repeat it.
    baud : int
        Bits per second; a socket has none and keeps the number only.
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
        """What has come, as soon as anything has; empty after `timeout` seconds without a byte.

        Raises
        ------
        LinkError
            Where the port vanished, the other side closed it, or it is closed.
        """

    @abstractmethod
    def write(self, data: bytes) -> None:
        """All of `data`, or an error.

        Raises
        ------
        LinkError
            Where the port vanished or takes no bytes for a second.
        """

    @abstractmethod
    def fileno(self) -> int:
        """Its descriptor, for who reads and writes without the interpreter.

        Raises
        ------
        LinkError
            Where it is closed.
        """

    @abstractmethod
    def close(self) -> None:
        """Give it back; more than once does no harm, and nothing is raised."""

    @property
    def max_rate(self) -> float:
        """Bits per second that it carries; inf where nothing bounds them."""
        return self.baud

    def describe(self) -> str:
        """What can be said of it once it is open."""
        return "connected"

    @staticmethod
    def opening(url: str, number: int | None, error: BaseException) -> Texts:
        """What was expected, what came and what to do where it does not open.

        Parameters
        ----------
        url : str
        number : int or None
            The operating system's number of the error.
        error : BaseException
        """
        return "a port that opens", "one that does not", "`sewfast ports` lists what is connected"

    @staticmethod
    def losing(url: str, number: int | None, error: BaseException) -> Texts:
        """The same of one that was open."""
        if isinstance(error, TimeoutError) or "timeout" in str(error).lower():
            remedy = "check that the device runs; unplug it if it hangs"
            return "the port to take bytes", f"none taken within {WRITE_TIMEOUT:g} s", remedy
        if number in (errno.ECONNRESET, errno.EPIPE) or isinstance(error, ConnectionError):
            remedy = "see why it ended, then connect again"
            return "an open connection", "one that the other side ended", remedy
        return "an open port", "one that vanished", "check cable and supply, then connect again"

    def reopen(self, timeout: float = CONNECT_TIMEOUT) -> None:
        """Close it and open the same again.

        Parameters
        ----------
        timeout : float
            Longest wait for the other side of a socket [s], for each of its addresses.

        Raises
        ------
        LinkError
            Where it is not there (yet).
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
    """A serial device by its path or COM name; nobody else may open it meanwhile."""

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
            # a port that has vanished cannot be given back
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
        """What a socket that is ready holds."""

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
    """A TCP connection; bytes that wait when it opens are kept."""

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
"""Bytes of a datagram at most: with any header it passes every network in one piece."""


class UdpPort(NetworkPort):
    """Datagrams to one address and from it: those of anybody else are not heard.

    Each carries whole frames, so that one that is lost costs no other its frames. What the network
    loses, repeats or delivers late is seen by the frames' numbers, as on any port.
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
        # the other computer says so when a datagram arrives
        if number == errno.ECONNREFUSED:
            return NetworkPort.opening(url, number, error)
        return NetworkPort.losing(url, number, error)


def _datagrams(data: bytes) -> Iterator[bytes]:
    """The bytes in pieces that end where a frame ends; frames end with a zero."""
    start = 0
    while start < len(data):
        end = min(start + DATAGRAM, len(data))
        if end < len(data):
            end = data.rfind(b"\0", start, end) + 1 or end
        yield data[start:end]
        start = end


TRANSPORTS: dict[str, type[Port]] = {"": SerialPort, "socket": SocketPort, "udp": UdpPort}
"""Transports by what stands before `://` in an address; none is a serial port."""


def transport_of(url: str) -> type[Port] | None:
    """The transport of an address; None for a name of another kind."""
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
        Where it cannot be opened; the message says why and what to do.
    SettingError
        For a name of another kind, or where pyserial is not installed.
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
        What `open_port` takes.
    description : str
    vid, pid : int or None
        Of a USB port.
    serial_number : str or None
        Of a USB port.
    problem : str or None
        Why it cannot be opened and what to do; None where nothing speaks against it.
    """

    path: str
    description: str
    vid: int | None
    pid: int | None
    serial_number: str | None
    problem: str | None

    @property
    def can_open(self) -> bool:
        """Whether nothing is known that speaks against opening it."""
        return self.problem is None


def list_ports() -> list[PortInfo]:
    """The serial ports of this computer, by path.

    None is opened: that alone would restart many boards.

    Raises
    ------
    SettingError
        Where pyserial is not installed.
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
    """None where the port is ready and gives nothing: a device that is gone."""
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
