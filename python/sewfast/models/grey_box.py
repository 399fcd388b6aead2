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
WEIGHTS = ("b", "p", "q", "c")
MOST_UNITS: int = _core.GREYBOX_UNITS


class GreyBox(SingleModel):
    """A DC motor with dry friction and the dead zone of its inverter, and a network for the rest.

    The speed follows the command as in docs/physics.md, all in units of the command; loads that
    repeat over a turn are left out, since a speed does not show where a turn begins. The network's
    output is one more load: ``sum c tanh(b + p w + q x)``, of speed w and drive x in units of
    their scales.

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
        return (*(NAMES[j] for j in s["free"]), *units)

    @property
    def state_names(self) -> tuple[str, ...]:
        """Speed, drive and the previous command, in units of their scales."""
        return ("speed", "drive", "command before")

    @property
    def motor(self) -> dict[str, float]:
        """The motor's parameters by name (docs/physics.md), per rad/s and in commands."""
        return dict(zip(NAMES, self.settings["values"].tolist(), strict=True))

    def parameters(self) -> dict[str, Any]:
        s = self.settings
        values = dict(self.motor)
        limit = values.pop("limit")
        return {
            "n_inputs": 1,
            "values": list(values.values()),
            "limit": limit if math.isfinite(limit) else None,
            "free": [NAMES[j] for j in s["free"]],
            **{k: s[k] for k in _NUMBERS},
            "steps": s["steps"],
            "mean": s["mean"],
            "theta": self.core.theta.tolist(),
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
        if not all(name in NAMES for name in free) or len(set(free)) != len(free):
            raise fields.refuse("free", f"names of {', '.join(NAMES)}, each once", free)
        limit = fields.optional_number("limit")
        return _core.GreyBox(
            values=_completed(fields.vector("values"), math.inf if limit is None else limit),
            free=[NAMES.index(name) for name in free],
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
        named |= {"sag": ("sag", f"1/{u}^2")}
        parts += [f"{text} {of[n]:.3g} {unit}" for n, (text, unit) in named.items() if of[n]]
        units = self.settings["hidden"]
        network = f"{units} tanh for what they leave" if units else "no network"
        return [f"motor: {', '.join(parts)}", network]


def _completed(values: FloatArray, limit: float) -> FloatArray:
    """All parameters; older files end before `limit`, without the later terms."""
    at = NAMES.index("limit")
    if len(values) == at:
        values = np.append(values, np.zeros(len(NAMES) - at - 1))
    return np.insert(values, min(at, len(values)), limit)


_NUMBERS = (
    "Ts", "unit", "speed_scale", "command_scale", "residual_variance", "process_noise",
)  # fmt: skip
