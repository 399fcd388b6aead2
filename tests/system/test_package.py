"""The package as a whole: its public names, and what importing it costs."""

from __future__ import annotations

import ast
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

import licences
import sewfast


@pytest.mark.parametrize("name", sewfast.__all__)
def test_public_name_is_there(name: str) -> None:
    assert getattr(sewfast, name) is not None
    assert name in dir(sewfast)


def test_type_checkers_see_every_public_name() -> None:
    tree = ast.parse(Path(sewfast.__file__).read_text())
    imports = [n for n in ast.walk(tree) if isinstance(n, ast.ImportFrom) and n.level == 1]
    seen = {alias.name for node in imports for alias in node.names}
    assert seen == set(sewfast.__all__)


def test_unknown_name_is_an_attribute_error() -> None:
    with pytest.raises(AttributeError, match="no attribute 'idenfity'"):
        _ = sewfast.idenfity


def _loaded_by(statement: str) -> set[str]:
    code = f"{statement}\nimport sys\nprint(*sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    return set(done.stdout.split())


def test_import_loads_nothing_heavy() -> None:
    assert not _loaded_by("import sewfast") & {"numpy", "scipy", "matplotlib", "sewfast._core"}


def test_work_loads_no_extra() -> None:
    names = "identify, validate, tune, run, read, load_model, VirtualMachine"
    loaded = _loaded_by(f"from sewfast import {names}")
    assert not loaded & {"scipy", "matplotlib", "h5py", "pyarrow", "jinja2"}


def test_help_loads_no_arithmetic() -> None:
    loaded = _loaded_by("from sewfast.cli.parser import build_parser\nbuild_parser()")
    assert not loaded & {"numpy", "scipy", "matplotlib", "sewfast._core"}


def test_every_package_of_the_folder_is_shipped_and_checked() -> None:
    folder = licences.ROOT / "python"
    packages = {f.parent.name for f in folder.glob("*/__init__.py")}
    assert all((folder / package / "py.typed").is_file() for package in packages)
    text = (licences.ROOT / "pyproject.toml").read_text()
    for listed in re.findall(r"^(?:python-)?packages = (\[.*\])$", text, re.MULTILINE):
        assert set(ast.literal_eval(listed)) == packages
    _, _, covered = (licences.ROOT / "tests/support/coverage.ini").read_text().partition("_pkgs =")
    assert set(covered.partition("parallel")[0].split()) == packages


@pytest.mark.skipif(shutil.which("cargo") is None, reason="needs cargo")
def test_the_licences_of_what_is_linked_are_shipped() -> None:
    """Written anew where a crate came, went or changed: `make licences`."""
    assert licences.FILE.read_text(encoding="utf-8") == licences.written()
    text = (licences.ROOT / "pyproject.toml").read_text()
    assert f'"{licences.FILE.name}"' in re.search(r"license-files = .*", text)[0]  # type: ignore[index]
