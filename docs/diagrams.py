"""Draws diagrams of pages into assets/pages/*.png: boxes and arrows, and the time of a sample.

    python docs/diagrams.py [FOLDER]

`make docs` draws them for the site, `make pictures` those that are checked in.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import matplotlib as mpl
import matplotlib.pyplot as plt
import numpy as np

DOCS = Path(__file__).parent
INK, LINE, FILL, NOTE = "#1b1f24", "#4a6fa5", "#eef3fa", "0.35"
FIRST, SECOND = "tab:blue", "tab:orange"


def canvas(width: float, height: float, figure_height: float) -> tuple[Any, Any]:
    """A figure 8 inches wide whose units are those of the boxes."""
    figure, ax = plt.subplots(figsize=(8.0, figure_height), layout="constrained")
    ax.set(xlim=(0.0, width), ylim=(0.0, height))
    ax.axis("off")
    return figure, ax


def written(figure: Any, file: Path) -> None:
    figure.savefig(file, dpi=110)
    plt.close(figure)


def box(ax: Any, x: float, y: float, w: float, h: float, text: str, *, bold: bool = False) -> None:
    """A box around its centre."""
    ax.add_patch(
        plt.Rectangle((x - w / 2, y - h / 2), w, h, facecolor=FILL, edgecolor=LINE, linewidth=1.0)
    )
    weight = "bold" if bold else "normal"
    ax.text(x, y, text, ha="center", va="center", color=INK, fontsize=9, weight=weight)


def arrow(ax: Any, *points: tuple[float, float], text: str = "", at: Any = None) -> None:
    """A line through the points that ends in a head; the text is centred above `at`."""
    xs, ys = zip(*points, strict=True)
    ax.plot(xs[:-1], ys[:-1], color=LINE, linewidth=1.0)
    style = {"arrowstyle": "-|>", "color": LINE, "linewidth": 1.0, "shrinkA": 0, "shrinkB": 0}
    ax.annotate("", points[-1], points[-2], arrowprops=style)
    if text:
        place = at or ((xs[0] + xs[1]) / 2, ys[0])
        ax.text(place[0], place[1] + 0.08, text, ha="center", va="bottom", color=INK, fontsize=9)


def loop_and_time(file: Path) -> None:
    """The loop with its signs and units, and the order of events at a sample."""
    figure, (ax, time) = plt.subplots(
        2, 1, figsize=(8.0, 5.0), layout="constrained", height_ratios=(1.15, 1.0)
    )
    ax.set(xlim=(0.0, 10.0), ylim=(0.1, 3.4))
    ax.axis("off")
    box(ax, 1.75, 2.4, 1.3, 0.7, "reference\nramp")
    box(ax, 4.0, 2.4, 1.5, 0.7, "2-DOF PID\n$e = r - y$")
    box(ax, 6.1, 2.4, 1.4, 0.7, "limits,\nslew")
    box(ax, 8.3, 2.4, 1.3, 0.7, "drive", bold=True)
    box(ax, 6.1, 0.8, 2.0, 0.7, "feedback filter,\nencoder")
    arrow(ax, (0.1, 2.4), (1.1, 2.4), text="r [RPM]", at=(0.55, 2.4))
    arrow(ax, (2.4, 2.4), (3.25, 2.4))
    arrow(ax, (4.75, 2.4), (5.4, 2.4))
    arrow(ax, (6.8, 2.4), (7.65, 2.4), text="u [V]")
    arrow(ax, (8.95, 2.4), (9.95, 2.4), text="y [RPM]", at=(9.5, 2.4))
    arrow(ax, (9.4, 2.4), (9.4, 0.8), (7.1, 0.8))
    arrow(ax, (5.1, 0.8), (4.0, 0.8), (4.0, 2.05))
    arrow(ax, (5.1, 3.25), (5.1, 2.44), text="feedforward [V]", at=(4.3, 2.96))
    arrow(ax, (8.3, 3.25), (8.3, 2.75), text="load torque", at=(7.65, 2.96))
    ax.text(3.9, 1.75, "−", ha="right", fontsize=12)
    ax.text(3.18, 2.45, "+", ha="right", fontsize=11)

    k = np.arange(6)
    y, u = np.array([0.3, 0.35, 0.9, 1.45, 1.75, 1.9]), np.array([2.0, 3.0, 2.7, 2.4, 2.2, 2.1])
    time.step(k, u, where="post", color=SECOND, label="u, held until the next sample")
    fine = np.linspace(0.0, 5.0, 200)
    time.plot(fine, np.interp(fine, k, y), color=FIRST, label="y")
    time.plot(k, y, "o", color=FIRST)
    for i in (1, 2, 3):
        time.axvline(i, color="0.85", linewidth=0.8, zorder=0)
    style = {"arrowstyle": "-|>", "color": NOTE}
    time.annotate("1. y(k) is measured", (1.0, y[1]), (0.15, 1.15), arrowprops=style, fontsize=9)
    time.annotate("2. u(k) is computed", (1.0, u[1]), (0.15, 3.35), arrowprops=style, fontsize=9)
    time.annotate(
        "3. u(k) first acts on y(k+1): delay nk = 1", (2.0, y[2]), (2.25, 0.35),
        arrowprops=style, fontsize=9,
    )  # fmt: skip
    time.set_xticks(k, ["k-1", "k", "k+1", "k+2", "k+3", "k+4"])
    time.set(yticks=[], ylim=(0.0, 3.7), xlim=(0.0, 5.0), xlabel="time, in samples of Ts")
    time.spines[["top", "right"]].set_visible(False)
    time.legend(frameon=False, loc="upper right", fontsize=9)
    written(figure, file)


COMMANDS = (
    ("record", "data.csv", "a recording"),
    ("identify", "model.json", "a model"),
    ("tune", "controller.json", "gains, limits"),
    ("run", "run.csv", "the closed loop"),
)
CHECKED = ("validate, check", "figures, verdict", "on data not trained on")
FUNCTIONS = (
    ("read", "Dataset", "u, y, Ts, units"),
    ("identify", "Model", "simulate, predict"),
    ("tune", "TuningResult", ".controller"),
    ("run", "ClosedLoopRun", ".metrics()"),
)
CHECKED_BY = ("validate, check", "Validation, ReportCard", "on data not trained on")


def way(file: Path, steps: Sequence[tuple[str, str, str]], checked: tuple[str, str, str]) -> None:
    """What makes what, from a recording to a controller."""
    figure, ax = canvas(12.0, 3.0, 2.2)
    at = [2.2 + 2.9 * i for i in range(len(steps))]
    for x, (name, made, note) in zip(at, steps, strict=True):
        box(ax, x, 2.4, 1.75, 0.55, made)
        ax.text(x, 2.78, note, ha="center", color=NOTE, fontsize=8.5)
        start = x - (1.95 if x == at[0] else 2.02)
        arrow(ax, (start, 2.4), (x - 0.88, 2.4), text=name, at=((start + x - 0.88) / 2, 2.4))
    name, made, note = checked
    model = at[1]
    arrow(ax, (model, 2.12), (model, 1.0), text="", at=None)
    ax.text(model + 0.15, 1.55, name, va="center", color=INK, fontsize=9)
    box(ax, model, 0.72, 2.5, 0.55, made)
    ax.text(model + 1.4, 0.72, note, va="center", color=NOTE, fontsize=8.5)
    written(figure, file)


QUESTIONS: tuple[tuple[str, str, str], ...] = (
    ("Does the port open?", "port", "The port does not open"),
    ("Does the device answer?", "device", "Nobody answers"),
    ("Is the drive ready?", "state, limits", "The drive refuses"),
    ("Do all samples arrive?", "loss, throughput", "Samples are missing"),
    ("Does the run finish?", "counters, clock", "The watchdog trips;\nThe port vanishes"),
)


def questions(file: Path) -> None:
    """From the doctor's findings to the section of troubleshooting.md."""
    figure, ax = canvas(10.0, 7.0, 4.6)
    ax.text(2.1, 6.75, "question", ha="center", color=NOTE, fontsize=9)
    ax.text(5.4, 6.75, "finding of the doctor", ha="center", color=NOTE, fontsize=9)
    ax.text(8.2, 6.75, "section of this page", ha="center", color=NOTE, fontsize=9)
    for i, (question, finding, section) in enumerate(QUESTIONS):
        y = 6.15 - 1.15 * i
        box(ax, 2.1, y, 3.2, 0.62, question)
        arrow(ax, (3.7, y), (6.8, y), text=f"no: {finding}", at=(5.25, y))
        box(ax, 8.2, y, 2.8, 0.72, section, bold=True)
        arrow(ax, (2.1, y - 0.31), (2.1, y - 0.84))
        ax.text(2.25, y - 0.58, "yes", va="center", color=INK, fontsize=9)
    box(ax, 2.1, 0.43, 3.2, 0.5, "nothing is wrong with it")
    written(figure, file)


STAGES = ("linear\nmodels", "nonlinear\nmodels", "validation", "controller", "loop\nanalysis",
          "deployment", "on the\nmachine")  # fmt: skip
ROWS = (
    "linear models", "nonlinear models", "validation", "controller", "margins, loop analysis",
    "deployment", "on the machine",
)  # fmt: skip
OTHER = ("other MathWorks products", "Control System Toolbox")


def neighbours(file: Path) -> None:
    """Which part of the way each tool covers, from the table of neighbours.md."""
    text = (DOCS / "neighbours.md").read_text(encoding="utf-8")
    lines = [x for x in text.splitlines() if x.startswith("|")]
    head, *rows = ([c.strip() for c in line.split("|")[1:-1]] for line in lines)
    table: Mapping[str, list[str]] = {row[0]: row[1:] for row in rows}
    tools = head[1:]
    figure, ax = plt.subplots(figsize=(8.0, 3.0), layout="constrained")
    for j, row in enumerate(ROWS):
        for i, cell in enumerate(table[row]):
            none = cell in ("-", "simulated, not identified")
            other = any(word in cell for word in OTHER)
            colour = "0.94" if none else ("#b9cbe4" if other else LINE)
            ax.add_patch(plt.Rectangle((j + 0.06, i + 0.14), 0.88, 0.72, color=colour))
    names = [t.replace("MATLAB System Identification Toolbox", "MATLAB") for t in tools]
    ax.set_yticks(np.arange(len(tools)) + 0.5, names)
    ax.set_xticks(np.arange(len(ROWS)) + 0.5, STAGES)
    ax.set(xlim=(0, len(ROWS)), ylim=(len(tools), 0))
    ax.xaxis.tick_top()
    ax.tick_params(length=0)
    ax.spines[:].set_visible(False)
    keys = (("has it", LINE), ("another product of the vendor", "#b9cbe4"), ("none", "0.94"))
    ax.legend(
        [plt.Rectangle((0, 0), 1, 1, color=colour) for _, colour in keys], [k for k, _ in keys],
        loc="upper center", bbox_to_anchor=(0.5, 0.0), ncols=3, frameon=False,
    )  # fmt: skip
    written(figure, file)


BAUD, PERIOD = 115_200, 10.0
"""Of the drawn line [bit/s], and its sample time [ms]."""
ASKED, ANSWERED, TOLD = "f 0", "12.345678 0.000000", "c 0 0.150000"
"""What goes over the line of an ODrive in a sample; each line ends with a byte or two more."""


def polling(file: Path) -> None:
    """Two samples of a board that is polled over text, to scale."""
    per_byte = 1e4 / BAUD  # a start bit, eight, and a stop bit [ms]
    figure, ax = plt.subplots(figsize=(8.0, 3.3), layout="constrained")
    lanes = {"this computer": 2.4, "the line": 1.6, "the board": 0.8}
    for name, y in lanes.items():
        ax.plot((0.0, 2 * PERIOD), (y, y), color="0.88", linewidth=0.8, zorder=0)
        ax.text(-0.25, y, name, ha="right", va="center", color=INK, fontsize=9)
    changes = [0.0]
    for k in (0, 1):
        due = k * PERIOD
        ax.axvline(due, color=NOTE, linewidth=0.8, linestyle=(0, (4, 3)), zorder=0)
        ax.text(due + 0.06, 2.86, "due" if k == 0 else "due + Ts", color=NOTE, fontsize=8.5)
        sent = due + per_byte * (len(ASKED) + 1)
        looks = sent + 0.15
        back = looks + 0.15 + per_byte * (len(ANSWERED) + 2)
        decided = back + 0.5
        acts = decided + per_byte * (len(TOLD) + 1)
        for begin, end, text in (
            (due, sent, "asks"), (looks + 0.15, back, "position"), (decided, acts, "command"),
        ):  # fmt: skip
            ax.broken_barh([(begin, end - begin)], (1.45, 0.3), color=LINE)
            ax.text((begin + end) / 2, 1.84, text, ha="center", color=INK, fontsize=8.5)
        ax.broken_barh([(back, decided - back)], (2.25, 0.3), color=SECOND)
        ax.text((back + decided) / 2, 2.64, "computes u", ha="center", color=INK, fontsize=8.5)
        ax.broken_barh([(acts, due + PERIOD - acts)], (2.25, 0.3), color=FILL)
        free = "waits for the next sample"
        ax.text((acts + due + PERIOD) / 2, 2.4, free, ha="center", va="center", fontsize=8.5)
        ax.plot([looks], [0.8], "o", color=FIRST, markersize=5)
        ax.plot([acts], [0.8], ">", color=SECOND, markersize=6)
        if k == 0:
            ax.text(looks - 0.1, 0.93, "encoder is read", fontsize=8.5)
            ax.text(acts - 0.1, 0.93, "u acts until the next command", fontsize=8.5)
        changes.append(acts)
    levels = (0.05, 0.4, 0.25)
    ax.step([*changes, 2 * PERIOD], [*levels, levels[-1]], where="post", color=SECOND)
    ax.text(-0.25, 0.25, "u on the motor", ha="right", va="center", color=INK, fontsize=9)
    ax.set(xlim=(-3.4, 2 * PERIOD), ylim=(-0.05, 3.05), yticks=[], xlabel="time [ms]")
    ax.set_xticks(np.arange(0, 21, 2))
    ax.spines[["top", "right", "left"]].set_visible(False)
    written(figure, file)


DIAGRAMS: dict[str, Callable[[Path], None]] = {
    "loop": loop_and_time,
    "commands": lambda file: way(file, COMMANDS, CHECKED),
    "functions": lambda file: way(file, FUNCTIONS, CHECKED_BY),
    "questions": questions,
    "neighbours": neighbours,
    "polling": polling,
}


def draw_all(folder: Path) -> None:
    """Draw every diagram into a folder."""
    folder.mkdir(parents=True, exist_ok=True)
    with mpl.rc_context({"font.size": 9}):
        for name, draw in DIAGRAMS.items():
            draw(folder / f"{name}.png")


if __name__ == "__main__":
    draw_all(Path(sys.argv[1]) if len(sys.argv) > 1 else DOCS / "assets" / "pages")
