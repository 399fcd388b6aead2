"""Frequency response: what a machine does to a sine, with error bars, and the shaft behind it.

`response` holds the result and what is asked of it (bands, loop, margins, files, pictures),
`estimate` makes it from periods and by averaged spectra, `local` from any record, `shaft` fits a
rigid machine or two masses to it, `speeds` holds those about several speeds, `proposal` finds gains
and a notch.
"""

from .estimate import periodic, spectral
from .local import local_polynomial
from .proposal import Proposal, propose
from .response import FrequencyResponse, LoopMargins, load_response
from .shaft import Parameter, ShaftFit, fit_shaft
from .speeds import ResponsesOverSpeed, load_responses

__all__ = [
    "FrequencyResponse",
    "LoopMargins",
    "Parameter",
    "Proposal",
    "ResponsesOverSpeed",
    "ShaftFit",
    "fit_shaft",
    "load_response",
    "load_responses",
    "local_polynomial",
    "periodic",
    "propose",
    "spectral",
]
