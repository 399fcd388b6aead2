"""`sewfast bode`, `physics`: frequency response and shaft of a machine, constants of its motor."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterable
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_args

from ..errors import DataError, FitError, SettingError, SewfastError
from .arguments import (
    Commands,
    add_columns,
    add_command,
    add_options,
    add_output,
    add_plot,
    require_place,
    require_plot,
)
from .drive import add_drive, is_port, machine_of, opened, require_no_drive_options
from .output import REFUSED, note, print_json, print_result

if TYPE_CHECKING:
    from ..control.controller import Controller
    from ..dataset import Dataset
    from ..frequency import FrequencyResponse, ResponsesOverSpeed, ShaftFit


BODE = """\
The Bode plot of a drive, with error bars, and the resonance of its shaft. A machine (--on) is
brought to a working speed and excited there by sines of random phases, which separates noise from
distortion. For a record, spectra are averaged, or (--method local) the response is separated from
the transients at its beginning and end. Two masses and a shaft, or a rigid machine, are fitted.

The machine turns at --speed, a little faster and slower, for a minute or less; at several speeds
one after the other. Under a controller (--controller) the reference is excited instead, and the
loop's measured margins are printed. If a drive trips, the response of its samples until then is
kept and marked; the exit code is 2.
"""

EXAMPLES = """\
examples:
  sewfast bode --on virtual --speed 1500 --plot bode.png
  sewfast bode --on "virtual?load_inertia=0.001&shaft_stiffness=150" --speed 1500
  sewfast bode --on /dev/ttyUSB0 --speed 1000 --amplitude 1 -o response.json \\
      --limits volt=10,speed=3500,acceleration=30000,current=15
  sewfast bode --on virtual --speed 500,1000,2000 -o speeds.json --plot speeds.png
  sewfast bode run.csv --input u --output y --reference r     a record under feedback
  sewfast bode chirp.csv --input u --output y --method local  a chirp that began in motion
  sewfast bode response.json --controller controller.json     margins on the measured response
  sewfast bode response.json --propose new.json --u-max 10 --counts-per-rev 1572
"""

_ON_A_MACHINE = (
    "speed",
    "amplitude",
    "period",
    "realisations",
    "periods",
    "f_min",
    "f_max",
    "seed",
)
_OF_A_RECORD = ("reference", "method", "segment")


OPTIONS = """\
data DATA  text?  recording, or a response written by -o
--on virtual[:SEED]|FILE.fmu?volt=V|PORT  text  excite this machine instead
--speed RPM[,RPM...]  speeds  working speed of the machine, or several
--amplitude V  float  peak of the multisine (six tenths of the command left at that speed); with
    --controller of the reference [RPM] (a twentieth of the speed)
--controller FILE.json  text  excite the reference of this loop; print its margins on the response
--period S  float  period of the multisine (2)
--realisations N  int  multisines with different phases (4)
--periods N  int  repetitions of each (4)
--f-min HZ  float  lowest frequency (1)
--f-max HZ  float  highest frequency (four tenths of the sample rate)
--seed N  int  seed of the phases (0)
--reference COL  text  column of a record with the controller's reference
--method  {segments,local}  for a record: spectra averaged over segments (the default), or local
    polynomials, which remove the leakage of its beginning and end
--segment N  int  samples of a record's segments (a ninth of it)
--model FILE.json  path  write the fit as a model; keeps an identified one
--propose FILE.json  path  write a controller for the machine: PID gains of the largest bandwidth,
    with a notch if that pays; limits and filters of --controller, if given
--Ms MS  float  largest sensitivity of --propose (1.7)
--u-max V  float  limit of --propose's command
"""


def add(commands: Commands) -> None:
    parser = add_command(
        commands, "bode", command,
        summary="frequency response with error bars, resonance of the shaft",
        text=BODE, examples=EXAMPLES,
    )  # fmt: skip
    add_options(parser, OPTIONS, speeds=_speeds)
    add_output(parser, "FILE.json", "write the response")
    add_plot(parser, "draw gain, phase and coherence")
    add_columns(parser, from_model=False)
    add_drive(parser)


def _speeds(text: str) -> float | list[float]:
    """One speed, or several between commas."""
    found = [float(part) for part in text.split(",")]
    return found[0] if len(found) == 1 else found


def _require_place_of_model(path: Path | None) -> None:
    """Refuse to replace an identified model, or a file that is no model: other commands read
    `--model`, so a slip here would lose it.
    """
    from ..models import load_model

    require_place(path, (".json",), option="--model")
    if path is None or not path.is_file():
        return
    try:
        is_own = not load_model(path).training
    except SewfastError:
        is_own = False
    if not is_own:
        raise SettingError(
            name=f"--model {path}", expected="a new file for the model that is written",
            received="an identified model, or a file that is none",
            remedy="choose another name, or remove that file",
        )  # fmt: skip


def command(args: argparse.Namespace) -> int | None:
    from ..control.files import load_pid
    from ..frequency import ResponsesOverSpeed, fit_shaft

    require_place(args.out, (".json",))
    _require_place_of_model(args.model)
    require_place(args.propose, (".json",), option="--propose")
    require_plot(args.plot)
    for name in ("Ms", "u_max"):
        if getattr(args, name) is not None and args.propose is None:
            raise SettingError(
                name=f"--{name.replace('_', '-')}", expected="--propose FILE.json with it",
                received="none", remedy="give that as well",
            )  # fmt: skip
    if (args.on is None) == (args.data is None):
        received = "neither" if args.on is None else "both"
        raise SettingError(
            f"expected a record, DATA, or a machine, --on virtual, received {received}"
        )
    controller = None if args.controller is None else load_pid(args.controller)
    response = _of_record(args) if args.on is None else _of_machine(args, controller)
    if args.out is not None:
        response.save(args.out)
    if isinstance(response, ResponsesOverSpeed):
        return _over_speeds(args, response, controller)
    try:
        fit, none = fit_shaft(response), None
    except (DataError, FitError) as refused:
        fit, none = None, str(refused)
    if args.plot is not None:
        response.plot(fit=fit, file=args.plot)
    if args.model is not None and fit is not None:
        fit.to_model().save(args.model)
    margins = None if controller is None else response.margins(controller, speed=args.speed)
    _show(args, response, fit, none, margins)
    if args.propose is not None:
        _propose(args, fit, controller)
    return _tripped([response])


def _tripped(responses: Iterable[FrequencyResponse]) -> int | None:
    """The exit code, and a line on standard error, if a drive tripped."""
    for response in responses:
        if why := response.provenance.get("incomplete"):
            print(f"sewfast bode: {why}; what came until then is kept", file=sys.stderr)
            return REFUSED
    return None


def _over_speeds(
    args: argparse.Namespace, found: ResponsesOverSpeed, controller: Controller | None
) -> int | None:
    for option in ("model", "propose"):
        if getattr(args, option) is not None:
            raise SettingError(
                name=f"--{option}", expected="a response about one speed",
                received=f"those about {len(found)}", remedy="measure at one of them",
            )  # fmt: skip
    if args.plot is not None:
        found.plot(file=args.plot)
    margins = {} if controller is None else found.margins(controller)
    if args.json:
        shown: dict[str, Any] = found.to_dict()
        shown["shafts"] = [
            found.fits[s].to_dict() if s in found.fits else None for s in found.speeds
        ]
        if margins:
            shown["margins"] = [vars(m) for m in margins.values()]
        print_json(shown)
    else:
        print(found)
        for speed, m in margins.items():
            print(f"  {speed:>8g}  {m}")
        for path in (args.out, args.plot):
            if path is not None:
                print(f"written to {path}")
    return _tripped(found)


def _propose(args: argparse.Namespace, fit: ShaftFit | None, controller: Any) -> None:
    """Write a controller and print its loop. Raises `SettingError` without a fitted machine."""
    from ..frequency import propose

    if fit is None:
        raise SettingError(
            "--propose: expected a response to which a machine can be fitted, got one where the "
            "fit fails; excite more, or longer"
        )
    given = {"Ms": args.Ms, "u_max": args.u_max}
    found = propose(
        fit, like=controller, counts_per_rev=args.counts_per_rev,
        **{name: value for name, value in given.items() if value is not None},
    )  # fmt: skip
    found.controller.save(args.propose)
    if not args.json:
        print(found)
        print(f"written to {args.propose}")


def _show(
    args: argparse.Namespace,
    response: FrequencyResponse,
    fit: ShaftFit | None,
    none: str | None,
    margins: Any,
) -> None:
    if args.json:
        shaft = {"refused": none} if fit is None else fit.to_dict()
        found = {"response": response.to_dict(), "shaft": shaft}
        print_json(found if margins is None else {**found, "margins": vars(margins)})
        return
    print(response)
    print(f"no shaft fitted: {none}" if fit is None else fit)
    if margins is not None:
        print(margins)
    for path in (args.out, args.plot, args.model if fit is not None else None):
        if path is not None:
            print(f"written to {path}")


def _of_machine(
    args: argparse.Namespace, controller: Controller | None
) -> FrequencyResponse | ResponsesOverSpeed:
    from ..commissioning import bode

    for name in _OF_A_RECORD:
        if getattr(args, name) is not None:
            raise SettingError(
                name=f"--{name}", expected="a record", received="a machine, --on",
                remedy="leave it out",
            )  # fmt: skip
    found: FrequencyResponse | ResponsesOverSpeed
    options = {k: getattr(args, k) for k in _ON_A_MACHINE if getattr(args, k) is not None}
    if is_port(args.on):
        with opened(args) as drive:
            found = bode(drive, controller=controller, **options)
            return found
    require_no_drive_options(args)
    found = bode(machine_of(args.on), controller=controller, **options)
    return found


def _of_record(args: argparse.Namespace) -> FrequencyResponse | ResponsesOverSpeed:
    from .. import storage
    from ..commissioning import bode, unsmoothed
    from ..frequency import FrequencyResponse, ResponsesOverSpeed, load_response, load_responses
    from .data import read_training

    require_no_drive_options(args)
    for name in _ON_A_MACHINE:
        if name != "speed" and getattr(args, name) is not None:
            raise SettingError(
                name=f"--{name.replace('_', '-')}", expected="a machine, --on", received="a record",
                remedy="leave it out",
            )  # fmt: skip
    if args.data.endswith(".json"):
        format = storage.format_of(args.data)
        if format == ResponsesOverSpeed.FORMAT:
            return load_responses(args.data)
        if format != FrequencyResponse.FORMAT:
            raise SettingError(
                f"{args.data}: expected a recording or a response that `sewfast bode -o` wrote"
            )
        return load_response(args.data)
    source, args.data = args.data, [args.data]
    data = read_training(args)
    found: FrequencyResponse = bode(
        unsmoothed(source, data), reference=args.reference, method=args.method,
        segment=args.segment,
    )  # fmt: skip
    return found


# --- `sewfast physics`: friction, inertia and electrical constants of a motor from a record -------


PHYSICS = """\
The constants of a motor: command per speed, per acceleration and against friction, lags, loads over
a turn, each with a 95 % interval. With a measured current also the resistance, and with the volts
on the winding R, Ke, J and friction in SI units. Constants that the record does not determine are
not printed as numbers but named, with the measurement that would determine them.
"""

PHYSICS_EXAMPLES = """\
examples:
  sewfast physics steps.csv --input u --counts counts --counts-per-rev 1572 -o motor.json
  sewfast physics log.csv --input volts --output speed --speed-unit rad/s
  sewfast physics log.csv --input volts --output rpm --speed-unit rpm --current amps --volts 1
  sewfast physics log.csv --input u --output rpm --speed-unit rpm --export wpilib gains.json
  sewfast record --on motor.json --signal chirp -o rehearsal.csv     the twin as a machine
"""


PHYSICS_OPTIONS = """\
data DATA  text...  recordings of the same motor
--current COL  text  column of the motor current [A]
--volts N  float  volts on the winding per unit of command
--structure LIST  text  default: joint if the output is a position, else dcmotor (the usual terms
    that the record shows); or terms: lag,delay,coulomb,offset,drop,stribeck,load_1,load_2,
    inertia_2,cogging,torque_ripple,limit; dcmotor,sag adds one of
    stribeck_difference,sag,eccentricity
--intervals  {curvature,profile}=curvature  95 %% intervals by the curvature of the cost, or as
    profile likelihood (seconds)
--speed-unit UNIT  text  unit of the output: rpm, rad/s, rev/s, deg/s
--inertia N  float  for --export of a joint: known inertia [kg m^2; kg if it slides], for forces in
    N m
--check  {mujoco}  of a joint: build the simulator from its export, replay the record, and say how
    they differ
--bandwidth HZ  float  of a joint with a controller inside: its gains for this bandwidth of the
    position, and what they cannot do
--winding  {line,q}  for --export: volts and amperes are between two terminals (line), or amplitudes
    along the q axis, as logged by boards (q)
--gear N  float=1.0  for --export wpilib, mujoco, urdf: turns of the motor per turn of the joint
--model FILE.json  path  write the turning motor as a linear model for tuning; keeps an identified
    one
"""


def add_physics(commands: Commands) -> None:
    parser = add_command(
        commands, "physics", physics_command,
        summary="inertia, friction and electrical constants of a motor",
        text=PHYSICS, options=PHYSICS_OPTIONS, examples=PHYSICS_EXAMPLES,
    )  # fmt: skip
    parser.add_argument(
        "--export", nargs=2, metavar=("TARGET", "FILE"),
        help="write settings for wpilib, mujoco, urdf, odrive, moteus or simplefoc; of a joint for "
        "mujoco, urdf or json",
    )  # fmt: skip
    add_output(parser, "FILE.json", "write the motor")
    add_plot(parser, "draw the free run and the command over the speed")
    add_columns(parser, from_model=False)


def physics_command(args: argparse.Namespace) -> None:
    from .. import storage
    from ..dataset.faults import sound
    from ..greybox import physics
    from ..greybox.exports import BOARDS, Target
    from ..greybox.fit import is_joint
    from ..greybox.joint_exports import JointTarget, simulator

    require_place(args.out, (".json",))
    _require_place_of_model(args.model)
    require_plot(args.plot)
    target, place = args.export or (None, "")
    if args.structure in (None, "joint") and (joints := _joints(args)):
        for name, wanted in (
            ("--plot", args.plot), ("--export", target), ("--check", args.check),
            ("--model", args.model), ("-o", args.out), ("--bandwidth", args.bandwidth),
            ("--inertia", args.inertia), ("--volts", args.volts), ("--current", args.current),
            ("--winding", args.winding), ("--intervals profile", args.intervals == "profile"),
        ):  # fmt: skip
            if wanted:
                raise SettingError(
                    name=name, expected="one joint", received=f"{len(joints)}: {', '.join(joints)}",
                    remedy="choose one of them: --joint NAME",
                )  # fmt: skip
        print_result(physics(joints), args)
        return
    data, found = sound(_motor_data(args))
    for fault in found:
        note(fault.warning)
    of_joint = is_joint(data, args.structure, args.speed_unit)
    if of_joint and args.plot:
        raise SettingError(
            name="--plot", expected="none for a joint", received="a file",
            remedy="write the joint (-o), or it as a model (--model)",
        )  # fmt: skip
    of_joints = {"--check": args.check, "--inertia": args.inertia, "--bandwidth": args.bandwidth}
    given = [name for name, value in of_joints.items() if value is not None]
    if not of_joint and given:
        raise SettingError(
            name=given[0], expected="a position as output",
            received=data.output_unit or "an output without a unit", remedy="leave it out for a "
            "motor, or name the unit of the position",
        )  # fmt: skip
    if args.inertia is not None and not (target or args.check):
        raise SettingError(
            name="--inertia", expected="--export or --check, whose forces are then in N m",
            received="neither", remedy="leave it out, or add --export mujoco joint.xml",
        )  # fmt: skip
    if target not in (None, *get_args(JointTarget if of_joint else Target)):
        names = ", ".join(get_args(JointTarget if of_joint else Target))
        raise SettingError(f"--export: expected one of {names}, received {target!r}")
    if target in BOARDS and args.winding is None:
        raise SettingError(
            name="--winding", expected=f"line or q with --export {target}", received="nothing",
            remedy="line: volts and amperes between two terminals; q: amplitudes along the q axis",
        )  # fmt: skip
    if target is not None:
        storage.require_writable(place)
    if args.check:
        simulator()
    motor: Any = physics(
        data,
        structure="joint" if of_joint else (args.structure or "dcmotor").split(","),
        current=args.current,
        volts=args.volts,
        speed_unit=args.speed_unit,
        intervals=args.intervals,
    )
    gains = None if args.bandwidth is None else motor.inner_gains(args.bandwidth)
    own = {"inertia": args.inertia} if of_joint else {"winding": args.winding, "gear": args.gear}
    text = "" if target is None else motor.export(target, **own)
    if args.out is not None:
        motor.save(args.out)
    if text:
        storage.replace(place, text)
    replay = motor.check(data, inertia=args.inertia) if args.check else None
    if args.model is not None:
        motor.to_model().save(args.model)
    if args.plot is not None:
        motor.plot(file=args.plot)
    if args.json:
        shown = {} if replay is None else {"check": asdict(replay)}
        shown |= {} if gains is None else {"inner_gains": gains.to_dict()}
        notes = [*data.notes, *(f.warning for f in found)]
        print_json({**motor.to_dict(), **shown, "notes": notes})
        return
    print(motor)
    for told in (replay, gains):
        if told is not None:
            print(told)
    for path in (args.out, place, args.model, args.plot):
        if path:
            print(f"written to {path}")


def _joints(args: argparse.Namespace) -> dict[str, Dataset]:
    """All joints of a robot's records, unless a column or one of them is named."""
    from ..readers import joint_columns, parse_source, read_joints, read_table

    named = args.input or args.output or args.counts or args.joint or args.speed_unit
    sources = [parse_source(source) for source in args.data]
    if named or any(inputs or output for _, inputs, output in sources):
        return {}
    tables = [read_table(path) for path, _, _ in sources]
    if len(joint_columns(tables[0])) < 2:
        return {}
    joints = read_joints(tables, unit=args.unit or "", Ts=args.ts)
    return {name: data.shift_inputs(args.shift_input) for name, data in joints.items()}


def _motor_data(args: argparse.Namespace) -> Dataset:
    """The records, with differences of counts as speed: smoothing hides the effect of friction."""
    from ..commissioning import unsmoothed
    from ..dataset import Dataset
    from .data import read_training

    sources, found = args.data, []
    for source in sources:
        args.data = [source]
        data = read_training(args, channels=() if args.current is None else (args.current,))
        whole = data.counts is not None and len(data.experiments) == 1
        found.append(unsmoothed(source, data) if whole else data)
    args.data = sources
    return Dataset.concat(found)
