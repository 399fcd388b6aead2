"""Learning from repetitions: what models do not know goes, worse is undone, nothing diverges."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from lags import LEAD, PI, RAMP, drive, error, rms
from sewfast import (
    FitError,
    Interrupted,
    LinkError,
    MoveTable,
    SettingError,
    VirtualMachine,
    learn,
    load_table,
    plan,
    run,
)
from sewfast.arrays import FloatArray
from sewfast.commissioning import SteppedBench
from sewfast.link import VirtualDevice, connect

LED = replace(PI, feedforward=LEAD)


class Lag:
    """A lag behind an encoder, with noise on its load that no two runs share."""

    def __init__(self, gain: float = 490.0, noise: float = 0.0, load: float = 0.0) -> None:
        self.gain, self.noise, self.load = gain, noise, load
        self.random, self.runs = np.random.default_rng(0), 0
        self.late_load = 0.0
        self.reset()
        self.runs = 0

    def reset(self) -> None:
        self.counts = self.speed_rpm = self.angle = 0.0
        self.waiting = [0.0] * 3
        self.runs += 1

    def step(self, u: float) -> None:
        self.waiting.append(u)
        load = self.load + (self.late_load if self.runs > 4 else 0.0)
        push = self.waiting.pop(0) - load + self.noise * self.random.standard_normal()
        self.speed_rpm += 0.004 * (self.gain * push - self.speed_rpm)
        self.angle += self.speed_rpm / 60.0 * 1e-3
        self.counts = np.floor(1572.0 * self.angle)


def bench(**settings: float) -> SteppedBench:
    return SteppedBench(Lag(**settings), Ts=0.001, counts_per_rev=1572.0, volt=20.0, name="lag")


def errors(found: Any) -> list[float]:
    return [one.error for one in found.repetitions]


@pytest.fixture(scope="module")
def table() -> MoveTable:
    return plan(LED, drive(), RAMP, name="ramp")


@pytest.mark.parametrize("gain", [390.0, 490.0, 610.0])
def test_a_machine_that_is_a_quarter_off_is_learned(table: MoveTable, gain: float) -> None:
    found = learn(table, drive(), bench(gain=gain, noise=0.05), repetitions=6)
    assert found.contraction < 1.0
    assert found.repetitions[0].outcome == "first"
    np.testing.assert_array_equal(found.best.r, RAMP)
    assert min(errors(found)) <= errors(found)[0]
    if gain != 490.0:
        assert min(errors(found)) < 0.35 * errors(found)[0]
    played = run(LED, bench(gain=gain), table=found.table)
    plain = run(LED, bench(gain=gain), RAMP)
    assert error(played) < 0.5 * error(plain)


def test_a_changed_load_is_told_from_a_bad_table(table: MoveTable) -> None:
    machine = bench(gain=560.0, noise=0.05)
    machine.machine.late_load = 1.5
    found = learn(table, drive(), machine, repetitions=10)
    outcomes = [one.outcome for one in found.repetitions]
    assert "undone" in outcomes
    assert outcomes[outcomes.index("undone") + 1] == "repeated"
    # it goes on from what the machine has become
    assert errors(found)[-1] < errors(found)[4]


def test_what_does_not_repeat_is_not_learned(table: MoveTable) -> None:
    found = learn(table, drive(), bench(noise=3.0), repetitions=12)
    assert found.reason == "noise"
    assert "undone" in [one.outcome for one in found.repetitions]
    assert max(errors(found)) < 2.5 * errors(found)[0]
    again = [run(LED, bench(noise=3.0), table=one) for one in (table, found.table)]
    assert error(again[1]) < 1.3 * error(again[0])


class Wild(SteppedBench):
    """Its counts answer a correction with the wrong sign: no model says so."""

    def follow(self, controller: Any, r: FloatArray, name: str, **options: Any) -> Any:
        found = super().follow(controller, r, name, **options)
        wrong = np.cumsum(r - self.planned) * -3.0  # type: ignore[attr-defined]
        counts = np.floor(found.recording.counts + wrong * self.Ts * self.counts_per_rev / 60.0)
        return replace(found, recording=replace(found.recording, counts=counts))


def test_a_machine_that_turns_a_correction_round_keeps_the_plan(table: MoveTable) -> None:
    machine = Wild(Lag(gain=430.0), Ts=0.001, counts_per_rev=1572.0, volt=20.0, name="wild")
    object.__setattr__(machine, "planned", table.planned)
    found = learn(table, drive(), machine, repetitions=8)
    assert rms(found.table.setpoint - table.planned) < 100.0
    assert errors(found)[-1] < 4.0 * errors(found)[0]
    assert {"undone", "repeated"} <= {one.outcome for one in found.repetitions}


def test_the_file_has_the_best_so_far_and_is_gone_on_from(table: MoveTable, tmp_path: Path) -> None:
    place, machine = tmp_path / "t.json", bench(gain=390.0)

    class Pulled(SteppedBench):
        def follow(self, *given: Any, **options: Any) -> Any:
            if self.machine.runs >= 2:  # type: ignore[attr-defined]
                raise LinkError("unplugged")
            return super().follow(*given, **options)

    pulled = Pulled(machine.machine, Ts=0.001, counts_per_rev=1572.0, volt=20.0, name="lag")
    with pytest.raises(LinkError):
        learn(table, drive(), pulled, repetitions=6, file=place)
    kept = load_table(place)
    assert [one.number for one in kept.repetitions] == [1, 2]
    found = learn(kept, drive(), bench(gain=390.0), repetitions=3, file=place)
    assert [one.number for one in found.repetitions] == [1, 2, 3, 4, 5]
    assert found.repetitions[2].error == pytest.approx(kept.repetitions[1].error, rel=0.2)
    np.testing.assert_array_equal(load_table(place).setpoint, found.table.setpoint)


def test_ctrl_c_keeps_the_best_so_far(table: MoveTable) -> None:
    def press(done: int, total: int, text: str) -> None:
        if done == 2:
            raise KeyboardInterrupt

    with pytest.raises(Interrupted) as stop:
        learn(table, drive(), bench(gain=390.0), progress=press)
    best = stop.value.best
    assert len(best.repetitions) == 2
    assert best.best is not None
    assert best.reason == "interrupted"
    again = learn(best.table, drive(), bench(gain=390.0), repetitions=1)
    assert again.repetitions[-1].error == pytest.approx(best.repetitions[-1].error, rel=0.2)


def test_lost_samples_do_not_undo_a_table(table: MoveTable) -> None:
    class Lossy(SteppedBench):
        def follow(self, *args: Any, **options: Any) -> Any:
            run = super().follow(*args, **options)
            known = run.recording
            counts, y = known.counts.astype(float), known.y.copy()
            counts[40::97] = y[40::97] = np.nan
            return replace(run, recording=replace(known, counts=counts, y=y))

    whole = learn(table, drive(), bench(gain=390.0), repetitions=3)
    lossy = Lossy(Lag(gain=390.0), Ts=0.001, counts_per_rev=1572.0, volt=20.0)
    found = learn(table, drive(), lossy, repetitions=3)
    np.testing.assert_allclose(errors(found), errors(whole), rtol=0.3)


def test_it_learns_on_a_device(table: MoveTable) -> None:
    with VirtualDevice(fast=True) as device, connect(device.port) as drive_:
        drive_.set_limits(volt=20.0, speed_rpm=4000.0)
        found = learn(table, drive(), drive_, repetitions=3)
    assert errors(found)[-1] < 0.6 * errors(found)[0]
    here = learn(table, drive(), VirtualMachine(), repetitions=1)
    assert errors(here)[0] == pytest.approx(errors(found)[0], rel=0.2)
    assert "repetition  3" in str(found)


def test_what_cannot_be_learned_is_refused(table: MoveTable) -> None:
    still = plan(LED, drive(), np.zeros(200))
    with pytest.raises(FitError, match="nothing to learn"):
        learn(still, drive(), bench())
    with pytest.raises(SettingError, match="repetitions"):
        learn(table, drive(), bench(), repetitions=0)
    slow = SteppedBench(Lag(), Ts=0.002, counts_per_rev=1572.0, volt=20.0)
    with pytest.raises(SettingError, match="sample time"):
        learn(table, drive(), slow)
