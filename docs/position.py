"""Draws assets/position.svg: the angle of a drive moves on, its speed settles."""

from __future__ import annotations

from pathlib import Path

import matplotlib as mpl
import matplotlib.pyplot as plt
import numpy as np

import sewfast

PICTURE = Path(__file__).parent / "assets" / "position.svg"
LEVELS = (0.0, 2.0, 0.0, 4.0, 2.0, 0.0)
HELD = 1000
STEP = 6
"""One sample of six is drawn: finer is not seen."""


def main() -> None:
    machine = sewfast.VirtualMachine()
    u = np.repeat(LEVELS, HELD)
    turns = machine.run(u).counts / machine.counts_per_rev
    angle = sewfast.Dataset.from_arrays(u, turns, machine.Ts, output_unit="rev")
    speed = angle.differentiate()
    rows = {
        "command [V]": u,
        "angle [rev]": turns,
        f"its speed [{speed.output_unit}]": speed.experiments[0].y,
    }
    mpl.rcParams |= {"svg.fonttype": "none", "svg.hashsalt": "sewfast", "font.size": 10}
    figure, axes = plt.subplots(3, 1, sharex=True, figsize=(8.0, 4.6), layout="constrained")
    t = machine.Ts * np.arange(len(u))
    for ax, (name, column) in zip(axes, rows.items(), strict=True):
        ax.plot(t[::STEP], column[::STEP], color="tab:blue", linewidth=1.4)
        ax.set_ylabel(name)
        for start in range(len(LEVELS)):
            ax.axvline(start * HELD * machine.Ts, color="0.8", linewidth=0.6, zorder=0)
    axes[-1].set(xlabel="time [s]", xlim=(0.0, t[-1]))
    figure.align_ylabels()
    figure.savefig(PICTURE, metadata={"Date": None})


if __name__ == "__main__":
    main()
