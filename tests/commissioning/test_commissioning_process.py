"""`sewfast commission` as a process that is killed, or interrupted."""

from __future__ import annotations

import json
import signal
import subprocess
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from cli import PROGRAM, environment, refused, sewfast
from commissioned import SMALL, short
from effort import FULL
from moments import PATIENCE, until
from sewfast import (
    Commissioning,
    Controller,
    Gains,
    LinkError,
    SettingError,
    VirtualMachine,
    commission,
    read_table,
)
from sewfast.commissioning.checkpoint import Checkpoint, prepare
from sewfast.commissioning.result import require_own
from sewfast.control.benches import MachineBench
from sewfast.control.loop import run as closed_loop
from sewfast.control.machine import RecordedRun, Watch
from sewfast.control.record import record
from sewfast.dataset import FloatArray
from sewfast.link import VirtualDevice
from sewfast.recordfile import read_recording
from sewfast.recording import Recording


@contextmanager
def commissioning(folder: Path, on: str = "virtual") -> Iterator[subprocess.Popen[str]]:
    """One that fills `out`, once it has recorded its first closed loop."""
    command = [*PROGRAM, "commission", "--on", on, "--out", "out", "--members", "2"]
    with subprocess.Popen(
        command, cwd=folder, env=environment(), text=True,
        stdout=subprocess.PIPE, stderr=subprocess.PIPE,
    ) as process:  # fmt: skip
        try:
            until(lambda: (folder / "out/unfinished/trapezoids.mcap").exists())
            yield process
        finally:
            process.kill()


@pytest.mark.nightly("a commissioning for each bench", by_day=["process"])
@pytest.mark.alone
@pytest.mark.parametrize("behind", ["process", "port"])
def test_a_killed_commissioning_leaves_its_recordings(tmp_path: Path, behind: str) -> None:
    with ExitStack() as stack:
        on = "virtual"
        if behind == "port":
            on = stack.enter_context(VirtualDevice(fast=True)).port
        with commissioning(tmp_path, on) as process:
            process.send_signal(signal.SIGKILL)
            _, said = process.communicate(timeout=PATIENCE)
    assert ("recording is saved in out/unfinished" in said) == (behind == "port")
    out = tmp_path / "out"
    assert not (out / "commissioning.json").exists()
    files = {file.stem: file for file in (out / "unfinished").glob("*.mcap")}
    assert {"motion_1", "step", "trapezoids"} <= set(files)
    for file in files.values():
        found = read_recording(file)
        assert found.complete
        told = found.header.settings["commissioning"]
        assert (told["u_max"], told["speed"]) == (20.0, 2000.0)
        assert ("limits" in told) == (behind == "port")
    step, loop = (read_recording(files[name]).header for name in ("step", "trapezoids"))
    assert step.settings["commissioning"]["stage"] == "step response"
    assert loop.settings["controller"]["u_max"] == 20.0
    sewfast(tmp_path, "identify", files["trapezoids"], "--model", "arx", "-o", "model.json")
    # a computer can make these again
    require_own(out, overwrite=False)


@pytest.mark.alone
def test_ctrl_c_says_what_it_has_written(tmp_path: Path) -> None:
    with commissioning(tmp_path) as process:
        process.send_signal(signal.SIGINT)
        _, told = process.communicate(timeout=PATIENCE)
    assert process.returncode == 130
    said = [line for line in told.splitlines() if "interrupted" in line or "best" in line]
    best = "kept the best so far in out, without a page (sewfast report out writes it)"
    assert said == [f"interrupted; {best}"]
    assert (tmp_path / "out/unfinished/trapezoids.mcap").exists()
    assert (tmp_path / "out/recordings/trapezoids.csv").exists()


@pytest.mark.nightly("a commissioning for each moment", by_day=["0.2"])
@pytest.mark.alone
@pytest.mark.parametrize("after", [0.2, 0.6])
def test_ctrl_c_is_heard_while_linear_models_are_fitted(tmp_path: Path, after: float) -> None:
    with commissioning(tmp_path) as process:
        time.sleep(after)
        process.send_signal(signal.SIGINT)
        process.communicate(timeout=PATIENCE)
    assert process.returncode == 130


@pytest.mark.alone
def test_a_second_ctrl_c_leaves_no_half_file(tmp_path: Path) -> None:
    with commissioning(tmp_path) as process:
        process.send_signal(signal.SIGINT)
        time.sleep(0.1)  # it writes its recordings for some tenths of a second
        process.send_signal(signal.SIGINT)
        process.communicate(timeout=PATIENCE)
    assert process.returncode == 130
    files = [file for file in (tmp_path / "out").rglob("*") if file.is_file()]
    assert not [file for file in files if file.suffix == ".tmp"]
    places = ("recordings", "unfinished")
    kept = {file.stem: file for file in files if file.parent.name in places}
    assert {"step", "trapezoids"} <= set(kept)
    assert all(len(read_table(file)["u"]) > 100 for file in kept.values())


# --- the files ----------------------------------------------------------------------------------


def taken(folder: Path, kind: str = "virtual") -> Recording:
    """A recording that lies in a folder, of a commissioning on what `kind` says."""
    recording = record(VirtualMachine(), np.full(300, 2.0), name="step")
    prepare(folder)
    files = Checkpoint(folder, {"kind": kind, "name": "bench 2"}, {"u_max": 9.0})
    files.begin()
    files.keep("step response", "step", "key", recording, None)
    return recording


def test_what_is_written_is_what_was_recorded(tmp_path: Path) -> None:
    recording = taken(tmp_path)
    found = read_recording(tmp_path / "unfinished/step.mcap")
    for name in ("u", "counts", "y", "speed_true"):
        np.testing.assert_array_equal(found.columns[name], recording.columns()[name])
    assert found.header.device["name"] == "bench 2"
    assert found.header.settings == {
        "commissioning": {"stage": "step response", "key": "key", "u_max": 9.0}
    }


def test_recordings_of_a_drive_are_kept(tmp_path: Path) -> None:
    taken(tmp_path, "drive")
    with pytest.raises(SettingError, match="'bench 2'"):
        require_own(tmp_path, overwrite=False)
    # nor does what a virtual machine has left beside them make a difference
    told = {"format": "sewfast.commissioning", "version": 1, "machine": "virtual"}
    (tmp_path / "commissioning.json").write_text(json.dumps(told))
    said = refused(tmp_path, "commission", "--on", "virtual", "--out", tmp_path)
    assert "'bench 2'" in said
    assert (tmp_path / "unfinished/step.mcap").exists()


def test_files_of_others_are_neither_repeatable_nor_cleared(tmp_path: Path) -> None:
    recording = taken(tmp_path)
    mine = tmp_path / "unfinished/mine.mcap"
    recording.save(mine)
    with pytest.raises(SettingError, match="choose another folder"):
        require_own(tmp_path, overwrite=False)
    Checkpoint(tmp_path, {}, {}).begin()
    assert list((tmp_path / "unfinished").iterdir()) == [mine]


def test_a_whole_commissioning_stays_beside_an_unfinished_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    recording = record(VirtualMachine(), np.full(300, 2.0), name="step")
    drive = Commissioning("bench 2", "refused", "step response", "", {}, {"step": recording})
    drive.save(tmp_path)
    before = {f: f.read_bytes() for f in tmp_path.rglob("*") if f.is_file()}
    taken(tmp_path, "drive")
    assert before == {f: f.read_bytes() for f in before}
    # saved by one that has not taken them, they stay; by the one that has, tables take their place
    drive.save(tmp_path, overwrite=True)
    assert (tmp_path / "unfinished/step.mcap").exists()
    monkeypatch.chdir(tmp_path.parent)
    own = replace(drive, recorded_in=Path(tmp_path.name))
    own.save(tmp_path, overwrite=True)
    # a refused one may be resumed, of a verified one the tables hold the same
    assert (tmp_path / "unfinished/step.mcap").exists()
    replace(own, verdict="verified").save(tmp_path, overwrite=True)
    assert not (tmp_path / "unfinished").exists()


def test_a_recording_that_cannot_be_written_does_not_end_a_commissioning(tmp_path: Path) -> None:
    recording = taken(tmp_path)
    files = Checkpoint(tmp_path / "missing", {"kind": "virtual"}, {})
    with pytest.warns(RuntimeWarning, match="goes on, its recordings are in memory alone"):
        files.keep("limits", "pulses", "key", recording, None)
    # once: a second warning would be an error here
    files.keep("limits", "again", "key", recording, None)


@pytest.mark.parametrize(
    ("names", "message"), [(["a b", "a/b"], "would be one file"), (["r" * 300], "shorten it")]
)
def test_references_have_files_of_their_own(names: list[str], message: str) -> None:
    references = {name: np.full(100, 500.0) for name in names}
    with pytest.raises(SettingError, match=message):
        commission(VirtualMachine(), references=references)


def test_a_reference_does_not_replace_a_recording_of_its_name(tmp_path: Path) -> None:
    recording = taken(tmp_path)
    controller, machine = Controller(Gains.standard(0.01, 0.1)), VirtualMachine()
    files = Checkpoint(tmp_path, {"kind": "virtual"}, {})
    files.keep(
        "verification", "step", "key", recording, closed_loop(controller, machine, np.zeros(300))
    )
    names = {file.name for file in (tmp_path / "unfinished").iterdir()}
    assert names == {"step.mcap", "verification_step.mcap"}


# --- going on after a trip ------------------------------------------------------------------------


class Trips(MachineBench):
    """The virtual machine, whose link fails once, as it is asked for a signal of this name."""

    def __init__(self, at: str | None, machine: int | None = None) -> None:
        super().__init__(VirtualMachine(machine))
        object.__setattr__(self, "at", at)
        object.__setattr__(self, "played", [])

    def _next(self, name: str) -> None:
        self.played.append(name)  # type: ignore[attr-defined]
        if name == self.at:  # type: ignore[attr-defined]
            raise LinkError(f"{name}: the cable fell out")

    def excite(self, u: FloatArray, name: str) -> Recording:
        self._next(name)
        return super().excite(u, name)

    def follow(
        self, controller: Controller, r: FloatArray, name: str, *, watch: Watch | None = None
    ) -> RecordedRun:
        self._next(name)
        return super().follow(controller, r, name, watch=watch)


@pytest.fixture(scope="module")
def whole() -> tuple[Commissioning, list[str]]:
    """One that nothing interrupts, and what it played."""
    machine = Trips(None)
    with short():
        found = commission(machine, **SMALL)
    return found, machine.played  # type: ignore[attr-defined]


FAILURES = (
    "motion_1", "step", "small_signals", "pulses", "hold_first_50", "trapezoids", "levels",
    "training", "tuning", "hold_tuned_50", "trapezoid", "chirp_lo_hi",
)  # fmt: skip
"""Of every stage, in their order."""
COMPUTED = ("training", "tuning")
"""Stages that do not move the machine."""


@pytest.mark.nightly("a commissioning for each trip")
def test_it_goes_on_after_every_trip_to_the_same_controller(
    whole: tuple[Commissioning, list[str]], tmp_path: Path
) -> None:
    """Each attempt resumes the one before, so that one training serves most stages."""
    expected, played = whole
    recorded: list[str] = []
    for at in FAILURES if FULL else FAILURES[1::3]:
        machine = Trips(at)

        def fails(done: int, total: int, stage: str, at: str = at) -> None:
            if at in COMPUTED and stage.startswith(f"{at} "):
                raise LinkError(f"{at}: the cable fell out")

        with short(), pytest.raises(LinkError, match=f"{at}: the cable fell out"):
            commission(machine, **SMALL, folder=tmp_path, resume=True, progress=fails)
        # what had failed is all that is taken again
        asked = machine.played  # type: ignore[attr-defined]
        recorded += asked if at in COMPUTED else asked[:-1]
    again = Trips(None)
    with short():
        found = commission(again, **SMALL, folder=tmp_path, resume=True)
    assert recorded + again.played == played  # type: ignore[attr-defined]
    assert expected.controller is not None
    assert found.controller is not None
    assert found.controller.to_dict() == expected.controller.to_dict()
    assert found.measured_cost == expected.measured_cost


def test_what_was_recorded_under_other_settings_is_not_taken(tmp_path: Path) -> None:
    with short():
        with pytest.raises(LinkError):
            commission(Trips("pulses"), **SMALL, folder=tmp_path)
        other = Trips("pulses")
        with pytest.raises(LinkError):
            commission(other, **{**SMALL, "seed": 2}, folder=tmp_path, resume=True)
    assert other.played[0] == "motion_1"  # type: ignore[attr-defined]
    with pytest.raises(SettingError) as caught:
        commission(VirtualMachine(), resume=True)
    assert (caught.value.name, caught.value.received) == ("folder", "none")


def test_what_was_recorded_on_another_machine_is_not_taken(tmp_path: Path) -> None:
    other = Trips("small_signals", machine=3)
    with short():
        with pytest.raises(LinkError):
            commission(Trips("small_signals"), **SMALL, folder=tmp_path)
        with pytest.raises(LinkError):
            commission(other, **SMALL, folder=tmp_path, resume=True)
    # the first pulse is the same command, and not the same motor
    assert other.played[0] == "motion_1"  # type: ignore[attr-defined]
