"""From models to a controller.

Read in this order: `objective` (`Cost`, `Constraints`, `LoadStep`), `task` (plants, variables and
start of a search), `robustness` (Ms and its default limit), `search` (`tune`), `opinion` (a second
opinion), `verdict`, `judge` (`costs`: no search), `front` (`pareto`).
"""

from .front import ParetoFront, pareto
from .judge import Judge, Judgement, costs, led, recoveries, verdict_on
from .objective import Constraints, Cost, LoadStep
from .search import TuningResult, tune
from .task import default_variations, first_controller

__all__ = [
    "Constraints",
    "Cost",
    "Judge",
    "Judgement",
    "LoadStep",
    "ParetoFront",
    "TuningResult",
    "costs",
    "default_variations",
    "first_controller",
    "led",
    "pareto",
    "recoveries",
    "tune",
    "verdict_on",
]
