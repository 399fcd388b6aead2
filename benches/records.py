"""Frequency responses of records whose truth is known: local polynomials beside averaged segments.

    python benches/records.py                even seeds: what the rules were made on
    python benches/records.py --held         odd seeds, held back
    python benches/records.py --feedback     a controller around the plant, its reference known

Two masses with a lag and a dead time, drawn anew for each seed, already in motion when the record
begins. Errors are read on one grid of frequencies from .01 to .35 of the sample rate, for both
methods alike; a band holds where the truth is within it, at the method's own frequencies.
"""

from __future__ import annotations

import argparse
import itertools
import math
import time
from typing import Any

import numpy as np
from scipy.signal import csd, lfilter, welch

from sewfast.frequency import FrequencyResponse, local_polynomial, spectral

TS = 1e-3
SIGNALS = ("chirp", "log chirp", "prbs", "random", "multisine")
LENGTHS = (4_000, 20_000)
NOISES = (0.0, 0.01, 0.1)
"""Of the output's standard deviation."""
BEFORE = 3_000
"""Samples that have passed when the record begins."""


def system(seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Numerator and denominator in powers of the delay."""
    rng = np.random.default_rng([seed, 91])
    fr = math.exp(rng.uniform(math.log(20.0), math.log(250.0)))
    share, zr, za = rng.uniform(0.2, 0.7), rng.uniform(0.01, 0.06), rng.uniform(0.01, 0.06)
    fa = fr * math.sqrt(1.0 - share)
    pole = math.exp(-TS / math.exp(rng.uniform(math.log(0.005), math.log(0.1))))

    def pair(f: float, z: float) -> np.ndarray:
        w = 2.0 * math.pi * f * TS
        p = np.exp(-z * w + 1j * w * math.sqrt(1.0 - z * z))
        return np.array([1.0, -2.0 * p.real, abs(p) ** 2])

    b, a = pair(fa, za), np.convolve(pair(fr, zr), [1.0, -pole])
    b = b * a.sum() / b.sum() * rng.uniform(20.0, 500.0)
    return np.concatenate([np.zeros(int(rng.integers(1, 4))), b]), a


def command(kind: str, n: int, rng: np.random.Generator) -> np.ndarray:
    """A command with a peak of 1."""
    t = np.arange(n) * TS
    span = n * TS
    if kind == "chirp":
        return np.sin(2.0 * math.pi * (0.5 * t + 0.5 * (400.0 - 0.5) / span * t * t))
    if kind == "log chirp":
        rate = math.log(400.0 / 0.5)
        return np.sin(2.0 * math.pi * 0.5 * span / rate * (np.exp(rate * t / span) - 1.0))
    if kind == "prbs":
        return np.repeat(np.sign(rng.normal(size=n // 2 + 1)), 2)[:n]
    if kind == "random":
        return np.repeat(rng.uniform(-1.0, 1.0, n // 2 + 1), 2)[:n]
    # periods of 1.37 s, which the record does not hold in whole numbers
    f = np.arange(1, 540) / 1.37
    x = np.cos(2.0 * math.pi * np.outer(t, f) + rng.uniform(0.0, 2.0 * math.pi, len(f))).sum(axis=1)
    return np.asarray(x / np.abs(x).max())


def drawn(
    seed: int, kind: str, n: int, noise: float, *, feedback: bool
) -> tuple[np.ndarray, np.ndarray, np.ndarray | None, Any]:
    """Command, output, reference (under feedback), and the true response."""
    rng = np.random.default_rng([seed, 92, SIGNALS.index(kind), n, round(1e4 * noise)])
    b, a = system(seed)
    # another piece of the same kind goes before: the record begins in motion
    x = np.concatenate([command(kind, BEFORE, rng), command(kind, n, rng)])

    def truth(hertz: Any) -> np.ndarray:
        step = np.exp(-2j * math.pi * np.asarray(hertz) * TS)
        return np.asarray(np.polyval(b[::-1], step) / np.polyval(a[::-1], step))

    v = lfilter([1.0], [1.0, -0.7], rng.normal(size=len(x))) * noise * math.sqrt(0.51)
    if not feedback:
        y = lfilter(b, a, x)
        return x[BEFORE:], (y + v * y.std())[BEFORE:], None, truth
    # u = k (x - y) with half of the largest gain tried at which the loop is stable
    gain = next(
        g for g in (3.0 / abs(b.sum() / a.sum()) * 0.7**k for k in range(60))
        if _stable(b, a, 2.0 * g)
    )  # fmt: skip
    size = max(len(a), len(b))
    closed = np.pad(a, (0, size - len(a))) + gain * np.pad(b, (0, size - len(b)))
    y = lfilter(gain * b, closed, x)
    v = v * y.std()
    u, y = lfilter(gain * a, closed, x - v), y + lfilter(a, closed, v)
    return u[BEFORE:], y[BEFORE:], x[BEFORE:], truth


def _stable(b: np.ndarray, a: np.ndarray, gain: float) -> bool:
    size = max(len(a), len(b))
    closed = np.pad(a, (0, size - len(a))) + gain * np.pad(b, (0, size - len(b)))
    return bool(np.abs(np.roots(closed)).max() < 0.9995)


GRID = np.geomspace(0.01 / TS, 0.35 / TS, 300)


def errors(found: FrequencyResponse, truth: Any) -> tuple[np.ndarray, float]:
    """Errors on the grid over the truth there, and the share of bands that hold; NaN where the
    method says itself that it does not see the response.
    """
    grid = np.clip(GRID, found.hertz[0], found.hertz[-1])
    off = np.array([abs(found.at(f) / truth(f) - 1.0) for f in grid])
    off[np.interp(grid, found.hertz, found.coherence) < 0.5] = np.nan
    inside = (found.hertz >= GRID[0]) & (found.hertz <= GRID[-1]) & (found.coherence >= 0.5)
    held = np.abs(found.value - truth(found.hertz)) < found.radius()
    return off, float(held[inside].mean())


def scipys(u: np.ndarray, y: np.ndarray) -> FrequencyResponse:
    """csd over welch with scipy's own choice of everything but the segment: 1,024 samples."""
    f, crossed = csd(u, y, fs=1.0 / TS, nperseg=1024)
    _, power = welch(u, fs=1.0 / TS, nperseg=1024)
    n = len(f) - 1
    return FrequencyResponse(
        f[1:], (crossed / power)[1:], np.full(n, 1e-300), np.ones(n), 2.0, TS
    )  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--held", action="store_true")
    parser.add_argument("--feedback", action="store_true")
    parser.add_argument("--count", type=int, default=10)
    args = parser.parse_args()
    seeds = [2 * k + args.held for k in range(args.count)]
    print("record, samples, noise; error of the response in % of it, median / 90 %: local "
          "polynomials, segments, scipy's csd, where the first two see it; share of the grid that "
          "each of the two sees; bands that hold [%]")  # fmt: skip
    for kind, n in itertools.product(SIGNALS, LENGTHS):
        for noise in NOISES:
            rows: dict[str, list[Any]] = {"local": [], "segments": [], "scipy": []}
            bands: dict[str, list[float]] = {"local": [], "segments": []}
            lines, took = 0, 0.0
            for seed in seeds:
                u, y, r, truth = drawn(seed, kind, n, noise, feedback=args.feedback)
                began = time.perf_counter()
                found = {"local": local_polynomial(u, y, Ts=TS, r=r)}
                took += time.perf_counter() - began
                lines += len(found["local"].hertz)
                found["segments"] = spectral(u, y, Ts=TS, r=r)
                found["scipy"] = scipys(u, y)
                for name, one in found.items():
                    off, held = errors(one, truth)
                    rows[name].append(off)
                    bands.get(name, []).append(held)
            off = np.array([np.concatenate(r) for r in rows.values()])
            both = np.isfinite(off[:2]).all(axis=0)
            text = "; ".join(
                "{:.2f} / {:.2f}".format(*np.percentile(100.0 * r[both], [50, 90])) for r in off
            )
            seen = " and ".join(f"{100 * np.isfinite(r).mean():.0f}" for r in off[:2])
            text += f"; {seen} % seen"
            held = ", ".join(f"{100 * np.mean(b):.1f}" for b in bands.values())
            print(
                f"{kind}, {n}, {noise:g}: {text}; {held}; "
                f"{lines / len(seeds):.0f} frequencies, {1e3 * took / len(seeds):.0f} ms",
                flush=True,
            )  # fmt: skip


if __name__ == "__main__":
    main()
