"""The linear loop as state space: controller, measurement and plant, and their connections.

Exact for deviations from an operating point as long as no limit, slew or ramp acts.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..dataset import FloatArray
from ..errors import DataError, SettingError
from ..models.conversion import StateSpace, require_control, require_scipy_signal
from .controller import Controller
from .loop import require_controller
from .margins import scheduled_gains

SYSTEMS = ("L", "S", "T", "closed", "tracking", "disturbance", "plant", "measurement", "pid")
"""Systems of a `LinearLoop` for toolboxes, by name."""


def gain(D: Any) -> StateSpace:
    """A static gain: the outputs are `D` times the inputs."""
    D = np.atleast_2d(np.asarray(D, dtype=np.float64))
    outputs, inputs = D.shape
    return StateSpace(np.zeros((0, 0)), np.zeros((0, inputs)), np.zeros((outputs, 0)), D)


def series(first: StateSpace, then: StateSpace) -> StateSpace:
    """The series connection, `first` before `then`."""
    (A1, B1, C1, D1), (A2, B2, C2, D2) = first, then
    A = np.block([[A1, np.zeros((len(A1), len(A2)))], [B2 @ C1, A2]])
    return StateSpace(A, np.vstack([B1, B2 @ D1]), np.hstack([D2 @ C1, C2]), D2 @ D1)


def beside(one: StateSpace, other: StateSpace) -> StateSpace:
    """Both systems side by side, with separate inputs and outputs."""
    return StateSpace(*(_diagonal(a, b) for a, b in zip(one, other, strict=True)))


def plus(one: StateSpace, other: StateSpace) -> StateSpace:
    """The parallel connection: the sum of both outputs for common inputs."""
    A, B, C, _ = beside(one, other)
    inputs = one.D.shape[1]
    outputs = one.D.shape[0]
    return StateSpace(
        A, B[:, :inputs] + B[:, inputs:], C[:outputs] + C[outputs:], one.D + other.D
    )  # fmt: skip


def _diagonal(a: FloatArray, b: FloatArray) -> FloatArray:
    found = np.zeros((a.shape[0] + b.shape[0], a.shape[1] + b.shape[1]))
    found[: a.shape[0], : a.shape[1]] = a
    found[a.shape[0] :, a.shape[1] :] = b
    return found


# --- the parts of the loop ------------------------------------------------------------------------


def moving_average(samples: int) -> StateSpace:
    """Mean over the last samples."""
    n = samples - 1
    A, B = np.eye(n, k=-1), np.zeros((n, 1))
    B[:1] = 1.0
    return StateSpace(A, B, np.full((1, n), 1.0 / samples), np.full((1, 1), 1.0 / samples))


def lag(time: float, Ts: float) -> StateSpace:
    """First-order lag by backward difference; 0 for none."""
    w = Ts / (Ts + time)
    return _first_order(1.0 - w, w * (1.0 - w), w) if time else gain(1.0)


def observer(time: float, Ts: float) -> StateSpace:
    """Alpha-beta observer of a speed; 0 for none."""
    if not time:
        return gain(1.0)
    theta = math.exp(-Ts / time)
    pole = _first_order(theta, theta * (1.0 - theta), 1.0 - theta)
    return series(pole, pole)


def cascade(controller: Controller) -> StateSpace:
    """The controller's biquads, one after the other. Each is in the canonical form of
    `H = 1 + (1 - q)(c0 + c1 q)/(1 + a1 q + a2 q^2)`, q = 1/z, whose numerator less the constant c0
    is (c1 - c0 - a1 c0) q - (c1 + a2 c0) q^2.
    """
    found = gain(1.0)
    for c0, c1, a1, a2 in controller.sections():
        section = StateSpace(
            np.array([[-a1, -a2], [1.0, 0.0]]), np.array([[1.0], [0.0]]),
            np.array([[c1 - c0 - a1 * c0, -c1 - a2 * c0]]), np.array([[1.0 + c0]]),
        )  # fmt: skip
        found = series(found, section)
    return found


def _first_order(a: float, c: float, d: float) -> StateSpace:
    return StateSpace(
        np.array([[a]]), np.array([[1.0]]), np.array([[c]]), np.array([[d]])
    )  # fmt: skip


def measurement(controller: Controller, encoder: bool) -> StateSpace:
    """From the plant's output to the PID's input: encoder, feedback filters, biquads. With
    `encoder` the output is measured by differences of positions: the mean over the sample before.
    """
    found = moving_average(controller.filter_samples)
    if encoder:
        found = series(moving_average(2), found)
    found = series(found, lag(controller.filter_time, controller.Ts))
    found = series(found, observer(controller.observer_time, controller.Ts))
    return series(found, cascade(controller))


def pid(controller: Controller, speed: float = 0.0) -> StateSpace:
    """From (reference, filtered output) to the command, at the output `speed` [y] of a schedule."""
    g, slope = scheduled_gains(controller, speed)
    Ts = controller.Ts
    ki = g.Kp * Ts / g.Ti
    filtered = g.Td / controller.N
    kd = g.Kp * g.Td / (filtered + Ts)
    pole = filtered / (filtered + Ts)
    b, c = 1.0 - controller.alpha, 1.0 - controller.beta
    integral = series(gain([[ki, -ki]]), _first_order(1.0, 1.0, 1.0))
    derivative = series(gain([[c, -1.0]]), _first_order(pole, kd * (pole - 1.0), kd))
    found = plus(gain([[g.Kp * b, -g.Kp - slope]]), plus(integral, derivative))
    return series(beside(cascade(controller), gain(1.0)), found) if controller.biquads else found


@dataclass(frozen=True, eq=False)
class LinearLoop:
    """A controller around a linear plant, for deviations from an operating point.

    Attributes
    ----------
    plant : StateSpace
        From the command to the true output, delay included.
    measurement : StateSpace
        From the true output to the filtered one.
    pid : StateSpace
        From reference and filtered output to the command.
    Ts : float
        Sample time [s].
    """

    plant: StateSpace
    measurement: StateSpace
    pid: StateSpace
    Ts: float

    @classmethod
    def of(
        cls,
        controller: Controller,
        plant: StateSpace,
        *,
        encoder: bool | None = None,
        speed: float = 0.0,
    ) -> LinearLoop:
        """Close the loop, with a schedule's gains at `speed`.

        Parameters
        ----------
        encoder : bool, optional
            Whether an encoder measures the output; by default if the controller has one.

        Raises
        ------
        SettingError
            For anything but a Controller and a StateSpace, such as that of `model.to_ss()`.
        """
        require_controller(controller, plant, "LinearLoop.of(controller, plant)")
        if not isinstance(plant, StateSpace):
            raise SettingError(
                name="plant", expected="a StateSpace", received=type(plant).__name__,
                remedy="a linear model has to_ss()",
            )  # fmt: skip
        if encoder is None:
            encoder = controller.counts_per_rev is not None
        return cls(
            plant, measurement(controller, encoder), pid(controller, speed), controller.Ts
        )  # fmt: skip

    @property
    def L(self) -> StateSpace:
        """Loop transfer, broken at the plant's input."""
        A, B, C, D = self.pid
        back = StateSpace(A, -B[:, 1:], C, -D[:, 1:])
        return series(self.plant, series(self.measurement, back))

    @property
    def S(self) -> StateSpace:
        """Sensitivity 1/(1 + L): the share of a disturbance at the plant's input that remains."""
        A, B, C, D = self.L
        return StateSpace(A - B @ C, B, -C, 1.0 - D)

    @property
    def T(self) -> StateSpace:
        """Complementary sensitivity L/(1 + L)."""
        A, B, C, D = self.L
        return StateSpace(A - B @ C, B, C, D)

    @property
    def closed(self) -> StateSpace:
        """From reference and disturbance at the plant's input to true output and command."""
        (Ap, Bp, Cp, _), (Am, Bm, Cm, Dm), (Ac, Bc, Cc, Dc) = self.plant, self.measurement, self.pid
        m, c = len(Am), len(Ac)
        Br, By, Dr, Dy = Bc[:, :1], Bc[:, 1:], Dc[:, :1], Dc[:, 1:]
        A = np.block(
            [
                [Ap + Bp @ Dy @ Dm @ Cp, Bp @ Dy @ Cm, Bp @ Cc],
                [Bm @ Cp, Am, np.zeros((m, c))],
                [By @ Dm @ Cp, By @ Cm, Ac],
            ]
        )
        B = np.block([[Bp @ Dr, Bp], [np.zeros((m, 2))], [Br, np.zeros((c, 1))]])
        C = np.block([[Cp, np.zeros((1, m + c))], [Dy @ Dm @ Cp, Dy @ Cm, Cc]])
        return StateSpace(A, B, C, np.array([[0.0, 0.0], [float(Dr[0, 0]), 0.0]]))

    @property
    def tracking(self) -> StateSpace:
        """From the reference to the true output."""
        A, B, C, D = self.closed
        return StateSpace(A, B[:, :1], C[:1], D[:1, :1])

    @property
    def disturbance(self) -> StateSpace:
        """From a disturbance at the plant's input to the true output."""
        A, B, C, D = self.closed
        return StateSpace(A, B[:, 1:], C[:1], D[:1, 1:])

    def poles(self) -> NDArray[np.complex128]:
        """Poles of the closed loop in the z plane, the slowest first."""
        found = np.linalg.eigvals(self.closed.A).astype(np.complex128)
        return found[np.argsort(-np.abs(found), kind="stable")]

    def to_control(self, name: str = "T") -> Any:
        """`L`, `S`, `T`, `closed`, `tracking` or `disturbance` as a `control.StateSpace`, dt = Ts.

        Raises
        ------
        SettingError
            If python-control is not installed, or for another name.
        """
        return require_control().ss(*self._named(name), self.Ts)

    def to_scipy(self, name: str = "T") -> Any:
        """The same as `scipy.signal.dlti`.

        Raises
        ------
        SettingError
            If scipy is not installed.
        """
        return require_scipy_signal().dlti(*self._named(name), dt=self.Ts)

    def _named(self, name: str) -> StateSpace:
        if name not in SYSTEMS:
            raise SettingError(
                name="name", expected=f"one of {', '.join(SYSTEMS)}", received=repr(name)
            )
        found: StateSpace = getattr(self, name)
        return found


def response(system: StateSpace, hertz: FloatArray, Ts: float) -> NDArray[np.complex128]:
    """Frequency response of a system with one input and one output, shape (len(hertz),)."""
    z = np.exp(2j * np.pi * np.asarray(hertz, dtype=np.float64) * Ts)
    A, B, C, D = system
    inner = np.linalg.solve(
        z[:, None, None] * np.eye(len(A)) - A, np.broadcast_to(B, (len(z), *B.shape))
    )
    return np.asarray((C @ inner + D)[:, 0, 0], dtype=np.complex128)


def simulate(system: StateSpace, u: FloatArray) -> FloatArray:
    """The output from rest for inputs (N, inputs), shape (N, outputs)."""
    A, B, C, D = system
    u = np.asarray(u, dtype=np.float64)
    if u.ndim != 2 or u.shape[1] != B.shape[1]:
        raise DataError(name="u", expected=f"shape (N, {B.shape[1]})", received=str(u.shape))
    x, found = np.zeros(len(A)), np.empty((len(u), len(C)))
    for k, v in enumerate(u):
        found[k] = C @ x + D @ v
        x = A @ x + B @ v
    return found
