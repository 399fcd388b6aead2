"""Physical parameters of a motor from its record: friction, inertia, resistance, with error bars.

Read `fit` first: `physics` turns the result of `sewfast.motorfit` into a `motor` or, of positions,
a `joint` or several, `joints`; `equations` fits a function of your own; `exports` writes settings
of other tools; `tracking` follows a running motor.
"""

from .equations import EquationFit, load_equations
from .fit import physics
from .joint import Joint, load_joint
from .joints import Coupling, Joints
from .motor import Motor, load_motor
from .tracking import Track, Tracker

__all__ = [
    "Coupling", "EquationFit", "Joint", "Joints", "Motor", "Track", "Tracker", "load_equations",
    "load_joint", "load_motor", "physics",
]  # fmt: skip
