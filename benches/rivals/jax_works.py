"""What JAX does of the benchmarks, all of it jitted: each function prepares the work timed.

The inputs' part of the network is taken out of the recursion, sensitivities are a hand-written
scan (tangents through the scan, `jacfwd`, take nine times as long), Levenberg-Marquardt is one
compiled loop, and candidates and starts are mapped.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import problem

jax.config.update("jax_enable_x64", True)
# what was compiled in another run is loaded where JAX_COMPILATION_CACHE_DIR says
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)

Work = Callable[[], dict[str, Any]]
P = problem.PARAMETERS


def _lagged(u: jax.Array) -> jax.Array:
    """u(k-1), u(k-2), the first value before the record."""
    before = jnp.concatenate([u[:1], u[:1], u])
    return jnp.stack([before[1:-1], before[:-2]], 1)


def _simulate(theta: jax.Array, lagged: jax.Array, unroll: int) -> jax.Array:
    w1 = theta[:32].reshape(8, 4)
    moved = lagged @ w1[:, 2:].T + theta[32:40]
    a, b, w2, b2 = w1[:, 0], w1[:, 1], theta[40:48], theta[48]

    def step(past: Any, at: jax.Array) -> Any:
        y = w2 @ jnp.tanh(a * past[0] + b * past[1] + at) + b2
        return (y, past[0]), y

    return jax.lax.scan(step, (0.0, 0.0), moved, unroll=unroll)[1]


def _normal(theta: jax.Array, lagged: jax.Array, y: jax.Array) -> Any:
    """J, J'J/N, J'e/N: a free run, then one scan of sensitivities."""
    w1, w2 = theta[:32].reshape(8, 4), theta[40:48]
    run = _simulate(theta, lagged, 1)
    past = jnp.concatenate([jnp.zeros(2), run])
    x = jnp.concatenate([jnp.stack([past[1:-1], past[:-2]], 1), lagged], 1)
    h = jnp.tanh(x @ w1.T + theta[32:40])
    slope = w2 * (1 - h * h)
    gains = slope @ w1[:, :2]
    first = (slope[:, :, None] * x[:, None, :]).reshape(-1, 32)
    own = jnp.concatenate([first, slope, h, jnp.ones((len(h), 1))], 1)

    def step(before: Any, at: Any) -> Any:
        row = at[0] + at[1][0] * before[0] + at[1][1] * before[1]
        return (row, before[0]), row

    zero = jnp.zeros(P)
    rows = jax.lax.scan(step, (zero, zero), (own, gains), unroll=2)[1]
    e, n = y - run, len(y)
    return 0.5 * jnp.sum(e**2) / n, rows.T @ rows / n, rows.T @ e / n


def _trainer(iterations: int, mu: float) -> Any:
    u, y = (jnp.asarray(v) for v in problem.drive())
    lagged, n = _lagged(u), len(y)

    def cost(theta: jax.Array) -> jax.Array:
        return 0.5 * jnp.sum((y - _simulate(theta, lagged, 1)) ** 2) / n

    def attempt(s: Any) -> Any:
        mu, count, _, _, _, theta, value, left, right = s
        new = theta + jnp.linalg.solve(left + mu * jnp.eye(P), right)
        reached = cost(new)
        accepted = reached < value
        mu = jnp.where(accepted, mu, jnp.minimum(mu * 4, 1e10))
        return mu, count + 1, accepted, new, reached, theta, value, left, right

    def iteration(_: Any, s: Any) -> Any:
        theta, value, left, right, mu, trials = s
        first = (mu, 0, False, theta, value, theta, value, left, right)
        tried = jax.lax.while_loop(lambda q: (~q[2]) & (q[1] < 12), attempt, first)
        theta = jnp.where(tried[2], tried[3], theta)
        new = _normal(theta, lagged, y)
        return theta, *new, jnp.maximum(tried[0] / 5, 1e-14), trials + tried[1]

    def train(theta: jax.Array) -> Any:
        first = (theta, *_normal(theta, lagged, y), mu, 0)
        return jax.lax.fori_loop(0, iterations, iteration, first)

    return train


def training(iterations: int, mu: float) -> Work:
    """Levenberg-Marquardt from the common start."""
    train, theta = jax.jit(_trainer(iterations, mu)), jnp.asarray(problem.start())

    def work() -> dict[str, Any]:
        found = jax.block_until_ready(train(theta))
        return {"cost": float(found[1]), "trials": int(found[5])}

    return work


def several_starts(starts: int, iterations: int, mu: float) -> Work:
    """All starts mapped over one training."""
    train = jax.jit(jax.vmap(_trainer(iterations, mu)))
    thetas = jnp.asarray(np.stack([problem.start(seed) for seed in range(starts)]))

    def work() -> dict[str, Any]:
        return {"costs": sorted(np.asarray(jax.block_until_ready(train(thetas))[1]).tolist())}

    return work


def free_run(samples: int) -> Work:
    """Of the trained network."""
    lagged, theta = _lagged(jnp.asarray(problem.drive(samples)[0])), jnp.asarray(problem.trained())
    run = jax.jit(lambda theta: _simulate(theta, lagged, 2))

    def work() -> dict[str, Any]:
        out = np.asarray(run(theta))
        return {"last": float(out[-1]), "sum": float(out.sum())}

    return work


def jacobian_pass() -> Work:
    """J'J and J'e at the trained network, its own free run in it."""
    u, y = (jnp.asarray(v) for v in problem.drive())
    lagged, theta = _lagged(u), jnp.asarray(problem.trained())
    normal = jax.jit(lambda theta: _normal(theta, lagged, y))
    return lambda: {"cost": float(jax.block_until_ready(normal(theta))[0])}


def _loop(memory: int) -> Callable[[Any, Any], Any]:
    """Sum of squared errors of one candidate; with ``memory`` samples of feedback filter."""
    theta = jnp.asarray(problem.trained())
    w1, b1, w2, b2 = theta[:32].reshape(8, 4), theta[32:40], theta[40:48], theta[48]
    per_second = problem.COUNTS_PER_REV / 60.0 * problem.Y_SCALE
    half = 0.5 * problem.TS * per_second

    def loop(terms: Any, r: Any) -> Any:
        kp, ki, kd, pole, alpha, beta, tracking = terms

        def step(s: Any, rk: Any) -> Any:
            y1, y2, u1, i, d, last, position, counts = s
            if memory:
                count = jnp.floor(position)
                feedback = (count - counts[-1]) / (memory * problem.TS * per_second)
                counts = (count, *counts[:-1])
            else:
                feedback = y1
            e = rk - feedback
            rate = e - beta * rk
            d = pole * d + kd * (rate - last)
            i = i + ki * e
            wanted = kp * (e - alpha * rk) + i + d
            u = jnp.clip(wanted, 0.0, 1.0)
            i = i + tracking * (u - wanted)
            y = w2 @ jnp.tanh(w1 @ jnp.array([y1, y2, u, u1]) + b1) + b2
            position = position + half * (y1 + y)
            return (y, y1, u, i, d, rate, position, counts), (rk - y1) ** 2

        zero = 0.0
        start = (zero, zero, zero, zero, zero, (1 - beta) * r[0], 0.5, (zero,) * memory)
        return jnp.sum(jax.lax.scan(step, start, r)[1])

    return loop


def _mapped(number: int, memory: int) -> Work:
    terms = jnp.asarray(np.array(list(problem.terms(number).values())).T)
    r = jnp.asarray(problem.reference())
    run = jax.jit(jax.vmap(_loop(memory), (0, None)))

    def work() -> dict[str, Any]:
        total = np.asarray(run(terms, r))
        costs = problem.Y_SCALE * np.sqrt(total / problem.LOOP_SAMPLES)
        return {"mean": float(costs.mean()), "least": float(costs.min())}

    return work


def candidates(number: int) -> Work:
    """Closed loops over many candidates."""
    return _mapped(number, 0)


def encoded_candidates(number: int) -> Work:
    """The same with encoder and feedback filter."""
    return _mapped(number, problem.FILTER)
