"""A drive behind a port, here a virtual one: examine, set limits, record, trip, identify."""

import tempfile
from pathlib import Path

import numpy as np

import sewfast
from sewfast.errors import LinkError
from sewfast.link import VirtualDevice, connect, examine

t = 0.001 * np.arange(8000)
gentle = 2.5 + 1.5 * np.sin(2 * np.pi * 0.5 * t) + np.where(t % 0.4 < 0.2, 0.4, -0.4)

# for a real drive, leave out the virtual device: port = "/dev/ttyUSB0"
with VirtualDevice(fast=True) as device, tempfile.TemporaryDirectory() as name:
    port, file = device.port, Path(name) / "gentle.mcap"

    found = examine(port)
    for finding in found.findings:
        print(f"{finding.verdict:5} {finding.name}")
    assert found.verdict != "fail", found

    # the motor is stopped when this block ends, after an exception too
    with connect(port) as drive:
        drive.set_limits(volt=8.0, speed_rpm=3500.0, acceleration=40_000.0, current=15.0)
        recording = sewfast.record(drive, gentle, name="gentle", file=file)
        print(recording)

        # exceeding a limit trips the drive: its output is off, the samples so far are kept
        drive.set_limits(speed_rpm=500.0)
        try:
            sewfast.record(drive, gentle, name="too fast", file=Path(name) / "tripped.mcap")
        except LinkError as error:
            print(drive.status().reason, "trip after", len(error.recording), "samples")
            drive.clear()

    data = sewfast.read(file, inputs="u", counts="counts")
    train, test = data.split(0.6)
    score = sewfast.validate(sewfast.identify(train, model="oe"), test)
    print(score)
    assert score.simulation.fit_percent > 95.0, score
