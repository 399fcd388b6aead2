"""`sewfast look`: what is in recordings before anything is identified from them."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING

from ..errors import SettingError
from .arguments import Commands, add_columns, add_command, add_plot, require_plot
from .data import read_training
from .output import print_json, print_result
from .preparation import add_preparation, prepared

if TYPE_CHECKING:
    from ..dataset import ColumnSummary
    from ..readers import Table

TEXT = """\
Say what one should know of recordings before identifying from them: samples, gaps, range, trend,
quantisation, time at limits, noise, the band that is excited, and what to do about each finding.

Without --input and --output every column of a file is listed, so that the two can be chosen.
"""

EXAMPLES = """\
examples:
  sewfast look run.csv                                    which columns are there
  sewfast look run.csv --input u --output speed
  sewfast look run.csv --input u --output speed --plot look.png
  sewfast look run.csv:u:speed other.csv:volt:rpm --json
  sewfast look run.csv --input u --output speed --resample 0.005 --mask 100:120
"""


def add(commands: Commands) -> None:
    parser = add_command(
        commands, "look", look_command,
        summary="what is in recordings", text=TEXT, examples=EXAMPLES,
    )  # fmt: skip
    parser.add_argument("data", nargs="+", metavar="DATA", help="recording: FILE or FILE:IN:OUT")
    add_plot(parser, "draw columns and spectra")
    add_columns(parser, from_model=False)
    add_preparation(parser)


def look_command(args: argparse.Namespace) -> None:
    require_plot(args.plot)
    tables = [] if args.input or args.output or args.counts else _unnamed(args)
    if tables:
        _show_columns(tables, args)
        return
    found = prepared(read_training(args), args).summary()
    if args.plot is not None:
        found.plot(file=args.plot)
    print_result(found, args, plot=args.plot)


def _unnamed(args: argparse.Namespace) -> list[Table]:
    """The files, where none says which column is what."""
    from ..readers import parse_source, read_table

    sources = [parse_source(source) for source in args.data]
    if any(inputs or output for _, inputs, output in sources):
        return []
    tables = [read_table(path) for path, _, _ in sources]
    return [] if all(t.counts_per_rev is not None for t in tables) else tables


def _show_columns(tables: list[Table], args: argparse.Namespace) -> None:
    if args.plot is not None:
        raise SettingError(
            f"--plot: which column is the input, which the output? available: "
            f"{', '.join(tables[0].names)}; name them: --input COL --output COL"
        )
    columns = {str(t.path): _columns(t) for t in tables}
    if args.json:
        print_json({path: [vars(c) for c in found] for path, found in columns.items()})
        return
    from .output import print_rows

    for table, (path, found) in zip(tables, columns.items(), strict=True):
        print(f"{path}: {found[0].n if found else 0} rows")
        header = ("column", "from", "to", "standard deviation", "missing")
        print_rows([header, *map(_row, found)])
        for name, reason in table.unusable.items():
            print(f"not a column of numbers: {name}, {reason}")
    print("name the input and the output to see more: --input COL --output COL")


def _columns(table: Table) -> list[ColumnSummary]:
    from ..dataset import column_summary

    return [
        column_summary(name, table.unit(name), "column", [table[name]], None)
        for name in table.names
    ]


def _row(c: ColumnSummary) -> tuple[str, ...]:
    from ..dataset import labelled

    return (labelled(c.name, c.unit), *(f"{v:.6g}" for v in (c.low, c.high, c.std)), f"{c.missing}")
