"""The controller and its loop.

Read in this order: `biquad` (notches and other filters), `feedforward` (the command that a model
needs), `controller` (the base class of all kinds; the PID), `state_feedback` (the second kind),
`files` (`load_controller`), `loop` (`run`: on a model or a machine), `machine` (`Machine`, the
protocol of machines), `guarding` (their guard), `benches` (machines of this process), `record`,
`position` (a position loop over a PID), `stops` (`stop_at`), `defaults` (limits, filter and
references of a drive by default), `margins` (of the linear loop), `systems` (the linear loop as
state space), `forms` (a PID as MATLAB's and python-control's).
"""

from ..gains import Form, Gains, vector
from ..rules import Fopdt, Rule, fit_fopdt, table_1
from .biquad import Biquad
from .controller import Controller, SampledController, paper_controller
from .feedforward import Feedforward
from .files import load_controller
from .state_feedback import StateFeedback

__all__ = [
    "Biquad",
    "Controller",
    "Feedforward",
    "Fopdt",
    "Form",
    "Gains",
    "Rule",
    "SampledController",
    "StateFeedback",
    "fit_fopdt",
    "load_controller",
    "paper_controller",
    "table_1",
    "vector",
]
