"""Reference for the network output-error model: plain NumPy, derivatives by complex step.

Run as a program it writes ``neural_oe.json``; the tests use its functions on more networks.
Complex step (Squire and Trapp 1998): df/dx = Im f(x + ih)/h, exact to rounding for h = 1e-30.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

_STEP = 1e-30


def free_run(
    theta: NDArray[Any], y_past: NDArray[Any], u: NDArray[np.float64], settings: dict[str, Any]
) -> NDArray[Any]:
    """Free run (N, batch), data's units; parameters (n_theta, batch), past outputs (na, batch)."""
    na, nb, nk, hidden = (settings[name] for name in ("na", "nb", "nk", "hidden"))
    n_inputs, n_phi = settings["n_inputs"], na + nb * settings["n_inputs"]
    weights = theta[: hidden * n_phi].reshape(hidden, n_phi, -1)
    bias, second = theta[hidden * n_phi :][:hidden], theta[hidden * (n_phi + 1) :][:hidden]
    constant, linear = theta[hidden * (n_phi + 2)], theta[hidden * (n_phi + 2) + 1 :]
    scaled_u = (u - settings["u_mean"]) / settings["u_scale"]
    past = list((y_past - settings["y_mean"]) / settings["y_scale"])
    outputs = []
    for k in range(len(u)):
        inputs = [scaled_u[max(k - nk - i, 0), j] for j in range(n_inputs) for i in range(nb)]
        batch = np.broadcast_to(np.array(inputs)[:, None], (len(inputs), theta.shape[1]))
        phi = np.concatenate([np.array(past), batch])
        y = (second * np.tanh(np.einsum("hpb,pb->hb", weights, phi) + bias)).sum(0) + constant
        if settings["bypass"]:
            y = y + (linear * phi).sum(0)
        for limit, beyond in (
            (settings["output_low"], np.less),
            (settings["output_high"], np.greater),
        ):
            if limit is not None:
                y = np.where(beyond(y.real, limit), limit, y)
        outputs.append(y)
        past = [y, *past[:-1]]
    return np.array(outputs) * settings["y_scale"] + settings["y_mean"]


def jacobian(
    theta: NDArray[np.float64],
    y_past: NDArray[np.float64],
    u: NDArray[np.float64],
    settings: dict[str, Any],
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Free run (N,) and its derivatives (N, n_theta + na) by theta and by the past outputs."""
    point = np.concatenate([theta, y_past])
    moved = point[:, None] + 1j * _STEP * np.eye(len(point))
    run = free_run(moved[: len(theta)], moved[len(theta) :], u, settings)
    return run[:, 0].real, run.imag / _STEP


def random_case(rng: np.random.Generator, samples: int = 60) -> dict[str, Any]:
    """A random network that stays bounded, an input and past outputs."""
    na, nb, n_inputs, hidden = (int(v) for v in rng.integers([1, 1, 1, 1], [5, 4, 4, 13]))
    bypass, clipped = bool(rng.integers(2)), bool(rng.integers(2))
    n_phi = na + nb * n_inputs
    weights = rng.normal(size=(hidden, n_phi))
    linear = rng.normal(size=n_phi) * 0.3 if bypass else np.zeros(0)
    if bypass:
        linear[:na] *= 0.6 / np.abs(linear[:na]).sum()
    parts = [weights.ravel(), rng.normal(size=hidden), rng.normal(size=hidden) / hidden]
    settings = {
        "na": na,
        "nb": nb,
        "nk": int(rng.integers(0, 4)),
        "n_inputs": n_inputs,
        "hidden": hidden,
        "bypass": bypass,
        "u_mean": rng.normal(size=n_inputs),
        "u_scale": rng.uniform(0.5, 5, n_inputs),
        "y_mean": float(rng.normal()),
        "y_scale": float(rng.uniform(0.5, 100)),
        "output_low": -0.4 if clipped else None,
        "output_high": 0.5 if clipped else None,
    }
    return {
        "settings": settings,
        "theta": np.concatenate([*parts, rng.normal(size=1) * 0.1, linear]),
        "y_past": settings["y_mean"] + settings["y_scale"] * rng.normal(size=na) * 0.3,
        "u": settings["u_mean"] + settings["u_scale"] * rng.normal(size=(samples, n_inputs)),
    }


def _main() -> None:
    rng = np.random.default_rng(20040)
    cases = []
    for _ in range(4):
        case = random_case(rng, samples=12)
        run, derivatives = jacobian(case["theta"], case["y_past"], case["u"], case["settings"])
        cases.append({**case, "run": run, "jacobian": derivatives})
    text = json.dumps(cases, default=lambda array: array.tolist(), indent=1)
    Path(__file__).with_suffix(".json").write_text(text + "\n", encoding="utf-8")


if __name__ == "__main__":
    _main()
