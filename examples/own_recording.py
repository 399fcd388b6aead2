"""A recording of your own: identify on its first part, score on the rest, keep the model."""

import tempfile
from pathlib import Path

import numpy as np

import sewfast

with tempfile.TemporaryDirectory() as name:
    folder = Path(name)

    # in place of your recording: a fan, from volts to rad/s, with noise
    random = np.random.default_rng(0)
    u = np.repeat(random.uniform(0.0, 12.0, 200), 20)
    y = np.zeros_like(u)
    for k in range(1, len(u)):
        y[k] = 0.96 * y[k - 1] + 1.2 * np.sqrt(u[k - 1])
    columns = {"t": 0.01 * np.arange(len(u)), "volt": u, "speed": y + random.normal(0, 0.2, len(u))}
    sewfast.write_table(folder / "fan.csv", columns, units={"volt": "V", "speed": "rad/s"})

    data = sewfast.read(folder / "fan.csv", inputs="volt", output="speed")
    train, test = data.split(0.6)
    errors = {}
    for kind in ("oe", "auto"):
        model = sewfast.identify(train, model=kind)
        score = sewfast.validate(model, test)
        print(score)
        errors[kind] = score.simulation.rmse
    # the noise is 0.2 rad/s, and no model can do better
    assert errors["auto"] < 0.5 < 2.0 < errors["oe"], errors

    print(model.training["verdict"]["text"])
    assert model.training["verdict"]["grade"] == "good"
    model.save(folder / "fan.json")
    again = sewfast.load_model(folder / "fan.json")
    print(again)
