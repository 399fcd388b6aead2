"""`sewfast gains`: first gains by a tuning rule, in every form, with their margins."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING, Any

from ..errors import SettingError
from .arguments import Commands, add_columns, add_command, add_output, require_place
from .data import read_training
from .output import print_json, print_rows
from .tune import forms_of, gain_row

if TYPE_CHECKING:
    from ..control.controller import Controller
    from ..control.margins import Margins
    from ..rules import Fopdt, Rule


TEXT = """\
First gains for a drive, from a recorded step response or from K, T and L of K e^(-sL)/(1 + sT).

A rule gives gains, alpha and beta. The gains are printed in all three forms, with the margins of
the sampled loop including hold, derivative filter, feedback filter and encoder. The delays of hold,
filter and encoder are added to L before the rule is applied.
"""

EXAMPLES = """\
examples:
  sewfast gains step.csv --input u --output y
  sewfast gains step.mcap --rule amigo -o controller.json
  sewfast gains --K 490 --T 0.25 --L 0.0075 --rule eq-12 --Ms 2
  sewfast gains --K 490 --T 0.25 --L 0.0075 --rule simc --tau-c 0.02 --form per-sample
"""


OPTIONS = """\
data DATA  text?  recording of one step: FILE or FILE:IN:OUT
--rule  {eq-12,table-1,simc,simc-pid,amigo}=eq-12  tuning rule (eq-12)
--Ms MS  float  eq-12: largest allowed sensitivity (2.0); inf: the paper's optimum
--tau-c S  float  simc: time constant of the closed loop [s]
--nearest  flag  table-1: use the end row for L/T outside .1 to 1
--filter N  int=8  moving average over N samples of the feedback (8); 1: none
--N N  float=10.0  the derivative is filtered with Td/N (10); inf: not
--form  {standard,parallel,per-sample}=standard  form of the gains in the controller's
    file (standard)
--u-min U  float=-20.0  least command (-20)
--u-max U  float=20.0  largest command (20)
"""


def add(commands: Commands) -> None:
    parser = add_command(
        commands, "gains", gains_command,
        summary="first gains by a tuning rule, with margins",
        text=TEXT, options=OPTIONS, examples=EXAMPLES,
    )  # fmt: skip
    for name, unit in (("K", "output/command"), ("T", "s"), ("L", "s")):
        parser.add_argument(f"--{name}", type=float, metavar=name, help=f"of the plant [{unit}]")
    add_columns(parser, from_model=False)
    add_output(parser, "CONTROLLER.json", "controller file to write")


def gains_command(args: argparse.Namespace) -> None:
    from ..control.margins import margins

    require_place(args.out, (".json",))
    if args.filter < 1:
        raise SettingError(f"--filter: expected 1 sample or more, received {args.filter}")
    if args.ts is not None and not args.ts > 0.0:
        raise SettingError(f"--ts: expected a sample time above 0 s, received {args.ts:g}")
    fopdt, Ts = _plant(args)
    rule = _rule(args, _delayed(args, fopdt, Ts))
    controller = _controller(args, rule, fopdt, Ts)
    found = margins(controller, fopdt)
    if args.out is not None:
        controller.save(args.out)
    if args.json:
        print_json(_summary(args, fopdt, rule, controller, found))
        return
    _show(args, fopdt, rule, controller, found)


def _plant(args: argparse.Namespace) -> tuple[Fopdt, float]:
    """The first-order model and the sample time."""
    from ..rules import Fopdt, fit_fopdt

    given = [args.K, args.T, args.L]
    if (args.data is None) == (None in given):
        raise SettingError("expected either a recording of a step, or --K, --T and --L")
    if args.data is None:
        # a speed from counts is in RPM; of the others the numbers say nothing
        unit = "RPM" if args.counts_per_rev else ""
        Ts = 0.001 if args.ts is None else args.ts
        return Fopdt(args.K, args.T, args.L, u_unit="", y_unit=unit), Ts
    data = read_training(argparse.Namespace(**{**vars(args), "data": [args.data]}))
    step = data.experiments[0]
    if len(data.experiments) != 1 or step.u.shape[1] != 1:
        raise SettingError("expected one experiment with one input, a step")
    units = {"u_unit": data.input_units[0], "y_unit": data.output_unit}
    return fit_fopdt(step.u[:, 0], step.y, Ts=data.Ts, **units), data.Ts


def _delayed(args: argparse.Namespace, fopdt: Fopdt, Ts: float) -> Fopdt:
    """The plant with the delays of hold, feedback filter and encoder in its dead time."""
    from dataclasses import replace

    samples = 0.5 + (args.filter - 1) / 2 + (0.5 if args.counts_per_rev else 0.0)
    return replace(fopdt, L=fopdt.L + samples * Ts)


def _rule(args: argparse.Namespace, plant: Fopdt) -> Rule:
    from .. import rules

    for option, value, rule in (
        ("--Ms", args.Ms, "eq-12"), ("--tau-c", args.tau_c, "simc"),
        ("--nearest", args.nearest or None, "table-1"),
    ):  # fmt: skip
        if value is not None and not args.rule.startswith(rule):
            raise SettingError(
                name=option, expected=f"the rule {rule}", received=args.rule, remedy="leave it out"
            )
    if args.rule == "eq-12":
        return rules.eq_12(plant, Ms=2.0 if args.Ms is None else args.Ms)
    if args.rule == "table-1":
        return rules.table_1(plant, outside="nearest" if args.nearest else "error")
    if args.rule == "amigo":
        return rules.amigo(plant)
    return rules.simc(plant, tau_c=args.tau_c, kind="PI" if args.rule == "simc" else "PID")


def _controller(args: argparse.Namespace, rule: Rule, fopdt: Fopdt, Ts: float) -> Controller:
    from ..control.controller import Controller

    form = args.form.replace("-", "_")
    return Controller(
        gains=rule.gains.to(form, Ts=Ts),
        Ts=Ts,
        alpha=rule.alpha,
        beta=rule.beta,
        N=args.N,
        u_min=args.u_min,
        u_max=args.u_max,
        filter_samples=args.filter,
        counts_per_rev=args.counts_per_rev,
        notes=f"{rule.name} from K {fopdt.K:.6g}, T {fopdt.T:.6g} s, L {fopdt.L:.6g} s"
        + (f"; {fopdt.warning}" if fopdt.warning else ""),
    )


def _summary(
    args: argparse.Namespace, fopdt: Fopdt, rule: Rule, controller: Controller, found: Margins
) -> dict[str, Any]:
    names = (
        "K", "T", "L", "K_se", "T_se", "L_se", "offset", "fit_percent", "limited", "moving",
        "overshoot_percent",
    )  # fmt: skip
    return {
        "file": None if args.out is None else str(args.out),
        "plant": {name: getattr(fopdt, name) for name in names},
        "warnings": [fopdt.warning] if fopdt.warning else [],
        "rule": {"name": rule.name, "alpha": rule.alpha, "beta": rule.beta, **rule.costs},
        "gains": {g.form: {**g.to_dict(), "units": g.units} for g in forms_of(controller)},
        "margins": found.to_dict(),
        "controller": controller.to_dict(),
    }


def _show(
    args: argparse.Namespace, fopdt: Fopdt, rule: Rule, controller: Controller, found: Margins
) -> None:
    print(f"plant    {fopdt}")
    print(f"rule     {rule.name}: alpha {rule.alpha:.4g}, beta {rule.beta:.4g}")
    print("gains")
    print_rows([gain_row(g) for g in forms_of(controller)])
    print("margins")
    print("\n".join(f"  {line}" for line in str(found).splitlines()))
    if args.out is not None:
        print(f"written to {args.out}; a controller that was tuned on a model follows the machine "
              "better: sewfast tune")  # fmt: skip
