"""Ports: bytes come through, and every failure is one `LinkError` that says what to do."""

from __future__ import annotations

import errno
import json
import os
import pty
import socket
import stat
import sys
import threading
import time
import tty
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import pytest

from cli import sewfast
from refusals import refuses
from sewfast.errors import LinkError, SettingError
from sewfast.link import PortInfo, list_ports, open_port, ports
from sewfast.link.ports import explain

REMEDY = r"expected .+; .+"


@pytest.fixture
def terminal() -> Iterator[tuple[int, str]]:
    """The device's end of a pty and the host's path to it."""
    master, slave = pty.openpty()
    tty.setraw(slave)
    path = os.ttyname(slave)
    os.close(slave)
    yield master, path
    # a test may have closed it
    with suppress(OSError):
        os.close(master)


@pytest.fixture
def server() -> Iterator[socket.socket]:
    with socket.create_server(("127.0.0.1", 0)) as listener:
        yield listener


def url_of(server: socket.socket) -> str:
    return f"socket://127.0.0.1:{server.getsockname()[1]}"


# --- bytes --------------------------------------------------------------------------------------


def test_a_pty_carries_bytes_both_ways(terminal):
    master, path = terminal
    port = open_port(path, 921_600)
    port.write(b"to the device\0\xff")
    assert os.read(master, 100) == b"to the device\0\xff"
    os.write(master, bytes(range(256)))
    assert port.read(1.0) == bytes(range(256))
    port.close()
    port.close()


def test_a_socket_keeps_what_waits_when_it_opens(server):
    port = open_port(url_of(server))
    peer, _ = server.accept()
    with peer:
        peer.sendall(b"early")
        assert port.read(1.0) == b"early"
        port.write(b"answer")
        assert peer.recv(100) == b"answer"
    port.close()


def test_a_socket_sends_small_frames_at_once(server):
    port = open_port(url_of(server))
    assert port._socket.getsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY)
    port.close()


def test_reading_gives_what_is_there_without_waiting_for_more(terminal):
    master, path = terminal
    port = open_port(path)
    os.write(master, b"x")
    began = time.monotonic()
    assert port.read(30.0) == b"x"
    assert time.monotonic() - began < 15.0
    assert port.read(0.0) == b""
    port.close()


def test_a_megabyte_is_written_whole_while_the_other_side_reads_slowly(server):
    port = open_port(url_of(server))
    peer, _ = server.accept()
    data = os.urandom(1 << 20)
    writer = threading.Thread(target=port.write, args=(data,))
    writer.start()
    got = b""
    while len(got) < len(data):
        got += peer.recv(1 << 16)
    writer.join()
    assert got == data
    port.close()
    peer.close()


def test_reopening_finds_the_device_that_came_back(tmp_path):
    path = tmp_path / "port"
    first, second = pty.openpty(), pty.openpty()
    path.symlink_to(os.ttyname(first[1]))
    port = open_port(str(path))
    os.close(first[1])
    os.close(first[0])
    with pytest.raises(LinkError):
        port.read(1.0)
    path.unlink()
    path.symlink_to(os.ttyname(second[1]))
    port.reopen()
    port.write(b"again\n")
    assert os.read(second[0], 100).startswith(b"again")
    port.close()
    for end in second:
        os.close(end)


# --- failures -----------------------------------------------------------------------------------


def test_a_path_that_is_not_there(tmp_path):
    with refuses(LinkError, expected="port of this name", received="none", remedy="sewfast ports"):
        open_port(str(tmp_path / "ttyUSB7"))


@pytest.mark.parametrize("url", [None, 5, b"/dev/ttyUSB0"])
def test_a_name_that_is_no_text(url):
    with refuses(SettingError, name="port", expected="text"):
        open_port(url)


@pytest.mark.parametrize("kind", ["file", "folder", "null"])
def test_what_is_no_serial_port(tmp_path, kind):
    path = {"file": tmp_path / "file", "folder": tmp_path, "null": Path("/dev/null")}[kind]
    if kind == "file":
        path.write_text("no port")
    with pytest.raises(LinkError, match=REMEDY):
        open_port(str(path))


def test_a_port_that_another_program_has(terminal):
    port = open_port(terminal[1])
    with refuses(
        LinkError, expected="nobody else uses", received="in use", remedy="close the other program"
    ):
        open_port(terminal[1])
    port.close()
    open_port(terminal[1]).close()


def test_a_port_without_permission_names_the_group(tmp_path):
    path = tmp_path / "port"
    path.write_text("")
    path.chmod(stat.S_IRUSR | stat.S_IWUSR | stat.S_IRGRP | stat.S_IWGRP)
    error = explain(str(path), "open", PermissionError(errno.EACCES, "Permission denied"))
    import grp

    group = grp.getgrgid(path.stat().st_gid).gr_name
    assert f"usermod -aG {group} $USER" in str(error)


@pytest.mark.skipif(os.geteuid() == 0, reason="root may open everything")
def test_a_port_that_may_not_be_opened(terminal):
    os.chmod(terminal[1], 0)
    with refuses(LinkError, received="no permission"):
        open_port(terminal[1])


def test_the_device_vanishes(terminal):
    master, path = terminal
    port = open_port(path)
    os.close(master)
    with refuses(LinkError, expected="an open port", received="vanished", remedy="cable"):
        port.read(1.0)
    with pytest.raises(LinkError, match=REMEDY):
        port.write(b"anybody?")
    with pytest.raises(LinkError):
        port.reopen()
    with pytest.raises(LinkError, match="connect again"):
        port.read(0.0)


def test_the_other_side_takes_nothing(terminal, monkeypatch):
    monkeypatch.setattr(ports, "WRITE_TIMEOUT", 0.05)
    port = open_port(terminal[1])
    with refuses(LinkError, expected="to take bytes", received="none taken"):
        port.write(bytes(1 << 20))
    port.close()


def test_the_socket_takes_nothing(server, monkeypatch):
    monkeypatch.setattr(ports, "WRITE_TIMEOUT", 0.05)
    port = open_port(url_of(server))
    with refuses(LinkError, expected="to take bytes", received="none taken"):
        port.write(bytes(1 << 26))
    port.close()


def test_nobody_listens():
    with socket.create_server(("127.0.0.1", 0)) as closed:
        url = url_of(closed)
    with refuses(LinkError, expected="listens there", received="nobody", remedy="sewfast device"):
        open_port(url)


def test_an_address_that_never_answers(monkeypatch):
    def silent(*_: object) -> None:
        raise TimeoutError("timed out")

    monkeypatch.setattr(socket, "create_connection", silent)
    with refuses(LinkError, received="no answer", remedy="firewall"):
        open_port("socket://192.0.2.1:5000")


def test_a_host_that_does_not_exist(monkeypatch):
    def unknown(*_: object) -> None:
        raise socket.gaierror(socket.EAI_NONAME, "Name or service not known")

    monkeypatch.setattr(socket, "create_connection", unknown)
    with pytest.raises(LinkError, match="check host and port"):
        open_port("socket://nowhere.invalid:5000")


@pytest.mark.parametrize("linger", [False, True], ids=["closed", "reset"])
def test_the_other_side_ends_the_connection(server, linger):
    port = open_port(url_of(server))
    peer, _ = server.accept()
    if linger:
        peer.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, b"\1\0\0\0\0\0\0\0")
    peer.close()
    with refuses(LinkError, received="the other side ended"):
        port.read(1.0)
    port.close()


@pytest.mark.parametrize("url", ["", "http://a:1", "rfc2217://a:1", "virtual", "virtual:3"])
def test_what_is_no_port(url):
    with pytest.raises(SettingError, match=r"expected a serial port's path.*sewfast ports"):
        open_port(url)


@pytest.mark.parametrize("url", ["socket://", "socket://host", "socket://:5", "socket://h:99999"])
def test_what_is_no_address(url):
    with pytest.raises(SettingError, match="HOST:PORT"):
        open_port(url)


@pytest.mark.parametrize("baud", [0, -1, 9600.5, True, "fast"])
def test_what_is_no_baud_rate(baud):
    with pytest.raises(SettingError, match="baud"):
        open_port("/dev/null", baud)


def test_without_pyserial_sockets_work_and_serial_ports_name_the_extra(server, monkeypatch):
    monkeypatch.setitem(sys.modules, "serial", None)
    open_port(url_of(server)).close()
    with pytest.raises(SettingError, match=r"pip install \"sewfast\[link\]\""):
        open_port("/dev/ttyUSB0")
    with pytest.raises(SettingError, match=r"sewfast\[link\]"):
        list_ports()


WAYS = [
    OSError(errno.EIO, "Input/output error"),
    OSError(errno.ENXIO, "No such device or address"),
    OSError(errno.ENODEV, "No such device"),
    OSError(errno.ETIMEDOUT, "Connection timed out"),
    ConnectionResetError(errno.ECONNRESET, "Connection reset by peer"),
    BrokenPipeError(errno.EPIPE, "Broken pipe"),
    ValueError("Invalid baud rate: 1"),
    TypeError("an integer is required (got type NoneType)"),
    OSError("device reports readiness to read but returned no data"),
    OSError("read failed: [Errno 5] Input/output error"),
    OSError("could not open port 'COM3': FileNotFoundError(2, 'cannot find', None, 2)"),
]


@pytest.mark.parametrize("doing", ["open", "read", "write"])
@pytest.mark.parametrize("error", [*WAYS, pytest.param("termios", id="termios.error")], ids=repr)
def test_each_way_to_fail_says_what_to_do(doing, error):
    if error == "termios":
        termios = pytest.importorskip("termios")
        error = termios.error(errno.EIO, "Input/output error")
    found = explain("/dev/ttyUSB0", doing, error)
    assert isinstance(found, OSError)
    before, received, *remedy = str(found).replace("; ", ", ").split(", ")
    assert before.startswith("/dev/ttyUSB0: expected ")
    assert received
    assert remedy


def test_pyserial_hides_the_number_in_its_text():
    windows = OSError("could not open port 'COM3': FileNotFoundError(2, 'cannot find', None, 2)")
    assert "received none" in str(explain("COM3", "open", windows))


# --- which there are ----------------------------------------------------------------------------


def test_ports_are_listed_by_path(monkeypatch, tmp_path, capsys):
    class Found:
        def __init__(self, device: str, vid: int | None = None) -> None:
            self.device, self.description, self.vid, self.pid = device, "an adapter", vid, vid
            self.serial_number = None

    there = tmp_path / "a"
    there.touch()
    comports = pytest.importorskip("serial.tools.list_ports")
    monkeypatch.setattr(
        comports, "comports", lambda: [Found(str(tmp_path / "b"), 0x0403), Found(str(there))]
    )
    first, second = list_ports()
    assert first == PortInfo(str(there), "an adapter", None, None, None, None)
    assert first.can_open
    assert second.vid == 0x0403
    assert not second.can_open
    assert "received none" in str(second.problem)

    from sewfast.cli import main

    assert main(["ports"]) == 0
    printed = capsys.readouterr().out
    assert "0403:0403" in printed
    assert str(second.problem) in printed
    assert main(["ports", "--json"]) == 0
    listed = json.loads(capsys.readouterr().out)
    assert [port["can_open"] for port in listed] == [True, False]


def test_the_command_lists_ports(tmp_path):
    found = sewfast(tmp_path, "ports", "--json").json()
    assert isinstance(found, list)
    assert all(set(p) >= {"path", "vid", "pid", "can_open"} for p in found)
    assert sewfast(tmp_path, "ports").out


def test_a_socket_is_opened_again_within_the_time_given(monkeypatch):
    waits = []

    def refuse(address, timeout):
        waits.append(timeout)
        raise TimeoutError("timed out")

    with socket.create_server(("127.0.0.1", 0)) as server:
        port = open_port(f"socket://127.0.0.1:{server.getsockname()[1]}")
        monkeypatch.setattr(socket, "create_connection", refuse)
        with pytest.raises(LinkError):
            port.reopen(0.3)
    assert waits == [0.3]
