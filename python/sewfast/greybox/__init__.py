"""Physical parameters of a motor from its record: friction, inertia, resistance, with error bars.

Read `fit` first: `physics` turns the result of `sewfast.motorfit` into a `motor` or, of positions,
a `joint`; `equations` fits a function of your own; `exports` writes settings of other tools;
`tracking` follows a running motor.
"""

from .equations import EquationFit, load_equations
from .fit import physics
from .joint import Joint, load_joint
from .motor import Motor, load_motor
from .tracking import Track, Tracker

__all__ = [
    "EquationFit", "Joint", "Motor", "Track", "Tracker", "load_equations", "load_joint",
    "load_motor", "physics",
]  # fmt: skip
