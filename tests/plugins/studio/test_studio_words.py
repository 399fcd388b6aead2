"""Messages in the words of the page: fields where the package names options."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

import sewfast
import sewfast_studio
from sewfast_studio.words import FIELDS, PHRASES, advice, spoken

PAGE = (Path(sewfast_studio.__file__).parent / "page" / "index.html").read_text("utf-8")


def test_every_field_that_is_named_is_on_the_page() -> None:
    for name, label in FIELDS.values():
        before = rf'{label}[^<>]*(</[a-z]+>)? *<(input|select) id="{name}"'
        assert re.search(rf'{before}|<input id="{name}"[^>]*> {label}', PAGE), label
    for phrase in PHRASES.values():
        for label in re.findall("“(.*?)”", phrase):
            assert label in PAGE


@pytest.mark.parametrize(
    ("said", "shown", "field", "value"),
    [
        ("fit it slower, data.resample(0.01) (--resample 0.01)",
         "fit it slower, with “Sample time to work at” set to 0.01", "resample", "0.01"),
        ("take it out, data.mask(data.mark_outliers()) (--mask outliers)",
         "take it out, with “Leave out” set to outliers", "mask", "outliers"),
        ('hold it, data.fill_inputs("hold") (--hold-inputs), or take the pieces between, '
         'data.split_at_gaps(of="inputs") (--split-at-gaps)',
         "hold it, with “Hold missing inputs” set, or take the pieces between", "hold", True),
        ("name its columns (sewfast look FILE)", "name its columns", None, None),
        ("state it (Ts, --ts)", "state it (“Sample time of the file”)", None, None),
        ("record with an excitation (`sewfast signals`)", "record with an excitation", None, None),
        ("give both limits (--u-min, --u-max)", "give both limits", None, None),
        ("choose a name (--overwrite, overwrite=True)", "choose a name", None, None),
        ("longer: --watchdog 250 (watchdog=0.25)", "longer: “Watchdog” 250", None, None),
        ("lower the gains (by a half)", "lower the gains (by a half)", None, None),
    ],
)  # fmt: skip
def test_options_and_calls_become_fields(
    said: str, shown: str, field: str | None, value: object
) -> None:
    assert advice(said) == {"text": shown, "field": field, "value": value, "idle": False}


def test_what_is_advised_for_records_names_no_option() -> None:
    """Of records with each of the faults that `look` knows a remedy for."""
    random = np.random.default_rng(3)
    u = np.repeat(random.uniform(-1.0, 1.0, 40), 50)
    y = np.zeros(len(u))
    for k in range(1, len(u)):
        y[k] = 0.98 * y[k - 1] + u[k - 1]
    y += random.normal(0.0, 0.01, len(u))
    spike, dead, gap = y.copy(), y.copy(), u.copy()
    spike[700], dead[900:1200], gap[300:310] = 1e4, dead[900], np.nan
    late = np.roll(u, 4)
    for inputs, output in ((u, y), (u, spike), (u, dead), (gap, y), (late, y)):
        data = sewfast.Dataset.from_arrays(inputs, output, Ts=1e-3)
        for text in data.summary().advice:
            assert not re.search(r" --[a-z]|data\.|sewfast ", spoken(text)), spoken(text)
