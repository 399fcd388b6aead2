"""Controllers judged without a search, and fronts that state what a search would."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from sewfast import _core, margins
from sewfast.control import Controller, Gains
from sewfast.models import LinearOE
from sewfast.tuning import Constraints, Cost, Judge, costs, led, pareto, tune, verdict_on

START = Controller(
    Gains.standard(0.02, 0.1, 0.002), N=5, u_min=-20, u_max=20, filter_samples=8,
    counts_per_rev=1572,
)  # fmt: skip
QUIET: dict[str, Any] = {"seed": 2, "threads": 2}


def drive(time: float = 0.25, gain: float = 490.0, delay: int = 4) -> LinearOE:
    pole = np.exp(-0.001 / time)
    core = _core.LinearModel(np.array([-pole]), np.array([[gain * (1 - pole)]]), delay, 0.0)
    known = {"input_range": [[-20.0, 20.0]]}
    return LinearOE(core, 0.001, ("u",), "y", ("V",), "RPM", ("counts", 1572.0), known)


@pytest.mark.parametrize("limit", [2.0, 8.0])
def test_what_a_search_kept_is_kept(limit: float) -> None:
    found = tune(
        drive(), start=START, constraints=Constraints(overshoot=limit), feedforward="none",
        evaluations=150, **QUIET,
    )  # fmt: skip
    (judged,) = Judge(START, drive()).of([found.pid])
    assert judged.cost == found.cost
    assert 0.0 < judged.overshoot <= limit
    assert 0.0 < judged.u <= 20.0
    assert judged.Ms == pytest.approx(margins(found.pid, drive()).Ms)


def test_costs_weights_and_verdict_are_those_of_the_functions() -> None:
    judge, hot = Judge(START, drive()), replace(START, gains=Gains.standard(2.0, 0.1, 0.002))
    chatter = Cost(chatter=100.0)
    assert [j.cost for j in judge.of([START, hot], chatter)] == list(
        costs([START, hot], drive(), cost=chatter)
    )
    assert judge.verdict(hot) == verdict_on(hot, drive())


def test_a_front_has_the_cost_of_a_search_where_overshoot_counts() -> None:
    """A cost of mean terms would let the overshoot of one run be made up for in others."""
    heavy = Cost(overshoot=300.0, overshoot_limit=3.0)
    front = pareto(
        drive(), objectives=("cost", "Ms"), start=START, cost=heavy, evaluations=200, size=12,
        constraints=Constraints(overshoot=20.0), **QUIET,
    )  # fmt: skip
    assert len(front) > 3
    np.testing.assert_array_equal(front.values[:, 0], costs(front.controllers, drive(), cost=heavy))
    assert max(j.overshoot for j in Judge(START, drive()).of(front.controllers)) <= 20.0


def test_a_front_keeps_the_feedforward_of_its_start() -> None:
    start, _ = led(START, drive())
    assert start.feedforward is not None
    front = pareto(
        drive(), objectives=("cost", "Ms"), start=start, evaluations=200, size=12, **QUIET
    )
    assert {c.feedforward for c in front} == {start.feedforward}
    assert {(c.alpha, c.beta) for c in front} == {(start.alpha, start.beta)}
    assert len({c.gains for c in front}) > 1
    np.testing.assert_array_equal(front.values[:, 0], costs(front.controllers, drive()))
    named = pareto(
        drive(), objectives=("cost", "Ms"), start=start, variables=["Kp", "beta"],
        evaluations=100, size=8, **QUIET,
    )  # fmt: skip
    assert len({c.beta for c in named}) > 1
