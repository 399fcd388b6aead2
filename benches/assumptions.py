"""Records that break assumptions: unstable plants in loops, steps, coloured noise, sound records.

    python benches/assumptions.py [PART ..] [--first 0] [--count 20]
    make assumptions

loops: an unstable plant (first order, with a lag, a falling body), recorded under a controller with
a dither on the command, noise of .3 to 3 %. The tuned controller has to hold the true plant, or
`identify` or `tune` to refuse.

gaps: the same with every ninth output missing.

steps: one step after 3 to 20 standing samples, one or two lags, a dead time, any level at rest. It
counts against `identify` if a model graded good or fair has a steady gain more than 10 % off.

coloured: records of the battery with a coloured noise (AR(1) of .9, drift, hum, hum of .4 cycles a
sample) of 3 to 20 %. It counts against `identify` if a model graded good has a test fit below 80 %.

praised: the same records, each with white and with coloured noise, output error only; beside it how
many of those with a test fit above 90 % are graded good.

accused: single steps, whole records of the battery and 100 to 500 samples of them. It counts if the
record is said to change or its columns to be exchanged.

seeds: heaters and axes, output error, six seeds of `tune` each: cost of the worst over the best.

shifts: heaters, axes, tanks and positions, output error, with 0, 24.5 and 293.15 added to the
output. It counts if a gain of `tune` moves by more than 2 %, or if one level only is refused.
"""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Iterator, Sequence

import numpy as np
from scipy.linalg import expm
from scipy.signal import lfilter

import sewfast
from battery.families import FAMILIES, Case, make
from battery.families import NAMES as FAMILY_NAMES
from battery.references import score
from sewfast import Dataset, SewfastError, identify, tune
from sewfast.arrays import FloatArray
from sewfast.dataset.faults import faults
from sewfast.models.linear import LinearDifference

Sampled = tuple[FloatArray, FloatArray]
QUICK = [name for name in FAMILY_NAMES if FAMILIES[name].quick]
"""Families whose records are small."""


def main() -> int:
    """Run the parts that were asked for; 1 if one misses its goal."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parts = {
        "loops": loops, "gaps": lambda drawn: loops(drawn, missing=9), "steps": steps,
        "coloured": coloured, "praised": praised, "accused": accused, "seeds": seeds,
        "shifts": shifts,
    }  # fmt: skip
    parser.add_argument("parts", nargs="*", metavar="|".join(parts), choices=[*parts, []])
    parser.add_argument("--count", type=int, default=20, help="systems of each part")
    parser.add_argument("--first", type=int, default=0, help="the first system's seed")
    args = parser.parse_args()
    drawn = range(args.first, args.first + args.count)
    began, missed = time.process_time(), 0
    for name in args.parts or parts:
        missed += parts[name](drawn)
    print(f"{time.process_time() - began:.0f} s of processor")
    return int(missed > 0)


# --- Unstable plants ------------------------------------------------------------------------------


def unstable(rng: np.random.Generator, Ts: float) -> tuple[Sampled, float, bool]:
    """A plant whose first state is the output, the rate at which it grows, if it needs a lead."""
    rate, gain = math.exp(rng.uniform(0.4, 1.8)), math.exp(rng.uniform(1.6, 4.1))
    lag = rate * rng.uniform(4.0, 10.0)
    A, b = (
        ([[rate]], [gain]),
        ([[rate, gain], [0.0, -lag]], [0.0, lag]),
        ([[0.0, 1.0], [rate**2, -rng.uniform(0.0, 0.3) * rate]], [0.0, gain]),
    )[kind := int(rng.integers(3))]
    n = len(b)
    whole = np.zeros((n + 1, n + 1))
    whole[:n, :n], whole[:n, n] = A, b
    moved = expm(whole * Ts)
    return (moved[:n, :n], moved[:n, n]), rate, kind > 0


def holding(
    plant: Sampled, Ts: float, rng: np.random.Generator, *, lead: bool
) -> tuple[float, float]:
    """Kp and Kd that hold a plant with the quickest decay of some hundred drawn."""
    F, g = plant
    found = []
    for _ in range(400):
        Kp = math.exp(rng.uniform(-6.0, 6.0))
        Kd = Kp * math.exp(rng.uniform(-5.0, 0.0)) if lead else 0.0
        n = len(g)
        loop = np.zeros((n + 1, n + 1))
        loop[:n, :n], loop[:n, n], loop[n, 0] = F, g * Kd / Ts, 1.0
        loop[:n, 0] -= g * (Kp + Kd / Ts)
        found.append((np.abs(np.linalg.eigvals(loop)).max(), Kp, Kd))
    return min(found)[1:]


def recorded(seed: int) -> tuple[Dataset, Sampled]:
    """A record of an unstable plant in a loop, and the plant."""
    rng = np.random.default_rng([seed, 77])
    Ts, n = float(rng.choice([0.005, 0.01, 0.02])), int(rng.integers(1500, 4000))
    plant, rate, lead = unstable(rng, Ts)
    Kp, Kd = holding(plant, Ts, rng, lead=lead)
    held = max(3, round(0.15 / (rate * Ts)))
    dither = rng.uniform(0.5, 2.0) * np.repeat(rng.uniform(-1.0, 1.0, n // held + 1), held)[:n]
    noise, share = rng.standard_normal(n), rng.uniform(0.003, 0.03)

    def run(deviation: float) -> tuple[FloatArray, FloatArray]:
        (F, g), x, last = plant, np.zeros(len(plant[1])), 0.0
        u, y = np.zeros(n), np.zeros(n)
        for k in range(n):
            y[k] = x[0] + deviation * noise[k]
            u[k] = dither[k] - Kp * y[k] - Kd * (y[k] - last) / Ts
            x, last = F @ x + g * u[k], y[k]
        return u, y

    u, y = run(share * float(run(0.0)[1].std()))
    return Dataset.from_arrays(u, y, Ts, input_units=("V",), output_unit="rad"), plant


def is_held(plant: Sampled, controller: sewfast.Controller) -> bool:
    """Whether the plant comes back to rest from a small deviation, limits included."""
    (F, g), core = plant, controller.core()
    x = np.zeros(len(g))
    x[0] = 1e-3
    y = np.empty(8000)
    for k in range(len(y)):
        y[k] = x[0]
        if not abs(y[k]) < 1e6:
            return False
        x = F @ x + g * core.step(0.0, y[k])
    return bool(np.abs(y[-500:]).max() < 0.5 * np.abs(y[:500]).max())


def loops(drawn: range, missing: int = 0) -> int:
    """Unstable plants that are neither held nor refused, without every `missing`-th output."""
    missed, refused, off = 0, 0, 0.0
    for seed in drawn:
        data, plant = recorded(seed)
        if missing:
            data = data.mask(np.arange(len(data)) % missing == missing - 1)
        try:
            model = identify(data, threads=1)
            pole = float(np.abs(np.linalg.eigvals(plant[0])).max())
            own = max(map(abs, getattr(model, "poles", (0.0,))))
            off = max(off, abs(math.log(own) / math.log(pole) - 1.0) if own else math.inf)
            found = tune(model, evaluations=600, threads=1)
        except SewfastError as error:
            refused += 1
            print(f"  {seed}: {error}")
            continue
        if not is_held(plant, found.pid):
            missed += 1
            print(f"  {seed}: {found.pid.gains} does not hold it ({found.verdict})")
    print(
        f"loops: {len(drawn)} plants, {missed} not held, {refused} refused; rate of growth at most "
        f"{100 * off:.1f} % off"
    )
    return missed


# --- Single steps ---------------------------------------------------------------------------------


def single_step(seed: int) -> tuple[Dataset, float]:
    """A record of one step, and the plant's gain."""
    rng = np.random.default_rng([seed, 5])
    Ts, n, at = float(rng.choice([0.1, 1.0, 5.0])), int(rng.integers(150, 600)), rng.integers(3, 21)
    tau, gain = rng.uniform(15.0, 80.0), rng.uniform(0.5, 30.0)
    level, rest = rng.choice([0.0, 22.0, 293.15]), rng.choice([0.0, 0.0, 10.0])
    size, late = rng.uniform(1.0, 40.0), int(rng.integers(0, 4))
    step = np.where(np.arange(n) >= at, size, 0.0)
    y = np.concatenate([np.zeros(late + 1), step])[:n]
    for lag in (tau, tau * rng.choice([0.0, 0.3, 0.6])):
        a = math.exp(-1.0 / lag) if lag else 0.0
        y = lfilter([1.0 - a], [1.0, -a], y)
    y = level + gain * (y + rng.choice([0.001, 0.01]) * size * rng.standard_normal(n))
    return Dataset.from_arrays(rest + step, y, Ts, input_units=("%",), output_unit="degC"), gain


def steps(drawn: range) -> int:
    """Praised models whose gain is more than 10 % off."""
    praised, off = 0, 0
    for seed in drawn:
        data, gain = single_step(seed)
        for kind in ("oe", "auto"):
            try:
                model = identify(data, model=kind, threads=1)
            except SewfastError:
                continue
            if not isinstance(model, LinearDifference):
                continue
            grade = model.training["verdict"]["grade"]
            if abs(model.dc_gain[0] / gain - 1.0) > 0.1:
                off += 1
                praised += grade in ("good", "fair")
                print(f"  {seed} {kind}: {grade}, gain {model.dc_gain[0]:.3g} for {gain:.3g}")
    print(f"steps: {len(drawn)} records, {off} of {2 * len(drawn)} gains off, {praised} praised")
    return praised


# --- Coloured noise -------------------------------------------------------------------------------


def colour(rng: np.random.Generator, kind: str, n: int, Ts: float) -> FloatArray:
    """Noise of deviation 1."""
    white = rng.standard_normal(n)
    if kind in ("hum", "buzz"):
        f = 0.4 / Ts if kind == "buzz" else 50.0 if Ts < 0.008 else 0.13 / Ts
        noise = np.sin(2.0 * np.pi * (f * Ts * np.arange(n) + rng.uniform())) + 0.1 * white
    elif kind == "drift":
        noise = np.cumsum(white)
    else:
        noise = lfilter([1.0], [1.0, -0.9], white) if kind == "AR(1)" else white
    noise = noise - noise.mean()
    return np.asarray(noise / noise.std())


def noisy(seed: int, kinds: Sequence[str]) -> Iterator[tuple[Case, str, float, Dataset]]:
    """A case of the battery with white noise, then coloured: the noise's share, the record."""
    rng = np.random.default_rng([seed, 40])
    case = make(QUICK[seed % len(QUICK)], seed)
    kind, share = kinds[seed % len(kinds)], float(rng.choice([0.03, 0.1, 0.2]))
    clean = [case.truth.simulate(r) for r in case.train]
    size = share * float(np.concatenate(clean).std())
    own = rng.spawn(len(clean))
    for of in ("white", kind):
        records = (
            case.dataset(r.u, y + size * colour(g, of, len(y), case.Ts))
            for r, y, g in zip(case.train, clean, own, strict=True)
        )
        yield case, of, share, Dataset.concat(records)


def on_test(case: Case, model: sewfast.Model) -> tuple[float, float]:
    """The error on the test record, and the fit [%]."""
    error = score(case, model)
    spread = float(np.concatenate([r.y[case.n :] for r in case.test]).std())
    return error, 100.0 * (1.0 - error / spread)


def coloured(drawn: range) -> int:
    """Models graded good whose test fit is below 80 %; the same records with white noise beside."""
    wrong, ratios = 0, []
    for seed in drawn:
        errors: dict[tuple[str, str], float] = {}
        words: list[str] = []
        of = what = ""
        for case, of, share, data in noisy(seed, ("AR(1)", "drift", "hum", "buzz")):
            what = f"{case.family}, {of} of {share:.0%}"
            for model in ("oe",) if of == "white" else ("oe", "auto"):
                try:
                    found = identify(data, model=model, threads=1)
                except SewfastError as error:
                    words.append(f"{of} {model}: refused ({str(error)[:60]})")
                    continue
                errors[of, model], fit = on_test(case, found)
                grade = found.training["verdict"]["grade"]
                is_wrong = grade == "good" and fit < 80.0
                wrong += is_wrong and of != "white"
                orders = " ".join(f"{k} {v}" for k, v in found.orders.items() if k != "parameters")
                words.append(
                    f"{of} {model}: {found.kind} {orders}, {grade}, test fit {fit:.1f} %"
                    f"{' PRAISED' if is_wrong else ''}"
                )
        if (of, "oe") in errors and errors.get(("white", "oe"), 0.0) > 0.0:
            ratios.append(errors[of, "oe"] / errors["white", "oe"])
        said = "\n    ".join(words)
        print(f"  {seed} {what}\n    {said}", flush=True)
    print(
        f"coloured: {len(drawn)} records, {wrong} praised wrongly; test error over that with "
        f"white noise of the same size: median {np.median(ratios):.2f}, worst {max(ratios):.2f}"
    )
    return wrong


def praised(drawn: range) -> int:
    """Output error graded good whose test fit is below 80 %."""
    found: list[tuple[bool, float]] = []
    for seed in drawn:
        for case, of, share, data in noisy(seed, ("AR(1)", "drift", "hum", "buzz", "AR(1)")):
            try:
                model = identify(data, model="oe", threads=1)
            except SewfastError:
                continue
            is_good, fit = model.training["verdict"]["grade"] == "good", on_test(case, model)[1]
            found.append((is_good, fit))
            if is_good and fit < 80.0:
                print(f"  {seed} {case.family}, {of} of {share:.0%}: test fit {fit:.1f} %")
    good, able = [fit for is_good, fit in found if is_good], [g for g, fit in found if fit > 90.0]
    wrong = sum(fit < 80.0 for fit in good)
    print(
        f"praised: {len(found)} records, {wrong} of {len(good)} good ones below 80 %, the least "
        f"{min(good, default=math.nan):.1f} %; of {len(able)} above 90 %, {sum(able)} good"
    )
    return wrong


# --- Sound records that are accused ---------------------------------------------------------------


def accused(drawn: range) -> int:
    """Sound records that are said to change, or to have exchanged columns."""
    count = 0
    for seed in drawn:
        case = make(FAMILY_NAMES[seed % len(FAMILY_NAMES)], seed)
        rng = np.random.default_rng([seed, 9])
        first = case.train[0]
        n = min(int(rng.integers(100, 500)), len(first.y))
        at = int(rng.integers(0, len(first.y) - n + 1))
        short = case.dataset(first.u[at : at + n], first.y[at : at + n])
        records = {"step": single_step(seed)[0], case.family: case.training, "short": short}
        for name, data in records.items():
            for fault in faults(data):
                if fault.kind in ("changes", "exchanged"):
                    count += 1
                    print(f"  {seed} {name} ({case.family}): {fault.text[:110]}", flush=True)
    print(f"accused: {3 * len(drawn)} records, {count} accused")
    return count


# --- Seeds of the search --------------------------------------------------------------------------


def slow_plants(drawn: range) -> Iterator[tuple[str, Dataset]]:
    """Records of heaters (two lags, commands of 0 to 60 %) and of axes with dry friction."""
    for seed in drawn:
        rng = np.random.default_rng(seed)
        u = np.repeat(rng.uniform(0.0, 60.0, 20), 45)
        u[:40] = 0.0
        y = rng.uniform(0.3, 1.0) * np.concatenate([[0.0], u])[: len(u)]
        for lag in (rng.uniform(300.0, 800.0), rng.uniform(60.0, 200.0)):
            a = math.exp(-5.0 / lag)
            y = lfilter([1.0 - a], [1.0, -a], y)
        y += 24.5 + 0.05 * rng.standard_normal(len(y))
        yield (
            f"heater {seed}",
            Dataset.from_arrays(u, y, 5.0, input_units=("%",), output_unit="degC"),
        )
        u = np.repeat(rng.uniform(-1.0, 1.0, 60), 25)
        u[:30] = 0.0
        gain, a, v = (
            rng.uniform(50.0, 300.0),
            math.exp(-0.01 / rng.uniform(0.05, 0.3)),
            np.zeros(1500),
        )
        for k in range(1, len(v)):
            v[k] = a * v[k - 1] + (1 - a) * gain * (u[k - 1] - 0.05 * math.tanh(0.5 * v[k - 1]))
        v += 0.005 * v.std() * rng.standard_normal(len(v))
        yield (
            f"axis {seed}",
            Dataset.from_arrays(u, v, 0.01, input_units=("V",), output_unit="mm/s"),
        )


def seeds(drawn: range) -> int:
    """Plants whose worst seed costs a fifth more than the best."""
    worst = []
    for name, data in slow_plants(drawn):
        model = identify(data, model="oe", threads=1)
        costs = [tune(model, threads=1, feedforward="none", seed=s).cost for s in range(6)]
        worst.append(max(costs) / min(costs))
        print(f"  {name}: worst over best {worst[-1]:.3f}")
    print(f"seeds: {len(worst)} plants, six seeds each; worst over best at most {max(worst):.3f}")
    return sum(w > 1.2 for w in worst)


# --- The same plant at another level --------------------------------------------------------------


def resting_plants(drawn: range) -> Iterator[tuple[str, Dataset]]:
    """The slow plants at rest at 0, tanks (which drain by the root of their level), positions."""
    for name, data in slow_plants(drawn):
        yield name, moved(data, -24.5 if name.startswith("heater") else 0.0)
    for seed in drawn:
        rng = np.random.default_rng(seed)
        u = np.repeat(rng.uniform(1.0, 6.0, 30), 100)
        u[:60] = 3.0
        drain, area = rng.uniform(0.4, 0.8), rng.uniform(15.0, 40.0)
        level, y = (1.5 / drain) ** 2, np.zeros(len(u))
        for k in range(10 * len(u)):
            level += 0.1 / area * (u[k // 10] - 2.0 * drain * math.sqrt(max(level, 0.0)))
            y[k // 10] = level
        y += 0.01 * rng.standard_normal(len(y))
        units = {"input_units": ("V",), "output_unit": "cm"}
        yield f"tank {seed}", Dataset.from_arrays(u, y, 1.0, **units)
        u = np.repeat(rng.uniform(-5.0, 5.0, 50), 80)
        u[:100] = 0.0
        a = math.exp(-0.005 / rng.uniform(0.03, 0.1))
        v = lfilter([rng.uniform(5.0, 20.0) * (1.0 - a)], [1.0, -a], u)
        y = 0.005 * np.cumsum(v) + 0.003 * rng.standard_normal(len(u))
        units = {"input_units": ("V",), "output_unit": "mm"}
        yield f"position {seed}", Dataset.from_arrays(u, y, 0.005, **units)


def moved(data: Dataset, by: float) -> Dataset:
    """The record with a constant added to its output."""
    (e,) = data.experiments
    units = {"input_units": data.input_units, "output_unit": data.output_unit}
    return Dataset.from_arrays(e.u, e.y + by, data.Ts, **units)


def shifts(drawn: range) -> int:
    """Plants whose tuned gains depend on the level of the output."""
    apart, levels = [], (0.0, 24.5, 293.15)
    for name, data in resting_plants(drawn):
        gains, refused = [], []
        for by in levels:
            try:
                model = identify(moved(data, by), model="oe", threads=1, seed=0)
                found = tune(model, threads=1, feedforward="none", seed=0).pid.gains
            except SewfastError as error:
                refused.append(f"{error}")
                continue
            gains.append((found.Kp, found.integral, found.derivative))
        if len(refused) == len(levels):
            print(f"  {name}: refused at every level ({refused[0]})", flush=True)
            continue
        of = np.array(gains)
        apart.append(math.inf if refused else float(np.max(np.abs(of / of[0] - 1.0))))
        print(f"  {name}: gains {100.0 * apart[-1]:.2g} % apart", flush=True)
    over = sum(a > 0.02 for a in apart)
    middle, worst = 100.0 * np.median(apart), 100.0 * max(apart)
    print(
        f"shifts: {len(apart)} plants, {over} over 2 % apart, median {middle:.2g} %, at most "
        f"{worst:.2g} %"
    )
    return over


if __name__ == "__main__":
    raise SystemExit(main())
