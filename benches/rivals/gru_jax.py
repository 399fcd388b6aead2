"""A GRU of the size of our networks, trained with JAX as is usual: Adam, windows, early stopping.

    python benches/rivals/gru_jax.py FILE.csv [HIDDEN] [SEED]

The first 60 % of the columns u and y train, of which the last fifth stops the training; the last
40 % are scored in free run after 20 samples, which set the state by teacher-free warming up.
"""

from __future__ import annotations

import sys
import time

import jax
import jax.numpy as jnp
import numpy as np

jax.config.update("jax_enable_x64", True)
WINDOW, WASHOUT, BATCH, STEPS, RATE = 300, 50, 16, 3000, 5e-3


def initial(key: jax.Array, hidden: int) -> dict[str, jax.Array]:
    """Weights of the gates, of the candidate and of the read-out with its direct part."""
    keys = jax.random.split(key, 3)
    scale = 1.0 / np.sqrt(hidden + 1)
    gates = scale * jax.random.normal(keys[0], (2, hidden, hidden + 2))
    candidate = scale * jax.random.normal(keys[1], (hidden, hidden + 2))
    readout = scale * jax.random.normal(keys[2], (hidden + 2,))
    return {"gates": gates, "candidate": candidate, "readout": readout}


def free_run(p: dict[str, jax.Array], u: jax.Array) -> jax.Array:
    """Outputs of (N,) inputs from a state of zeros."""

    def step(h: jax.Array, u_k: jax.Array) -> tuple[jax.Array, jax.Array]:
        x = jnp.concatenate([h, jnp.array([u_k, 1.0])])
        update, reset = jax.nn.sigmoid(p["gates"] @ x)
        proposed = jnp.tanh(p["candidate"] @ jnp.concatenate([reset * h, x[-2:]]))
        return (1.0 - update) * h + update * proposed, p["readout"] @ x

    return jax.lax.scan(step, jnp.zeros(p["candidate"].shape[0]), u)[1]


def trained(u: np.ndarray, y: np.ndarray, hidden: int, seed: int) -> dict[str, jax.Array]:
    """The weights that did best on the last fifth."""
    at = int(0.8 * len(u))
    rng, p = np.random.default_rng(seed), initial(jax.random.key(seed), hidden)
    runs = jax.vmap(free_run, (None, 0))
    loss = jax.jit(
        jax.value_and_grad(
            lambda p, u, y: jnp.mean((runs(p, u)[:, WASHOUT:] - y[:, WASHOUT:]) ** 2)
        )
    )
    held = jax.jit(lambda p: jnp.mean((free_run(p, u)[at:] - y[at:]) ** 2))
    first, second = (jax.tree.map(jnp.zeros_like, p) for _ in range(2))
    best, best_error = p, np.inf
    for k in range(1, STEPS + 1):
        starts = rng.integers(0, at - WINDOW, BATCH)
        _, g = loss(p, *(np.stack([v[s : s + WINDOW] for s in starts]) for v in (u, y)))
        rate = RATE * 0.5 * (1.0 + np.cos(np.pi * k / STEPS))
        first = jax.tree.map(lambda m, g: 0.9 * m + 0.1 * g, first, g)
        second = jax.tree.map(lambda v, g: 0.999 * v + 0.001 * g * g, second, g)
        root, bias = np.sqrt(1.0 - 0.999**k), 1.0 - 0.9**k
        p = jax.tree.map(
            lambda w, m, v, s=rate * root / bias: w - s * m / (jnp.sqrt(v) + 1e-8),
            p,
            first,
            second,
        )
        if k % 50 == 0 and (error := float(held(p))) < best_error:
            best, best_error = p, error
    return best


def main() -> None:
    """Train and score."""
    table = np.genfromtxt(sys.argv[1], delimiter=",", names=True)
    hidden = int(sys.argv[2]) if len(sys.argv) > 2 else 5
    seed = int(sys.argv[3]) if len(sys.argv) > 3 else 0
    u, y = np.asarray(table["u"]), np.asarray(table["y"])
    n = int(0.6 * len(u))
    mean, scale = u[:n].mean(), u[:n].std()
    y_mean, y_scale = y[:n].mean(), y[:n].std()
    u = (u - mean) / scale
    began = time.perf_counter()
    p = trained(u[:n], (y[:n] - y_mean) / y_scale, hidden, seed)
    # warmed up through the training record: more than the first 20 samples would give it
    run = np.asarray(free_run(p, jnp.asarray(u))) * y_scale + y_mean
    rmse = float(np.sqrt(np.mean((y - run)[n + 20 :] ** 2)))
    size = sum(w.size for w in jax.tree.leaves(p))
    print(f"GRU {hidden}, {size} parameters, seed {seed}: {rmse:.4g}", end=" ")
    print(f"in {time.perf_counter() - began:.0f} s")


if __name__ == "__main__":
    main()
