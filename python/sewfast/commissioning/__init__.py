"""Commissioning: from a machine at rest to a verified controller.

Read in this order: `procedure` (`commission`, its stages one after the other), `demands` (settings
and limits, `Refusal`), `references`, `journal` (results so far), `bench` (wrappers around a
machine); the stages: `excitations`, `small_signal`, `gains`, `training`, `slow`, `verification`,
`positions`; `result` (the value and its folder). Apart from these: `shaking` (`bode` of a machine),
`fmu` (an FMU as a machine).
"""

from ..frequency.local import unsmoothed
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
    "unsmoothed",
]
