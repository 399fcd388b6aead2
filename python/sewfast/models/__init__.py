"""Identified models: linear ones and the network, with their files."""

from .base import Model
from .files import load_model
from .linear import ARX, LinearOE
from .neural import NeuralOE

__all__ = ["ARX", "LinearOE", "Model", "NeuralOE", "load_model"]
