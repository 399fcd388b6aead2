"""Accuracy on public records with the default configuration, beside what is published.

    python benches/accuracy.py [--only NAME ..] [--repetitions 10] [--out FILE.json]

The protocols are those of nonlinearbenchmark.org: the test record is simulated from its inputs and
its first n outputs, and scored after them. Nothing is decided on a test record. SEWFAST_DATA names
the folder with the recordings.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

import sewfast
from sewfast import Dataset, Model, identify

DATA = Path(os.environ.get("SEWFAST_DATA", Path(__file__).parents[2] / "shared" / "data"))
OUTLIER = 1.3
"""A repetition whose score is more than this multiple of the median is counted."""


@dataclass(frozen=True)
class Protocol:
    """Records of one benchmark: what is learned from, what is scored, what others reached."""

    train: Dataset
    tests: dict[str, Dataset]
    n: int
    unit: str
    factor: float = 1.0
    published: dict[str, tuple[float, ...]] = field(default_factory=dict)
    truth: str | None = None


def coupled_drives() -> Protocol:
    folder = DATA / "coupled_drives"
    records = [
        sewfast.read(folder / "DATAUNIF.MAT", inputs=f"u1{i}", output=f"z1{i}", Ts=0.02)
        for i in (1, 2)
    ]
    return Protocol(
        Dataset.concat(r[0:400] for r in records),
        {f"record {i + 1}": r[400:500] for i, r in enumerate(records)},
        10,
        "ticks/s",
        published={
            "ARX": (0.291, 0.331),
            "polynomial NARX": (0.100, 0.141),
            "GP-NARX": (0.102, 0.090),
            "RNN": (0.096, 0.235),
            "best anywhere": (0.115, 0.074),
        },
    )


def silverbox() -> Protocol:
    path = DATA / "silverbox" / "SNLS80mV.mat"
    whole = sewfast.read(path, inputs="V1", output="V2", Ts=1 / 610.35)
    multisine, arrow = whole[40650:127400], whole[100:40575]
    tests = {"multisine": multisine[65062:], "arrow": arrow, "no extrapolation": arrow[:32000]}
    return Protocol(
        multisine[:65062],
        tests,
        50,
        "mV",
        1e3,
        published={
            "ARX": (6.95, 14.2, 6.59),
            "polynomial NARX": (0.640, 2.25, 0.571),
            "GRU": (1.49, 2.80, 0.947),
            "best anywhere": (0.36, 0.26, 0.32),
        },
    )


def virtual_machine() -> Protocol:
    """The sewing machine: scored against its true speed, trained on what the encoder gives."""
    machine = sewfast.VirtualMachine()

    def recorded(name: str, seed: int) -> Dataset:
        u = sewfast.signals.excitation(name, seed)
        return sewfast.record(machine, u, name=name).dataset()

    train = Dataset.concat([recorded("chirp_lo_hi", 0), recorded("random", 1)])
    tests = {"Hi-Lo": recorded("chirp_hi_lo", 0), "random": recorded("random", 2)}
    return Protocol(train, tests, 20, "RPM", truth="speed_true")


def motor(file: str) -> Callable[[], Protocol]:
    """The first 60 % to learn from, the last 40 % to score."""

    def load() -> Protocol:
        train, rest = sewfast.read(DATA / file, inputs="u", output="y").split(0.6)
        return Protocol(train, {"last 40 %": rest}, 20, "")

    return load


PROTOCOLS: dict[str, Callable[[], Protocol]] = {
    "coupled drives": coupled_drives,
    "silverbox": silverbox,
    "virtual machine": virtual_machine,
    "bldc": motor("bldc_cigan/bldc.csv"),
    "dc motor": motor("dc_motor_un/prbs_open_exp.csv"),
}


def scores(model: Model, protocol: Protocol) -> tuple[float, ...]:
    """RMSE of the free run on every test record; outputs after the first n are not shown."""
    return tuple(_score(model, test, protocol) for test in protocol.tests.values())


def _score(model: Model, test: Dataset, protocol: Protocol) -> float:
    e, n = test.experiments[0], protocol.n
    seen = np.where(np.arange(len(e)) < n, e.y, np.nan)
    blind = Dataset.from_arrays(
        e.u,
        seen,
        test.Ts,
        input_names=test.input_names,
        output_name=test.output_name,
        input_units=test.input_units,
        output_unit=test.output_unit,
    )
    (run,) = model.simulate(blind, init=n)
    truth = e.y if protocol.truth is None else e.channels[protocol.truth]
    error = (truth - run)[n:]
    return protocol.factor * float(np.sqrt(np.mean(error**2)))


def measured(protocol: Protocol, repetitions: int) -> dict[str, Any]:
    """The default configuration with as many seeds: scores, times, structures."""
    found: list[tuple[float, ...]] = []
    seconds: list[float] = []
    chosen: list[str] = []
    for seed in range(repetitions):
        began = time.perf_counter()
        model = identify(protocol.train, seed=seed)
        seconds.append(time.perf_counter() - began)
        found.append(scores(model, protocol))
        chosen.append(repr(model))
        print(
            f"  seed {seed}: {_shown(found[-1])} in {seconds[-1]:.1f} s, {model.orders}", flush=True
        )
    pooled = [float(np.sqrt(np.mean(np.square(f)))) for f in found]
    median = statistics.median(pooled)
    return {
        "scores": found,
        "median": [statistics.median(column) for column in zip(*found, strict=True)],
        "seconds": seconds,
        "outliers": sum(p > OUTLIER * median for p in pooled),
        "models": chosen,
    }


def linear(protocol: Protocol) -> dict[str, tuple[float, ...]]:
    """ARX and output error of orders 1 to 3, as rivals."""
    rivals = {}
    for kind in ("arx", "oe"):
        for order in (1, 2, 3):
            model = identify(protocol.train, model=kind, na=order, nb=order)  # type: ignore[arg-type]
            rivals[f"{kind} {order}"] = scores(model, protocol)
    return rivals


def _shown(values: tuple[float, ...] | list[float]) -> str:
    return " / ".join(f"{v:.4g}" for v in values)


def _report(name: str, protocol: Protocol, found: dict[str, Any]) -> None:
    columns = list(zip(*found["scores"], strict=True))
    low, high = [min(c) for c in columns], [max(c) for c in columns]
    print(f"{name}: RMSE [{protocol.unit}] on {', '.join(protocol.tests)}")
    print(f"  sewfast, median of {len(found['scores'])}: {_shown(found['median'])}")
    print(f"  smallest {_shown(low)}, largest {_shown(high)}")
    print(f"  over {OUTLIER} x the median: {found['outliers']}")
    print(f"  training: median {statistics.median(found['seconds']):.1f} s")
    for rival, values in {**found["rivals"], **protocol.published}.items():
        print(f"  {rival}: {_shown(values)}")


def main() -> None:
    """Run the protocols that were asked for and print their tables."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--only", nargs="+", choices=tuple(PROTOCOLS), default=tuple(PROTOCOLS))
    parser.add_argument("--repetitions", type=int, default=10)
    parser.add_argument("--out", type=Path, help="write the numbers as JSON")
    args = parser.parse_args()
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    print(f"sewfast {sewfast.__version__}, {platform.machine()}, {cores} cores")
    results = {}
    for name in args.only:
        protocol = PROTOCOLS[name]()
        found = measured(protocol, args.repetitions)
        found["rivals"] = linear(protocol)
        _report(name, protocol, found)
        results[name] = found
    if args.out is not None:
        args.out.write_text(json.dumps(results, indent=1) + "\n")


if __name__ == "__main__":
    main()
