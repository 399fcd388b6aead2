"""The page: figures, tables and text of a result folder in one HTML document."""

from __future__ import annotations

from collections.abc import Mapping
from importlib import resources
from typing import Any

from ..plotting import milliseconds, percent, rpm, significant, style
from . import analysed, figures
from .artefacts import Artefacts
from .tables import (
    control_table,
    gains_table,
    goals,
    identification_tables,
    readings_table,
    speed_table,
)


def render(artefacts: Artefacts) -> str:
    """The report as one self-contained HTML document."""
    return fill("page.html", _context(artefacts))


def fill(template: str, context: Mapping[str, Any]) -> str:
    """A template with values in it."""
    from jinja2 import Environment, FunctionLoader, StrictUndefined

    environment = Environment(
        loader=FunctionLoader(_source),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters.update(
        significant=significant, rpm=rpm, percent=percent, milliseconds=milliseconds
    )
    return environment.get_template(template).render(context)


def _source(name: str) -> str:
    return (resources.files(__package__) / "templates" / name).read_text(encoding="utf-8")


def _context(artefacts: Artefacts) -> dict[str, Any]:
    numbers = {
        "goals": goals(artefacts),
        "speed": speed_table(artefacts),
        "scores": identification_tables(artefacts),
        "gains": gains_table(artefacts),
        "control": control_table(artefacts),
        "readings": readings_table(artefacts),
        "number": artefacts.number,
        "value": artefacts.value,
        # results of before the link have none
        "link": artefacts.results.get("link"),
        # nor have those of before the report card
        "check": artefacts.results.get("check"),
        "analysed": analysed.section(artefacts.folder)
        or analysed.section(artefacts.folder / "commissioning"),
        # nor those of before commissioning
        "commissioning": artefacts.results.get("commissioning"),
    }
    # drawn last: where a number is missing nothing is drawn in vain
    with style():
        return numbers | {
            "recorded": figures.recorded_pictures(artefacts),
            "scaled": figures.scaled_pictures(artefacts),
            "predicted": figures.prediction_pictures(artefacts),
            "trust": figures.trust_pictures(artefacts),
            "arx": figures.arx_picture(artefacts),
            "loops": figures.loop_pictures(artefacts),
            "paper_gains": figures.paper_gain_pictures(artefacts),
        }
