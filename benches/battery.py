"""The battery: `identify` with its defaults on simulated systems whose truth is known.

    python benches/battery.py [--split rules|held|all] [--families NAME ..] [--seeds 3] [--runs 1]
        [--time-budget S] [--threads N] [--jobs N] [--cache FILE] [--json FILE] [--quick]
    make battery [SPLIT=..] [FAMILIES="NAME .."] [SEEDS=..] [QUICK=1]

Each family draws another system for every seed. Which families there are, and which of the two
halves each belongs to, stands in benches/battery/families/; what the errors are held against in
references.py; what is reported in scoring.py. Families of the half HELD are for the record: no rule
may be made on them.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import sys
from pathlib import Path
from typing import Any

import sewfast
from battery.families import FAMILIES, HELD, RULES
from battery.scoring import Cache, Outcome, Task, line, run_all, summary, table
from battery.simulators import IS_COMPILED

SPLITS = {"rules": RULES, "held": HELD, "all": (*RULES, *HELD)}


def main(arguments: list[str] | None = None) -> int:
    """Run what was asked for; 1 where a run ended without a model."""
    args = _parsed(arguments)
    cache = Cache(args.cache)
    tasks = [
        Task(name, seed, args.runs, args.time_budget, args.threads, cache.get(name, seed))
        for name in _names(args)
        for seed in args.seeds
    ]
    if not IS_COMPILED:
        print("numba is not installed (extra bench): the references take minutes longer")

    def ended(found: Outcome) -> None:
        cache.put(found)
        print(line(found), flush=True)

    outcomes = run_all(tasks, args.jobs, ended)
    ran = [o for o in outcomes if o.runs]
    if ran:
        print("\n" + table(ran))
    if args.json is not None:
        args.json.write_text(json.dumps(_finite(_document(args, outcomes)), indent=1) + "\n")
    return int(any(run.failure for o in ran for run in o.runs))


def _parsed(arguments: list[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--split", choices=tuple(SPLITS), default="all")
    parser.add_argument("--families", nargs="+", choices=tuple(FAMILIES), metavar="NAME")
    parser.add_argument(
        "--seeds", type=_seeds, default="3", help="of the systems: a number, or 0,4,7, or 5-9"
    )
    parser.add_argument("--runs", type=int, default=1, help="seeds of identify; 0: references only")
    parser.add_argument("--time-budget", type=float, help="seconds, given to identify")
    parser.add_argument("--threads", type=int, help="given to identify")
    parser.add_argument("--jobs", type=int, default=1, help="processes; cases are independent")
    parser.add_argument("--cache", type=Path, help="JSON that keeps oracles and output errors")
    parser.add_argument("--json", type=Path, help="results to write")
    parser.add_argument("--quick", action="store_true", help="small families, one seed")
    args = parser.parse_args(arguments)
    if args.quick:
        args.seeds = [0]
    return args


def _names(args: argparse.Namespace) -> tuple[str, ...]:
    names = tuple(args.families or SPLITS[args.split])
    if args.quick and not args.families:
        names = tuple(n for n in names if FAMILIES[n].quick)
    return names


def _seeds(text: str) -> list[int]:
    """`3` is 0, 1, 2; `0,4,7` are these; `5-9` are five."""
    if "-" in text:
        first, last = map(int, text.split("-"))
        return list(range(first, last + 1))
    if "," in text:
        return [int(x) for x in text.split(",") if x]
    return list(range(int(text)))


def _document(args: argparse.Namespace, outcomes: list[Outcome]) -> dict[str, Any]:
    settings = {k: v for k, v in vars(args).items() if k not in ("cache", "json")}
    return {
        "version": sewfast.__version__,
        "cores": os.cpu_count(),
        "settings": settings,
        "summary": summary([o for o in outcomes if o.runs]),
        "cases": [o.to_json() for o in outcomes],
    }


def _finite(value: Any) -> Any:
    """JSON has no infinity: null stands for a run that has failed or run away."""
    if isinstance(value, dict):
        return {k: _finite(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(v) for v in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


if __name__ == "__main__":
    sys.exit(main())
