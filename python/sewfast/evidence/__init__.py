"""Evidence that a model can be trusted: tests, covariance, bands, region, linearisation.

Read in this order: `checking` (`check`), `card` and `verdicts` (the report card and its lines), and
the evidence behind them: `residuals` and `portmanteau` (tests), `parameters` (covariance),
`simulation_bands`, `region` (the training region), `operating` (linearisation), `figures`.
"""

from .card import Line, ReportCard
from .checking import check, training_evidence, with_training_evidence
from .operating import OperatingPoint, OperatingRange, operating_range
from .parameters import Parameters, estimate
from .portmanteau import ResidualTest, residual_tests
from .region import Region, TrainingRegion, training_region
from .residuals import Residuals
from .simulation_bands import Bands, bands

__all__ = [
    "Bands",
    "Line",
    "OperatingPoint",
    "OperatingRange",
    "Parameters",
    "Region",
    "ReportCard",
    "ResidualTest",
    "Residuals",
    "TrainingRegion",
    "bands",
    "check",
    "estimate",
    "operating_range",
    "residual_tests",
    "training_evidence",
    "training_region",
    "with_training_evidence",
]
