"""What speaks against a closed loop: training region, saturation, limit cycle, disagreement."""

from .disagreement import Disagreement, disagreements
from .judgement import Judgement
from .judging import judge
from .limits import Limits
from .oscillation import Oscillation, oscillation

__all__ = [
    "Disagreement",
    "Judgement",
    "Limits",
    "Oscillation",
    "disagreements",
    "judge",
    "oscillation",
]
