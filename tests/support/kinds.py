"""One model of every kind that `identify` gives, with recordings of the plant that it describes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import Any, Literal

import numpy as np

from sewfast import ARX, IV, Dataset, Ensemble, LinearOE, Model, NeuralOE, NeuralSS, _core
from sewfast.evidence import with_training_evidence
from sewfast.models.base import Combine
from sewfast.models.grey_box import NAMES, GreyBox
from sewfast.models.hammerstein import HammersteinWiener

TS = 0.01


@dataclass(frozen=True)
class Case:
    """How one model is made: without training, from numbers of its kind.

    Attributes
    ----------
    make : callable
        The model as its kind's trainer would give it, with the range of the inputs.
    evidence : bool
        Whether it stores what `identify` adds (region, uncertainty, information).
    deploys : bool
        Whether there is a form of it for a microcontroller.
    """

    make: Callable[[], Model]
    evidence: bool = True
    deploys: bool = True


def levels(n: int, seed: int, inputs: int) -> Any:
    """Random levels, each held for 9 samples, (n, inputs)."""
    drawn = np.random.default_rng(seed).uniform(-3.0, 5.0, (n // 9 + 1, inputs))
    return np.repeat(drawn, 9, axis=0)[:n]


def recording(model: Model, n: int = 700, seed: int = 1, noise: float = 0.02) -> Dataset:
    """Steps on the plant that the model describes, with white noise on its output."""
    u = levels(n, seed, len(model.input_names))
    y = model.core.simulate(u, model.core.rest_state())
    y = y + noise * max(float(y.std()), 1.0) * np.random.default_rng(seed + 99).normal(size=n)
    return Dataset.from_arrays(
        u, y, TS, input_names=model.input_names, input_units=model.input_units,
        output_name=model.output_name, output_unit=model.output_unit, name=f"record {seed}",
    )  # fmt: skip


@cache
def model_of(name: str) -> Model:
    """The model of a case, with the evidence of its own training record."""
    case = CASES[name]
    model = case.make()
    return with_training_evidence(model, recording(model)) if case.evidence else model


def _wrapped(cls: Any, core: Any, inputs: int, **training: Any) -> Any:
    names = ("u",) if inputs == 1 else tuple(f"u{i + 1}" for i in range(inputs))
    known = {"input_range": [[-3.0, 5.0]] * inputs, "output_range": [-20.0, 40.0], "samples": 700}
    return cls(core, TS, names, "speed", ("V",) * inputs, "RPM", None, {**known, **training})


def _linear(cls: Any, nk: int = 1, inputs: int = 1, pole: float = 0.8, na: int = 2) -> Any:
    a = np.poly([pole, 0.3][:na])[1:]
    b = np.array([[0.4, 0.3], [1.0, -0.2], [0.2, 0.2]])[:inputs]
    return _wrapped(cls, _core.LinearModel(a, b, nk, 0.5), inputs)


def _hammerstein_wiener(
    nk: int = 1, inputs: int = 1, pieces: tuple[int, int] = (4, 3), na: int = 2
) -> Any:
    a, b = np.poly([0.8, 0.3][:na])[1:], np.tile([0.4, 0.3], inputs)
    bends = np.tile([-0.1, 0.05, 0.12, 0.0, 0.03][: pieces[0] - 1], inputs)
    slopes = np.array([0.6, -0.5, 0.3])[: pieces[1] - 1]
    core = _core.HammersteinWiener(
        na=na, nb=2, nk=nk, input_low=np.full(inputs, -3.0), input_high=np.full(inputs, 5.0),
        input_pieces=pieces[0], x_low=-20.0, x_high=40.0, output_pieces=pieces[1],
        theta=np.concatenate([a, b, [0.5], bends, slopes]),
    )  # fmt: skip
    return _wrapped(HammersteinWiener, core, inputs)


def _grey_box(hidden: int = 3, delay: float = 0.0, free: tuple[str, ...] = ()) -> Any:
    motor = {
        "k_e": 0.019, "k_a": 0.004, "tau": 0.007, "k_s": 0.2, "offset": 0.1, "drop": 0.06,
        "ripple": 0.2, "k_t": 0.05, "w_s": 9.0, "k_b": 0.001, "delay": delay, "limit": np.inf,
    }  # fmt: skip
    names = free or ("k_e", "k_a", "tau", "k_s", "offset", "drop", "ripple", "k_t", "w_s")
    network = np.random.default_rng(2).normal(size=(hidden, 4)) * [0.5, 1.0, 1.0, 0.1]
    core = _core.GreyBox(
        values=np.array([motor.get(n, 0.0) for n in NAMES]), free=[NAMES.index(n) for n in names],
        Ts=TS, steps=4, mean=True, unit=2.0 * np.pi / 60.0, speed_scale=120.0, command_scale=2.5,
        residual_variance=4.0, process_noise=1e-4,
        theta=np.concatenate([[motor[n] for n in names], network.ravel()]),
    )  # fmt: skip
    return _wrapped(GreyBox, core, 1)


def _neural_oe(nk: int = 1, inputs: int = 1, bypass: bool = True, saturates: bool = False) -> Any:
    rng = np.random.default_rng(4)
    na, nb, hidden = 2, 2, 3
    width = na + nb * inputs
    linear = np.concatenate([[0.9, -0.2], np.tile([0.2, 0.1], inputs)])
    parts = [0.3 * rng.normal(size=hidden * width), 0.2 * rng.normal(size=hidden)]
    parts += [0.1 * rng.normal(size=hidden), np.array([0.05])]
    core = _core.NeuralOE(
        na=na, nb=nb, nk=nk, n_inputs=inputs, hidden=hidden, bypass=bypass,
        theta=np.concatenate([*parts, linear] if bypass else parts),
        u_mean=np.full(inputs, 1.0), u_scale=np.full(inputs, 2.3), y_mean=4.0, y_scale=8.0,
        output_low=-1.5 if saturates else None, output_high=1.5 if saturates else None,
    )  # fmt: skip
    return _wrapped(NeuralOE, core, inputs, weight_decay=1e-4)


def _neural_ss(
    output: Literal["linear", "saturation", "abs"] = "linear",
    nk: int = 1,
    inputs: int = 1,
    nx: int = 2,
    integrator: bool = False,
    seed: int = 3,
) -> Any:
    rng = np.random.default_rng(seed)
    hidden, free = 3, nx - 1 if integrator else nx
    A, Wx = np.zeros((nx, nx)), 0.3 * rng.normal(size=(hidden, nx))
    A[:free, :free] = np.diag([0.85, 0.6, 0.3][:free])
    if integrator:
        A[-1] = 0.05
        A[-1, -1] = 1.0
        Wx[:, -1] = 0.0
    C, c = np.full((1, nx), 1.0), np.zeros(1)
    if integrator:
        C, c = np.eye(1, nx, nx - 1), np.zeros(1)
    parts = [
        A, 0.3 * np.ones((nx, inputs)), 0.05 * rng.normal(size=(nx, hidden)), Wx,
        0.3 * rng.normal(size=(hidden, inputs)), 0.2 * rng.normal(size=hidden), C,
        (0.1 if nk else 0.05) * np.ones((1, inputs)), c, 0.05 * rng.normal(size=(1, hidden)),
    ]  # fmt: skip
    if integrator:
        parts[-1] *= 0.0
    given = {"linear": [], "saturation": [-1.2, 1.5, 0.2], "abs": [0.1]}[output]
    core = _core.NeuralSS(
        nx=nx, nk=nk, n_inputs=inputs, n_outputs=1, hidden=hidden, integrator=integrator,
        output=output, output_parameters=np.array(given, dtype=np.float64),
        theta=np.concatenate([np.ravel(p) for p in parts]), u_mean=np.full(inputs, 1.0),
        u_scale=np.full(inputs, 2.3), y_mean=np.array([0.0 if output == "abs" else 4.0]),
        y_scale=np.array([8.0]), state_mean=np.zeros(nx), state_covariance=np.eye(nx),
        residual_variance=np.array([1e-3]), process_noise=1e-3,
    )  # fmt: skip
    return _wrapped(NeuralSS, core, inputs, weight_decay=1e-4)


def _ensemble(*members: Model, combine: Combine = "median") -> Ensemble:
    """As `identify` gives one: the range of the inputs is stored with the ensemble alone."""
    single = [type(m)(*(getattr(m, f) for f in _FIELDS)) for m in members]
    return Ensemble.of(single, combine, dict(members[0].training))


_FIELDS = ("core", "Ts", "input_names", "output_name", "input_units", "output_unit")

CASES: dict[str, Case] = {
    "arx": Case(lambda: _linear(ARX)),
    "arx, nk 0": Case(lambda: _linear(ARX, nk=0)),
    "arx, two inputs, nk 2": Case(lambda: _linear(ARX, nk=2, inputs=2)),
    "iv": Case(lambda: _linear(IV)),
    "oe": Case(lambda: _linear(LinearOE)),
    "oe, na 1": Case(lambda: _linear(LinearOE, na=1)),
    "oe, three inputs": Case(lambda: _linear(LinearOE, inputs=3)),
    "oe, integrator": Case(lambda: _linear(LinearOE, pole=1.0)),
    "oe without evidence": Case(lambda: _linear(LinearOE), evidence=False),
    "hammerstein_wiener": Case(_hammerstein_wiener, deploys=False),
    "hammerstein_wiener, nk 0": Case(
        lambda: _hammerstein_wiener(nk=0, pieces=(4, 1)), deploys=False
    ),
    "hammerstein_wiener, two inputs": Case(
        lambda: _hammerstein_wiener(nk=2, inputs=2), deploys=False
    ),
    "wiener, na 1": Case(lambda: _hammerstein_wiener(pieces=(1, 4), na=1), deploys=False),
    "grey_box": Case(_grey_box, deploys=False),
    "grey_box, no network": Case(lambda: _grey_box(hidden=0), deploys=False),
    "grey_box, late by 1.4 samples": Case(lambda: _grey_box(delay=0.014), deploys=False),
    "neural_oe": Case(_neural_oe),
    "neural_oe, nk 0": Case(lambda: _neural_oe(nk=0)),
    "neural_oe, nk 2, no bypass": Case(lambda: _neural_oe(nk=2, bypass=False)),
    "neural_oe, saturates": Case(lambda: _neural_oe(saturates=True)),
    "neural_oe, two inputs": Case(lambda: _neural_oe(inputs=2)),
    "neural_ss": Case(_neural_ss),
    "neural_ss, one state": Case(lambda: _neural_ss(nx=1)),
    "neural_ss, nk 0": Case(lambda: _neural_ss(nk=0)),
    "neural_ss, nk 2": Case(lambda: _neural_ss(nk=2, nx=3)),
    "neural_ss, saturation": Case(lambda: _neural_ss("saturation")),
    "neural_ss, abs": Case(lambda: _neural_ss("abs")),
    "neural_ss, integrator": Case(lambda: _neural_ss(nx=3, integrator=True)),
    "neural_ss, two inputs": Case(lambda: _neural_ss(inputs=2, nk=2)),
    "neural_ss without evidence": Case(_neural_ss, evidence=False),
    "ensemble of one": Case(lambda: _ensemble(_neural_ss())),
    "ensemble of neural_ss": Case(
        lambda: _ensemble(_neural_ss(), _neural_ss(seed=5), _neural_ss(seed=6))
    ),
    "ensemble of two structures": Case(
        lambda: _ensemble(_neural_ss(), _neural_ss(nx=3, nk=2, seed=5))
    ),
    "ensemble of mixed kinds": Case(
        lambda: _ensemble(_neural_ss("saturation"), _linear(LinearOE), _neural_oe())
    ),
    "ensemble of oe, mean": Case(
        lambda: _ensemble(_linear(LinearOE), _linear(LinearOE, pole=0.78, na=1), combine="mean")
    ),
    "ensemble of oe, midmean": Case(
        lambda: _ensemble(
            *(_linear(LinearOE, pole=0.70 + 0.03 * i) for i in range(7)), combine="midmean"
        )
    ),
    "ensemble of integrators": Case(
        lambda: _ensemble(
            _neural_ss(nx=3, integrator=True), _neural_ss(nx=2, integrator=True, seed=5)
        )
    ),
    "ensemble, two inputs": Case(
        lambda: _ensemble(_neural_oe(inputs=2), _neural_ss(inputs=2), _linear(ARX, inputs=2))
    ),
    "ensemble, no delay": Case(lambda: _ensemble(_neural_ss(nk=0), _linear(LinearOE, nk=0))),
}

DEPLOYED = tuple(name for name, case in CASES.items() if case.deploys)
