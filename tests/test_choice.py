"""The choice between linear model and network: later parts, sound starts, memory."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from plants import bent_data, linear_data
from sewfast.dataset import Dataset
from sewfast.errors import FitError
from sewfast.identification import identify
from sewfast.identification.candidate import Candidate, pooled
from sewfast.identification.folds import FOLDS, folds
from sewfast.identification.memory import Memory, remembered
from sewfast.identification.training import Start, Structure

F = NDArray[np.float64]
STRUCTURE = Structure(2, 1, 4, 1e-4)


class Lag:
    """y(k) = pole y(k-1) + (1 - pole) u(k-1)."""

    def __init__(self, pole: float) -> None:
        self.pole = pole

    def estimate_initial_state(self, u: F, y: F) -> F:
        return np.array([y[0]])

    def step(self, y: float, u: float) -> float:
        return self.pole * y + (1.0 - self.pole) * u

    def simulate(self, u: F, state: F) -> F:
        y = np.empty(len(u))
        y[0] = state[0]
        for k in range(1, len(u)):
            y[k] = self.step(y[k - 1], float(u[k - 1, 0]))
        return y


class Latch(Lag):
    """Two equilibria: the input only moves it from one to the other where it is large."""

    def step(self, y: float, u: float) -> float:
        return y + 0.3 * (y - y**3) + 0.1 * u


class Runaway(Lag):
    def simulate(self, u: F, state: F) -> F:
        raise FitError("runs away")


def driven(core: Lag, n: int = 1600, seed: int = 0) -> Dataset:
    """Levels between -2.5 and 2.5, held for 40 samples."""
    u = np.repeat(np.random.default_rng(seed).uniform(-2.5, 2.5, n // 40), 40)
    return Dataset.from_arrays(u, core.simulate(u[:, None], np.zeros(1)), 0.01)


# --- memory -----------------------------------------------------------------------------------


def test_a_lag_forgets_the_order_of_its_inputs_as_far_as_its_blocks_are_long() -> None:
    data = driven(Lag(0.8))
    assert remembered(Lag(0.8), data) < 1e-3
    assert remembered(Lag(0.98), data) > 10 * remembered(Lag(0.9), data)


def test_a_network_may_remember_little_more_than_the_linear_model() -> None:
    data = driven(Lag(0.9))
    bound = Memory.of([Lag(0.9)], data)
    assert bound.allows(Lag(0.9))
    assert bound.allows(Lag(0.92))
    assert not bound.allows(Latch(0.0))
    assert not bound.allows(Runaway(0.9))


def test_records_too_short_to_be_cut_say_nothing() -> None:
    u = np.arange(30.0)
    assert remembered(Latch(0.0), Dataset.from_arrays(u, u, 0.01)) == 0.0


# --- later parts --------------------------------------------------------------------------------


def test_every_fold_is_later_than_what_it_is_judged_by() -> None:
    data = Dataset.concat([linear_data(1000, name="a"), linear_data(500, name="b")])
    found = folds(data)
    assert len(found) == FOLDS
    ranges = [[s["range"] for s in f.sources] for f in found]
    assert ranges == [["800:1000", "400:500"], ["600:800", "300:400"], ["400:600", "200:300"]]
    for fold, stop in zip(found, (800, 600, 400), strict=True):
        assert [len(e) for e in fold.fitted.experiments] == [stop, stop // 2]
        assert fold.scored == 300


def test_given_validation_data_are_the_only_fold() -> None:
    (only,) = folds(linear_data(400), linear_data(300, seed=3))
    assert only.is_given
    assert len(only.fitted) == 400


def test_a_short_record_has_fewer_folds() -> None:
    assert folds(linear_data(60)) == ()
    assert len(folds(linear_data(210))) == FOLDS


def test_the_network_has_to_win_on_every_later_part() -> None:
    options: dict[str, Any] = {"nx": 1, "nk": 1, "hidden": 4, "starts": 2, "iterations": 30}
    won = identify(bent_data(1000, noise=0.3), **options).training["choice"]
    assert won["chosen"] == "neural_ss"
    assert "on 3 later parts" in won["reason"]
    # from 400 to 600 the plant is another one: what was learned before does not hold there
    plain = bent_data(1000, noise=0.3)
    (e,) = plain.experiments
    y = e.y.copy()
    y[400:600] = linear_data(1000).experiments[0].y[400:600] * 0.1 - 0.5 * e.y[400:600]
    lost = identify(Dataset.from_arrays(e.u, y, 0.01), **options).training["choice"]
    assert lost["chosen"] == "oe"


def test_the_geometric_mean_needs_every_fold() -> None:
    assert pooled([1.0, 4.0]) == pytest.approx(2.0)
    assert pooled([]) == np.inf
    assert pooled([1.0, np.inf]) == np.inf


# --- starts that agree --------------------------------------------------------------------------


def candidate(error: float, *sound: bool) -> Candidate:
    starts = tuple(Start(None, 1.0, s) for s in sound)  # type: ignore[arg-type]
    return Candidate(STRUCTURE, starts, error)


def test_starts_that_fail_the_guard_do_not_agree() -> None:
    assert candidate(1.0, True, True, False, False).agreement == 0.5
    assert candidate(1.0, False, False).agreement == 0.0
    assert candidate(1.0).agreement == 0.0


def test_a_structure_without_a_sound_start_is_no_step_forward() -> None:
    sound, unsound = candidate(2.0, True), candidate(1.0, False)
    assert sound.is_better(unsound, 0.97)
    assert not unsound.is_better(sound, 0.97)
    assert candidate(1.0, True).is_better(sound, 0.97)
    assert not candidate(1.99, True).is_better(sound, 0.97)
