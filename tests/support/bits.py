"""Results of every kind of computation as JSON, to the last bit: they compare two builds."""

from __future__ import annotations

import json
from typing import Any

import numpy as np

import sewfast


def record(seed: int, n: int = 1500) -> tuple[np.ndarray, sewfast.Dataset]:
    """Command and data of a drive with friction and a saturating command, in RPM."""
    rng = np.random.default_rng(seed)
    u = np.repeat(rng.uniform(-10.0, 10.0, n // 30), 30)
    y = np.zeros(n)
    for k in range(1, n):
        y[k] = 0.95 * y[k - 1] + 12.0 * np.tanh(u[k - 1] / 4.0) - 0.5 * np.sign(y[k - 1])
    y += rng.normal(0.0, 0.3, n)
    return u, sewfast.Dataset.from_arrays(u, y, 1e-3, output_unit="rpm")


def found() -> dict[str, Any]:
    (_, data), (fresh, _) = record(1), record(2)
    values: dict[str, Any] = {}
    for kind in ("arx", "oe", "neural_oe", "neural_ss", "grey_box", "hammerstein_wiener"):
        model = sewfast.identify(data, model=kind, seed=0, threads=1)
        values[kind] = model.simulate(fresh).tolist()
    tuned = sewfast.tune(sewfast.identify(data, model="oe", threads=1), evaluations=300, threads=1)
    values["tune"] = tuned.controller.to_dict()["gains"]
    machine = sewfast.VirtualMachine(seed=0)
    values["recording"] = sewfast.record(machine, np.full(500, 2.0)).counts.tolist()
    return values


if __name__ == "__main__":
    # repr of a float is exact
    print(json.dumps(found(), indent=1))
