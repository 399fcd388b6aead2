"""What a motor is, from its record: friction, inertia, resistance, with error bars.

`fit` holds the method, `records` what is fitted, `motor` the result. The equations and their
sensitivities are the core's.
"""

from .fit import physics
from .motor import Motor, load_motor

__all__ = ["Motor", "load_motor", "physics"]
