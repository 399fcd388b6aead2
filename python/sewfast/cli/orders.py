"""`sewfast orders`: which orders and which delay a linear model of a recording should have."""

from __future__ import annotations

import argparse

from .arguments import Commands, add_columns, add_command, add_split
from .data import read_training
from .output import print_json
from .preparation import add_preparation, prepared
from .progress import Progress

TEXT = """\
Estimate the delay of each input, then try linear models of every order and print the table.

Every model is judged in free run on the last part of each recording, which it was not fitted to.
The choice is the smallest model that does as well there as the best one; the table says why.
"""

EXAMPLES = """\
examples:
  sewfast orders run.csv --input u --output speed
  sewfast orders one.csv two.csv --input u --output speed --na 6 --nb 6
  sewfast orders run.csv --input u --output y --nk 3        the delay is known
  sewfast orders run.mcap --json

then: sewfast identify run.csv --input u --output speed --na 2 --nb 2 --nk 3 -o drive.json
"""


def add(commands: Commands) -> None:
    parser = add_command(
        commands, "orders", orders_command,
        summary="orders and delay for a model", text=TEXT, examples=EXAMPLES,
    )  # fmt: skip
    parser.add_argument("data", nargs="+", metavar="DATA", help="recording: FILE or FILE:IN:OUT")
    add_columns(parser, from_model=False)
    add_split(parser)
    add_preparation(parser)
    parser.add_argument("--na", type=int, default=4, metavar="N", help="past outputs up to (4)")
    parser.add_argument("--nb", type=int, default=4, metavar="N", help="past inputs up to (4)")
    parser.add_argument(
        "--nk", type=int, metavar="N", help="delay [samples]; default: 1 and what is plausible"
    )
    parser.add_argument(
        "--held-out", type=float, default=0.3, metavar="PART",
        help="last part of each recording, which the models are judged on (0.3)",
    )  # fmt: skip


def orders_command(args: argparse.Namespace) -> None:
    from ..identification.order_table import orders

    data = prepared(read_training(args), args)
    with Progress("orders") as progress:
        table = orders(
            data,
            na=args.na,
            nb=args.nb,
            nk=args.nk,
            held_out=args.held_out,
            progress=progress,
        )
    if args.json:
        print_json(table.to_json())
    else:
        print(table)
