"""A motor's equations fitted to its record: output error on exact sensitivities.

Read `terms` (the method, and profile-likelihood intervals) first, then `records` (the data),
`problem` (free parameters and residuals), `starts` (initial values, and effects that repeat over
the turn) and `estimation` (descent, whitening filters, covariance). `joint` is the same for
positions. The motor's equations and their sensitivities are in the core. `physics` prints the
result, `identify` makes a model of it.
"""

from .problem import OPTIONAL, PLACE, TERMS, WAVES
from .records import Records, rad_per_second, records_of
from .terms import Estimated, estimated

__all__ = [
    "OPTIONAL", "PLACE", "TERMS", "WAVES", "Estimated", "Records", "estimated", "rad_per_second",
    "records_of",
]  # fmt: skip
