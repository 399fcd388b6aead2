"""`sewfast ports`, `doctor`, `stop`, `clear`, `device`: a drive behind a port."""

from __future__ import annotations

import argparse
import json
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..errors import LinkError, SettingError
from .arguments import Commands, add_command, add_view
from .interrupts import patient
from .output import REFUSED, print_json, print_rows, suggested

if TYPE_CHECKING:
    from ..control.machine import Machine
    from ..link import Drive, PortInfo
    from ..link.virtual import VirtualDevice
    from ..machine import VirtualMachine

PORT_HELP = "serial port, socket://HOST:PORT or udp://HOST:PORT"

PORTS = """\
List the serial ports of this computer, with known problems of opening one.

They are not opened: opening alone would restart many boards.
"""


def add_ports(commands: Commands) -> None:
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


# --- `sewfast doctor`: diagnosis of a port and the device behind it -------------------------------


DOCTOR = """\
Examine a port and the device behind it: permission, other programs that use the port, answers of
the device, speed and reliability of the link, clock, state. Each finding has a verdict, a figure
and, if something is wrong, a remedy.

The motor is never moved. Connecting opens a new session, which ends a run of another host.

Exit code 0 if nothing fails (there may be warnings), 2 if something does.
"""

DOCTOR_EXAMPLES = """\
examples:
  sewfast doctor /dev/ttyUSB0
  sewfast doctor /dev/ttyACM0 --baud 921600 --echoes 2000
  sewfast doctor socket://localhost:5000 --json
"""


DOCTOR_OPTIONS = """\
--baud N  int=115200  bits/s of a serial port (115200)
--echoes N  int=200  short messages to send back and forth, and as many long ones (200)
"""


def add_doctor(commands: Commands) -> None:
    parser = add_command(
        commands, "doctor", doctor_command,
        summary="diagnosis of a port",
        text=DOCTOR, options=DOCTOR_OPTIONS, examples=DOCTOR_EXAMPLES,
    )  # fmt: skip
    parser.add_argument("port", metavar="PORT", help=PORT_HELP)


def doctor_command(args: argparse.Namespace) -> int | None:
    from ..link import examine

    found = examine(args.port, baud=args.baud, echoes=args.echoes)
    if args.json:
        print_json(found.to_dict())
    else:
        print(found)
    return 2 if found.verdict == "fail" else None


# --- Options and checks for a drive behind a port; `sewfast stop`, `sewfast clear` ----------------


LIMITS = {
    "volt": "volt",
    "speed": "speed_rpm",
    "acceleration": "acceleration",
    "current": "current",
}
"""Names on the command line, and those of `Drive.set_limits`."""

STOP = """\
Make a drive's output safe: command 0, drive disabled. A tripped drive stays tripped.
"""

CLEAR = """\
Clear the trip of a drive once you know its cause. The drive is then idle; nothing moves.
"""


def add(commands: Commands) -> None:
    for name, command, text in (("stop", stop_command, STOP), ("clear", clear_command, CLEAR)):
        parser = add_command(
            commands, name, command,
            summary={"stop": "stop a drive", "clear": "clear a drive's trip"}[name], text=text,
            examples=f"example:\n  sewfast {name} /dev/ttyUSB0",
        )  # fmt: skip
        parser.add_argument("port", metavar="PORT", help=PORT_HELP)
        _add_baud(parser)


def _add_baud(parser: argparse._ActionsContainer) -> None:
    parser.add_argument(
        "--baud", type=int, default=115_200, metavar="N", help="bits/s of a serial port (115200)"
    )


def add_drive(parser: argparse.ArgumentParser) -> None:
    """Options for a drive behind a port."""
    group = parser.add_argument_group(f"on a drive (PORT: {PORT_HELP})")
    _add_baud(group)
    group.add_argument(
        "--limits", metavar="LIST",
        help="limits of the drive, as volt=10,speed=3500,acceleration=30000,current=15 [V, RPM, "
        "RPM/s, A]; it stops beyond them. inf: no limit. A virtual drive has limits by default; a "
        "virtual machine without a port has none",
    )  # fmt: skip
    group.add_argument(
        "--watchdog", type=float, metavar="MS",
        help="the drive stops without a frame from this computer for this time (100; 250 of its "
        "own time if that runs on credit)",
    )  # fmt: skip
    add_view(group)


def is_port(text: str) -> bool:
    """Whether a text names a port rather than a file or a virtual machine."""
    from ..link.ports import is_port as names_port

    return names_port(text)


def machine_of(text: str) -> VirtualMachine | Machine:
    """The machine that `--on` names: `virtual[:SEED]`, a motor's twin, or an FMU."""
    from ..commissioning.fmu import fmu_of, is_fmu
    from ..machine import VirtualMachine

    if is_fmu(text):
        return fmu_of(text)
    if text.endswith(".json"):
        from ..greybox import load_motor

        return load_motor(text).machine()
    if not text.startswith("virtual"):
        raise SettingError(
            f"--on {text}: expected virtual[:SEED], MOTOR.json, FILE.fmu?volt=24 or a port "
            f"({PORT_HELP}), got none of them; `sewfast ports` lists the serial ports"
        )
    return VirtualMachine.from_name(text)


def _named(machine: str) -> str:
    """The name of a virtual machine, which can be a motor's twin."""
    return machine_of(machine).name if machine.endswith(".json") else machine


def require_no_drive_options(args: argparse.Namespace) -> None:
    """Refuse a drive's options elsewhere: a user could rely on limits that do not apply."""
    given = {
        "--limits": args.limits is not None,
        "--watchdog": args.watchdog is not None,
        "--live": args.live.name not in ("auto", "none"),
    }
    for name, is_given in given.items():
        if is_given:
            raise SettingError(
                name=name, expected="a drive behind a port", received=f"--on {args.on}",
                remedy="leave it out, or serve a virtual machine as a drive, which keeps to "
                "limits: `sewfast device --link DRIVE --fast`, then --on DRIVE",
            )  # fmt: skip


@contextmanager
def opened(args: argparse.Namespace) -> Iterator[Drive]:
    """The drive behind `args.on` with its limits set; the end of the block stops it."""
    from ..link import connect

    limits = _limits(args.limits) if args.limits else None
    watchdog = None if args.watchdog is None else args.watchdog * 1e-3
    if watchdog is not None and not 0.001 <= watchdog <= 10.0:
        raise SettingError(
            f"--watchdog: expected 1 to 10000 ms, got {args.watchdog:g}; 100 suits most"
        )
    with patient(), connect(args.on, baud=args.baud, watchdog=watchdog) as drive:
        if limits is None and not drive.identity.is_computed:
            raise SettingError(
                "expected --limits for a drive that is no virtual one, got none; say what motor "
                "and machine stand: --limits volt=10,speed=3500,acceleration=30000,current=15"
            )
        _require_untripped(args.on, drive)
        # limits of an earlier command must not stay in force unnoticed
        ceilings = dict(zip(LIMITS.values(), drive.limits().ceilings, strict=True))
        drive.set_limits(**(limits or ceilings))
        yield drive


def _require_untripped(port: str, drive: Drive) -> None:
    """Raise `LinkError` with the reason of a trip, as a tripped drive refuses limits without it."""
    status = drive.status()
    if status.state == "tripped":
        raise LinkError(
            f"{port}: expected a drive that is ready, it has tripped: {status.reason}; find out "
            f"why, then `{suggested('clear', port)}`"
        )


def _limits(text: str) -> dict[str, float]:
    """Parse `volt=10,speed=3500,...`."""
    parts = [part.partition("=") for part in text.split(",")]
    names = [name.strip() for name, _, _ in parts]
    if sorted(names) != sorted(LIMITS):
        raise SettingError(
            f"--limits: expected each of {', '.join(LIMITS)} once, got {text!r}; for example "
            "volt=10,speed=3500,acceleration=30000,current=15"
        )
    try:
        return {LIMITS[name.strip()]: float(value) for name, _, value in parts}
    except ValueError:
        raise SettingError(f"--limits: expected numbers, got {text!r}") from None


def recording_place(out: Path | None, *, overwrite: bool) -> Path:
    """The file of a drive's recording: the output itself, or `.mcap` in the same folder.
    Raises `SettingError` without an output, and for an existing recording of a drive, as neither
    can be made again.
    """
    from ..recordfile.writer import require_free, require_replaceable

    if out is None:
        raise SettingError(
            "expected -o FILE for what is recorded on a drive, got none; as in -o run.mcap"
        )
    place = out.with_suffix(".mcap")
    require_replaceable(place, overwrite=overwrite)
    if not place.exists():
        # a table next to its recording can be made again from it; this one cannot
        require_free([out], overwrite=overwrite)
    return place


def stop_command(args: argparse.Namespace) -> None:
    _send(args, "stop")


def clear_command(args: argparse.Namespace) -> None:
    _send(args, "clear")


def _send(args: argparse.Namespace, what: str) -> None:
    from ..link import connect

    with connect(args.port, baud=args.baud) as drive:
        getattr(drive, what)()
        status = drive.status()
    found: dict[str, Any] = {"state": status.state, "speed_rpm": status.speed_rpm}
    if status.state == "tripped":
        found["reason"] = status.reason
    if args.json:
        print_json(found)
    else:
        why = (
            f" ({status.reason}); see to the cause, then `sewfast clear`"
            if "reason" in found
            else ""
        )
        print(f"{args.port}: {status.state}{why}, {status.speed_rpm:.0f} RPM")


# --- `sewfast device`: the virtual sewing machine behind a port -----------------------------------


DEVICE = """\
Serve the virtual sewing machine on a port, like a real drive.

The first line on standard output is `port NAME`; record, run and doctor take that name. Ctrl-C
ends it.

A pty has a symbolic link as its name, which comes back with it after a fault `unplug`. TCP takes
one host at a time.
"""

DEVICE_EXAMPLES = """\
examples:
  sewfast device --link /tmp/drive
  sewfast device --tcp 127.0.0.1:5000 --machine virtual:3 --fast
  sewfast device --faults drop=.001,flip=1e-4,stall=1e-4:0.2 --seed 3 --baud 115200
"""

FAULTS = """\
KIND=RATE or KIND=RATE:SECONDS, separated by commas; rates are per frame, in both directions.
drop, flip (a bit), duplicate, reorder, delay (.02 s), stall (both directions, .2 s), reset (the
device reboots), unplug (the port vanishes, .3 s)
"""


DEVICE_OPTIONS = """\
--anyone  flag  allow --tcp an address that other computers can reach: they can start the motor
--machine virtual[:SEED]|MOTOR.json  text=virtual  the machine (virtual), or the twin of a motor in
    a file of `sewfast physics -o`
--fast  flag  as fast as the port allows: time advances only by the host's credit
--baud N  int  limit to N bits a second in each direction, 10 per byte
--seed N  int=0  seed of the faults (0)
--once  flag  end when the first host has disconnected
--fault-log FILE  path  a line of JSON for each fault
--trace FILE  path  a line of JSON for each change of the output and of the connection
"""


def add_device(commands: Commands) -> None:
    parser = add_command(
        commands, "device", device_command,
        summary="the virtual machine behind a port",
        text=DEVICE, options=DEVICE_OPTIONS, examples=DEVICE_EXAMPLES,
    )  # fmt: skip
    place = parser.add_mutually_exclusive_group()
    place.add_argument(
        "--link", type=Path, metavar="PATH",
        help="serve on a pty with this name (one in a temporary folder)",
    )  # fmt: skip
    place.add_argument(
        "--tcp", nargs="?", const="127.0.0.1:0", metavar="HOST:PORT",
        help="serve on TCP instead; port 0 takes a free one (127.0.0.1:0)",
    )  # fmt: skip
    parser.add_argument("--faults", default="", metavar="LIST", help=FAULTS)
    parser.add_argument(
        "--for", dest="duration", type=float, metavar="S", help="end after S seconds"
    )


def device_command(args: argparse.Namespace) -> int | None:
    from ..link.virtual import VirtualDevice
    from ..recordfile.writer import require_replaceable

    for log in (args.fault_log, args.trace):
        if log is not None:
            require_replaceable(log, overwrite=False)
    with (
        VirtualDevice(
            _named(args.machine),
            fast=args.fast,
            faults=args.faults,
            seed=args.seed,
            baud=args.baud,
            endpoint="tcp" if args.tcp is not None else None,
            link=args.link,
            address=args.tcp or "127.0.0.1:0",
            anyone=args.anyone,
            once=args.once,
            duration=args.duration,
            fault_log=args.fault_log,
            trace=args.trace,
        ) as device,
        suppress(KeyboardInterrupt),
    ):
        _serve(device, as_json=args.json)
    _say_result(device, as_json=args.json)
    return None if device.problem is None else REFUSED


def _serve(device: VirtualDevice, *, as_json: bool) -> None:
    _say(json.dumps({"port": device.port}) if as_json else f"port {device.port}")
    # longest delay of a signal [s]
    while not device.wait(0.05):
        pass


def _say_result(device: VirtualDevice, *, as_json: bool) -> None:
    faults, statistics = device.faults, device.statistics
    result: dict[str, Any] = {"faults": faults, **statistics}
    if as_json:
        _say(json.dumps(result))
    else:
        counts = ", ".join(f"{kind} {count}" for kind, count in faults.items() if count)
        _say(f"faults: {counts or 'none'}")
        _say(
            f"{statistics['samples']} samples, {statistics['late']} late by a period or more, "
            f"the latest by {statistics['latest_us'] / 1e3:.1f} ms; "
            f"{statistics['refused']} hosts refused"
        )
    if device.problem is not None:
        print(f"a log file ended early: {device.problem}", file=sys.stderr)


def _say(line: str) -> None:
    """Print immediately; a reader that has ended must not end the device."""
    try:
        print(line, flush=True)
    except (BrokenPipeError, ValueError):
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
