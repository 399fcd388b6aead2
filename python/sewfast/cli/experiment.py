"""`sewfast demo`, `sewfast report`: the whole experiment and its page."""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from .arguments import Commands, add_command, add_overwrite
from .output import print_json, print_rows
from .progress import Progress

DEMO = """\
Carry out the paper's experiment on the virtual sewing machine: excite, record, identify, validate,
tune, run, report. Takes about a minute.

DIR/report.html is the page to look at; DIR/results.json holds its numbers. Recordings, models and
the controller lie beside them, ready for the other commands.
"""

REPORT = """\
Write DIR/report.html anew from what `sewfast demo` left in DIR; nothing is computed again.
"""


def add(commands: Commands) -> None:
    parser = add_command(
        commands, "demo", demo_command,
        summary="the whole experiment, with a report", text=DEMO,
        examples="examples:\n  sewfast demo\n  sewfast demo --out second --seed 1",
    )  # fmt: skip
    parser.add_argument(
        "--out", type=Path, default=Path("demo"), metavar="DIR", help="folder to fill (demo)"
    )
    parser.add_argument(
        "--seed", type=int, default=0, metavar="N",
        help="seed of the random signals and of every search (0)",
    )  # fmt: skip
    add_overwrite(parser)
    parser = add_command(
        commands, "report", report_command,
        summary="the page of an experiment", text=REPORT,
        examples="example:\n  sewfast report demo",
    )  # fmt: skip
    parser.add_argument("folder", type=Path, metavar="DIR", help="folder that demo filled")


def demo_command(args: argparse.Namespace) -> None:
    from ..experiment import run_demo

    with Progress("demo") as progress:
        results = run_demo(
            args.out, args.seed, overwrite=args.overwrite,
            progress=lambda done, total, stage: progress.say(stage),
        )  # fmt: skip
    page = args.out / "report.html"
    if args.json:
        print_json({"report": str(page), "results": results})
    else:
        _summarise(results)
        print(f"{results['seconds']:.0f} s; look at {page}")


def _summarise(results: Mapping[str, Any]) -> None:
    """The headline: free-run errors on records never trained on, and the trapezoid."""
    head = ["free-run error [RPM rms]", "paper", "neural_oe", "oe_all", "oe", "arx"]
    found = results["identification"]
    rows = [
        [r, *(f"{found[m][r]['simulation']['rmse_rpm']:.1f}" for m in head[1:])]
        for r in ("chirp_hi_lo", "random", "saturating")
    ]
    print_rows([head, *rows])
    trapezoid = results["control"]["trapezoid"]
    rise, overshoot = (trapezoid["machine"][key] for key in ("rise_time_ms", "overshoot_percent"))
    print(f"trapezoid on the machine: rise {rise:.0f} ms, overshoot {overshoot:.1f} %")


def report_command(args: argparse.Namespace) -> None:
    from ..report import report

    page = report(args.folder)
    if args.json:
        print_json({"report": str(page)})
    else:
        print(page)
