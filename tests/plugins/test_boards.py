"""Boards of other makers: a `Machine` that keeps its limits, and off however a run ends."""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest

import boards
import sewfast
from boards import Emulated, EmulatedODrive, EmulatedSimpleFOC, Line, odrive, on_a_pty, simplefoc
from refusals import refuses
from sewfast import Controller, Gains, record, run
from sewfast.errors import DataError, Interrupted, LinkError, SettingError
from sewfast_boards import ODrive, PolledBoard, SimpleFOC

pytestmark = pytest.mark.alone
BAUD = 921_600


@dataclass(frozen=True)
class Case:
    """A board, its emulation, and what is asked of it."""

    emulated: Callable[..., Emulated]
    volt: float
    gain: float
    """RPM per unit of the command, in the end."""

    def board(self, emulated: Emulated, **options: Any) -> tuple[PolledBoard, Line]:
        line = Line(emulated, options.pop("baud", BAUD))
        given = {"volt": self.volt, "speed": 1500.0, "Ts": 0.01, **options}
        if isinstance(emulated, EmulatedODrive):
            return ODrive(line, clock=line, **given), line
        return SimpleFOC(line, clock=line, counts_per_rev=16384.0, **given), line

    @property
    def step(self) -> np.ndarray[Any, np.dtype[np.float64]]:
        return np.concatenate([np.zeros(20), np.full(150, 0.5 * self.volt)])

    @property
    def controller(self) -> Controller:
        gains = Gains.standard(0.2 / self.gain, 0.1)
        return Controller(gains, Ts=0.01, u_min=-self.volt, u_max=self.volt)


CASES = [Case(odrive, 0.2, 6000.0), Case(simplefoc, 10.0, 100.0)]
cases = pytest.mark.parametrize("case", CASES, ids=["odrive", "simplefoc"])


def is_off(emulated: Emulated) -> bool:
    """Nothing on the motor, and the output disabled."""
    if isinstance(emulated, EmulatedODrive):
        return emulated.motor.u == 0.0 and not emulated.drives
    assert isinstance(emulated, EmulatedSimpleFOC)
    return emulated.motor.u == 0.0 and not emulated.enabled


@cases
def test_a_recording_is_what_the_motor_did(case: Case) -> None:
    emulated = case.emulated()
    board, line = case.board(emulated)
    found = record(board, case.step, name="step")
    np.testing.assert_allclose(found.u, case.step, atol=1e-6)
    assert (found.counts[0], found.name, found.Ts) == (0.0, "step", 0.01)
    motor = emulated.motor
    t = 0.01 * np.arange(150)
    expected = motor.gain * (0.5 * case.volt - motor.friction) * (1.0 - np.exp(-t / motor.T))
    assert np.abs(found.y[20:] - expected).max() < 0.05 * expected[-1]
    assert is_off(emulated)
    board.close()
    assert line.closed


@cases
def test_a_controller_runs_on_it(case: Case) -> None:
    emulated = case.emulated()
    board, _ = case.board(emulated)
    r = np.concatenate([np.zeros(20), np.full(600, 500.0)])
    found = run(case.controller, board, r, name="level")
    assert np.median(found.y[-50:]) == pytest.approx(500.0, rel=0.01)
    assert is_off(emulated)
    with refuses(SettingError, name="controller", received=r"0\.001"):
        run(Controller(case.controller.gains, Ts=0.001), board, r)


@cases
def test_no_command_is_beyond_the_limit(case: Case) -> None:
    emulated = case.emulated()
    board, _ = case.board(emulated, volt=0.5 * case.volt)
    record(board, 10.0 * case.step)
    run(case.controller, board, np.full(60, board.speed))
    assert 0.0 < emulated.motor.most <= 0.5 * case.volt


@cases
def test_pauses_of_the_host_are_not_in_the_speed(case: Case) -> None:
    """Answers come late by up to 8 ms in every fourth sample; the time of each is known."""
    emulated = case.emulated()
    board, line = case.board(emulated)
    late = np.random.default_rng(0).uniform(0.0, 0.008, 100)
    line.pauses = {1.0 + 0.04 * k: pause for k, pause in enumerate(late)}
    found = record(board, np.full(400, 0.5 * case.volt))
    assert board.late > 0.005
    steady = found.y[250:]
    assert np.ptp(steady) < 0.01 * np.median(steady)


class Ends(Exception):
    pass


def _raises(board: PolledBoard, line: Line) -> None:
    def fails(k: int, u: Any, counts: Any) -> None:
        raise Ends

    board.follow(
        Controller(Gains.standard(1e-3, 0.1), Ts=0.01, u_min=-0.1, u_max=0.1), np.full(90, 200.0),
        "level", watch=fails,
    )  # fmt: skip


def _too_fast(board: PolledBoard, line: Line) -> None:
    board.speed = 50.0
    record(board, np.full(200, board.volt))


def _comes_late(board: PolledBoard, line: Line) -> None:
    line.pauses = {line.time + 1.0: 0.05}
    record(board, np.full(200, 0.5 * board.volt))


@cases
@pytest.mark.parametrize(
    ("ending", "kind", "received"),
    [
        (_raises, Ends, ""),
        (_too_fast, LinkError, "RPM at sample"),
        (_comes_late, LinkError, "late by"),
    ],
)
def test_off_however_a_run_ends(
    case: Case,
    ending: Callable[[PolledBoard, Line], None],
    kind: type[Exception],
    received: str,
) -> None:
    emulated = case.emulated()
    board, line = case.board(emulated)
    with pytest.raises(kind) as caught:
        ending(board, line)
    assert is_off(emulated)
    if isinstance(caught.value, LinkError):
        assert caught.value.received is not None
        assert received in caught.value.received
    if ending is _comes_late:
        # what came until then is kept
        assert caught.value.recording.y[-1] > 0.3 * 0.5 * case.volt * case.gain  # type: ignore[attr-defined]
    # and the next run is one as any other
    board.speed = 1500.0
    assert len(record(board, case.step)) == len(case.step)


@cases
def test_ctrl_c_leaves_the_motor_off_and_the_recording(case: Case) -> None:
    emulated = case.emulated()
    board, line = case.board(emulated)
    slept = line.sleep

    def sleep(seconds: float) -> None:
        slept(seconds)
        if emulated.motor.rpm > 200.0:
            raise KeyboardInterrupt

    line.sleep = sleep  # type: ignore[method-assign]
    with pytest.raises(Interrupted) as caught:
        record(board, case.step)
    # it comes while the way out waits as well
    assert is_off(emulated)
    # the speed that was passed lies between two samples
    assert 150.0 < caught.value.best.y[-1] < 1.2 * emulated.motor.gain * 0.5 * case.volt


@cases
def test_a_board_that_falls_silent_is_told_to_stop_all_the_same(case: Case) -> None:
    """Its answers are lost from somewhere in a run on; it hears what it is told."""
    emulated = case.emulated()
    board, line = case.board(emulated)
    slept, begun = line.sleep, line.time

    def sleep(seconds: float) -> None:
        slept(seconds)
        emulated.silent = line.time > begun + 1.0

    line.sleep = sleep  # type: ignore[method-assign]
    with refuses(LinkError, received="an answer to", remedy="SWITCH THE SUPPLY OFF"):
        record(board, case.step)
    assert emulated.motor.most > 0.0
    assert is_off(emulated)


@cases
def test_the_boards_own_watchdog_stops_an_orphan(case: Case) -> None:
    """What a host that is killed leaves behind: nobody who sends anything any more."""
    emulated = case.emulated()
    board, line = case.board(emulated)
    board._arm()
    for _ in range(30):
        board._apply(0.5 * case.volt)
        line.sleep(0.01)
    assert emulated.motor.u == 0.5 * case.volt
    emulated.at(line.time + 0.21)
    assert is_off(emulated)


def test_settings_are_as_they_were(tmp_path: Any) -> None:
    axis = odrive()
    before = dict(axis.properties)
    board, _ = CASES[0].board(axis)
    record(board, CASES[0].step)
    assert axis.properties == {**before, "axis0.requested_state": 1.0}
    assert any(line == "w axis0.config.enable_watchdog 1" for line in axis.told)
    motor = simplefoc()
    record(CASES[1].board(motor)[0], CASES[1].step)
    assert (motor.limit, motor.watchdog_ms) == (6.0, 0.0)
    assert "ML" + "U10.000000" in motor.told


def test_an_axis_that_trips_is_named() -> None:
    axis = odrive(vel_limit=5.0)
    board, _ = CASES[0].board(axis)
    with refuses(LinkError, received="error 0x200", remedy="dump_errors"):
        record(board, np.full(200, 0.2))
    assert is_off(axis)
    # it stays so until somebody has looked
    with refuses(LinkError, received="error 0x200"):
        record(board, np.full(200, 0.2))


def test_a_gimbal_motor_takes_volts() -> None:
    axis = odrive()
    assert CASES[0].board(axis)[0].unit == "N m"  # type: ignore[attr-defined]
    axis.properties["axis0.motor.config.motor_type"] = 2.0
    assert CASES[0].board(axis)[0].unit == "V"  # type: ignore[attr-defined]


@pytest.mark.parametrize(
    ("properties", "kind", "received"),
    [
        ({"fw_version_minor": 6.0}, SettingError, "0.6"),
        ({"axis0.error": 64.0}, LinkError, "0x40"),
        ({"axis0.current_state": 8.0}, LinkError, "in use"),
    ],
)
def test_an_odrive_that_cannot_be_used_is_refused(
    properties: dict[str, float], kind: type[sewfast.SewfastError], received: str
) -> None:
    axis = odrive()
    axis.properties |= properties
    with refuses(kind, received=received):
        CASES[0].board(axis)
    assert axis.motor.most == 0.0


def test_an_axis_without_calibration_does_not_arm() -> None:
    board, _ = CASES[0].board(odrive(calibrated=False))
    with refuses(LinkError, received="error 0x1"):
        record(board, CASES[0].step)


class Talkative(EmulatedSimpleFOC):
    """A sketch that prints in its loop, whatever the Commander is told."""

    def at(self, now: float) -> None:
        self.telemetry = True
        super().at(now)


@pytest.mark.parametrize(
    ("emulated", "options", "kind", "fields"),
    [
        (simplefoc(watchdog=False), {}, SettingError, {"name": "watchdog"}),
        (simplefoc(resistance=2.0), {}, SettingError, {"received": "currents"}),
        (simplefoc(), {"motor": "B"}, SettingError, {"name": "motor", "received": "M, W"}),
        (simplefoc(), {"motor": "MM"}, SettingError, {"name": "motor"}),
        (simplefoc(), {"baud": 9600}, SettingError, {"name": "Ts"}),
        (simplefoc(), {"Ts": 0.001}, SettingError, {"name": "Ts", "expected": "0.002 to 0.5"}),
        (simplefoc(), {"volt": 0.0}, SettingError, {"name": "volt"}),
        (simplefoc(), {"speed": np.inf}, SettingError, {"name": "speed"}),
        (odrive(), {}, SettingError, {"name": "motor", "received": "none"}),
        (Talkative(simplefoc().motor), {}, LinkError, {"received": "keeps sending"}),
    ],
)
def test_a_sketch_that_cannot_be_used_is_refused(
    emulated: Emulated, options: dict[str, Any], kind: Any, fields: dict[str, str]
) -> None:
    line = Line(emulated, options.pop("baud", BAUD))
    given = {"volt": 10.0, "speed": 1500.0, "counts_per_rev": 16384.0, **options}
    with refuses(kind, **fields):
        SimpleFOC(line, clock=line, **given)
    assert emulated.motor.most == 0.0


def test_a_sketch_without_a_watchdog_is_used_where_that_is_said() -> None:
    emulated = simplefoc(watchdog=False)
    board, _ = CASES[1].board(emulated, watchdog=False)
    assert len(record(board, CASES[1].step)) == len(CASES[1].step)


@cases
def test_a_command_that_is_no_number_moves_nothing(case: Case) -> None:
    emulated = case.emulated()
    board, _ = case.board(emulated)
    u = case.step
    u[40] = np.nan
    with refuses(DataError, name="command"):
        record(board, u)
    assert emulated.motor.most == 0.0


def test_it_is_commissioned() -> None:
    emulated = simplefoc()
    board, _ = CASES[1].board(emulated, speed=1000.0)
    found = sewfast.commission(board, speed=600.0, members=2, evaluations=40)
    assert found.controller.Ts == 0.01
    assert emulated.motor.most <= 10.0
    assert is_off(emulated)


@cases
def test_the_shortest_sample_times_of_the_page(case: Case) -> None:
    """What the bytes of a sample take on the line (docs/boards.md)."""
    case.board(case.emulated(), Ts=0.006, baud=115_200)
    case.board(case.emulated(), Ts=0.002, baud=BAUD)
    with refuses(SettingError, name="Ts", expected=r"at least 0\.005\d s"):
        case.board(case.emulated(), Ts=0.005, baud=115_200)


@cases
def test_over_a_terminal_in_real_time(case: Case) -> None:
    """Every byte through a tty; Ctrl-C in the middle of the second run."""
    emulated = case.emulated()
    # on a busy computer a thread waits for tens of ms, and a sample late by more than Ts ends a run
    given = {"volt": case.volt, "speed": 1500.0, "Ts": 0.2}
    with on_a_pty(emulated) as path:
        if isinstance(emulated, EmulatedODrive):
            board: PolledBoard = ODrive(path, **given)  # type: ignore[arg-type]
        else:
            board = SimpleFOC(path, counts_per_rev=16384.0, **given)  # type: ignore[arg-type]
        with board:
            found = record(board, np.repeat([0.0, 0.5 * case.volt], [2, 8]))
            assert found.y[-1] > 0.2 * case.gain * 0.5 * case.volt
            assert is_off(emulated)
            threading.Timer(1.5, os.kill, (os.getpid(), signal.SIGINT)).start()
            with pytest.raises(KeyboardInterrupt):
                record(board, np.full(1000, 0.5 * case.volt))
            assert is_off(emulated)


def test_the_emulation_answers_as_the_firmware_does() -> None:
    """The lines of ODrive's and SimpleFOC's own documents."""
    axis = boards.odrive()
    axis.feed(b"r fw_version_minor\nf 0\nr nothing\nx\n")
    assert axis.out == b"5\r\n0.000000 0.000000\r\ninvalid property\r\nunknown command\r\n"
