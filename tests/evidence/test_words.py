"""What `validate`, `check` and the text of a model say: units, a closing sentence, no flattery."""

from __future__ import annotations

import re

import numpy as np
import pytest

from kinds import TS, model_of, recording
from plants import linear_data
from sewfast import Dataset, LinearOE, check, identify
from sewfast.evidence import Residuals, operating_range
from sewfast.evidence.card import summary
from sewfast.evidence.residuals import horizon_scores
from sewfast.evidence.verdicts import accuracy, correlation, operation
from sewfast.validation import grade_of, validate


def oe(poles: list[complex], Ts: float) -> LinearOE:
    den = np.real(np.poly(poles))
    num = [0.0, 0.1]
    return LinearOE.from_tf(num, den, Ts, input_units=["V"], output_name="speed", output_unit="RPM")


# --- time constants -------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("pole", "Ts", "shown"),
    [
        (0.9, 0.001, "0.9 (9.491 ms)"),
        (0.9, 4.0, "0.9 (37.96 s)"),
        (0.9999, 4.0, "0.9999 (11.11 h)"),
        (-0.9, 0.001, "-0.9 (alternates from sample to sample, dies away in 9.491 ms)"),
        (1.0, 0.001, "1 (integrates)"),
        (1.0 - 2e-7, 0.001, "1 - 2e-07 (83.33 min)"),
        (1.2, 0.001, "1.2"),
    ],
)
def test_a_pole_is_shown_with_what_its_mode_does(pole: float, Ts: float, shown: str) -> None:
    assert f"poles: {shown}\n" in str(oe([pole], Ts)) + "\n"


def test_a_pair_of_poles_has_a_frequency() -> None:
    assert "(37.96 s, 0.01768 Hz)" in str(oe([0.9 * np.exp(0.4443j), 0.9 * np.exp(-0.4443j)], 4.0))


# --- validate -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("fit", "rmse", "noise", "grade"),
    [
        (95.0, 1.0, 0.1, "good"),
        (75.0, 1.0, 0.1, "fair"),
        (40.0, 1.0, 0.1, "poor"),
        (40.0, 1.0, 0.999, "good"),  # nothing but noise is left
        (40.0, 1.0, 1.1, "good"),
        (80.0, 1.0, 0.9, "good"),  # without the noise it is 91 %
        (40.0, 1.0, 0.9, "poor"),  # the rest is a third of what the noise does not explain
        (2.0, 1.0, 0.9, "useless"),  # the output itself is nothing but noise
        (-328.0, 4.0, float("nan"), "useless"),
        (float("nan"), 1.0, 0.1, ""),
    ],
)
def test_grades(fit: float, rmse: float, noise: float, grade: str) -> None:
    assert grade_of(fit, rmse, noise) == grade


@pytest.mark.parametrize("shape", ["ramp", "decay", "sine"])
def test_an_output_that_the_input_does_not_move_is_no_good_fit(shape: str) -> None:
    rng = np.random.default_rng(3)
    n, t = 600, 0.01 * np.arange(600)
    u = np.repeat(rng.uniform(-5.0, 5.0, n // 6), 6)
    y = {"ramp": t, "decay": 10.0 * np.exp(-t / 2.0), "sine": np.sin(2.0 * np.pi * t)}[shape]
    data = Dataset.from_arrays(u, y + 0.01 * rng.standard_normal(n), 0.01)
    model = identify(data, time_budget=1.0)
    verdict = model.training["verdict"]
    found = validate(model, data)
    for grade in (verdict["grade"], found.grade):
        assert grade in ("poor", "useless"), (verdict, found.verdict)
    assert check(model, data).lines[0].verdict in ("warn", "fail")


def test_levels_that_differ_between_recordings_are_not_the_inputs_work() -> None:
    rng = np.random.default_rng(3)
    keeps = LinearOE.from_tf([0.0, 1e-4], [1.0, -1.0], 0.01)
    u = np.repeat(rng.uniform(-5.0, 5.0, 100), 6)
    data = Dataset.concat([
        Dataset.from_arrays(u, level + 0.1 * rng.standard_normal(600), 0.01)
        for level in (0.0, 5000.0)
    ])  # fmt: skip
    found = validate(keeps, data)
    assert found.simulation.fit_percent > 99.0
    assert found.grade == "useless"
    assert "moves of the input" in found.verdict


def test_a_model_without_delay_is_not_sent_to_tuning() -> None:
    rng = np.random.default_rng(5)
    u, y = np.repeat(rng.uniform(-5.0, 5.0, 200), 3), np.zeros(600)
    for k in range(600):
        y[k] = 0.5 * y[k - 1] + 0.5 * u[k]
    data = Dataset.from_arrays(u, y + 0.01 * rng.standard_normal(600), 0.01)
    model = identify(data, nk=0, time_budget=1.0, seed=0)
    assert "nk = 1" in model.training["verdict"]["next"][0]


def test_a_useless_fit_is_called_useless() -> None:
    model = model_of("oe")
    (e,) = recording(model, 400, seed=2).experiments
    wrong_way = Dataset.from_arrays(
        e.u, -e.y, TS, input_names=["u"], input_units=["V"], output_name="speed", output_unit="RPM"
    )
    found = validate(model, wrong_way)
    assert found.grade == "useless"
    last = str(found).splitlines()[-1]
    assert last.startswith("verdict: useless here, worse than a constant: fit -")
    assert "columns" in last
    assert found.to_json()["grade"] == "useless"
    assert validate(model, recording(model, 400, seed=2)).verdict.startswith("good enough to tune")


def test_identify_and_validate_use_the_same_words_for_noise_alone() -> None:
    """An output that is white noise is as small as its noise: that does not make a model good."""
    rng = np.random.default_rng(2)
    u = np.repeat(rng.uniform(-1.0, 1.0, 80), 20)
    data = Dataset.from_arrays(u, rng.normal(size=1600), 0.01)
    model = identify(data, nx=1, nk=1, hidden=4, starts=2, iterations=30)
    assert model.training["verdict"]["grade"] == "useless"
    assert validate(model, data).grade == "useless"


def test_a_noisy_record_of_a_known_plant_is_no_reproach() -> None:
    model = identify(linear_data(1500, noise=0.02), model="oe")
    found = validate(model, linear_data(1500, seed=5, noise=3.0))
    assert found.simulation.fit_percent < 90.0
    assert "what is left is noise" in found.verdict


# --- check ----------------------------------------------------------------------------------------


def test_the_card_ends_in_one_sentence() -> None:
    good = model_of("oe")
    card = good.check(recording(good, 500, seed=2))
    assert card.summary.startswith("good enough to tune")
    assert str(card).replace("\n", " ").endswith(f"in short: {card.summary}")
    assert card.to_json()["summary"] == card.summary
    assert card.summary in card.to_html()
    bent = model_of("neural_oe, saturates")
    wrong = good.check(recording(bent, 500, seed=2))
    assert wrong.verdict == "fail"
    assert re.search(r"; first \w+", wrong.summary)


def test_the_sentence_of_a_useless_model_and_of_a_constant_output() -> None:
    model = model_of("oe")
    (e,) = recording(model, 400, seed=2).experiments
    for y, words in ((-e.y, "useless here ("), (np.full(400, 3.0), "output is constant")):
        data = Dataset.from_arrays(
            e.u, y, TS, input_names=["u"], input_units=["V"], output_name="speed",
            output_unit="RPM",
        )  # fmt: skip
        assert words in model.check(data).summary
    assert summary([]).startswith("good")


def test_a_small_probability_and_a_pole_near_one_are_written_once() -> None:
    model = model_of("oe")
    card = model.check(recording(model_of("neural_oe, saturates"), 700, seed=2))
    tests = [correlation(t) for t in card.tests]
    assert any(line.shown == "p < 1e-12" for line in tests)
    assert not any("= <" in line.shown for line in tests)
    near = oe([1.0 - 2e-7], TS)
    line = operation(operating_range(near, [np.zeros(1)]))[0]
    assert (line.shown, line.limit) == ("1 - 2e-07", "< 1")
    line = operation(operating_range(model_of("oe, integrator"), [np.zeros(1)]))[0]
    assert (line.shown, line.limit, line.verdict) == ("1", "", "info")
    assert "integrates" in line.meaning


def test_no_line_praises_one_step_errors() -> None:
    """Noise in the measured outputs that it starts from makes it worse than the free run here."""
    model = model_of("oe")
    data = recording(model, 500, seed=2, noise=0.3)
    scores = horizon_scores(model, data, Residuals.of(model, data))
    assert scores.pooled["1 step"].rmse > scores.pooled["free run"].rmse
    lines = accuracy(scores, "RPM", float("nan"), 100.0)
    ahead = next(x for x in lines if x.name == "1 step ahead")
    assert ahead.verdict == "info"
    assert "says little" in ahead.meaning
