"""What NumPy, SciPy, pyrenn and python-control do of the benchmarks."""

from __future__ import annotations

import contextlib
import io
from collections.abc import Callable
from typing import Any

import numpy as np

import problem

Work = Callable[[], dict[str, Any]]


def arx_gram(samples: int) -> Work:
    """ARX(2, 2, 1) by NumPy's dot products of slices: no regressor matrix is built."""
    u, y = problem.noisy_drive(samples)

    def work() -> dict[str, Any]:
        columns = (-y[1:-1], -y[:-2], u[1:-1], u[:-2])
        left = np.array([[a @ b for b in columns] for a in columns])
        return {"theta": np.linalg.solve(left, np.array([a @ y[2:] for a in columns])).tolist()}

    return work


def arx_lstsq(samples: int) -> Work:
    """ARX(2, 2, 1) by an orthogonal decomposition of the regressors."""
    u, y = problem.noisy_drive(samples)

    def work() -> dict[str, Any]:
        rows = np.stack([-y[1:-1], -y[:-2], u[1:-1], u[:-2]], 1)
        return {"theta": np.linalg.lstsq(rows, y[2:], rcond=None)[0].tolist()}

    return work


def pyrenn_training(iterations: int) -> Work:
    """Levenberg-Marquardt of the package, with damping of its own, from the common start."""
    import pyrenn

    u, y = problem.drive()
    inputs, outputs = u[None], y[None]
    net = pyrenn.CreateNN([1, problem.HIDDEN, 1], dIn=[1, 2], dIntern=[], dOut=[1, 2])
    _, net = pyrenn.prepare_data(inputs, outputs, net)
    net["w"] = _pyrenn_weights(problem.start(), float(net["normY"][0]))
    run = pyrenn.NNOut(inputs, net)
    cost = 0.5 * float(np.mean((y - run) ** 2))

    def work() -> dict[str, Any]:
        with contextlib.redirect_stdout(io.StringIO()):
            pyrenn.train_LM(inputs, outputs, dict(net), k_max=iterations, E_stop=1e-12)
        return {"first_cost": cost}

    return work


def _pyrenn_weights(theta: np.ndarray, scale: float) -> np.ndarray:
    """theta in the package's order, for inputs and outputs in its scaling."""
    w1, b1, w2, b2 = theta[:32].reshape(8, 4), theta[32:40], theta[40:48], theta[48:]
    parts = [w1[:, 2], w1[:, 3], scale * w1[:, 0], scale * w1[:, 1], b1, w2 / scale, b2 / scale]
    return np.concatenate(parts)


def control_loop() -> Work:
    """One closed loop by python-control's simulation of interconnected nonlinear systems."""
    import control

    theta, r, dt = problem.trained(), problem.reference(), problem.TS
    terms = {name: float(values[0]) for name, values in problem.terms(1).items()}
    w1, b1, w2, b2 = theta[:32].reshape(8, 4), theta[32:40], theta[40:48], theta[48]

    def plant(_t: Any, s: Any, u: Any, _p: Any) -> Any:
        y = w2 @ np.tanh(w1 @ np.array([s[0], s[1], u[0], s[2]]) + b1) + b2
        return np.array([y, s[0], u[0]])

    def decide(s: Any, u: Any) -> tuple[Any, ...]:
        e = u[0] - u[1]
        rate = e - terms["beta"] * u[0]
        derivative = terms["pole"] * s[1] + terms["kd"] * (rate - s[2])
        integral = s[0] + terms["ki"] * e
        wanted = terms["kp"] * (e - terms["alpha"] * u[0]) + integral + derivative
        command = min(max(wanted, 0.0), 1.0)
        return integral + terms["tracking"] * (command - wanted), derivative, rate, command

    def remember(_t: Any, s: Any, u: Any, _p: Any) -> Any:
        return np.array(decide(s, u)[:3])

    def command(_t: Any, s: Any, u: Any, _p: Any) -> Any:
        return np.array([decide(s, u)[3]])

    motor = control.nlsys(
        plant,
        lambda _t, s, _u, _p: np.array([s[0]]),
        inputs=["u"],
        outputs=["y"],
        states=3,
        dt=dt,
        name="motor",
    )
    pid = control.nlsys(
        remember, command, inputs=["r", "y"], outputs=["u"], states=3, dt=dt, name="pid"
    )
    loop = control.interconnect([motor, pid], inputs=["r"], outputs=["y"])
    t, rest = np.arange(len(r)) * dt, [0, 0, 0, 0, 0, (1 - terms["beta"]) * r[0]]

    def work() -> dict[str, Any]:
        y = np.ravel(control.input_output_response(loop, t, r, rest).outputs)
        return {"last": float(y[-1]), "mean": float(np.mean((r - y) ** 2))}

    return work
