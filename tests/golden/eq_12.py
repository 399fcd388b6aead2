"""Writes python/sewfast/data/eq_12.csv: Eq. 12 of the paper solved over L/T, with its costs.

Run it from the root of the repository: python tests/golden/eq_12.py
"""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

from sewfast import _core
from sewfast.control import Fopdt
from sewfast.rules import eq_12, table_1

PLACE = Path(__file__).resolve().parents[2] / "python" / "sewfast" / "data" / "eq_12.csv"
LIMITS = (math.inf, 2.0, 1.7, 1.4)
COLUMNS = (
    "L/T,Ms_limit,Kp K,Ti/T,Td/T,alpha,beta,disturbance_cost,reference_cost,Ms,"
    "table_1_disturbance_cost,table_1_reference_cost"
)
HEADER = f"""\
# Eq. 12 of the paper, int w |d^2 E/ds^2|^2 dw, solved for the plant e^(-sL)/(1 + sT)
# and the ideal 2-DOF PID in continuous time.
# Kp K, Ti/T, Td/T: the least cost after a unit step of the disturbance among gains
# with max |S| of at most Ms_limit (inf: no limit).
# alpha, beta: the least cost after a unit step of the reference with these gains, the
# integral taken up to w = 1000/L.
# Costs with K = T = 1. Ms: max |S|. table_1_*: costs of the paper's Table 1 at its rows.
# All columns are pure numbers. Made by tests/golden/eq_12.py.
{COLUMNS}
"""


def ratios() -> list[float]:
    """.01 to 2: twelve a decade, and the rows of Table 1."""
    even = np.geomspace(0.01, 2.0, 28)
    return sorted({*(float(f"{r:.4g}") for r in even), *(i / 10 for i in range(1, 11))})


def row(ratio: float, limit: float) -> list[float]:
    """One line of the file."""
    plant = Fopdt(1.0, 1.0, ratio)
    rule = eq_12(plant, Ms=limit)
    costs = [rule.costs[name] for name in ("disturbance_cost", "reference_cost", "Ms")]
    gains = rule.gains
    return [
        ratio, limit, gains.Kp, gains.Ti, gains.Td, rule.alpha, rule.beta, *costs, *of_table(ratio)
    ]  # fmt: skip


def of_table(ratio: float) -> list[float]:
    """Costs of Table 1's row, NaN where it has none."""
    if round(ratio * 10, 9) not in range(1, 11):
        return [math.nan, math.nan]
    rule = table_1(Fopdt(1.0, 1.0, ratio))
    found = _core.eq_12_costs(
        ratio, KpK=rule.gains.Kp, Ti=rule.gains.Ti, Td=rule.gains.Td, alpha=rule.alpha,
        beta=rule.beta,
    )  # fmt: skip
    return [found["disturbance_cost"], found["reference_cost"]]


def main() -> None:
    lines = [",".join(f"{x:.6g}" for x in row(r, m)) for m in LIMITS for r in ratios()]
    PLACE.write_text(HEADER + "\n".join(lines) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
