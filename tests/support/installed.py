"""Packages as an installer leaves them: a module and its entry points on the path."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest


def installed(
    folder: Path,
    monkeypatch: pytest.MonkeyPatch,
    code: str,
    points: str,
    group: str,
    package: str = "drive-logger",
) -> None:
    """A package of one module with this code, and with these lines in a group of entry points."""
    module = package.replace("-", "_")
    metadata = folder / f"{module}-1.0.dist-info"
    metadata.mkdir(parents=True)
    (folder / f"{module}.py").write_text(code, encoding="utf-8")
    (metadata / "METADATA").write_text(
        f"Metadata-Version: 2.1\nName: {package}\nVersion: 1.0\n", encoding="utf-8"
    )
    (metadata / "entry_points.txt").write_text(f"[{group}]\n{points}\n", encoding="utf-8")
    monkeypatch.syspath_prepend(folder)
    # what the test imports of it is gone after the test
    monkeypatch.setitem(sys.modules, module, None)  # type: ignore[arg-type]
    monkeypatch.delitem(sys.modules, module)
