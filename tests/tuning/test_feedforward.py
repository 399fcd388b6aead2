"""The feedforward of a tuned controller: made of its models, worth it on other machines, too."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sewfast import _core, signals
from sewfast.control import Controller, Feedforward, Gains, load_controller
from sewfast.control.feedforward import reduced
from sewfast.control.loop import run
from sewfast.errors import ModelFileError, SettingError
from sewfast.machine import VirtualMachine
from sewfast.models import LinearOE
from sewfast.models.rest import Rest
from sewfast.tuning import Constraints, tune
from sewfast.tuning.lead import _mirrored, _slope, choices
from sewfast.tuning.task import TuningTask

LEVELS = ((-3000.0, -6.5), (-9.0, -0.5), (0.0, 0.0), (9.0, 0.5), (3000.0, 6.5))
LEAD = Feedforward(preview=8, late=0.5, levels=LEVELS, taps=(0.01, 0.2, 0.05))
RAMP = np.clip((np.arange(1500) - 100) * 20.0, 0.0, 2500.0)
PI = Controller(
    Gains.standard(0.02, 0.1, 0.002), N=5, u_min=-20, u_max=20, filter_samples=8,
    counts_per_rev=1572, feedforward=LEAD,
)  # fmt: skip


def rms(x: Any) -> float:
    return float(np.sqrt(np.mean(np.square(x))))


def linear(a: list[float], b: list[float], delay: int = 1, **record: Any) -> LinearOE:
    core = _core.LinearModel(np.array(a), np.array([b]), delay, 0.0)
    known = {"input_range": [[-20.0, 20.0]], **record}
    return LinearOE(core, 0.001, ("u",), "y", ("V",), "RPM", ("counts", 1572.0), known)


def drive(time: float = 0.25, gain: float = 490.0, delay: int = 4) -> LinearOE:
    pole = np.exp(-0.001 / time)
    return linear([-pole], [gain * (1 - pole)], delay)


def followed(found: Any, plant: Any, reference: Any = RAMP) -> tuple[float, float]:
    """Error with the feedforward, and of the PID alone [RPM rms]."""
    runs = [run(c, plant, reference) for c in (found.controller, found.lead.alone)]
    with_it, alone = (rms(one.y - one.r) for one in runs)
    return with_it, alone


def test_a_tuned_loop_follows_what_its_model_can() -> None:
    # a search of 300 has not converged
    found = tune(drive(), [RAMP], evaluations=1000, threads=2)
    lead = found.pid.feedforward
    assert lead is not None
    assert (lead.late, found.pid.alpha, found.pid.beta) == (0.5, 0.0, 0.0)
    assert 3 <= lead.preview <= 30
    with_it, alone = followed(found, drive())
    assert with_it < 0.1 * alone
    # the feedback stays: gains, margins, recovery from loads
    assert found.lead is not None
    assert found.pid.gains == found.lead.alone.gains
    assert found.lead.cost < found.lead.alone_cost
    assert "with it and" in str(found)


@pytest.mark.parametrize(
    "plant",
    [drive(gain=612.0), drive(gain=392.0), drive(time=0.31), drive(time=0.19), drive(delay=6)],
)
def test_it_is_never_worse_on_a_plant_that_is_a_quarter_off(plant: LinearOE) -> None:
    found = tune(drive(), "trapezoid", evaluations=300, threads=2)
    for name in ("trapezoid", "random"):
        with_it, alone = followed(found, plant, name)
        assert with_it <= alone


def test_on_the_machine_that_nobody_told_it_of() -> None:
    found = tune(drive(), "trapezoid", evaluations=300, threads=2)
    with_it, alone = followed(found, VirtualMachine(), "trapezoid")
    assert with_it < 0.6 * alone


def test_without_preview_it_is_causal_and_without_feedforward_none() -> None:
    causal = tune(drive(), [RAMP], feedforward="causal", evaluations=200, threads=2)
    assert causal.pid.feedforward is None or causal.pid.feedforward.preview == 0
    none = tune(drive(), [RAMP], feedforward="none", evaluations=200, threads=2)
    assert (none.pid.feedforward, none.lead) == (None, None)
    # that of a start is of other models: it is made anew, or left out
    anew = tune(drive(), [RAMP], start=PI, evaluations=100, threads=2)
    assert anew.pid.feedforward not in (None, LEAD)
    left = tune(drive(), [RAMP], start=PI, feedforward="none", evaluations=100, threads=2)
    assert left.pid.feedforward is None
    with pytest.raises(SettingError, match="preview, causal, none"):
        tune(drive(), [RAMP], feedforward="some", evaluations=10)  # type: ignore[arg-type]


def test_a_plant_without_an_inverse_says_why() -> None:
    unstable = linear([-1.01], [4.9])
    start = Controller(Gains.standard(0.02, 0.1, 0.0), u_min=-20, u_max=20, counts_per_rev=1572)
    task = TuningTask.of(
        unstable, [RAMP], start=start, first={}, cost=None, aggregate="mean", constraints=None,
        variations=None,
    )  # fmt: skip
    assert "unstable" in choices(task, "preview").reason
    machine = replace(task, plants=[VirtualMachine()])
    assert "models" in choices(machine, "preview").reason


def test_a_position_is_led_by_its_changes_alone() -> None:
    axis = linear([-1.0], [0.02], output_range=[0.0, 100.0])
    move = np.clip((np.arange(1500) - 100) * 0.1, 0.0, 90.0)
    found = tune(axis, [move], counts_per_rev=None, evaluations=300, threads=2)
    assert found.pid.feedforward is not None
    assert found.pid.feedforward.levels == ()
    with_it, alone = followed(found, axis, move)
    assert with_it < 0.3 * alone


def test_a_limit_of_overshoot_holds_with_it() -> None:
    limited = Constraints(overshoot=1.0)
    found = tune(drive(), [RAMP], constraints=limited, evaluations=300, threads=2)
    assert run(found.controller, drive(), RAMP).metrics()["overshoot_percent"] <= 1.0


def test_it_stands_without_a_command_and_begins_early() -> None:
    loop = run(PI, VirtualMachine(), RAMP)
    moves = np.flatnonzero(loop.u)
    assert moves[0] == 101 - LEAD.preview
    assert np.all(run(PI, VirtualMachine(), np.zeros(300)).u == 0.0)


def test_the_machine_has_the_bits_of_the_controller_stepped_by_hand() -> None:
    machine, core = VirtualMachine(), PI.core()
    loop, early = run(PI, machine, RAMP), PI.early(RAMP)
    before = machine.counts
    counts = before
    for k, r in enumerate(early.tolist()):
        u = core.step(r, (counts - before) * 60.0 / (1572.0 * 0.001))
        assert u == loop.u[k]
        before = counts
        counts, _ = machine.step(u)


def test_a_shift_of_the_plant_shifts_its_levels() -> None:
    shifted = PI.about(Rest((2.0,), 100.0)).feedforward
    assert shifted is not None
    assert shifted.levels[0] == (-3100.0, -8.5)
    assert shifted.taps == LEAD.taps


def test_files_keep_it_and_refuse_what_it_cannot_be(tmp_path: Path) -> None:
    PI.save(tmp_path / "c.json")
    assert load_controller(tmp_path / "c.json") == PI
    assert "5 levels, 3 taps, preview of 8 samples" in str(PI)
    content = json.loads((tmp_path / "c.json").read_text())
    for name, value in (
        ("preview", 31),
        ("late", 2.0),
        ("taps", [1.0] * 17),
        ("levels", [{"y": 1}]),
    ):
        wrong = {**content, "feedforward": {**content["feedforward"], name: value}}
        (tmp_path / "wrong.json").write_text(json.dumps(wrong))
        with pytest.raises(ModelFileError):
            load_controller(tmp_path / "wrong.json")


@pytest.mark.parametrize(
    "given",
    [
        {"preview": -1, "taps": (1.0,)},
        {"preview": 0.5, "taps": (1.0,)},
        {"levels": ((0.0, 0.0), (0.0, 1.0))},
        {"levels": (1.0, 2.0)},
        {"taps": (float("nan"),)},
        {},
    ],
)
def test_what_cannot_be_is_refused(given: dict[str, Any]) -> None:
    with pytest.raises(SettingError):
        replace(PI, feedforward=Feedforward(**given))


def test_few_levels_draw_the_line_through_many() -> None:
    straight = [(float(y), 2.0 * y) for y in range(-9, 10)]
    assert reduced(straight) == [straight[0], straight[-1]]
    bent = [(y, u + np.sign(y)) for y, u in straight]
    assert len(reduced(bent)) == 4
    curve = [(float(y), float(np.tanh(0.3 * y))) for y in range(-30, 31)]
    assert len(reduced(curve)) == 8


def test_the_slope_at_a_level_is_that_towards_rest_and_never_that_of_friction() -> None:
    outer = 6.0 / 2991.0
    for y in (-3000.0, -1500.0, 1500.0, 3000.0):
        assert _slope(LEVELS, y, 0.0) == pytest.approx(outer)
    assert _slope(LEVELS, 5.0, 0.0) == pytest.approx(0.5 / 9.0)
    assert _slope(LEVELS, 9000.0, 0.0) == _slope(LEVELS, -9000.0, 0.0) == pytest.approx(outer)
    assert _slope(LEVELS[:1], 0.0, 0.0) == 0.0


def test_a_drive_that_runs_both_ways_is_led_both_ways() -> None:
    both = np.concatenate([RAMP, RAMP[::-1], -RAMP, -RAMP[::-1]])
    found = tune(drive(), [both], evaluations=300, threads=2)
    with_it, alone = followed(found, drive(), both)
    assert with_it < 0.1 * alone


def test_every_reference_by_name_has_its_shape() -> None:
    for name in ("trapezoid", "random"):
        r = signals.reference(name, 0)
        early = PI.early(r)
        np.testing.assert_array_equal(early[: len(r) - 8], r[8:])
        assert np.all(early[-8:] == r[-1])


def test_models_of_several_recordings_share_their_levels() -> None:
    plants = [
        replace(drive(), training={**drive().training, "output_range": [-a, a]}) for a in (2e3, 3e3)
    ]
    lead = tune(plants, [RAMP, -0.6 * RAMP], evaluations=60, threads=2).pid.feedforward
    assert lead is not None
    assert len(lead.levels) >= 2


def test_the_level_at_rest_stays_however_straight_the_line() -> None:
    line = [(float(y), 2.0 * y + 1e-4 * (y == 3)) for y in range(7)]
    assert [y for y, _ in reduced(line, always=3.0)] == [0.0, 3.0, 6.0]
    assert [y for y, _ in reduced(line)] == [0.0, 6.0]


def test_a_side_known_only_about_rest_is_the_mirror_of_the_other() -> None:
    rest = Rest((1.0,), 10.0)
    levels = [(9.0, 0.5), (11.0, 1.5), (500.0, 3.0), (1000.0, 5.0)]
    mirrored = _mirrored(levels, rest, 250.0)
    assert mirrored[:3] == [(-980.0, -3.0), (-480.0, -1.0), (9.0, 0.5)]
    assert mirrored[3:] == levels[1:]
    both = [(-900.0, -4.0), *levels]
    assert _mirrored(both, rest, 250.0) == both
