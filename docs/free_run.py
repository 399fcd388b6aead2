"""Draws assets/free_run.svg: the model that `identify` chooses and a linear one, on new data.

    python docs/free_run.py [MODEL.json]

Without a model the walk of the README is identified anew, which takes about 20 s.
"""

from __future__ import annotations

import sys
from pathlib import Path

import matplotlib as mpl
import matplotlib.pyplot as plt
import numpy as np

import sewfast

PICTURE = Path(__file__).parent / "assets" / "free_run.svg"
SHOWN = slice(8_000, 11_000)
STEP = 6
"""One sample of six is drawn: finer is not seen."""


def record(signal: str) -> sewfast.Dataset:
    """A named excitation on the virtual machine, its speed from the encoder's counts."""
    machine = sewfast.VirtualMachine()
    u = sewfast.signals.excitation(signal)
    y = sewfast.speed_from_counts(machine.run(u).counts, machine.Ts, machine.counts_per_rev)
    return sewfast.Dataset.from_arrays(u, y, machine.Ts, input_units="V", output_unit="RPM")


def main() -> None:
    training = sewfast.Dataset.concat(map(record, ["chirp_lo_hi", "saturating"]))
    chosen = sewfast.load_model(sys.argv[1]) if len(sys.argv) > 1 else sewfast.identify(training)
    models = {
        "chosen by identify": chosen,
        "linear output error": sewfast.identify(training, model="oe"),
    }
    random = record("random")
    t = random.Ts * np.arange(SHOWN.start, SHOWN.stop, STEP)
    y = random.experiments[0].y[SHOWN][::STEP]

    mpl.rcParams |= {"svg.fonttype": "none", "svg.hashsalt": "sewfast", "font.size": 10}
    figure, (speed, error) = plt.subplots(
        2, 1, sharex=True, figsize=(8.0, 4.6), height_ratios=(3, 2), layout="constrained"
    )
    speed.plot(t, y, color="0.0", linewidth=3.0, label="measured")
    for (name, model), colour in zip(models.items(), ("tab:orange", "tab:blue"), strict=True):
        score = sewfast.validate(model, random).simulation
        run = model.simulate(random)[0][SHOWN][::STEP]
        label = f"{name}: fit {score.fit_percent:.0f} %"
        speed.plot(t, run, color=colour, linewidth=1.2, label=label)
        error.plot(t, run - y, color=colour, linewidth=1.2)
    speed.set_ylabel("speed [RPM]")
    speed.set_ylim(top=speed.get_ylim()[1] + 700.0)
    speed.legend(loc="upper left", ncols=3, frameon=False, columnspacing=1.2)
    error.axhline(0.0, color="0.0", linewidth=0.5)
    error.set(ylabel="error [RPM]", xlabel="time [s]")
    figure.savefig(PICTURE, metadata={"Date": None})


if __name__ == "__main__":
    main()
