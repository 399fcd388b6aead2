"""What a motor is, from its record: friction, inertia, resistance, with error bars.

Read `fit` (the method) first: `records` is what is fitted, `task` what is compared and summed,
`starts` where it begins, `marquardt` how it goes down, `intervals` how sure it is, `motor` the
result; `equations` fits a function of your own. `tracking` follows a motor while it runs. The
motor's equations and their sensitivities are the core's.
"""

from .equations import EquationFit, load_equations
from .fit import physics
from .motor import Motor, load_motor
from .tracking import Track, Tracker

__all__ = ["EquationFit", "Motor", "Track", "Tracker", "load_equations", "load_motor", "physics"]
