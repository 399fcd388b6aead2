"""Whole files of the nine formats, for `mutations.py`: what is changed there."""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

import sewfast
from sewfast.cli import project
from sewfast.recordfile import Header, RecordWriter

sys.path.append(str(Path(__file__).parents[1] / "tests" / "support"))
from commissioned import SMALL, short
from kinds import TS, levels, model_of, recording

MODELS = (
    "arx", "arx, two inputs, nk 2", "iv", "oe", "oe, integrator", "hammerstein_wiener", "grey_box",
    "grey_box, late by 1.4 samples", "neural_oe", "neural_oe, saturates", "neural_ss",
    "neural_ss, abs", "neural_ss, integrator", "ensemble of mixed kinds", "ensemble, two inputs",
)  # fmt: skip


def make_models(folder: Path) -> list[Path]:
    made = []
    for i, name in enumerate(MODELS):
        model = model_of(name)
        rest = {"u": [0.5] * len(model.input_names), "y": 2.0, "source": "record"}
        at_zero = "abs" in name or "grey_box" in name
        known = {**model.training, "noise": 0.1, **({} if at_zero else {"rest": rest})}
        made.append(folder / f"model-{i}.json")
        replace(model, training=known).save(made[-1])
    return made


def make_controllers(folder: Path) -> list[Path]:
    gains = sewfast.Gains.standard(0.02, 0.2, 0.01)
    notch = sewfast.Biquad.notch(20.0)
    made = (
        sewfast.Controller(gains, u_min=-20, u_max=20, Ts=TS, counts_per_rev=1572.0),
        sewfast.paper_controller(),
        sewfast.Controller(
            gains, u_min=-10, u_max=10, slew=500.0, Ts=TS, biquads=[notch],
            schedule=[(0.0, gains), (500.0, sewfast.Gains.standard(0.01, 0.3, 0.0))],
        ),
        sewfast.StateFeedback.from_model(model_of("oe"), u_min=-9.0, u_max=9.0),
        sewfast.Controller(
            gains, u_min=-20, u_max=20, Ts=TS, filter_samples=4, feedforward=sewfast.Feedforward(
                8, 0.5, ((-900.0, -3.0), (-50.0, -0.8), (50.0, 0.8), (900.0, 3.0)), (0.01, 0.02),
            ),
        ),
    )  # fmt: skip
    return saved(folder, "controller", made)


def saved(folder: Path, name: str, made: Sequence[Any]) -> list[Path]:
    found = [folder / f"{name}-{i}.json" for i in range(len(made))]
    for path, value in zip(found, made, strict=True):
        value.save(path)
    return found


def motor_record() -> sewfast.Dataset:
    return recording(model_of("grey_box, no network"), n=600, noise=0.002)


def turning(x: Any, u: Any, p: Any) -> Any:
    return (u / p["k_e"] - x) / p["T"]


def make_motors(folder: Path) -> list[Path]:
    data = motor_record()
    usual = sewfast.physics(data)
    turned = sewfast.physics(
        data, structure=["lag", "coulomb", "offset", "drop", "stribeck", "sag", "load_1"]
    )
    own = sewfast.physics(
        data, equations=turning, parameters={"k_e": (0.02, 1e-4, 10.0), "T": (0.2, 1e-3, 10.0)}
    )
    return saved(folder, "motor", (usual, turned, own))


def make_responses(folder: Path) -> list[Path]:
    one, other = response(24), replace(response(24), blocks=np.full(24, 8.0), noise=None)
    # of so few lines no shaft is fitted, which takes seconds
    speeds = {500.0: response(12), 900.0: response(15)}
    more = sewfast.ResponsesOverSpeed(speeds, {1500.0: "the drive tripped"})
    return saved(folder, "response", (one, other, more))


def response(lines: int) -> sewfast.FrequencyResponse:
    f = np.geomspace(1.0, 40.0, lines)
    s = 2j * np.pi * f
    value = 50.0 / (1.0 + 0.05 * s) * np.exp(-0.01 * s)
    return sewfast.FrequencyResponse(
        f, value, (0.01 * abs(value)) ** 2, np.linspace(0.999, 0.9, lines), 16.0, TS,
        (0.008 * abs(value)) ** 2, "V", "RPM", False, {"method": "segments", "cautions": ["few"]},
    )  # fmt: skip


def make_tables(folder: Path) -> list[Path]:
    data = recording(model_of("oe"), n=120)
    u, y = data.experiments[0].u[:, 0], data.experiments[0].y
    place, plain = folder / "recording-0.csv", folder / "recording-1.csv"
    columns = {"t": TS * np.arange(len(u)), "u": u, "y": np.round(y, 4)}
    sewfast.write_table(place, columns, units={"t": "s", "u": "V", "y": "RPM"})
    counts = np.cumsum(np.round(10.0 * y))
    sewfast.write_table(plain, {"time": columns["t"], "duty": u, "encoder": counts})
    return [place, plain]


def header_of_example() -> Header:
    return Header(
        "steps", TS, {"u": "V", "y": "RPM", "counts": "1"}, 100, 1572.0,
        {"name": "virtual", "boot_id": 7}, {"seed": 3, "limits": {"u": 20.0}},
        "2026-01-31T12:00:00+00:00",
    )  # fmt: skip


def write_recording(path: Path) -> Path:
    u = levels(100, 3, 1)[:, 0]
    with RecordWriter(path, header_of_example()) as writer:
        writer.event("armed", 0, limits={"u": 20.0})
        for first in range(0, 100, 10):
            if first != 40:
                k = slice(first, first + 10)
                part = {"u": u[k], "y": 3.0 * u[k], "counts": np.arange(first, first + 10)}
                writer.samples(first, part)
        writer.event("disarmed", 100)
    return path


def make_recordings(folder: Path) -> list[Path]:
    return [write_recording(folder / "recording.mcap")]


SETTINGS = """\
port = "/dev/ttyUSB0"
[columns]
input = "u"
output = "y"
time = "t"
ts = 0.01
[units]
u = "V"
y = "RPM"
[limits]
volt = 10.0
speed = 3500.0
acceleration = 30000.0
current = inf
u_min = -10.0
u_max = 10
"""


def make_projects(folder: Path) -> list[Path]:
    path = folder / project.NAME
    path.write_text(SETTINGS)
    return [path]


def make_commissionings(folder: Path) -> list[Path]:
    with short():
        found = sewfast.commission(sewfast.VirtualMachine(1), **SMALL)
    place = folder / "commissioned"
    found.save(place)
    numbers = place / "commissioning.json"
    document = json.loads(numbers.read_bytes())
    document["references"] = dict([*document["references"].items()][:1])  # each takes a second
    numbers.write_text(json.dumps(document, indent=1))
    return [numbers, place / "analysis.json"]


def make_fleets(folder: Path) -> list[Path]:
    records = folder / "records"
    records.mkdir(exist_ok=True)
    for i in range(3):
        data = recording(model_of("oe, na 1"), n=300, seed=i)
        columns = {
            "t": TS * np.arange(300),
            "u": data.experiments[0].u[:, 0],
            "y": data.experiments[0].y,
        }
        sewfast.write_table(records / f"{i}.csv", columns)
    (records / "3.csv").write_text("t,u,y\n0,1,2\n")
    found = sewfast.fleet(records, model="oe", workers=1)
    made = [folder / "fleet.csv", folder / "fleet.json"]
    for path in made:
        found.save(path)
    return made
