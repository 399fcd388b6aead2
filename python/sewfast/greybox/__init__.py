"""What a motor is, from its record: friction, inertia, resistance, with error bars.

Read `fit` first: `physics` makes a `motor` of what `sewfast.motorfit` finds; `equations` fits a
function of your own. `tracking` follows a motor while it runs.
"""

from .equations import EquationFit, load_equations
from .fit import physics
from .motor import Motor, load_motor
from .tracking import Track, Tracker

__all__ = ["EquationFit", "Motor", "Track", "Tracker", "load_equations", "load_motor", "physics"]
