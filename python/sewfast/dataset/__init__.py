"""Data sets: experiments, their parts, checks and preparation.

Read in this order: `experiment` and `dataset` (the values, immutable; as tables of other packages),
`pieces` (parts, gaps, what a data set must fulfil); preparation: `trends` (offsets, kept for
restoring), `rates` (sample times, the speed of a position), `outliers`; properties: `summary`,
`diagnosis` and `feedback` (integrators, closed loops, repetitions), `faults` and `changes` (records
that deceive).
"""

from ..arrays import FloatArray, HasUnits, labelled, require_same_units
from .dataset import Dataset
from .diagnosis import Diagnosis, Finding, diagnose, is_reference
from .experiment import Experiment
from .outliers import Outliers
from .pieces import SHORTEST_PIECE, require_dataset
from .summary import ColumnSummary, Summary, column_summary
from .trends import Trend

__all__ = [
    "SHORTEST_PIECE",
    "ColumnSummary",
    "Dataset",
    "Diagnosis",
    "Experiment",
    "Finding",
    "FloatArray",
    "HasUnits",
    "Outliers",
    "Summary",
    "Trend",
    "column_summary",
    "diagnose",
    "is_reference",
    "labelled",
    "require_dataset",
    "require_same_units",
]
