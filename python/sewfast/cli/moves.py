"""`sewfast profile`, `plan`, `learn`: known moves."""

from __future__ import annotations

import argparse
import math
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..errors import Interrupted, SettingError
from ..progress import Progress
from ..units import spelled
from .arguments import (
    TABLES,
    Commands,
    add_command,
    add_options,
    add_output,
    add_overwrite,
    add_plot,
    require_place,
    require_plot,
)
from .drive import add_drive, is_port, machine_of, opened, require_no_drive_options
from .output import INTERRUPTED, print_json, suggested, write_columns
from .tune import useful_models

if TYPE_CHECKING:
    from ..control.controller import SampledController
    from ..control.move import MoveTable
    from ..models import Model
    from ..moves import Learned

PROFILE = """\
Make a reference that the drive can follow: it meets the levels of the one that is asked for in the
least time, within what the models can do under the limits of the command, and within the bounds
that are given. A step becomes an S-curve.

What the models can do is taken from them in the large: from rest at one limit and back at the
other. Columns: t [s], r, asked.
"""

PROFILE_EXAMPLES = """\
examples:
  sewfast profile drive.json --reference steps.csv -o reference.csv
  sewfast profile drive.json --reference trapezoid --rate 15000 --jerk 2e6 -o reference.csv
"""

PLAN = """\
Find the table of a known move: the reference that the controller must get so that the models
follow the wanted one. It holds for this controller only, and runs wherever that runs:
sewfast run CONTROLLER --table TABLE.json.
"""

PLAN_EXAMPLES = """\
examples:
  sewfast plan controller.json drive.json --reference trapezoid -o table.json
  sewfast plan controller.json drive.json --reference seam.csv -o seam.json --plot seam.png
  sewfast plan controller.json drive.json --reference steps.csv --within-reach -o table.json
  sewfast run controller.json --on virtual --table table.json -o measured.csv
"""

LEARN = """\
Repeat a known move on a machine, and improve its table from repetition to repetition.

Before the machine moves, learning must converge on every model. A repetition that is worse than the
best is undone. The best table so far is written after each repetition; Ctrl-C, `sewfast stop` and a
trip stop the motor and keep it, and --resume goes on from it.
"""

LEARN_EXAMPLES = """\
examples:
  sewfast learn controller.json drive.json --reference trapezoid --on virtual -o table.json
  sewfast learn controller.json drive.json --table seam.json --on /dev/ttyUSB0 -o learned.json \\
      --limits volt=10,speed=3500,acceleration=30000,current=15
  sewfast learn controller.json drive.json --resume --on virtual -o table.json
"""


def add_profile(commands: Commands) -> None:
    parser = add_command(
        commands, "profile", profile_command,
        summary="a reference that the drive can follow", text=PROFILE, examples=PROFILE_EXAMPLES,
    )  # fmt: skip
    parser.add_argument("model", nargs="+", metavar="MODEL.json", help="files that identify wrote")
    parser.add_argument(
        "--reference", required=True, metavar="FILE|NAME", help="what is wanted, steps for example"
    )
    for option, unit, text in (
        ("--u-min", "V", "least command (as recorded)"),
        ("--u-max", "V", "largest command (as recorded)"),
        ("--low", "Y", "least level"),
        ("--high", "Y", "largest level"),
        ("--rate", "Y/s", "largest rate"),
        ("--jerk", "Y/s2", "largest change of the rate"),
        ("--share", "PART", "part of what the models can do that is used (.9)"),
    ):
        parser.add_argument(option, type=float, metavar=unit, help=text)
    _add_force(parser)
    add_output(parser, "OUT", "CSV, .npz, .mat or Parquet; default: CSV to standard output")


def _add_force(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--force", action="store_true", help="even with a model that identify called useless"
    )


def profile_command(args: argparse.Namespace) -> None:
    from ..moves import profile
    from .control import reference_of

    require_place(args.out, TABLES)
    models = useful_models(args.model, force=args.force)
    asked: Any = reference_of(args.reference, models[0].Ts, models[0].output_unit)
    if isinstance(asked, str):
        from .. import signals

        if spelled(models[0].output_unit) != "rpm" or not math.isclose(models[0].Ts, signals.TS):
            raise SettingError(
                name="--reference", expected=f"a file for a model in {models[0].output_unit} at "
                f"{models[0].Ts:g} s",
                received=asked, remedy="names are for models in RPM at 1 ms",
            )  # fmt: skip
        asked = signals.reference(asked)
    names = ("u_min", "u_max", "low", "high", "rate", "jerk", "share")
    given = {name: getattr(args, name) for name in names}
    found = profile(asked, models, **{name: x for name, x in given.items() if x is not None})
    y = models[0].output_unit
    summary = {
        "unit": y, "n": len(found.r), "Ts": found.Ts, "bounds": list(found.bounds),
        "later": found.later, "low": found.reach.low, "high": found.reach.high,
    }  # fmt: skip
    write_columns(
        args.out, found.columns(), {"t": "s", "r": y, "asked": y}, summary,
        str(found).splitlines(), as_json=args.json,
    )  # fmt: skip


FILES_OPTIONS = """\
controller CONTROLLER.json  text  file that tune wrote
model MODEL.json  text...  models of the drive, all of which count
--reference FILE|NAME  text  the move; default: a trapezoid over the recorded range of the model
--within-reach  flag  make it one that the models can follow first, as sewfast profile does
"""


def _add_files(parser: argparse.ArgumentParser) -> None:
    add_options(parser, FILES_OPTIONS)
    _add_force(parser)


def add_plan(commands: Commands) -> None:
    parser = add_command(
        commands, "plan", plan_command,
        summary="the table of a known move", text=PLAN, examples=PLAN_EXAMPLES,
    )  # fmt: skip
    _add_files(parser)
    add_output(parser, "TABLE.json", "table to write", required=True)
    add_plot(parser, "draw reference, expected output, error and command")
    add_overwrite(parser)


def plan_command(args: argparse.Namespace) -> int | None:
    require_plot(args.plot)
    require_place(args.out, (".json",))
    _require_not_learned(args)
    controller, models = _files(args)
    try:
        table = _planned(args, controller, models)
    except Interrupted as stop:
        stop.best.save(args.out)
        print(f"interrupted; kept the best so far in {args.out}", file=sys.stderr)
        return INTERRUPTED
    table.save(args.out)
    if args.plot is not None:
        table.plot(file=args.plot)
    if args.json:
        before, after = table.expected
        print_json({
            "table": str(args.out), "reference": table.name, "unit": table.units["y"],
            "n": len(table.reference), "Ts": table.Ts, "expected": after, "without": before,
            "limited": table.limited, "plot": None if args.plot is None else str(args.plot),
        })  # fmt: skip
        return None
    print(table)
    for place in filter(None, (args.plot, args.out)):
        print(f"written to {place}")
    print(suggested("run", args.controller, "--table", args.out, "--on", "virtual"))
    return None


def _require_not_learned(args: argparse.Namespace) -> None:
    """Refuse to write over a table that was learned: on a drive it cannot be made again."""
    from ..control.files import load_table

    if args.out.exists() and not args.overwrite and load_table(args.out).repetitions:
        raise SettingError(
            name=f"-o {args.out}", expected="no table that was learned", received="one",
            remedy="choose another name, go on with learn --resume, or replace it with --overwrite",
        )  # fmt: skip


def _files(args: argparse.Namespace) -> tuple[SampledController, list[Model]]:
    from ..control.files import load_controller

    return load_controller(args.controller), useful_models(args.model, force=args.force)


def _planned(
    args: argparse.Namespace, controller: SampledController, models: list[Model]
) -> MoveTable:
    from ..moves import plan
    from .control import reference_of

    reference = name = None
    if args.reference is not None:
        reference = reference_of(args.reference, controller.Ts, controller.y_unit)
        name = Path(args.reference).stem
    with Progress("plan", "error", quiet=args.quiet) as progress:
        return plan(
            controller, models, reference, within_reach=args.within_reach, name=name,
            progress=progress,
        )  # fmt: skip


LEARN_OPTIONS = """\
--table TABLE.json  text  begin with this table
--on virtual[:SEED]|FILE.fmu?volt=V|PORT  text!  machine to repeat it on
--repetitions N  int=8  at most so many (8)
--resume  flag  go on from the table that an earlier call left in -o
"""


def add_learn(commands: Commands) -> None:
    parser = add_command(
        commands, "learn", learn_command,
        summary="improve a known move on the machine",
        text=LEARN, options=LEARN_OPTIONS, examples=LEARN_EXAMPLES,
    )  # fmt: skip
    _add_files(parser)
    add_output(parser, "TABLE.json", "table to write after each repetition", required=True)
    add_plot(parser, "draw the best run over the first one")
    add_overwrite(parser)
    add_drive(parser)


def learn_command(args: argparse.Namespace) -> int | None:
    from ..control.files import load_table

    require_plot(args.plot)
    require_place(args.out, (".json",))
    starts = [args.table is not None, args.resume, args.reference is not None]
    if sum(starts) > 1:
        raise SettingError(
            name="--table, --resume, --reference", expected="one of them", received="several",
            remedy="--resume goes on with the table in -o",
        )  # fmt: skip
    if not is_port(args.on):
        require_no_drive_options(args)
    elif not any(starts):
        raise SettingError(
            name="--reference", expected="the move for a drive", received="none",
            remedy="name one: a slip must not move a motor",
        )  # fmt: skip
    controller, models = _files(args)
    start = args.out if args.resume else args.table
    if start is not None and args.within_reach:
        raise SettingError(
            name="--within-reach", expected="--reference beside it", received="a table",
            remedy="its move is planned already",
        )  # fmt: skip
    if not args.resume:
        _require_not_learned(args)
    table = _planned(args, controller, models) if start is None else load_table(start)
    table.require(controller)
    code = None
    try:
        found = _learned(args, table, models)
    except Interrupted as stop:
        found, code = stop.best, INTERRUPTED
        found.table.save(args.out)
        print(f"interrupted; kept the best so far in {args.out}", file=sys.stderr)
    if args.plot is not None and found.best is not None:
        found.plot(file=args.plot)
    if args.json:
        print_json({"table": str(args.out), **found.to_json()})
    else:
        print(f"{found}\nwritten to {args.out}")
    return code


def _learned(args: argparse.Namespace, table: MoveTable, models: list[Model]) -> Learned:
    from ..moves import learn

    with Progress("learn", quiet=args.quiet) as progress:
        options: dict[str, Any] = {
            "repetitions": args.repetitions, "file": args.out, "progress": progress,
        }  # fmt: skip
        if is_port(args.on):
            with opened(args) as drive:
                return learn(table, models, drive, **options)
        return learn(table, models, machine_of(args.on), **options)
