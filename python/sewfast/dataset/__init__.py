"""Data sets: experiments, their parts, what they must fulfil."""

from .arrays import FloatArray
from .checks import require_dataset
from .dataset import Dataset
from .experiment import Experiment
from .pieces import SHORTEST_PIECE
from .units import HasUnits, labelled, require_same_units

__all__ = [
    "SHORTEST_PIECE",
    "Dataset",
    "Experiment",
    "FloatArray",
    "HasUnits",
    "labelled",
    "require_dataset",
    "require_same_units",
]
