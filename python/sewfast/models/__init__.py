"""Identified models: linear ones and networks, with their files.

Read in this order: `base` (`Model`, `Ensemble`), then the kinds: `linear`, `hammerstein`, `neural`,
`grey_box`; `files` (with the table of kinds), `conversion` (linear models in other forms).
"""

from ..dynamic_model import FreeRunJacobian
from .base import Ensemble, Model, NotLinearError
from .files import load_model, model_schema
from .linear import ARX, IV, LinearOE
from .neural import NeuralOE, NeuralSS

__all__ = [
    "ARX",
    "IV",
    "Ensemble",
    "FreeRunJacobian",
    "LinearOE",
    "Model",
    "NeuralOE",
    "NeuralSS",
    "NotLinearError",
    "load_model",
    "model_schema",
]
