"""A project folder, the demo's, and studios that serve them."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

import sewfast
from fitted import made
from sewfast_studio import Project, Studio, make_demo
from studio_page import EVIL, Page


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    excitation = sewfast.signals.excitation("saturating")[:6000]
    found = sewfast.record(sewfast.VirtualMachine(seed=1), excitation)
    place = tmp_path / "machine"
    place.mkdir()
    t = np.arange(len(found)) * found.Ts
    for name in ("run.csv", "run2.csv"):
        columns = {"t": t, "u": found.u, "y": found.y, EVIL: found.y}
        sewfast.write_table(place / name, columns)
    return place


@pytest.fixture
def studio(folder: Path) -> Iterator[Studio]:
    with Studio(Project(folder)) as running:
        yield running


@pytest.fixture
def page(studio: Studio) -> Iterator[Page]:
    with Page(studio) as found:
        yield found


@pytest.fixture(scope="session")
def demo() -> Path:
    return made(make_demo)


@pytest.fixture
def tuned(demo: Path, tmp_path: Path) -> Iterator[Studio]:
    place = tmp_path / "machine"
    place.mkdir()
    shutil.copy(demo / "drive.json", place)
    with Studio(Project(place, demo=True)) as running:
        yield running
