"""The picture of docs/ARCHITECTURE.md is that of the imports, and the page names what there is."""

from __future__ import annotations

import re
import sys
import xml.etree.ElementTree as ET
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT / "docs"))
architecture = pytest.importorskip("architecture")

PAGE = (ROOT / "docs" / "ARCHITECTURE.md").read_text(encoding="utf-8")


@pytest.mark.slow("a change of structure is seen at once")
def test_the_picture_is_up_to_date() -> None:
    drawn = architecture.drawn()
    assert architecture.PICTURE.read_text(encoding="utf-8") == drawn, (
        "draw it anew: python docs/architecture.py"
    )
    assert f"assets/{architecture.PICTURE.name}" in PAGE


def test_it_shows_every_unit_and_every_import() -> None:
    texts = {e.text for e in ET.fromstring(architecture.drawn()).iter() if e.tag.endswith("text")}
    assert set(architecture.order().ORDER.split()) <= texts
    reached = architecture.arrows()
    beneath: dict[str, set[str]] = {}
    for unit in architecture.order().ORDER.split():
        direct = {b for a, b in reached if a == unit}
        beneath[unit] = direct.union(*(beneath[b] for b in direct))
    for module, unit in architecture.order()._arrows():
        assert unit in beneath[module.split(".")[0]]
    # none that follows from others
    for a, b in reached:
        assert not any(b in beneath[c] for one, c in reached if one == a and c != b)


NAMED = sorted(set(re.findall(r"`((?:python|rust|tests|docs|benches|examples)/[\w./-]+)`", PAGE)))


@pytest.mark.parametrize("path", NAMED)
def test_what_the_page_names_is_there(path: str) -> None:
    assert (ROOT / path).exists()


def test_the_page_is_one_page() -> None:
    assert len(PAGE.splitlines()) < 110
    assert len(NAMED) > 10
