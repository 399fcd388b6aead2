"""`sewfast check`, `compare` and `analyse`: checks of models, and of a controller on them."""

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
from .control import plant_of, reference_of
from .data import add_preparation, masked, prepared, read_for_model
from .output import print_json, print_result

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


OPTIONS = """\
model MODEL.json  text  model file that identify wrote
data DATA  text  recording: FILE or FILE:IN:OUT
--init N  whole=20  first samples, which set the initial state and are not judged (20); 0: from rest
--range A:B  text  samples to judge, 0-based, end excluded; default: all
--training DATA  text  recording that the model was identified from
--training-range A:B  text  samples of it that it was identified from
--plot FILE  path  draw measured output, free run and its band: PNG, SVG or PDF; a folder takes a
    PNG per question
"""


def add(commands: Commands) -> None:
    parser = add_command(
        commands, "check", check_command,
        summary="whether a model can be trusted", text=CHECK, options=OPTIONS, examples=EXAMPLES,
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


# --- `sewfast analyse`: a controller on models ----------------------------------------------------


ANALYSE = """\
A controller on models (every member of an ensemble) or on the virtual machine: margins over the
operating range, steps of the reference and of a disturbance, sensitivity of the cost to gains and
plants, and doubts about the simulated loops.
"""

ANALYSE_EXAMPLES = """\
examples:
  sewfast analyse controller.json drive.json
  sewfast analyse controller.json drive.json --plot loop.png      steps and Bode in one picture
  sewfast analyse controller.json drive.json --out analysis       figures and analysis.json
  sewfast analyse controller.json one.json two.json virtual --json
  sewfast analyse controller.json drive.json --speed 300 --speed 1500 --reference cycle.csv
"""


ANALYSE_OPTIONS = """\
controller CONTROLLER.json  text  file that tune wrote
plants MODEL.json|virtual[:SEED]  text...  plants to analyse it on
--speed Y  float...  output about which the plants are linearised; may repeat (three over the
    training data)
--step Y  float  size of the reference step
--disturbance U  float  size of the step at the plant's input
--seconds S  float  duration of the steps
--reference FILE|NAME  text...  reference of the cost; may repeat (trapezoid, random)
--out DIR  path  folder for analysis.json and the figures
"""


def add_analyse(commands: Commands) -> None:
    parser = add_command(
        commands, "analyse", analyse_command,
        summary="margins, steps, sensitivities of a controller",
        text=ANALYSE, options=ANALYSE_OPTIONS, examples=ANALYSE_EXAMPLES,
    )  # fmt: skip
    add_plot(parser, "draw steps, loop transfer and sensitivities")


def analyse_command(args: argparse.Namespace) -> None:
    from ..analysis import analyse
    from ..control.files import load_pid

    require_plot(args.plot)
    controller = load_pid(args.controller)
    references = [
        reference_of(text, controller.Ts, controller.gains.y_unit) for text in args.reference or ()
    ]
    found = analyse(
        controller,
        [plant_of(text) for text in args.plants],
        speeds=args.speed,
        step=args.step,
        disturbance=args.disturbance,
        seconds=args.seconds,
        references=references or None,
    )
    written = found.save(args.out) if args.out is not None else []
    if args.plot is not None:
        found.plot(file=args.plot)
        written.append(args.plot)
    if args.json:
        print_json({**found.to_json(), **({"files": list(map(str, written))} if written else {})})
        return
    print(found)
    for path in written:
        print(f"written to {path}")


# --- `sewfast compare`: several models on one recording -------------------------------------------


COMPARE = """\
Score several models on the same recording, best one that none of them was trained on: free run
(the headline), one step ahead, number of parameters. Columns are those of the first model.
"""

COMPARE_EXAMPLES = """\
examples:
  sewfast compare network.json linear.json other.csv
  sewfast compare network.json linear.json other.csv --plot both.png
  sewfast compare drive.json drive-alternative-*.json run.csv --range 5000:8334 --json
"""


COMPARE_OPTIONS = """\
models MODEL.json  text...  model file that identify wrote
data DATA  text  recording: FILE or FILE:IN:OUT
--init N  whole=20  first samples, which set the initial state and are not scored (20); 0: from rest
--range A:B  text  samples to score, 0-based, end excluded; default: all
"""


def add_compare(commands: Commands) -> None:
    parser = add_command(
        commands, "compare", compare_command,
        summary="several models on a recording",
        text=COMPARE, options=COMPARE_OPTIONS, examples=COMPARE_EXAMPLES,
    )  # fmt: skip
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
