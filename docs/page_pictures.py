"""Draws assets/pages/*.png: pictures of pages that need no results of `make demo`.

    python docs/page_pictures.py [FOLDER]

`make docs` draws them for the site, `make pictures` those that are checked in for readers of the
repository. Tables of pages are drawn from the pages themselves, so that both say the same.
"""

from __future__ import annotations

import contextlib
import json
import re
import runpy
import sys
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

import sewfast
from sewfast.plotting import Trace, loop_drawing
from sewfast.recordfile import Header, RecordWriter

DOCS = Path(__file__).parent
MUTED, FIRST, SECOND, THIRD = "0.6", "tab:blue", "tab:orange", "tab:green"


@contextlib.contextmanager
def axes(file: Path, rows: int = 1, height: float = 3.2, **options: Any) -> Iterator[Any]:
    """Axes of a new figure, which is written to the file at the end."""
    import matplotlib as mpl
    import matplotlib.pyplot as plt

    with mpl.rc_context({"font.size": 10, "axes.spines.top": False, "axes.spines.right": False}):
        figure, ax = plt.subplots(rows, 1, figsize=(8.0, height), layout="constrained", **options)
        yield ax
        figure.savefig(file, dpi=110)
        plt.close(figure)


def fleet(file: Path) -> None:
    """Gain and residence time of six machines in two months, with their bands."""
    gains, lags = np.array([90.0, 95, 100, 105, 110, 115]), np.full(6, 0.04)
    with tempfile.TemporaryDirectory() as place:
        months = {
            "October": _months(Path(place) / "october", 0, gains, lags),
            "November": _months(
                Path(place) / "november",
                100,
                gains * [1, 1, 0.9, 1, 1, 1],
                lags * [1, 1, 1, 1, 1.3, 1],
            ),
        }
        earlier = sewfast.fleet(months["October"], workers=0)
        found = sewfast.fleet(months["November"], workers=0, before=earlier)
    drifted = {(drift.file, drift.quantity) for drift in found.drifts}
    with axes(file, rows=2, height=4.4, sharex=True) as (top, bottom):
        for ax, quantity, label, scale in (
            (top, "gain", "gain [RPM/V]", 1.0),
            (bottom, "residence_time", "residence time [ms]", 1e3),
        ):
            for name, rows, at, colour in (
                ("October", earlier.rows, -0.08, MUTED),
                ("November", found.rows, 0.08, FIRST),
            ):
                value = scale * np.array([getattr(row, quantity) for row in rows])
                error = scale * np.array([getattr(row, f"{quantity}_error") for row in rows])
                x = np.arange(len(rows)) + 1.0 + at
                ax.errorbar(x, value, 4 * error, fmt="o", color=colour, label=name, capsize=3)
                for i, row in enumerate(rows):
                    if name == "November" and (row.file, quantity) in drifted:
                        ax.annotate("drift", (x[i], value[i]), (12, 4), textcoords="offset points")
            ax.set_ylabel(label)
        top.legend(frameon=False, loc="upper left", ncols=2)
        bottom.set_xlabel("machine")


def _months(folder: Path, seed: int, gains: Any, lags: Any) -> Path:
    """Recordings as fleet.md makes them."""
    folder.mkdir()
    for i, (gain, lag) in enumerate(zip(gains, lags, strict=True)):
        rng = np.random.default_rng(seed + i)
        u = np.repeat(rng.uniform(-5, 5, 80), 25)
        y, pole = np.zeros(2000), np.exp(-0.001 / lag)
        for k in range(1, 2000):
            y[k] = pole * y[k - 1] + (1 - pole) * gain * u[k - 1]
        noisy = y + rng.normal(0, 2, 2000)
        np.savez(folder / f"machine-{i + 1}.npz", t=np.arange(2000) * 0.001, u=u, y=noisy)
    return folder


def recordings(file: Path) -> None:
    """A recording with a frame that the link lost, as recordings.md writes it."""
    with tempfile.TemporaryDirectory() as place:
        path = Path(place) / "run.mcap"
        columns = {"u": "V", "counts": "1"}
        with RecordWriter(path, Header("step", 0.001, columns, n=3000, counts_per_rev=1572)) as out:
            for k in range(0, 3000, 10):
                if not 1200 <= k < 1300:
                    i = np.arange(k, k + 10)
                    counts = np.maximum(i - 500, 0) ** 2 // 300
                    out.samples(k, {"u": np.where(i < 500, 0.0, 5.0), "counts": counts})
        e = sewfast.read(path, inputs="u", counts="counts").experiments[0]
    t = 0.001 * np.arange(len(e.y))
    lost = np.isnan(e.y)
    with axes(file, rows=2, height=3.6, sharex=True) as (top, bottom):
        for ax, column, label in ((top, e.u[:, 0], "u [V]"), (bottom, e.y, "speed [RPM]")):
            ax.plot(t, column, color=FIRST)
            ax.axvspan(t[lost][0], t[lost][-1], color="tab:red", alpha=0.2, linewidth=0)
            ax.set_ylabel(label)
        top.annotate(
            f"{int(lost.sum())} samples that never arrived",
            (t[lost][-1], 2.5), (6, 0), textcoords="offset points",
        )  # fmt: skip
        bottom.set_xlabel("time [s]")


def gains(file: Path) -> None:
    """A step, the first-order lag fitted to it, and the loop that each rule's gains make of it."""
    t = np.arange(1500) * 0.001
    u = np.where(t < 0.2, 0.0, 2.0)
    drive = sewfast.rules.Fopdt(K=490.0, T=0.15, L=0.012, u_high=2.0)
    y = drive.response(t - 0.2) + 3.0 * np.random.default_rng(1).standard_normal(len(t))
    plant = sewfast.fit_fopdt(u, y, Ts=0.001)
    r = np.where(np.arange(700) < 50, 0.0, 1000.0)
    with axes(file, rows=2, height=4.8) as (top, bottom):
        top.plot(t, y, color=MUTED, linewidth=0.8, label="recorded step of 2 V")
        fitted = plant.response(t - 0.2)
        top.plot(t, fitted, color=FIRST, label="fit: gain, lag and dead time")
        model = _lagged(plant)
        for name, colour in (("eq-12", FIRST), ("simc", SECOND), ("amigo", THIRD)):
            rule = sewfast.rules.by_name(name)(plant)
            controller = sewfast.Controller(rule.gains, alpha=rule.alpha, beta=rule.beta, N=10.0)
            Ms = sewfast.margins(controller, plant).Ms
            run = sewfast.run(controller, model, r)
            label = f"{name}: Ms = {Ms:.1f}"
            bottom.plot(t[: len(r)], run.y, color=colour, linewidth=1.2, label=label)
        bottom.plot(t[: len(r)], r, color="black", linewidth=0.8, linestyle=":", label="reference")
        for ax in (top, bottom):
            ax.set_ylabel("speed [RPM]")
            ax.legend(frameon=False, loc="lower right")
        bottom.set_xlabel("time [s]")


def _lagged(plant: Any) -> sewfast.Model:
    """The lag with its dead time as a model in samples of 1 ms."""
    pole = float(np.exp(-0.001 / plant.T))
    nk = 1 + round(plant.L / 0.001)
    rng = np.random.default_rng(0)
    u = np.repeat(rng.uniform(-4.0, 4.0, 60), 50)
    late, y = np.concatenate([np.zeros(nk - 1), u]), np.zeros(len(u))
    for k in range(1, len(u)):
        y[k] = pole * y[k - 1] + (1.0 - pole) * plant.K * late[k - 1]
    data = sewfast.Dataset.from_arrays(u, y, 0.001, input_units="V", output_unit="RPM")
    return sewfast.identify(data, model="arx", na=1, nb=1, nk=nk)


def real_data(file: Path) -> None:
    """The fits of real-data.md's table."""
    rows = _table("real-data.md", "| recording | ARX |")
    fits = [[float(re.search(r"\((-?[\d.]+) %\)", cell)[1]) for cell in row[1:]] for row in rows]
    names = [re.sub(r" \[.*", "", row[0]).replace(", ", "\n") for row in rows]
    with axes(file, height=3.4) as ax:
        for i, (label, colour) in enumerate(
            (("ARX", MUTED), ("linear output error", FIRST), ("lagged network", SECOND))
        ):
            at = np.arange(len(rows)) + 0.27 * (i - 1)
            bars = ax.bar(at, [fit[i] for fit in fits], 0.25, color=colour, label=label)
            ax.bar_label(bars, fmt="%.0f", padding=1, fontsize=8)
        ax.set_xticks(np.arange(len(rows)), names, fontsize=8)
        ax.set_ylabel("fit in free run [%]")
        ax.set_ylim(min(0.0, *map(min, fits)) - 14.0, 118.0)
        ax.axhline(0.0, color="0.6", linewidth=0.8)
        ax.legend(frameon=False, ncols=3, loc="upper right")


def accuracy(file: Path) -> None:
    """Errors of BENCHMARKS.md over the best that is published, with the range of the seeds."""
    record, found = "", []
    for row in _table("BENCHMARKS.md", "| record | scored part |"):
        record = row[0].split(",")[0].split("[")[0].strip() or record
        best = re.match(r"\.\d+", row[5])
        if best is not None:
            median, (low, high) = _number(row[2]), map(_number, row[3].split(" to "))
            name = f"{record},\n{row[1]}"
            found.append((name, *(x / float(best[0]) for x in (median, low, high))))
    names, median, low, high = zip(*reversed(found), strict=True)
    middle, at = np.array(median), np.arange(len(names))
    with axes(file, height=2.8) as ax:
        ax.axvline(1.0, color="black", linewidth=0.8, linestyle=":")
        ax.barh(at, middle, 0.6, color=FIRST, alpha=0.7)
        ax.errorbar(
            middle, at, xerr=[middle - low, high - middle], fmt="none", color="black", capsize=3
        )
        ax.set_yticks(at, names, fontsize=8)
        ax.set_xlabel("error of the default over the best published error (1: as good)")


def speed(file: Path) -> None:
    """How many times as long rivals take, from performance.json."""
    rows = json.loads((DOCS / "performance.json").read_text(encoding="utf-8"))["rows"].values()
    found = []
    for row in rows:
        least = {n: c[f"{row['clock']}_least"] for n, c in row["contenders"].items()}
        own = least.pop("sewfast", None)
        found += [
            (f"{row['title'].replace('`', '')}: {n}", x / own) for n, x in least.items() if own
        ]
    found.sort(key=lambda entry: entry[1])
    names, ratios = zip(*found, strict=True)
    with axes(file, height=0.5 + 0.2 * len(names)) as ax:
        ax.barh(names, ratios, color=[FIRST if x > 1.0 else SECOND for x in ratios])
        ax.axvline(1.0, color="black", linewidth=0.8)
        ax.set_xscale("log")
        ax.tick_params(axis="y", labelsize=7)
        ax.margins(y=0.01)
        ax.set_xlabel("time of the rival over that of sewfast (1: as fast)")


def _table(page: str, head: str) -> list[list[str]]:
    """Cells of a page's table that begins with this text."""
    text = (DOCS / page).read_text(encoding="utf-8")
    lines = text[text.index(head) :].split("\n\n")[0].splitlines()[2:]
    return [[cell.strip().replace("*", "") for cell in line.split("|")[1:-1]] for line in lines]


def _number(text: str) -> float:
    found = re.match(r"[\d.]+", text.strip())
    assert found is not None, text
    return float(found[0])


def state_feedback(file: Path) -> None:
    """A tuned PID and tuned state feedback on the virtual machine, for tuning.md."""
    machine = sewfast.VirtualMachine()
    data = sewfast.record(machine, sewfast.signals.excitation("multisine")).dataset()
    model = sewfast.identify(data, model="oe")
    loops = []
    for kind, look, label in (
        ("state_feedback", "measured", "state feedback"),
        ("pid", "model", "PID"),
    ):
        found = sewfast.tune(
            model, "trapezoid", controller=kind, u_min=-20.0, u_max=20.0,
            counts_per_rev=machine.counts_per_rev, feedforward="none", evaluations=600,
        )  # fmt: skip
        run = sewfast.run(found.controller, machine, "trapezoid")
        loops.append(Trace.of(run.columns(), look, label))
    loop_drawing(loops, "RPM", "V", (-20.0, 20.0)).plot(file=file)


def feedforward(file: Path) -> None:
    """The README's drive along a trapezoid, with feedforward and without, for feedforward.md."""
    machine = sewfast.VirtualMachine()

    record = runpy.run_path(str(DOCS / "free_run.py"))["record"]
    training = sewfast.Dataset.concat(map(record, ("chirp_lo_hi", "saturating")))
    model = sewfast.identify(training, model="grey_box", seed=0)
    found = sewfast.tune(model, counts_per_rev=machine.counts_per_rev)
    loops = [
        Trace.of(sewfast.run(controller, machine, "trapezoid").columns(), look, label)
        for controller, look, label in (
            (found.lead.alone, "model", "PID alone"),
            (found.controller, "measured", "with feedforward"),
        )
    ]
    loop_drawing(loops, "RPM", "V", (-20.0, 20.0)).plot(file=file)


def moves(file: Path) -> None:
    """A move of the README's drive: PID alone, planned, learned in five repetitions."""
    machine = sewfast.VirtualMachine()
    record = runpy.run_path(str(DOCS / "free_run.py"))["record"]
    training = sewfast.Dataset.concat(map(record, ("chirp_lo_hi", "saturating")))
    model = sewfast.identify(training, model="grey_box", seed=0)
    found = sewfast.tune(model, counts_per_rev=machine.counts_per_rev)
    table = sewfast.plan(found.controller, model, "trapezoid")
    learned = sewfast.learn(table, model, machine, repetitions=5).table
    alone = sewfast.run(found.lead.alone, machine, "trapezoid")
    loops = [Trace.of(alone.columns(), "model", "PID alone")]
    for one, look, label in ((table, "oe", "planned"), (learned, "measured", "learned")):
        played = sewfast.run(found.controller, machine, table=one)
        loops.append(Trace.of(played.columns(), look, label))
    loop_drawing(loops, "RPM", "V", (-20.0, 20.0)).plot(file=file)


def joints(file: Path) -> None:
    """The joint of joints.md on moves that it has not seen, beside a linear model."""

    def recorded(seed: int) -> sewfast.Dataset:
        u = np.repeat(np.random.default_rng(seed).uniform(-3.0, 3.0, 40), 150)
        made = sewfast.record(sewfast.VirtualMachine(3), u)
        angle = made.counts / made.counts_per_rev
        return sewfast.Dataset.from_arrays(u, angle, made.Ts, input_units=("V",), output_unit="rev")

    train, fresh = recorded(1), recorded(2)
    models = {
        "linear model": (sewfast.identify(train, model="oe"), SECOND),
        "joint": (sewfast.physics(train, structure="joint").to_model(), FIRST),
    }
    (e,) = fresh.experiments
    with axes(file, rows=2, height=4.4, sharex=True) as (top, bottom):
        t = fresh.Ts * np.arange(len(e))
        top.plot(t, e.y, color=MUTED, lw=3, label="measured")
        for name, (model, colour) in models.items():
            state = model.core.estimate_initial_state(e.u[:50], e.y[:50])
            run = model.core.simulate(e.u, state)
            top.plot(t, run, color=colour, lw=1.2, label=f"{name}, free run")
            bottom.plot(t, run - e.y, color=colour, lw=1.2)
        top.set_ylabel("angle [rev]")
        top.legend(frameon=False)
        bottom.set_ylabel("error [rev]")
        bottom.set_xlabel("time [s]")


def positions(file: Path) -> None:
    """The README's drive stops at an angle from 3,000 RPM."""
    machine = sewfast.VirtualMachine()
    record = runpy.run_path(str(DOCS / "free_run.py"))["record"]
    training = sewfast.Dataset.concat(map(record, ("chirp_lo_hi", "saturating")))
    model = sewfast.identify(training, model="grey_box", seed=0)
    found = sewfast.tune(model, counts_per_rev=machine.counts_per_rev, loop="position")
    sewfast.stop_at(found.controller, machine, "90deg", speed=3000.0, after=0.7).plot(file=file)


def live(file: Path) -> None:
    """The speed of a view, from the counts of the last 20 ms, and that of the recording."""
    machine = sewfast.VirtualMachine()
    recording = sewfast.record(machine, sewfast.signals.excitation("step"))
    counts, window = recording.counts, 20
    shown = np.full(len(counts), np.nan)
    shown[window:] = (counts[window:] - counts[:-window]) * 60e3 / (window * machine.counts_per_rev)
    t = 0.001 * np.arange(len(counts))
    part = slice(490, 700)
    with axes(file) as ax:
        ax.step(t[part], shown[part], where="post", color=MUTED, label="while you watch")
        ax.plot(t[part], recording.y[part], color=FIRST, label="in the recording")
        ax.set_xlabel("time [s]")
        ax.set_ylabel("speed [RPM]")
        ax.legend(frameon=False, loc="lower right")


PICTURES: dict[str, Callable[[Path], None]] = {
    "fleet": fleet,
    "recordings": recordings,
    "gains": gains,
    "real-data": real_data,
    "accuracy": accuracy,
    "speed": speed,
    "state-feedback": state_feedback,
    "feedforward": feedforward,
    "moves": moves,
    "joints": joints,
    "positions": positions,
    "live": live,
}


if __name__ == "__main__":
    place = Path(sys.argv[1]) if len(sys.argv) > 1 else DOCS / "assets" / "pages"
    place.mkdir(parents=True, exist_ok=True)
    for name, draw in PICTURES.items():
        draw(place / f"{name}.png")
