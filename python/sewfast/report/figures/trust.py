"""The report card's figures: drawn when the card was made, read as they are."""

from __future__ import annotations

from ..artefacts import Artefacts
from ..canvas import Picture

CAPTIONS = {
    "residuals": (
        "What is left in the residual",
        "Correlations of the free-run residual with its past, with past inputs, their squares and "
        "cubes, powers of the computed output, squares and products; grey bands hold 99 % of the "
        "single correlations of a perfect model",
        "One verdict per panel judges all its lags together. In 20,000 samples small dependences "
        "are certain: the table says what each is worth.",
    ),
    "bands": (
        "Where samples are to be expected",
        "Measured speed in the 95 % band about the free run, and the error in the same band",
        "The band holds the residual's spread and the parameters' uncertainty, both from the "
        "training data alone.",
    ),
    "bode": (
        "Small signals over the operating range",
        "Gain and phase of the network linearised about constant commands from low to high",
        "Where the curves part the plant changes with the operating point.",
    ),
    "poles": (
        "Poles, steady output, gain and time constant over the command",
        "Poles in the unit circle; steady speed, steady gain and slowest time constant over the "
        "constant command",
        "All poles lie inside the circle where the model is stable.",
    ),
    "region": (
        "Is the model used where it has been trained?",
        "Distance of every sample from the training region; values above 1 lie outside",
        "Outside the green area no training sample was like it.",
    ),
}
"""Title, what a reader sees, what to look at."""


def trust_pictures(artefacts: Artefacts) -> list[Picture]:
    """The figures of the report card that the folder holds."""
    letters = iter("CDEFG")
    return [
        Picture(f"trust-{name}", f"Check {next(letters)}", *CAPTIONS[name], svg=svg)
        for name, svg in artefacts.drawn.items()
    ]
