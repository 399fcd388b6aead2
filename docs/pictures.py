"""Draws the pictures of README, gallery and pages, most of them from the demo's own results.

    sewfast demo --out demo && python docs/pictures.py demo      (or: make pictures)

They go to docs/assets, where README, pages and site have them from.
"""

from __future__ import annotations

import runpy
import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

import sewfast
from sewfast.plotting import Drawing, Trace, draw, loop_panels
from sewfast.readers import read_table
from sewfast.report.artefacts import run_file

ASSETS = Path(__file__).parent / "assets"
STUDIO = runpy.run_path(str(Path(__file__).with_name("studio_pictures.py")))
PICTURES = {
    **runpy.run_path(str(Path(__file__).with_name("page_pictures.py")))["PICTURES"],
    **runpy.run_path(str(Path(__file__).with_name("diagrams.py")))["DIAGRAMS"],
}
LARGEST = 150_000
"""Bytes of a picture: a page has to load it."""
LABELS = {"model": "predicted (model)", "machine": "measured (virtual machine)"}
RISE = (0.08, 0.36)
"""The window that is shown magnified [s]."""


def traces(folder: Path) -> list[Trace]:
    """The trapezoid on the identified model and on the machine, as the demo left them."""
    return [
        Trace.of(read_table(folder / run_file("trapezoid", plant)).columns, plant, label)
        for plant, label in LABELS.items()
    ]


def magnified(ax: Any, loops: list[Trace]) -> None:
    """The rise: 3,000 RPM in 150 ms."""
    for loop in reversed(loops):
        inside = (loop.t >= RISE[0]) & (loop.t <= RISE[1])
        draw(ax, loop.t[inside], loop.y[inside], loop.look, loop.label)
    draw(ax, loop.t[inside], loop.r[inside], "reference", "reference")
    ax.set_title("the rise, magnified")
    ax.legend(loc="lower right", handlelength=1.8)
    ax.set_xlabel("time [s]")
    ax.margins(x=0.01)


def drawing(loops: list[Trace]) -> Drawing:
    """The whole run beside its rise, error and command below."""
    output, error, command = loop_panels(loops, "RPM", "V")

    def whole(ax: Any) -> None:
        output(ax)
        # it stands in the other panel, where there is room for it
        ax.get_legend().remove()

    rows = ((whole, partial(magnified, loops=loops)), (error, command))
    return Drawing(rows, (2.6, 1.6), (1.35, 1.0), share_x=False)


def gallery(folder: Path) -> dict[str, Any]:
    """What draws each picture of gallery.md: a function of the file."""

    def read(name: str) -> sewfast.Dataset:
        path = folder / "recordings" / f"{name}.csv"
        return sewfast.read(path, inputs="u", output="y", channels=["speed_true"])

    networks = sewfast.load_model(folder / "commissioning" / "models" / "ensemble.json")
    linear = sewfast.load_model(folder / "models" / "oe_all.json")
    controller = sewfast.load_controller(folder / "controllers" / "tuned.json")
    random = read("random")
    both = sewfast.compare({"networks": networks, "linear": linear}, data=random)
    card = sewfast.check(sewfast.load_model(folder / "models" / "neural_oe.json"), random)
    analysis = sewfast.analyse(controller, networks)
    front = sewfast.pareto(networks, "trapezoid", start=controller, evaluations=1500, seed=1)
    return {
        "data": read("saturating").plot,
        "compare": both.plot,
        "bands": card.plot,
        "bode": partial(card.plot, figure="bode"),
        "analysis": analysis.plot,
        "sensitivity": partial(analysis.plot, figure="sensitivity"),
        "front": front.plot,
    }


def bode(file: Path) -> None:
    """The response of bode.md."""
    machine = sewfast.VirtualMachine(load_inertia=1e-3, stiffness=150.0)
    response = sewfast.bode(machine, speed=1500.0)
    response.plot(fit=sewfast.fit_shaft(response), file=file)


def bode_speeds(file: Path) -> None:
    """The responses about several speeds of bode.md."""
    machine = sewfast.VirtualMachine(load_inertia=1e-3, stiffness=150.0)
    sewfast.bode(machine, speed=[500.0, 1000.0, 2000.0], realisations=2).plot(file=file)


def bode_record(file: Path) -> None:
    """Averaged segments and local polynomials on 8 s of a chirp, of bode.md."""
    from sewfast.frequency import local_polynomial, spectral

    Ts, before, n = 1e-3, 2000, 8000
    t = np.arange(n) * Ts
    chirp = np.sin(2.0 * np.pi * (0.5 * t + 0.5 * 399.5 / 8.0 * t * t))
    rng = np.random.default_rng(1)
    u = np.concatenate([rng.normal(size=before), chirp])

    def pair(hertz: float, damping: float) -> Any:
        w = 2.0 * np.pi * hertz * Ts
        p = np.exp(-damping * w + 1j * w * np.sqrt(1.0 - damping**2))
        return np.array([1.0, -2.0 * p.real, abs(p) ** 2])

    b, a = pair(60.0, 0.015), np.convolve(pair(80.0, 0.015), [1.0, -np.exp(-Ts / 0.02)])
    b = np.concatenate([[0.0, 0.0], b * a.sum() / b.sum()])
    plant = sewfast.LinearOE.from_tf(b, a, Ts)
    y = plant.simulate(u) + 0.002 * rng.normal(size=len(u))
    ways = {
        "averaged segments": (spectral(u[before:], y[before:], Ts=Ts), "machine"),
        "local polynomials": (local_polynomial(u[before:], y[before:], Ts=Ts), "measured"),
    }
    fine = np.geomspace(10.0, 300.0, 20_000)
    step = np.exp(-2j * np.pi * fine * Ts)
    truth = np.polyval(b[::-1], step) / np.polyval(a[::-1], step)

    def error(ax: Any) -> None:
        for name, (response, look) in ways.items():
            at = (response.hertz > 10.0) & (response.hertz < 300.0)
            exact = np.interp(response.hertz, fine, truth.real) + 1j * np.interp(
                response.hertz, fine, truth.imag
            )
            off = 100.0 * np.abs(response.value / exact - 1.0)
            draw(ax, response.hertz[at], off[at], look, name)
        ax.set(yscale="log", ylim=(0.01, 100.0), ylabel="error [%]", xlabel="frequency [Hz]")
        ax.grid(True, which="both", alpha=0.3)

    def gain(ax: Any) -> None:
        ax.plot(fine, 20.0 * np.log10(np.abs(truth)), color="0.6", lw=3.0, label="truth")
        for name, (response, look) in ways.items():
            draw(ax, response.hertz, response.magnitude_db, look, name)
        ax.set(xscale="log", xlim=(10.0, 300.0), ylim=(-60.0, 10.0), ylabel="gain [dB]")
        ax.grid(True, which="both", alpha=0.3)
        ax.legend(loc="lower left")

    Drawing(((gain,), (error,)), (2.4, 1.8)).plot(file=file)


def draw_all(results: Path, assets: Path) -> list[Path]:
    """Draw every picture into a folder; the files."""
    assets.mkdir(parents=True, exist_ok=True)
    loops = traces(results)
    picture = assets / "closed_loop.svg"
    drawing(loops).plot(file=picture)
    predicted, measured = loops
    apart = float(np.sqrt(np.mean((predicted.y - measured.y) ** 2)))
    print(f"predicted and measured are {apart:.1f} RPM rms apart")
    drawn: dict[Path, Callable[[Path], object]] = {
        assets / "bode" / "compliant.png": bode,
        assets / "bode" / "speeds.png": bode_speeds,
        assets / "bode" / "record.png": bode_record,
    }
    for name, plot in gallery(results).items():
        drawn[assets / "gallery" / f"{name}.png"] = lambda file, plot=plot: plot(file=file)
    for name, draw_page in PICTURES.items():
        drawn[assets / "pages" / f"{name}.png"] = draw_page
    for path, plot in drawn.items():
        path.parent.mkdir(exist_ok=True)
        plot(path)
        STUDIO["shrink"](path)
    studio = STUDIO["draw_studio"](assets / "studio") if STUDIO["can_draw"]() else []
    return [picture, *drawn, *studio]


def main() -> None:
    for path in draw_all(Path(sys.argv[1] if len(sys.argv) > 1 else "demo"), ASSETS):
        size = path.stat().st_size
        print(f"{path}: {size // 1000} kB")
        if size > LARGEST:
            raise SystemExit(f"expected at most {LARGEST} bytes, received {size}")


if __name__ == "__main__":
    main()
