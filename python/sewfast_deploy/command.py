"""`sewfast deploy`, `pil`: code for a processor, and the firmware on an emulated one."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Iterator
from contextlib import redirect_stdout
from io import StringIO
from pathlib import Path
from typing import Any

from sewfast.cli.arguments import Commands, add_command, add_overwrite
from sewfast.cli.output import note, print_json, suggested
from sewfast.errors import SettingError

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


OPTIONS = """\
file FILE.json  text  model or controller
folder DIR  path  folder for the code
--to  {c99,st,fmi,onnx}=c99  C99, structured text, FMU or ONNX (c99)
--precision  {f32,f64}  precision of the arithmetic (f32; f64 for fmi, onnx)
--changeable  flag  gains and limits of the controller can be changed while it runs (C99 only)
"""


def add(commands: Commands) -> None:
    parser = add_command(
        commands, "deploy", deploy_command,
        summary="a model or controller as C99, PLC code, FMU or ONNX",
        text=DEPLOY, options=OPTIONS, examples=EXAMPLES,
    )  # fmt: skip
    parser.add_argument(
        "--name", dest="prefix", metavar="NAME",
        help="prefix of all names in the code; default: controller or model",
    )  # fmt: skip


def deploy_command(args: argparse.Namespace) -> None:
    from sewfast import storage
    from sewfast.control.controller import Controller
    from sewfast.control.files import load_pid
    from sewfast.dynamic_model import DynamicModel
    from sewfast.errors import ModelFileError
    from sewfast.models import load_model

    from .code import deploy

    found = storage.format_of(args.file)
    if found not in ("", Controller.FORMAT, DynamicModel.FORMAT):
        raise ModelFileError(
            name=args.file, expected="a model or a controller",
            received=f"a file of format {found!r}",
            remedy="`sewfast identify` and `sewfast tune` write those",
        )  # fmt: skip
    what = load_pid(args.file) if found == Controller.FORMAT else load_model(args.file)
    done = deploy(
        what, args.folder, to=args.to, precision=args.precision, name=args.prefix,
        changeable=args.changeable,
    )  # fmt: skip
    if args.json:
        files = [str(done.folder / name) for name in done.files]
        print_json({"folder": str(done.folder), "files": files, "notes": list(done.notes)})
    else:
        print(done)


# --- `sewfast pil`: the firmware on an emulated processor, from doctor to commissioning -----------


PIL = """\
Processor in the loop: compile the example firmware for a Cortex-M4 or M7, start it in the emulator
QEMU, connect to its serial port and use it like a drive: examine it, record a chirp, run a
controller, commission it. The motor is computed on the emulated processor too.

At the end it prints the instructions per control period, the deepest use of the stack and the size
of the code. QEMU counts instructions, not cycles.

It needs a source checkout and, on Debian, make, cargo-web and
  gcc-arm-none-eabi libnewlib-arm-none-eabi qemu-system-arm rustc-web rust-web-src
or a built firmware, and qemu-system-arm alone.
"""

PIL_EXAMPLES = """\
examples:
  sewfast pil                                 in a source checkout; results go to pil/
  sewfast pil --no-commission                 in a quarter of the time
  sewfast pil --clock real --watchdog 500     the board's time is the computer's
  sewfast pil --board mps2-an500              a Cortex-M7
  sewfast pil --firmware target/bare/mps2-an386.elf
"""

LIMITS = "volt=10,speed=8000,acceleration=90000,current=inf"
"""Limits of the computed motor."""


PIL_OPTIONS = """\
--board  {mps2-an386,mps2-an500}  board to build for: a Cortex-M4 or a Cortex-M7 (mps2-an386)
--out DIR  path=pil  folder for the results (pil)
--clock  {credit,real}=credit  the board's time: granted by the host, or the computer's (credit)
--watchdog MS  float  the board stops without a frame from this computer for this time (as for
    `record`)
--seed N  int=0  seed of the commissioning (0)
"""


def add_pil(commands: Commands) -> None:
    parser = add_command(
        commands, "pil", pil_command,
        summary="the firmware on an emulated processor",
        text=PIL, options=PIL_OPTIONS, examples=PIL_EXAMPLES,
    )  # fmt: skip
    place = parser.add_mutually_exclusive_group()
    place.add_argument(
        "--source", type=Path, default=Path(), metavar="DIR",
        help="a source checkout of sewfast (the current folder)",
    )  # fmt: skip
    place.add_argument(
        "--firmware", type=Path, metavar="FILE.elf",
        help="a built firmware for either board",
    )  # fmt: skip
    parser.add_argument(
        "--no-commission", dest="commission", action="store_false", help="leave commissioning out"
    )
    add_overwrite(parser)


def pil_command(args: argparse.Namespace) -> int:
    from sewfast.control import Controller
    from sewfast.gains import Gains

    from .emulated import EmulatedBoard, build_firmware

    _prepare_folder(args.out, args.overwrite, make=False)
    firmware = args.firmware
    if firmware is None:
        note("compiling the firmware")
        firmware = build_firmware(args.source, board=args.board or "mps2-an386")
    elif args.board is not None:
        raise SettingError(
            name="--board", expected="none with --firmware, which states the board", received="one",
            remedy="leave it out",
        )  # fmt: skip
    with EmulatedBoard(firmware, clock=args.clock, boot_id=args.seed + 1) as board:
        _prepare_folder(args.out, args.overwrite, make=True)
        first = Controller(
            Gains.standard(Kp=0.02, Ti=0.1, Td=0.002),
            Ts=0.001, alpha=0.4, N=10, u_min=-10, u_max=10, filter_samples=8,
        )  # fmt: skip
        first.save(args.out / "first.json")
        results: dict[str, Any] = {}
        for name, words in _stages(args, board.port):
            code, results[name] = _carried_out(args, words)
            if code:
                print(f"{name} ended with {code}", file=sys.stderr, flush=True)
                return code
        figures = board.figures()
    if args.json:
        print_json({"stages": results, "figures": vars(figures)})
    else:
        print(figures)
        print(f"written to {args.out}")
    return 0


def _prepare_folder(folder: Path, overwrite: bool, *, make: bool) -> None:
    """Check the folder for the results before compiling; create it when the board runs."""
    try:
        if folder.exists() and not overwrite:
            raise SettingError(
                f"--out {folder}: expected a new folder, got an existing one; name another, or "
                "--overwrite"
            )
        if make:
            folder.mkdir(parents=True, exist_ok=True)
    except (OSError, UnicodeError) as error:
        raise SettingError(
            name=f"--out {folder}",
            expected="a folder that can be made",
            received=getattr(error, "strerror", None) or str(error),
            remedy="name another one",
        ) from error


def _stages(args: argparse.Namespace, port: str) -> Iterator[tuple[str, list[str]]]:
    """The commands of the stages."""
    out = args.out
    drive = ["--limits", LIMITS, "--live", "none"]
    if args.watchdog is not None:
        drive += ["--watchdog", f"{args.watchdog:g}"]
    if args.overwrite:
        drive += ["--overwrite"]
    yield "doctor", ["doctor", port]
    chirp = ["--signal", "chirp_lo_hi", "-o", str(out / "chirp.mcap")]
    yield "record", ["record", "--on", port, *chirp, *drive]
    run = [str(out / "first.json"), "--reference", "trapezoid", "-o", str(out / "first.mcap")]
    yield "run", ["run", *run, "--on", port, *drive]
    if args.commission:
        short = ["--members", "2", "--evaluations", "500", "--seed", str(args.seed)]
        place = ["--out", str(out / "commission")]
        yield "commission", ["commission", "--on", port, *place, *short, *drive]


def _carried_out(args: argparse.Namespace, words: list[str]) -> tuple[int, Any]:
    """Run one stage; return its exit code, and with --json its output."""
    from sewfast.cli import main

    note(f"$ {suggested(*words)}")
    if args.quiet:
        words = [*words, "--quiet"]
    if not args.json:
        return main(words), None
    with redirect_stdout(StringIO()) as printed:
        code = main([*words, "--json"])
    text = printed.getvalue()
    return code, json.loads(text) if text.strip() else None
