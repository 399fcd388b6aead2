"""Stand-in for the core's guard while it is being written."""

from __future__ import annotations

import numpy as np

from ..errors import FitError
from ..models.base import INIT


def _memory(linear, pairs, W):
    v = 0.0
    for l in linear:
        for U, Y in pairs:
            U, Y = np.ascontiguousarray(U[:20000]), np.ascontiguousarray(Y[:20000])
            L = len(U) // 8
            if L < 100:
                continue
            x0 = l.estimate_initial_state(U[:INIT], Y[:INIT])
            r = l.simulate(U, x0)
            order = [(i + 1) * 3 % 8 for i in range(8)]
            q = l.simulate(
                np.ascontiguousarray(np.concatenate([U[i * L : (i + 1) * L] for i in order])), x0
            )
            v = max(
                v,
                np.mean(
                    np.concatenate(
                        [
                            np.abs(
                                q[j * L + L // 2 : (j + 1) * L] - r[i * L + L // 2 : (i + 1) * L]
                            )
                            for j, i in enumerate(order)
                        ]
                    )
                ),
            )
    return min(1.5 * v, 0.3 * W) + 0.03 * W


def guard(m, pairs, *, linear=()):
    y = np.concatenate([p[1] for p in pairs])
    lo, hi = np.nanmin(y), np.nanmax(y)
    W = hi - lo
    st = m.settings
    for U, Y in pairs:
        U, Y = np.ascontiguousarray(U[:20000]), np.ascontiguousarray(Y[:20000])
        N = len(U)
        try:
            x0 = m.estimate_initial_state(U[:INIT], Y[:INIT])
            r = m.simulate(U, x0)
            big = m.simulate(np.ascontiguousarray(U.mean(0) + 1.25 * (U - U.mean(0))), x0)
            if big.min() < lo - W or big.max() > hi + W:
                return "runs away on inputs a quarter larger"
            if st.get("integrator"):
                continue
            if "state_covariance" in st:
                sd = np.sqrt(np.maximum(np.diag(st["state_covariance"]), 0))
                mu = st["state_mean"]
                sides = [np.ascontiguousarray(mu + s * 3 * sd) for s in (1, -1)]
            else:
                sides = [np.full(len(x0), v) for v in (lo - 0.25 * W, hi + 0.25 * W)]
            for x in sides:
                q = m.simulate(U, x)
                if np.mean(np.abs(q - r)[-N // 10 :]) > 0.2 * W:
                    return "does not forget its initial state"
            L = N // 8
            if L >= 100:
                for step in (3, 5):
                    order = [(i + 1) * step % 8 for i in range(8)]
                    q = m.simulate(
                        np.ascontiguousarray(
                            np.concatenate([U[i * L : (i + 1) * L] for i in order])
                        ),
                        x0,
                    )
                    if q.min() < lo - 0.5 * W or q.max() > hi + 0.5 * W:
                        return "runs away on inputs in another order"
                    t = np.concatenate(
                        [
                            np.abs(
                                q[j * L + L // 2 : (j + 1) * L] - r[i * L + L // 2 : (i + 1) * L]
                            )
                            for j, i in enumerate(order)
                        ]
                    )
                    if np.mean(t) > _memory(linear, pairs, W):
                        return "depends on the order of its inputs"
        except FitError:
            return "runs away"
    return ""


def grown(m, nx, H, seed):
    import math

    from .. import _core

    rng = np.random.default_rng([seed, nx, H])
    st = m.settings
    nx0, H0, nu = st["nx"], st["hidden"], st["n_inputs"]
    th = m.theta
    P = {}
    i = 0
    for name, sh in (
        ("A", (nx0, nx0)),
        ("B", (nx0, nu)),
        ("E", (nx0, H0)),
        ("Wx", (H0, nx0)),
        ("Wu", (H0, nu)),
        ("b", (H0,)),
        ("C", (1, nx0)),
        ("D", (1, nu)),
        ("c", (1,)),
        ("G", (1, H0)),
    ):
        k = int(np.prod(sh))
        P[name] = th[i : i + k].reshape(sh).copy()
        i += k
    dn, dh = nx - nx0, H - H0
    r = 1e-3
    w = 1 / math.sqrt(nx + nu)
    cov = st["state_covariance"]
    A = np.zeros((nx, nx))
    A[:nx0, :nx0] = P["A"]
    B = np.zeros((nx, nu))
    B[:nx0] = P["B"]
    E = r * rng.normal(size=(nx, H))
    E[:nx0, :H0] = P["E"]
    Wx = w * rng.normal(size=(H, nx))
    Wx[:H0, :nx0] = P["Wx"]
    Wu = w * rng.normal(size=(H, nu))
    Wu[:H0] = P["Wu"]
    if dn:
        Wx[:H0, nx0:] = 0
    b = rng.uniform(-1, 1, H)
    b[:H0] = P["b"]
    C = r * rng.normal(size=(1, nx))
    C[:, :nx0] = P["C"]
    G = r * rng.normal(size=(1, H))
    G[:, :H0] = P["G"]
    for j in range(dn):
        a = rng.uniform(0.5, 0.98)
        A[nx0 + j, nx0 + j] = a
        q = math.sqrt(1 - a * a)
        A[nx0 + j, :nx0] = 0.5 * q * rng.normal(size=nx0)
        B[nx0 + j] = 0.5 * q * rng.normal(size=nu)
    K = np.eye(nx)
    K[:nx0, :nx0] = cov
    mu = np.zeros(nx)
    mu[:nx0] = st["state_mean"]
    if st["integrator"]:
        pm = list(range(nx0 - 1)) + list(range(nx0, nx)) + [nx0 - 1]
        A, B, E, Wx, C, K, mu = (
            A[np.ix_(pm, pm)],
            B[pm],
            E[pm],
            Wx[:, pm],
            C[:, pm],
            K[np.ix_(pm, pm)],
            mu[pm],
        )
        A[:-1, -1] = 0
        A[-1, -1] = 1
        Wx[:, -1] = 0
    th = np.concatenate([x.ravel() for x in (A, B, E, Wx, Wu, b, C, P["D"], P["c"], G)])
    return _core.NeuralSS(
        **{**st, "nx": nx, "hidden": H, "theta": th, "state_mean": mu, "state_covariance": K}
    )
