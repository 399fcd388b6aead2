"""`sewfast orders`, `identify`, `validate`, `simulate`: models from recordings."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from itertools import count, takewhile
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..errors import Interrupted, SettingError
from ..kinds import KINDS, TEXTS, spelled
from ..progress import Progress
from .arguments import (
    TABLES,
    Commands,
    add_columns,
    add_command,
    add_named_output,
    add_options,
    add_output,
    add_plot,
    add_split,
    add_weights,
    require_place,
    require_plot,
    time_left,
)
from .data import (
    add_hold,
    add_preparation,
    held,
    masked,
    prepared,
    read_for_model,
    read_training,
    split,
)
from .output import print_json, print_result, suggested, write_columns

if TYPE_CHECKING:
    from ..dataset import Dataset, FloatArray
    from ..models import Model
    from ..readers import Table
    from ..validation import Validation


ORDERS_TEXT = """\
Estimate the delay of each input, then try linear models of every order and print the table.

Every model is judged in free run on the last part of each recording, which it was not fitted to.
The choice is the smallest model that is as good there as the best one; the table gives the reason.
"""

ORDERS_EXAMPLES = """\
examples:
  sewfast orders run.csv --input u --output speed
  sewfast orders one.csv two.csv --input u --output speed --na 6 --nb 6
  sewfast orders run.csv --input u --output y --nk 3        the delay is known
  sewfast orders run.mcap --json

then: sewfast identify run.csv --input u --output speed --na 2 --nb 2 --nk 3 -o drive.json
"""


ORDERS_OPTIONS = """\
data DATA  text...  recording: FILE or FILE:IN:OUT
--na N  int=4  past outputs up to (4)
--nb N  int=4  past inputs up to (4)
--nk N  int  delay [samples]; default: 1 and plausible ones
--held-out PART  float=0.3  last part of each recording, which the models are judged on (0.3)
"""


def add_orders(commands: Commands) -> None:
    parser = add_command(
        commands, "orders", orders_command,
        summary="orders and delay for a model",
        text=ORDERS_TEXT, options=ORDERS_OPTIONS, examples=ORDERS_EXAMPLES,
    )  # fmt: skip
    add_columns(parser, from_model=False)
    add_split(parser)
    add_preparation(parser)


def orders_command(args: argparse.Namespace) -> None:
    from ..identification.order_table import orders

    data = prepared(read_training(args), args)
    with Progress("orders", quiet=args.quiet) as progress:
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


# --- `sewfast identify`: from recordings to a model file ------------------------------------------


TEXT = """\
Identify a model of a drive from recordings of its input and its output.

DATA is a CSV, .mat, .npz, Parquet or MCAP file, or a log (MDF, TDMS, ULog, WPILOG, ROS bag);
several files are several experiments of one drive.
FILE:IN:OUT names the columns of one file, IN1+IN2 several inputs.

The default, auto, fits linear output error of several orders, then networks that start from it, and
keeps a network only if it is credibly better in free run on samples that it was not fitted to.
Every candidate is printed with its error; the last lines tell whether the model is good enough to
tune a controller on, and what to do next. Without --input and --output both are recognised by
their names and units, if these are clear.
"""

EXAMPLES = """\
examples:
  sewfast identify run.csv
      input and output by their names and units; the model goes to run-model.json

  sewfast identify run.csv --input u --output speed -o drive.json
      columns u and speed [unit from the header], sample time from the column t

  sewfast identify run.csv --input u --output y --train 0:5000 --validate 5000:8000 -o drive.json
      the first 5,000 samples train; the next 3,000 choose when to stop, and are scored

  sewfast identify run.csv --input u --counts encoder --counts-per-rev 1572 -o drive.json
      the speed [RPM] is computed from encoder counts

  sewfast identify run.mcap -o drive.json
      a recording of a device: input u, speed from its counts

  sewfast identify slow.csv:u:y fast.csv:volt:rpm -o drive.json
      two experiments whose columns have different names

  sewfast identify run.csv --input u --output y --mask 700:720 --resample 0.005 -o drive.json
      20 samples without weight, a longer sample time; sewfast look gives such advice

  sewfast identify run.mat --input u --output y --ts 0.02 --model oe -o linear.json
      a file without a time column; linear output error alone

  sewfast identify run.csv --input u --output y --validate 5000:8334 -o drive.json --plot fit.png
      a picture of the free run on the samples held out

  sewfast identify run.csv --input u --output y --time-budget 30 -o drive.json
      the best model found in half a minute

  sewfast identify run.csv --input u --output y --alternatives -o drive.json
      also the next best models: drive-alternative-1.json and so on

  sewfast identify today.csv --input u --output y --further drive.json -o drive2.json
      the model in drive.json, trained further on today's recording
"""


OPTIONS = """\
data DATA  text...  recording: FILE or FILE:IN:OUT
--train A:B  text  samples of each file to train on, 0-based, end excluded; default: all but
    --validate
--validate A:B  text  samples of each file to hold out, for the choice and the score; default: the
    last fifth is held out for the choice, and used for training in the end
"""


def add(commands: Commands) -> None:
    parser = add_command(
        commands, "identify", identify_command,
        summary="a model from recordings", text=TEXT, options=OPTIONS, examples=EXAMPLES,
    )  # fmt: skip
    add_columns(parser, from_model=False)
    add_weights(parser)
    add_split(parser)
    add_preparation(parser)
    _add_model(parser)
    add_plot(parser, "draw the free run on the data held out, else on the training data")
    add_named_output(parser, "model", "data", "model file to write")


MODEL_OPTIONS = """\
--preset  {paper}  paper: 8 tanh and a saturated output, u/10, y/1000, random starts, as published
--na N  int  past outputs of a lagged model (2)
--nb N  int  past inputs of a lagged model (2)
--nk N  int  delay [samples] (1; auto, neural-ss: from the data)
--nx N  int  states of neural-ss (from the data)
--hidden N  int  hidden units (from the data; neural-oe: 8)
--output-function  {linear,saturation,abs}  output function of neural-ss: abs for a sensor without
    the sign (from the data)
--starts N  int  random starts (by the amount of data)
--seed N  int=0  seed of the starts (0)
--time-budget S  float  total time [s]; the best model until then is kept (no limit)
--further MODEL.json  text  a model to train further
--alternatives  flag  also write the next best models, to MODEL-alternative-1.json and so on, in
    place of those of an earlier MODEL.json
"""


def _add_model(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--model", choices=[spelled(kind) for kind in KINDS], default="auto",
        help="; ".join(f"{spelled(kind)}: {text}" for kind, text in TEXTS.items())
        + "; auto (default): oe or a network, whichever is better",
    )  # fmt: skip
    add_options(parser, MODEL_OPTIONS)
    parser.add_argument(
        "--no-select", dest="select", action="store_false",
        help="neural-oe: hold nothing out, train to the last iteration; to compare methods",
    )  # fmt: skip


def identify_command(args: argparse.Namespace) -> int | None:
    from ..dataset.experiment import in_effect
    from ..dataset.sensor import measuring

    require_place(args.out, (".json",))
    require_plot(args.plot)
    train, held = split(masked(read_training(args), args), args.train, args.validate)
    train = prepared(train, args, cut=True)
    held = None if held is None else prepared(held, args, like=train, cut=True)
    try:
        with Progress("identify", quiet=args.quiet) as progress:
            model = _identify(args, train, held, progress)
    except Interrupted as e:
        e.best.save(args.out)
        print(f"interrupted; kept the best so far in {args.out}", file=sys.stderr)
        return 130
    model.save(args.out)
    # scored as identify took them
    train = measuring(in_effect(train))
    others = _save_alternatives(args, model) if args.alternatives else []
    scores = _scores(model, train, held)
    if args.plot is not None:
        scores["train" if held is None else "validation"].plot(file=args.plot)
    _show(args, model, scores, others)
    return None


def _save_alternatives(args: argparse.Namespace, model: Model) -> list[Path]:
    """Write the alternatives beside the model, the best first; delete those of older models."""
    out = Path(args.out)
    numbered = (out.with_name(f"{out.stem}-alternative-{i}{out.suffix}") for i in count(1))
    paths = []
    for other in model.alternatives:
        paths.append(next(numbered))
        other.save(paths[-1])
    # a model that is trained further has no alternatives, and can be one of these files itself
    for old in takewhile(Path.is_file, () if args.further else numbered):
        old.unlink()
    return paths


def _identify(
    args: argparse.Namespace, train: Dataset, held: Dataset | None, progress: Progress
) -> Model:
    from ..identification import identify
    from ..models import load_model

    if args.further is not None and args.model != "auto":
        raise SettingError(
            name="--further", expected="no --model with it, as a model keeps its kind",
            received=f"--model {args.model}", remedy="leave one of them out",
        )  # fmt: skip
    return identify(
        train,
        model=args.model if args.further is None else load_model(args.further),
        preset=args.preset,
        na=args.na,
        nb=args.nb,
        nk=args.nk,
        nx=args.nx,
        hidden=args.hidden,
        output=args.output_function,
        starts=args.starts,
        seed=args.seed,
        time_budget=time_left(args),
        select=args.select,
        validation=held,
        progress=progress,
    )


def _scores(model: Model, train: Dataset, held: Dataset | None) -> dict[str, Validation]:
    from ..validation import validate

    sets = {"train": train} | ({} if held is None else {"validation": held})
    return {name: validate(model, data) for name, data in sets.items()}


def _show(
    args: argparse.Namespace,
    model: Model,
    scores: dict[str, Validation],
    others: Sequence[Path],
) -> None:
    if args.json:
        found: dict[str, Any] = {
            "file": str(args.out),
            "kind": model.kind,
            "Ts": model.Ts,
            **model.orders,
            "training": dict(model.training),
            "scores": {name: s.to_json() for name, s in scores.items()},
            "alternatives": [str(path) for path in others],
        }
        if args.plot is not None:
            found["plot"] = str(args.plot)
        print_json(found)
        return
    print(model)
    for name, score in scores.items():
        label = "training data" if name == "train" else "held out to choose"
        s = score.simulation
        unit = f" {score.unit}" if score.unit else ""
        fit = f"fit {s.fit_percent:.2f} %, " if s.fit_percent > -100.0 else ""
        print(f"{label}: free-run {fit}rmse {s.rmse:.5g}{unit}")
    # without --alternatives nothing was written
    for path, other in zip(others, model.alternatives, strict=False):
        print(f"alternative: {other!r} in {path}")
    if args.plot is not None:
        print(f"written to {args.plot}")
    command = suggested("validate", args.out, "DATA")
    print(f"written to {args.out}; score it on another recording: {command}")


# --- `sewfast validate`, `sewfast simulate`: a model on a recording -------------------------------


VALIDATE = """\
Score a model on a recording that it was not trained on, in free run and one step ahead.

Free run is what counts: the model starts once and then uses its own outputs, as in the tuning of a
controller. One step ahead starts from the measured output at every sample: that looks good for
models that are useless on their own, and bad if the outputs are noisy.
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


MODEL_AND_DATA_OPTIONS = """\
model MODEL.json  text  model file that identify wrote
data DATA  text  recording: FILE or FILE:IN:OUT
--init N  whole=20  first samples, which set the initial state and are not scored (20); 0: from rest
"""
SCORED_OPTIONS = "--range A:B  text  samples to score, 0-based, end excluded; default: all"


def add_models(commands: Commands) -> None:
    parser = add_command(
        commands, "validate", validate_command,
        summary="errors of a model on a recording", text=VALIDATE, examples=VALIDATE_EXAMPLES,
    )  # fmt: skip
    _add_model_and_data(parser)
    add_split(parser)
    add_preparation(parser)
    add_plot(parser, "draw measured output, free run and errors")
    add_options(parser, SCORED_OPTIONS)
    parser = add_command(
        commands, "simulate", simulate_command,
        summary="free run of a model", text=SIMULATE, examples=SIMULATE_EXAMPLES,
    )  # fmt: skip
    _add_model_and_data(parser)
    add_hold(parser)
    add_output(parser, "OUT", "CSV, .npz, .mat or Parquet; default: CSV to standard output")


def _add_model_and_data(parser: argparse.ArgumentParser) -> None:
    add_options(parser, MODEL_AND_DATA_OPTIONS)
    add_columns(parser, from_model=True)
    add_weights(parser)


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
    from ..validation import doubling

    require_place(args.out, TABLES)
    model = load_model(args.model)
    data, table = read_for_model(args.data, model, args, needs_output=args.init > 0)
    data = held(data, args)
    (y_hat,) = model.simulate(data, init=args.init)
    columns = {"t": _time(table, data), **_inputs(data), "y_hat": y_hat}
    low, high = float(y_hat.min()), float(y_hat.max())
    ahead = doubling(model)
    lines = [f"{model.title}, free run of {len(y_hat)} samples: y_hat from {low:.6g} to {high:.6g}"]
    if ahead is not None:
        lines.append(
            "note: the model is unstable, as a plant that only a loop holds: without one its run "
            f"doubles every {ahead} samples, whatever was recorded; sewfast validate begins it "
            "anew as often, sewfast run closes a loop around it"
        )
    write_columns(
        args.out,
        columns,
        {},
        {
            "n": len(y_hat),
            "init": args.init,
            "Ts": data.Ts,
            "y_hat_min": low,
            "y_hat_max": high,
            "doubles_every": ahead,
        },
        lines,
        as_json=args.json,
    )


def _time(table: Table, data: Dataset) -> FloatArray:
    """The recording's own time if it is in seconds, else multiples of the sample time."""
    import numpy as np

    for name in table.names:
        seconds = name.lower() in ("t", "time") and table.unit(name) in ("", "s")
        if seconds and len(table[name]) == len(data) and not data.notes:
            return table[name]
    return np.arange(len(data), dtype=np.float64) * data.Ts


def _inputs(data: Dataset) -> dict[str, FloatArray]:
    """`u` for one input; several keep their names, prefixed if another column has the same."""
    names = tuple(f"u_{n}" if n in ("t", "y_hat") else n for n in data.input_names)
    labels = ("u",) if data.n_inputs == 1 else names
    return dict(zip(labels, data.experiments[0].u.T, strict=True))
