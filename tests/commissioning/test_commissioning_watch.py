"""A run of the verification that goes wrong is ended while it does."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from commissioned import SMALL, short
from loops import QUIET, drive
from sewfast import Controller, Gains, VirtualMachine, commission, run
from sewfast.commissioning import Refusal
from sewfast.commissioning.bench import Aborted, Guard, RecordedBench
from sewfast.commissioning.verification import Watching, measure, predict, restless
from sewfast.control.benches import MachineBench, SteppedBench
from sewfast.control.controller import SampledController
from sewfast.control.machine import WATCHED, RecordedRun, Watch
from sewfast.dataset import FloatArray
from sewfast.link import VirtualDevice, connect
from sewfast.models import Ensemble
from sewfast.recording import Recording
from sewfast.tuning.objective import Cost

R = np.concatenate([np.linspace(0.0, 1500.0, 400), np.full(4600, 1500.0)])
FIERCE = Controller(
    Gains.standard(0.5, 0.05), u_min=-20.0, u_max=20.0, filter_samples=8, counts_per_rev=1572.0
)
"""Swings on the virtual machine from limit to limit."""


def watching(controller: Controller = QUIET) -> Watching:
    """Of a loop that is predicted to be quiet."""
    return Watching(run(QUIET, VirtualMachine(), R, name="hold"), controller, 1572.0)


def test_a_run_that_does_as_predicted_ends_by_itself() -> None:
    found = MachineBench(VirtualMachine()).follow(QUIET, R, "hold", watch=watching())
    assert len(found.r) == len(R)


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("samples", [1, 2, 30, 2000])
def test_short_references_and_what_a_link_has_lost_end_nothing(samples: int) -> None:
    watch = Watching(run(QUIET, VirtualMachine(), np.zeros(samples)), QUIET, 1572.0)
    for first in range(0, samples + 40, 7):
        watch(first, np.full(7, np.nan), np.full(7, np.nan))
    watch = Watching(run(QUIET, VirtualMachine(), R), QUIET, 1572.0)
    watch(0, np.zeros(20), np.zeros(20))
    watch(600, np.zeros(20), np.zeros(20))


def on_virtual(watch: Watch) -> None:
    MachineBench(VirtualMachine()).follow(FIERCE, R, "hold", watch=watch)


def on_stepped(watch: Watch) -> None:
    on = SteppedBench(Steps(), Ts=1e-3, counts_per_rev=1572.0, volt=20.0)
    on.follow(FIERCE, R, "hold", watch=watch)


def on_drive(watch: Watch) -> None:
    with VirtualDevice() as device, connect(device.port) as there:
        there.set_limits(volt=20.0, speed_rpm=4000.0)
        try:
            there.follow(FIERCE, R, "hold", watch=watch)
        finally:
            assert there.status().state == "idle"


@pytest.mark.parametrize(
    "followed", [on_virtual, on_stepped, pytest.param(on_drive, marks=pytest.mark.alone)]
)
def test_a_loop_that_swings_is_ended_within_a_second(followed: Callable[[Watch], None]) -> None:
    with pytest.raises(Aborted, match=r"'hold', ended after .* as in a loop that swings") as stop:
        followed(watching(FIERCE))
    recording = stop.value.recording
    assert 0.25 <= len(recording) * 1e-3 < 1.0
    assert np.ptp(recording.u) > 2.0


class Steps:
    """The virtual machine, sample by sample."""

    def __init__(self) -> None:
        self.machine, self.held = VirtualMachine(), [0.0]

    def reset(self) -> None:
        self.machine.reset()

    def step(self, u: float) -> None:
        self.counts = float(self.machine.run(np.array([u])).counts[-1])

    counts = 0.0


def test_a_machine_that_parts_from_the_prediction_is_stopped_where_that_is_certain() -> None:
    weak = MachineBench(VirtualMachine(parameters={"current_limit": 0.7}))
    with pytest.raises(Aborted, match=r"within 5 % of the span|within its limits") as stop:
        weak.follow(QUIET, R, "hold", watch=watching())
    ended = len(stop.value.recording)
    assert ended < 0.7 * len(R)
    # run to its end it would have been refused as well
    predicted = run(QUIET, VirtualMachine(), R).y
    whole = weak.follow(QUIET, R, "hold")
    assert np.sqrt(np.mean((whole.y - predicted) ** 2)) > 0.05 * 1500.0


def test_what_was_recorded_is_kept_and_a_machine_that_cannot_be_watched_runs_on() -> None:
    kept: dict[str, Recording] = {}

    class Own:
        name, Ts, counts_per_rev, volt, speed = "own", 1e-3, 1572.0, 20.0, np.inf
        inner = MachineBench(VirtualMachine(parameters={"current_limit": 0.7}))

        def excite(self, u: FloatArray, name: str) -> Recording:
            return self.inner.excite(u, name)

        def follow(self, controller: Controller, r: FloatArray, name: str) -> RecordedRun:
            return self.inner.follow(controller, r, name)

    class Watched(Own):
        def follow(
            self, controller: Controller, r: FloatArray, name: str, *, watch: Watch | None = None
        ) -> RecordedRun:
            return self.inner.follow(controller, r, name, watch=watch)

    def note(name: str, key: str, recording: Recording, found: Any) -> None:
        kept[name] = recording

    predicted = predict(QUIET, Ensemble.of([drive()]), {"hold": R})
    for machine, name in ((Watched(), "hold_aborted"), (Own(), "hold")):
        kept.clear()
        on = RecordedBench(machine, note, lambda *_: None, lambda *_: None)
        with pytest.raises(Refusal, match=r"the controller is not verified|limits most"):
            measure(QUIET, on, predicted, {"hold": R}, lambda _: None, Cost())
        assert list(kept) == [name]
    assert len(kept["hold"]) == len(R)


@pytest.mark.nightly("a commissioning of its own; what it watches runs by day")
def test_a_commissioning_names_the_reference_and_keeps_what_was_recorded(tmp_path: Path) -> None:
    class Changes(MachineBench):
        """Loses most of its current as the references begin."""

        def follow(
            self, controller: Controller, r: FloatArray, name: str, *, watch: Watch | None = None
        ) -> RecordedRun:
            if name == "trapezoid":
                weak = VirtualMachine(parameters={"current_limit": 0.7})
                object.__setattr__(self, "machine", weak)
            return super().follow(controller, r, name, watch=watch)

    with short(), pytest.raises(Refusal, match=r"ended after .* s: expected") as refused:
        commission(Changes(VirtualMachine()), **SMALL, folder=tmp_path)
    assert refused.value.so_far is not None
    assert any(name.endswith("_aborted") for name in refused.value.so_far.recordings)
    assert list((tmp_path / "unfinished").glob("*_aborted.mcap"))


class Fails(SteppedBench):
    """A machine whose encoder or amplifier fails a second into the first long run."""

    def __init__(self, what: str) -> None:
        super().__init__(Failing(), 1e-3, 1572.0, 20.0)
        self.machine.what = what  # type: ignore[attr-defined]

    def follow(
        self, controller: SampledController, r: FloatArray, name: str, *, watch: Watch | None = None
    ) -> RecordedRun:
        if name == "trapezoids":
            self.machine.left = 1000  # type: ignore[attr-defined]
        return super().follow(controller, r, name, watch=watch)


class Failing:
    """300 RPM per volt, a time constant of 80 ms."""

    what, left = "", math.inf
    speed = angle = counts = held = 0.0
    railed = 0

    def reset(self) -> None:
        self.speed = self.angle = self.counts = 0.0

    def step(self, u: float) -> None:
        self.left -= 1
        is_out = self.left < 0
        self.railed += abs(u) >= 19.99
        self.held = u if not is_out else self.held
        u = self.held if self.what == "stage" else u
        self.speed += 0.0125 * (
            300.0 * (0.0 if is_out and self.what == "amplifier" else u) - self.speed
        )
        self.angle += self.speed * 1e-3 / 60.0
        if not (is_out and self.what == "encoder"):
            self.counts = math.floor(1572.0 * self.angle)


@pytest.mark.parametrize("what", ["encoder", "amplifier"])
def test_a_loop_without_encoder_or_amplifier_is_ended_and_named(what: str) -> None:
    on = Fails(what)
    with short(), pytest.raises(Refusal, match="expected the encoder to move") as refused:
        commission(on, **SMALL)
    assert refused.value.stage == "closed loop"
    assert refused.value.so_far is not None
    cause = refused.value.so_far.cause
    assert cause is not None
    assert cause.name == {"encoder": "encoder lost", "amplifier": "stage off"}[what]
    assert cause.run == "trapezoids"
    # a quarter of a second without a count, and a block; a motor without amplifier coasts before
    most = {"encoder": 250, "amplifier": 1000}[what] + WATCHED
    assert on.machine.railed <= most  # type: ignore[attr-defined]


def test_a_loop_whose_stage_sticks_is_not_out_of_reach() -> None:
    with short(), pytest.raises(Refusal, match="command within its limits") as refused:
        commission(Fails("stage"), **SMALL)
    assert refused.value.cause is not None
    assert refused.value.cause.name == "stage stuck"
    assert "raise" not in str(refused.value)


@pytest.mark.parametrize("hertz", [3.0, 20.0, 60.0])
def test_a_command_that_goes_from_limit_to_limit_ends_a_run(hertz: float) -> None:
    guard = Guard(QUIET, "hold", 1572.0)
    t = np.arange(5000) * 1e-3
    u, counts = 20.0 * np.sign(np.sin(2 * np.pi * hertz * t + 0.1)), np.arange(5000.0)
    with pytest.raises(Aborted, match="8 times in a row from limit to limit") as stop:
        guard(0, u, counts)
    assert stop.value.frequency == pytest.approx(hertz, rel=0.1)
    assert len(stop.value.recording) <= 1000 * 9 / (2 * hertz)


@pytest.mark.parametrize(
    "u",
    [
        20.0 * np.sign(np.sin(2 * np.pi * 1.5 * np.arange(5000) * 1e-3)),
        18.0 * np.sin(2 * np.pi * 20.0 * np.arange(5000) * 1e-3),
        np.full(5000, 20.0),
    ],
    ids=["slower than a swing", "within the limits", "one limit"],
)
def test_a_command_that_does_not_swing_ends_no_run(u: FloatArray) -> None:
    guard = Guard(QUIET, "hold", 1572.0)
    guard(0, u, np.arange(5000.0))


def test_a_motor_that_stands_under_a_small_command_ends_no_run() -> None:
    guard = Guard(QUIET, "hold", 1572.0)
    guard(0, np.full(5000, 9.9), np.zeros(5000))
    guard(5000, np.full(245, 20.0), np.zeros(245))
    with pytest.raises(Aborted, match=r"not a count for \.25 s at 20 V") as stop:
        guard(5245, np.full(20, 20.0), np.zeros(20))
    assert len(stop.value.recording) == 5251


def test_a_loop_is_restless_if_it_swings_at_a_level_and_costs_twice_as_much() -> None:
    predicted = predict(QUIET, Ensemble.of([drive()]), {"hold": R})[0]
    expected = predicted.predicted
    swing = np.sin(2.0 * np.pi * 20.0 * expected.t)
    off = 10.0 * float(np.sqrt(np.mean((expected.r - expected.y) ** 2)))

    def swings(volts: float, rpm: float) -> float | None:
        run = replace(expected, u=expected.u + volts * swing, y=expected.y + rpm * swing)
        found = restless(replace(predicted, measured=run), Cost())
        return None if found is None else found.frequency

    assert swings(1.0, off) == pytest.approx(20.0, abs=1.0)
    assert swings(0.0, off) is None
    assert swings(1e-3, 0.0) is None
    assert swings(0.0, 0.0) is None
