"""Arguments that cannot be: the package's own error says what was expected and what came."""

from __future__ import annotations

import copy
import gc
import pickle
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from link_device import RUNNING, ScriptedDevice
from refusals import refuses
from sewfast import Controller, Gains, VirtualMachine
from sewfast.cli import main
from sewfast.control.loop import run
from sewfast.control.record import record
from sewfast.errors import DataError, LinkError, SettingError
from sewfast.link import Drive, Outcome, Plan, VirtualDevice, connect, examine, run_on_host
from sewfast.recordfile import Header, RecordWriter, export, read_recording

U = np.ones(100)
CONTROLLER = Controller(Gains.standard(0.005, 0.1), u_min=-10.0, u_max=10.0)


@pytest.fixture(scope="module")
def device() -> Iterator[VirtualDevice]:
    with VirtualDevice(fast=True) as served:
        yield served


@pytest.fixture
def drive(device: VirtualDevice) -> Iterator[Drive]:
    with connect(device.port) as connected:
        if connected.status().state == "tripped":
            connected.clear()
        connected.set_limits(volt=20.0)
        yield connected


@pytest.mark.parametrize(
    "settings",
    [
        {"machine": 5}, {"link": 5}, {"link": ""}, {"fault_log": 5}, {"trace": b"x"}, {"faults": 5},
        {"fast": "yes"}, {"once": 1}, {"duration": "long"}, {"address": None}, {"baud": "x"},
    ],
    ids=repr,
)  # fmt: skip
def test_settings_of_a_virtual_device(settings: dict[str, Any]) -> None:
    with refuses(SettingError, name=".", received="."):
        VirtualDevice(**settings)


def test_causes_that_are_none(device: VirtualDevice) -> None:
    for fault, seconds in ((5, None), ("stall", "long"), (None, None)):
        with refuses(SettingError, name=".", received="."):
            device.cause(fault, seconds)  # type: ignore[arg-type]
    with pytest.raises(SettingError, match="timeout"):
        device.wait("long")  # type: ignore[arg-type]


@pytest.mark.parametrize("name", ["link", "trace", "fault_log"])
def test_places_in_a_folder_that_is_not_there(
    name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    place = tmp_path / "nodir" / "x"
    with pytest.raises(LinkError, match=r"nodir/x: expected a folder .*nodir; create it"):
        VirtualDevice(**{name: place})  # type: ignore[arg-type]
    assert main(["device", f"--{name.replace('_', '-')}", str(place)]) == 2
    assert "create it" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("call", "error", "message"),
    [
        (lambda d: record(d, U, live=5), SettingError, "live view out of .* received 5"),
        (
            lambda d: record(d, "abc"),
            DataError,
            "numbers, received 'abc'; .*excitation",
        ),
        (lambda d: record(d, [[1.0], 2.0]), DataError, "u: expected numbers"),
        (lambda d: record(d, U, file=5), SettingError, "a file's name, received 5"),
        (lambda d: record(d, U, settings=5), SettingError, "a mapping, received 5"),
        (lambda d: record(U, d), SettingError, "received ndarray; the machine comes first"),
        (
            lambda d: run(d, CONTROLLER, U),
            SettingError,
            r"received Drive and .*is run\(contr",
        ),
        (lambda d: run(CONTROLLER, U, U), SettingError, "on: .* received ndarray"),
        (lambda d: run_on_host(CONTROLLER, d, U), SettingError, r"order is run_on_host\(drive, c"),
        (lambda d: run_on_host(d, None, U), SettingError, "a Controller, received NoneType"),
        (lambda d: run_on_host(None, CONTROLLER, U), SettingError, "a Drive .* received NoneType"),
        (lambda d: read_recording(None), DataError, "name, received None"),
        (lambda d: export(3.0, "x.csv"), DataError, r"name, received 3\.0"),
    ],
)
def test_arguments_of_runs_and_recordings(
    drive: Drive, call: Callable[[Drive], object], error: type[Exception], message: str
) -> None:
    with pytest.raises(error, match=message):
        call(drive)
    assert drive.status().state == "idle"


@pytest.mark.parametrize("text", ["127.0.0.1:5055", "drive.local:5000"])
def test_an_address_without_its_scheme(text: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert f"socket://{text}" in examine(text)["port"].remedy
    with pytest.raises(LinkError, match=f"is written socket://{text}"):
        connect(text)
    assert main(["stop", text]) == 2
    assert f"socket://{text}" in capsys.readouterr().err


# --- what is told -------------------------------------------------------------------------------


def test_a_trip_names_the_limit_in_force(drive: Drive) -> None:
    drive.set_limits(speed_rpm=600.0)
    with refuses(LinkError, received=r"tripped: speed, the limit is 600 RPM, after"):
        record(drive, np.full(2000, 5.0))
    drive.clear()
    drive.set_limits(speed_rpm=6000.0, acceleration=1000.0)
    with refuses(LinkError, received=r"acceleration, the limit is 1000 RPM/s, "):
        record(drive, np.full(2000, 5.0))
    drive.clear()
    drive.set_limits(acceleration=1e6)


def test_a_watchdog_trip_says_how_to_give_it_more_time(tmp_path: Path) -> None:
    with ScriptedDevice(tmp_path) as device, connect(device.url, watchdog=5.0) as drive:
        drive.set_limits()

        def trip(frame: tuple[object, ...]) -> bool:
            if device.state == RUNNING:
                device.trip(1)
            return False

        device.intercept = trip
        with refuses(
            LinkError, received="received nothing for 5000 ms", remedy="--watchdog 10000 "
        ):
            record(drive, np.ones(3000))


def recorded(path: Path, n: int = 8) -> Path:
    header = Header("run", 0.001, {"u": "V"}, n, None, {"kind": "virtual", "rows": [1, 2]})
    with RecordWriter(path, header) as writer:
        writer.event("started", 0, reason="none", state="running", value=0.0)
        writer.samples(0, {"u": np.ones(5)})
        writer.event("tripped", 5, reason="speed", state="tripped", value=812.5)
        writer.close("tripped: speed")
    return path


def test_an_event_without_a_trip_has_no_reason(tmp_path: Path) -> None:
    told = str(read_recording(recorded(tmp_path / "run.mcap")))
    assert "started at sample 0: state running" in told
    assert "tripped at sample 5: reason speed, state tripped, value 812.5" in told
    assert "none" not in told


def test_what_was_planned_and_is_not_there_is_told(tmp_path: Path) -> None:
    assert "not there samples 5:8" in str(read_recording(recorded(tmp_path / "run.mcap")))
    assert "not there" not in str(read_recording(recorded(tmp_path / "whole.mcap", 5)))


@pytest.mark.parametrize("copied", [lambda r: pickle.loads(pickle.dumps(r)), copy.deepcopy])
def test_a_recording_can_be_handed_to_another_process(
    tmp_path: Path, copied: Callable[[Any], Any]
) -> None:
    made = read_recording(recorded(tmp_path / "run.mcap"))
    again = copied(made)
    assert (again.path, again.header, again.gaps) == (made.path, made.header, made.gaps)
    assert (again.outcome, again.damage) == (made.outcome, made.damage)
    assert [dict(e) for e in again.events] == [dict(e) for e in made.events]
    np.testing.assert_array_equal(again.columns["u"], made.columns["u"])
    with pytest.raises(ValueError, match="read-only"):
        again.columns["u"][0] = 2.0
    with pytest.raises(TypeError):
        again.columns["v"] = U


def test_a_virtual_machine_by_another_name_than_text() -> None:
    with refuses(SettingError, received="5"):
        VirtualMachine.from_name(5)  # type: ignore[arg-type]


@pytest.mark.parametrize("duplicate", [copy.copy, copy.deepcopy, pickle.dumps])
def test_what_owns_a_port_is_not_copied(duplicate: Callable[[object], object]) -> None:
    with VirtualDevice(fast=True) as device, connect(device.port) as drive:
        for owner in (drive, drive._link, drive._link.port, device):
            with refuses(SettingError, name="port", expected="one owner"):
                duplicate(owner)
        # half a copy must not take the original's descriptor along
        gc.collect()
        assert drive.status().state == "idle"


@pytest.mark.parametrize("u", [np.ones(5) * 1j, [1j], [10**400]])
def test_what_would_lose_its_value_is_no_excitation(device: VirtualDevice, u: Any) -> None:
    with pytest.raises(DataError, match="u: expected numbers"):
        record(VirtualMachine(), u)
    with pytest.raises(DataError, match="expected numbers"):
        Plan("commands", u)


def test_a_name_with_a_zero_is_refused(drive: Drive) -> None:
    with pytest.raises(SettingError, match="a file's name"):
        record(drive, U, file="a\0.mcap")


# --- from another thread --------------------------------------------------------------------------


class Running:
    """A record in a thread of its own, once samples come."""

    def __init__(self, drive: Drive, n: int = 200_000) -> None:
        self.began, self.error = threading.Event(), None
        self.outcome: Outcome | None = None
        self._work = (drive, Plan("commands", np.ones(n)))
        self._thread = threading.Thread(target=self._stream)
        self._thread.start()
        assert self.began.wait(60.0)

    def _stream(self) -> None:
        drive, plan = self._work
        try:
            self.outcome = drive.stream(plan, self)
        except Exception as error:
            self.error, self.outcome = error, drive.outcome

    def samples(self, first: int, columns: object) -> None:
        self.began.set()

    def event(self, kind: str, index: int, **detail: object) -> None: ...

    def ended(self) -> Outcome:
        self._thread.join(60.0)
        assert not self._thread.is_alive()
        assert self.outcome is not None
        return self.outcome


def test_a_stop_from_another_thread_ends_the_run() -> None:
    with VirtualDevice() as device, connect(device.port, watchdog=10.0) as drive:
        drive.set_limits()
        run = Running(drive)
        drive.stop()
        outcome = run.ended()
        assert (outcome.reason, outcome.state) == ("cancelled", "idle")
        assert run.error is None
        assert outcome.is_complete
        assert outcome.taken is not None
        assert outcome.taken < 200_000
        # and the next one is not
        assert drive.stream(Plan("commands", U), run).reason == "finished"


def test_a_drive_closed_in_a_run_is_not_opened_again() -> None:
    with VirtualDevice() as device:
        drive = connect(device.port, watchdog=0.5, resume=30.0)
        drive.set_limits()
        run = Running(drive)
        drive.close()
        assert run.ended().state == "unknown"
        assert isinstance(run.error, LinkError)
        with connect(device.port) as again:
            while (status := again.status()).state == "running":
                time.sleep(0.01)
            assert status.taken < 200_000
