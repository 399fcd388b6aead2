"""Formats that installed packages add by entry points: found, read, and named where they fail."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import sewfast
from installed import installed as as_installed
from refusals import refuses
from sewfast.errors import DataError, SettingError
from sewfast.readers import read_table

WORKING = """
import numpy as np

def read(path):
    return {"u [V]": np.loadtxt(path)[:, 0], "speed [RPM]": np.loadtxt(path)[:, 1]}

def stated(path):
    from sewfast.readers import Table
    u, y = np.loadtxt(path).T
    return Table(path.with_name("another"), {"u": u, "speed": y}, {"u": "V"}, Ts=0.01)

def fails(path):
    raise RuntimeError("no \\x1b[2J header")

def text(path):
    return path.read_text()

def empty(path):
    return {}

def refuses(path):
    from sewfast.errors import DataError
    raise DataError(name="row 3", expected="two numbers", received="one")

number = 5
"""
ROWS = np.column_stack([np.arange(40.0) % 7, np.arange(40.0) ** 2])


def installed(
    folder: Path, monkeypatch: pytest.MonkeyPatch, points: str, package: str = "drive-logger"
) -> None:
    as_installed(folder, monkeypatch, WORKING, points, "sewfast.readers", package)


def written(path: Path) -> Path:
    np.savetxt(path, ROWS)
    return path


def test_an_installed_package_adds_a_format(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = written(tmp_path / "run.DLOG")
    with pytest.raises(DataError):
        # without the package it is a text file without a header
        sewfast.read(file, inputs="u", output="speed", Ts=0.01)
    installed(tmp_path / "site", monkeypatch, "dlog = drive_logger:read")
    table = read_table(file)
    assert (table.path, table.names, table.unit("u")) == (file, ("u", "speed"), "V")
    np.testing.assert_array_equal(table["speed"], ROWS[:, 1])
    data = sewfast.read(file, inputs="u", output="speed", Ts=0.01)
    np.testing.assert_array_equal(data.experiments[0].y, ROWS[:, 1])


def test_a_table_keeps_what_it_states(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    installed(tmp_path / "site", monkeypatch, "dlog = drive_logger:stated")
    file = written(tmp_path / "run.dlog")
    data = sewfast.read(file, inputs="u", output="speed")
    assert (data.Ts, data.input_units) == (0.01, ("V",))
    assert read_table(file).path == file


def test_the_command_line_reads_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    installed(tmp_path / "site", monkeypatch, "dlog = drive_logger:stated")
    written(tmp_path / "run.dlog")
    done = subprocess.run(
        [sys.executable, "-m", "sewfast", "look", "run.dlog", "--input", "u", "--output", "speed"],
        cwd=tmp_path, capture_output=True, text=True, check=False,
        env={**os.environ, "PYTHONPATH": os.pathsep.join([str(tmp_path / "site"), *sys.path])},
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert "run.dlog" in done.stdout
    assert "40" in done.stdout


@pytest.mark.parametrize("ending", ["csv", "txt", "npz", "mcap"])
def test_own_formats_are_not_taken_over(
    ending: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    installed(tmp_path / "site", monkeypatch, f"{ending} = drive_logger:fails")
    file = tmp_path / f"run.{ending}"
    if ending == "npz":
        np.savez(file, u=ROWS[:, 0])
    elif ending == "mcap":
        machine = sewfast.VirtualMachine()
        sewfast.record(machine, ROWS[:, 0], file=file)
    else:
        file.write_text("u,y\n" + "\n".join(f"{a},{b}" for a, b in ROWS), encoding="utf-8")
    np.testing.assert_array_equal(read_table(file)["u"], ROWS[:, 0])


@pytest.mark.parametrize(
    ("function", "kind", "fields"),
    [
        ("fails", DataError, {"received": r"RuntimeError: no \\x1b\[2J header"}),
        ("text", DataError, {"expected": "a table", "received": "str"}),
        ("number", SettingError, {"received": "a int|an int", "remedy": "drive-logger"}),
        ("absent", SettingError, {"received": "AttributeError"}),
    ],
)
def test_what_fails_names_its_package(
    function: str,
    kind: type[sewfast.SewfastError],
    fields: dict[str, str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    installed(tmp_path / "site", monkeypatch, f"dlog = drive_logger:{function}")
    with refuses(kind, name=r"run\.dlog", **fields):
        read_table(written(tmp_path / "run.dlog"))


def test_its_own_refusals_and_empty_tables_are_ours(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    installed(
        tmp_path / "site", monkeypatch, "dlog = drive_logger:refuses\nvoid = drive_logger:empty"
    )
    with refuses(DataError, name="row 3", received="one"):
        read_table(written(tmp_path / "run.dlog"))
    with pytest.raises(DataError, match="rows of numbers"):
        read_table(written(tmp_path / "run.void"))


def test_two_packages_for_one_ending_are_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    installed(tmp_path / "a", monkeypatch, "dlog = drive_logger:read")
    installed(tmp_path / "b", monkeypatch, "dlog = other_logger:read", "other-logger")
    with refuses(SettingError, received="drive-logger and other-logger"):
        read_table(written(tmp_path / "run.dlog"))
