"""The grey box: a motor's equations, and a small network for the rest."""

from __future__ import annotations

import math
from typing import Any, ClassVar

import numpy as np

from .. import _core
from ..dataset import FloatArray
from ..storage import Fields
from .base import SingleModel

NAMES = tuple(_core.GREYBOX_PARAMETERS)
JOINT = tuple(_core.GREYBOX_JOINT)
WEIGHTS = ("b", "p", "q", "c")
MOST_UNITS: int = _core.GREYBOX_UNITS


class GreyBox(SingleModel):
    """A DC motor with dry friction and the dead zone of its inverter, and a network for the rest.

    The speed follows the command as in docs/physics.md, all in units of the command; loads that
    repeat over a turn are left out, since a speed does not show where a turn begins. The network's
    output is one more load: ``sum c tanh(b + p w + q x)``, of speed w and drive x in units of
    their scales.

    If the output is a position, this is a joint (docs/joints.md): gravity may pull at it, its gears
    may rub more under load, and `u` may be a position command to a controller of its own, whose
    gain is then the unit of all forces.

    References
    ----------
    docs/physics.md, docs/CONVENTIONS.md, Models.
    """

    kind: ClassVar[str] = "grey_box"
    title: ClassVar[str] = "Grey box"
    core: _core.GreyBox

    @property
    def settings(self) -> dict[str, Any]:
        """Everything except `theta`."""
        return self.core.settings

    @property
    def orders(self) -> dict[str, int]:
        settings = self.settings
        return {k: settings[k] for k in ("nx", "nk", "hidden")}

    @property
    def theta(self) -> FloatArray:
        """`[free parameters of the motor, (b, p, q, c) of each unit]`, shape (p,)."""
        return self.core.theta

    @property
    def parameter_names(self) -> tuple[str, ...]:
        """`k_e`, `k_a`, .. and `b[i]`, `p[i]`, `q[i]`, `c[i]`."""
        s = self.settings
        units = (f"{w}[{i}]" for i in range(s["hidden"]) for w in WEIGHTS)
        return (*((*NAMES, *JOINT)[j] for j in s["free"]), *units)

    @property
    def state_names(self) -> tuple[str, ...]:
        """Speed, drive and the previous command in units of their scales, and the position; with a
        limit of the setpoint's rate or play the setpoint, and position and speed of the load."""
        of_motor = ("speed", "drive", "command before", "position")
        of_load = ("setpoint", "load position", "load speed")
        return (*of_motor, *of_load)[: self.settings["nx"]]

    @property
    def motor(self) -> dict[str, float]:
        """The motor's parameters by name (docs/physics.md), per rad/s and in commands."""
        return dict(zip(NAMES, self.settings["values"].tolist(), strict=True))

    @property
    def joint(self) -> dict[str, float]:
        """The parameters of a joint by name (docs/joints.md); all 0 for a motor's speed."""
        return dict(zip(JOINT, self.settings["joint"], strict=True))

    def parameters(self) -> dict[str, Any]:
        s = self.settings
        values = dict(self.motor)
        limit = values.pop("limit")
        return {
            "n_inputs": 1,
            "values": list(values.values()),
            "limit": limit if math.isfinite(limit) else None,
            "free": [(*NAMES, *JOINT)[j] for j in s["free"]],
            **{k: s[k] for k in _NUMBERS},
            "steps": s["steps"],
            "mean": s["mean"],
            "theta": self.core.theta.tolist(),
            # a file of a speed has no field that older versions do not know
            **({"joint": self.joint} if s["position"] else {}),
        }

    def with_output_scaled(self, factor: float) -> dict[str, Any]:
        s = self.settings
        return {
            "unit": s["unit"] / factor,
            "residual_variance": factor**2 * s["residual_variance"],
        }

    def with_input_delayed(self, samples: int) -> dict[str, Any]:
        values = self.parameters()["values"]
        values[NAMES.index("delay")] += samples * self.Ts
        return {"values": values}

    @staticmethod
    def core_from(fields: Fields) -> _core.GreyBox:
        """The compiled model from the parameters of a file."""
        free = fields.items("free")
        known = (*NAMES, *JOINT)
        if not all(name in known for name in free) or len(set(free)) != len(free):
            raise fields.refuse("free", f"names of {', '.join(known)}, each once", free)
        position = "joint" in fields.values
        own = fields.object("joint") if position else None
        limit = fields.optional_number("limit")
        return _core.GreyBox(
            values=_completed(fields.vector("values"), math.inf if limit is None else limit),
            joint=[_own(own, name) for name in JOINT],
            position=position,
            free=[known.index(name) for name in free],
            steps=fields.integer("steps"),
            mean=fields.flag("mean"),
            theta=fields.vector("theta"),
            **{k: fields.number(k) for k in _NUMBERS},
        )

    def describe(self) -> list[str]:
        of, u = self.motor, self.input_units[0] or "command"
        parts = [
            f"k_v {of['k_e'] + of['k_b']:.4g} {u}/(rad/s)",
            f"k_a {of['k_a']:.4g} {u}/(rad/s^2)",
            f"k_s {of['k_s']:.4g} {u}",
        ]
        named = {"tau": ("lag", "s"), "delay": ("delay", "s"), "drop": ("drop", u)}
        named |= {"sag": ("sag", f"1/{u}^2"), "limit": ("limit", u)}
        of = {k: v for k, v in of.items() if math.isfinite(v)} | self.joint
        if self.settings["position"]:
            parts = self._of_joint(u)
            gravity = math.hypot(of["load_1c"], of["load_1s"])
            cogging = math.hypot(of["cogging_c"], of["cogging_s"])
            of |= {"gravity": gravity, "stribeck": of["k_t"], "cogging": cogging}
            of["backlash"] = 2.0 * of["play"] / self.settings["unit"]
            named |= {
                "gravity": ("gravity", u), "stribeck": ("Stribeck friction", u),
                "k_l": ("friction per load", ""), "k_m": ("friction per drive", ""),
                "k_g": ("friction per load from outside", ""), "creep": ("creep", "s"),
                "settling": ("settling of the friction", "s"),
                "dead_band": ("dead band", u), "rate": ("rate of the setpoint", f"{u}/s"),
                "backlash": ("backlash", self.output_unit or "output"), "cogging": ("cogging", u),
                "reach": ("largest output of the controller", u), "damping": ("k_d / k_p", "s"),
            }  # fmt: skip
        parts += [
            f"{text} {of[n]:.3g} {unit}".rstrip() for n, (text, unit) in named.items() if of.get(n)
        ]
        units = self.settings["hidden"]
        network = f"{units} tanh for what they leave" if units else "no network"
        what = "motor"
        if self.settings["position"]:
            inside = "a controller of its own" if self.joint["k_q"] else "a command that drives it"
            what = f"joint with {inside}"
        return [f"{what}: {', '.join(parts)}", network]

    def _of_joint(self, u: str) -> list[str]:
        """Inertia and friction, per unit of the output."""
        of, unit, y = self.motor, self.settings["unit"], self.output_unit or "output"
        return [
            f"inertia {of['k_a'] * unit:.4g} {u}/({y}/s^2)",
            f"viscous {(of['k_e'] + of['k_b']) * unit:.4g} {u}/({y}/s)",
            f"friction {of['k_s']:.4g} {u}",
            f"offset {of['offset']:.3g} {u}",
        ]


def _own(joint: Fields | None, name: str) -> float:
    """A parameter of a joint; 0 for a motor, and for a term that older files do not know."""
    if joint is None or (name in _LATER and name not in joint.values):
        return 0.0
    return joint.number(name)


def _completed(values: FloatArray, limit: float) -> FloatArray:
    """All parameters; older files end before `limit`, without the later terms."""
    at = NAMES.index("limit")
    if len(values) == at:
        values = np.append(values, np.zeros(len(NAMES) - at - 1))
    return np.insert(values, min(at, len(values)), limit)


_LATER = ("k_m", "k_g", "creep", "exponent", "k_mm", *JOINT[JOINT.index("settling") :])
_NUMBERS = (
    "Ts", "unit", "speed_scale", "command_scale", "residual_variance", "process_noise",
)  # fmt: skip
