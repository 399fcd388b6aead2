"""What speaks against a closed loop: training region, saturation, limit cycle, disagreement."""

from .judgement import Disagreement, Judgement, Limits, Oscillation, disagreements, oscillation
from .judging import judge

__all__ = [
    "Disagreement",
    "Judgement",
    "Limits",
    "Oscillation",
    "disagreements",
    "judge",
    "oscillation",
]
