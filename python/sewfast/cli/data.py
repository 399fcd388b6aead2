"""Reading and preparing the data of the DATA arguments; `sewfast look`."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from ..errors import DataError, SettingError
from .arguments import Commands, add_columns, add_command, add_options, add_plot, require_plot
from .output import note, print_json, print_result
from .project import with_units

if TYPE_CHECKING:
    from ..dataset import ColumnSummary, Dataset
    from ..models import Model
    from ..readers import Roles, Table


def read_training(args: argparse.Namespace, channels: Sequence[str] = ()) -> Dataset:
    """Every DATA argument as an experiment; columns from `FILE:IN:OUT` or the options."""
    from ..dataset import Dataset

    read = (_read_named(source, args, channels) for source in args.data)
    return Dataset.concat([shifted(data, args) for data in read])


def shifted(data: Dataset, args: argparse.Namespace) -> Dataset:
    """The data with the inputs read `--shift-input` samples earlier."""
    return data.shift_inputs(getattr(args, "shift_input", 0))


def _read_named(source: str, args: argparse.Namespace, channels: Sequence[str]) -> Dataset:
    from ..readers import (
        joint_columns,
        left_out,
        of_joint,
        parse_source,
        read_columns,
        read_table,
    )

    path, inputs, output = parse_source(source)
    table = with_units(read_table(path), args)
    inputs, output = inputs or tuple(args.input or ()), output or args.output
    counts = args.counts
    joint = getattr(args, "joint", None)
    if joint is None and getattr(args, "unit", None) and not (inputs or output or counts):
        # a unit is that of a joint's positions
        joints = joint_columns(table)
        joint = next(iter(joints)) if len(joints) == 1 else None
    if joint is not None:
        if inputs or output or counts:
            raise SettingError(
                name="--joint", expected="no other names of columns", received=", ".join(
                    filter(None, (*inputs, output, counts))
                ), remedy="leave one of them out",
            )  # fmt: skip
        table, command, output = of_joint(table, joint, args.unit or "")
        inputs = (command,)
    if not inputs or not (output or counts):
        found = _recognised(table, args, inputs, output)
        if found is None:
            raise SettingError(
                name=str(table.path), expected="columns that show which is the input and which "
                "the output", received=", ".join(table.names),
                remedy=_how_to_name(table) + left_out(table),
            )  # fmt: skip
        inputs = inputs or (found.input,)
        if not output and not counts:
            output, counts = found.output, found.counts
        if table.counts_per_rev is None:
            note(f"{path}: input {', '.join(inputs)}, output {output or counts}")
            _note_second_inputs(table, inputs, output or counts, args.time)
    return _with_notes(
        read_columns(
            table,
            inputs=inputs,
            output=output,
            Ts=args.ts,
            counts=counts,
            counts_per_rev=args.counts_per_rev,
            time=args.time,
            channels=[*channels, *_references(table, (*inputs, output, counts, *channels))],
            weights=getattr(args, "weights", None),
        )
    )


def _note_second_inputs(
    table: Table, inputs: Sequence[str], output: str | None, time: str | None
) -> None:
    from ..readers.roles import commands_beside

    used = [*inputs, *([output] if output else [])]
    for name in commands_beside(table, used, time)[:3]:
        both = " ".join(f"--input {column}" for column in (*inputs, name))
        note(
            f"{name} is left out, although it steps as a command does: if it moves {output}, too, "
            f"hold it while you record what a controller is tuned on, or model both: {both}"
        )


def _how_to_name(table: Table) -> str:
    from ..readers import joint_columns

    if joints := joint_columns(table):
        return f"name a joint: --joint NAME, of {', '.join(joints)}"
    return "name them: --input COL, --output COL, or --counts COL --counts-per-rev N"


def _recognised(
    table: Table, args: argparse.Namespace, inputs: Sequence[str] = (), output: str | None = None
) -> Roles | None:
    """Input and output of a table, of which some are named; None where that leaves any doubt."""
    from ..readers import roles

    return roles(table, inputs=inputs, output=output, counts=args.counts, time=args.time)


def _with_notes(data: Dataset) -> Dataset:
    """The data, after printing the notes of reading them to standard error."""
    for text in data.notes:
        note(text)
    return data


def _references(table: Table, taken: tuple[str | None, ...]) -> list[str]:
    """Columns with the name of a reference: they show that a record was made in closed loop."""
    from ..dataset import is_reference

    used = {table.resolve(name) for name in taken if name and name in table}
    lengths = {len(table[name]) for name in used}
    names = (n for n in table.names if is_reference(n) and n not in used)
    return [n for n in names if {len(table[n])} == lengths]


def read_for_model(
    source: str, model: Model, args: argparse.Namespace, *, needs_output: bool = True
) -> tuple[Dataset, Table]:
    """The data of one DATA argument, with the model's columns unless others are named."""
    from ..readers import parse_source, read_columns, read_table

    path, inputs, output = parse_source(source)
    table = with_units(read_table(path), args)
    columns = model.columns
    columns["inputs"] = inputs or args.input or columns["inputs"]
    columns |= _output_columns(output or args.output, args, columns)
    columns |= _recorded_columns(table, columns, args, chosen=output or args.output)
    if not needs_output and not _has_output(table, columns):
        columns |= {"output": None, "counts": None, "counts_per_rev": None}
    columns["weights"] = getattr(args, "weights", None)
    columns["time"] = args.time
    data = read_columns(table, Ts=_sample_time(args.ts, table, model), **columns)
    return shifted(_with_notes(data), args), table


def _output_columns(
    output: str | None, args: argparse.Namespace, stored: dict[str, Any]
) -> dict[str, Any]:
    """The output of the command line; the model's counts apply only without one."""
    if args.counts is not None or args.counts_per_rev is not None:
        return {
            "output": output or stored["output"],
            "counts": args.counts or stored["counts"],
            "counts_per_rev": args.counts_per_rev or stored["counts_per_rev"],
        }
    if output is not None:
        return {"output": output, "counts": None, "counts_per_rev": None}
    return {}


def _recorded_columns(
    table: Table, columns: dict[str, Any], args: argparse.Namespace, *, chosen: str | None
) -> dict[str, Any]:
    """The recording's own encoder and counts, which replace the model's."""
    if table.counts_per_rev is None or args.counts_per_rev is not None:
        return {}
    if columns["counts"]:
        return {"counts_per_rev": table.counts_per_rev}
    if chosen is None and "counts" in table and not _has_output(table, columns):
        return {"counts": "counts", "counts_per_rev": table.counts_per_rev}
    return {}


def _has_output(table: Table, columns: dict[str, Any]) -> bool:
    try:
        table.resolve(columns["counts"] or columns["output"])
    except DataError:
        return False
    return True


def _sample_time(given: float | None, table: Table, model: Model) -> float | None:
    """The given sample time; the model's if neither the caller nor the file has one."""
    from ..readers.timebase import time_column

    has_time = table.Ts is not None or time_column(table) is not None
    return given if given is not None or has_time else model.Ts


def split(data: Dataset, train: str | None, held_out: str | None) -> tuple[Dataset, Dataset | None]:
    """Training data and held-out data; without `train` the former is all but the latter."""
    held = None if held_out is None else data.slice(held_out)
    if train is None:
        return (data, None) if held is None else (_without(data, held), held)
    kept = data.slice(train)
    if held is not None:
        _require_apart(kept, held)
    return kept, held


def _without(data: Dataset, held: Dataset) -> Dataset:
    """The parts before and after the held-out part of each experiment."""
    from dataclasses import replace

    pieces = []
    for whole, part in zip(data.experiments, held.experiments, strict=True):
        after = part.start + len(part)
        pieces += [whole.cut(0, part.start)] if part.start > 0 else []
        pieces += [whole.cut(after, len(whole))] if after < len(whole) else []
    if not pieces:
        raise SettingError(
            name="--validate", expected="samples left to train on", received="none",
            remedy="give a smaller range, or --train A:B",
        )  # fmt: skip
    return replace(data, experiments=tuple(pieces))


def _require_apart(train: Dataset, held: Dataset) -> None:
    for a, b in zip(train.experiments, held.experiments, strict=True):
        if a.start < b.start + len(b) and b.start < a.start + len(a):
            raise SettingError(
                name="--train, --validate",
                expected="ranges that do not overlap, as a model is not validated by the data "
                "that it was trained on",
                received=f"{a.range_text} and {b.range_text} of {a.name}",
                remedy="change one of them",
            )  # fmt: skip


# --- Options that prepare data, in the order in which they are applied ----------------------------


PREPARATION_OPTIONS = """\
--differentiate  flag  the output is a position: take its speed, [deg] becomes [deg/s]
--resample TS  float  new sample time [s]; the output is filtered, inputs are averaged
--detrend  {0,1,steady}  remove 0: the mean, 1: a straight line, steady: the level before inputs
    move
"""


def add_preparation(parser: argparse.ArgumentParser) -> None:
    """`--mask`, `--hold-inputs`, `--differentiate`, `--resample` and `--detrend`."""
    group = parser.add_argument_group("preparation, in this order")
    group.add_argument(
        "--mask", action="append", metavar="A:B", default=[],
        help="outputs of each file to leave out: no weight, no score; repeat it for several "
        "ranges; outliers: those that stand out from their neighbours",
    )  # fmt: skip
    add_hold(group)
    add_options(group, PREPARATION_OPTIONS)


def add_hold(parser: argparse._ActionsContainer) -> None:
    parser.add_argument(
        "--hold-inputs", action="store_true",
        help="replace a missing input by the last known one",
    )  # fmt: skip


def held(data: Dataset, args: argparse.Namespace) -> Dataset:
    """The data, with missing inputs held if that option is given."""
    before = len(data.notes)
    data = data.fill_inputs("hold") if args.hold_inputs else data
    _note_new(data, before)
    return data


def masked(data: Dataset, args: argparse.Namespace) -> Dataset:
    """The data without the masked outputs; ranges refer to whole files."""
    before = len(data.notes)
    for text in args.mask:
        if text == "outliers":
            data = data.mask(data.mark_outliers(), why="stand out")
        else:
            data = data.mask(text)
    _note_new(data, before)
    return data


def prepared(
    data: Dataset, args: argparse.Namespace, *, like: Dataset | None = None, cut: bool = False
) -> Dataset:
    """The data after all preparing options; notes on them go to standard error.
    `like` are training data: the same mean is removed as from these. `cut` says that the data were
    cut from masked files: then they are not masked again.
    """
    data = data if cut else masked(data, args)
    data = held(data, args)
    before = len(data.notes)
    if getattr(args, "split_at_gaps", False):
        data = data.split_at_gaps()
    elif hasattr(args, "split_at_gaps") and _rows_are_missing(data):
        note(f"{data.source}: rows are missing; the pieces between are separate experiments")
        data = data.split_at_gaps(of="inputs")
    if args.differentiate:
        data = data.differentiate()
    if args.resample is not None:
        data = data.resample(args.resample)
    if args.detrend == "0":
        data = data.detrend(0, like=like)
    elif args.detrend is not None:
        data = data.detrend("steady" if args.detrend == "steady" else 1)
    _note_new(data, before)
    return data


def _rows_are_missing(data: Dataset) -> bool:
    """Whether inputs are unknown only where outputs are: nothing is lost between the pieces."""
    import numpy as np

    gaps = [(~e.known_inputs, np.isnan(e.y)) for e in data.experiments]
    # a sample at either end of a gap has an output, from one row, but no input to its end
    alone = sum(int(np.sum(u & ~y)) for u, y in gaps)
    ends = sum(int(np.sum(np.diff(u.astype(int), prepend=0) > 0)) for u, _ in gaps)
    return ends > 0 and alone <= 2 * ends and any(np.any(u & y) for u, y in gaps)


def _note_new(data: Dataset, before: int) -> None:
    """Print the notes after the first `before`."""
    for text in data.notes[before:]:
        note(text)


# --- `sewfast look`: recordings before identification ---------------------------------------------


LOOK_TEXT = """\
Show the properties of recordings that matter for identification: samples, gaps, range, trend,
quantisation, time at limits, noise, the excited band, with advice on each.

Where the names and units of the columns leave in doubt which is the input and which the output, it
lists every column of the file, so that you can choose the two: --input COL --output COL.
"""

LOOK_EXAMPLES = """\
examples:
  sewfast look run.csv
  sewfast look run.csv --input u --output speed
  sewfast look run.csv --input u --output speed --plot look.png
  sewfast look run.csv:u:speed other.csv:volt:rpm --json
  sewfast look run.csv --input u --output speed --resample 0.005 --mask 100:120
"""


def add_look(commands: Commands) -> None:
    parser = add_command(
        commands, "look", look_command,
        summary="properties of recordings", text=LOOK_TEXT, examples=LOOK_EXAMPLES,
    )  # fmt: skip
    parser.add_argument("data", nargs="+", metavar="DATA", help="recording: FILE or FILE:IN:OUT")
    add_plot(parser, "draw columns and spectra")
    add_columns(parser, from_model=False)
    add_preparation(parser)


def look_command(args: argparse.Namespace) -> None:
    require_plot(args.plot)
    if (tables := _in_doubt(args)) is not None:
        _show_columns(tables, args)
        return
    found = prepared(read_training(args), args).summary()
    if args.plot is not None:
        found.plot(file=args.plot)
    print_result(found, args, plot=args.plot)


def _in_doubt(args: argparse.Namespace) -> list[Table] | None:
    """All tables, if nothing names a column and input or output of one of them are in doubt."""
    from ..readers import parse_source, read_table

    sources = [parse_source(source) for source in args.data]
    named = args.input or args.output or args.counts or args.joint
    if named or any(inputs or output for _, inputs, output in sources):
        return None
    tables = [with_units(read_table(path), args) for path, _, _ in sources]
    return tables if any(_recognised(table, args) is None for table in tables) else None


def _show_columns(tables: list[Table], args: argparse.Namespace) -> None:
    if args.plot is not None:
        raise SettingError(
            name="--plot", expected="which column is the input, which the output", received="none",
            remedy=f"name them of {', '.join(tables[0].names)}: --input COL --output COL",
        )  # fmt: skip
    columns = {str(t.path): _columns(t) for t in tables}
    if args.json:
        print_json({path: [vars(c) for c in found] for path, found in columns.items()})
        return
    from ..readers import joint_columns
    from .output import print_rows

    for table, (path, found) in zip(tables, columns.items(), strict=True):
        # variables of a file can differ in length
        print(f"{path}: {max((c.n for c in found), default=0)} rows")
        header = ("column", "from", "to", "standard deviation", "missing")
        print_rows([header, *map(_row, found)])
        for name, reason in table.unusable.items():
            print(f"not a column of numbers: {name}, {reason}")
    if named := ", ".join(joint_columns(tables[0])):
        print(f"name a joint, or the input and the output to see more: --joint NAME, of {named}")
    else:
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
