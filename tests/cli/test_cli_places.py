"""Places that cannot be written to, and names that only a shell's quotes hold together."""

from __future__ import annotations

import errno
import os
import shlex
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import sewfast as api
from cli import call_refused as refused
from cli import called as sewfast
from sewfast._core import DeviceServer
from sewfast.cli.output import suggested
from sewfast.link import virtual

pytestmark = pytest.mark.skipif(os.name != "posix", reason="pipes and names of POSIX")

WRITING = {
    "record": ("record", "--on", "virtual", "--signal", "short.csv", "-o", "PLACE.csv"),
    "mcap": ("record", "--on", "virtual", "--signal", "short.csv", "-o", "PLACE.mcap"),
    "gains": ("gains", "--K", "1", "--T", ".1", "--L", ".02", "-o", "PLACE.json"),
    "fleet": ("fleet", ".", "--workers", "0", "-o", "PLACE.csv"),
    "look": ("look", "short.csv", "--input", "u", "--output", "t", "--plot", "PLACE.png"),
    "trace": ("device", "--tcp", "--for", ".1", "--trace", "PLACE.jsonl"),
}
"""A command for each way to write a file."""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    t = 0.001 * np.arange(100)
    api.write_table(tmp_path / "short.csv", {"t": t, "u": 5 * np.sin(60 * t)}, units={"u": "V"})
    return tmp_path


def named(command: str, place: str) -> list[str]:
    return [word.replace("PLACE", place) for word in WRITING[command]]


@pytest.mark.parametrize("command", WRITING)
@pytest.mark.parametrize("place", ["pipe", "long", "beneath", "device"])
def test_what_cannot_be_a_file_is_refused(folder: Path, command: str, place: str) -> None:
    words = named(command, {"long": "n" * 300, "beneath": "short.csv/n"}.get(place, place))
    made = folder / words[-1]
    if place == "pipe":
        os.mkfifo(made)
    if place == "device":
        if command == "trace" or not Path("/dev/full").exists():
            pytest.skip("a log may go to a device")
        made.symlink_to("/dev/full")
    message = refused(folder, *words)
    assert len(message.splitlines()) == 1
    assert ": expected " in message
    assert "; " in message
    assert place != "pipe" or made.is_fifo()
    assert place != "device" or made.is_symlink()


@pytest.mark.parametrize("command", [*WRITING, "init"])
def test_a_full_disk_is_told_with_a_remedy_and_nothing_is_left(
    folder: Path, monkeypatch: pytest.MonkeyPatch, command: str
) -> None:
    def full(descriptor: int) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "fsync", full)
    words = ["init", "new"] if command == "init" else named(command, "n")
    assert "free some space or write elsewhere" in refused(folder, *words)
    assert [path.name for path in folder.iterdir()] == ["short.csv"]


@pytest.mark.parametrize("name", ["line\nbreak", "b\udcff"])
def test_any_name_of_a_file_is_written_and_told(folder: Path, name: str) -> None:
    sewfast(folder, "gains", "--K", "1", "--T", ".1", "--L", ".02", "-o", f"{name}.json", "--json")
    assert (folder / f"{name}.json").is_file()
    said = refused(folder, "gains", "--K", "1", "--T", ".1", "--L", ".02", "-o", f"{name}.txt")
    assert len(said.splitlines()) == 1


def test_a_link_to_itself_is_refused(folder: Path) -> None:
    (folder / "n.json").symlink_to("n.json")
    for words in named("gains", "n"), ["init", "n.json"]:
        assert "expected a file that can be written" in refused(folder, *words)
    assert "choose another name" in refused(folder, *named("gains", "n"))
    assert (folder / "n.json").is_symlink()


def test_who_reads_a_trace_from_a_pipe_reads_to_its_end(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Reading ends once nobody has the pipe open for writing."""
    os.mkfifo(pipe := tmp_path / "pipe")
    reader = os.open(pipe, os.O_RDONLY | os.O_NONBLOCK)

    def served(*args: Any, **kwargs: Any) -> Any:
        with pytest.raises(BlockingIOError):  # open, and empty
            os.read(reader, 1)
        return DeviceServer(*args, **kwargs)

    monkeypatch.setattr(virtual, "DeviceServer", served)
    with virtual.VirtualDevice(endpoint="tcp", trace=pipe):
        pass
    assert os.read(reader, 1) == b""
    os.close(reader)


def test_a_model_that_looks_like_an_option_is_suggested_as_a_file() -> None:
    for name in ("-m.json", "a b.json", "it's.json", "a\nb.json"):
        said = shlex.split(suggested("run", Path(name)))
        assert os.path.normpath(said[-1]) == name
        assert not said[-1].startswith("-")
