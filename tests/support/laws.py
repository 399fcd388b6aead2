"""Every property of the Rust crates under many seeds: what `make laws` runs.

python tests/support/laws.py [--seeds 20] [--cases 10000] [--package NAME ...] [--only WORD]

A law that holds for one seed may fail for the next. Cases that fail are kept by proptest in the
crate's proptest-regressions, and are tried first from then on: commit them with what mends them.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
CRATES = {"sewfast-control": "control", "sewfast-core": "core", "sewfast-link": "link"}
BUILD = ("cargo", "test", "--profile", "checked", "--lib", "--no-run", "--message-format=json")


def binary(package: str) -> Path:
    """The crate's unit tests, built."""
    done = subprocess.run(
        [*BUILD, "--package", package], cwd=ROOT, stdout=subprocess.PIPE, text=True, check=True
    )
    found = [json.loads(line).get("executable") for line in done.stdout.splitlines()]
    return next(Path(path) for path in reversed(found) if path)


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


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--first", type=int, default=1, help="the first seed")
    parser.add_argument("--cases", type=int, default=10_000)
    parser.add_argument("--package", action="append", choices=CRATES)
    parser.add_argument("--only", default="", help="properties with this in their name")
    asked = parser.parse_args()
    failed: list[str] = []
    rows: list[str] = []
    for package in asked.package or CRATES:
        program = binary(package)
        names = laws(program, package, asked.only)
        began, broken = time.monotonic(), 0
        for seed in range(asked.first, asked.first + asked.seeds) if names else ():
            done = subprocess.run(
                [program, "--exact", *names],
                cwd=ROOT / "rust" / CRATES[package],
                env={
                    **os.environ,
                    "PROPTEST_RNG_SEED": str(seed),
                    "PROPTEST_CASES": str(asked.cases),
                },
                capture_output=True,
                text=True,
            )
            found = re.findall(r"^test (.+) \.\.\. FAILED$", done.stdout, re.MULTILINE)
            if done.returncode and not found:
                found = [f"{package}, which ended with {done.returncode}"]
            broken += len(found)
            failed += [f"{name} (seed {seed})" for name in found]
            print(f"{package} seed {seed}: {len(names)} laws, {len(found)} failed", flush=True)
            if found:
                print(done.stdout[-4000:], flush=True)
        seconds = time.monotonic() - began
        rows.append(
            f"{package:<16} {len(names):>4} laws x {asked.seeds} seeds x {asked.cases} cases: "
            f"{broken} failed, {seconds:.0f} s"
        )
    print("\n".join(["", *rows, *failed]))
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
