"""Frequency response of a machine with error bars, and the shaft behind it.

`response` has the result and its uses (bands, loop, margins, files, pictures), `estimate` computes
it from periods and by averaged spectra, `local` from any record, with cautions; `shaft` fits a
rigid machine or masses on shafts to it, `speeds` has the responses at several speeds, `proposal`
finds gains and filters.
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
