"""`sewfast deploy`: a model or a controller as code for a processor or another tool."""

from __future__ import annotations

import argparse
from pathlib import Path

from .arguments import Commands, add_command
from .output import print_json

DEPLOY = """\
Write a model or a controller as code: C99 without heap, C library or global state; IEC 61131-3
structured text; a co-simulation FMU (FMI 3.0); a model also as ONNX. C comes with a test that
compares its results with those of sewfast bit by bit, and with files for CMake, PlatformIO and
Zephyr.
"""

EXAMPLES = """\
examples:
  sewfast deploy controller.json firmware             controller.c, controller.h and their test
  sewfast deploy controller.json firmware --changeable  with set_gains, set_limits
  sewfast deploy drive.json firmware --name plant     the model: plant.c, plant.h
  sewfast deploy controller.json simulation --precision f64
  sewfast deploy controller.json plc --to st          a function block for a PLC
  sewfast deploy drive.json fmu --to fmi              for Simulink, Modelica tools, FMPy
  sewfast deploy drive.json graphs --to onnx          one step, and a batch of free runs

try it:  cc -std=c99 firmware/controller.c firmware/controller_test.c && ./a.out
"""


def add(commands: Commands) -> None:
    parser = add_command(
        commands, "deploy", deploy_command,
        summary="a model or controller as C99, PLC code, FMU or ONNX",
        text=DEPLOY, examples=EXAMPLES,
    )  # fmt: skip
    parser.add_argument("file", metavar="FILE.json", help="model or controller")
    parser.add_argument("folder", metavar="DIR", type=Path, help="folder for the code")
    parser.add_argument(
        "--to",
        choices=("c99", "st", "fmi", "onnx"),
        default="c99",
        help="C99, structured text, FMU or ONNX (c99)",
    )
    parser.add_argument(
        "--precision",
        choices=("f32", "f64"),
        help="precision of the arithmetic (f32; f64 for fmi, onnx)",
    )
    parser.add_argument(
        "--name", dest="prefix", metavar="NAME",
        help="prefix of all names in the code; default: controller or model",
    )  # fmt: skip
    parser.add_argument(
        "--changeable", action="store_true",
        help="gains and limits of the controller can be changed while it runs (C99 only)",
    )  # fmt: skip


def deploy_command(args: argparse.Namespace) -> None:
    from .. import storage
    from ..control.controller import FORMAT as CONTROLLER
    from ..control.files import load_pid
    from ..deployment import deploy
    from ..dynamic_model import FORMAT as MODEL
    from ..errors import ModelFileError
    from ..models import load_model

    found = storage.format_of(args.file)
    if found not in ("", CONTROLLER, MODEL):
        raise ModelFileError(
            name=args.file, expected="a model or a controller",
            received=f"a file of format {found!r}",
            remedy="`sewfast identify` and `sewfast tune` write those",
        )  # fmt: skip
    what = load_pid(args.file) if found == CONTROLLER else load_model(args.file)
    done = deploy(
        what, args.folder, to=args.to, precision=args.precision, name=args.prefix,
        changeable=args.changeable,
    )  # fmt: skip
    if args.json:
        files = [str(done.folder / name) for name in done.files]
        print_json({"folder": str(done.folder), "files": files, "notes": list(done.notes)})
    else:
        print(done)
