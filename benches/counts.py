"""Instructions that the kernels take, by valgrind's callgrind, beside those that are kept here.

python benches/counts.py [--keep]

Counted with AVX2 and on the baseline: valgrind knows no AVX-512. Which instructions come out of a
source is the compiler's affair, and some are the C library's: counts are compared only where both
are of the versions that were there when they were kept.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import re
import shutil
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
KEPT = Path(__file__).with_name("counts.json")
LEVELS = ("avx2", "baseline")
TOLERANCE = 0.03
"""Share by which a count may grow: inlining moves that much with code that is elsewhere."""
FEW = 1e-3
"""Counts that differ by less say nothing."""


def build() -> Path:
    """The program with the kernels."""
    # with the features of the whole workspace, as the extension: the core is there already
    command = ["cargo", "build", "--release", "--quiet", "--workspace"]
    subprocess.run([*command, "--example", "kernels"], cwd=ROOT, check=True)
    target = os.environ.get("CARGO_TARGET_DIR", str(ROOT / "target"))
    return Path(target) / "release" / "examples" / "kernels"


def kernels(program: Path) -> dict[str, int]:
    """Samples of a call, by the kernel's name."""
    listed = subprocess.run([str(program)], capture_output=True, text=True, check=True).stdout
    return {name: int(samples) for name, samples in map(str.split, listed.splitlines())}


def count(program: Path, name: str, level: str) -> int:
    """Instructions of one call."""
    command = ["valgrind", "--tool=callgrind", "--callgrind-out-file=/dev/null"]
    command += ["--toggle-collect=*measured*", str(program), name]
    done = subprocess.run(
        command,
        capture_output=True,
        text=True,
        check=True,
        env={**os.environ, "SEWFAST_CPU": level},
    )
    found = re.search(r"Collected : (\d+)", done.stderr)
    if found is None or int(found[1]) == 0:
        raise SystemExit(
            f"expected a count of {name} from callgrind, got none: {done.stderr[-300:]}"
        )
    return int(found[1])


def counted(program: Path) -> dict[str, dict[str, float]]:
    """Instructions per sample by kernel and level; of trainings those of one iteration more."""
    samples = kernels(program)
    levels = [level for level in LEVELS if level == "baseline" or _has_avx2()]
    jobs = [(name, level) for name in samples for level in levels]
    with ThreadPoolExecutor(os.cpu_count() or 1) as pool:
        totals = dict(zip(jobs, pool.map(lambda job: count(program, *job), jobs), strict=True))
    found: dict[str, dict[str, float]] = {}
    for name, level in jobs:
        if name.endswith("_4"):
            continue
        many = float(totals[name, level])
        if name.endswith("_8"):
            many = (many - totals[name[:-1] + "4", level]) / 4
        title = name.removesuffix("_8")
        found.setdefault(title, {})[level] = round(many / samples[name], 2)
    return found


def _has_avx2() -> bool:
    try:
        return " avx2 " in Path("/proc/cpuinfo").read_text().replace("\n", " ")
    except OSError:
        return False


def versions() -> dict[str, str]:
    """What decides which instructions there are."""
    rustc = subprocess.run(["rustc", "--version"], capture_output=True, text=True, check=True)
    return {
        "rustc": rustc.stdout.split()[1],
        "target": f"{platform.machine()} {platform.system()}",
        "libc": " ".join(platform.libc_ver()),
    }


def compared(kept: dict[str, Any], found: dict[str, dict[str, float]]) -> list[str]:
    """Prints every change; what grew by more than the tolerance."""
    grown = []
    for name, levels in found.items():
        for level, now in levels.items():
            before = kept["kernels"].get(name, {}).get(level)
            if before is None:
                print(f"{name}, {level}: {now:,.1f} instructions per sample, not kept yet")
                continue
            change = now / before - 1.0
            if abs(change) > FEW:
                print(f"{name}, {level}: {before:,.1f} -> {now:,.1f} per sample ({change:+.1%})")
            if change > TOLERANCE:
                grown.append(f"{name}, {level}")
    return grown


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--keep", action="store_true", help="keep these counts from now on")
    given = parser.parse_args()
    if shutil.which("valgrind") is None:
        print("valgrind is not installed: instruction counts are not compared")
        return 0
    kept = json.loads(KEPT.read_text()) if KEPT.exists() else {"versions": {}, "kernels": {}}
    here = versions()
    if not given.keep and kept["versions"] != here:
        print(f"counts were kept with {kept['versions']}, here is {here}: they are not compared")
        return 0
    found = counted(build())
    grown = compared(kept, found)
    if given.keep:
        KEPT.write_text(json.dumps({"versions": here, "kernels": found}, indent=1) + "\n")
        return 0
    if grown:
        print(
            f"more than {TOLERANCE:.0%} more instructions: {'; '.join(grown)}. If that is meant, "
            "keep them: python benches/counts.py --keep",
            file=sys.stderr,
        )
    else:
        print(f"{len(found)} kernels take as many instructions as before, within {TOLERANCE:.0%}")
    return 1 if grown else 0


if __name__ == "__main__":
    sys.exit(main())
