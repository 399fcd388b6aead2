"""Kinds of model by name: what `identify`, the command line and the studio offer."""

from __future__ import annotations

from typing import Literal, TypeAlias, get_args

Kind: TypeAlias = Literal[
    "auto",
    "arx",
    "iv",
    "oe",
    "hammerstein_wiener",
    "hammerstein-wiener",
    "grey_box",
    "grey-box",
    "neural_oe",
    "neural-oe",
    "neural_ss",
    "neural-ss",
]
KINDS: tuple[Kind, ...] = tuple(kind for kind in get_args(Kind) if "-" not in kind)
TEXTS: dict[str, str] = {
    "arx": "least squares one step ahead",
    "iv": "refined instrumental variables",
    "oe": "linear output error",
    "hammerstein_wiener": "linear output error between static characteristics",
    "grey_box": "equations of a motor, a network for what they leave",
    "neural_oe": "lagged network output error",
    "neural_ss": "neural state space",
}
"""Short description of each kind."""


def spelled(kind: str) -> str:
    """A kind as spelled on the command line, with hyphens."""
    return kind.replace("_", "-")
