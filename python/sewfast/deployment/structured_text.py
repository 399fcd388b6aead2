"""IEC 61131-3 structured text of a controller: one function block, in the arithmetic of the C."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from .. import __version__
from ..control import Controller
from ..errors import SettingError
from ..models import Model
from .precision import controller_step


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
    return {f"{name}.st": block}, [note, *loss]


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
    observer = ""
    if n["observes"]:
        observer = f"""
  IF observing THEN
    previous := speed;
  ELSE
    previous := y_filtered;
    innovation := {zero};
  END_IF;
  innovation := {value["keep"]} * innovation + (y_filtered - previous);
  speed := previous + {value["gain"]} * innovation;
  observing := TRUE;
  y_filtered := speed;
"""
    declared, of_y, of_r, forgotten = _biquads(number, n["biquads"])
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
  r : {real}; (* reference, {y} *)
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
  averaging, lagging, observing, ramping, started : BOOL;
  lag, speed, innovation, ramped, referred, integral, derivative, r_last, e_last : {real};
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
  integral := {zero};
  derivative := {zero};
  r_last := {zero};
  e_last := {zero};
  u := {first};
END_IF;

(* a measurement that is no number leaves the command as it was *)
usable := y - y = {zero};
IF usable THEN
  IF NOT averaging THEN
    FOR i := 0 TO {samples - 1} DO
      samples[i] := y;
    END_FOR;
  END_IF;
  averaging := TRUE;
  samples[next_sample] := y;
  next_sample := next_sample + 1;
  IF next_sample >= {samples} THEN
    next_sample := 0;
  END_IF;
  sum := {zero};
  FOR i := 0 TO {samples - 1} DO
    sum := sum + samples[i];
  END_FOR;
  sum := sum / {number(float(samples))};
  previous := sum;
  IF lagging THEN
    previous := lag;
  END_IF;
  lag := previous + {value["lag"]} * (sum - previous);
  lagging := TRUE;
  y_filtered := lag;
{observer}
  usable := y_filtered - y_filtered = {zero};
  IF NOT usable THEN
    averaging := FALSE;
    next_sample := 0;
    lagging := FALSE;
    observing := FALSE;
  END_IF;
END_IF;
{of_y}
IF usable THEN
  IF NOT ramping THEN
    ramped := y_filtered;
  END_IF;
  ramping := TRUE;
  low := ramped - {value["ramp"]};
  high := ramped + {value["ramp"]};
  ramped := r;
  IF ramped < low THEN
    ramped := low;
  END_IF;
  IF ramped > high THEN
    ramped := high;
  END_IF;
  referred := ramped;
{of_r}{_gains(number, n)}
  e := referred - y_filtered;
  rate_input := e - {value["beta"]} * referred;
  change := {zero};
  IF started THEN
    change := rate_input - (e_last - {value["beta"]} * r_last);
  END_IF;
  derivative_now := pole * derivative + kd * change;
  integral_now := integral + ki * e;
  proportional := kp * (e - {value["alpha"]} * referred);
  wanted := proportional + integral_now + derivative_now + feedforward;
  usable := wanted - wanted = {zero};
END_IF;

IF usable OR manual THEN
  low := u - {value["change"]};
  high := u + {value["change"]};
  previous := u;
  IF manual THEN
    u := u_manual;
  ELSE
    u := wanted;
  END_IF;
  IF u < {value["u_min"]} THEN
    u := {value["u_min"]};
  END_IF;
  IF u > {value["u_max"]} THEN
    u := {value["u_max"]};
  END_IF;
  IF u < low THEN
    u := low;
  END_IF;
  IF u > high THEN
    u := high;
  END_IF;
  IF NOT (u - u = {zero}) THEN
    u := previous;
  END_IF;
  IF usable THEN
    IF manual THEN
      integral := u - proportional - derivative_now - feedforward;
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
