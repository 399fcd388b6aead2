"""What a motor is, from its record: friction, inertia, resistance, with error bars.

`fit` holds the method, `records` what is fitted, `motor` the result; `tracking` follows a motor
while it runs. The equations and their sensitivities are the core's.
"""

from .fit import physics
from .motor import Motor, load_motor
from .tracking import Track, Tracker

__all__ = ["Motor", "Track", "Tracker", "load_motor", "physics"]
