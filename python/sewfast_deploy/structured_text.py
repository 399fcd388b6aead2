"""IEC 61131-3 structured text of a controller: one function block, in the arithmetic of the C."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np

from sewfast import __version__
from sewfast.control import Controller
from sewfast.errors import SettingError
from sewfast.models import Model

from .precision import controller_step, early, lead_of


def files(what: Model | Controller, name: str, precision: str) -> tuple[dict[str, str], list[str]]:
    """The function block by its file name, and notes on it."""
    if not isinstance(what, Controller):
        raise SettingError(
            name="to", expected="a controller for structured text", received="a model",
            remedy="deploy models to c99",
        )  # fmt: skip
    core, loss = controller_step(what, precision)
    block = _block(what, name, _Type("REAL" if precision == "f32" else "LREAL"), core.numbers)
    note = f"PID as structured text: FUNCTION_BLOCK {name.upper()}, call it every {what.Ts:g} s"
    return {f"{name}.st": block}, [note, *loss, *early(core.numbers)]


class _Type:
    """`REAL` or `LREAL`, and how its numbers are written."""

    def __init__(self, name: str) -> None:
        self.name = name

    def __call__(self, value: float) -> str:
        single = self.name == "REAL"
        if math.isinf(value):
            value = math.copysign(3.40282347e38 if single else 1.7976931348623157e308, value)
        text = str(np.float32(value)) if single else repr(float(value))
        mantissa, _, exponent = text.partition("e")
        mantissa = mantissa if "." in mantissa else f"{mantissa}.0"
        return f"{self.name}#{mantissa}" + (f"E{exponent}" if exponent else "")


def _block(controller: Controller, name: str, number: _Type, n: Mapping[str, Any]) -> str:
    real, zero = number.name, number(0.0)
    u, y = controller.gains.u_unit or "u", controller.gains.y_unit or "y"
    about = "\n".join(
        f"   {line}" for line in re.sub(r"\(\*|\*\)", "*", str(controller)).splitlines()
    )
    value = {k: number(n[k]) for k in _NUMBERS}
    samples = n["samples"]
    first = number(min(max(0.0, n["u_min"]), n["u_max"]))
    declared, of_y, of_r, forgotten = _biquads(number, n["biquads"])
    ahead = _ahead(number, n)
    added = "added" if ahead else "feedforward"
    around = _around("u", number, n["change"])
    way = _ramp(number, n["ramp"])
    if ahead:
        declared += ahead.declared
        forgotten += "  ahead := FALSE;\n"
        way = f"{way}{ahead.way}END_IF;\nIF usable THEN\n"
    preview = n["feedforward"][0]
    early_by = f", {preview} samples early" if ahead and preview else ""
    if n["tracks"]:
        windup = f"        kept := integral_now + {value['tracking']} * excess;"
    else:
        windup = f"""        IF (integral_now - integral) * excess < {zero} THEN
          kept := integral;
        END_IF;"""
    return f"""(* {name}: a two-degree-of-freedom PID controller.
   Written by sewfast {__version__}; change it there.

{about}

   Call it in a task of exactly {controller.Ts:g} s.
   This text may be used under MIT, Apache-2.0 or 0BSD, as you like. *)
FUNCTION_BLOCK {name.upper()}
VAR_INPUT
  r : {real}; (* reference, {y}{early_by} *)
  y : {real}; (* measurement, {y} *)
  feedforward : {real}; (* added to the command before its limits, {u} *)
  manual : BOOL; (* the command is the operator's *)
  u_manual : {real}; (* {u} *)
  restart : BOOL; (* back to rest *)
END_VAR
VAR_OUTPUT
  u : {real} := {first}; (* command, {u} *)
  y_filtered : {real}; (* measurement after its filter, {y} *)
END_VAR
VAR
  samples : ARRAY[0..{samples - 1}] OF {real};
  next_sample, i : INT;
  averaging, lagging, observing, ramping, started, operated : BOOL;
  lag, speed, innovation, ramped, referred, integral, derivative, r_last, e_last : {real};
  operator, y_last : {real};
  sum, previous, e, rate_input, change, derivative_now, integral_now, proportional : {real};
  kp, ki, kd, pole, wanted, excess, kept, low, high, distance, share, weight, td, lag_of_d : {real};
  usable : BOOL;
{declared}END_VAR

IF restart THEN
  averaging := FALSE;
  next_sample := 0;
  lagging := FALSE;
  observing := FALSE;
  ramping := FALSE;
{forgotten}  started := FALSE;
  operated := FALSE;
  integral := {zero};
  derivative := {zero};
  r_last := {zero};
  e_last := {zero};
  y_filtered := {zero};
  u := {first};
END_IF;

(* a command of the operator that is no number is not taken *)
operated := operated AND manual;
IF manual AND (u_manual - u_manual = {zero}) THEN
  operated := TRUE;
  operator := u_manual;
END_IF;

(* a measurement that is no number leaves the command as it was *)
y_last := y_filtered;
usable := y - y = {zero};
IF usable THEN
{_filter(number, n, "y", "y_filtered", "")}  usable := y_filtered - y_filtered = {zero};
  IF NOT usable THEN
    averaging := FALSE;
    next_sample := 0;
    lagging := FALSE;
    observing := FALSE;
  END_IF;
END_IF;
{of_y}IF NOT usable THEN
  y_filtered := y_last;
END_IF;

IF {"usable OR ahead" if ahead else "usable"} THEN
{way}{of_r}{_gains(number, n)}
  e := referred - y_filtered;
  rate_input := e - {value["beta"]} * referred;
  change := {zero};
  IF started THEN
    change := rate_input - (e_last - {value["beta"]} * r_last);
  END_IF;
  derivative_now := pole * derivative + kd * change;
  integral_now := integral + ki * e;
  proportional := kp * (e - {value["alpha"]} * referred);
  wanted := proportional + integral_now + derivative_now + {added};
  usable := (wanted - wanted = {zero}) AND (rate_input - rate_input = {zero});
  IF NOT usable AND (rate_input - rate_input = {zero}) AND ({added} - {added} = {zero}) THEN
    (* the memory is to blame: begin again at this sample *)
    r_last := referred;
    e_last := e;
    started := TRUE;
    derivative := {zero};
    IF NOT (integral - integral = {zero}) THEN
      integral := u;
    END_IF;
  END_IF;
END_IF;

IF usable OR operated THEN
{around}  previous := u;
  IF operated THEN
    u := operator;
  ELSE
    u := wanted;
  END_IF;
  IF u < {value["u_min"]} THEN
    u := {value["u_min"]};
  END_IF;
  IF u > {value["u_max"]} THEN
    u := {value["u_max"]};
  END_IF;
{_within("u") if around else ""}  IF NOT (u - u = {zero}) THEN
    u := previous;
  END_IF;
  IF usable THEN
    IF operated THEN
      integral := u - proportional - derivative_now - {added};
    ELSE
      excess := u - wanted;
      kept := integral_now;
      IF NOT (excess = {zero}) AND NOT (ki = {zero}) THEN
{windup}
      END_IF;
      integral := kept;
    END_IF;
    derivative := derivative_now;
    r_last := referred;
    e_last := e;
    started := TRUE;
  ELSE
    integral := integral + (u - previous);
  END_IF;
END_IF;
END_FUNCTION_BLOCK
"""


_NUMBERS = (
    "kp", "ki", "kd", "pole", "tracking", "lag", "keep", "gain", "ramp", "change", "alpha", "beta",
    "u_min", "u_max", "ts",
)  # fmt: skip


def _filter(number: _Type, n: Mapping[str, Any], taken: str, given: str, of: str) -> str:
    """Statements from a measurement to the filtered one; the names in its memory end with `of`."""
    lines = [
        f"IF NOT averaging{of} THEN",
        f"  FOR i := 0 TO {n['samples'] - 1} DO",
        f"    samples{of}[i] := {taken};",
        "  END_FOR;",
        "END_IF;",
        f"averaging{of} := TRUE;",
        f"samples{of}[next_sample{of}] := {taken};",
        f"next_sample{of} := next_sample{of} + 1;",
        f"IF next_sample{of} >= {n['samples']} THEN",
        f"  next_sample{of} := 0;",
        "END_IF;",
        f"sum := {number(0.0)};",
        f"FOR i := 0 TO {n['samples'] - 1} DO",
        f"  sum := sum + samples{of}[i];",
        "END_FOR;",
        f"sum := sum / {number(float(n['samples']))};",
        "previous := sum;",
        f"IF lagging{of} THEN",
        f"  previous := lag{of};",
        "END_IF;",
        f"lag{of} := previous + {number(n['lag'])} * (sum - previous);",
        f"lagging{of} := TRUE;",
        f"{given} := lag{of};",
    ]
    if n["observes"]:
        lines += [
            f"IF observing{of} THEN",
            f"  previous := speed{of};",
            "ELSE",
            f"  previous := {given};",
            f"  innovation{of} := {number(0.0)};",
            "END_IF;",
            f"innovation{of} := {number(n['keep'])} * innovation{of} + ({given} - previous);",
            f"speed{of} := previous + {number(n['gain'])} * innovation{of};",
            f"observing{of} := TRUE;",
            f"{given} := speed{of};",
        ]
    return "".join(f"  {line}\n" for line in lines)


def _ramp(number: _Type, change: float) -> str:
    """Statements from `r` to `referred`; a reference that is no number passes without effect."""
    bounds = _around("ramped", number, change)
    lines = [
        "referred := r;",
        f"IF r - r = {number(0.0)} THEN",
        "  IF NOT ramping THEN",
        "    ramped := y_filtered;",
        "  END_IF;",
        "  ramping := TRUE;",
        *bounds.splitlines(),
        "  ramped := r;",
        *(_within("ramped").splitlines() if bounds else ()),
        "  referred := ramped;",
        "END_IF;",
    ]
    return "".join(f"  {line}\n" for line in lines)


def _around(name: str, number: _Type, change: float) -> str:
    """Statements that set low and high around a value; none for an infinite change."""
    if math.isinf(change):
        return ""
    return f"  low := {name} - {number(change)};\n  high := {name} + {number(change)};\n"


def _within(name: str) -> str:
    """Statements that keep a value between low and high."""
    return "".join(
        f"  IF {name} {sign} {bound} THEN\n    {name} := {bound};\n  END_IF;\n"
        for sign, bound in (("<", "low"), (">", "high"))
    )


@dataclass(frozen=True)
class _Ahead:
    """A feedforward: its variables, and its statements after the ramp."""

    declared: str
    way: str


def _ahead(number: _Type, n: Mapping[str, Any]) -> _Ahead | None:
    """The feedforward of a controller; None where there is none."""
    lead = lead_of(n)
    if lead is None:
        return None
    real, zero, last, samples = number.name, number(0.0), lead.kept - 1, n["samples"]
    declared = f"""  known : ARRAY[0..{last}] OF {real}; (* references, the newest first *)
  samples_r : ARRAY[0..{samples - 1}] OF {real};
  next_sample_r : INT;
  averaging_r, lagging_r, observing_r, ahead : BOOL;
  lag_r, speed_r, innovation_r, added, own, held, expected : {real};
"""
    way = [
        f"IF NOT (referred - referred = {zero}) AND ahead THEN",
        "  referred := known[0];",
        "END_IF;",
        f"IF referred - referred = {zero} THEN",
        "  IF NOT ahead THEN",
        f"    FOR i := 0 TO {last} DO",
        "      known[i] := referred;",
        "    END_FOR;",
        *(f"    {line}" for line in _FORGET_R),
        "  END_IF;",
        f"  FOR i := 1 TO {last} DO",
        f"    known[{lead.kept} - i] := known[{last} - i];",
        "  END_FOR;",
        "  known[0] := referred;",
        "  ahead := TRUE;",
        "END_IF;",
        "added := feedforward;",
        "IF ahead THEN",
        f"  own := {zero};",
    ]
    for age, tap in enumerate(lead.taps):
        way.append(f"  own := own + {number(tap)} * (known[{age}] - known[{age + 1}]);")
    if lead.levels:
        way += [f"  {line}" for line in _held(number, lead.levels)]
    late, p = number(lead.late), lead.preview
    way += [
        "  added := feedforward + own;",
        f"  expected := known[{p}] + {late} * (known[{p + 1}] - known[{p}]);",
    ]
    body = "".join(f"  {line}\n" for line in way)
    filtered = _filter(number, n, "expected", "referred", "_r").splitlines()
    body += "".join(f"  {line}\n" for line in filtered)
    rest = [f"  IF NOT (referred - referred = {zero}) THEN", *(f"    {x}" for x in _FORGET_R)]
    body += "".join(f"  {line}\n" for line in [*rest, "  END_IF;", "END_IF;"])
    return _Ahead(declared, body)


_FORGET_R = (
    "averaging_r := FALSE;", "next_sample_r := 0;", "lagging_r := FALSE;", "observing_r := FALSE;",
)  # fmt: skip


def _held(number: _Type, levels: Sequence[Sequence[float]]) -> list[str]:
    """Statements that add the command which holds the newest reference to `own`."""
    pairs = list(pairwise(levels)) or [(levels[0], levels[0])]
    lines = []
    for i, ((y, u), (next_y, next_u)) in enumerate(pairs):
        apart = f"({number(next_y)} - {number(y)})" if next_y > y else number(1.0)
        rise = f"({number(next_u)} - {number(u)})"
        held = f"held := {number(u)} + (known[0] - {number(y)}) * {rise} / {apart};"
        lines += [f"IF known[0] >= {number(y)} THEN", f"  {held}", "END_IF;"] if i else [held]
    return [*lines, "own := held + own;"]


def _biquads(number: _Type, sections: Sequence[Sequence[float]]) -> tuple[str, str, str, str]:
    """Declarations, statements that filter the feedback and the reference, and their restart."""
    if not sections:
        return "", "", "", ""
    zero, count = number(0.0), len(sections)
    memory = ", ".join(f"{name}_{of}" for of in "yr" for name in ("x", "s1", "s2"))
    declared = (
        f"  {memory} : ARRAY[0..{count - 1}] OF {number.name};\n"
        f"  delta, d : {number.name};\n  y_begun, r_begun : BOOL;\n"
    )

    def through(signal: str, of: str) -> list[str]:
        lines = [
            f"  IF NOT {of}_begun THEN",
            f"    FOR i := 0 TO {count - 1} DO",
            f"      x_{of}[i] := y_filtered;",
            f"      s1_{of}[i] := {zero};",
            f"      s2_{of}[i] := {zero};",
            "    END_FOR;",
            "  END_IF;",
        ]
        for k, (c0, c1, a1, a2) in enumerate(sections):
            lines += [
                f"  delta := {signal} - x_{of}[{k}];",
                f"  d := {number(c0)} * delta + s1_{of}[{k}];",
                f"  x_{of}[{k}] := {signal};",
                f"  s1_{of}[{k}] := {number(c1)} * delta - {number(a1)} * d + s2_{of}[{k}];",
                f"  s2_{of}[{k}] := -({number(a2)} * d);",
                f"  {signal} := {signal} + d;",
            ]
        return [*lines, f"  {of}_begun := {signal} - {signal} = {zero};"]

    of_y = ["IF usable THEN", *through("y_filtered", "y"), "  usable := y_begun;", "END_IF;"]
    within = [f"  {line}" for line in through("referred", "r")]
    of_r = [f"  IF referred - referred = {zero} THEN", *within, "  END_IF;"]
    forgotten = "  y_begun := FALSE;\n  r_begun := FALSE;\n"
    return declared, "\n".join([*of_y, ""]), "\n".join([*of_r, ""]), forgotten


def _gains(number: _Type, n: Mapping[str, Any]) -> str:
    """Statements that set kp, ki, kd and pole of this sample."""
    rows = n["rows"]
    if not rows:
        return "".join(f"  {k} := {number(n[k])};\n" for k in ("kp", "ki", "kd", "pole"))
    used = rows[: next(i for i, row in enumerate(rows) if row[4] == 0.0) + 1]
    zero, one = number(0.0), number(1.0)
    lines = [
        "  distance := y_filtered;",
        f"  IF distance < {zero} THEN",
        "    distance := -distance;",
        "  END_IF;",
    ]
    for i, (speed, kp, ki, td, inverse) in enumerate(used):
        _, next_kp, next_ki, next_td, _ = used[min(i + 1, len(used) - 1)]
        word = "IF" if i == 0 else "END_IF;\n  IF"
        condition = "TRUE" if i == 0 else f"distance >= {number(speed)}"
        lines += [
            f"  {word} {condition} THEN",
            f"    share := (distance - {number(speed)}) * {number(inverse)};",
            f"    IF share < {zero} THEN",
            f"      share := {zero};",
            "    END_IF;",
            f"    IF share > {one} THEN",
            f"      share := {one};",
            "    END_IF;",
            f"    kp := {number(kp)} + share * ({number(next_kp)} - {number(kp)});",
            f"    ki := {number(ki)} + share * ({number(next_ki)} - {number(ki)});",
            f"    weight := {zero};",
            f"    IF NOT (kp = {zero}) THEN",
            f"      weight := share * {number(next_kp)} / kp;",
            "    END_IF;",
            f"    td := {number(td)} + weight * ({number(next_td)} - {number(td)});",
        ]
    share = zero if math.isinf(n["n"]) else f"td / {number(n['n'])}"
    ts = number(n["ts"])
    lines += [
        "  END_IF;",
        f"  lag_of_d := {share};",
        f"  kd := kp * td / (lag_of_d + {ts});",
        f"  pole := lag_of_d / (lag_of_d + {ts});",
    ]
    return "\n".join(lines) + "\n"
