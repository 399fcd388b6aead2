"""A linear rival beside a network in `tune`: what either's gains cost on the drive itself.

Drives of `drives.py`, recorded in open loop: a chirp of 20 s, a step and, for half of the networks,
pulses up to the limit. The linear model is one of chirp and step.

    python benches/second_opinion.py nominal drawn1 drawn2 drawn3 drawn5 --seeds 2
"""

from __future__ import annotations

import argparse

import numpy as np

from drives import FAMILY, Simulator, bench_of, drawn
from sewfast import Controller, _core, identify, tune
from sewfast.commissioning.demands import demands
from sewfast.commissioning.excitations import standard
from sewfast.commissioning.gains import cost_of
from sewfast.dataset import Dataset

TS = 1e-3
ACCELERATION = 5300.0
"""Which the references are planned with [RPM/s]."""


def pulses() -> np.ndarray:
    """Commands up to the limit between gentle ones [V]."""
    rng = np.random.default_rng(3)
    parts: list[np.ndarray] = []
    while sum(map(len, parts)) < 8000:
        hard = np.full(int(rng.integers(20, 120)), rng.choice([20.0, -20.0, 15.0, -10.0]))
        parts += [hard, np.full(int(rng.integers(200, 600)), rng.uniform(0.5, 4.5))]
    return np.concatenate(parts)


def chirp() -> np.ndarray:
    """From low to high speeds and frequencies [V]."""
    return _core.chirp(
        duration=20.0, Ts=TS, f_start=0.05, f_end=3.0, amplitude_start=0.3, amplitude_end=1.2,
        offset_start=1.0, offset_end=2.6,
    )  # fmt: skip


def measured(name: str, seeds: int) -> None:
    """Print a line per network."""
    named = {d.name: d for d in FAMILY}
    drive = named[name] if name in named else drawn(int(name.removeprefix("drawn")))
    bench = bench_of(Simulator(drive))
    asked = demands(
        bench, u_max=None, speed=None, references=None, members=1, evaluations=1, seed=0, threads=1
    )
    practice = standard(ACCELERATION, asked, TS, short=True)
    verify = standard(ACCELERATION, asked, TS, short=False)
    cost = cost_of(practice, TS, asked)
    step = np.repeat([0.0, 3.0], [200, 1800])
    signals = {"chirp": chirp(), "step": step, "pulses": pulses()}
    recorded = {key: bench.excite(u, key).dataset() for key, u in signals.items()}

    def on_the_drive(controller: Controller) -> float:
        return cost.of([bench.follow(controller, r, key) for key, r in verify.items()])

    rival = identify(Dataset.concat([recorded["chirp"], recorded["step"]]), model="oe")
    for keys in (("chirp", "step", "pulses"), ("chirp", "step")):
        data = Dataset.concat([recorded[key] for key in keys])
        for seed in range(seeds):
            network = identify(data, model="neural_oe", starts=1, seed=seed, select=False)
            found = tune(
                network, list(practice.values()), rival=rival, u_min=-20.0, u_max=20.0,
                counts_per_rev=drive.counts, filter_samples=8, cost=cost,
            )  # fmt: skip
            opinion = found.opinion
            if opinion is None:
                print(f"{name:9}{seed:3} the rival has no opinion", flush=True)
                continue
            told = "contradicted" if opinion.is_contradiction else ""
            own, taken = (on_the_drive(c) for c in (opinion.candidates[0], found.controller))
            data_told = "with pulses" if "pulses" in keys else "without"
            print(f"{name:9}{seed:3} {data_told:12}{own:8.1f}{taken:8.1f} {told}", flush=True)


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("drives", nargs="+", help="names of drives.py, drawnN among them")
    parser.add_argument("--seeds", type=int, default=1)
    args = parser.parse_args()
    print("drive    seed data           own   taken  cost on the drive [RPM]")
    for name in args.drives:
        measured(name, args.seeds)


if __name__ == "__main__":
    main()
