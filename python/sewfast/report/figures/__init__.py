"""The figures of the report, each with its paper's number and the numbers that belong to it."""

from .excitation import recorded_pictures, scaled_pictures
from .loops import loop_pictures, paper_gain_pictures, trust_pictures
from .prediction import arx_picture, prediction_pictures

__all__ = [
    "arx_picture",
    "loop_pictures",
    "paper_gain_pictures",
    "prediction_pictures",
    "recorded_pictures",
    "scaled_pictures",
    "trust_pictures",
]
