"""ONNX of a model: one step with its state as inputs and outputs, and a batch of free runs.

Both graphs compute in double precision, with standard operators of opset 17 only; the free run is a
`Scan`, not a `Loop`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from types import ModuleType
from typing import Any

import numpy as np

from sewfast import __version__, _core
from sewfast.control import Controller
from sewfast.dataset import FloatArray
from sewfast.errors import SettingError, not_installed
from sewfast.models import Model
from sewfast.models.base import kept

from .precision import at_rest, embedded_members

OPSET = 17
IR = 9
"""Format of the file, which every runtime since 2023 reads."""


def files(
    what: Model | Controller, name: str, precision: str
) -> tuple[dict[str, bytes], list[str]]:
    """Both graphs by file name, and notes on them."""
    if isinstance(what, Controller):
        raise SettingError(
            name="to", expected="a model for onnx", received="a controller",
            remedy="deploy controllers to c99 or st",
        )  # fmt: skip
    if precision != "f64":
        raise SettingError(
            name="precision", expected="f64 for onnx", received=repr(precision),
            remedy="leave it out",
        )  # fmt: skip
    onnx = _library()
    step = _step_graph(onnx, what, f"{name}_step")
    simulate = _simulate_graph(onnx, what, f"{name}_simulate")
    texts = {}
    for graph in (step, simulate):
        made = onnx.helper.make_model(
            graph,
            opset_imports=[onnx.helper.make_opsetid("", OPSET)],
            ir_version=IR,
            producer_name="sewfast",
            producer_version=__version__,
        )
        onnx.helper.set_model_props(made, _properties(what))
        onnx.checker.check_model(made, full_check=True)
        texts[f"{graph.name}.onnx"] = made.SerializeToString()
    inputs, size = len(what.input_names), _size(what)
    notes = [
        f"{what.title} as ONNX in double precision, opset {OPSET}",
        f"{name}_step: u (batch, {inputs}), state (batch, {size}) -> y, next_state",
        f"{name}_simulate: u (N, batch, {inputs}), state -> y (N, batch), last_state",
    ]
    return texts, notes


def initial_state(
    model: Model, state: FloatArray | None = None, held: FloatArray | None = None
) -> FloatArray:
    """The graphs' `state` for a model's own state and the inputs before the first sample.

    Parameters
    ----------
    model : Model
    state : array, optional
        The state of `Model.simulate`; by default the model is at rest (`Model.rest`).
    held : array, shape (n_inputs,), optional
        Constant inputs before the first sample, in their units; by default those at rest.

    Returns
    -------
    array, shape (1, n)
    """
    members, embedded, _ = embedded_members(model, "f64")
    states, inputs = at_rest(members)
    first = np.concatenate(states) if state is None else state
    before = inputs if held is None else np.asarray(held, dtype=float)
    parts, at = [], 0
    for e in embedded:
        na = e.orders["na"]
        own, scaling = first[at : at + na], e.scaling
        if scaling is not None and e.kind == "network":
            own = (own - scaling["y_mean"]) / scaling["y_scale"]
        scaled = before if scaling is None else (before - scaling["u_mean"]) / scaling["u_scale"]
        parts += [own, np.repeat(scaled, _kept(e))]
        at += na
    return np.concatenate(parts)[None, :]


def _library() -> ModuleType:
    try:
        import onnx
        import onnx.checker
        import onnx.helper
    except ImportError as error:
        raise not_installed("onnx", "ONNX", "sewfast[onnx]") from error
    found: ModuleType = onnx
    return found


def _properties(model: Model) -> dict[str, str]:
    """Metadata of the file."""
    units = zip(model.input_names, model.input_units, strict=True)
    return {
        "sample_time_s": repr(model.Ts),
        "inputs": ", ".join(f"{n} [{u}]" if u else n for n, u in units),
        "output": f"{model.output_name} [{model.output_unit}]"
        if model.output_unit
        else model.output_name,
        "model": model.title,
    }


def _kept(e: _core.EmbeddedModel) -> int:
    """Past samples of each input in the state; the current sample is an input of the graph."""
    return e.orders["nk"] + e.orders["nb"] - 1


def _sizes(e: _core.EmbeddedModel) -> tuple[int, int]:
    """Lengths of the two parts of the state: the model's own, and past inputs."""
    return e.orders["na"], e.orders["inputs"] * _kept(e)


class _Graph:
    """Nodes and constants of one graph; every method returns the name of its result."""

    def __init__(self, onnx: ModuleType) -> None:
        self.onnx = onnx
        self.nodes: list[Any] = []
        self.constants: list[Any] = []
        self._count = 0

    def name(self) -> str:
        self._count += 1
        return f"v{self._count}"

    def constant(self, values: Any, integer: bool = False) -> str:
        name = self.name()
        array = np.asarray(values, dtype=np.int64 if integer else np.float64)
        self.constants.append(self.onnx.numpy_helper.from_array(array, name))
        return name

    def node(self, operator: str, *inputs: str, **attributes: Any) -> str:
        name = self.name()
        self.nodes.append(self.onnx.helper.make_node(operator, list(inputs), [name], **attributes))
        return name

    def columns(self, x: str, start: int, end: int) -> str:
        """x[:, start:end]"""
        ends = [self.constant([i], integer=True) for i in (start, end, 1)]
        return self.node("Slice", x, *ends)

    def joined(self, parts: Sequence[str]) -> str:
        return parts[0] if len(parts) == 1 else self.node("Concat", *parts, axis=1)

    def affine(self, x: str, weights: FloatArray, bias: Any) -> str:
        """x weights' + bias, for weights of shape (outputs, inputs)."""
        product = self.node("MatMul", x, self.constant(np.ascontiguousarray(weights.T)))
        return self.node("Add", product, self.constant(bias))


def _step(g: _Graph, model: Model, u: str, state: str) -> tuple[str, str]:
    """Add one step; return the names of the output (batch, 1) and of the next state."""
    _, embedded, combined = embedded_members(model, "f64")
    outputs, states, at = [], [], 0
    for e in embedded:
        na, waiting = _sizes(e)
        y, following = _member(
            g, e, u, g.columns(state, at, at + na), g.columns(state, at + na, at + na + waiting)
        )
        outputs.append(y)
        states += following
        at += na + waiting
    return _combined(g, outputs, combined), g.joined(states)


def _member(
    g: _Graph, e: _core.EmbeddedModel, u: str, past: str, waiting: str
) -> tuple[str, list[str]]:
    """Add one model; return its output and the parts of its next state."""
    nk, nb, kept = e.orders["nk"], e.orders["nb"], _kept(e)
    if e.scaling is not None:
        u = g.node("Sub", u, g.constant(e.scaling["u_mean"]))
        u = g.node("Div", u, g.constant(e.scaling["u_scale"]))
    acting, remembered = [], []
    for j in range(e.orders["inputs"]):
        window = [g.columns(u, j, j + 1)]
        if kept:
            window.append(g.columns(waiting, j * kept, (j + 1) * kept))
        whole = g.joined(window)
        acting.append(g.columns(whole, nk, nk + nb))
        if kept:
            remembered.append(g.columns(whole, 0, kept))
    equation: Callable[..., tuple[str, str]] = _EQUATIONS[e.kind]
    y, following = equation(g, e, past, g.joined(acting))
    if e.scaling is not None:
        y = g.node("Mul", y, g.constant(e.scaling["y_scale"]))
        y = g.node("Add", y, g.constant(e.scaling["y_mean"]))
    return y, [following, *remembered]


def _pushed(g: _Graph, e: _core.EmbeddedModel, past: str, y: str) -> str:
    """Past outputs, the newest first."""
    na = e.orders["na"]
    return y if na == 1 else g.joined([y, g.columns(past, 0, na - 1)])


def _linear(g: _Graph, e: _core.EmbeddedModel, past: str, inputs: str) -> tuple[str, str]:
    weights = np.concatenate([-e.parts["a"], e.parts["b"]])[None, :]
    y = g.affine(g.joined([past, inputs]), weights, e.parts["offset"])
    return y, _pushed(g, e, past, y)


def _network(g: _Graph, e: _core.EmbeddedModel, past: str, inputs: str) -> tuple[str, str]:
    p, phi = e.parts, g.joined([past, inputs])
    hidden = g.node("Tanh", g.affine(phi, p["w1"].reshape(len(p["b1"]), -1), p["b1"]))
    direct = g.affine(phi, p["direct"][None, :], p["b2"])
    y = g.node("Add", direct, g.node("MatMul", hidden, g.constant(p["w2"][:, None])))
    low, high = float(p["low"][0]), float(p["high"][0])
    if np.isfinite([low, high]).any():
        y = g.node("Clip", y, g.constant(low), g.constant(high))
    return y, _pushed(g, e, past, y)


def _states(g: _Graph, e: _core.EmbeddedModel, x: str, v: str) -> tuple[str, str]:
    p, nx, nu = e.parts, e.orders["na"], e.orders["inputs"]
    xv = g.joined([x, v])
    inner = np.hstack([p["wx"].reshape(-1, nx), p["wu"].reshape(-1, nu)])
    hidden = g.node("Tanh", g.affine(xv, inner, p["bh"]))
    outer = np.hstack([p["a"].reshape(nx, nx), p["b"].reshape(nx, nu)])
    e_t = np.ascontiguousarray(p["e"].reshape(nx, -1).T)
    following = g.node("Add", g.affine(xv, outer, np.zeros(nx)), _times(g, hidden, e_t))
    last = np.concatenate([p["c"], p["d"]])[None, :]
    s = g.node("Add", g.affine(xv, last, p["constant"]), _times(g, hidden, p["g"][:, None]))
    return _output(g, e, s), following


def _times(g: _Graph, x: str, matrix: FloatArray) -> str:
    return g.node("MatMul", x, g.constant(matrix))


def _output(g: _Graph, e: _core.EmbeddedModel, s: str) -> str:
    """The output function, without `Softplus`, which some runtimes have in f32 only."""
    function, values = e.output
    if function == "linear":
        return s
    if function == "abs":
        squares = g.node("Add", g.node("Mul", s, s), g.constant(values[0] ** 2))
        return g.node("Sqrt", squares)
    low, high, width = values

    def softplus(limit: float) -> str:
        z = g.node("Div", g.node("Sub", s, g.constant(limit)), g.constant(width))
        e_z = g.node("Exp", g.node("Neg", g.node("Abs", z)))
        rest = g.node("Log", g.node("Add", e_z, g.constant(1.0)))
        return g.node("Add", g.node("Max", z, g.constant(0.0)), rest)

    above = g.node("Sub", softplus(low), softplus(high))
    return g.node("Add", g.node("Mul", above, g.constant(width)), g.constant(low))


_EQUATIONS: dict[str, Callable[[_Graph, _core.EmbeddedModel, str, str], tuple[str, str]]] = {
    "linear": _linear,
    "network": _network,
    "states": _states,
}


def _combined(g: _Graph, outputs: list[str], combined: str) -> str:
    if len(outputs) == 1:
        return outputs[0]
    together = g.joined(outputs)
    if combined == "mean":
        return g.node("ReduceMean", together, axes=[1], keepdims=1)
    ordered = g.name()
    count = g.constant([len(outputs)], integer=True)
    g.nodes.append(
        g.onnx.helper.make_node("TopK", [together, count], [ordered, g.name()], axis=1, largest=0)
    )
    middle = g.columns(ordered, *kept(combined, len(outputs)))
    return g.node("ReduceMean", middle, axes=[1], keepdims=1)


def _size(model: Model) -> int:
    return sum(sum(_sizes(e)) for e in embedded_members(model, "f64")[1])


def _step_graph(onnx: ModuleType, model: Model, name: str) -> Any:
    g = _Graph(onnx)
    y, following = _step(g, model, "u", "state")
    g.nodes.append(onnx.helper.make_node("Identity", [y], ["y"]))
    g.nodes.append(onnx.helper.make_node("Identity", [following], ["next_state"]))
    value = _value_of(onnx)
    inputs, size = len(model.input_names), _size(model)
    return onnx.helper.make_graph(
        g.nodes, name,
        [value("u", ["batch", inputs]), value("state", ["batch", size])],
        [value("y", ["batch", 1]), value("next_state", ["batch", size])],
        g.constants,
        doc_string=f"{model.title}: one sample of {model.Ts:g} s",
    )  # fmt: skip


def _simulate_graph(onnx: ModuleType, model: Model, name: str) -> Any:
    g = _Graph(onnx)
    y, following = _step(g, model, "u_k", "x_k")
    g.nodes.append(onnx.helper.make_node("Identity", [following], ["x_next"]))
    squeezed = g.constant([1], integer=True)
    g.nodes.append(onnx.helper.make_node("Squeeze", [y, squeezed], ["y_k"]))
    value = _value_of(onnx)
    inputs, size = len(model.input_names), _size(model)
    body = onnx.helper.make_graph(
        g.nodes, "sample",
        [value("x_k", ["batch", size]), value("u_k", ["batch", inputs])],
        [value("x_next", ["batch", size]), value("y_k", ["batch"])],
        g.constants,
    )  # fmt: skip
    scan = onnx.helper.make_node(
        "Scan", ["state", "u"], ["last_state", "y"], body=body, num_scan_inputs=1
    )
    return onnx.helper.make_graph(
        [scan], name,
        [value("u", ["N", "batch", inputs]), value("state", ["batch", size])],
        [value("y", ["N", "batch"]), value("last_state", ["batch", size])],
        doc_string=f"{model.title}: free runs, every {model.Ts:g} s",
    )  # fmt: skip


def _value_of(onnx: ModuleType) -> Callable[[str, list[int | str]], Any]:
    return lambda name, shape: onnx.helper.make_tensor_value_info(
        name, onnx.TensorProto.DOUBLE, shape
    )
