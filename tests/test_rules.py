"""Tuning rules: Eq. 12 and its table, Table 1, SIMC, AMIGO."""

from __future__ import annotations

import csv
import math
import runpy
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sewfast import Controller, SettingError, margins, rules
from sewfast.control import Fopdt

ROWS = list(
    csv.DictReader(
        line
        for line in files("sewfast").joinpath("data/eq_12.csv").read_text("utf-8").splitlines()
        if not line.startswith("#")
    )
)


def numbers(row: dict[str, str]) -> dict[str, float]:
    return {name: float(text) for name, text in row.items()}


def cost_by_hand(L: float, Kp: float, Ti: float, Td: float) -> float:
    """Eq. 12 after a disturbance step, with d^2/ds^2 as a difference and plain trapezes."""

    def error(s: Any) -> Any:
        G = np.exp(-s * L) / (1 + s)
        return G / (1 + Kp * (1 + 1 / (Ti * s) + Td * s) * G) / s

    w = np.concatenate([np.geomspace(1e-4 / L, 0.3 / L, 4000), np.linspace(0.3, 60, 40000)[1:] / L])
    h = 1e-3
    s = 1j * w
    second = (error(s * (1 + h)) - 2 * error(s) + error(s * (1 - h))) / (h * s) ** 2
    y = w * np.abs(second) ** 2
    return float(np.sum(np.diff(w) * (y[1:] + y[:-1])) / 2)


@pytest.mark.parametrize("ratio", [0.03, 0.1, 0.5, 1.0])
def test_eq_12_is_the_integral_of_the_paper_and_a_minimum_of_it(ratio: float) -> None:
    rule = rules.eq_12(Fopdt(1.0, 1.0, ratio))
    at = (rule.gains.Kp, rule.gains.Ti, rule.gains.Td)
    assert cost_by_hand(ratio, *at) == pytest.approx(rule.costs["disturbance_cost"], rel=2e-3)
    for i in range(3):
        for factor in (0.95, 1.05):
            moved = [x * (factor if j == i else 1.0) for j, x in enumerate(at)]
            assert cost_by_hand(ratio, *moved) > cost_by_hand(ratio, *at)


def test_table_1_costs_within_a_tenth_of_eq_12() -> None:
    found = [numbers(row) for row in ROWS if row["Ms_limit"] == "inf"]
    ten = [row for row in found if not math.isnan(row["table_1_disturbance_cost"])]
    assert [row["L/T"] for row in ten] == pytest.approx([i / 10 for i in range(1, 11)])
    for row in ten:
        assert 1.0 <= row["table_1_disturbance_cost"] / row["disturbance_cost"] <= 1.1
        assert row["table_1_reference_cost"] / row["reference_cost"] < 1.2
    assert (found[0]["L/T"], found[-1]["L/T"]) == (0.01, 2.0)


@pytest.mark.parametrize(
    "row", ROWS[:: len(ROWS) // 12], ids=lambda r: f"{r['L/T']}-{r['Ms_limit']}"
)
def test_the_table_is_what_its_generator_gives(row: dict[str, str]) -> None:
    made = runpy.run_path(str(Path(__file__).with_name("golden") / "eq_12.py"))["row"]
    expected = numbers(row)
    found = made(expected["L/T"], expected["Ms_limit"])
    assert found == pytest.approx(list(expected.values()), rel=1e-3, nan_ok=True)


@pytest.mark.parametrize("Ms", [1.4, 1.7, 2.0])
def test_a_limit_of_ms_holds_on_the_sampled_loop(Ms: float) -> None:
    plant = Fopdt(490.0, 0.25, 0.025)
    rule = rules.eq_12(plant, Ms=Ms)
    controller = Controller(rule.gains, 2.5e-5, alpha=rule.alpha, beta=rule.beta)
    assert margins(controller, plant).Ms == pytest.approx(Ms, rel=0.02)
    assert rule.costs["Ms"] == pytest.approx(Ms, rel=1e-4)
    assert rule.name == f"eq-12, Ms <= {Ms:g}"


def test_every_rule_by_name_gives_a_stable_loop() -> None:
    plant = Fopdt(-3.0, 0.5, 0.1, u_unit="A", y_unit="rad/s")
    assert set(rules.BY_NAME) == {"table-1", "eq-12", "simc", "simc-pid", "amigo"}
    for name in rules.BY_NAME:
        rule = rules.by_name(name.upper().replace("-", "_"))(plant)
        assert rule.gains.units["Kp"] == "A/rad/s"
        assert rule.gains.Kp < 0
        assert rule.name.startswith(name)
        assert name in str(rule)
        assert margins(Controller(rule.gains, 0.001), plant).stable, name
    with pytest.raises(SettingError, match="eq-12"):
        rules.by_name("ziegler")


def test_simc_by_hand() -> None:
    plant = Fopdt(2.0, 1.0, 0.2)
    pi = rules.simc(plant)
    assert (pi.gains.Kp, pi.gains.Ti, pi.gains.Td) == pytest.approx((1.25, 1.0, 0.0))
    slow = rules.simc(plant, tau_c=0.05)
    assert slow.gains.Ti == pytest.approx(1.0)
    lagging = rules.simc(Fopdt(2.0, 10.0, 0.2))
    assert lagging.gains.Ti == pytest.approx(1.6)
    pid = rules.simc(plant, kind="PID", tau_c=0.2)
    f = 1 + 0.2 / 3
    assert (pid.gains.Kp, pid.gains.Ti, pid.gains.Td) == pytest.approx((1.25 * f, f, 0.2 / 3 / f))
    assert (pid.alpha, pid.beta) == pytest.approx((1 - 1 / f, 1.0))


@pytest.mark.parametrize(
    ("make", "says"),
    [
        (lambda: rules.eq_12(Fopdt(1.0, 1.0, 0.005)), "L/T"),
        (lambda: rules.eq_12(Fopdt(1.0, 1.0, 0.1), Ms=1.0), "Ms"),
        (lambda: rules.simc(Fopdt(1.0, 1.0, 0.1), kind="P"), "kind"),
        (lambda: rules.simc(Fopdt(1.0, 1.0, 0.1), tau_c=-1.0), "tau_c"),
        (lambda: rules.simc(Fopdt(1.0, 1.0, 0.0)), "tau_c"),
        (lambda: rules.amigo(Fopdt(1.0, 1.0, 0.0)), "dead time"),
        (lambda: rules.amigo(Fopdt(0.0, 1.0, 0.1)), "K"),
    ],
)
def test_what_a_rule_is_not_made_for_is_refused(make: Any, says: str) -> None:
    with pytest.raises(SettingError, match=says):
        make()
