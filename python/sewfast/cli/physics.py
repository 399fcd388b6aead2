"""`sewfast physics`: friction, inertia and electrical constants of a motor from a record."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, get_args

from ..errors import SettingError
from .arguments import (
    Commands,
    add_columns,
    add_command,
    add_output,
    add_plot,
    require_place,
    require_plot,
)
from .output import print_json

if TYPE_CHECKING:
    from ..dataset import Dataset

PHYSICS = """\
The constants of a motor: command per speed, per acceleration and against friction, lags, loads over
a turn, each with a 95 % interval. With a measured current also the resistance, and with the volts
on the winding R, Ke, J and friction in SI units. Constants that the record does not determine are
not printed as numbers but named, with the measurement that would determine them.
"""

EXAMPLES = """\
examples:
  sewfast physics steps.csv --input u --counts counts --counts-per-rev 1572 -o motor.json
  sewfast physics log.csv --input volts --output speed --speed-unit rad/s
  sewfast physics log.csv --input volts --output rpm --speed-unit rpm --current amps --volts 1
  sewfast physics log.csv --input u --output rpm --speed-unit rpm --export wpilib gains.json
  sewfast record --on motor.json --signal chirp -o rehearsal.csv     the twin as a machine
"""


def add(commands: Commands) -> None:
    parser = add_command(
        commands, "physics", command,
        summary="inertia, friction and electrical constants of a motor", text=PHYSICS,
        examples=EXAMPLES,
    )  # fmt: skip
    parser.add_argument("data", metavar="DATA", nargs="+", help="recordings of the same motor")
    parser.add_argument("--current", metavar="COL", help="column of the motor current [A]")
    parser.add_argument(
        "--volts", type=float, metavar="N", help="volts on the winding per unit of command"
    )
    parser.add_argument(
        "--structure", default="dcmotor", metavar="LIST",
        help="dcmotor (the usual terms that the record shows), or terms: lag,delay,coulomb,"
        "offset,drop,stribeck,load_1,load_2,inertia_2,cogging,torque_ripple,limit; dcmotor,sag "
        "adds one of stribeck_difference,sag,eccentricity",
    )  # fmt: skip
    parser.add_argument(
        "--intervals", choices=("curvature", "profile"), default="curvature",
        help="95 %% intervals by the curvature of the cost, or as profile likelihood (seconds)",
    )  # fmt: skip
    parser.add_argument(
        "--speed-unit", metavar="UNIT", help="unit of the output: rpm, rad/s, rev/s, deg/s"
    )
    parser.add_argument(
        "--export", nargs=2, metavar=("TARGET", "FILE"),
        help="write settings for wpilib, mujoco, urdf, odrive, moteus or simplefoc",
    )  # fmt: skip
    parser.add_argument(
        "--winding", choices=("line", "q"),
        help="for --export: volts and amperes are between two terminals (line), or amplitudes "
        "along the q axis, as logged by boards (q)",
    )  # fmt: skip
    parser.add_argument(
        "--gear", type=float, default=1.0, metavar="N",
        help="for --export wpilib, mujoco, urdf: turns of the motor per turn of the joint",
    )  # fmt: skip
    parser.add_argument(
        "--model", metavar="FILE.json", type=Path,
        help="write the turning motor as a linear model for tuning",
    )  # fmt: skip
    add_output(parser, "FILE.json", "write the motor")
    add_plot(parser, "draw the free run and the command over the speed")
    add_columns(parser, from_model=False)


def command(args: argparse.Namespace) -> None:
    from ..greybox import physics
    from ..greybox.exports import BOARDS, Target

    require_place(args.out, (".json",))
    require_place(args.model, (".json",), option="--model")
    require_plot(args.plot)
    target, place = args.export or (None, "")
    if target not in (None, *get_args(Target)):
        names = ", ".join(get_args(Target))
        raise SettingError(f"--export: expected one of {names}, received {target!r}")
    if target in BOARDS and args.winding is None:
        raise SettingError(
            name="--winding", expected=f"line or q with --export {target}", received="nothing",
            remedy="line: volts and amperes between two terminals; q: amplitudes along the q axis",
        )  # fmt: skip
    structure = args.structure
    motor = physics(
        _data(args),
        structure=structure.split(","),
        current=args.current,
        volts=args.volts,
        speed_unit=args.speed_unit,
        intervals=args.intervals,
    )
    text = "" if target is None else motor.export(target, winding=args.winding, gear=args.gear)
    if args.out is not None:
        motor.save(args.out)
    if text:
        from .. import storage

        storage.replace(place, text)
    if args.model is not None:
        motor.to_model().save(args.model)
    if args.plot is not None:
        motor.plot(file=args.plot)
    if args.json:
        print_json(motor.to_dict())
        return
    print(motor)
    for path in (args.out, place, args.model, args.plot):
        if path:
            print(f"written to {path}")


def _data(args: argparse.Namespace) -> Dataset:
    """The records, with differences of counts as speed: smoothing hides the effect of friction."""
    from ..commissioning import unsmoothed
    from ..dataset import Dataset
    from .data import read_training

    sources, found = args.data, []
    for source in sources:
        args.data = [source]
        data = read_training(args, channels=() if args.current is None else (args.current,))
        whole = data.counts is not None and len(data.experiments) == 1
        found.append(unsmoothed(source, data) if whole else data)
    args.data = sources
    return Dataset.concat(found)
