"""Which tests `make test` leaves to the night: writes tests/night.txt from a measured run.

A test that takes over half a second goes if the others reach (nearly) every line of the package
that it reaches; the most seconds for the fewest lines go first, until the day has lost `LINES`.
What is marked `slow` or `nightly` stays as it is. The run that `make parting` measures holds every
test of the day and of the list, with the lines that each reaches (`--cov-context=test`). What a
process that a test starts reaches is known only as a whole: it counts as reached whoever goes.
"""

from __future__ import annotations

import collections
import json
import sqlite3
import sys
from pathlib import Path

LIST = Path(__file__).parents[1] / "night.txt"
HEAD = """\
# Left to `make nightly`, written by `make parting`: tests of over half a second, of whose
# lines the others reach all but a few. A family leaves its quickest case; `slow` keeps a test.
"""
LEAST = 0.5
"""Seconds from which a test, or what goes of a family, is worth a line of the list."""
LINES = 40
"""Lines of the package, of 35,000, that no test of the day may reach any more."""
PROMISES = 0.2
"""Seconds that a test of the day may cost whatever it reaches."""


def units(seconds: dict[str, float]) -> dict[str, list[str]]:
    """What goes together: a test, or all cases of a family but the quickest."""
    families: dict[str, list[str]] = collections.defaultdict(list)
    for name in seconds:
        families[name.partition("[")[0]].append(name)
    found = {}
    for family, names in families.items():
        going = sorted(names, key=lambda n: (seconds[n], n))[1 if len(names) > 1 else 0 :]
        if sum(seconds[n] for n in going) >= LEAST:
            found[family] = going
    return found


def reached(database: Path) -> dict[str, set[tuple[int, int]]]:
    """Lines of each test, as numbers of the file and in it."""
    from coverage.numbits import numbits_to_nums

    lines: dict[str, set[tuple[int, int]]] = collections.defaultdict(set)
    with sqlite3.connect(database) as data:
        names = dict(data.execute("select id, context from context"))
        for file, context, bits in data.execute(
            "select file_id, context_id, numbits from line_bits"
        ):
            test = names[context].rpartition("|")[0]
            lines[test] |= {(file, n) for n in numbits_to_nums(bits)}
    return lines


def left(
    seconds: dict[str, float], lines: dict[str, set[tuple[int, int]]], most: int = LINES
) -> tuple[list[str], int]:
    """Names of the tests that go, and how many lines they take with them, `most` at the most."""
    by_day = collections.Counter(line for reach in lines.values() for line in reach)

    def lost(names: list[str]) -> int:
        going = collections.Counter(line for name in names for line in lines.get(name, ()))
        return sum(by_day[line] == many for line, many in going.items())

    def worth(names: list[str]) -> float:
        return (sum(seconds[n] for n in names) - PROMISES * len(names)) / (1 + lost(names))

    due = units(seconds)
    gone: list[str] = []
    taken = 0
    while due:
        family = max(due, key=lambda f: (worth(due[f]), f))
        names = due.pop(family)
        takes = lost(names)
        if worth(names) <= 0.0 or taken + takes > most:
            continue
        taken += takes
        gone += names
        for name in names:
            by_day.subtract(lines.get(name, ()))
    return sorted(gone), taken


def main(seconds: Path, database: Path) -> None:
    taken: dict[str, float] = {}
    for part in seconds.glob("*.json"):
        taken |= json.loads(part.read_text(encoding="utf-8"))
    gone, lines = left(taken, reached(database))
    LIST.write_text(HEAD + "".join(f"{name}\n" for name in gone), encoding="utf-8")
    spared, all_of_it = sum(taken[n] for n in gone), sum(taken.values())
    print(f"{len(gone)} of {len(taken)} tests, {spared:.0f} of {all_of_it:.0f} s, {lines} lines")


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
