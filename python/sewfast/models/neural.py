"""The network output-error model."""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np

from .. import _core
from ..dataset import FloatArray
from .base import Model
from .fields import Fields, entries


class NeuralOE(Model):
    """One hidden layer of tanh on the lagged regressor, trained in free run (paper Eq. 2 to 4)."""

    kind: ClassVar[str] = "neural_oe"
    title: ClassVar[str] = "Network output error"
    core: _core.NeuralOE

    @property
    def settings(self) -> dict[str, Any]:
        """Orders, scaling and output limits, as JSON values."""
        return {k: v.tolist() if isinstance(v, np.ndarray) else v for k, v in self._raw.items()}

    @property
    def _raw(self) -> dict[str, object]:
        return self.core.settings

    @property
    def orders(self) -> dict[str, int]:
        settings = self.settings
        return {k: settings[k] for k in ("na", "nb", "nk", "hidden")}

    @property
    def theta(self) -> FloatArray:
        """`[W1 row by row, b1, w2, b2, linear]` in scaled units, shape (p,)."""
        return self.core.theta

    @property
    def parameter_names(self) -> tuple[str, ...]:
        """`W1[i,j]`, `b1[i]`, `w2[i]`, `b2` and, with a bypass, `linear[j]`."""
        s = self.settings
        hidden, width = s["hidden"], s["na"] + s["nb"] * s["n_inputs"]
        shapes = {"W1": (hidden, width), "b1": (hidden,), "w2": (hidden,), "b2": ()}
        return entries(shapes | ({"linear": (width,)} if s["bypass"] else {}))

    def parameters(self) -> dict[str, Any]:
        return {**self.settings, "theta": self.core.theta.tolist()}

    @staticmethod
    def core_from(fields: Fields) -> _core.NeuralOE:
        """The compiled model from the parameters of a file."""
        return _core.NeuralOE(
            na=fields.integer("na"),
            nb=fields.integer("nb"),
            nk=fields.integer("nk"),
            n_inputs=fields.integer("n_inputs"),
            hidden=fields.integer("hidden"),
            bypass=fields.flag("bypass"),
            theta=fields.vector("theta"),
            u_mean=fields.vector("u_mean"),
            u_scale=fields.vector("u_scale"),
            y_mean=fields.number("y_mean"),
            y_scale=fields.number("y_scale"),
            output_low=fields.optional_number("output_low"),
            output_high=fields.optional_number("output_high"),
        )

    def describe(self) -> list[str]:
        s = self.settings
        kind = "with a linear bypass" if s["bypass"] else "without a linear bypass"
        lines = [f"{s['hidden']} tanh, {len(self.core.theta)} parameters, {kind}"]
        if s["output_low"] is not None:
            low, high = (s[k] * s["y_scale"] + s["y_mean"] for k in ("output_low", "output_high"))
            lines.append(
                f"output saturates at {low:.6g} and {high:.6g} {self.output_unit}".rstrip()
            )
        return lines
