"""The noise of a record is measured in closed loops on the model, and nowhere else."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sewfast import Dataset, Gains, LinearOE, VirtualMachine, identify, load_model
from sewfast.control.controller import Controller
from sewfast.control.loop import run
from sewfast.errors import ModelFileError, SettingError
from sewfast.models import Ensemble
from sewfast.trust import judge
from sewfast.tuning import tune

TS = 0.01


def record(noise: float, seed: int = 0, hold: int = 20, step: float = 0.0) -> Dataset:
    """A motor of 50 rad/s per volt with a time constant of .15 s, measured with white noise."""
    rng = np.random.default_rng(seed)
    u = np.repeat(rng.uniform(0.0, 3.0, 2000 // hold), hold)
    y = np.zeros(len(u))
    for k in range(1, len(u)):
        y[k] = y[k - 1] + (TS / 0.15) * (50.0 * u[k - 1] - y[k - 1])
    y = y + noise * rng.normal(size=len(y))
    y = step * np.floor(y / step) if step else y
    return Dataset.from_arrays(u, y, TS, input_units="V", output_unit="rad/s")


def noisy(noise: float) -> LinearOE:
    plant = LinearOE.from_tf([0.0, 10.0 / 3.0], [1.0, -14.0 / 15.0], TS)
    known: dict[str, Any] = {"input_range": [[0.0, 3.0]], "output_range": [0.0, 150.0]}
    return replace(plant, training=known | ({"noise": noise} if noise else {}))


def pid(**settings: Any) -> Controller:
    return Controller(Gains.standard(0.05, 0.15, 0.0), Ts=TS, u_min=0.0, u_max=3.0, **settings)


@pytest.mark.parametrize("hold", [1, 20])
@pytest.mark.parametrize("noise", [0.0, 0.5, 5.0])
def test_a_model_knows_the_noise_of_its_record(noise: float, hold: int) -> None:
    for seed in range(5):
        found = identify(record(noise, seed, hold), model="oe", na=1, nb=1, nk=1).noise
        # fast motion of the plant itself is not taken for noise (hold 1)
        assert found == pytest.approx(noise, rel=0.12, abs=1e-6), seed


def test_rounding_is_noise() -> None:
    found = identify(record(0.0, step=2.0), model="oe", na=1, nb=1, nk=1).noise
    assert found == pytest.approx(2.0 / np.sqrt(12.0), rel=0.25)


def test_a_loop_measures_noise_that_the_output_does_not_have() -> None:
    r = np.full(4000, 60.0)
    calm, found = run(pid(), noisy(0.0), r), run(pid(), noisy(2.0), r)
    late = slice(1000, None)
    assert np.std((found.feedback - found.y)[late]) == pytest.approx(2.0, rel=0.05)
    assert np.std(calm.u[late]) < 1e-3
    # the proportional part alone gives Kp * noise
    assert np.std(found.u[late]) == pytest.approx(0.05 * 2.0, rel=0.15)
    assert np.std(found.y[late]) < 1.0
    np.testing.assert_array_equal(run(pid(), noisy(2.0), r).u, found.u)
    assert np.any(run(pid(), noisy(2.0), r, seed=1).u != found.u)
    np.testing.assert_array_equal(run(pid(), noisy(2.0), r, noise=0.0).u, calm.u)
    np.testing.assert_array_equal(run(pid(), noisy(0.0), r, noise=2.0).u, found.u)


def test_a_noisy_record_gets_a_calmer_controller() -> None:
    changes = []
    for noise in (0.0, 3.0):
        tuned = tune(noisy(noise), evaluations=400, threads=1).controller
        changes.append(run(tuned, noisy(3.0)).metrics()["du_rms"])
    calm, calmed = changes
    assert calm is not None
    assert calmed is not None
    assert calmed < 0.7 * calm


def test_an_encoder_in_the_loop_replaces_the_noise() -> None:
    names: dict[str, Any] = {"input_units": ["V"], "output_unit": "RPM"}
    plant = LinearOE.from_tf([0.0, 20.0], [1.0, -0.9], 1e-3, **names)
    gains = Gains.standard(0.002, 0.05, 0.0, u_unit="V", y_unit="RPM")
    counted = Controller(gains, Ts=1e-3, u_min=0.0, u_max=10.0, counts_per_rev=1572)
    r = np.full(500, 300.0)
    loud = replace(plant, training={"noise": 50.0})
    np.testing.assert_array_equal(run(counted, loud, r).u, run(counted, plant, r).u)


def test_members_have_the_noise_of_their_ensemble(tmp_path: Path) -> None:
    one, two = noisy(0.0), LinearOE.from_tf([0.0, 3.2], [1.0, -0.93], TS)
    both = Ensemble.of([one, two], training={"noise": 1.5})
    assert [m.noise for m in both.members] == [1.5, 1.5]
    both.save(tmp_path / "m.json")
    assert load_model(tmp_path / "m.json").noise == 1.5


def test_noise_below_zero_is_refused(tmp_path: Path) -> None:
    stored = noisy(1.0).to_dict()
    for wrong in (-1.0, "2", None):
        stored["training"]["noise"] = wrong
        (tmp_path / "m.json").write_text(json.dumps(stored))
        with pytest.raises(ModelFileError, match="noise"):
            load_model(tmp_path / "m.json")
    with pytest.raises(SettingError, match="noise"):
        run(pid(), noisy(1.0), np.ones(10), noise=-1.0)
    with pytest.raises(SettingError, match="noise"):
        run(pid(), VirtualMachine(), np.ones(10), noise=1.0)


def test_noise_is_no_oscillation() -> None:
    found = judge(pid(), noisy(5.0))
    assert [line.verdict for line in found.lines if line.name == "limit cycle"] == ["ok"]
