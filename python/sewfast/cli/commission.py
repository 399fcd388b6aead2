"""`sewfast commission`, `report`: all the way to a controller."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from ..errors import Interrupted
from ..progress import Progress
from .arguments import Commands, add_command, add_overwrite
from .drive import add_drive, is_port, machine_of, opened, require_no_drive_options
from .output import INTERRUPTED, print_json, suggested

if TYPE_CHECKING:
    from ..commissioning import Commissioning


TEXT = """\
Follow an engineer's procedure for a drive: find the command that moves it, record its step
response, compute first gains by rule, record a closed loop under these and pulses up to the
command's limit, train an ensemble of networks, tune the gains on all of them, run them on the
machine and report prediction and measurement together. It stops with a reason if the evidence is
not good enough.

The machine turns freely up to a quarter more than the top speed (--speed), again and again, each
time from rest. DIR gets recordings, models, controllers, runs and report.html; Ctrl-C stops the
motor and keeps the results so far.
"""

EXAMPLES = """\
examples:
  sewfast commission --on virtual --out virtual
  sewfast commission --on virtual:7 --out seven --speed 1500
  sewfast commission --on /dev/ttyUSB0 --out machine --u-max 10 --speed 2000 \\
      --limits volt=10,speed=3500,acceleration=30000,current=15
"""


OPTIONS = """\
--on virtual[:SEED]|FILE.fmu?volt=V|PORT  text!  machine to commission: virtual machine, FMU of
    another tool, or drive
--out DIR  path!  folder to fill
--u-max V  float  largest command in either direction (the machine's)
--speed RPM  float  top of the working range (the largest reference, else 2000)
--reference NAME  text...  a named reference for tuning and verification (`sewfast signals`); may
    repeat
--members N  int=4  networks (4)
--evaluations N  int=3000  controllers tried (3000)
--load V  float  load in volts of command, from which the loop must recover as fast as Eq. 12's (a
    tenth of --u-max; 0: not required)
--Ms MS  float  largest sensitivity allowed (1.8; inf: no limit)
--time-budget S  float  time of the search for gains (no limit)
--loop  {speed,position}=speed  with a position loop over that of the speed, verified by stops at an
    angle
--seed N  int=0  seed of the random signals, the networks and the search (0)
--resume  flag  continue from the recordings of an attempt with the same settings in DIR
"""


def add(commands: Commands) -> None:
    parser = add_command(
        commands, "commission", command,
        summary="from a machine at rest to a verified controller",
        text=TEXT, options=OPTIONS, examples=EXAMPLES,
    )  # fmt: skip
    add_overwrite(parser)
    add_drive(parser)


def command(args: argparse.Namespace) -> int | None:
    from ..commissioning.checkpoint import FOLDER, prepare
    from ..commissioning.result import require_own

    if not is_port(args.on):
        require_no_drive_options(args)
    require_own(args.out, overwrite=args.overwrite or args.resume)
    prepare(args.out)
    if is_port(args.on):
        # the recordings of a virtual machine can be made again
        print(
            f"each recording is saved in {args.out / FOLDER} as soon as it is complete",
            file=sys.stderr,
            flush=True,
        )
    return _kept(args)


def _kept(args: argparse.Namespace) -> int | None:
    """Commission, and write the result into the folder, however it ends."""
    from ..commissioning import Refusal

    try:
        found = _commissioned(args)
    except Refusal as refusal:
        if refusal.so_far is not None:
            refusal.so_far.save(args.out, overwrite=True)
        raise Refusal(f"{refusal}; what there is lies in {args.out}") from refusal
    except Interrupted as stop:
        stop.best.save(args.out, overwrite=True, page=False)
        print(
            f"interrupted; kept the best so far in {args.out}, without a page "
            f"({suggested('report', args.out)} writes it)",
            file=sys.stderr,
        )
        return INTERRUPTED
    page = found.save(args.out, overwrite=True)
    if args.json:
        print_json({"folder": str(args.out), **found.numbers()})
    else:
        print(f"{found}\nlook at {page}")
    return None if found.is_verified else 2


def _commissioned(args: argparse.Namespace) -> Commissioning:
    from ..commissioning import commission

    with Progress("commission", quiet=args.quiet) as progress:
        options = {
            "u_max": args.u_max,
            "speed": args.speed,
            "references": args.reference,
            "members": args.members,
            "evaluations": args.evaluations,
            "load": args.load,
            **({} if args.Ms is None else {"Ms": args.Ms}),
            "time_budget": args.time_budget,
            "loop": args.loop,
            "seed": args.seed,
            "progress": lambda done, total, stage: progress.say(stage),
            "folder": args.out,
            "overwrite": args.overwrite,
            "resume": args.resume,
        }
        if is_port(args.on):
            with opened(args) as drive:
                return commission(drive, **options)
        return commission(machine_of(args.on), **options)


# --- `sewfast report`: the page of an experiment --------------------------------------------------


REPORT = """\
Write DIR/report.html again from the files of `sewfast demo` or `sewfast commission` in DIR; nothing
is computed again.
"""


def add_report(commands: Commands) -> None:
    parser = add_command(
        commands, "report", report_command,
        summary="the page of an experiment", text=REPORT,
        examples="example:\n  sewfast report demo",
    )  # fmt: skip
    parser.add_argument(
        "folder", type=Path, metavar="DIR", help="folder that demo or commission filled"
    )


def report_command(args: argparse.Namespace) -> None:
    from ..report import report

    page = report(args.folder)
    if args.json:
        print_json({"report": str(page)})
    else:
        print(page)
