"""`sewfast device`: the virtual sewing machine behind a port."""

from __future__ import annotations

import argparse
import json
import os
import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Any

from .arguments import Commands, add_command

if TYPE_CHECKING:
    from ..link.virtual import VirtualDevice

DEVICE = """\
Serve the virtual sewing machine on a port, as a real drive would be there.

The first line on standard output is `port NAME`; record, run and doctor take that name. Ctrl-C
ends it.

A pty is named by a symbolic link, which comes back with it after a fault `unplug`. TCP takes one
host at a time.
"""

EXAMPLES = """\
examples:
  sewfast device --link /tmp/drive
  sewfast device --tcp 127.0.0.1:5000 --machine virtual:3 --fast
  sewfast device --faults drop=.001,flip=1e-4,stall=1e-4:0.2 --seed 3 --baud 115200
"""

FAULTS = """\
KIND=RATE or KIND=RATE:SECONDS, separated by commas; rates are per frame, in both directions.
drop, flip (a bit), duplicate, reorder, delay (.02 s), stall (both ways, .2 s), reset (the
device boots anew), unplug (the port is gone, .3 s)
"""

_LOOK = 0.05
"""Time between two looks at signals [s]."""


def add(commands: Commands) -> None:
    parser = add_command(
        commands, "device", device_command,
        summary="the virtual machine behind a port", text=DEVICE, examples=EXAMPLES,
    )  # fmt: skip
    place = parser.add_mutually_exclusive_group()
    place.add_argument(
        "--link", type=Path, metavar="PATH",
        help="serve on a pty with this name; default: one in a temporary folder",
    )  # fmt: skip
    place.add_argument(
        "--tcp", nargs="?", const="127.0.0.1:0", metavar="HOST:PORT",
        help="serve on TCP instead; port 0 takes a free one (127.0.0.1:0)",
    )  # fmt: skip
    parser.add_argument(
        "--anyone", action="store_true",
        help="--tcp may name an address that other computers reach, and start the motor from",
    )  # fmt: skip
    parser.add_argument(
        "--machine", default="virtual", metavar="virtual[:SEED]", help="the machine (virtual)"
    )
    parser.add_argument(
        "--fast", action="store_true",
        help="as fast as the port allows: time advances only by the host's credit",
    )  # fmt: skip
    parser.add_argument(
        "--baud", type=int, metavar="N", help="carry N bits a second each way, 10 for a byte"
    )
    parser.add_argument("--faults", default="", metavar="LIST", help=FAULTS)
    parser.add_argument("--seed", type=int, default=0, metavar="N", help="seed of the faults (0)")
    parser.add_argument("--once", action="store_true", help="end when the first host has gone")
    parser.add_argument(
        "--for", dest="duration", type=float, metavar="S", help="end after S seconds"
    )
    parser.add_argument(
        "--fault-log", type=Path, metavar="FILE", help="a line of JSON for each fault"
    )
    parser.add_argument(
        "--trace", type=Path, metavar="FILE",
        help="a line of JSON for each change of the output and of who is there",
    )  # fmt: skip


def device_command(args: argparse.Namespace) -> None:
    from ..link.virtual import VirtualDevice
    from ..recordfile.writer import require_replaceable

    for log in (args.fault_log, args.trace):
        if log is not None:
            require_replaceable(log, overwrite=False)
    with _signals_as_interrupts():
        with (
            VirtualDevice(
                args.machine,
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


def _serve(device: VirtualDevice, *, as_json: bool) -> None:
    _say(json.dumps({"port": device.port}) if as_json else f"port {device.port}")
    while not device.wait(_LOOK):
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
    """Print at once; whoever listened may have gone without ending the device."""
    try:
        print(line, flush=True)
    except (BrokenPipeError, ValueError):
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


@contextmanager
def _signals_as_interrupts() -> Iterator[None]:
    """SIGTERM, and SIGHUP where there is one, end the device as Ctrl-C does."""

    def interrupt(number: int, frame: FrameType | None) -> None:
        raise KeyboardInterrupt

    numbers = [signal.SIGTERM, *([signal.SIGHUP] if hasattr(signal, "SIGHUP") else [])]
    before = {number: signal.signal(number, interrupt) for number in numbers}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
