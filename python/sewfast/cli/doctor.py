"""`sewfast doctor`: what is wrong with a port and the device behind it."""

from __future__ import annotations

import argparse

from .arguments import Commands, add_command
from .output import print_json

DOCTOR = """\
Examine a port and the device behind it: may it be opened and who else has it open, does a device
answer, how fast and how reliably, does its clock agree, how is it. Each finding has a verdict, a
figure and, where something is wrong, a remedy.

The motor is never moved. The device is greeted anew, which ends a run of another host.

Exit code 0 where nothing fails (there may be warnings), 2 where something does.
"""

EXAMPLES = """\
examples:
  sewfast doctor /dev/ttyUSB0
  sewfast doctor /dev/ttyACM0 --baud 921600 --echoes 2000
  sewfast doctor socket://localhost:5000 --json
"""


def add(commands: Commands) -> None:
    parser = add_command(
        commands, "doctor", doctor_command,
        summary="what is wrong with a port", text=DOCTOR, examples=EXAMPLES,
    )  # fmt: skip
    parser.add_argument("port", metavar="PORT", help="serial port or socket://HOST:PORT")
    parser.add_argument(
        "--baud", type=int, default=115_200, metavar="N", help="bits/s of a serial port (115200)"
    )
    parser.add_argument(
        "--echoes", type=int, default=200, metavar="N",
        help="messages to and fro, short ones and as many long ones (200)",
    )  # fmt: skip


def doctor_command(args: argparse.Namespace) -> int | None:
    from ..link import examine

    found = examine(args.port, baud=args.baud, echoes=args.echoes)
    if args.json:
        print_json(found.to_dict())
    else:
        print(found)
    return 2 if found.verdict == "fail" else None
