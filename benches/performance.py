"""`make bench`: sewfast and its rivals in one run, the same work, checked; docs/PERFORMANCE.md.

python benches/performance.py [--quick] [--only WORD ...]
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np

import extras
import report
from rows import Row, all_rows
from turns import Turn, take_turns

ROOT = Path(__file__).resolve().parents[1]
RESULTS = ROOT / "docs" / "performance.json"
CACHE = ROOT / "target" / "bench"


class Disagreement(Exception):
    """Contenders that did not do the same work."""


def require_agreement(row: Row, taken: dict[str, list[Turn]]) -> None:
    """Raises where what contenders reached differs by more than the row allows."""
    reached = {name: turns[-1].reached for name, turns in taken.items() if turns}
    for key, tolerance in row.agree.items():
        having = {n: r[key] for n, r in reached.items() if key in r and n not in row.less.values()}
        first = next(iter(having), "")
        for name, value in having.items():
            if not np.allclose(value, having[first], rtol=tolerance, atol=0.0):
                raise Disagreement(f"{key}: {first} {having[first]}, {name} {value}")
        if row.judge is not None and row.judge[0] in having:
            exact = np.array(having[row.judge[0]])
            off = np.abs(np.array(having[first]) - exact).max() / np.abs(exact).max()
            if off > row.judge[1]:
                raise Disagreement(f"{key}: {first} is {off:.1e} off {row.judge[0]}")


def told(row: Row, taken: dict[str, list[Turn]]) -> dict[str, Any]:
    """The row's results, in its unit."""

    def times(name: str, clock: str) -> list[float]:
        return [getattr(turn, clock) for turn in taken[name]]

    contenders, parts = {}, {c.name: c.parts for c in row.contenders}
    for name, turns in taken.items():
        if not turns or name in row.less.values():
            continue
        off = row.less.get(name)
        scale = row.unit[1] / (row.parts * parts[name])
        entry: dict[str, Any] = {"turns": len(turns), "reached": turns[-1].reached}
        for clock in ("cpu", "wall"):
            for which, of in (("least", min), ("median", statistics.median)):
                less = of(times(off, clock)) if off else 0.0
                entry[f"{clock}_{which}"] = (of(times(name, clock)) - less) * scale
        contenders[name] = entry
    return {
        "title": row.title,
        "section": row.section,
        "unit": row.unit[0],
        "clock": row.clock,
        "bars": row.bars,
        "wanted": row.wanted,
        "limit": row.limit,
        "contenders": contenders,
    }


def measured(row: Row, turns: int) -> dict[str, Any]:
    """Takes turns and checks."""
    taken = take_turns(list(row.contenders), turns)
    require_agreement(row, taken)
    return told(row, taken)


def line(found: dict[str, Any]) -> str:
    """What is printed of a row."""
    clock = f"{found['clock']}_least"
    times = [f"{n} {c[clock]:.4g}" for n, c in found["contenders"].items()]
    ratios = [f"{n} {ratio:.2f} x" for n, ratio in report.ratios(found).items()]
    return f"{found['title']}: {', '.join(times)} {found['unit']}; {', '.join(ratios)}".rstrip("; ")


def chosen(words: list[str], quick: bool) -> list[Row]:
    """The rows that are asked for."""
    rows = all_rows()
    if words:
        # a whole name is that row alone
        names = {row.key for row in rows}
        return [
            r for r in rows if any(w == r.key or (w not in names and w in r.key) for w in words)
        ]
    return [row for row in rows if row.quick or not quick]


def keep(results: dict[str, Any]) -> None:
    """Writes the results and the page."""
    RESULTS.write_text(json.dumps(results, indent=1) + "\n")
    report.write(results)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="below two minutes")
    parser.add_argument("--only", nargs="*", default=[], help="rows with a word in their names")
    parser.add_argument("--turns", type=int, help="of every contender, at most")
    parser.add_argument("--dry", action="store_true", help="print, and leave the page as it is")
    given = parser.parse_args()
    CACHE.mkdir(parents=True, exist_ok=True)
    os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(CACHE))
    results: dict[str, Any] = json.loads(RESULTS.read_text()) if RESULTS.exists() else {}
    rows, wrong = results.setdefault("rows", {}), []
    for row in chosen(given.only, given.quick):
        try:
            most = given.turns or (3 if given.quick else row.turns)
            rows[row.key] = measured(row, min(row.turns, most))
            print(line(rows[row.key]), flush=True)
        except (Disagreement, subprocess.SubprocessError) as refused:
            wrong.append(f"{row.key}: {refused}")
            print(f"FAILED, not the same work: {wrong[-1]}", flush=True)
    if not given.only:
        results["seam"] = extras.imports()
        results["memory"] = {} if given.quick else extras.memory()
    results["machine"] = extras.machine()
    if not given.dry:
        keep(results)
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
