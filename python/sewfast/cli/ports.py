"""`sewfast ports`: the serial ports of this computer."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING

from .arguments import Commands, add_command
from .output import print_json, print_rows

if TYPE_CHECKING:
    from ..link import PortInfo

PORTS = """\
List the serial ports of this computer, with what speaks against opening one.

None is opened: that alone would restart many boards.
"""


def add(commands: Commands) -> None:
    add_command(
        commands, "ports", ports_command,
        summary="the serial ports of this computer", text=PORTS,
        examples="example:\n  sewfast ports",
    )  # fmt: skip


def ports_command(args: argparse.Namespace) -> None:
    from ..link import list_ports

    ports = list_ports()
    if args.json:
        print_json([_record(p) for p in ports])
        return
    if not ports:
        print("no serial port; plug the drive in, or start a virtual one: sewfast device")
        return
    head = ("port", "USB id", "serial number", "usable", "description")
    print_rows([head, *map(_row, ports)])
    for port in ports:
        if port.problem is not None:
            print(port.problem)


def _record(port: PortInfo) -> dict[str, object]:
    return {
        "path": port.path,
        "description": port.description,
        "vid": port.vid,
        "pid": port.pid,
        "serial_number": port.serial_number,
        "can_open": port.can_open,
        "problem": port.problem,
    }


def _row(port: PortInfo) -> tuple[str, ...]:
    usb = "" if port.vid is None or port.pid is None else f"{port.vid:04x}:{port.pid:04x}"
    usable = "yes" if port.can_open else "no"
    return port.path, usb, port.serial_number or "", usable, port.description
