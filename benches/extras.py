"""What is measured beside the rows: the machine, the time that an import takes, memory."""

from __future__ import annotations

import os
import platform
import statistics
import subprocess
import sys
import time
from importlib import metadata
from pathlib import Path
from typing import Any

from sewfast import _core
from turns import Contender, Worker

PACKAGES = ("numpy", "scipy", "numba", "jax", "pyrenn", "control")
STATEMENTS = ("pass", "import numpy", "import sewfast", "from sewfast import identify, tune, run")


def _version(package: str) -> str | None:
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return None


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return platform.processor() or platform.machine()
    names = (line.split(":", 1)[1].strip() for line in lines if line.startswith("model name"))
    return next(names, platform.machine())


def _rustc() -> str:
    try:
        told = subprocess.run(["rustc", "--version"], capture_output=True, text=True, check=True)
    except (OSError, subprocess.CalledProcessError):
        return "unknown"
    return told.stdout.split()[1]


def machine() -> dict[str, Any]:
    """Processor, level of the kernels and versions; no name of a host, no path."""
    versions = {package: _version(package) for package in PACKAGES}
    return {
        "processor": _processor(),
        "cores": os.cpu_count(),
        "level": _core.cpu,
        "system": f"{platform.system()} {platform.machine()}",
        "load": round(os.getloadavg()[0], 1),
        "versions": {
            "sewfast": _core.__version__,
            "Rust": _rustc(),
            "Python": platform.python_version(),
            **{package: version for package, version in versions.items() if version},
        },
    }


def imports(rounds: int = 9) -> dict[str, float]:
    """Milliseconds of the clock for an interpreter that does nothing else, the least of all."""
    times: dict[str, list[float]] = {statement: [] for statement in STATEMENTS}
    for _ in range(rounds):
        for statement, found in times.items():
            began = time.perf_counter()
            subprocess.run([sys.executable, "-c", statement], check=True)
            found.append(1e3 * (time.perf_counter() - began))
    return {statement: min(found) for statement, found in times.items()}


def memory() -> dict[str, float]:
    """Bytes per sample that trainings take beside the data: the median of three."""
    found = {}
    for samples, hidden in ((100_000, 8), (1_000_000, 8), (1_000_000, 16), (1_000_000, 64)):
        several = [_grown(samples, hidden) for _ in range(3)]
        found[f"N = {samples:,}, {hidden} hidden units"] = statistics.median(several)
    return found


def _grown(samples: int, hidden: int) -> float:
    contender = Contender("memory", "ours", "memory", {"samples": samples, "hidden": hidden})
    worker = Worker(contender)
    try:
        worker.ready()
        return float(worker.turn().reached["bytes_per_sample"])
    finally:
        worker.close()
