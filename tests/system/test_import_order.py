"""The order of the package: a unit imports what stands before it, never what stands behind it.

A unit is a module or a folder directly below `sewfast`. Every import counts, those inside functions
and those for types too: they are the ones that hide a knot.
"""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest

import sewfast

ORDER = """
    errors plugins kinds units arrays written storage tables plotting progress threads speed signals
    recordfile dataset readers benchmarks gains machine live recording
    causes equilibrium dynamic_model validation comparison evidence models
    motorfit identification
    rules control moves tuning trust analysis frequency
    link greybox report commissioning cli __main__
"""

LEFT: frozenset[tuple[str, str]] = frozenset()
"""Imports (module, unit) that still point up. Take out what is mended; nothing is put in."""

BELOW_ALL = ("_core", "__version__")
"""The compiled core and the package's version, which is the core's."""

ROOT = Path(sewfast.__file__).parent
MODULES = {
    ".".join(f.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__"): f
    for f in ROOT.rglob("*.py")
    if f != ROOT / "__init__.py"
}


def _imported(module: str) -> Iterator[str]:
    """Modules of the package that a module imports anywhere; `` where it imports the package."""
    file = MODULES[module]
    package = module.split(".") if file.name == "__init__.py" else module.split(".")[:-1]
    for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            names = [alias.name.split(".") for alias in node.names]
            yield from (".".join(n[1:]) for n in names if n[0] == "sewfast")
        elif isinstance(node, ast.ImportFrom):
            path = (node.module or "").split(".") if node.module else []
            if node.level:
                path = [*package[: len(package) - node.level + 1], *path]
            elif path[:1] == ["sewfast"]:
                path = path[1:]
            else:
                continue
            for alias in node.names:
                whole = ".".join([*path, alias.name])
                yield whole if whole in MODULES or not path else ".".join(path)


@cache
def _arrows() -> frozenset[tuple[str, str]]:
    """Every import from one unit into another: (module, unit)."""
    found = {(m, target.split(".")[0]) for m in MODULES for target in _imported(m)}
    return frozenset((m, unit) for m, unit in found if unit not in (m.split(".")[0], *BELOW_ALL))


def test_every_unit_has_its_place() -> None:
    assert sorted(ORDER.split()) == sorted({m.split(".")[0] for m in MODULES})


@pytest.mark.slow("a change of structure is seen at once")
def test_imports_point_down() -> None:
    place = {unit: i for i, unit in enumerate(ORDER.split())}
    up = {(m, u) for m, u in _arrows() if u not in place or place[u] > place[m.split(".")[0]]}
    assert up - LEFT == set(), "move what is imported down, or hand the value in"
    assert LEFT - up == set(), "mended: take it out of LEFT"


# --- Plug-ins: packages beside `sewfast` in the same wheel ----------------------------------------


BESIDE = {f.parent.name: f.parent for f in ROOT.parent.glob("sewfast_*/__init__.py")}


def _packages_named(folder: Path) -> set[tuple[str, str]]:
    """(file, package beside the core that its text names), in a folder.

    The text has more than the imports at any depth: also names for `import_module`, and programs
    for other processes.
    """
    name = re.compile(rf"\b({'|'.join(BESIDE)})\b")
    files = [file for file in folder.rglob("*.py") if "__pycache__" not in file.parts]
    return {(f.name, n) for f in files for n in name.findall(f.read_text(encoding="utf-8"))}


def test_the_core_names_no_plugin() -> None:
    assert len(BESIDE) >= 4
    assert _packages_named(ROOT) == set()


@pytest.mark.parametrize("plugin", sorted(BESIDE))
def test_a_plugin_names_no_other(plugin: str) -> None:
    assert {name for _, name in _packages_named(BESIDE[plugin])} <= {plugin}
