"""`sewfast run`: a controller in closed loop with a model, a machine or a drive."""

from __future__ import annotations

import argparse
import re
import sys
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..errors import DataError, Interrupted, SettingError
from ..progress import Progress
from .arguments import (
    RECORDINGS,
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
from .drive import (
    PORT_HELP,
    add_drive,
    is_port,
    machine_of,
    opened,
    recording_place,
    require_no_drive_options,
)
from .output import note, print_json, write_columns

if TYPE_CHECKING:
    from ..control.controller import Controller, SampledController
    from ..control.loop import ClosedLoopRun, Plant
    from ..control.position import PositionController
    from ..control.stops import PositionRun
    from ..dataset import FloatArray
    from ..link import HostLoopRun

RUN = """\
Close the loop around a model, a virtual machine or a drive, with the same controller arithmetic.

Columns: t [s], r, u, y (the plant's true output; of a real drive the speed estimated from its
counts), feedback (y after encoder and filter).

With a controller of positions (sewfast tune --loop position), --stop-at brings a running drive to
an angle, and --positions goes from goal to goal; there are further columns counts, position, place
(of the profile) and goal. Angles count from where the run begins.

On a drive the controller runs on the device; the run is written as MCAP while it runs, and
a file with another ending is made from it afterwards. Ctrl-C stops the motor and keeps the file.
"""

RUN_EXAMPLES = """\
examples:
  sewfast run controller.json drive.json -o predicted.csv
  sewfast run controller.json --on drive.json --reference random -o predicted.csv --plot loop.png
  sewfast run controller.json --on virtual --reference trapezoid -o measured.csv
  sewfast run controller.json --on virtual:7 --reference cycle.csv --json
  sewfast run controller.json --on virtual --table seam.json -o measured.csv
  sewfast run position.json --on virtual --stop-at 90deg --speed 2000 -o stop.csv
  sewfast run position.json --on virtual --positions moves.csv -o measured.csv
  sewfast run position.json --on /dev/ttyUSB0 --stop-at 90deg --speed 2000 -o stop.csv \\
      --limits volt=10,speed=3500,acceleration=60000,current=15
  sewfast run controller.json --on /dev/ttyUSB0 --reference trapezoid -o measured.mcap \\
      --limits volt=10,speed=3500,acceleration=30000,current=15
  sewfast run controller.json --on /dev/ttyUSB0 --reference cycle.csv -o measured.csv \\
      --limits volt=10,speed=3500,acceleration=30000,current=15 --host-loop 20
"""


OPTIONS = """\
controller CONTROLLER.json  text  file that tune wrote
plant MODEL.json|virtual[:SEED]  text?  model or virtual machine to run on; both files in any order
--on MODEL.json|virtual[:SEED]|FILE.fmu?volt=V|PORT  text  plant or drive to run on
--reference FILE|NAME  text  reference to track; default: a trapezoid over the recorded range of the
    model (none for a drive)
--table TABLE.json  text  the table of a known move that plan or learn wrote, in place of a
    reference
"""


def add(commands: Commands) -> None:
    parser = add_command(
        commands, "run", run_command,
        summary="a closed loop on a model, a machine or a drive",
        text=RUN, options=OPTIONS, examples=RUN_EXAMPLES,
    )  # fmt: skip
    _add_positions(parser)
    add_output(
        parser, "OUT",
        "CSV, .npz, .mat or Parquet, for a drive also .mcap; default: CSV to standard output",
    )  # fmt: skip
    add_plot(parser, "draw output, error and command; with --host-loop also its timing")
    add_overwrite(parser)
    add_drive(parser)
    add_host_loop(parser)


def run_command(args: argparse.Namespace) -> int | None:
    from ..commissioning.fmu import is_fmu
    from ..control.files import load_controller, load_pid, load_table
    from ..control.loop import noise_in_loop, run

    _settle_plant(args)
    require_plot(args.plot)
    if args.host_loop is not None:
        pid = at_loops_period(args, load_pid(args.controller))
        return run_host_loop(args, pid, _wanted(args, pid))
    require_place(args.out, RECORDINGS if is_port(args.on) else TABLES)
    controller = load_controller(args.controller)
    if args.stop_at is not None or args.positions is not None:
        _run_positions(args, controller)
        return None
    name = None if args.reference is None else Path(args.reference).stem
    table = None if args.table is None else load_table(args.table)
    if not is_port(args.on):
        require_no_drive_options(args)
        if is_fmu(args.on):
            machine = machine_of(args.on)
            found = run(controller, machine, _wanted(args, controller), table=table, name=name)
            _show_run(args, found, None)
            return None
        plant = plant_of(args.on)
        reference = _wanted(args, controller)
        found = run(controller, plant, reference, table=table, name=name)
        calm = None
        if noise_in_loop(controller, plant) > 0.0:
            # noise is no oscillation, so that a run without it is judged
            calm = run(controller, plant, reference, table=table, noise=0.0, name=name)
        _show_run(args, found, None, plant, calm)
        return None
    place = recording_place(args.out, overwrite=args.overwrite)
    reference = _wanted(args, controller)
    with opened(args) as drive:
        found = run(
            controller, drive, reference, table=table, name=name, file=place, live=args.live,
            overwrite=args.overwrite,
        )  # fmt: skip
    _show_run(args, found, place)
    return None


POSITIONS_OPTIONS = """\
--stop-at ANGLE  text  run at a speed, then stop at this angle of the turn: 90deg, 1.57rad,
    .25turns, 393counts; the loop then holds it
--positions FILE  text  goals to go to, a CSV with columns t [s], r [deg, rad, turns or counts]
--speed Y  float  speed from which it stops (half of the largest known one); or give --reference
--way  {onward,shortest}=onward  to the angle that is reached first without turning back, or the
    shorter way (onward)
--zero COUNTS  float=0.0  the encoder's count at the angle 0, from where the run begins (0)
--after S  float=1.0  time from the stop on (1 s)
--share PART  float  part of what the models can do that a move uses (the controller's own); less of
    it leaves room for a load that came later
--release  flag  take the command away once the shaft has come to rest, in place of holding it
"""


def _add_positions(parser: argparse.ArgumentParser) -> None:
    group = parser.add_argument_group(
        "positions", "With a controller of positions, on a model, a machine or a drive."
    )
    add_options(group, POSITIONS_OPTIONS)


def _run_positions(args: argparse.Namespace, controller: SampledController) -> None:
    from ..commissioning.fmu import is_fmu
    from ..control.position import require_position

    position = require_position(controller, "run --stop-at")
    if args.share is not None:
        position = replace(position, share=args.share)
    if is_port(args.on):
        place = recording_place(args.out, overwrite=args.overwrite)
        kept = {"file": place, "live": args.live, "overwrite": args.overwrite}
        with opened(args) as drive:
            _show_positions(args, _positions_run(args, position, drive, **kept), place)
        return
    require_no_drive_options(args)
    on: Any = machine_of(args.on) if is_fmu(args.on) else plant_of(args.on)
    _show_positions(args, _positions_run(args, position, on), None)


def _positions_run(
    args: argparse.Namespace, position: PositionController, on: Any, **kept: Any
) -> PositionRun:
    """The stop or the moves that are asked for."""
    from ..control.stops import follow_positions, stop_at

    if args.stop_at is not None:
        reference = _wanted(args, position.speed)
        if isinstance(reference, str):
            raise SettingError(
                name="--reference", expected="a file of speeds before the stop",
                received=reference, remedy="or give --speed",
            )  # fmt: skip
        return stop_at(
            position, on, args.stop_at, speed=args.speed, reference=reference, way=args.way,
            zero=args.zero, after=args.after, release=args.release, **kept,
        )  # fmt: skip
    if beside := _of_stops(args):
        raise SettingError(
            name=beside[0], expected="--stop-at", received="--positions",
            remedy="leave it out: goals are counted from where the run begins",
        )  # fmt: skip
    goals, unit = _goals(args.positions, position.Ts)
    name = Path(args.positions).stem
    return follow_positions(position, on, goals, unit=unit, release=args.release, name=name, **kept)


def _show_positions(args: argparse.Namespace, found: PositionRun, place: Path | None) -> None:
    """Write the columns, beside a drive's recording in `place`, and print a summary."""
    summary: dict[str, Any] = {"plant": found.plant, "asked": found.name, "unit": found.unit}
    summary |= {"n": len(found.t), "Ts": found.Ts, **found.metrics()}
    summary["warnings"] = warnings = found.warnings
    for text in warnings:
        note(f"warning: {text}")
    lines = str(found).splitlines()
    if args.plot is not None:
        found.plot(file=args.plot)
        summary["plot"] = str(args.plot)
        lines.append(f"written to {args.plot}")
    write_columns(
        args.out, found.columns(), found.units, summary, lines, as_json=args.json, written=place
    )


def _of_stops(args: argparse.Namespace) -> list[str]:
    """The options that were given and that only a stop has."""
    given = {
        "--speed": args.speed is not None, "--way": args.way != "onward",
        "--zero": args.zero != 0.0, "--after": args.after != 1.0,
    }  # fmt: skip
    return [name for name, is_given in given.items() if is_given]


def _goals(path: str, Ts: float) -> tuple[FloatArray, str]:
    """Goals of a file with columns t, r, and their unit."""
    goals, unit = _samples(path, Ts)
    if not unit:
        raise DataError(
            name=path, expected="a unit of r: deg, rad, turns or counts", received="none",
            remedy="name the column 'r [deg]'",
        )  # fmt: skip
    return goals, unit


def _samples(path: str, Ts: float) -> tuple[FloatArray, str]:
    """The column r of a file with columns t, r at the loop's sample time, and its unit."""
    from ..readers import read_columns

    data = read_columns(path, inputs="r")
    data.require_inputs()
    if abs(data.Ts - Ts) > 0.01 * Ts:
        raise DataError(
            name=path, expected=f"the loop's sample time of {Ts:g} s", received=f"{data.Ts:g} s",
            remedy="resample the column r",
        )  # fmt: skip
    return data.experiments[0].u[:, 0].copy(), data.input_units[0]


def _settle_plant(args: argparse.Namespace) -> None:
    """Put the plant into `args.on` and the controller into `args.controller`.
    Raises `SettingError` for no plant or two, and for a drive without a reference or without --on:
    a slip must not move a motor.
    """
    from .. import storage
    from ..control.controller import Controller
    from ..dynamic_model import DynamicModel

    if (args.on is None) == (args.plant is None):
        received = "neither" if args.on is None else "both"
        raise SettingError(
            f"expected one plant, {args.controller} MODEL.json or --on PORT, received {received}"
        )
    if args.plant is not None:
        formats = tuple(storage.format_of(path) for path in (args.controller, args.plant))
        if formats == (DynamicModel.FORMAT, Controller.FORMAT):
            args.controller, args.plant = args.plant, args.controller
        if is_port(args.plant):
            raise SettingError(
                f"{args.plant}: expected a model or a virtual machine with the controller; a "
                f"drive is given by --on {args.plant}"
            )
        args.on = args.plant
    if args.table is not None and (args.reference is not None or args.host_loop is not None):
        raise SettingError(
            name="--table", expected="neither --reference nor --host-loop beside it",
            received="one of them",
            remedy="leave it out; a loop on this computer has no table, run it on the device",
        )  # fmt: skip
    moves = [name for name in ("stop_at", "positions") if getattr(args, name) is not None]
    beside = (args.table, args.host_loop, args.reference if "positions" in moves else None)
    if len(moves) > 1 or (moves and any(x is not None for x in beside)):
        raise SettingError(
            name="--" + moves[0].replace("_", "-"),
            expected="one of --stop-at, --positions, --table, --reference, --host-loop",
            received="two", remedy="leave one of them out",
        )  # fmt: skip
    alone = _of_stops(args)
    alone += ["--share"] * (args.share is not None) + ["--release"] * args.release
    if alone and not moves:
        raise SettingError(
            name=", ".join(alone), expected="--stop-at or --positions beside it",
            received="neither", remedy="leave it out for a run along a speed",
        )  # fmt: skip
    needed = (is_port(args.on) and not moves) or args.host_loop is not None
    if args.reference is None and args.table is None and needed:
        raise SettingError("--reference: expected a reference to track, received nothing")


def _show_run(
    args: argparse.Namespace, found: ClosedLoopRun, place: Path | None,
    plant: Plant | None = None, calm: ClosedLoopRun | None = None,
) -> None:  # fmt: skip
    """Write the columns, unless `place` already has those of a drive, and print a summary."""
    from ..models import Model
    from ..trust import judge

    # a model knows the region that it was trained in
    warnings = judge(calm or found, plant if isinstance(plant, Model) else None).warnings
    summary: dict[str, Any] = {"plant": found.plant, "reference": found.reference}
    summary |= {"unit": found.units["y"], "n": len(found.t), "Ts": found.Ts, **found.metrics()}
    summary["warnings"] = [line.to_json() for line in warnings]
    lines = [f"  warning   {x.name}, {x.shown}: {x.meaning}" for x in warnings]
    if args.plot is not None:
        found.plot(file=args.plot)
        summary["plot"] = str(args.plot)
        lines.append(f"written to {args.plot}")
    write_columns(
        args.out, found.columns(), found.units, summary, [*str(found).splitlines(), *lines],
        as_json=args.json, written=place,
    )  # fmt: skip


def plant_of(text: str) -> Plant:
    """The plant named by a text: `virtual[:SEED][?NAME=VALUE]`, a motor's file, or a model's."""
    from .. import storage
    from ..greybox.motor import Motor, load_motor
    from ..machine import VirtualMachine
    from ..models import load_model

    if re.match(r"virtual(?![\w.])", text) and not Path(text).exists():
        return VirtualMachine.from_name(text)
    if storage.format_of(text) == Motor.FORMAT:
        return load_motor(text).machine()
    return load_model(text)


def _wanted(args: argparse.Namespace, controller: SampledController) -> Any:
    """The reference of a run; None for the plant's default."""
    if args.reference is None:
        return None
    return reference_of(args.reference, controller.Ts, controller.y_unit)


def reference_of(text: str, Ts: float, unit: str) -> str | FloatArray:
    """The name of a reference, or the samples of a file with columns t, r."""
    from ..signals import REFERENCES
    from ..units import spelled

    if text.replace("-", "_").lower() in REFERENCES:
        return text
    if not Path(text).exists():
        raise SettingError(
            f"--reference {text}: expected a CSV file with columns t, r, or one of "
            f"{', '.join(REFERENCES)}; received neither"
        )
    samples, given = _samples(text, Ts)
    if given and unit and spelled(given) != spelled(unit):
        raise DataError(
            f"{text}: expected r in {unit}, the loop's unit, got {given}; convert the column"
        )
    return samples


# --- `sewfast run --host-loop`: the controller on this computer, for slow plants ------------------


def add_host_loop(parser: argparse.ArgumentParser) -> None:
    """Options of a controller that runs on this computer."""
    group = parser.add_argument_group(
        "on a drive, with the controller on this computer",
        "For slow plants: this computer's jitter and the link's delay are in the loop. Both are\n"
        "measured and shown; they are not limited. Columns: t [s], r, u, y (speed over a period),\n"
        "feedback, late [s], age [s] (of the newest sample).",
    )
    group.add_argument(
        "--host-loop", nargs="?", const=0.0, type=float, metavar="MS",
        help="compute each command here, every MS ms (the controller's own sample time)",
    )  # fmt: skip
    group.add_argument(
        "--samples", type=Path, metavar="FILE", help="write the drive's samples at its own period"
    )
    group.add_argument(
        "--real-time", action="store_true",
        help="try real-time scheduling and locked memory; a refusal is reported",
    )  # fmt: skip


def at_loops_period(args: argparse.Namespace, controller: Controller) -> Controller:
    """The controller at the requested sample time; other arguments are checked too."""
    from ..link import at_period
    from ..recordfile.writer import require_free

    if not is_port(args.on):
        raise SettingError(
            f"--host-loop: expected --on PORT ({PORT_HELP}), got {args.on!r}; leave "
            "--host-loop out to simulate"
        )
    require_place(args.out, TABLES)
    require_place(args.samples, RECORDINGS)
    require_free([args.out, args.samples, args.plot], overwrite=args.overwrite)
    if not args.host_loop:
        return controller
    if not 0.0 < args.host_loop <= 10_000.0:
        raise SettingError(f"--host-loop: expected up to 10000 ms, got {args.host_loop:g}")
    return at_period(controller, args.host_loop * 1e-3)


def run_host_loop(
    args: argparse.Namespace, controller: Controller, reference: str | FloatArray
) -> int | None:
    """Run the loop and write its files: 0, 2 if it did not complete, 130 if interrupted."""
    from ..link import run_on_host

    code = None
    with opened(args) as drive:
        try:
            with Progress("run", quiet=args.quiet) as progress:
                found = run_on_host(
                    drive,
                    controller,
                    reference,
                    name=Path(args.reference).stem,
                    real_time=args.real_time,
                    progress=lambda done, total, _: progress.count(done, total),
                )
        except Interrupted as e:
            found, code = e.best, 130
        _show(args, found)
    if found.outcome != "completed":
        print(f"sewfast run: {found.message}", file=sys.stderr)
        code = code or 2
    return code


def _show(args: argparse.Namespace, found: HostLoopRun) -> None:
    summary: dict[str, Any] = {
        "plant": found.plant, "reference": found.reference, "unit": found.units["y"],
        "n": len(found.t), "Ts": found.Ts, "outcome": found.outcome, "message": found.message,
        "stop_confirmed": found.stop_confirmed,
        "samples": len(found.samples["t"]), "taken": found.taken, "gaps": found.gaps,
        **found.metrics(), "jitter": found.jitter.to_dict(),
    }  # fmt: skip
    lines = str(found).splitlines()
    if args.samples is not None:
        found.save_samples(args.samples, overwrite=args.overwrite)
        lines.append(f"samples written to {args.samples}")
    if args.plot is not None:
        found.plot(file=args.plot)
        summary["plot"] = str(args.plot)
        lines.append(f"written to {args.plot}")
    if args.out is None and args.samples is not None:
        print_json(summary) if args.json else print("\n".join(lines))
        return
    write_columns(args.out, found.columns(), found.units, summary, lines, as_json=args.json)
