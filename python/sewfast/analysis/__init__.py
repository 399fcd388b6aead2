"""Analysis of a controller on models: responses, Bode of L, S, T, gain sensitivity, what-if.

Read in this order: `analysis` (`analyse` and its result), `points` (operating points and their
Bode), `responses` (steps of reference and load), `sensitivity` and `changes` (other gains, other
plants), `figures`.
"""

from ..control.systems import LinearLoop
from .analysis import Analysis, analyse
from .changes import Change
from .points import LoopBode, PlantPoint
from .responses import Responses, run_under_load
from .sensitivity import GainSensitivity, Score, WhatIf

__all__ = [
    "Analysis",
    "Change",
    "GainSensitivity",
    "LinearLoop",
    "LoopBode",
    "PlantPoint",
    "Responses",
    "Score",
    "WhatIf",
    "analyse",
    "run_under_load",
]
