"""Three masses on two shafts: both found, named, notched; two masses stay two."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from effort import FULL
from sewfast import FrequencyResponse, VirtualMachine, bode, fit_shaft
from sewfast.control.margins import loop_response
from sewfast.errors import DataError, FitError
from sewfast.frequency import propose

TS = 1e-3


def chain(inertias: list[float], stiffness: list[float], seed: int = 0) -> FrequencyResponse:
    """The exact response of masses in a row, driven and measured at the first, with a little noise.

    Damping of a shaft is a hundredth of its critical one, friction a tenth of a second's.
    """
    J = np.array(inertias)
    n = len(J)
    K = np.zeros((n, n))
    C = np.diag([J.sum() / 0.1, *np.zeros(n - 1)])
    for i, k in enumerate(stiffness):
        part = np.zeros((n, n))
        part[i : i + 2, i : i + 2] = [[1.0, -1.0], [-1.0, 1.0]]
        K += k * part
        C += 0.02 * np.sqrt(k * min(J[i], J[i + 1])) * part
    A = np.block([[np.zeros((n, n)), np.eye(n)], [-K / J[:, None], -C / J[:, None]]])
    B = np.zeros(2 * n)
    B[n] = 1.0 / J[0]
    scale, modes = np.linalg.eig(A)
    held = np.where(np.abs(scale) > 1e-9, np.expm1(scale * TS) / np.where(scale == 0, 1, scale), TS)
    hertz = np.arange(2.0, 400.0, 0.5)
    z = np.exp(2j * np.pi * hertz * TS)
    weights = modes[n] * np.linalg.solve(modes, B.astype(complex)) * held
    value = (weights / (z[:, None] - np.exp(scale * TS))).sum(axis=1)
    rng = np.random.default_rng(seed)
    noise = 0.003 * np.abs(value) * (rng.normal(size=len(z)) + 1j * rng.normal(size=len(z)))
    variance = 2 * (0.003 * np.abs(value)) ** 2
    return FrequencyResponse(
        hertz, value + noise, variance, np.full(len(z), 0.99), 16.0, TS, u_unit="V", y_unit="RPM",
        from_counts=False,
    )  # fmt: skip


def swings(inertias: list[float], stiffness: list[float], *, held: bool) -> np.ndarray:
    """Natural frequencies of the row [Hz], free or with the first mass held; without the zero."""
    J = np.array(inertias)
    K = np.zeros((len(J), len(J)))
    for i, k in enumerate(stiffness):
        K[i : i + 2, i : i + 2] += k * np.array([[1.0, -1.0], [-1.0, 1.0]])
    first = 1 if held else 0
    square = np.linalg.eigvals((K / J[:, None])[first:, first:]).real
    return np.sort(np.sqrt(np.abs(square)))[0 if held else 1 :] / (2.0 * np.pi)


CASES = [
    ([1e-3, 4e-3, 1e-3], [250.0, 100.0]),
    ([2e-3, 5e-4, 2e-3], [300.0, 150.0]),
    ([1e-3, 2e-3, 4e-4], [400.0, 40.0]),
]


@pytest.mark.nightly("a search for two shafts")
@pytest.mark.parametrize(("inertias", "stiffness"), CASES if FULL else CASES[:1])
def test_both_shafts_are_found_where_they_swing(
    inertias: list[float], stiffness: list[float]
) -> None:
    fit = fit_shaft(chain(inertias, stiffness))
    assert fit.resonances == 2
    assert str(fit).startswith("three masses and two shafts")
    free, held = swings(inertias, stiffness, held=False), swings(inertias, stiffness, held=True)
    for k, mark in enumerate(("", "_2")):
        for name, true in (("resonance", free[k]), ("antiresonance", held[k])):
            found = fit.parameters[f"{name}{mark}_hertz"]
            assert found.value == pytest.approx(true, rel=0.01), name
    ratio = sum(inertias[1:]) / inertias[0]
    assert fit.parameters["inertia_ratio"].value == pytest.approx(ratio, rel=0.1)
    assert [fit.notch(k).numbers[0] for k in (1, 2)] == pytest.approx(list(free), rel=0.01)
    assert "resonance_2_hertz" in json.dumps(fit.to_dict())
    with pytest.raises(FitError, match="3 or more"):
        fit.notch(3)
    model = fit.to_model()  # what is fitted is what is simulated
    hertz = fit.response.hertz[::50]
    num, den = np.ravel(model.to_tf()[0]), model.to_tf()[1]
    q = np.exp(-2j * np.pi * hertz * TS)
    np.testing.assert_allclose(
        np.polyval(num[::-1], q) / np.polyval(den[::-1], q), fit.at(hertz), rtol=1e-6
    )


def row(seed: int) -> tuple[list[float], list[float]]:
    """Inertias and stiffnesses of three masses whose shafts swing apart, below 330 Hz."""
    rng = np.random.default_rng(seed)
    while True:
        inertias = list(10.0 ** rng.uniform(-3.5, -2.5, 3))
        stiffness = list(10.0 ** rng.uniform(1.3, 2.9, 2))
        free, held = swings(inertias, stiffness, held=False), swings(inertias, stiffness, held=True)
        apart = free[1] > 1.25 * free[0] and np.all(free > 1.06 * held)
        if apart and held[0] > 10.0 and free[1] < 330.0:
            return inertias, stiffness


@pytest.mark.nightly("shafts of whole rows of masses")
@pytest.mark.parametrize("seed", range(40) if FULL else [3, 10])
def test_of_any_row_every_shaft_is_found_and_no_other(seed: int) -> None:
    """The search was made on seeds 0 to 11 of a like family."""
    inertias, stiffness = row(seed)
    fit = fit_shaft(chain(inertias, stiffness, seed))
    assert fit.resonances == 2
    for true, mark in zip(swings(inertias, stiffness, held=False), ("", "_2"), strict=True):
        assert fit.parameters[f"resonance{mark}_hertz"].value == pytest.approx(true, rel=0.02)
    assert fit_shaft(chain(inertias[:2], stiffness[:1], seed)).resonances == 1


@pytest.mark.nightly("a search for two shafts")
@pytest.mark.parametrize("load", [3e-4, 1e-3, 4e-3] if FULL else [1e-3])
def test_two_masses_stay_two(load: float) -> None:
    assert fit_shaft(chain([1e-3, load], [100.0])).resonances == 1


@pytest.mark.parametrize("seed", [3, 4] if FULL else [3])
def test_a_machine_with_one_shaft_has_one(seed: int) -> None:
    machine = VirtualMachine(seed, load_inertia=1e-3, stiffness=150.0)
    assert fit_shaft(bode(machine, speed=1500.0)).resonances == 1


@pytest.mark.nightly("a search for shafts for each change", by_day=["changed0"])
@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize(
    "changed",
    [
        {"hertz": np.concatenate([[0.0], np.arange(2.5, 400.0, 0.5)])},
        {"variance": np.full(796, -1.0)},
        {"variance": np.concatenate([[np.nan], np.zeros(795)])},
        {"value": chain([1e-3, 1e-3], [100.0]).value * 1e300},
        {"value": chain([1e-3, 1e-3], [100.0]).value * 1e-290, "variance": np.zeros(796)},
    ],
)
def test_lines_that_say_nothing_are_left_out(changed: dict[str, Any]) -> None:
    fit = fit_shaft(replace(chain([1e-3, 1e-3], [100.0]), **changed))
    assert fit.parameters["resonance_hertz"].value == pytest.approx(71.16, rel=0.01)


@pytest.mark.parametrize(
    "changed",
    [
        {"hertz": np.full(796, 50.0)},
        {"hertz": np.arange(400.0, 2.0, -0.5)},
        {"hertz": -np.arange(2.0, 400.0, 0.5)},
        {"Ts": 0.0},
        {"Ts": float("nan")},
        {"value": np.zeros(796, dtype=complex)},
        {"variance": np.full(796, np.nan)},
    ],
)
def test_a_response_that_is_none_is_refused(changed: dict[str, Any]) -> None:
    with pytest.raises(DataError) as caught:
        fit_shaft(replace(chain([1e-3, 1e-3], [100.0]), **changed))
    assert caught.value.name == "response"


@pytest.mark.nightly("a search for four filters")
def test_filters_take_both_shafts_on(tmp_path: Path) -> None:
    fit = fit_shaft(chain(*CASES[1]))
    found = propose(fit, Ms=1.7)
    assert found.without is not None
    assert found.bandwidth_hertz > 1.2 * found.without.bandwidth_hertz
    assert found.margins.stable
    assert found.margins.Ms < 1.75
    hertz = np.geomspace(1.0, 490.0, 3000)
    S = 1.0 / np.abs(1.0 + loop_response(found.controller, fit.to_model(), 2.0 * np.pi * hertz))
    assert S.max() < 1.75
