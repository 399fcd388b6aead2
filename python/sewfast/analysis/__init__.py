"""Analysis of a controller on models: responses, Bode of L, S, T, gain sensitivity, what-if."""

from .analysis import Analysis, analyse
from .bode import LoopBode
from .changes import Change
from .loading import run_under_load
from .points import PlantPoint
from .responses import Responses
from .scoring import Score
from .sensitivity import GainSensitivity
from .systems import LinearLoop
from .whatif import WhatIf

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
