"""Slow drives (simulated on every k-th sample) and what small signals show of resonances."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from commissioned import SMALL, short
from sewfast import Controller, Gains, VirtualMachine, _core, commission
from sewfast.commissioning.gains import ruled
from sewfast.commissioning.slow import HARMONICS, MOST, PER_CONSTANT, SHARPEST, Thinning, TurnLoad
from sewfast.commissioning.small_signal import (
    Resonance,
    Shaken,
    SmallSignal,
    _is_seen,
    explained,
)
from sewfast.control import Feedforward, Fopdt
from sewfast.control.feedforward import AHEAD, TAPS
from sewfast.control.loop import run
from sewfast.control.margins import margins
from sewfast.control.record import record
from sewfast.recording import Recording
from sewfast.tuning.objective import Cost


def recorded(samples: int = 1003) -> Recording:
    u = 2.0 + np.random.default_rng(0).normal(0.0, 0.5, samples)
    return record(VirtualMachine(), u, name="noise")


def controller(samples: int = 8) -> Controller:
    return Controller(
        gains=Gains.standard(0.02, 0.06, 0.004), alpha=0.3, beta=-0.5, N=10.0, u_min=-20.0,
        u_max=20.0, filter_samples=samples, filter_time=0.004, counts_per_rev=1572.0,
    )  # fmt: skip


@pytest.mark.parametrize(
    ("T", "k"), [(0.2, 1), (0.39, 1), (0.6, 3), (2.0, 10), (50.0, MOST)]
)  # fmt: skip
def test_it_follows_the_time_constant(T: float, k: int) -> None:
    fopdt = Fopdt(K=400.0, T=T, L=0.01)
    assert Thinning.of(fopdt, 1e-3, None).k == k
    # at another sample time the same samples of a time constant
    assert Thinning.of(replace(fopdt, T=10.0 * T), 1e-2, None).k == k
    assert T / (k * 1e-3) >= PER_CONSTANT - 5 or k == 1


def test_a_resonance_is_not_folded() -> None:
    model = None
    small = SmallSignal(model, Resonance(60.0, 0.02), None)  # type: ignore[arg-type]
    assert Thinning.of(Fopdt(K=400.0, T=2.0, L=0.01), 1e-3, small).k == 1


def test_a_fast_drive_is_left_as_it_is() -> None:
    same, recording = Thinning(), recorded(200)
    assert same.recording(recording) is recording
    assert same.coarse(controller()) == same.fine(controller()) == controller()
    assert same.variations() is None


def test_commands_are_averaged_and_counts_are_picked() -> None:
    whole, thin = recorded(), Thinning(10).recording(recorded())
    assert thin.Ts == pytest.approx(0.01)
    assert len(thin) == 101
    np.testing.assert_array_equal(thin.counts, whole.counts[::10])
    np.testing.assert_allclose(thin.u[:100], whole.u[:1000].reshape(100, 10).mean(axis=1))
    assert thin.u[100] == pytest.approx(whole.u[1000:].mean())
    assert whole.speed_true is not None
    # the speed is that of the samples that are left
    error = thin.y[20:] - whole.speed_true[::10][20:]
    assert np.sqrt(np.mean(error**2)) < 0.02 * np.ptp(whole.speed_true)


def test_a_rule_is_told_of_the_delay_of_coarse_samples() -> None:
    fopdt = Fopdt(K=500.0, T=2.0, L=0.002)
    assert Thinning().plant(fopdt, 1e-3) is fopdt
    thinning = Thinning(10)
    coarse = thinning.coarse(controller())
    told = thinning.plant(fopdt, 1e-3)
    assert pytest.approx(0.011) == told.L
    assert margins(ruled(told, coarse), fopdt).Ms < 2.0


def test_chatter_counts_as_it_will_on_the_machine() -> None:
    cost = Cost(chatter=5.0)
    assert Thinning().cost(cost) is cost
    assert Thinning(4).cost(cost) == Cost(chatter=2.5)
    assert Thinning(4).cost(Cost()) == Cost()


def test_a_controller_converts_there_and_back() -> None:
    thinning = Thinning(10)
    coarse = thinning.coarse(controller(20))
    assert (coarse.Ts, coarse.filter_samples) == (0.01, 2)
    assert coarse.gains == controller().gains
    # .4 ms of derivative filter are less than 10 ms of sample time are
    assert coarse.N == SHARPEST
    softer = replace(coarse, N=5.0)
    fine = thinning.fine(softer)
    assert (fine.Ts, fine.filter_samples) == (0.001, 20)
    assert pytest.approx(0.004 / 5.0 + 0.01) == 0.004 / fine.N + 0.001
    back = thinning.coarse(fine)
    assert pytest.approx(5.0) == back.N
    assert replace(back, N=5.0) == softer
    assert thinning.coarse(controller(3)).filter_samples == 1
    assert thinning.fine(replace(coarse, filter_samples=20)).filter_samples == 64


@pytest.mark.parametrize("k", [2, 3, 5, 10])
def test_a_feedforward_is_converted_there_and_back(k: int) -> None:
    for preview in range(AHEAD // k + 1):
        taps = tuple(0.1 / (1 + i) for i in range(TAPS // k))
        coarse = Feedforward(preview, 0.5, ((0.0, 0.0), (2000.0, 12.0)), taps)
        softer = replace(Thinning(k).coarse(controller()), N=5.0, feedforward=coarse)
        fine = Thinning(k).fine(softer)
        assert fine.feedforward is not None
        assert len(fine.feedforward.taps) == k * (TAPS // k)
        assert Thinning(k).coarse(fine).feedforward == coarse


def test_the_converted_feedforward_commands_the_same() -> None:
    k, r = 3, np.concatenate([np.zeros(60), np.linspace(0.0, 900.0, 600), np.full(240, 900.0)])
    lead = Feedforward(4, 0.5, ((0.0, 0.0), (2000.0, 12.0)), (0.05, -0.02, 0.01))
    without = replace(controller(), gains=Gains.standard(1e-12, 1.0), alpha=0.0, beta=0.0)
    coarse = replace(Thinning(k).coarse(without), feedforward=lead)
    fine = replace(without, feedforward=Thinning(k).fine(coarse).feedforward)
    each = [c.core() for c in (coarse, fine)]
    thin = [each[0].step(float(x), 0.0) for x in coarse.early(r[::k])]
    full = [each[1].step(float(x), 0.0) for x in fine.early(r)]
    # the held command is the mean over its samples wherever the reference does not bend
    means = np.reshape(full, (-1, k)).mean(axis=1)
    assert np.abs(means - thin)[40:200].max() < 1e-6
    # and at a bend less off than one of the machine's samples changes it
    assert np.abs(means - thin).max() < 0.05 * 1.5


def test_the_converted_controller_does_the_same() -> None:
    machine, thinning = VirtualMachine(), Thinning(4)
    r = np.concatenate([np.linspace(0.0, 1000.0, 2000), np.full(1000, 1000.0)])
    gentle = replace(controller(8), gains=Gains.standard(0.01, 0.2))
    fine = run(gentle, machine, r)
    alike = thinning.run(fine)
    assert (len(alike.y), alike.Ts) == (750, 0.004)
    np.testing.assert_array_equal(alike.y, fine.y[::4])
    # one that decides at every fourth sample only, by the converted gains
    core = thinning.coarse(gentle).core()
    machine_y = 0.0
    model = Slow()
    y = []
    for k in range(len(r)):
        if k % 4 == 0:
            u = core.step(float(r[k]), machine_y)
        machine_y = model.step(u)
        y.append(machine_y)
    held, same = Slow(), gentle.core()
    z, now = [], 0.0
    for k in range(len(r)):
        now = held.step(same.step(float(r[k]), now))
        z.append(now)
    assert np.sqrt(np.mean((np.array(y) - np.array(z)) ** 2)) < 5.0


class Slow:
    """500 RPM/V, a time constant of one second."""

    y = 0.0

    def step(self, u: float) -> float:
        self.y += 1e-3 * (500.0 * u - self.y)
        return self.y


def test_a_load_over_the_turn_is_averaged_and_not_folded() -> None:
    # the sixth harmonic at 1,000 RPM is 100 Hz: picked every 10 ms it would be a constant
    load = TurnLoad(np.eye(HARMONICS)[5], np.zeros(HARMONICS))
    r = {"hold": np.full(1000, 1000.0)}
    found = Thinning(10).pushes(load, r, 1e-3)
    assert found is not None
    assert np.abs(found[0]).max() < 1e-6
    assert np.abs(load.along(r["hold"], 1e-3)[::10]).min() > 0.99
    assert Thinning(10).pushes(None, r, 1e-3) is None


@pytest.mark.nightly("a commissioning of a slow drive")
def test_a_commissioning_on_every_third_sample(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(Thinning, "of", lambda *_: Thinning(3))
    r = np.concatenate([np.linspace(0.0, 900.0, 500), np.full(400, 900.0)])
    with short():
        found = commission(VirtualMachine(), references={"mine": r}, **{**SMALL, "members": 1})
    assert found.is_verified
    assert found.sample_time == pytest.approx(0.003)
    assert found.controller is not None
    assert found.models is not None
    assert found.tuning is not None
    assert (found.controller.Ts, found.models.Ts) == pytest.approx((0.001, 0.003))
    assert found.tuning.controller.Ts == pytest.approx(0.003)
    (c,) = found.comparisons
    assert c.measured is not None
    assert c.alike is not None
    assert (len(c.predicted.r), len(c.measured.r), len(c.alike.r)) == (300, 900, 300)
    np.testing.assert_array_equal(c.alike.r, c.predicted.r)
    assert c.apart == pytest.approx(np.sqrt(np.mean((c.measured.y[::3] - c.predicted.y) ** 2)))
    assert "mine, measured" in found.save(tmp_path / "out").read_text()


def shaken(frequency: float | None, seed: int) -> Shaken:
    """A drive of .2 s about a speed, its counts and, with a frequency, a shaft [Hz]."""
    u = 6.0 + _core.prbs(duration=4.0, Ts=1e-3, low=-1.0, high=1.0, hold=2e-3, seed=seed)
    y, swing, rate = np.full(len(u), 600.0), 0.0, 0.0
    for k in range(1, len(u)):
        y[k] = y[k - 1] + 5e-3 * (100.0 * u[k - 1] - y[k - 1])
        if frequency is not None:
            omega = 2.0 * np.pi * frequency
            rate += 1e-3 * (omega**2 * (0.02 * (u[k] - 6.0) - swing) - 0.04 * omega * rate)
            swing += 1e-3 * rate
            y[k] += 100.0 * 1e-3 * rate
    counts = np.round(np.cumsum(y) * 1e-3 / 60.0 * 1572.0)
    speed = np.diff(counts, prepend=0.0) * 60.0 / (1572.0 * 1e-3)
    return Shaken(u, speed, counts / 1572.0, 1e-3, "shaken")


@pytest.mark.parametrize(("frequency", "seen"), [(60.0, True), (None, False), (90.0, False)])
def test_a_resonance_shows_in_a_second_record(frequency: float | None, seen: bool) -> None:
    fopdt = Fopdt(K=100.0, T=0.2, L=0.002)
    first = explained(shaken(60.0, 0), fopdt)
    assert first is not None
    assert first.resonance is not None
    assert first.resonance.frequency == pytest.approx(60.0, rel=0.02)
    assert _is_seen(first.resonance, shaken(frequency, 1), fopdt) is seen
    calm = explained(shaken(60.0, 0), fopdt, swings=False)
    assert calm is not None
    assert calm.resonance is None
