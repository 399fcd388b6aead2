"""Frequency response: what a machine does to a sine, with error bars, and the shaft behind it.

`response` holds the result and what is asked of it (bands, loop, margins, files, pictures),
`estimate` makes it from signals, `shaft` fits a rigid machine or two masses to it, `proposal`
finds gains and a notch.
"""

from .estimate import periodic, spectral
from .proposal import Proposal, propose
from .response import FrequencyResponse, LoopMargins, load_response
from .shaft import Parameter, ShaftFit, fit_shaft

__all__ = [
    "FrequencyResponse",
    "LoopMargins",
    "Parameter",
    "Proposal",
    "ShaftFit",
    "fit_shaft",
    "load_response",
    "periodic",
    "propose",
    "spectral",
]
