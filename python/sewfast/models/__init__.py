"""Identified models: linear ones and networks, with their files."""

from .base import Model
from .ensemble import Ensemble
from .files import load_model, model_schema
from .linear import ARX, IV, LinearOE
from .neural import NeuralOE
from .neural_ss import NeuralSS

__all__ = [
    "ARX",
    "IV",
    "Ensemble",
    "LinearOE",
    "Model",
    "NeuralOE",
    "NeuralSS",
    "load_model",
    "model_schema",
]
