"""`sewfast demo`: the paper's experiment and its page."""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from typing import Any

from sewfast.cli.arguments import Commands, add_command, add_overwrite
from sewfast.cli.output import print_json, print_rows
from sewfast.progress import Progress

TEXT = """\
Carry out the paper's experiment on the virtual sewing machine: excite, record, identify, validate,
tune, run, report. Takes about a minute.

DIR/report.html is the page to look at; DIR/results.json has its numbers. Recordings, models and the
controller are written as well, ready for the other commands.
"""


OPTIONS = """\
--out DIR  path=demo  folder to fill (demo)
--seed N  int=0  seed of the random signals and of every search (0)
"""


def add(commands: Commands) -> None:
    parser = add_command(
        commands, "demo", command,
        summary="the whole experiment, with a report", text=TEXT, options=OPTIONS,
        examples="examples:\n  sewfast demo\n  sewfast demo --out second --seed 1",
    )  # fmt: skip
    add_overwrite(parser)


def command(args: argparse.Namespace) -> None:
    from . import run_demo

    with Progress("demo", quiet=args.quiet) as progress:
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
    """Print free-run errors on records not used for training, and the trapezoid."""
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
