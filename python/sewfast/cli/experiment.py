"""`sewfast demo`, `sewfast report`: the whole experiment and its page."""

from __future__ import annotations

import argparse
from pathlib import Path

from .arguments import Commands, add_command
from .output import print_json

REPORT = """\
Write DIR/report.html anew from what `sewfast demo` left in DIR; nothing is computed again.
"""


def add(commands: Commands) -> None:
    parser = add_command(
        commands, "report", report_command,
        summary="the page of an experiment", text=REPORT,
        examples="example:\n  sewfast report demo",
    )  # fmt: skip
    parser.add_argument("folder", type=Path, metavar="DIR", help="folder that demo filled")


def report_command(args: argparse.Namespace) -> None:
    from ..report import report

    page = report(args.folder)
    if args.json:
        print_json({"report": str(page)})
    else:
        print(page)
