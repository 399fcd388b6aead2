"""The networks: output error with lagged regressors, and state space."""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np

from .. import _core
from ..dataset import Dataset, FloatArray
from ..dynamic_model import INIT
from ..storage import Fields, entries
from .base import SingleModel


class _Network(SingleModel):
    """Common to both networks: settings, parameters and scales of the compiled model."""

    core: _core.NeuralOE | _core.NeuralSS

    @property
    def settings(self) -> dict[str, Any]:
        """Sizes, scaling and all other settings except `theta`, as JSON values."""
        raw = self.core.settings
        return {k: v.tolist() if isinstance(v, np.ndarray) else v for k, v in raw.items()}

    def parameters(self) -> dict[str, Any]:
        return {**self.settings, "theta": self.core.theta.tolist()}

    def with_output_scaled(self, factor: float) -> dict[str, Any]:
        scales = self.settings
        return {k: (factor * np.asarray(scales[k])).tolist() for k in ("y_mean", "y_scale")}

    def with_zero_at(self, u: FloatArray, y: float) -> dict[str, Any] | None:
        s = self.settings
        # an output without sign has its own zero
        if y != 0.0 and s.get("output") == "abs":
            return None
        moved = {"u_mean": np.asarray(s["u_mean"]) - u, "y_mean": np.asarray(s["y_mean"]) - y}
        return {name: values.tolist() for name, values in moved.items()}


# --- The network output-error model ---------------------------------------------------------------


class NeuralOE(_Network):
    """One hidden layer of tanh on the lagged regressor, trained in free run (paper Eq. 2 to 4)."""

    kind: ClassVar[str] = "neural_oe"
    title: ClassVar[str] = "Network output error"
    core: _core.NeuralOE

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

    @staticmethod
    def core_from(fields: Fields) -> _core.NeuralOE:
        """The compiled model from the parameters of a file."""
        return _core.NeuralOE(
            **fields.take(
                integer="na nb nk n_inputs hidden", flag="bypass", vector="theta u_mean u_scale",
                number="y_mean y_scale", optional_number="output_low output_high",
            )
        )  # fmt: skip

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


# --- The neural state-space model -----------------------------------------------------------------


OUTPUTS = ("linear", "saturation", "abs")


class NeuralSS(_Network):
    """Linear state equations plus one hidden layer of tanh, trained in free run.

    Its states have no units: they are scaled to unit size on the training data.

    References
    ----------
    M. Schoukens, *Improved Initialization of State-Space Artificial Neural Networks*, 2021,
    arXiv 2103.14516; docs/CONVENTIONS.md, State space.
    """

    kind: ClassVar[str] = "neural_ss"
    title: ClassVar[str] = "Neural state space"
    core: _core.NeuralSS

    @property
    def orders(self) -> dict[str, int]:
        settings = self.settings
        return {k: settings[k] for k in ("nx", "nk", "hidden")}

    @property
    def theta(self) -> FloatArray:
        """`[A, B, E, Wx, Wu, bh, C, D, c, G]`, row by row, in scaled units, shape (p,)."""
        return self.core.theta

    @property
    def parameter_names(self) -> tuple[str, ...]:
        """`A[i,j]` and so on, in the order of `theta`."""
        s = self.settings
        nx, nu, hidden = s["nx"], s["n_inputs"], s["hidden"]
        return entries(
            {
                "A": (nx, nx), "B": (nx, nu), "E": (nx, hidden), "Wx": (hidden, nx),
                "Wu": (hidden, nu), "bh": (hidden,), "C": (1, nx), "D": (1, nu), "c": (1,),
                "G": (1, hidden),
            }
        )  # fmt: skip

    def states(self, data: Dataset, *, init: int = INIT) -> list[FloatArray]:
        """States of the free run.

        Parameters
        ----------
        data : Dataset
        init : int
            As for `simulate`.

        Returns
        -------
        list of array, shape (N, nx)
            One per experiment, in scaled units.

        Raises
        ------
        DataError, FitError
            As for `simulate`.
        """
        self._require_match(data)
        data.require_inputs()
        return [self.core.states(e.u, self.initial_state(e, init)) for e in data.experiments]

    @staticmethod
    def core_from(fields: Fields) -> _core.NeuralSS:
        """The compiled model from the parameters of a file."""
        output = fields.text("output")
        if output not in OUTPUTS:
            raise fields.refuse("output", f"one of {', '.join(OUTPUTS)}", output)
        if fields.integer("n_outputs") != 1:
            raise fields.refuse("n_outputs", "1, as a data set has", fields.any("n_outputs"))
        return _core.NeuralSS(
            **fields.take(
                integer="nx nk n_inputs n_outputs hidden", flag="integrator", text="output",
                vector="output_parameters theta u_mean u_scale y_mean y_scale state_mean "
                "residual_variance", matrix="state_covariance", number="process_noise",
            )
        )  # fmt: skip

    def describe(self) -> list[str]:
        s = self.settings
        last = ", the last one an integrator" if s["integrator"] else ""
        states = "1 state" if s["nx"] == 1 else f"{s['nx']} states"
        lines = [f"{states}{last}, {s['hidden']} tanh, {len(self.core.theta)} parameters"]
        return lines + self._describe_output(s)

    def _describe_output(self, s: dict[str, Any]) -> list[str]:
        values = [p * s["y_scale"][0] for p in s["output_parameters"]]
        mean = s["y_mean"][0]
        if s["output"] == "saturation":
            low, high = values[0] + mean, values[1] + mean
            text = f"output saturates softly at {low:.6g} and {high:.6g} {self.output_unit}"
        elif s["output"] == "abs":
            text = f"output without sign, with a corner of {values[0]:.6g} {self.output_unit}"
        else:
            return []
        return [text.rstrip()]
