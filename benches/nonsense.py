"""Records that deceive, and good ones: how many are praised, named and accused (`make nonsense`).

A record is praised if the verdict on its model is good or fair and no samples were left out. All
records are those held back: no rule was made on them (`tests/support/deceivers.py`).
"""

from __future__ import annotations

import argparse
import sys
import time
import warnings
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests" / "support"))

from deceivers import GOOD, HELD, NONSENSE, data, good, nonsense
from sewfast import SewfastError, identify
from sewfast.dataset import Dataset
from sewfast.dataset.faults import faults


def judged(record: Dataset, model: str) -> tuple[str, list[str]]:
    """The grade of a model, or "refused", and the faults that were named."""
    try:
        found = faults(record)
        kinds = [fault.kind for fault in found]
        grade = identify(record, model=model, time_budget=5.0).training["verdict"]["grade"]
    except SewfastError:
        return "refused", kinds
    praised = grade in ("good", "fair") and not any(fault.dead for fault in found)
    return "praised" if praised else f"({grade})", kinds


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=2, help="records of each kind")
    parser.add_argument(
        "--first", type=int, default=HELD, help=f"first seed; held back from {HELD}"
    )
    parser.add_argument("--model", default="auto")
    parser.add_argument("--only", default="", help="words of the names")
    args = parser.parse_args()
    warnings.simplefilter("ignore")
    count = {
        "records": 0,
        "praised": 0,
        "nameable": 0,
        "named": 0,
        "good": 0,
        "accused": 0,
        "kept": 0,
    }
    began = time.monotonic()
    for names, made in ((NONSENSE, nonsense), (GOOD, good)):
        for kind in names:
            if args.only not in kind:
                continue
            for seed in range(args.first, args.first + args.count):
                grade, kinds = judged(data(made(kind, seed)), args.model)
                print(f"{kind:28s} {seed:4d}  {grade:10s} {', '.join(kinds)}", flush=True)
                if names is GOOD:
                    count["good"] += 1
                    count["accused"] += bool(kinds)
                    count["kept"] += grade == "praised"
                    continue
                count["records"] += 1
                count["praised"] += grade == "praised"
                if expected := NONSENSE[kind].named:
                    count["nameable"] += 1
                    count["named"] += bool(set(kinds) & set(expected))
    print(
        "praised {praised} of {records} records that deceive, named {named} of {nameable}; "
        "accused {accused} of {good} good ones, of which {kept} are graded good or fair".format(
            **count
        )
        + f" ({time.monotonic() - began:.0f} s)"
    )


if __name__ == "__main__":
    main()
