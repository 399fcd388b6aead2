"""`sewfast analyse`: what a controller does on models, and what it would do on slightly others."""

from __future__ import annotations

import argparse
from pathlib import Path

from .arguments import Commands, add_command, add_plot, require_plot
from .control import plant_of, reference_of
from .output import print_json

ANALYSE = """\
A controller on models (every member of an ensemble) or on the virtual machine: margins over the
operating range, steps of the reference and of a disturbance, what gains that are a little off and
plants that are not as identified would cost, and what speaks against the simulated loops.
"""

EXAMPLES = """\
examples:
  sewfast analyse controller.json drive.json
  sewfast analyse controller.json drive.json --plot loop.png      steps and Bode in one picture
  sewfast analyse controller.json drive.json --out analysis       figures and analysis.json
  sewfast analyse controller.json one.json two.json virtual --json
  sewfast analyse controller.json drive.json --speed 300 --speed 1500 --reference cycle.csv
"""


def add(commands: Commands) -> None:
    parser = add_command(
        commands, "analyse", analyse_command,
        summary="margins, steps, sensitivities of a controller", text=ANALYSE, examples=EXAMPLES,
    )  # fmt: skip
    parser.add_argument("controller", metavar="CONTROLLER.json", help="file that tune wrote")
    parser.add_argument(
        "plants", metavar="MODEL.json|virtual[:SEED]", nargs="+", help="what to analyse it on"
    )
    parser.add_argument(
        "--speed", action="append", type=float, metavar="Y",
        help="output about which the plants are linearised; may repeat (three over the training "
        "data)",
    )  # fmt: skip
    parser.add_argument("--step", type=float, metavar="Y", help="size of the reference step")
    parser.add_argument(
        "--disturbance", type=float, metavar="U", help="size of the step at the plant's input"
    )
    parser.add_argument(
        "--seconds", type=float, metavar="S", help="how long the steps are looked at"
    )
    parser.add_argument(
        "--reference", action="append", metavar="FILE|NAME",
        help="what the cost is taken over; may repeat (trapezoid, random)",
    )  # fmt: skip
    add_plot(parser, "draw steps, loop transfer and sensitivities")
    parser.add_argument(
        "--out", metavar="DIR", type=Path, help="folder for analysis.json and the figures"
    )


def analyse_command(args: argparse.Namespace) -> None:
    from ..analysis import analyse
    from ..control.controller import load_controller

    require_plot(args.plot)
    controller = load_controller(args.controller)
    references = [
        reference_of(text, controller.Ts, controller.gains.y_unit) for text in args.reference or ()
    ]
    found = analyse(
        controller,
        [plant_of(text) for text in args.plants],
        speeds=args.speed,
        step=args.step,
        disturbance=args.disturbance,
        seconds=args.seconds,
        references=references or None,
    )
    written = found.save(args.out) if args.out is not None else []
    if args.plot is not None:
        found.plot(file=args.plot)
        written.append(args.plot)
    if args.json:
        print_json({**found.to_json(), **({"files": list(map(str, written))} if written else {})})
        return
    print(found)
    for path in written:
        print(f"written to {path}")
