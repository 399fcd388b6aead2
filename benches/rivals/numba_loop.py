"""Closed loops of the network and a two-degree-of-freedom PID, as an expert writes them with numba.

Scaled units. Many candidates: each sample's arithmetic runs over a block of candidates, which the
compiler turns into SIMD, with the branch-free exponential of `numba_oe`. One loop: SIMD over the
hidden units. The average over speeds from an encoder is one difference of its counts.
"""

from __future__ import annotations

import numba
import numpy as np

from .numba_oe import _exp2x

BLOCK = 128
"""Candidates whose states stay in the first cache."""


@numba.njit(fastmath=True, cache=True)
def _network(theta, y1, y2, u1, u2, s, p, power):
    """Next outputs of a block into ``s``; ``p`` and ``power`` are room."""
    scale = power.view(np.float64)
    s[:] = theta[48]
    for i in range(8):
        a, b, c, d = theta[4 * i], theta[4 * i + 1], theta[4 * i + 2], theta[4 * i + 3]
        bias, weight = theta[32 + i], theta[40 + i]
        for m in range(s.shape[0]):
            n, p[m] = _exp2x(a * y1[m] + b * y2[m] + c * u1[m] + d * u2[m] + bias)
            power[m] = (np.int64(n) + 1023) << 52
        for m in range(s.shape[0]):
            s[m] += weight * (1.0 - 2.0 / (1.0 + p[m] * scale[m]))


@numba.njit(fastmath=True, cache=True)
def _block(theta, terms, r, total):
    kp, ki, kd, pole, alpha, beta, tracking = terms
    m_all = kp.shape[0]
    state = np.zeros((8, m_all))
    y1, y2, u1, u2, integral, derivative = (
        state[0],
        state[1],
        state[2],
        state[3],
        state[4],
        state[5],
    )
    s, p, power = state[6], state[7], np.zeros(m_all, np.int64)
    last = (1.0 - beta) * r[0]
    total[:] = 0.0
    for k in range(r.shape[0]):
        rk = r[k]
        for m in range(m_all):
            e = rk - y1[m]
            rate = e - beta[m] * rk
            derivative[m] = pole[m] * derivative[m] + kd[m] * (rate - last[m])
            last[m] = rate
            i = integral[m] + ki[m] * e
            wanted = kp[m] * (e - alpha[m] * rk) + i + derivative[m]
            u = min(max(wanted, 0.0), 1.0)
            integral[m] = i + tracking[m] * (u - wanted)
            total[m] += e * e
            u2[m] = u1[m]
            u1[m] = u
        _network(theta, y1, y2, u1, u2, s, p, power)
        for m in range(m_all):
            y2[m] = y1[m]
            y1[m] = s[m]


@numba.njit(fastmath=True, cache=True)
def _encoded_block(theta, terms, r, step, per_count, memory, total):
    """As `_block`; positions in counts, ``step`` counts per scaled unit and half a sample."""
    kp, ki, kd, pole, alpha, beta, tracking = terms
    m_all = kp.shape[0]
    state = np.zeros((9, m_all))
    y1, y2, u1, u2, integral, derivative = (
        state[0],
        state[1],
        state[2],
        state[3],
        state[4],
        state[5],
    )
    s, p, position, power = state[6], state[7], state[8], np.zeros(m_all, np.int64)
    position[:] = 0.5
    counts = np.zeros((memory, m_all))
    last = (1.0 - beta) * r[0]
    total[:] = 0.0
    for k in range(r.shape[0]):
        rk, oldest = r[k], counts[k % memory]
        for m in range(m_all):
            count = np.floor(position[m])
            feedback = (count - oldest[m]) * per_count
            oldest[m] = count
            true = rk - y1[m]
            e = rk - feedback
            rate = e - beta[m] * rk
            derivative[m] = pole[m] * derivative[m] + kd[m] * (rate - last[m])
            last[m] = rate
            i = integral[m] + ki[m] * e
            wanted = kp[m] * (e - alpha[m] * rk) + i + derivative[m]
            u = min(max(wanted, 0.0), 1.0)
            integral[m] = i + tracking[m] * (u - wanted)
            total[m] += true * true
            u2[m] = u1[m]
            u1[m] = u
        _network(theta, y1, y2, u1, u2, s, p, power)
        for m in range(m_all):
            position[m] += step * (y1[m] + s[m])
            y2[m] = y1[m]
            y1[m] = s[m]


@numba.njit(fastmath=True, cache=True)
def candidates(theta, terms, r, total):
    """Sum of squared errors of every candidate; ``terms`` is (7, candidates)."""
    for first in range(0, terms.shape[1], BLOCK):
        end = min(first + BLOCK, terms.shape[1])
        _block(theta, terms[:, first:end].copy(), r, total[first:end])


@numba.njit(fastmath=True, cache=True)
def encoded_candidates(theta, terms, r, step, per_count, memory, total):
    """The same with the speed from an encoder's counts, averaged over ``memory`` samples."""
    for first in range(0, terms.shape[1], BLOCK):
        end = min(first + BLOCK, terms.shape[1])
        block = terms[:, first:end].copy()
        _encoded_block(theta, block, r, step, per_count, memory, total[first:end])


@numba.njit(fastmath=True, cache=True)
def one(theta, terms, r, y, u):
    """Outputs and commands of one loop."""
    a, b = theta[0:32:4].copy(), theta[1:32:4].copy()
    c, d = theta[2:32:4].copy(), theta[3:32:4].copy()
    b1, w2, b2 = theta[32:40].copy(), theta[40:48].copy(), theta[48]
    p, power = np.empty(8), np.empty(8, np.int64)
    scale = power.view(np.float64)
    kp, ki, kd, pole, alpha, beta, tracking = terms
    y1 = y2 = u1 = u2 = integral = derivative = 0.0
    last = (1.0 - beta) * r[0]
    for k in range(r.shape[0]):
        y[k] = y1
        e = r[k] - y1
        rate = e - beta * r[k]
        derivative = pole * derivative + kd * (rate - last)
        last = rate
        integral += ki * e
        wanted = kp * (e - alpha * r[k]) + integral + derivative
        u2, u1 = u1, min(max(wanted, 0.0), 1.0)
        integral += tracking * (u1 - wanted)
        u[k] = u1
        for i in range(8):
            n, p[i] = _exp2x(a[i] * y1 + (b[i] * y2 + (c[i] * u1 + (d[i] * u2 + b1[i]))))
            power[i] = (np.int64(n) + 1023) << 52
        s = b2
        for i in range(8):
            s += w2[i] * (1.0 - 2.0 / (1.0 + p[i] * scale[i]))
        y2, y1 = y1, s
