"""Every property of the Rust crates under many seeds: what `make laws` runs.

python tests/support/laws.py [--seeds 20] [--cases 10000] [--package NAME ...] [--only WORD]
    [--state FILE --minutes 10]

Each law runs in a process of its own, `--jobs` of them at a time, and all laws under one seed
before the next seed: an interrupted run has whole seeds. With a state file, a run of some minutes
goes on where the last one stopped. A law that holds for one seed may fail for
the next. Cases that fail are kept by proptest in the crate's proptest-regressions, and are tried
first from then on: commit them with what mends them.
"""

from __future__ import annotations

import argparse
import itertools
import json
import os
import re
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

from portions import portion

ROOT = Path(__file__).resolve().parents[2]
CRATES = {"sewfast-control": "control", "sewfast-core": "core", "sewfast-link": "link"}
BUILD = ("cargo", "test", "--profile", "checked", "--lib", "--no-run", "--message-format=json")


def binaries(packages: Sequence[str]) -> dict[str, Path]:
    """The crates' unit tests, built at once: one by one they would be compiled for other features,
    each several times.
    """
    asked = [word for package in packages for word in ("--package", package)]
    done = subprocess.run([*BUILD, *asked], cwd=ROOT, stdout=subprocess.PIPE, text=True, check=True)
    found = [json.loads(line) for line in done.stdout.splitlines()]
    built = {f["target"]["name"]: Path(f["executable"]) for f in found if f.get("executable")}
    return {package: built[package.replace("-", "_")] for package in packages}


def properties(folder: Path) -> set[str]:
    """Names of the functions within `proptest!`."""
    found: set[str] = set()
    for file in folder.rglob("*.rs"):
        for block in blocks(file.read_text(), "proptest! {"):
            found |= set(re.findall(r"#\[test\]\s*fn (\w+)", block))
    return found


def blocks(text: str, opening: str) -> Iterator[str]:
    """What stands between an opening brace and its own closing one."""
    at = text.find(opening)
    while at >= 0:
        end, depth = at + len(opening), 1
        while depth and end < len(text):
            depth += {"{": 1, "}": -1}.get(text[end], 0)
            end += 1
        yield text[at:end]
        at = text.find(opening, end)


def laws(program: Path, package: str, only: str) -> list[str]:
    """Full names of the crate's properties."""
    named = properties(ROOT / "rust" / CRATES[package] / "src")
    listed = subprocess.run([program, "--list"], capture_output=True, text=True, check=True).stdout
    tests = re.findall(r"^(.+): test$", listed, re.MULTILINE)
    found = [test for test in tests if test.rpartition("::")[2] in named and only in test]
    missing = named - {test.rpartition("::")[2] for test in tests}
    if missing:
        raise SystemExit(f"{package}: expected a test for each property, got none for {missing}")
    return found


@dataclass(frozen=True)
class Trial:
    """One law under one seed."""

    seed: int
    package: str
    law: str

    def __str__(self) -> str:
        return f"{self.package} {self.law} (seed {self.seed})"


@dataclass(frozen=True)
class Found:
    """What came of a trial: what its process said where it failed, else nothing."""

    trial: Trial
    said: str
    seconds: float


def try_law(program: Path, trial: Trial, cases: int) -> Found:
    """Run one under one seed."""
    began = time.monotonic()
    done = subprocess.run(
        [program, "--exact", trial.law],
        cwd=ROOT / "rust" / CRATES[trial.package],
        env={**os.environ, "PROPTEST_RNG_SEED": str(trial.seed), "PROPTEST_CASES": str(cases)},
        capture_output=True,
        text=True,
    )
    ran = done.returncode == 0 and "1 passed" in done.stdout
    said = "" if ran else f"{trial} ended with {done.returncode}\n{done.stdout}{done.stderr}"
    return Found(trial, said, time.monotonic() - began)


def summary(found: Sequence[Found], package: str, cases: int) -> str:
    mine = [f for f in found if f.trial.package == package]
    took: dict[str, float] = {}
    for f in mine:
        took[f.trial.law] = took.get(f.trial.law, 0.0) + f.seconds
    slowest = sorted(took, key=lambda name: -took[name])[:3]
    return (
        f"{package:<16} {len(mine)} trials of {len(took)} laws, {cases} cases each: "
        f"{sum(bool(f.said) for f in mine)} failed; slowest "
        + ", ".join(f"{name.rpartition('::')[2]} {took[name]:.0f} s" for name in slowest)
    )


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--first", type=int, default=1, help="the first seed")
    parser.add_argument("--cases", type=int, default=10_000)
    parser.add_argument("--package", action="append", choices=CRATES)
    parser.add_argument("--only", default="", help="properties with this in their name")
    parser.add_argument("--jobs", type=int, default=os.cpu_count(), help="processes at a time")
    parser.add_argument("--state", type=Path, help="file that says where to go on")
    parser.add_argument("--minutes", type=float, default=float("inf"), help="begin no law later")
    asked = parser.parse_args()
    programs = binaries(asked.package or list(CRATES))
    named = {package: laws(p, package, asked.only) for package, p in programs.items()}
    seeds = range(asked.first, asked.first + asked.seeds)
    work = [
        Trial(seed, package, law) for seed in seeds for package in named for law in named[package]
    ]
    found: list[Found] = []
    with ThreadPoolExecutor(asked.jobs) as pool:
        todo = portion(work, asked.state, asked.minutes)
        while some := list(itertools.islice(todo, asked.jobs)):
            if asked.state:  # all of these are done again if they are interrupted
                asked.state.write_text(str(some[0]))
            for f in pool.map(lambda t: try_law(programs[t.package], t, asked.cases), some):
                found.append(f)
                print(f"{f.trial}: {'FAILED' if f.said else 'ok'}, {f.seconds:.1f} s", flush=True)
                if f.said:
                    print(f.said[-4000:], flush=True)
    failed = [f for f in found if f.said]
    rows = [summary(found, package, asked.cases) for package in programs]
    print("\n".join(["", *rows, *(str(f.trial) for f in failed)]))
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
