"""The battery: its cases are what they claim to be, its references are bounds, its scores count.

The quick part: the whole of it is `make battery`. numba is not needed.
"""

from __future__ import annotations

import importlib
import importlib.util
import json
import math
import runpy
import sys
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from effort import FULL
from sewfast import Dataset, Ensemble, Model, identify

pytest.importorskip("scipy", reason="needs scipy (extra mat)")
BENCHES = Path(__file__).parents[2] / "benches"


def part(name: str) -> Any:
    """A chapter of the package, which is loaded without putting its folder on the path: some of
    the folder's modules have the names of modules of the tests.
    """
    if "battery" not in sys.modules:
        place = BENCHES / "battery" / "__init__.py"
        spec = importlib.util.spec_from_file_location("battery", place)
        assert spec is not None
        assert spec.loader is not None
        sys.modules["battery"] = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(sys.modules["battery"])
    return importlib.import_module(f"battery.{name}")


families, references, scoring = part("families"), part("references"), part("scoring")
QUICK = [name for name, f in families.FAMILIES.items() if f.quick]
CLOSED_LOOPS = ("motor_loop",)
"""Their input is the controller's answer, so it has no range of its own."""


@cache
def case(name: str, seed: int = 0) -> Any:
    return families.make(name, seed)


# --- families -------------------------------------------------------------------------------------


def test_both_halves_have_every_sort_of_system() -> None:
    assert not set(families.RULES) & set(families.HELD)
    assert {*families.RULES, *families.HELD} == set(families.FAMILIES)
    for half in (families.RULES, families.HELD):
        cases = [case(name) for name in half]
        assert sum(c.is_linear for c in cases) >= 2
        assert min(c.samples for c in cases) < 2000
        assert max(c.samples for c in cases) > 20000
        for sorts in (
            {"motor_friction", "drive_limit", "motor_loop", "slow_drive"},
            {"position", "position_periodic"},
            {"hammerstein", "wiener", "wiener_hammerstein", "hammerstein_wiener"},
        ):
            assert sorts & set(half)


def test_the_split_is_that_of_the_docstring() -> None:
    text = families.__doc__.split("RULES  ")[1]
    rules, held = (set(part.replace("\n", " ").split(", ")) for part in text.split("HELD   "))
    assert {name.strip() for name in rules} == set(families.RULES)
    assert {name.strip() for name in held} == set(families.HELD)


@pytest.mark.nightly(
    "every family, two seeds",
    by_day=[
        "hammerstein-0",
        "wiener_hammerstein-1",
        "first_order_encoder-0",
        "dead_time-1",
        "two_mass-0",
        "three_inputs-1",
        "motor_friction-0",
        "drive_limit-0",
    ],
)
@pytest.mark.parametrize("seed", [0, 1])
@pytest.mark.parametrize("name", families.FAMILIES)
def test_a_case_is_what_it_claims_to_be(name: str, seed: int) -> None:
    c = case(name, seed)
    is_short = name.startswith("short_")
    least, most = (families.short.LEAST, families.short.MOST) if is_short else (500, 100_000)
    assert least <= c.samples <= most
    for r in (*c.train, *c.test):
        assert len(r.u) == len(r.y) > c.n
        assert np.isfinite(r.u).all()
        assert np.isfinite(r.y).all()
    # test outputs are the truth's, to the last digit; training outputs are not
    assert all(np.array_equal(c.truth.simulate(r), r.y) for r in c.test)
    spread = np.concatenate([r.y for r in c.train]).std()
    quiet, loud = (42, 13) if is_short else (62, 18)
    assert loud < 20 * math.log10(spread / c.noise) < quiet
    inputs, outputs = ([getattr(r, x) for r in c.train] for x in ("u", "y"))
    low, high = (f(np.concatenate(outputs)) for f in (np.min, np.max))
    for r in c.test:
        if name not in CLOSED_LOOPS:
            assert np.all(r.u.min(axis=0) >= np.min([u.min(axis=0) for u in inputs], axis=0))
            assert np.all(r.u.max(axis=0) <= np.max([u.max(axis=0) for u in inputs], axis=0))
        assert low - 0.25 * (high - low) < r.y.min()
        assert high + 0.25 * (high - low) > r.y.max()


@pytest.mark.parametrize("name", families.FAMILIES)
def test_a_seed_is_one_system_and_another_seed_another(name: str) -> None:
    again = families.make(name, 0)
    assert references.digest(again) == references.digest(case(name))
    np.testing.assert_array_equal(again.train[0].y, case(name).train[0].y)
    other = case(name, 1).truth.theta
    assert len(other) != len(again.truth.theta) or not np.allclose(other, again.truth.theta)


def test_linear_truths_are_linear_and_the_others_are_not() -> None:
    for name, family in families.FAMILIES.items():
        c = case(name)
        u = c.test[0].u[:1500]
        rest, once, twice = (c.truth.run(c.truth.theta, k * u) for k in (0.0, 0.5, 1.0))
        bend = np.abs((twice - rest) - 2 * (once - rest)).max() / np.ptp(twice)
        assert (bend < 1e-9) == family.is_linear, (name, bend)


# --- references -----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "name", ["first_order_encoder", "dead_time", "hammerstein", "wiener", "backlash"]
)
def test_the_oracle_is_near_the_truth(name: str) -> None:
    c = case(name)
    theta = references.refitted(c)
    assert 0.0 < references.oracle_error(c, theta) < 0.15 * c.noise
    assert references.oracle_error(c, c.truth.theta) == 0.0
    # it was fitted to the noisy record, which it describes better than the truth does
    left = [c.truth.simulate(r, theta) - r.y for r in c.train]
    assert families.rms(np.concatenate(left)) < c.noise


def test_the_oracle_refits_what_was_moved() -> None:
    c = case("wiener")
    moved = families.Truth(c.truth.run, 1.01 * c.truth.theta)
    theta = references.refitted(replace(c, truth=moved))
    assert references.oracle_error(c, theta) < 0.15 * c.noise
    assert references.oracle_error(c, moved.theta) > 0.3 * c.noise


def test_output_error_is_the_order_best_on_the_last_fifth() -> None:
    c = case("second_order_encoder")
    order, model = references.output_error(c)
    assert model.orders == {"na": order, "nb": order + 1, "nk": 1}
    assert order >= 2
    assert references.score(c, model) < 0.05 * c.noise
    held = references.references(c)
    assert references.gain_error(c, model, held.gain, c.gain_probe) < 0.01
    assert references.gain_error(c, model, held.range_gain, c.range_probe) < 0.01


def test_the_score_sees_no_output_after_the_first_ones() -> None:
    c = case("first_order_encoder")
    model = identify(c.training, model="oe")
    r = c.test[0]
    seen = np.where(np.arange(len(r.y)) < c.n, r.y, r.y + 1e3)
    (run,) = model.simulate(c.dataset(r.u, seen), init=c.n)
    assert references.score(c, model) == pytest.approx(families.rms((run - r.y)[c.n :]))


def test_the_digest_is_of_the_data() -> None:
    c = case("first_order_encoder")
    r = c.train[0]
    changed = families.Record(r.u, r.y + 1e-3 * np.eye(1, len(r.y))[0], r.before)
    assert references.digest(replace(c, train=(changed,))) != references.digest(c)


# --- the default ----------------------------------------------------------------------------------


@pytest.mark.nightly("a default search; by day test_choice and test_table have some")
@pytest.mark.parametrize(
    "name",
    ["first_order_encoder", *(("wiener", "prbs_drift", "dead_time", "tanks") if FULL else ())],
)
def test_the_default_is_no_worse_than_output_error(name: str) -> None:
    found = scoring.outcome(scoring.Task(name, 0))
    (run,) = found.runs
    assert run.failure == ""
    # with the noise of a real test record: both may be a hundredth of it away from the truth
    assert found.over_oe_measured()[0] <= scoring.WORSE
    assert run.gain_error is None or run.gain_error < 0.05
    assert run.range_gain_error is None or run.range_gain_error < 0.05


# --- scores ---------------------------------------------------------------------------------------


def outcome(name: str, errors: list[float], *, kind: str = "oe", oe: float = 2.0) -> Any:
    held = references.References("", noise=1.0, oracle=0.5, oe=oe, oe_order=2, gain=3.0)
    runs = [
        scoring.Run(
            i,
            e,
            10.0,
            15.0,
            kind,
            gain_error=0.01 * i,
            range_gain_error=0.02 * i,
            failure="" if e < 9e9 else "no",
        )
        for i, e in enumerate(errors)
    ]
    linear = families.FAMILIES[name].is_linear
    return scoring.Outcome(name, 0, 1000, linear, held, tuple(runs))


def test_ratios_and_summary() -> None:
    found = outcome("dead_time", [1.0, 2.0, 3.0])
    assert found.over_oracle() == [2.0, 4.0, 6.0]
    assert found.over_oe() == [0.5, 1.0, 1.5]
    assert found.over_noise() == [1.0, 2.0, 3.0]
    assert found.as_measured()[0] == pytest.approx(math.sqrt(2 / 1.25))
    assert found.spread == 1.5
    # an oracle that is the truth itself has no error to divide by
    exact = replace(found, references=replace(found.references, oracle=0.0))
    assert exact.over_oracle() == 3 * [math.inf]
    network = outcome("dead_time", [1.0], kind="neural_oe+neural_ss")
    held = outcome("wiener", [1.0, math.inf], kind="neural_ss")
    summary = scoring.summary([found, network, held])
    assert list(summary) == ["rules", "held"]
    rules = summary["rules"]
    assert rules["over_oracle_median"] == 3.0
    assert rules["over_oracle_90"] == 6.0
    assert rules["worse_than_oe"] == 0.25
    assert rules["networks_for_linear_truth"] == 0.25
    assert rules["spread_95"] == 1.5
    assert rules["gain_error_worst"] == 0.02
    assert rules["range_gain_error_worst"] == 0.04
    assert summary["held"]["failed"] == 1
    assert summary["held"]["spread_95"] == math.inf
    assert summary["held"]["networks_for_linear_truth"] is None
    assert "dead_time" in scoring.table([found, network, held])


def test_an_ensemble_is_named_by_its_members() -> None:
    u = np.random.default_rng(0).normal(size=300)
    data = Dataset.from_arrays(u, np.convolve(u, [0, 0.5, 0.3])[:300], 0.01)
    members: list[Model] = [identify(data, model="oe"), identify(data, model="arx")]
    assert scoring.kind_of(members[0]) == "oe"
    assert scoring.kind_of(Ensemble.of(members)) == "arx+oe"


def test_a_model_that_runs_away_has_an_infinite_error() -> None:
    c = case("first_order_encoder")
    model = identify(c.training, model="arx")
    wild = replace(model, core=type(model.core)(np.array([-3.0]), np.ones((1, 1)), 1, 0.0))
    assert references.score(c, wild) == math.inf


def test_references_are_kept_for_the_same_data_only(tmp_path: Path) -> None:
    place = tmp_path / "new" / "kept.json"
    first = scoring.outcome(scoring.Task("first_order_encoder", 0, runs=0))
    scoring.Cache(place).put(first)
    kept = scoring.Cache(place).get("first_order_encoder", 0)
    assert kept == first.references
    marked = replace(kept, oracle=123.0)
    task = scoring.Task("first_order_encoder", 0, runs=0, kept=marked)
    assert scoring.outcome(task).references.oracle == 123.0
    stale = replace(task, kept=replace(marked, digest="other"))
    assert scoring.outcome(stale).references.oracle == kept.oracle


@pytest.mark.nightly("the whole program of the battery")
def test_the_program(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    main = runpy.run_path(str(BENCHES / "battery.py"))["main"]
    out = tmp_path / "out.json"
    names = ["first_order_encoder", "prbs_drift"]
    assert main(["--families", *names, "--seeds", "1,4", "--runs", "0", "--json", str(out)]) == 0
    assert capsys.readouterr().out.count("oracle") == 4
    cases = json.loads(out.read_text())["cases"]
    assert [(c["family"], c["seed"]) for c in cases] == [(n, s) for n in names for s in (1, 4)]
    assert main(["--families", names[0], "--seeds", "0-0", "--json", str(out)]) == 0
    document = json.loads(out.read_text())
    (run,) = document["cases"][0]["runs"]
    assert run["over_oe"] == pytest.approx(run["error"] / document["cases"][0]["references"]["oe"])
    assert document["summary"]["rules"]["cases"] == 1
    assert "share over 1.05 x output error" in capsys.readouterr().out
    with pytest.raises(SystemExit):
        main(["--families", "nothing"])


def test_quick_is_small() -> None:
    assert {"rules", "held"} == {families.FAMILIES[name].split for name in QUICK}
    assert all(case(name).samples <= 6000 for name in QUICK)
