"""`sewfast check`: whether a model can be trusted on a recording."""

from __future__ import annotations

import argparse
from pathlib import Path

from .arguments import Commands, add_columns, add_command, add_split, add_weights, require_plot
from .data import read_for_model
from .models import whole
from .output import print_json
from .preparation import add_preparation, masked, prepared

CHECK = """\
The report card of a model on a recording, best one that it was not trained on: errors in free run
and some steps ahead, residual tests, bands with their measured coverage, samples outside the
training region, poles and gains over the operating range. One verdict and one sentence per line.
"""

EXAMPLES = """\
examples:
  sewfast check drive.json other.csv
  sewfast check drive.json run.csv --range 5000:8334          the part not trained on
  sewfast check drive.json other.csv --training run.csv       criteria, growth of the error
  sewfast check drive.json other.csv --plot band.png          free run in its band
  sewfast check drive.json other.csv --plot figures           a folder: one PNG per question
  sewfast check drive.json other.csv --json
"""


def add(commands: Commands) -> None:
    parser = add_command(
        commands, "check", check_command,
        summary="whether a model can be trusted", text=CHECK, examples=EXAMPLES,
    )  # fmt: skip
    parser.add_argument("model", metavar="MODEL.json", help="model file that identify wrote")
    parser.add_argument("data", metavar="DATA", help="recording: FILE or FILE:IN:OUT")
    parser.add_argument(
        "--init", type=whole, default=20, metavar="N",
        help="first samples, which set the initial state and are not judged (20); 0: from rest",
    )  # fmt: skip
    parser.add_argument(
        "--range", metavar="A:B", help="samples to judge, 0-based, end excluded; default: all"
    )
    parser.add_argument(
        "--training", metavar="DATA", help="recording that the model was identified from"
    )
    parser.add_argument(
        "--training-range", metavar="A:B", help="samples of it that it was identified from"
    )
    parser.add_argument(
        "--plot", metavar="FILE", type=Path,
        help="draw measured output, free run and its band: PNG, SVG or PDF; a folder takes a PNG "
        "per question",
    )  # fmt: skip
    add_columns(parser, from_model=True)
    add_weights(parser)
    add_split(parser)
    add_preparation(parser)


def check_command(args: argparse.Namespace) -> None:
    from ..models import load_model
    from ..plotting import FILES

    if args.plot is not None and args.plot.suffix.lower() in FILES:
        require_plot(args.plot)
    model = load_model(args.model)
    data, _ = read_for_model(args.data, model, args)
    data = masked(data, args)
    part = prepared(data if args.range is None else data.slice(args.range), args, cut=True)
    training = None
    if args.training is not None:
        training, _ = read_for_model(args.training, model, args)
        if args.training_range is not None:
            training = training.slice(args.training_range)
        training = prepared(training, args, cut=True)
    card = model.check(part, training, init=args.init)
    written = []
    if args.plot is not None and args.plot.suffix.lower() in FILES:
        card.plot(file=args.plot)
        written = [args.plot]
    elif args.plot is not None:
        from ..evidence.figures import save

        written = save(card, args.plot)
    if args.json:
        print_json({**card.to_json(), **({"figures": list(map(str, written))} if written else {})})
        return
    print(card)
    for path in written:
        print(f"written to {path}")
