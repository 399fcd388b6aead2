"""Draws assets/architecture.svg: the package's units in their order, and what each imports.

python docs/architecture.py        (tests/system/test_architecture.py says when it is out of date)
"""

from __future__ import annotations

import importlib.util
from functools import cache
from pathlib import Path
from types import ModuleType

ROOT = Path(__file__).resolve().parents[1]
PICTURE = ROOT / "docs" / "assets" / "architecture.svg"

BOX, HIGH, GAP, ROW, LEFT, TOP = 112, 28, 12, 92, 20, 20
STYLE = (
    "text{font:13px sans-serif;fill:#1b1f24;text-anchor:middle}"
    "rect{fill:#eef3fa;stroke:#4a6fa5}.core{fill:#f6efe2;stroke:#a07b3a}"
    "path{fill:none;stroke:#4a6fa5;stroke-opacity:.38}"
)
WIDEST = 9
"""Boxes in a row; a longer one is broken."""


@cache
def order() -> ModuleType:
    """The test that holds the order of the package, which reads the imports."""
    (file,) = (ROOT / "tests").rglob("test_import_order.py")
    spec = importlib.util.spec_from_file_location("import_order", file)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def rows() -> list[list[str]]:
    """The units from the foundation up, as the order has them in lines."""
    lines = [line.split() for line in order().ORDER.splitlines() if line.strip()]
    return [line[i : i + WIDEST] for line in lines for i in range(0, len(line), WIDEST)]


def arrows() -> set[tuple[str, str]]:
    """(unit, unit that it imports), without those that follow from others."""
    found = {(m.split(".")[0], unit) for m, unit in order()._arrows()}
    beneath: dict[str, set[str]] = {}
    for unit in order().ORDER.split():
        direct = {b for a, b in found if a == unit}
        beneath[unit] = direct.union(*(beneath.get(b, set()) for b in direct))
    return {
        (a, b)
        for a, b in found
        if not any(b in beneath[other] for one, other in found if one == a and other != b)
    }


def drawn() -> str:
    """The picture as SVG; the foundation is at the bottom, as in the order of building."""
    table = rows()
    width = 2 * LEFT + max(map(len, table)) * (BOX + GAP) - GAP
    height = 2 * TOP + len(table) * ROW + HIGH
    place = {}
    for level, units in enumerate(table):
        start = (width - len(units) * (BOX + GAP) + GAP) / 2
        y = height - TOP - HIGH - (level + 1) * ROW
        place.update({unit: (start + i * (BOX + GAP), y) for i, unit in enumerate(units)})
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width:g} {height:g}" '
        f'width="{width:g}" role="img">',
        "<title>What imports what in the package sewfast</title>",
        f"<style>{STYLE}</style>",
        f'<rect width="{width:g}" height="{height:g}" style="fill:#fff;stroke:none"/>',
    ]
    for upper, lower in sorted(arrows()):
        (x, y), (u, v) = place[upper], place[lower]
        x, u, y = x + BOX / 2, u + BOX / 2, y + HIGH
        if v < y:  # side by side, the line goes around below
            parts.append(f'<path d="M{x:g} {y:g}C{x:g} {y + 26:g} {u:g} {y + 26:g} {u:g} {y:g}"/>')
        else:
            middle = (y + v) / 2
            parts.append(f'<path d="M{x:g} {y:g}C{x:g} {middle:g} {u:g} {middle:g} {u:g} {v:g}"/>')
    for unit, (x, y) in place.items():
        parts.append(_box(x, y, BOX, unit, ""))
    core = "_core: the compiled core (rust/python, link, core, control)"
    parts.append(_box(LEFT, height - TOP - HIGH, width - 2 * LEFT, core, ' class="core"'))
    return "\n".join([*parts, "</svg>", ""])


def _box(x: float, y: float, wide: float, text: str, kind: str) -> str:
    middle = f'x="{x + wide / 2:g}" y="{y + 19:g}"'
    return (
        f'<rect{kind} x="{x:g}" y="{y:g}" width="{wide:g}" height="{HIGH}" rx="5"/>'
        f"<text {middle}>{text}</text>"
    )


if __name__ == "__main__":
    PICTURE.write_text(drawn(), encoding="utf-8")
