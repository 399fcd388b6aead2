"""Options that prepare data before they are used, in the order in which they act."""

from __future__ import annotations

import argparse
import sys
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from ..dataset import Dataset


def add_preparation(parser: argparse.ArgumentParser, *, detrend: bool = True) -> None:
    """`--mask` to `--resample` and, where a model may come of it, `--detrend`."""
    group = parser.add_argument_group("preparation, in this order")
    group.add_argument(
        "--mask", action="append", metavar="A:B", default=[],
        help="outputs of each file to take out: no weight, no score; repeat it for several ranges; "
        "outliers: those that stand out of their neighbours",
    )  # fmt: skip
    add_hold(group)
    group.add_argument(
        "--differentiate", action="store_true",
        help="the output is a position: take its speed, [deg] becomes [deg/s]",
    )  # fmt: skip
    group.add_argument(
        "--resample", type=float, metavar="TS",
        help="new sample time [s]; the output is filtered, inputs are averaged as held ones",
    )  # fmt: skip
    if detrend:
        group.add_argument(
            "--detrend", choices=("0", "1", "steady"),
            help="take off 0: the mean, 1: a straight line, steady: the level before inputs move",
        )  # fmt: skip


def add_hold(parser: argparse._ActionsContainer) -> None:
    parser.add_argument(
        "--hold-inputs", action="store_true",
        help="take an input that is missing to be the last known one, held",
    )  # fmt: skip


def held(data: Dataset, args: argparse.Namespace) -> Dataset:
    """The data with missing inputs held, where that is asked for."""
    before = len(data.notes)
    data = data.fill_inputs("hold") if args.hold_inputs else data
    _tell(data, before)
    return data


def masked(data: Dataset, args: argparse.Namespace) -> Dataset:
    """The data without the outputs that are masked: ranges are of whole files."""
    before = len(data.notes)
    for text in args.mask:
        if text == "outliers":
            data = data.mask(data.mark_outliers(), why="stand out")
        else:
            data = data.mask(text)
    _tell(data, before)
    return data


def prepared(
    data: Dataset, args: argparse.Namespace, *, like: Dataset | None = None, cut: bool = False
) -> Dataset:
    """The data behind every option; what was done goes to standard error.

    Parameters
    ----------
    like : Dataset or None
        Training data: the mean that was taken off them comes off these as well.
    cut : bool
        The data were cut out of masked files already: leaves the mask out.
    """
    data = data if cut else masked(data, args)
    data = held(data, args)
    before = len(data.notes)
    if getattr(args, "split_at_gaps", False):
        data = data.split_at_gaps()
    if args.differentiate:
        data = data.differentiate()
    if args.resample is not None:
        data = data.resample(args.resample)
    data = _detrended(data, getattr(args, "detrend", None), like)
    _tell(data, before)
    return data


def _tell(data: Dataset, before: int) -> None:
    for note in data.notes[before:]:
        print(note, file=sys.stderr)


def _detrended(data: Dataset, order: str | None, like: Dataset | None) -> Dataset:
    if order is None:
        return data
    if order == "0":
        return data.detrend(0, like=like)
    return data.detrend("steady" if order == "steady" else 1)
