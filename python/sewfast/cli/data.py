"""DATA arguments -> `Dataset`."""

from __future__ import annotations

import argparse
import sys
from typing import TYPE_CHECKING, Any

from ..errors import DataError, SettingError

if TYPE_CHECKING:
    from ..dataset import Dataset
    from ..models import Model
    from ..readers import Table


def read_training(args: argparse.Namespace) -> Dataset:
    """Every DATA argument as an experiment; columns from `FILE:IN:OUT` or the options."""
    from ..dataset import Dataset

    return Dataset.concat([_read_named(source, args) for source in args.data])


def _read_named(source: str, args: argparse.Namespace) -> Dataset:
    from ..readers import parse_source, read, read_table

    path, inputs, output = parse_source(source)
    table = read_table(path)
    inputs, output = inputs or tuple(args.input or ()), output or args.output
    counts = args.counts
    if table.counts_per_rev is not None:
        inputs, counts = _of_recording(table, inputs, output, counts)
    if not inputs:
        raise _unnamed(table, "input", "--input COL")
    if not output and not counts:
        raise _unnamed(table, "output", "--output COL, or --counts COL --counts-per-rev N")
    return _with_notes(
        read(
            table,
            inputs=inputs,
            output=output,
            Ts=args.ts,
            counts=counts,
            counts_per_rev=args.counts_per_rev,
            channels=_references(table, (*inputs, output, counts)),
            weights=getattr(args, "weights", None),
        )
    )


def _with_notes(data: Dataset) -> Dataset:
    """The data; what was done in reading them goes to standard error."""
    for note in data.notes:
        print(note, file=sys.stderr)
    return data


def _references(table: Table, taken: tuple[str | None, ...]) -> list[str]:
    """Columns that are named as a reference: they show that a record was made in closed loop."""
    from ..dataset import is_reference

    used = {table.resolve(name) for name in taken if name and name in table}
    lengths = {len(table[name]) for name in used}
    names = (n for n in table.names if is_reference(n) and n not in used)
    return [n for n in names if {len(table[n])} == lengths]


def _of_recording(
    table: Table, inputs: tuple[str, ...] | None, output: str | None, counts: str | None
) -> tuple[tuple[str, ...] | None, str | None]:
    """Inputs and counts of a recording, which has columns `u` and `counts` of its own."""
    if not inputs and "u" in table:
        inputs = ("u",)
    if counts is None and output is None and "counts" in table:
        counts = "counts"
    return inputs, counts


def _unnamed(table: Table, what: str, remedy: str) -> SettingError:
    return SettingError(
        f"{table.path}: which column is the {what}? available: {', '.join(table.names)}; "
        f"name it: {remedy}"
    )


def read_for_model(
    source: str, model: Model, args: argparse.Namespace, *, needs_output: bool = True
) -> tuple[Dataset, Table]:
    """One DATA argument with the model's columns, unless the command line names others."""
    from ..readers import parse_source, read, read_table

    path, inputs, output = parse_source(source)
    table = read_table(path)
    columns = model.columns
    columns["inputs"] = inputs or args.input or columns["inputs"]
    columns |= _output_columns(output or args.output, args, columns)
    columns |= _recorded_columns(table, columns, args, chosen=output or args.output)
    if not needs_output and not _has_output(table, columns):
        columns |= {"output": None, "counts": None, "counts_per_rev": None}
    columns["weights"] = getattr(args, "weights", None)
    return _with_notes(read(table, Ts=_sample_time(args.ts, table, model), **columns)), table


def _output_columns(
    output: str | None, args: argparse.Namespace, stored: dict[str, Any]
) -> dict[str, Any]:
    """What the command line says about the output; counts stay only where it says nothing."""
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
    """What a recording knows better than the model: its encoder, and its counts for its speed."""
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
    """The model's own sample time where neither the caller nor the file says another."""
    from ..readers.timebase import time_column

    says = table.Ts is not None or time_column(table) is not None
    return given if given is not None or says else model.Ts


def split(data: Dataset, train: str | None, held_out: str | None) -> tuple[Dataset, Dataset | None]:
    """Training data and what is held out of it; without `train` that is all but the held-out part.

    Raises
    ------
    SettingError, DataError
        Where a range is none, leaves a file, or both overlap.
    """
    held = None if held_out is None else data.slice(held_out)
    if train is None:
        return (data, None) if held is None else (_without(data, held), held)
    kept = data.slice(train)
    if held is not None:
        _require_apart(kept, held)
    return kept, held


def _without(data: Dataset, held: Dataset) -> Dataset:
    """What lies before and after the held-out part of each experiment."""
    from dataclasses import replace

    pieces = []
    for whole, part in zip(data.experiments, held.experiments, strict=True):
        after = part.start + len(part)
        pieces += [whole.cut(0, part.start)] if part.start > 0 else []
        pieces += [whole.cut(after, len(whole))] if after < len(whole) else []
    if not pieces:
        raise SettingError(
            "--validate: the range covers every sample, so nothing is left to train on; give a "
            "smaller one, or --train A:B"
        )
    return replace(data, experiments=tuple(pieces))


def _require_apart(train: Dataset, held: Dataset) -> None:
    for a, b in zip(train.experiments, held.experiments, strict=True):
        if a.start < b.start + len(b) and b.start < a.start + len(a):
            raise SettingError(
                f"--train {a.range_text} and --validate {b.range_text} overlap in {a.name}; what a "
                "model was trained on says nothing about it: give ranges that do not overlap"
            )
