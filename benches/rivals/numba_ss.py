"""The neural state-space model in numba, as an expert writes it: analytic sensitivities, NumPy LM.

Simulation and Jacobian are compiled loops over the samples with fast maths; J'J is a BLAS product
over all rows, and the damped system is solved by LAPACK's Cholesky. Same equations, order of
parameters, weight decay and damping (times 4, divided by 5) as sewfast's.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
import scipy.linalg
from numba import njit


def offsets(nx: int, hidden: int) -> dict[str, int]:
    """Where the parts of theta end: A, B, E, Wx, Wu, bh, C, D, c, G; one input, one output."""
    sizes = (
        nx * nx,
        nx,
        nx * hidden,
        hidden * nx,
        hidden,
        hidden,
        nx,
        1,
        1,
        hidden,
    )
    names = ("A", "B", "E", "Wx", "Wu", "bh", "C", "D", "c", "G")
    return dict(zip(names, np.cumsum(sizes).tolist(), strict=True))


@njit(fastmath=True)
def simulate(th, nx, H, u, x0, Y):
    oB = nx * nx
    oE = oB + nx
    oW = oE + nx * H
    oU = oW + nx * H
    ob = oU + H
    oC = ob + H
    oD = oC + nx
    oc = oD + 1
    oG = oc + 1
    x = x0.copy()
    xn = np.empty(nx)
    h = np.empty(H)
    for k in range(len(u)):
        uk = u[k]
        s = th[oD] * uk + th[oc]
        for j in range(nx):
            s += th[oC + j] * x[j]
        for i in range(H):
            z = th[oU + i] * uk + th[ob + i]
            for j in range(nx):
                z += th[oW + i * nx + j] * x[j]
            h[i] = math.tanh(z)
            s += th[oG + i] * h[i]
        Y[k] = s
        m = 0.0
        for q in range(nx):
            v = th[oB + q] * uk
            for j in range(nx):
                v += th[q * nx + j] * x[j]
            for i in range(H):
                v += th[oE + q * H + i] * h[i]
            xn[q] = v
            m = max(m, abs(v))
        if not (m < 1e3):
            return 1
        for j in range(nx):
            x[j] = xn[j]
    return 0


@njit(fastmath=True)
def sensitivities(th, nx, H, u, x0, Y, J):
    oB = nx * nx
    oE = oB + nx
    oW = oE + nx * H
    oU = oW + nx * H
    ob = oU + H
    oC = ob + H
    oD = oC + nx
    oc = oD + 1
    oG = oc + 1
    P = oG + H
    PS = oC
    x = x0.copy()
    xn = np.empty(nx)
    h = np.empty(H)
    d = np.empty(H)
    S = np.zeros((nx, PS + nx))
    T = np.zeros((nx, PS + nx))
    Jx = np.empty((nx, nx))
    g = np.empty(nx)
    for j in range(nx):
        S[j, PS + j] = 1.0
    for k in range(len(u)):
        uk = u[k]
        s = th[oD] * uk + th[oc]
        for j in range(nx):
            s += th[oC + j] * x[j]
        for i in range(H):
            z = th[oU + i] * uk + th[ob + i]
            for j in range(nx):
                z += th[oW + i * nx + j] * x[j]
            h[i] = math.tanh(z)
            d[i] = 1 - h[i] * h[i]
            s += th[oG + i] * h[i]
        Y[k] = s
        row = J[k]
        for j in range(nx):
            v = th[oC + j]
            for i in range(H):
                v += th[oG + i] * d[i] * th[oW + i * nx + j]
            g[j] = v
        for p in range(PS):
            row[p] = 0.0
        for j in range(nx):
            gj = g[j]
            Sj = S[j]
            for p in range(PS):
                row[p] += gj * Sj[p]
        for q in range(nx):
            v = 0.0
            for j in range(nx):
                v += g[j] * S[j, PS + q]
            row[P + q] = v
        for i in range(H):
            gd = th[oG + i] * d[i]
            for j in range(nx):
                row[oW + i * nx + j] += gd * x[j]
            row[oU + i] += gd * uk
            row[ob + i] += gd
            row[oG + i] = h[i]
        for j in range(nx):
            row[oC + j] = x[j]
        row[oD] = uk
        row[oc] = 1.0
        for q in range(nx):
            v = th[oB + q] * uk
            for j in range(nx):
                v += th[q * nx + j] * x[j]
                a = th[q * nx + j]
                for i in range(H):
                    a += th[oE + q * H + i] * d[i] * th[oW + i * nx + j]
                Jx[q, j] = a
            for i in range(H):
                v += th[oE + q * H + i] * h[i]
            xn[q] = v
        for q in range(nx):
            Tq = T[q]
            a = Jx[q, 0]
            S0 = S[0]
            for p in range(PS + nx):
                Tq[p] = a * S0[p]
            for j in range(1, nx):
                a = Jx[q, j]
                Sj = S[j]
                for p in range(PS + nx):
                    Tq[p] += a * Sj[p]
            for j in range(nx):
                Tq[q * nx + j] += x[j]
            Tq[oB + q] += uk
            for i in range(H):
                Tq[oE + q * H + i] += h[i]
                ed = th[oE + q * H + i] * d[i]
                for j in range(nx):
                    Tq[oW + i * nx + j] += ed * x[j]
                Tq[oU + i] += ed * uk
                Tq[ob + i] += ed
        for j in range(nx):
            x[j] = xn[j]
        Z = S
        S = T
        T = Z


@dataclass
class Trainer:
    """Free-run LM on one record in scaled units, its input delayed already."""

    nx: int
    hidden: int
    v: np.ndarray
    y: np.ndarray
    decay: float
    trials: int = field(default=0, init=False)
    error: float = field(default=math.inf, init=False)

    def __post_init__(self) -> None:
        ends = offsets(self.nx, self.hidden)
        self.parameters = ends["G"]
        self.run, self.rows = (
            np.empty_like(self.y),
            np.empty((len(self.y), self.parameters + self.nx)),
        )
        self.weights = np.zeros(self.parameters + self.nx)
        self.weights[ends["B"] : ends["Wu"]] = self.decay
        self.weights[ends["Wu"] : ends["bh"]] = 0.1 * self.decay
        self.weights[ends["c"] : ends["G"]] = self.decay

    def _split(self, theta: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return theta, np.ascontiguousarray(theta[self.parameters :])

    def cost(self, theta: np.ndarray) -> float:
        self.trials += 1
        theta, x0 = self._split(theta)
        if simulate(theta, self.nx, self.hidden, self.v, x0, self.run):
            return math.inf
        e = self.y - self.run
        self.error = float(0.5 * (e @ e) / len(e))
        return self.error + float(0.5 * (self.weights * theta) @ theta)

    def normal(self, theta: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        theta, x0 = self._split(theta)
        sensitivities(theta, self.nx, self.hidden, self.v, x0, self.run, self.rows)
        e, n = self.y - self.run, len(self.y)
        left = self.rows.T @ self.rows / n
        left[np.diag_indices(len(theta))] += self.weights
        return left, self.rows.T @ e / n - self.weights * theta

    def train(self, theta: np.ndarray, iterations: int, mu: float) -> list[float]:
        """J, without weight decay, at the start and after each accepted step."""
        cost = self.cost(theta)
        trace = [self.error]
        for _ in range(iterations):
            left, right = self.normal(theta)
            while True:
                damped = left + mu * np.eye(len(theta))
                step = scipy.linalg.cho_solve(
                    scipy.linalg.cho_factor(damped, check_finite=False), right, check_finite=False
                )
                reached = self.cost(theta + step)
                if reached < cost:
                    break
                mu *= 4.0
            theta, mu, cost = theta + step, mu / 5.0, reached
            trace.append(self.error)
        return trace
