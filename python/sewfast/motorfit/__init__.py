"""A motor's equations fitted to its record: output error on exact sensitivities.

Read `terms` (the method) first: `records` is what is fitted, `task` what is compared and summed,
`starts` where it begins, `waves` what repeats over the turn, `marquardt` how it goes down,
`intervals` how sure it is. The motor's equations and their sensitivities are the core's. `physics`
prints what is found here, `identify` makes a model of it.
"""

from .records import Records, rad_per_second, records_of
from .task import OPTIONAL, PLACE, TERMS, WAVES
from .terms import Estimated, estimated

__all__ = [
    "OPTIONAL", "PLACE", "TERMS", "WAVES", "Estimated", "Records", "estimated", "rad_per_second",
    "records_of",
]  # fmt: skip
