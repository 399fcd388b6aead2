"""Commissioning: from a machine at rest to a verified controller."""

from .bench import Bench, Followed, Stepped, SteppedBench
from .demands import Refusal
from .fmu import FmuMachine, fmu_bench
from .procedure import STAGES, commission
from .result import Commissioning
from .shaking import bode
from .training import Rival
from .verification import Comparison

__all__ = [
    "STAGES",
    "Bench",
    "Commissioning",
    "Comparison",
    "FmuMachine",
    "Followed",
    "Refusal",
    "Rival",
    "Stepped",
    "SteppedBench",
    "bode",
    "commission",
    "fmu_bench",
]
