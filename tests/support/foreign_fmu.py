"""A motor of another tool: a co-simulation FMU that PythonFMU writes."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

MOTOR = """
import math
from pythonfmu import Fmi2Causality, Fmi2Slave, Real

class Motor(Fmi2Slave):
    def __init__(self, **kwargs):
        super().__init__(**kwargs)
        self.voltage = self.speed = self.angle = 0.0
        self.register_variable(Real("voltage", causality=Fmi2Causality.input))
        self.register_variable(Real("speed", causality=Fmi2Causality.output))
        self.register_variable(Real("angle", causality=Fmi2Causality.output))

    def do_step(self, current_time, step_size):
        for _ in range(10):
            friction = 0.3 * math.tanh(self.speed / 5.0)
            self.speed += 0.1 * step_size / 0.08 * (300.0 * (self.voltage - friction) - self.speed)
            self.angle += 0.1 * step_size * self.speed / 60.0
        return True
"""
OF_MOTOR: dict[str, Any] = {
    "input": "voltage", "speed": "speed", "angle": "angle", "speed_unit": "RPM",
    "angle_unit": "rev", "volt": 10.0,
}  # fmt: skip


def motor_fmu(folder: Path) -> Path:
    """The FMU, made in a folder."""
    builder = pytest.importorskip("pythonfmu.builder", reason="needs pythonfmu")
    (folder / "motor.py").write_text(MOTOR)
    made = builder.FmuBuilder.build_FMU(folder / "motor.py", dest=folder)
    return Path(made)
