"""`_repr_html_`: what a notebook shows of a result."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from html.parser import HTMLParser
from typing import Any

import numpy as np
import pytest

import sewfast
from plants import bent_data
from sewfast import Dataset, Model, VirtualMachine


class Cells(HTMLParser):
    """Tags that are open, and every text; a tag that closes another one fails."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.tags: set[str] = set()
        self.texts: list[str] = []
        self.feed(text)
        assert not self.open

    def handle_starttag(self, tag: str, attrs: Any) -> None:
        self.tags.add(tag)
        if tag != "br":
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.texts.append(data)


HOSTILE = "<script>alert('u')</script> & \"y\""


@cache
def model() -> Model:
    e = bent_data(600, noise=0.05).experiments[0]
    names = {"input_names": HOSTILE, "output_name": f"y{HOSTILE}", "name": f"run{HOSTILE}"}
    return sewfast.identify(Dataset.from_arrays(e.u, e.y, 0.01, **names), model="oe")


@cache
def results() -> dict[str, Any]:
    e = bent_data(300, noise=0.05).experiments[0]
    held = Dataset.from_arrays(
        e.u, e.y, 0.01, input_names=HOSTILE, output_name=f"y{HOSTILE}", name=HOSTILE
    )
    run = sewfast.run(
        sewfast.paper_controller(), VirtualMachine(), 500.0 * np.ones(200), name=HOSTILE
    )
    both = Dataset.concat([held, held])
    tuned = sewfast.tune(model(), counts_per_rev=None, evaluations=5, threads=1)
    front = sewfast.pareto(model(), start=tuned.controller, evaluations=20, size=4, threads=1)
    return {
        "model": model(), "data": held, "summary": held.summary(),
        "diagnosis": sewfast.diagnose(Dataset.from_arrays(
            np.repeat([0.0, 1.0] * 10, 30), np.arange(600.0), 0.01, input_names=HOSTILE
        )),
        "validation": sewfast.validate(model(), both),
        "card": sewfast.check(model(), held), "run": run, "tuning": tuned, "front": front,
        "controller": replace(tuned.controller, notes=HOSTILE),
    }  # fmt: skip


@pytest.mark.parametrize(
    "name",
    [
        "model",
        "data",
        "summary",
        "diagnosis",
        "validation",
        "card",
        "run",
        "tuning",
        "front",
        "controller",
    ],
)
def test_a_notebook_shows_a_table_and_runs_nothing(name: str) -> None:
    found = Cells(results()[name]._repr_html_())
    assert {"table", "caption", "th", "td"} <= found.tags
    assert "script" not in found.tags
    assert len(found.texts) > 8
    if name not in ("tuning", "front"):
        assert any(HOSTILE in text for text in found.texts)


def test_the_numbers_are_those_of_the_text() -> None:
    score = sewfast.validate(model(), model_data())
    assert f"{score.simulation.fit_percent:.2f}" in score._repr_html_()
    assert score.verdict.split(":")[0] in score._repr_html_()


def model_data() -> Dataset:
    e = bent_data(300, noise=0.05).experiments[0]
    return Dataset.from_arrays(e.u, e.y, 0.01, input_names=HOSTILE, output_name=f"y{HOSTILE}")
