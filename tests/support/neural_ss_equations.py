"""A NumPy reference of the neural state-space model: complex steps through docs/CONVENTIONS.md."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

STEP = 1e-40
"""Of the complex step: its square is nothing, so that no digit is lost (Squire and Trapp 1998)."""

F = NDArray[np.float64]
Z = NDArray[np.complex128]


def parts(settings: dict[str, Any]) -> dict[str, tuple[slice, tuple[int, ...]]]:
    """Where each matrix stands in theta, and its shape."""
    nx, nu, ny = settings["nx"], settings["n_inputs"], settings["n_outputs"]
    hidden = settings["hidden"]
    shapes = {
        "A": (nx, nx),
        "B": (nx, nu),
        "E": (nx, hidden),
        "Wx": (hidden, nx),
        "Wu": (hidden, nu),
        "bh": (hidden,),
        "C": (ny, nx),
        "D": (ny, nu),
        "c": (ny,),
        "G": (ny, hidden),
    }
    found, at = {}, 0
    for name, shape in shapes.items():
        found[name] = (slice(at, at + int(np.prod(shape))), shape)
        at += int(np.prod(shape))
    return found


def length(settings: dict[str, Any]) -> int:
    return max(where.stop for where, _ in parts(settings).values())


def output_function(s: Z, settings: dict[str, Any]) -> Z:
    values = settings["output_parameters"]
    if settings["output"] == "abs":
        return np.asarray(np.sqrt(s**2 + values[0] ** 2))
    if settings["output"] == "saturation":
        low, high, w = values
        # both forms are the same by p(z) = z + p(-z); beyond a limit the other one has no digits
        below = low + w * (softplus((s - low) / w) - softplus((s - high) / w))
        above = high + w * (softplus((low - s) / w) - softplus((high - s) / w))
        return np.where(s.real < (low + high) / 2, below, above)
    return s


def softplus(z: Z) -> Z:
    right = z.real > 0
    turned = np.where(right, -z, z)
    return np.asarray(np.where(right, z, 0) + np.log1p(np.exp(turned)))


def runs(theta: Z, state: Z, u: F, settings: dict[str, Any]) -> Z:
    """Free runs (n, N, ny) of n parameter vectors (n, n_theta) from n states (n, nx)."""
    m = {k: theta[:, w].reshape(-1, *shape) for k, (w, shape) in parts(settings).items()}
    scaled = (u - settings["u_mean"]) / settings["u_scale"]
    x, y = state, np.empty((len(theta), len(u), settings["n_outputs"]), dtype=complex)

    def times(matrix: Z, vector: Z) -> Z:
        return np.asarray((matrix @ vector[:, :, None])[:, :, 0])

    for k in range(len(u)):
        v = np.broadcast_to(scaled[max(k - settings["nk"], 0)], (len(theta), u.shape[1]))
        h = np.tanh(times(m["Wx"], x) + times(m["Wu"], v) + m["bh"])
        s = times(m["C"], x) + times(m["D"], v) + m["c"] + times(m["G"], h)
        y[:, k] = output_function(s, settings)
        x = times(m["A"], x) + times(m["B"], v) + times(m["E"], h)
    return y * settings["y_scale"] + settings["y_mean"]


def jacobian(theta: F, state: F, u: F, settings: dict[str, Any]) -> tuple[F, F]:
    """Free run (N, ny) and its derivatives (N, ny, n_theta + nx), exact to rounding."""
    count = len(theta) + len(state)
    point = np.concatenate([theta, state]).astype(complex)
    moved = point + 1j * STEP * np.eye(count)
    y = runs(moved[:, : len(theta)], moved[:, len(theta) :], u, settings)
    return y[0].real.copy(), np.moveaxis(y.imag / STEP, 0, -1)


def random_case(rng: np.random.Generator, samples: int = 30) -> dict[str, Any]:
    """A stable network of random size with its input and initial state."""
    nx, nu, ny = rng.integers(1, 5), rng.integers(1, 4), 1
    hidden = rng.integers(1, 9)
    output = ("linear", "saturation", "abs")[rng.integers(3)]
    width = float(rng.uniform(0.05, 0.5))
    values = {"linear": [], "saturation": [-0.8, 0.9, width], "abs": [width]}[output]
    settings: dict[str, Any] = {
        "nx": int(nx),
        "nk": int(rng.integers(0, 4)),
        "n_inputs": int(nu),
        "n_outputs": int(ny),
        "hidden": int(hidden),
        "integrator": False,
        "output": output,
        "output_parameters": np.array(values, dtype=float),
        "u_mean": rng.normal(size=nu),
        "u_scale": rng.uniform(0.5, 5, nu),
        "y_mean": np.zeros(ny) if output == "abs" else rng.normal(size=ny),
        "y_scale": rng.uniform(0.5, 100, ny),
        "state_mean": np.zeros(nx),
        "state_covariance": np.eye(nx),
        "residual_variance": np.full(ny, 1e-4),
        "process_noise": 1e-3,
    }
    theta = rng.normal(size=length(settings))
    where = parts(settings)

    def scale(name: str, largest: float) -> None:
        span, shape = where[name]
        theta[span] *= largest / np.linalg.norm(theta[span].reshape(shape), 2)

    # |A| + |E| |Wx| < 1: every such network forgets its state
    scale("A", rng.uniform(0.1, 0.9))
    scale("Wx", rng.uniform(0.3, 2.0))
    scale("E", rng.uniform(0.02, 0.045))
    return {
        "settings": settings,
        "theta": theta,
        "state": rng.normal(size=nx),
        "u": settings["u_mean"] + settings["u_scale"] * rng.normal(size=(samples, nu)),
    }
