"""Training of the 2-2-1 network with 8 tanh in free run, as an expert writes it with numba.

Parameters theta = [W1 (8 x 4) row by row, b1 (8), w2 (8), b2], J = 1/(2N) sum e^2,
Levenberg-Marquardt with mu I damping (times 4 on failure, divided by 5 on success). A branch-free
exponential lets the compiler vectorise over the hidden units, parameters are regrouped so that
every inner loop is contiguous, and the normal equations are one BLAS product.
"""

from __future__ import annotations

import numba
import numpy as np

HIDDEN = 8
N_PARAMETERS = 49
# column of the Jacobian (grouped by regressor) for each entry of theta (grouped by hidden unit)
_ORDER = np.concatenate([np.arange(32).reshape(4, 8).T.ravel(), np.arange(32, 49)])


@numba.njit(fastmath=True, inline="always")
def _exp2x(x):
    """exp(2x) = p 2^n: range reduction by Cody and Waite, Taylor polynomial of degree 11."""
    z = min(max(2.0 * x, -40.0), 40.0)
    n = np.rint(z * 1.4426950408889634)
    r = (z - n * 0.693145751953125) - n * 1.42860682030941723212e-6
    p = 1 / 39916800.0
    p = p * r + 1 / 3628800.0
    p = p * r + 1 / 362880.0
    p = p * r + 1 / 40320.0
    p = p * r + 1 / 5040.0
    p = p * r + 1 / 720.0
    p = p * r + 1 / 120.0
    p = p * r + 1 / 24.0
    p = p * r + 1 / 6.0
    p = p * r + 0.5
    p = p * r + 1.0
    p = p * r + 1.0
    return n, p


@numba.njit(fastmath=True, cache=True)
def simulate(theta, u, out):
    """Free run from rest into ``out``."""
    a, b = theta[0:32:4].copy(), theta[1:32:4].copy()
    c, d = theta[2:32:4].copy(), theta[3:32:4].copy()
    b1, w2, b2 = theta[32:40].copy(), theta[40:48].copy(), theta[48]
    p, power = np.empty(8), np.empty(8, np.int64)
    scale = power.view(np.float64)
    y1 = y2 = 0.0
    u1 = u2 = u[0]
    for k in range(u.shape[0]):
        for i in range(8):
            n, p[i] = _exp2x(a[i] * y1 + (b[i] * y2 + (c[i] * u1 + (d[i] * u2 + b1[i]))))
            power[i] = (np.int64(n) + 1023) << 52
        s = b2
        for i in range(8):
            s += w2[i] * (1.0 - 2.0 / (1.0 + p[i] * scale[i]))
        out[k] = s
        y2, y1 = y1, s
        u2, u1 = u1, u[k]
    return out


@numba.njit(fastmath=True, cache=True)
def cost(theta, u, y, out):
    """J of the free run."""
    simulate(theta, u, out)
    total = 0.0
    for k in range(y.shape[0]):
        total += (y[k] - out[k]) ** 2
    return 0.5 * total / y.shape[0]


@numba.njit(fastmath=True, cache=True)
def residuals_and_jacobian(theta, u, y, error, jacobian):
    """Free-run errors and forward sensitivities; columns grouped by regressor."""
    a, b = theta[0:32:4].copy(), theta[1:32:4].copy()
    c, d = theta[2:32:4].copy(), theta[3:32:4].copy()
    b1, w2, b2 = theta[32:40].copy(), theta[40:48].copy(), theta[48]
    p, power = np.empty(8), np.empty(8, np.int64)
    scale = power.view(np.float64)
    h, slope = np.empty(8), np.empty(8)
    zero = np.zeros(N_PARAMETERS)
    y1 = y2 = 0.0
    u1 = u2 = u[0]
    for k in range(u.shape[0]):
        for i in range(8):
            n, p[i] = _exp2x(a[i] * y1 + (b[i] * y2 + (c[i] * u1 + (d[i] * u2 + b1[i]))))
            power[i] = (np.int64(n) + 1023) << 52
        s, s1, s2 = b2, 0.0, 0.0
        for i in range(8):
            h[i] = 1.0 - 2.0 / (1.0 + p[i] * scale[i])
            slope[i] = w2[i] * (1.0 - h[i] * h[i])
            s += w2[i] * h[i]
            s1 += slope[i] * a[i]
            s2 += slope[i] * b[i]
        row = jacobian[k]
        last = jacobian[k - 1] if k > 0 else zero
        before = jacobian[k - 2] if k > 1 else zero
        for i in range(8):
            row[i] = slope[i] * y1 + s1 * last[i] + s2 * before[i]
        for i in range(8, 16):
            row[i] = slope[i - 8] * y2 + s1 * last[i] + s2 * before[i]
        for i in range(16, 24):
            row[i] = slope[i - 16] * u1 + s1 * last[i] + s2 * before[i]
        for i in range(24, 32):
            row[i] = slope[i - 24] * u2 + s1 * last[i] + s2 * before[i]
        for i in range(32, 40):
            row[i] = slope[i - 32] + s1 * last[i] + s2 * before[i]
        for i in range(40, 48):
            row[i] = h[i - 40] + s1 * last[i] + s2 * before[i]
        row[48] = 1.0 + s1 * last[48] + s2 * before[48]
        error[k] = y[k] - s
        y2, y1 = y1, s
        u2, u1 = u1, u[k]


class Trainer:
    """Levenberg-Marquardt with buffers that are allocated once."""

    def __init__(self, u, y):
        self.u, self.y = np.ascontiguousarray(u), np.ascontiguousarray(y)
        self.error = np.empty(len(u))
        self.jacobian = np.empty((len(u), N_PARAMETERS))
        self.out = np.empty(len(u))

    def normal_equations(self, theta):
        """J, J'J/N and J'e/N in the order of theta."""
        residuals_and_jacobian(theta, self.u, self.y, self.error, self.jacobian)
        n = len(self.y)
        gram, gradient = self.jacobian.T @ self.jacobian / n, self.jacobian.T @ self.error / n
        value = 0.5 * (self.error @ self.error) / n
        return value, gram[np.ix_(_ORDER, _ORDER)], gradient[_ORDER]

    def train(self, theta, iterations, mu=1e-2):
        """Return theta, J, number of trials."""
        value, gram, gradient = self.normal_equations(theta)
        identity, trials = np.eye(N_PARAMETERS), 0
        for _ in range(iterations):
            accepted = False
            for _ in range(12):
                trial = theta + np.linalg.solve(gram + mu * identity, gradient)
                trials += 1
                trial_value = cost(trial, self.u, self.y, self.out)
                if np.isfinite(trial_value) and trial_value < value:
                    accepted = True
                    break
                mu = min(mu * 4, 1e10)
            if not accepted:
                break
            theta, mu = trial, max(mu / 5, 1e-14)
            value, gram, gradient = self.normal_equations(theta)
        return theta, value, trials
