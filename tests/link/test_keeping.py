"""What a drive did is never lost: not to a second run, not to a start that is refused."""

from __future__ import annotations

import errno
import os
import struct
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from link_device import ARM, START, ScriptedDevice
from moments import once_on
from refusals import refuses
from sewfast import VirtualMachine
from sewfast.cli import main
from sewfast.control import Controller, Gains
from sewfast.control.loop import run
from sewfast.control.record import record
from sewfast.errors import DataError, LinkError, SettingError
from sewfast.link import Drive, VirtualDevice, connect
from sewfast.recordfile import Header, RecordWriter, export, read_recording
from sewfast.recordfile.filing import Sink
from sewfast_demo import run_demo

U = np.round(3.0 * np.sin(np.arange(300) / 20.0), 3)
CONTROLLER = Controller(Gains.standard(0.005, 0.1), u_min=-10.0, u_max=10.0)
REAL = 0b000111
"""Capabilities of a device that is no computed one."""


@pytest.fixture
def device(tmp_path: Path) -> Iterator[ScriptedDevice]:
    folder = tmp_path / "port"
    folder.mkdir()
    with ScriptedDevice(folder, capabilities=REAL) as served:
        yield served


@pytest.fixture
def drive(device: ScriptedDevice) -> Iterator[Drive]:
    with connect(device.url, watchdog=5.0) as connected:
        connected.set_limits(volt=10.0)
        yield connected


def recording(path: Path, **device: object) -> bytes:
    """A recording of some device, and its bytes."""
    header = Header("run", 0.001, {"u": "V", "counts": "1"}, 5, 1572.0, device)
    with RecordWriter(path, header) as writer:
        writer.samples(0, {"u": np.ones(5), "counts": np.arange(5)})
    return path.read_bytes()


def press(path: Path) -> bytes:
    return recording(path, kind="drive", name="press 7", capabilities=REAL)


def of_virtual(path: Path) -> bytes:
    return recording(path, kind="virtual")


@pytest.fixture
def sewfast(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> Callable[..., str]:
    """A command in `tmp_path`, which must be done, or refused with what is returned."""
    monkeypatch.chdir(tmp_path)

    def run_command(*arguments: object, refused: bool = False) -> str:
        code = main([*map(str, arguments)])
        said = capsys.readouterr().err
        assert code == (2 if refused else 0), said
        return said

    return run_command


def kinds(device: ScriptedDevice) -> set[int]:
    return {kind for kind, _ in device.executed}


# --- a drive ------------------------------------------------------------------------------------


def test_a_recording_of_a_drive_is_kept_unless_it_may_go(
    device: ScriptedDevice, drive: Drive, tmp_path: Path
) -> None:
    path = tmp_path / "run.mcap"
    record(drive, U, file=path)
    before = path.read_bytes()
    device.executed.clear()
    with pytest.raises(SettingError, match=r"run\.mcap: .*'script'.*kept.*overwrite"):
        record(drive, U, file=path)
    with pytest.raises(SettingError, match="kept"):
        run(CONTROLLER, drive, np.full(100, 50.0), file=path)
    assert path.read_bytes() == before
    assert not kinds(device) & {ARM, START}
    record(drive, 0.5 * U, file=path, overwrite=True)
    assert read_recording(path).columns["u"].max() < 2.0


@pytest.mark.parametrize("made", [None, of_virtual, press])
def test_a_start_that_is_refused_leaves_everything_as_it_was(
    device: ScriptedDevice, drive: Drive, tmp_path: Path, made: object
) -> None:
    path = tmp_path / "run.mcap"
    before = made(path) if callable(made) else None
    device._start = lambda body: b"\x06" + struct.pack("<I", 0)  # type: ignore[method-assign]
    with pytest.raises(LinkError, match="refusal") as caught:
        record(drive, U, file=path, overwrite=True)
    assert "what came" not in str(caught.value)
    assert ARM in kinds(device)
    assert (path.read_bytes() if path.exists() else None) == before
    assert {p.name for p in tmp_path.iterdir()} <= {"port", "run.mcap"}


def test_what_happened_on_the_way_to_the_start_is_in_the_file(drive: Drive, tmp_path: Path) -> None:
    record(drive, U, file=tmp_path / "run.mcap")
    told = [event["kind"] for event in read_recording(tmp_path / "run.mcap").events]
    assert told[-1] == "finished"
    assert "started" in told


@pytest.mark.parametrize("name", ["run.csv", "run", "run.txt"])
def test_a_recording_has_its_ending(drive: Drive, tmp_path: Path, name: str) -> None:
    with refuses(SettingError, expected=r"ends in \.mcap"):
        record(drive, U, file=tmp_path / name)
    assert not (tmp_path / name).exists()


def test_commands_on_a_drive_keep_the_table_too(
    tmp_path: Path, sewfast: Callable[..., str]
) -> None:
    with VirtualDevice(fast=True) as device:
        command = ("record", "--on", device.port, "--signal", "step", "-o")
        press(tmp_path / "a.mcap")
        assert "press 7" in sewfast(*command, "a.mcap", refused=True)
        assert "press 7" in sewfast(*command, "a.csv", refused=True)
        (tmp_path / "b.csv").write_text("t,u\n0,1\n")
        assert "b.csv: expected a free name" in sewfast(*command, "b.csv", refused=True)
        assert "on" not in [entry["event"] for entry in device.trace()]
        sewfast(*command, "b.csv", "--overwrite")
        # a table beside its recording was made from it, and this one from a virtual machine
        sewfast(*command, "b.csv")
    assert len(read_recording(tmp_path / "b.mcap")) == 3000


def test_a_loop_on_the_host_keeps_what_is_there(
    tmp_path: Path, sewfast: Callable[..., str]
) -> None:
    CONTROLLER.save(tmp_path / "c.json")
    (tmp_path / "run.csv").write_text("t,u\n0,1\n")
    command = ("run", "c.json", "--on", "socket://127.0.0.1:9", "--reference", "trapezoid")
    said = sewfast(*command, "--host-loop", 20, "-o", "run.csv", refused=True)
    assert "run.csv: expected a free name" in said


# --- what is computed ---------------------------------------------------------------------------


def test_commands_that_compute_can_be_repeated(tmp_path: Path, sewfast: Callable[..., str]) -> None:
    CONTROLLER.save(tmp_path / "c.json")
    for _ in range(2):
        for name in ("a.mcap", "a.csv"):
            sewfast("record", "--on", "virtual", "--signal", "step", "-o", name)
        sewfast("export", "a.mcap", "-o", "b.csv")
        sewfast("export", "a.mcap", "-o", "b.mcap")
        given = ("--on", "virtual", "--reference", "trapezoid", "-o", "run.csv")
        sewfast("run", "c.json", *given)


def test_none_of_them_replaces_what_a_drive_did(
    tmp_path: Path, sewfast: Callable[..., str]
) -> None:
    press(tmp_path / "press.mcap")
    of_virtual(tmp_path / "a.mcap")
    command = ("record", "--on", "virtual", "--signal", "step", "-o", "press.mcap")
    assert "press 7" in sewfast(*command, refused=True)
    assert "press 7" in sewfast("export", "a.mcap", "-o", "press.mcap", refused=True)
    with pytest.raises(SettingError, match="kept"):
        record(VirtualMachine(), U, file=tmp_path / "press.mcap")
    with pytest.raises(SettingError, match="kept"):
        record(VirtualMachine(), U).save(tmp_path / "press.mcap")
    sewfast("export", "a.mcap", "-o", "press.mcap", "--overwrite")
    assert read_recording(tmp_path / "press.mcap").header.device["kind"] == "virtual"


def test_an_export_replaces_an_earlier_one_of_the_same(tmp_path: Path) -> None:
    press(tmp_path / "press.mcap")
    for _ in range(2):
        found = export(tmp_path / "press.mcap", tmp_path / "curves.mcap")
    with RecordWriter(tmp_path / "less.mcap", found.header) as writer:
        writer.samples(0, {"u": np.ones(4), "counts": np.arange(4)})
    with pytest.raises(SettingError, match="press 7"):
        export(tmp_path / "less.mcap", tmp_path / "curves.mcap")


def test_what_cannot_be_read_may_be_of_a_drive(tmp_path: Path) -> None:
    of_virtual(tmp_path / "a.mcap")
    torn, empty = tmp_path / "torn.mcap", tmp_path / "empty.mcap"
    torn.write_bytes(press(tmp_path / "press.mcap")[:60])
    empty.touch()
    with pytest.raises(SettingError, match="can be one"):
        export(tmp_path / "a.mcap", torn)
    export(tmp_path / "a.mcap", empty)
    export(tmp_path / "a.mcap", torn, overwrite=True)


def test_a_demo_replaces_a_demo_only(tmp_path: Path, sewfast: Callable[..., str]) -> None:
    mine = tmp_path / "recordings" / "step.csv"
    mine.parent.mkdir()
    mine.write_text("t,u\n0,1\n")
    with pytest.raises(SettingError, match=r"recordings: expected .*--overwrite"):
        run_demo(tmp_path)
    assert "--overwrite" in sewfast("demo", "--out", ".", refused=True)
    assert [p.name for p in tmp_path.iterdir()] == ["recordings"]


# --- the writer ---------------------------------------------------------------------------------


def test_a_lazy_writer_makes_the_file_with_what_is_in_it(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    before = press(path)
    header = Header("run", 0.001, {"u": "V"}, 5)
    with RecordWriter(path, header, overwrite=True, lazy=True) as writer:
        pass
    assert not writer.is_made
    assert path.read_bytes() == before
    with RecordWriter(path, header, overwrite=True, lazy=True) as writer:
        writer.samples(0, {"u": np.ones(5)})
    assert writer.is_made
    assert read_recording(path).complete


def test_a_lazy_writer_refuses_at_once(tmp_path: Path) -> None:
    header = Header("run", 0.001, {"u": "V"}, 5)
    with refuses(DataError, expected="can be written"):
        RecordWriter(tmp_path / "none" / "run.mcap", header, lazy=True)
    with pytest.raises(DataError, match="received a folder"):
        RecordWriter(tmp_path, header, lazy=True)
    press(tmp_path / "run.mcap")
    with refuses(SettingError, expected="new name", received="kept"):
        RecordWriter(tmp_path / "run.mcap", header, lazy=True)
    assert [p.name for p in tmp_path.iterdir()] == ["run.mcap"]


def test_a_file_that_cannot_be_made_any_more_is_told_by_the_next_call(tmp_path: Path) -> None:
    folder = tmp_path / "stick"
    folder.mkdir()
    writer = RecordWriter(folder / "run.mcap", Header("run", 0.001, {"u": "V"}), lazy=True)
    folder.rmdir()
    writer.samples(0, {"u": np.ones(5)})
    with refuses(DataError, expected="can be written"):
        writer.close()


def test_a_disk_that_fills_up_meanwhile_leaves_no_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    path = tmp_path / "run.mcap"
    writer = RecordWriter(path, Header("run", 0.001, {"u": "V"}), lazy=True)
    monkeypatch.setattr(Sink, "append", full)
    writer.samples(0, {"u": np.ones(5)})
    with pytest.raises(DataError, match="No space left"):
        writer.close()
    assert not writer.is_made
    assert not path.exists()


def test_the_samples_that_were_taken_and_never_came_are_a_gap(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    with RecordWriter(path, Header("run", 0.001, {"u": "V"}, 50)) as writer:
        writer.samples(0, {"u": np.ones(5)})
        writer.close("tripped: watchdog", taken=20)
    found = read_recording(path)
    assert (found.gaps, len(found), found.outcome) == (((5, 15),), 20, "tripped: watchdog")


def test_the_end_that_an_unplug_took_is_listed(tmp_path: Path) -> None:
    """The device tripped while its port was away, and said so when it was back."""
    path = tmp_path / "run.mcap"
    with (
        VirtualDevice() as device,
        connect(device.port, watchdog=0.5, resume=10.0) as drive,
    ):
        drive.set_limits(volt=20.0)
        once_on(device, lambda: device.cause("unplug", 1.0), after=0.2)
        with pytest.raises(LinkError, match="tripped: watchdog"):
            record(drive, np.full(5000, 2.0), file=path)
        outcome = drive.outcome
    assert outcome is not None
    found = read_recording(path)
    assert len(found) == outcome.taken
    assert found.gaps == outcome.gaps
    assert outcome.gaps


# --- two recorders --------------------------------------------------------------------------------


def _writer(path: Path, **settings: bool) -> RecordWriter:
    header = Header("run", 0.001, {"u": "V"}, 100, None, {"kind": "virtual"})
    return RecordWriter(path, header, **settings)


needs_locks = pytest.mark.skipif(os.name == "nt", reason="Windows has no flock")


@needs_locks
@pytest.mark.parametrize("lazy", [False, True])
def test_a_recording_under_way_is_not_written_over(tmp_path: Path, lazy: bool) -> None:
    path = tmp_path / "run.mcap"
    with _writer(path) as first:
        first.samples(0, {"u": np.ones(50)})
        with pytest.raises(SettingError, match="nobody else writes"):
            _writer(path, overwrite=True, lazy=lazy)
        first.samples(50, {"u": np.ones(50)})
    assert read_recording(path).complete
    with _writer(path, overwrite=True) as second:
        second.samples(0, {"u": np.zeros(100)})
    assert not read_recording(path).columns["u"].any()


@needs_locks
def test_of_two_that_may_replace_a_file_one_does(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    path.touch()
    one, other = (_writer(path, overwrite=True, lazy=True) for _ in range(2))
    one.samples(0, {"u": np.ones(100)})
    one.event("started")
    while not path.stat().st_size:
        time.sleep(0.001)
    other.samples(0, {"u": np.zeros(100)})
    with pytest.raises(SettingError, match="is kept"):
        other.close()
    one.close()
    found = read_recording(path)
    assert found.complete
    assert not found.damage
    assert found.columns["u"].all()


def test_what_came_after_the_question_is_kept(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    with _writer(path) as first:
        first.samples(0, {"u": np.ones(10)})
    late = _writer(path, overwrite=True, lazy=True)
    path.unlink()
    with _writer(path) as second:
        second.samples(0, {"u": np.ones(100)})
    late.samples(0, {"u": np.zeros(100)})
    with pytest.raises(SettingError, match="is kept"):
        late.close()
    assert read_recording(path).complete
