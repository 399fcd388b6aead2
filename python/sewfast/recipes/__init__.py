"""How each kind of model comes out of a checked `Task`; `identify` is the way in."""

from .auto import auto, neural_ss
from .clock import Clock, Progress
from .linear import arx, iv, oe
from .network import neural_oe, paper
from .task import Task

__all__ = [
    "Clock",
    "Progress",
    "Task",
    "arx",
    "auto",
    "iv",
    "neural_oe",
    "neural_ss",
    "oe",
    "paper",
]
