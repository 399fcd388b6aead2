"""`sewfast tune`: a controller for a model, or a Pareto front of controllers."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..errors import Interrupted, SettingError
from ..progress import Progress
from ..units import duration
from .arguments import (
    TABLES,
    Commands,
    add_command,
    add_named_output,
    add_options,
    add_plot,
    require_place,
    require_plot,
    time_left,
)
from .control import reference_of
from .output import print_json, print_rows, suggested

if TYPE_CHECKING:
    from ..control.biquad import Biquad
    from ..control.controller import Controller, SampledController
    from ..gains import Gains
    from ..models import Model
    from ..tuning.front import ParetoFront
    from ..tuning.objective import Constraints, Cost, LoadStep
    from ..tuning.search import TuningResult
    from ..tuning.task import Wanted
    from ..tuning.verdict import Verdict


FORMS = ("standard", "parallel", "per_sample")
FIGURES = (".png", ".svg", ".pdf")

TUNE = """\
Tune a 2-DOF PID, or state feedback with an observer (--controller), on identified models, by
simulating the loop with the encoder, the feedback filter and the command's limits. It uses only the
models and no machine. Several models are plants that one controller has to suit, and so are all
members of an ensemble.

Nothing but the model is needed. References cover the range that the drive was recorded over, at
the pace of its step response; the command's limits are the recorded range of the input, with 0;
the feedback is filtered over 8 ms, at most a tenth of the time constant; an encoder is in the
loop if the model's speed comes from counts. If the drive can take more than its recorded commands,
give --u-min and --u-max.

A reference is a named one (`sewfast signals`) or a CSV with columns t [s], r [output unit].
Named ones are signals in RPM at 1 ms; on any other drive the same shapes over its own range.
Several references are tuned for together.

The cost of a run is a weighted sum of tracking [y], chatter [u], effort [u], overshoot [%], rise
[ms], lag [ms], saturation (a share), and under load steps (--load) recovery [ms] and load (rms
deviation); --cost NAME=WEIGHT sets a weight, overshoot_limit where its cost begins.
--constraint sets limits that come first: Ms (1.8 without one; inf: none), overshoot, u, recovery,
load. --pareto OBJECTIVES searches for a Pareto front instead, and picks its knee.

The command that the models need for the reference is added to that of a PID (--feedforward), which
then needs the reference some samples early: see the page "Follow a reference".

Gains that destabilise a model, that keep the command at a limit although the reference needs none,
or that leave the recorded inputs and outputs for most of a run, are refused: exit code 2, and no
file. --force writes them all the same.
"""

TUNE_EXAMPLES = """\
examples:
  sewfast tune drive.json -o controller.json
  sewfast tune drive.json --u-min -10 --u-max 10 --counts-per-rev 4096 -o controller.json
  sewfast tune drive.json --reference trapezoid --reference random -o controller.json
  sewfast tune drive.json --reference cycle.csv --u-min -10 --u-max 10 --filter 4 -o controller.json
  sewfast tune drive.json --cost chatter=50 --constraint overshoot=2 -o calm.json
  sewfast tune drive.json --load 1500:-2 --constraint recovery=70 -o firm.json
  sewfast tune one.json two.json --aggregate worst --variables Kp,Ti,alpha -o controller.json
  sewfast tune drive.json -o controller.json --plot tuned.png
  sewfast tune drive.json --controller state-feedback -o states.json
  sewfast tune drive.json --loop position -o position.json
  sewfast tune network.json --rival linear.json -o controller.json
  sewfast tune shaft.json --notch 75 --constraint Ms=1.7 --response response.json -o controller.json
  sewfast tune drive.json --pareto tracking,chatter --front front.png -o controller.json
"""


OPTIONS = """\
model MODEL.json  text...  model file that identify wrote
--reference FILE|NAME  text...  what to track; may repeat (trapezoid, trapezoids, random)
--u-min V  float  least command (as recorded)
--u-max V  float  largest command (as recorded)
--limits-of RECORDING.mcap  text  take the volt limit of a recording's drive in both directions, for
    those not given
--counts-per-rev N  float  encoder in the loop; default: that of the counts that the output comes
    from, if any
--filter N  int  moving average over N samples of the feedback; 1: none; default: 8 ms, at most a
    tenth of the time constant
--unit UNIT  text  unit of the output, if the model has none: RPM, rad/s, ..
--controller KIND  text=pid  kind of the controller without --start, such as state-feedback (pid)
--start CONTROLLER.json  text  start of the search, with its limits, encoder and filters; default:
    Table 1 on the first model's step response
--feedforward  {preview,causal}=preview  add the command that the models need for the reference,
    known ahead (preview) or only in time (causal), if following it then costs less
--loop  {speed,position}=speed  with a position loop over that of the speed, for run --stop-at and
    --positions (speed)
--notch HZ[:DEPTH[:WIDTH]]  text...  a notch to start with, tuned together with the gains; may
    repeat (depth .1, width .5; sewfast bode suggests one)
--response RESPONSE.json  text  a response measured by sewfast bode, for whose bands Ms must hold as
    well
--rival MODEL.json  text  another kind of model of the same drive, for a second opinion on the
    gains: a linear one for a network
--force  flag  tune on a model that identify called useless, and write gains that are unfit, too
"""


def add(commands: Commands) -> None:
    parser = add_command(
        commands, "tune", tune_command,
        summary="a controller for a model", text=TUNE, options=OPTIONS, examples=TUNE_EXAMPLES,
    )  # fmt: skip
    parser.add_argument(
        "--no-feedforward", dest="feedforward", action="store_const", const="none",
        help="the PID alone",
    )  # fmt: skip
    _add_search(parser)
    add_plot(parser, "draw the loops of the result and the start; with --pareto the front")
    add_named_output(parser, "controller", "model", "controller file to write")


SEARCH_OPTIONS = """\
--variables NAME[=LOW:HIGH],..  text  variables of the search (Kp,Ti,Td,alpha,beta,N; for state
    feedback rho,integral,noise,weight,lead); also Tt, filter_samples, filter_time, observer_time,
    r_rate, notches
--cost NAME=WEIGHT  text...  weight of a term; may repeat
--constraint NAME=LIMIT  text...  limit of Ms (1.8; inf: none), overshoot [%%], u, recovery [ms] or
    load; may repeat
--speed Y  float  output about which models are linearised for Ms (a tenth, half and nine tenths of
    the references)
--load LEVEL:COMMAND  text...  a load step: the level held and the command added after the limiter,
    as in 1500:-2; may repeat
--aggregate  {mean,worst}=mean  over the plants (mean)
--method  {genetic,cma-es}=genetic  search method (genetic)
--evaluations N  int  controllers tried (3000)
--time-budget S  float  time of the whole search, after which the best so far is used (no limit)
--seed N  int=0  seed of the search (0)
--pareto NAME,NAME  text  objectives of a front: tracking, chatter, effort, overshoot, rise, lag,
    saturation, recovery, load, cost, Ms; -o is its knee
--front FILE  path  the front as a table (.csv, .npz, .mat, .parquet) or a figure (.png, .svg, .pdf)
"""


def _add_search(parser: argparse.ArgumentParser) -> None:
    add_options(parser, SEARCH_OPTIONS)


def tune_command(args: argparse.Namespace) -> int | None:
    require_place(args.out, (".json",))
    require_plot(args.plot)
    if args.front is not None and args.pareto is None:
        raise SettingError("--front: expected --pareto with the objectives of the front as well")
    if args.pareto is not None and args.method != "genetic":
        raise SettingError(
            name="--method", expected="no --pareto, as a front is searched by NSGA-II",
            received="both", remedy="leave one of them out",
        )  # fmt: skip
    if args.pareto is not None and args.loop != "speed":
        raise SettingError(
            name="--loop", expected="no --pareto, as a front has speed loops only",
            received="both", remedy="leave one of them out",
        )  # fmt: skip
    if args.pareto is not None and args.rival is not None:
        raise SettingError(
            name="--rival", expected="no --pareto, as it is a second opinion on one controller",
            received="both", remedy="leave one of them out",
        )  # fmt: skip
    require_place(args.front, (*TABLES, *FIGURES), option="--front")
    models = useful_models(args.model, force=args.force)
    first = models[0]
    references = [
        reference_of(text, first.Ts, first.output_unit) for text in args.reference or ()
    ] or None
    settings = _settings(args)
    settings["constraints"] = _on_response(args, settings["constraints"], models)
    try:
        if args.pareto is None:
            found = _tuned(args, models, references, settings)
            _require_fit(args, found.verdict)
            found.controller.save(args.out)
            if args.plot is not None:
                found.plot(first, references[0] if references else None, file=args.plot)
            _show_tuned(args, found)
        else:
            front = _front(args, models, references, settings)
            _require_fit(args, front.verdict)
            front.picked.save(args.out)
            _show_front(args, front)
    except Interrupted as e:
        getattr(e.best, "picked", e.best).save(args.out)
        print(
            f"interrupted; kept the best so far in {args.out}, which nobody has judged: look at "
            f"its margins first ({suggested('analyse', args.out, Path(args.model[0]))})",
            file=sys.stderr,
        )
        return 130
    return None


def _require_fit(args: argparse.Namespace, verdict: Verdict) -> None:
    """Refuse unfit gains unless they are forced."""
    if not args.force:
        verdict.require_fit()


def _settings(args: argparse.Namespace) -> dict[str, Any]:
    """The settings of both searches."""
    settings: dict[str, Any] = {
        "variables": variables(args.variables),
        "cost": cost(args.cost),
        "constraints": constraints(args.constraint),
        "loads": loads(args.load),
        "aggregate": args.aggregate,
        "seed": args.seed,
    }
    if args.evaluations is not None:
        settings["evaluations"] = args.evaluations
    return settings


def _on_response(
    args: argparse.Namespace, constraints: Constraints, models: list[Any]
) -> Constraints:
    """Ms about a speed, and on the bands of a response."""
    if args.speed is not None:
        constraints = replace(constraints, speed=args.speed)
    if args.response is None:
        return constraints
    from ..frequency import load_response

    response = load_response(args.response)
    linear = [model for model in models if hasattr(model, "to_tf")]
    if not linear:
        raise SettingError(
            "--response: expected a linear model among those to tune on, as a response does not "
            "tell whether a loop is stable; add that of sewfast bode --model"
        )
    return replace(constraints, plant=[*linear, response])


def _started(args: argparse.Namespace, models: list[Any]) -> dict[str, Any]:
    """`_first` with the notches of the options."""
    first = _first(args)
    given = notches(args.notch)
    if not given:
        return first
    from ..tuning.task import first_of

    start = _pid(first.get("start") or first_of(models[0], **first), "--notch")
    return {"start": replace(start, biquads=(*start.biquads, *given))}


def _pid(start: SampledController, option: str) -> Controller:
    """The start as a PID, for an option that needs one."""
    from ..control.controller import Controller

    if isinstance(start, Controller):
        return start
    raise SettingError(
        f"{option}: expected a PID, received {type(start).__name__}; leave {option} out, or tune a "
        "PID (--controller pid)"
    )


def _first(args: argparse.Namespace) -> dict[str, Any]:
    """The controller to start with, or limits, encoder and filter of the first one."""
    if args.start is None:
        return _loop(args)
    from ..control.files import load_controller

    if args.controller != "pid":
        raise SettingError(
            name="--start",
            expected="no --controller, as the file says of which kind its controller is",
            received="both", remedy="leave out --controller",
        )  # fmt: skip
    given = [
        "--" + option.replace("_", "-")
        for option in ("u_min", "u_max", "limits_of", "counts_per_rev", "filter", "unit")
        if getattr(args, option) is not None
    ]
    if given:
        raise SettingError(
            name="--start", expected="the controller's own limits, encoder and filters",
            received=", ".join(given), remedy=f"leave them out, or change them in {args.start}",
        )  # fmt: skip
    return {"start": load_controller(args.start)}


def _loop(args: argparse.Namespace) -> dict[str, Any]:
    """Limits, encoder and filter of the first controller, if given."""
    u_min, u_max = command_limits(args)
    return {
        "u_min": u_min,
        "u_max": u_max,
        "counts_per_rev": "model" if args.counts_per_rev is None else args.counts_per_rev,
        "filter_samples": args.filter,
        "output_unit": args.unit,
        "controller": args.controller.replace("-", "_"),
    }


def useful_models(paths: Sequence[str], *, force: bool) -> list[Model]:
    """The models of files; one that identify called useless is refused unless by force."""
    from ..models import load_model

    models = [load_model(path) for path in paths]
    for path, model in zip(paths, models, strict=True):
        verdict = model.training.get("verdict") or {}
        if verdict.get("grade") == "useless" and not force:
            raise SettingError(
                name=str(path), expected="a model that a controller can be tuned on",
                received=verdict["text"],
                remedy="record as identify said, or tune on it all the same with --force",
            )  # fmt: skip
        if verdict.get("grade") in ("poor", "useless"):
            print(f"warning: {path}: {verdict['text']}", file=sys.stderr)
    return models


def _tuned(
    args: argparse.Namespace, models: list[Any], references: Any, settings: dict[str, Any]
) -> TuningResult:
    from ..models import load_model
    from ..tuning.search import tune

    rival = None if args.rival is None else load_model(args.rival)
    with Progress("tune", quiet=args.quiet) as progress:
        return tune(
            models, references, **_started(args, models), **settings, rival=rival,
            feedforward=args.feedforward, loop=args.loop, method=args.method,
            time_budget=time_left(args), progress=progress,
        )  # fmt: skip


def _front(
    args: argparse.Namespace, models: list[Any], references: Any, settings: dict[str, Any]
) -> ParetoFront:
    from ..tuning.front import pareto
    from ..tuning.task import first_of

    first = _started(args, models)
    start = _pid(first.get("start") or first_of(models[0], **first), "--pareto")
    if start.feedforward is not None:
        if args.feedforward == "causal" and start.feedforward.preview:
            raise SettingError(
                name="--feedforward", expected="preview or none with --pareto, whose loops keep "
                "the feedforward of the start", received="causal",
                remedy="tune the start with it first",
            )  # fmt: skip
        if args.feedforward == "none":
            start = replace(start, feedforward=None)
    with Progress("tune", quiet=args.quiet) as progress:
        return pareto(
            models, references, objectives=args.pareto.split(","), start=start, **settings,
            time_budget=time_left(args), progress=progress,
        )  # fmt: skip


def _show_tuned(args: argparse.Namespace, found: TuningResult) -> None:
    if args.json:
        print_json(
            {
                "file": str(args.out),
                "cost": found.cost,
                "start_cost": found.start_cost,
                "cost_unit": found.controller.y_unit,
                "evaluations": found.evaluations,
                "termination": found.termination,
                "method": found.method,
                "lost": list(found.lost),
                "position": None if found.position is None else found.position.to_json(),
                "grade": found.grade,
                "verdict": found.verdict.to_json(),
                "warning": found.warning,
                "feedforward": None if found.lead is None else found.lead.to_json(),
                "plot": None if args.plot is None else str(args.plot),
                "weights": found.weights.named(),
                "variables": {
                    v.name: {"value": v.value, "low": v.low, "high": v.high}
                    for v in found.variables
                },
                **_controller(found.controller),
            }
        )
        return
    print(found)
    _show_gains(args, found.controller)


def _show_front(args: argparse.Namespace, front: ParetoFront) -> None:
    if args.plot is not None:
        front.plot(file=args.plot)
    if args.front is not None and args.front.suffix.lower() in FIGURES:
        front.plot(file=args.front)
    elif args.front is not None:
        front.save(args.front)
    if args.json:
        print_json(
            {
                "file": str(args.out),
                "objectives": list(front.objectives),
                "units": front.units,
                "values": front.values.tolist(),
                "pick": front.pick,
                "evaluations": front.evaluations,
                "lost": list(front.lost),
                "grade": front.grade,
                "verdict": front.verdict.to_json(),
                "warning": front.warning,
                **_controller(front.picked),
            }
        )
        return
    print(front)
    print(front.picked)
    _show_gains(args, front.picked)


def _controller(controller: SampledController) -> dict[str, Any]:
    from ..control.controller import Controller

    if not isinstance(controller, Controller):
        return {"controller": controller.to_dict()}
    forms = forms_of(controller)
    return {
        "gains": {g.form: {**g.to_dict(), "units": g.units} for g in forms},
        "controller": controller.to_dict(),
    }


def _show_gains(args: argparse.Namespace, controller: SampledController) -> None:
    from ..control.controller import Controller

    if isinstance(controller, Controller):
        print("the same gains in every form:")
        print_rows([gain_row(g) for g in forms_of(controller)])
    if "from the recorded input" in controller.notes:
        unit = controller.u_unit or "u"
        print(
            f"limits: {controller.u_min:g} to {controller.u_max:g} {unit}, all that the drive was "
            "recorded with, and 0 if it shows no rest; --u-min, --u-max say what else it can "
            "take"
        )
    if controller.counts_per_rev is None and args.start is None:
        print(
            "feedback: with the noise that the model's record shows, without an encoder's steps; "
            "--counts-per-rev puts an encoder in the loop"
        )
    lead = controller.feedforward
    if lead is not None and lead.preview:
        early = f"{lead.preview} samples ({duration(lead.preview * controller.Ts, 3)})"
        print(
            f"feedforward: it needs the reference {early} early, or follows it that much later; "
            "--feedforward causal does without, --no-feedforward leaves it out"
        )
    if args.plot is not None:
        print(f"written to {args.plot}")
    print(f"written to {args.out}; try it: {suggested('run', args.out, Path(args.model[0]))}")


def forms_of(controller: Controller) -> list[Gains]:
    """The gains in every form."""
    return [controller.gains.to(form, Ts=controller.Ts) for form in FORMS]  # type: ignore[arg-type]


def gain_row(gains: Gains) -> list[str]:
    """The form, then each gain with its unit."""
    values = gains.to_dict()
    cells = [f"{name} = {values[name]:.6g} {unit}" for name, unit in gains.units.items()]
    cells += [""] * (4 - len(cells))
    return [f"  {gains.form.replace('_', '-')}", *cells]


# --- Options: weights, limits, load steps, variables, notches -------------------------------------


def _pairs(given: list[str] | None, option: str) -> dict[str, float]:
    """NAME=NUMBER of every occurrence of an option."""
    pairs = {}
    for text in given or ():
        name, equals, number = text.partition("=")
        try:
            pairs[name.strip()] = float(number)
        except ValueError:
            equals = ""
        if not equals or not name.strip():
            raise SettingError(f"{option} {text}: expected NAME=NUMBER, as in {option} overshoot=2")
    return pairs


def cost(given: list[str] | None) -> Cost:
    from ..tuning.objective import Cost

    return Cost(**_known(_pairs(given, "--cost"), "--cost", tuple(Cost.__dataclass_fields__)))


def constraints(given: list[str] | None) -> Constraints:
    from ..tuning.objective import Constraints

    pairs = _pairs(given, "--constraint")
    return Constraints(
        **_known(pairs, "--constraint", ("Ms", "overshoot", "u", "recovery", "load"))
    )


def loads(given: list[str] | None) -> list[LoadStep]:
    from ..tuning.objective import LoadStep

    steps = []
    for text in given or ():
        try:
            level, disturbance = (float(number) for number in text.split(":"))
        except ValueError:
            raise SettingError(
                f"--load {text}: expected LEVEL:COMMAND, as in --load=1500:-2"
            ) from None
        steps.append(LoadStep(level, disturbance))
    return steps


def _known(pairs: dict[str, float], option: str, names: tuple[str, ...]) -> dict[str, Any]:
    for name in pairs:
        if name not in names:
            raise SettingError(f"{option} {name}: expected one of {', '.join(names)}")
    return dict(pairs)


def variables(text: str | None) -> list[Wanted] | None:
    """`Kp,Ti=0.02:0.5` as names and (name, low, high)."""
    if text is None:
        return None
    found: list[Wanted] = []
    for part in text.split(","):
        name, equals, bounds = (piece.strip() for piece in part.partition("="))
        if not equals:
            found.append(name)
            continue
        try:
            low, high = (float(bound) for bound in bounds.split(":"))
        except ValueError:
            raise SettingError(
                f"--variables {part}: expected NAME or NAME=LOW:HIGH, as in Ti=0.02:0.5"
            ) from None
        found.append((name, low, high))
    return found


def command_limits(args: argparse.Namespace) -> tuple[float | None, float | None]:
    """Least and largest command [V]: as given, else a recording's volt limit, else None."""
    if args.limits_of is None:
        return args.u_min, args.u_max
    volt = _volt_limit(args.limits_of)
    return (
        -volt if args.u_min is None else args.u_min,
        volt if args.u_max is None else args.u_max,
    )


def _volt_limit(path: str) -> float:
    """Volt limit of the drive that a recording was made on [V]."""
    from ..recordfile.reader import read_header

    limits = read_header(path).settings.get("limits")
    volt = limits.get("volt") if isinstance(limits, dict) else None
    if not isinstance(volt, (int, float)) or isinstance(volt, bool) or volt <= 0.0:
        raise SettingError(
            f"--limits-of {path}: expected a recording of a drive with a volt limit, it states "
            "none; give --u-min and --u-max"
        )
    return float(volt)


def notches(given: list[str] | None) -> list[Biquad]:
    """Notches of every --notch. Raises `SettingError` for anything but HZ[:DEPTH[:WIDTH]]."""
    from ..control.biquad import Biquad

    found = []
    for text in given or ():
        try:
            numbers = [float(number) for number in text.split(":")]
        except ValueError:
            numbers = []
        if not 1 <= len(numbers) <= 3:
            raise SettingError(
                f"--notch {text}: expected HZ, HZ:DEPTH or HZ:DEPTH:WIDTH, as in --notch 75:0.1:0.5"
            )
        found.append(Biquad.notch(*numbers))
    return found
