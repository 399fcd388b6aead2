"""Plug-ins: commands and names that installed packages add, and what is said where one fails."""

from __future__ import annotations

import shutil
import sys
from importlib.metadata import EntryPoint
from pathlib import Path

import numpy as np
import pytest

import sewfast
import sewfast.link
import sewfast_boards
from cli import called
from installed import installed
from sewfast import plugins

CODE = """
from sewfast.cli.arguments import add_command

answer = 42

def add(commands):
    add_command(
        commands, "greet", lambda args: print("hello"), summary="a word", text="", examples=""
    )

def fails(commands):
    raise RuntimeError("no \\x1b[2J luck")
"""
COMMANDS, NAMES = "sewfast.commands", "sewfast.names"


def test_an_installed_package_adds_a_command(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    site, here = tmp_path / "site", tmp_path / "here"
    here.mkdir()
    installed(site, monkeypatch, CODE, "greet = drive_logger:add", COMMANDS)
    assert called(here, "greet").out == "hello\n"
    found = called(here, "--help")
    assert "greet     a word" in found.out
    assert found.err == ""
    assert "did you mean greet?" in called(here, "great", done=2).err


@pytest.mark.parametrize(
    ("point", "received"),
    [
        ("drive_logger:fails", "RuntimeError: no \\x1b[2J luck"),
        ("drive_logger:absent", "AttributeError: "),
        ("drive_logger:answer", "drive_logger:answer, a int"),
        ("nowhere:add", "ModuleNotFoundError: No module named 'nowhere'"),
    ],
)
def test_a_command_that_fails_is_named_and_the_others_work(
    point: str, received: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    points = f"greet = drive_logger:add\nworse = {point}"
    installed(tmp_path / "site", monkeypatch, CODE, points, COMMANDS)
    found = called(tmp_path, "--help")
    assert found.err.startswith(
        f"sewfast: command worse: expected a part of drive-logger that adds it, received {received}"
    )
    assert found.err.endswith("; update drive-logger and what it needs, or uninstall it\n")
    assert found.err.count("\n") == 1
    assert "greet     a word" in found.out
    # neither another plug-in nor a command of the core speaks of it
    assert called(tmp_path, "greet").err == ""
    assert called(tmp_path, "signals").err == ""


def test_the_core_s_commands_are_not_taken_over(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = called(tmp_path, "signals", "--help").out
    installed(tmp_path / "site", monkeypatch, CODE, "signals = drive_logger:fails", COMMANDS)
    assert called(tmp_path, "signals", "--help").out == before
    assert called(tmp_path, "--help").err == ""


def test_two_packages_for_one_command_are_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for package in ("a-logger", "b-logger"):
        point = f"greet = {package.replace('-', '_')}:add"
        installed(tmp_path / package, monkeypatch, CODE, point, COMMANDS, package)
    assert "received a-logger and b-logger; uninstall one" in called(tmp_path, "--help").err


def test_an_installed_package_adds_a_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    points = "answer = drive_logger:answer\nlogger = drive_logger\nidentify = drive_logger:answer"
    installed(tmp_path / "site", monkeypatch, CODE, f"{points}\nlost = nowhere", NAMES)
    for name in ("answer", "logger"):  # what is found is kept, and not by this test
        monkeypatch.setitem(vars(sewfast), name, None)
        monkeypatch.delitem(vars(sewfast), name)
    assert sewfast.answer == 42
    assert sewfast.logger is sys.modules["drive_logger"]
    assert callable(sewfast.identify)
    assert {"answer", "logger", "lost", "identify"} <= set(dir(sewfast))
    assert not hasattr(sewfast, "lost")
    with pytest.raises(AttributeError, match=r"sewfast\.lost: .*No module named 'nowhere'; update"):
        _ = sewfast.lost


def test_the_core_s_modules_are_not_looked_for_in_metadata(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(plugins, "points", lambda *_: pytest.fail("read all metadata"))
    for name in ("units", "storage", "_core", "__wrapped__"):
        monkeypatch.setitem(vars(sewfast), name, None)
        monkeypatch.delitem(vars(sewfast), name)
        assert not hasattr(sewfast, name)


def test_a_package_that_exits_is_named_too(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    code = CODE + "\nprint('chatter')\ndef exits(commands):\n    raise SystemExit('bye')\n"
    points = "greet = drive_logger:add\nworse = drive_logger:exits"
    installed(tmp_path / "site", monkeypatch, code, points, COMMANDS)
    found = called(tmp_path, "--help")
    assert "received SystemExit: bye" in found.err
    assert "chatter" in found.err
    assert "chatter" not in found.out
    assert "greet     a word" in found.out
    assert "chatter" not in called(tmp_path, "--version").out


def test_a_command_is_whole_or_not_there(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    code = CODE + "\ndef half(commands):\n    add(commands)\n    raise RuntimeError('half')\n"
    points = "greet = drive_logger:half\nother = drive_logger:add"
    installed(tmp_path / "site", monkeypatch, code, points, COMMANDS)
    assert "a word" not in called(tmp_path, "--help").out
    assert "received RuntimeError: half" in called(tmp_path, "greet", done=2).err
    assert "received no such command" in called(tmp_path, "other", done=2).err


@pytest.mark.parametrize("damage", [b"[sewfast.commands\n\xff", b"no line of this has a sign\n"])
def test_damaged_metadata_of_one_package_leave_the_others(
    damage: bytes, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    installed(tmp_path / "good", monkeypatch, CODE, "greet = drive_logger:add", COMMANDS)
    # an older one behind it on the path counts as little as where nothing is damaged
    older = tmp_path / "older"
    shutil.copytree(tmp_path / "good", older)
    monkeypatch.setattr(sys, "path", [*sys.path, str(older)])
    installed(tmp_path / "bad", monkeypatch, "", "", COMMANDS, "bad-one")
    (tmp_path / "bad" / "bad_one-1.0.dist-info" / "entry_points.txt").write_bytes(
        b"[sewfast.names]\n" + damage
    )
    with pytest.warns(UserWarning, match=r"bad_one.*install the package again"):
        assert [point.name for point in plugins.points(COMMANDS)].count("greet") == 1


def test_a_package_without_a_name_is_named_by_what_it_points_to(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    installed(tmp_path, monkeypatch, CODE, "worse = drive_logger:fails", COMMANDS)
    (tmp_path / "drive_logger-1.0.dist-info" / "METADATA").unlink()
    assert "a part of drive_logger:fails that adds it" in called(tmp_path, "--help").err


def test_the_wheel_s_own_are_not_taken_over(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    installed(tmp_path, monkeypatch, CODE, "fleet = drive_logger:answer", NAMES)
    monkeypatch.delitem(vars(sewfast), "fleet", raising=False)
    assert callable(sewfast.fleet)
    monkeypatch.delitem(vars(sewfast), "fleet", raising=False)


def test_a_folder_of_an_older_version_hides_no_plugin(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "studio" / "__pycache__").mkdir(parents=True)
    monkeypatch.setattr(sewfast, "__path__", [*sewfast.__path__, str(tmp_path)])
    monkeypatch.delitem(vars(sewfast), "studio", raising=False)
    assert sewfast.studio.__name__ == "sewfast_studio"


def test_names_that_come_on_first_use_are_listed() -> None:
    import sewfast_fleet

    assert {"Fleet", "fleet", "load_fleet"} <= {*dir(sewfast_fleet)}
    with pytest.raises(AttributeError, match="no attribute 'Flet'"):
        _ = sewfast_fleet.Flet


@pytest.fixture
def alone(monkeypatch: pytest.MonkeyPatch) -> None:
    """The core as it would be without any plug-in: none is named, none can be imported."""

    def none(group: str, name: str | None = None) -> tuple[EntryPoint, ...]:
        return ()

    monkeypatch.setattr(plugins, "points", none)
    for folder in Path(sewfast.__file__).parents[1].glob("sewfast_*"):
        for module in [m for m in sys.modules if m.split(".")[0] == folder.name]:
            monkeypatch.delitem(sys.modules, module)
        monkeypatch.setitem(sys.modules, folder.name, None)


@pytest.mark.usefixtures("alone")
def test_the_core_works_without_plugins(tmp_path: Path) -> None:
    found = called(tmp_path, "--help")
    assert "identify" in found.out
    assert "\n    studio" not in found.out
    assert found.err == ""
    refused = called(tmp_path, "studio", done=2).err
    assert "invalid choice: 'studio'" in refused
    assert "plug-ins of this installation are not registered" in refused
    with pytest.raises(AttributeError, match="not registered"):
        _ = sewfast.nothing
    random = np.random.default_rng(1)
    u = np.repeat(random.uniform(-5.0, 5.0, 30), 10)
    y = [0.0]
    for command in u[:-1]:
        y.append(0.9 * y[-1] + 20.0 * command + random.normal())
    sewfast.write_table(tmp_path / "run.csv", {"t": 0.01 * np.arange(300), "u": u, "y": y})
    columns = ("--input", "u", "--output", "y")
    called(tmp_path, "identify", "run.csv", *columns, "--model", "arx", "-o", "drive.json")
    called(tmp_path, "validate", "drive.json", "run.csv")
    assert not hasattr(sewfast, "nothing")
    assert "identify" in dir(sewfast)


@pytest.mark.parametrize("name", ["Deployment", "Fleet", "deploy", "fleet", "studio"])
def test_the_wheel_s_plugins_have_their_public_names(name: str) -> None:
    assert getattr(sewfast, name) is not None
    assert name in dir(sewfast)


@pytest.mark.parametrize("name", ["ODrive", "PolledBoard", "SimpleFOC"])
def test_the_link_has_the_boards_of_a_plugin(name: str) -> None:
    assert getattr(sewfast.link, name) is getattr(sewfast_boards, name)
    assert f"link.{name}" not in dir(sewfast)


def test_the_link_has_no_other_names() -> None:
    with pytest.raises(AttributeError, match=r"no attribute 'link\.Board'"):
        _ = sewfast.link.Board
    with pytest.raises(AttributeError, match="no attribute 'boards'"):
        _ = sewfast.link.boards
