"""`sewfast validate`, `sewfast simulate`: what a model says about a recording."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING

from .arguments import (
    TABLES,
    Commands,
    add_columns,
    add_command,
    add_output,
    add_plot,
    add_split,
    add_weights,
    require_place,
    require_plot,
)
from .data import read_for_model
from .output import print_result, write_columns
from .preparation import add_hold, add_preparation, held, masked, prepared

if TYPE_CHECKING:
    from ..dataset import Dataset, FloatArray
    from ..readers import Table

VALIDATE = """\
Score a model on a recording that it was not trained on, in free run and one step ahead.

Free run is the headline: the model starts once and lives with its own outputs, as it does when a
controller is tuned on it. One step ahead starts from the measured output at every sample: that
looks good for models that are of no use alone, and bad where the outputs are noisy.
"""

VALIDATE_EXAMPLES = """\
examples:
  sewfast validate drive.json other.csv
  sewfast validate drive.json other.csv --plot free-run.png
  sewfast validate drive.json run.csv --range 5000:8334      the part not trained on
  sewfast validate drive.json other.csv --init 0             from rest; every sample is scored
  sewfast validate drive.json other.mat:volt:rpm --json
"""

SIMULATE = """\
Run a model on the inputs of a recording: t, u, y_hat, one row per row of the recording.

The first --init outputs set the initial state; later ones may be empty. With --init 0 the model
starts from rest and the recording needs no output at all. Several inputs keep their names.
"""

SIMULATE_EXAMPLES = """\
examples:
  sewfast simulate drive.json run.csv -o prediction.csv
  sewfast simulate drive.json inputs.csv --init 0 | head
"""


def add(commands: Commands) -> None:
    parser = add_command(
        commands, "validate", validate_command,
        summary="errors of a model on a recording", text=VALIDATE, examples=VALIDATE_EXAMPLES,
    )  # fmt: skip
    _add_model_and_data(parser)
    add_split(parser)
    add_preparation(parser)
    add_plot(parser, "draw measured output, free run and errors")
    parser.add_argument(
        "--range", metavar="A:B", help="samples to score, 0-based, end excluded; default: all"
    )
    parser = add_command(
        commands, "simulate", simulate_command,
        summary="free run of a model", text=SIMULATE, examples=SIMULATE_EXAMPLES,
    )  # fmt: skip
    _add_model_and_data(parser)
    add_hold(parser)
    add_output(parser, "OUT", "CSV, .npz, .mat or Parquet; default: CSV to standard output")


def _add_model_and_data(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("model", metavar="MODEL.json", help="model file that identify wrote")
    parser.add_argument("data", metavar="DATA", help="recording: FILE or FILE:IN:OUT")
    parser.add_argument(
        "--init", type=whole, default=20, metavar="N",
        help="first samples, which set the initial state and are not scored (20); 0: from rest",
    )  # fmt: skip
    add_columns(parser, from_model=True)
    add_weights(parser)


def whole(text: str) -> int:
    try:
        value = int(text)
    except ValueError:
        value = -1
    if value < 0:
        raise argparse.ArgumentTypeError(
            f"expected a whole number of samples, 0 or more, received {text!r}"
        )
    return value


def validate_command(args: argparse.Namespace) -> None:
    from ..models import load_model
    from ..validation import validate

    require_plot(args.plot)
    model = load_model(args.model)
    data, _ = read_for_model(args.data, model, args)
    data = masked(data, args)
    part = prepared(data if args.range is None else data.slice(args.range), args, cut=True)
    found = validate(model, part, init=args.init)
    if args.plot is not None:
        found.plot(file=args.plot)
    print_result(found, args, plot=args.plot)


def simulate_command(args: argparse.Namespace) -> None:
    from ..models import load_model

    require_place(args.out, TABLES)
    model = load_model(args.model)
    data, table = read_for_model(args.data, model, args, needs_output=args.init > 0)
    data = held(data, args)
    (y_hat,) = model.simulate(data, init=args.init)
    columns = {"t": _time(table, data), **_inputs(data), "y_hat": y_hat}
    low, high = float(y_hat.min()), float(y_hat.max())
    write_columns(
        args.out,
        columns,
        {},
        {"n": len(y_hat), "init": args.init, "Ts": data.Ts, "y_hat_min": low, "y_hat_max": high},
        [f"{model.title}, free run of {len(y_hat)} samples: y_hat from {low:.6g} to {high:.6g}"],
        as_json=args.json,
    )


def _time(table: Table, data: Dataset) -> FloatArray:
    """The recording's own time where it is in seconds, else counted from 0."""
    import numpy as np

    for name in table.names:
        seconds = name.lower() in ("t", "time") and table.unit(name) in ("", "s")
        if seconds and len(table[name]) == len(data) and not data.notes:
            return table[name]
    return np.arange(len(data), dtype=np.float64) * data.Ts


def _inputs(data: Dataset) -> dict[str, FloatArray]:
    """`u` for one input; several keep their names, apart from those of the other columns."""
    names = tuple(f"u_{n}" if n in ("t", "y_hat") else n for n in data.input_names)
    labels = ("u",) if data.n_inputs == 1 else names
    return dict(zip(labels, data.experiments[0].u.T, strict=True))
