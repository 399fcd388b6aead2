"""`sewfast compare`: several models on one recording."""

from __future__ import annotations

import argparse
from pathlib import Path

from ..errors import SettingError
from .arguments import (
    Commands,
    add_columns,
    add_command,
    add_plot,
    add_split,
    add_weights,
    require_plot,
)
from .data import read_for_model
from .models import whole
from .output import print_result
from .preparation import add_preparation, masked, prepared

COMPARE = """\
Score several models on the same recording, best one that none of them was trained on: free run
(the headline), one step ahead, number of parameters. Columns are those of the first model.
"""

EXAMPLES = """\
examples:
  sewfast compare network.json linear.json other.csv
  sewfast compare network.json linear.json other.csv --plot both.png
  sewfast compare drive.json drive-alternative-*.json run.csv --range 5000:8334 --json
"""


def add(commands: Commands) -> None:
    parser = add_command(
        commands, "compare", compare_command,
        summary="several models on a recording", text=COMPARE, examples=EXAMPLES,
    )  # fmt: skip
    parser.add_argument(
        "models", nargs="+", metavar="MODEL.json", help="model file that identify wrote"
    )
    parser.add_argument("data", metavar="DATA", help="recording: FILE or FILE:IN:OUT")
    parser.add_argument(
        "--init", type=whole, default=20, metavar="N",
        help="first samples, which set the initial state and are not scored (20); 0: from rest",
    )  # fmt: skip
    parser.add_argument(
        "--range", metavar="A:B", help="samples to score, 0-based, end excluded; default: all"
    )
    add_plot(parser, "draw measured output, free runs and errors")
    add_columns(parser, from_model=True)
    add_weights(parser)
    add_split(parser)
    add_preparation(parser)


def compare_command(args: argparse.Namespace) -> None:
    from ..comparison import compare
    from ..models import load_model

    require_plot(args.plot)
    names = [Path(path).stem for path in args.models]
    if len(set(names)) < len(names):
        names = list(args.models)
    if len(set(names)) < len(names):
        raise SettingError("expected different models, received one of them twice")
    models = {name: load_model(path) for name, path in zip(names, args.models, strict=True)}
    data, _ = read_for_model(args.data, models[names[0]], args)
    data = masked(data, args)
    part = prepared(data if args.range is None else data.slice(args.range), args, cut=True)
    found = compare(models, data=part, init=args.init)
    if args.plot is not None:
        found.plot(file=args.plot)
    print_result(found, args, plot=args.plot)
