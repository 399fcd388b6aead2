"""Plants with known parameters for the tests of identification."""

import numpy as np

from sewfast.dataset import Dataset, FloatArray

A = np.array([-1.5, 0.56])
B = np.array([[0.4, 0.2]])
OFFSET = 1.0


def steps(n: int, seed: int, inputs: int = 1) -> FloatArray:
    """Random levels, each held for 7 samples."""
    levels = np.random.default_rng(seed).uniform(-5.0, 5.0, (n // 7 + 1, inputs))
    return np.repeat(levels, 7, axis=0)[:n]


def linear(u: FloatArray, a: FloatArray = A, b: FloatArray = B, nk: int = 1) -> FloatArray:
    """y(k) = -a y + b u + 1, from rest, input held at its first value before the start."""
    y = np.zeros(len(u))
    for k in range(len(u)):
        past = sum(-a[i] * y[k - 1 - i] for i in range(len(a)) if k > i)
        held = u[np.maximum(k - nk - np.arange(b.shape[1]), 0)]
        y[k] = past + (b.T * held).sum() + OFFSET
    return y


def linear_data(
    n: int = 600, seed: int = 0, noise: float = 0.0, name: str = "linear", inputs: int = 1
) -> Dataset:
    """A recording of the linear plant, with white measurement noise of that standard deviation."""
    u = steps(n, seed, inputs)
    b = np.vstack([B * (j + 1) for j in range(inputs)])
    y = linear(u, b=b) + noise * np.random.default_rng(seed + 1).standard_normal(n)
    return Dataset.from_arrays(
        u,
        y,
        0.01,
        input_units=["V"] * inputs,
        output_name="speed",
        output_unit="RPM",
        name=name,
        channels={"truth": linear(u, b=b)},
    )


def bent_data(n: int = 800, seed: int = 0, noise: float = 0.0, name: str = "bent") -> Dataset:
    """A lag whose input saturates: no linear model fits it."""
    u = steps(n, seed)
    x = 3.0 * np.tanh(u[:, 0] / 2.0)
    y = np.zeros(n)
    for k in range(1, n):
        y[k] = 0.9 * y[k - 1] + 0.1 * x[k - 1]
    y += noise * np.random.default_rng(seed + 1).standard_normal(n)
    return Dataset.from_arrays(u, y, 0.01, input_units="V", output_unit="RPM", name=name)
