"""The Hammerstein-Wiener model: linear dynamics between static curves."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar, NamedTuple

import numpy as np

from .. import _core
from ..dataset import FloatArray
from ..storage import Fields
from .base import StructuredModel


class Characteristic(NamedTuple):
    """A static curve through `x` and `y`, knots included, of an input or the output by `name`."""

    name: str
    x: FloatArray
    y: FloatArray


class HammersteinWiener(StructuredModel):
    """u -> f -> linear difference equation -> g -> y, fitted in free run. Each input has a
    piecewise linear curve f over its training range (dead band, saturation, valve), the output a
    strictly increasing g (sensor); each is the identity at the ends of its range, which fixes the
    gain of the linear part. Bai, *An optimal two-stage identification algorithm for
    Hammerstein-Wiener nonlinear systems*, Automatica 34 (1998); docs/CONVENTIONS.md, Models.
    """

    kind: ClassVar[str] = "hammerstein_wiener"
    title: ClassVar[str] = "Hammerstein-Wiener"
    core: _core.HammersteinWiener

    @property
    def settings(self) -> dict[str, Any]:
        """Orders and the ranges of the curves, as JSON values."""
        raw = self.core.settings
        return {k: v.tolist() if isinstance(v, np.ndarray) else v for k, v in raw.items()}

    @property
    def orders(self) -> dict[str, int]:
        settings = self.settings
        return {k: settings[k] for k in ("na", "nb", "nk", "input_pieces", "output_pieces")}

    @property
    def theta(self) -> FloatArray:
        """`[a, b input by input, offset, f input by input, g]`, shape (p,). f is the deviation of
        the curve from the straight line at its inner knots, over the input's range; g are
        logarithms of the slopes of its pieces relative to the first one.
        """
        return self.core.theta

    @property
    def parameter_names(self) -> tuple[str, ...]:
        """`a1 ..`, `b1 ..`, `offset`, `f[1] ..` (of several inputs `... of NAME`), `g[1] ..`."""
        s = self.settings
        of = ["" if len(self.input_names) == 1 else f" of {name}" for name in self.input_names]
        b = [f"b{i + 1}{one}" for one in of for i in range(s["nb"])]
        f = [f"f[{i}]{one}" for one in of for i in range(1, s["input_pieces"])]
        g = [f"g[{i}]" for i in range(1, s["output_pieces"])]
        return (*(f"a{i + 1}" for i in range(s["na"])), *b, "offset", *f, *g)

    def characteristics(self) -> tuple[Characteristic, ...]:
        """The curve of each input, then that of the output, over their training ranges."""
        # points of a drawn curve for each piece
        samples = 5
        s = self.settings
        ends = zip(self.input_names, s["input_low"], s["input_high"], strict=True)
        found = []
        for j, (name, low, high) in enumerate(ends):
            u = np.linspace(low, high, samples * s["input_pieces"] + 1)
            found.append(Characteristic(name, u, self.core.input_curve(j, u)))
        x = np.linspace(s["x_low"], s["x_high"], samples * s["output_pieces"] + 1)
        return (*found, Characteristic(self.output_name, x, self.core.output_curve(x)))

    def parameters(self) -> dict[str, Any]:
        inputs = {"n_inputs": len(self.input_names)}
        return {**self.settings, **inputs, "theta": self.core.theta.tolist()}

    def with_output_scaled(self, factor: float) -> dict[str, Any]:
        s, theta = self.settings, self.core.theta
        end = s["na"] + s["nb"] * len(self.input_names) + 1
        theta[s["na"] : end] *= factor
        ends = {k: factor * s[k] for k in ("x_low", "x_high")}
        return {**ends, "theta": theta.tolist()}

    def with_zero_at(self, u: FloatArray, y: float) -> dict[str, Any]:
        s, theta = self.settings, self.core.theta
        na, end = s["na"], s["na"] + s["nb"] * len(self.input_names)
        push = theta[na:end].reshape(len(self.input_names), -1).sum(axis=1) @ u
        theta[end] += push - (1.0 + theta[:na].sum()) * y
        ends = {k: (s[k] - u).tolist() for k in ("input_low", "input_high")}
        return {**ends, "x_low": s["x_low"] - y, "x_high": s["x_high"] - y, "theta": theta.tolist()}

    @staticmethod
    def core_from(fields: Fields) -> _core.HammersteinWiener:
        """The compiled model from the parameters of a file."""
        low, high = fields.vector("input_low"), fields.vector("input_high")
        if not len(low) == len(high) == fields.integer("n_inputs"):
            raise fields.refuse("n_inputs", "the length of input_low and input_high", len(low))
        return _core.HammersteinWiener(
            input_low=low,
            input_high=high,
            **fields.take(
                integer="na nb nk input_pieces output_pieces", number="x_low x_high", vector="theta"
            ),
        )

    @staticmethod
    def structures(size: int | None) -> tuple[Mapping[str, int], ...]:
        """A curve before the dynamics, one behind them, or both, with `size` pieces each."""
        # pieces of a curve, unless `identify` is given a number
        n = 8 if size is None else size
        pairs = ((n, 1), (1, n), (n, n))
        return tuple({"input_pieces": i, "output_pieces": o} for i, o in pairs)

    @staticmethod
    def fitted(experiments: Any, **settings: Any) -> _core.HammersteinWienerFit:
        return _core.fit_hammerstein_wiener(experiments, **settings)

    def describe(self) -> list[str]:
        lines = []
        for name, x, y in self.characteristics():
            unit = self.output_unit if name == self.output_name else "input's range"
            bend = float(np.abs(y - x).max())
            if name != self.output_name:
                text = f"{100.0 * bend / (x[-1] - x[0]):.3g} % of the {unit}"
            else:
                text = f"{bend:.4g} {unit}".rstrip()
            straight = bend <= 1e-9 * float(x[-1] - x[0])
            lines.append(
                f"curve of {name}: " + ("straight" if straight else f"off by up to {text}")
            )
        return lines
