"""Commissioning: from a machine at rest to a verified controller."""

from .bench import Bench, Followed, Stepped, SteppedBench
from .procedure import STAGES, commission
from .refusal import Refusal
from .result import Commissioning
from .rival import Rival
from .verification import Comparison

__all__ = [
    "STAGES",
    "Bench",
    "Commissioning",
    "Comparison",
    "Followed",
    "Refusal",
    "Rival",
    "Stepped",
    "SteppedBench",
    "commission",
]
