"""One table for every `Machine`: virtual, drive, simulator, FMU, MuJoCo, boards, a user's own."""

from __future__ import annotations

import shutil
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import boards
import sewfast
from foreign_fmu import OF_MOTOR, motor_fmu
from refusals import refuses
from sewfast import Controller, Gains, Machine, Recording, VirtualMachine, record, run
from sewfast.arrays import FloatArray
from sewfast.commissioning import SteppedBench
from sewfast.commissioning.bench import bench_of
from sewfast.control.benches import MachineBench, machine_of
from sewfast.control.machine import MEMBERS, RecordedRun
from sewfast.errors import DataError, SettingError
from sewfast.link import ODrive, SimpleFOC, VirtualDevice, connect
from sewfast.recordfile import read_recording

pytestmark = pytest.mark.alone
sys.path.insert(0, str(Path(__file__).parents[2] / "benches"))

CONTROLLER = Controller(Gains.standard(0.004, 0.1), u_min=-10.0, u_max=10.0)
STEP = np.concatenate([np.zeros(50), np.full(350, 4.0)])


class Lag:
    """300 RPM per volt with a time constant of 50 ms; it notes every command that it is given."""

    def __init__(self) -> None:
        self.applied: list[float] = []
        self.reset()

    def reset(self) -> None:
        self.counts = self.speed_rpm = self.angle = 0.0

    def step(self, u: float) -> None:
        self.applied.append(u)
        self.speed_rpm += 0.02 * (300.0 * u - self.speed_rpm)
        self.angle += self.speed_rpm / 60.0 * 1e-3
        self.counts = np.floor(4096.0 * self.angle)


def stepped() -> SteppedBench:
    return SteppedBench(Lag(), Ts=1e-3, counts_per_rev=4096.0, volt=10.0, name="lag")


@dataclass
class Own:
    """A user's test rig, with the members of a machine and no base class: it plays a whole signal
    and hands back its log.
    """

    name = "own"
    Ts = 1e-3
    counts_per_rev = 4096.0
    volt = 10.0
    speed = 6000.0

    def logged(self, law: Callable[[int, float], float], samples: int, name: str) -> Recording:
        lag, u, counts = Lag(), [], []
        for k in range(samples):
            # an encoder does not stand at 0 because a run begins
            counts.append(lag.counts + 1234.0)
            u.append(law(k, lag.counts))
            lag.step(u[-1])
        return Recording.of_counts(
            u, counts, Ts=self.Ts, counts_per_rev=self.counts_per_rev, name=name
        )

    def excite(self, u: FloatArray, name: str) -> Recording:
        return self.logged(lambda k, counts: float(u[k]), len(u), name)

    def follow(self, controller: Controller, r: FloatArray, name: str) -> RecordedRun:
        core, per_count, before = controller.core(), 60.0 / (self.counts_per_rev * self.Ts), 0.0

        def law(k: int, counts: float) -> float:
            nonlocal before
            speed, before = (counts - before) * per_count, counts
            return core.step(float(r[k]), speed)

        recording = self.logged(law, len(r), name)
        return RecordedRun.of_recording(recording, controller, r, plant=self.name)


@contextmanager
def virtual(folder: Path) -> Iterator[Machine]:
    yield MachineBench(VirtualMachine())


@contextmanager
def drive(folder: Path) -> Iterator[Machine]:
    with VirtualDevice(fast=True, endpoint="tcp") as device, connect(device.port) as found:
        found.set_limits()
        yield found


@contextmanager
def simulator(folder: Path) -> Iterator[Machine]:
    yield stepped()


@contextmanager
def own(folder: Path) -> Iterator[Machine]:
    yield Own()


@contextmanager
def fmu(folder: Path) -> Iterator[Machine]:
    pytest.importorskip("fmpy")
    if shutil.which("cc") is None or not sys.platform.startswith("linux"):
        pytest.skip("needs Linux and a C compiler")
    yield sewfast.commissioning.fmu_bench(motor_fmu(folder), **OF_MOTOR)


@contextmanager
def mujoco(folder: Path) -> Iterator[Machine]:
    motors = pytest.importorskip("mujoco_motors", reason="needs mujoco")
    yield motors.bench_of(motors.drawn(0))


@contextmanager
def odrive(folder: Path) -> Iterator[Machine]:
    """Of another maker, with a motor that takes volts."""
    axis = boards.EmulatedODrive(boards.Motor(100.0, 0.06, 0.1, 16384.0))
    axis.properties["axis0.motor.config.motor_type"] = 2.0
    line = boards.Line(axis)
    yield ODrive(line, clock=line, volt=12.0, speed=3000.0)


@contextmanager
def simplefoc(folder: Path) -> Iterator[Machine]:
    line = boards.Line(boards.simplefoc())
    yield SimpleFOC(line, clock=line, volt=12.0, speed=3000.0, counts_per_rev=16384.0)


@contextmanager
def whole(folder: Path) -> Iterator[Machine]:
    """A drive as commissioning takes it."""
    with drive(folder) as found, bench_of(found, None) as bench:
        yield bench


TABLE: tuple[Callable[[Path], Any], ...] = (
    virtual, drive, whole, simulator, own, fmu, mujoco, odrive, simplefoc,
)  # fmt: skip


@pytest.fixture(scope="module", params=TABLE, ids=lambda made: made.__name__)
def machine(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[Machine]:
    with request.param(tmp_path_factory.mktemp("machine")) as made:
        yield made


# --- what every machine keeps to ------------------------------------------------------------------


def test_it_says_what_it_is(machine: Machine) -> None:
    assert machine_of(machine) is machine
    assert machine.name
    assert isinstance(machine.name, str)
    assert 0.0 < machine.Ts < 1.0
    assert 0.0 < machine.counts_per_rev < np.inf
    assert 0.0 < machine.volt < np.inf
    assert machine.speed > 0.0


def test_it_is_recorded_from_rest_each_time(machine: Machine) -> None:
    first, again = record(machine, STEP, name="step"), record(machine, STEP, name="step")
    for found in (first, again):
        assert (len(found), found.Ts, found.name) == (len(STEP), machine.Ts, "step")
        assert found.counts_per_rev == machine.counts_per_rev
        np.testing.assert_allclose(found.u, STEP, atol=1e-3)
        assert found.counts[0] == 0.0
        # at rest to begin with, turning at the end
        assert np.ptp(found.counts[:50]) <= 2.0
        assert found.counts[-1] > found.counts[60] + 20.0
        assert np.isfinite(found.y).all()
    assert abs(first.counts[-1] - again.counts[-1]) <= 0.02 * first.counts[-1]


def test_it_takes_no_more_than_its_largest_command(machine: Machine) -> None:
    u = np.full(100, 0.1)
    u[50:60] = 0.9 * machine.volt
    assert np.abs(machine.excite(u, "pulse").u).max() <= machine.volt


def test_it_follows_a_reference(machine: Machine) -> None:
    controller = replace(CONTROLLER, Ts=machine.Ts)
    r = np.concatenate([np.zeros(50), np.full(1450, 600.0)])
    found = run(controller, machine, r, name="level")
    assert (found.reference, found.controller) == ("level", controller)
    assert len(found.t) == len(found.u) == len(found.y) == len(r)
    np.testing.assert_array_equal(found.r, r)
    assert np.abs(found.u).max() <= 10.0
    assert np.median(found.y[-50:]) == pytest.approx(600.0, rel=0.25)
    assert set(found.metrics()) >= {"rmse", "overshoot_percent"}
    followed = machine.follow(controller, r, "level")
    recording = followed.recording
    assert isinstance(recording, Recording)
    assert followed.run is followed
    np.testing.assert_allclose(recording.u, followed.u, atol=1e-3)
    assert (recording.name, len(recording)) == ("level", len(r))


def test_its_recording_goes_into_a_file(machine: Machine, tmp_path: Path) -> None:
    file = tmp_path / "step.mcap"
    found = record(machine, STEP, name="step", file=file)
    np.testing.assert_allclose(read_recording(file).columns["u"], found.u, atol=1e-3)


@pytest.mark.parametrize("u", [np.zeros((100, 1)), "step", [1.0, 2j], [[1.0], [2.0, 3.0]]])
def test_it_refuses_what_is_no_command(machine: Machine, u: Any) -> None:
    with refuses(DataError, name="^u$"):
        record(machine, u)


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_it_refuses_numbers_that_are_not_finite(machine: Machine, bad: float) -> None:
    u = np.ones(400)
    u[200] = bad
    with pytest.raises((DataError, SettingError), match="finite"):
        record(machine, u)
    with pytest.raises((DataError, SettingError), match="finite"):
        run(replace(CONTROLLER, Ts=machine.Ts), machine, 100.0 * u)


def test_it_refuses_a_controller_of_another_sample_time(machine: Machine) -> None:
    with pytest.raises(SettingError, match=r"sample time|period"):
        run(replace(CONTROLLER, Ts=5.0 * machine.Ts), machine, np.full(100, 300.0))


def test_a_rigs_log_is_the_run_of_a_machine_that_is_stepped() -> None:
    r = np.concatenate([np.zeros(50), np.full(350, 600.0)])
    logged, known = Own().follow(CONTROLLER, r, "level"), stepped().follow(CONTROLLER, r, "level")
    for name in ("t", "r", "u", "feedback"):
        np.testing.assert_array_equal(getattr(logged, name), getattr(known, name))
    # a log has no true speed
    np.testing.assert_array_equal(logged.y, known.recording.y)
    np.testing.assert_array_equal(logged.recording.counts, known.recording.counts)
    with refuses(DataError, name="reference", received="100"):
        RecordedRun.of_recording(logged.recording, CONTROLLER, r[:100], plant="own")
    with refuses(DataError, name="counts", received=r"\(3,\)"):
        Recording.of_counts([1.0, 2.0], [0, 1, 2], Ts=1e-3, counts_per_rev=4096.0)
    for nonsense in (["a", "b"], object(), [[1.0], [1.0, 2.0]], [1j, 2j], [[1.0, 2.0]]):
        with refuses(DataError, name="u"):
            Recording.of_counts(nonsense, [0, 1], Ts=1e-3, counts_per_rev=4096.0)


# --- what no machine is ---------------------------------------------------------------------------


@pytest.mark.parametrize("on", [None, 5, "virtual", Lag(), object()])
def test_what_is_no_machine_is_refused_by_name(on: Any) -> None:
    with refuses(SettingError, received=type(on).__name__):
        record(on, STEP)
    with refuses(SettingError, received=type(on).__name__):
        run(CONTROLLER, on, STEP)
    with refuses(SettingError, received=type(on).__name__):
        machine_of(on)


@pytest.mark.parametrize("member", MEMBERS)
def test_a_member_that_is_missing_is_named(member: str) -> None:
    members = {m: getattr(Own, m) for m in MEMBERS if m != member}
    with pytest.raises(SettingError, match=f"without {member};"):
        machine_of(type("Lacking", (), members)())


@pytest.mark.parametrize(
    "changes", [{"Ts": 0.0}, {"counts_per_rev": -1}, {"volt": np.inf}, {"speed": "fast"}]
)
def test_a_simulators_numbers_are_checked(changes: dict[str, Any]) -> None:
    with pytest.raises(SettingError, match=next(iter(changes))):
        replace(stepped(), **changes)


def test_a_run_that_is_broken_off_leaves_no_command() -> None:
    class Breaks(Lag):
        def step(self, u: float) -> None:
            super().step(u)
            if len(self.applied) == 100:
                raise KeyboardInterrupt

    on = replace(stepped(), machine=Breaks())
    with pytest.raises(KeyboardInterrupt):
        record(on, STEP)
    assert on.machine.applied[-2:] == [4.0, 0.0]


@pytest.mark.parametrize("counts", [None, "12", float("nan")])
def test_a_simulators_counts_are_a_number(counts: Any) -> None:
    class Odd:
        def reset(self) -> None: ...

        def step(self, u: float) -> None: ...

    odd: Any = Odd()
    odd.counts = counts
    on = SteppedBench(odd, Ts=1e-3, counts_per_rev=1000.0, volt=10.0, name="mine")
    with pytest.raises(SettingError) as caught:
        on.excite(np.zeros(100), "rest")
    assert (caught.value.name, caught.value.received) == ("counts of mine", repr(counts))
