"""`sewfast tune`, `sewfast run`: a controller for a model, and the loop that it closes."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..errors import DataError, Interrupted, SettingError
from .arguments import (
    RECORDINGS,
    TABLES,
    Commands,
    add_command,
    add_output,
    add_overwrite,
    require_place,
)
from .drive import add_drive, is_port, opened, recording_place, say_interrupted
from .host_loop import add_host_loop, at_loops_period, run_host_loop
from .output import print_json, print_rows, write_columns
from .progress import Progress

if TYPE_CHECKING:
    from ..control import Controller, Gains
    from ..dataset import FloatArray
    from ..loop import ClosedLoopRun, Plant
    from ..tuning import TuningResult

FORMS = ("standard", "parallel", "per_sample")

TUNE = """\
Tune a 2-DOF PID on an identified model, by simulating the loop with the encoder, the feedback
filter and the command's limits in it. The model alone is used; no machine is touched.

A reference is a named one (`sewfast signals`) or a CSV with columns t [s], r [output unit].
Named ones are in RPM at 1 ms. Several references are tuned for together.
"""

TUNE_EXAMPLES = """\
examples:
  sewfast tune drive.json -o controller.json
  sewfast tune drive.json --reference trapezoid --reference random -o controller.json
  sewfast tune drive.json --reference cycle.csv --u-min -10 --u-max 10 --filter 4 -o controller.json
"""

RUN = """\
Close the loop around a model, a virtual machine or a drive, with the same controller arithmetic.

Columns: t [s], r, u, y (the plant's true output; of a real drive the speed estimated from its
counts), feedback (y after encoder and filter).

On a drive the controller runs on the device; the run is written as MCAP while it lasts, and
another ending of -o is made from it afterwards. Ctrl-C stops the motor and keeps the file.
"""

RUN_EXAMPLES = """\
examples:
  sewfast run controller.json --on drive.json --reference trapezoid -o predicted.csv
  sewfast run controller.json --on virtual --reference trapezoid -o measured.csv
  sewfast run controller.json --on virtual:7 --reference cycle.csv --json
  sewfast run controller.json --on /dev/ttyUSB0 --reference trapezoid -o measured.mcap \\
      --limits volt=10,speed=3500,acceleration=30000,current=15
  sewfast run controller.json --on /dev/ttyUSB0 --reference cycle.csv -o measured.csv \\
      --limits volt=10,speed=3500,acceleration=30000,current=15 --host-loop 20
"""


def add(commands: Commands) -> None:
    parser = add_command(
        commands, "tune", tune_command,
        summary="a controller for a model", text=TUNE, examples=TUNE_EXAMPLES,
    )  # fmt: skip
    parser.add_argument("model", metavar="MODEL.json", help="model file that identify wrote")
    parser.add_argument(
        "--reference", action="append", metavar="FILE|NAME",
        help="what to track; may repeat (trapezoid, trapezoids, random)",
    )  # fmt: skip
    parser.add_argument("--u-min", type=float, metavar="V", help="least command (-20)")
    parser.add_argument("--u-max", type=float, metavar="V", help="largest command (20)")
    parser.add_argument(
        "--limits-of", metavar="RECORDING.mcap",
        help="take the volt limit that a drive had in a recording, both ways, for those not given",
    )  # fmt: skip
    parser.add_argument(
        "--counts-per-rev", type=float, metavar="N",
        help="encoder in the loop; default: the model's own, else 1572 where the output is a speed",
    )  # fmt: skip
    parser.add_argument(
        "--filter", type=int, default=8, metavar="N",
        help="moving average over N samples of the feedback (8); 1: none",
    )  # fmt: skip
    add_output(parser, "CONTROLLER.json", "controller file to write", required=True)
    parser = add_command(
        commands, "run", run_command,
        summary="a closed loop on a model, a machine or a drive", text=RUN, examples=RUN_EXAMPLES,
    )  # fmt: skip
    parser.add_argument("controller", metavar="CONTROLLER.json", help="file that tune wrote")
    parser.add_argument(
        "--on", required=True, metavar="MODEL.json|virtual[:SEED]|PORT", help="what to run on"
    )
    parser.add_argument("--reference", required=True, metavar="FILE|NAME", help="what to track")
    add_output(
        parser, "OUT",
        "CSV, .npz, .mat or Parquet, of a drive .mcap too; default: CSV to standard output",
    )  # fmt: skip
    add_overwrite(parser)
    add_drive(parser)
    add_host_loop(parser)


def tune_command(args: argparse.Namespace) -> int | None:
    from ..models import load_model
    from ..tuning import tune

    require_place(args.out, (".json",))
    model = load_model(args.model)
    counts = args.counts_per_rev or (model.counts[1] if model.counts else 1572.0)
    u_min, u_max = _command_limits(args)
    references = [
        _reference(text, model.Ts, model.output_unit) for text in args.reference or ()
    ] or None
    try:
        with Progress("tune") as progress:
            found = tune(
                model,
                references,
                u_min=u_min,
                u_max=u_max,
                counts_per_rev=counts,
                filter_samples=args.filter,
                progress=progress,
            )
    except Interrupted as e:
        e.best.save(args.out)
        print(f"interrupted; kept the best so far in {args.out}", file=sys.stderr)
        return 130
    found.controller.save(args.out)
    _show_tuned(args, found)
    return None


def _command_limits(args: argparse.Namespace) -> tuple[float, float]:
    """Least and largest command [V]: as given, else of a recording, else those of +-20 V.

    Raises
    ------
    SettingError, DataError
        For a recording without a volt limit, or one that cannot be read.
    """
    volt = 20.0 if args.limits_of is None else _volt_limit(args.limits_of)
    return (
        -volt if args.u_min is None else args.u_min,
        volt if args.u_max is None else args.u_max,
    )


def _volt_limit(path: str) -> float:
    from ..recordfile.reader import read_header

    limits = read_header(path).settings.get("limits")
    volt = limits.get("volt") if isinstance(limits, dict) else None
    if not isinstance(volt, (int, float)) or isinstance(volt, bool) or volt <= 0.0:
        raise SettingError(
            f"--limits-of {path}: expected a recording of a drive with a volt limit, it states "
            "none; give --u-min and --u-max"
        )
    return float(volt)


def _show_tuned(args: argparse.Namespace, found: TuningResult) -> None:
    if args.json:
        print_json(
            {
                "file": str(args.out),
                "cost": found.cost,
                "start_cost": found.start_cost,
                "cost_unit": found.controller.gains.y_unit,
                "evaluations": found.evaluations,
                "termination": found.termination,
                "gains": {
                    g.form: {**g.to_dict(), "units": g.units} for g in _forms(found.controller)
                },
                "controller": found.controller.to_dict(),
            }
        )
        return
    print(found)
    print("the same gains in every form:")
    print_rows([_gain_row(g) for g in _forms(found.controller)])
    print(f"written to {args.out}; try it: sewfast run {args.out} --on MODEL.json|virtual "
          "--reference NAME")  # fmt: skip


def _forms(controller: Controller) -> list[Gains]:
    return [controller.gains.to(form, Ts=controller.Ts) for form in FORMS]  # type: ignore[arg-type]


def _gain_row(gains: Gains) -> list[str]:
    """Form, then each number with its unit."""
    values = gains.to_dict()
    cells = [f"{name} = {values[name]:.6g} {unit}" for name, unit in gains.units.items()]
    cells += [""] * (4 - len(cells))
    return [f"  {gains.form.replace('_', '-')}", *cells]


def run_command(args: argparse.Namespace) -> int | None:
    from ..control import load_controller
    from ..loop import run

    if args.host_loop is not None:
        controller = at_loops_period(args, load_controller(args.controller))
        return run_host_loop(args, controller, _wanted(args, controller))
    require_place(args.out, RECORDINGS if is_port(args.on) else TABLES)
    controller = load_controller(args.controller)
    name = Path(args.reference).stem
    if not is_port(args.on):
        plant = _plant(args.on)
        reference = _wanted(args, controller)
        _show_run(args, run(controller, plant, reference, name=name), None)
        return None
    place = recording_place(args.out, overwrite=args.overwrite)
    reference = _wanted(args, controller)
    try:
        with opened(args) as drive:
            found = run(
                controller, drive, reference, name=name, file=place, live=args.live,
                overwrite=args.overwrite,
            )  # fmt: skip
    except Interrupted as e:
        return say_interrupted(len(e.best.t), place)
    _show_run(args, found, place)
    return None


def _show_run(args: argparse.Namespace, found: ClosedLoopRun, place: Path | None) -> None:
    """The columns and what they say; `place` already holds those of a drive."""
    summary: dict[str, Any] = {"plant": found.plant, "reference": found.reference}
    summary |= {"unit": found.units["y"], "n": len(found.t), "Ts": found.Ts, **found.metrics()}
    write_columns(
        args.out, found.columns(), found.units, summary, str(found).splitlines(),
        as_json=args.json, written=place,
    )  # fmt: skip


def _plant(text: str) -> Plant:
    """`virtual`, `virtual:SEED`, else a model file."""
    from ..machine import VirtualMachine
    from ..models import load_model

    if text.split(":")[0] == "virtual" and not Path(text).exists():
        return VirtualMachine.from_name(text)
    return load_model(text)


def _wanted(args: argparse.Namespace, controller: Controller) -> str | FloatArray:
    """The reference of a run."""
    return _reference(args.reference, controller.Ts, controller.gains.y_unit)


def _reference(text: str, Ts: float, unit: str) -> str | FloatArray:
    """The name of a reference, or the samples of a file with columns t, r.

    Raises
    ------
    SettingError, DataError
        For a text that is neither, a file without r, one at another sample time or in another unit.
    """
    from ..readers import read
    from ..signals import REFERENCES
    from ..units import REVOLUTIONS_PER_SECOND

    if text.replace("-", "_").lower() in REFERENCES:
        return text
    if not Path(text).exists():
        raise SettingError(
            f"--reference {text}: expected a CSV file with columns t, r, or one of "
            f"{', '.join(REFERENCES)}; received neither"
        )
    data = read(text, inputs="r")
    data.require_inputs()
    if abs(data.Ts - Ts) > 0.01 * Ts:
        raise DataError(
            f"{text}: sampled every {data.Ts:g} s, the loop every {Ts:g} s; resample the reference"
        )
    given = data.input_units[0]
    speeds = {given.lower(), unit.lower()}
    if len(speeds) > 1 and speeds <= REVOLUTIONS_PER_SECOND.keys():
        raise DataError(
            f"{text}: expected r in {unit}, the loop's unit, got {given}; convert the column"
        )
    return data.experiments[0].u[:, 0].copy()
