"""What models, records and references are called on the page."""

from __future__ import annotations

MODEL = {
    "paper": "paper's network",
    "neural_oe": "default network",
    "oe": "linear output error",
    "oe_all": "linear output error, all records",
    "arx": "ARX, smoothed speed",
    "arx_raw": "ARX, differenced counts",
}

RECORD = {
    "step": "step",
    "chirp_lo_hi": "chirp Lo-Hi",
    "chirp_hi_lo": "chirp Hi-Lo",
    "random": "random",
    "saturating": "saturating",
}

REFERENCE = {
    "trapezoid": "trapezoid",
    "chirp_hi_lo": "chirp Hi-Lo",
    "chirp_lo_hi": "chirp Lo-Hi",
    "random": "random",
}
