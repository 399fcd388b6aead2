"""Identified models: linear ones and the network, with their files."""

from .base import Model
from .files import load_model
from .linear import ARX, IV, LinearOE
from .neural import NeuralOE

__all__ = ["ARX", "IV", "LinearOE", "Model", "NeuralOE", "load_model"]
