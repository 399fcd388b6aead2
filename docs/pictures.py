"""Draws assets/closed_loop.svg, the picture of the README, from the demo's own results.

sewfast demo --out demo && python docs/pictures.py demo      (or: make pictures)
"""

from __future__ import annotations

import sys
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

import sewfast
from sewfast.plotting import Drawing, Trace, draw, loop_drawing, loop_panels
from sewfast.readers import read_table
from sewfast.report.artefacts import run_file

ASSETS = Path(__file__).parent / "assets"
PICTURE = ASSETS / "closed_loop.svg"
GALLERY = ASSETS / "gallery"
BODE = ASSETS / "bode" / "compliant.png"
STATES = ASSETS / "state_feedback.png"
LARGEST = 150_000
"""Bytes of a picture: a page has to load it."""
COLOURS = 64
"""That a picture of the gallery is stored with: lines on white need no more."""
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
            counts_per_rev=machine.counts_per_rev, evaluations=600,
        )  # fmt: skip
        run = sewfast.run(found.controller, machine, "trapezoid")
        loops.append(Trace.of(run.columns(), look, label))
    loop_drawing(loops, "RPM", "V", (-20.0, 20.0)).plot(file=file)


def main() -> None:
    folder = Path(sys.argv[1] if len(sys.argv) > 1 else "demo")
    loops = traces(folder)
    drawing(loops).plot(file=PICTURE)
    predicted, measured = loops
    apart = float(np.sqrt(np.mean((predicted.y - measured.y) ** 2)))
    print(f"predicted and measured are {apart:.1f} RPM rms apart")
    written = [PICTURE]
    GALLERY.mkdir(exist_ok=True)
    BODE.parent.mkdir(exist_ok=True)
    drawn = {GALLERY / f"{name}.png": plot for name, plot in gallery(folder).items()}
    drawn[BODE], drawn[STATES] = bode, state_feedback
    for path, plot in drawn.items():
        plot(file=path)
        Image.open(path).convert("RGB").quantize(COLOURS).save(path, optimize=True)
        written.append(path)
    for path in written:
        size = path.stat().st_size
        print(f"{path}: {size // 1000} kB")
        if size > LARGEST:
            raise SystemExit(f"expected at most {LARGEST} bytes, received {size}")


if __name__ == "__main__":
    main()
