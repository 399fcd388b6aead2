"""`tune` and `run` on drives that nobody named: limits, filter, references from the record."""

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import sewfast
from documents import Command
from refusals import refuses
from sewfast.control import Controller, Gains, load_controller
from sewfast.control.defaults import (
    catalogue_fits,
    default_references,
    drive_references,
    drive_step,
    filter_length,
    recorded_limits,
)
from sewfast.errors import FitError, SettingError
from sewfast.evidence.region import training_region
from sewfast.models import LinearOE
from sewfast.trust import judge
from sewfast.tuning import first_controller
from terminal import Terminal

TS = (0.0002, 0.001, 0.005, 0.02, 0.05)
FAMILY = [
    # sample time [s], time constant in samples, gain [y/u], command [u], damping, unit
    pytest.param(Ts, samples, gain, u, damping, unit, id=f"{Ts:g} s, {unit}, gain {gain:g}, {u}")
    for (Ts, samples, gain, u, damping, unit) in [
        (TS[0], 100, 0.05, (-24.0, 24.0), None, "rad/s"),
        (TS[0], 60, 500.0, (0.0, 3.0), 1.2, "deg/s"),
        (TS[0], 250, -5.0, (-10.0, 10.0), None, "RPM"),
        (TS[1], 40, 490.0, (0.0, 5.0), None, "RPM"),
        (TS[1], 250, 3.0, (-1.0, 1.0), 1.5, "rad/s"),
        (TS[1], 30, 5.0, (-12.0, 12.0), 0.6, "RPM"),
        (TS[2], 20, 5.0, (-1.0, 1.0), None, "rad/s"),
        (TS[2], 60, 0.3, (0.0, 24.0), 1.2, "rev/s"),
        (TS[2], 40, 60.0, (-6.0, -1.0), None, "deg/s"),
        (TS[3], 8, 162.0, (1.45, 2.7), None, "rad/s"),
        (TS[3], 30, 20.0, (-10.0, 10.0), 0.8, "mm/s"),
        (TS[4], 10, 0.05, (-5.0, 5.0), None, "RPM"),
        (TS[4], 20, 500.0, (0.0, 10.0), 1.0, "counts/s"),
    ]
]


def drive(
    Ts: float,
    T: float,
    gain: float,
    u: tuple[float, float],
    damping: float | None = None,
    unit: str = "rad/s",
) -> LinearOE:
    """A lag, or two with a damping, that was recorded between the commands u."""
    if damping is None:
        den = np.array([1.0, -math.exp(-Ts / T)])
    else:
        roots = np.roots([T**2, 2.0 * damping * T, 1.0])
        den = np.poly(np.exp(roots * Ts)).real
    b = gain * den.sum() / (len(den) - 1)
    num = np.r_[0.0, np.full(len(den) - 1, b)]
    model = LinearOE.from_tf(num, den, Ts, input_units=["V"], output_unit=unit)
    went = sorted(gain * end for end in (min(0.0, *u), max(0.0, *u)))
    return replace(model, training={"input_range": [list(u)], "output_range": went})


@pytest.mark.parametrize(("Ts", "samples", "gain", "u", "damping", "unit"), FAMILY)
def test_tune_with_no_option_ends_with_a_loop_that_tracks(
    Ts: float,
    samples: float,
    gain: float,
    u: tuple[float, float],
    damping: float | None,
    unit: str,
) -> None:
    model = drive(Ts, samples * Ts, gain, u, damping, unit)
    found = sewfast.tune(model, evaluations=300, threads=2)
    controller = found.controller
    assert (controller.u_min, controller.u_max) == (min(0.0, *u), max(0.0, *u))
    assert "from the recorded input" in controller.notes
    assert controller.gains.y_unit == unit
    assert controller.counts_per_rev is None
    assert controller.filter_samples * Ts <= max(Ts, 0.1001 * drive_step(model, *u).slowest)
    for reference in default_references(model, controller, ("trapezoid", "random")):
        told = sewfast.run(controller, model, reference)
        metrics = told.metrics()
        span = float(np.ptp(told.r))
        assert span > 0.3 * abs(gain) * max(map(abs, u))
        assert metrics["rmse"] is not None
        assert metrics["rmse"] < 0.03 * span
        assert metrics["saturated"] is not None
        assert metrics["saturated"] < 0.25


def servo(
    Ts: float, T: float, gain: float, u: tuple[float, float], delay: int = 1, drift: float = 0.0
) -> LinearOE:
    """A position: a rate of `gain` [y/s/u] behind a lag, recorded for a second each way."""
    a = math.exp(-Ts / T)
    k = gain * Ts
    num = np.r_[np.zeros(delay), k * (1.0 - T / Ts * (1.0 - a)), k * (T / Ts * (1.0 - a) - a)]
    den = np.poly([1.0 - drift, a])
    model = LinearOE.from_tf(num, den, Ts, input_units=["V"], output_unit="mm")
    went = sorted(gain * end for end in u)
    return replace(model, training={"input_range": [list(u)], "output_range": went})


SERVOS = [
    # sample time [s], time constant [s], gain [y/s/u], command [u], delay in samples, drift
    (0.0002, 0.004, 3000.0, (-10.0, 10.0), 1, 0.0),
    (0.001, 0.03, -20.0, (-24.0, 24.0), 3, 0.0),
    (0.001, 0.3, 1.0e4, (-12.0, 9.0), 1, 1e-6),
    (0.005, 0.06, 40.0, (-3.0, 3.0), 1, 2e-5),
    (0.01, 0.02, 0.5, (-5.0, 5.0), 5, 0.0),
    (0.02, 0.4, 100.0, (-1.0, 2.0), 2, 0.0),
]


@pytest.mark.nightly(
    "every axis",
    by_day=[
        "0.0002-0.004-3000.0-u0-1-0.0",
        "0.005-0.06-40.0-u3-1-2e-05",
        "0.02-0.4-100.0-u5-2-0.0",
    ],
)
@pytest.mark.parametrize(("Ts", "T", "gain", "u", "delay", "drift"), SERVOS)
def test_a_position_is_tuned_with_no_option(
    Ts: float, T: float, gain: float, u: tuple[float, float], delay: int, drift: float
) -> None:
    model = servo(Ts, T, gain, u, delay, drift)
    low, high = model.training["output_range"]
    first = first_controller(model)
    assert "SIMC for an integrator" in first.notes
    controller = sewfast.tune(model, evaluations=200, threads=2).controller
    for reference in default_references(model, controller, ("trapezoid", "random")):
        run = sewfast.run(controller, model, reference)
        assert low - 1e-9 <= run.r.min() < run.r.max() <= high + 1e-9
        assert run.metrics()["rmse"] < 0.04 * np.ptp(run.r)
    # a machine that is not quite the model; the first controller is no worse than slow
    other = servo(Ts, 1.3 * T, 0.8 * gain, u, delay + 1)
    for one in (first, controller):
        run = sewfast.run(one, other, sewfast.run(one, model).r)
        assert run.metrics()["rmse"] < 0.25 * np.ptp(run.r)
        assert abs(run.y[-1] - run.r[-1]) < 0.05 * np.ptp(run.r)


def test_a_spare_pole_at_1_is_no_position() -> None:
    slow, spare = math.exp(-0.05), 1.0 - 5e-5
    num = 0.1 * np.convolve([0.0, 1.0 - slow], [1.0, -spare * (1.0 - 1e-7)])
    model = LinearOE.from_tf(num, np.poly([slow, spare]), 0.01, input_units=["V"], output_unit="mm")
    model = replace(model, training={"input_range": [[-5.0, 5.0]], "output_range": [-0.5, 0.5]})
    assert "Table 1" in first_controller(model).notes
    assert drive_references(model, -5.0, 5.0)["trapezoid"].max() < 0.5


@pytest.mark.nightly(
    "every pole between the two", by_day=["0.02-0.0", "0.02-0.0002", "0.08-0.00012", "0.08-0.0004"]
)
@pytest.mark.parametrize("drift", [0.0, 8e-5, 1.2e-4, 2e-4, 2.4e-4, 2.6e-4, 4e-4])
@pytest.mark.parametrize("T", [0.02, 0.08])
def test_between_a_position_and_a_slow_lag_there_is_no_gap(T: float, drift: float) -> None:
    """Friction and noise put a position's pole a little below 1, where no step settles in time."""
    model = servo(0.002, T, 300.0, (-8.0, 8.0), drift=drift)
    controller = sewfast.tune(model, evaluations=200).controller
    run = sewfast.run(controller, model)
    low, high = model.training["output_range"]
    assert np.ptp(run.r) > 0.1 * (high - low)
    assert run.metrics()["rmse"] < 0.04 * np.ptp(run.r)


def test_a_position_that_cannot_return_needs_references() -> None:
    with pytest.raises(SettingError, match="limits that move a position both ways"):
        sewfast.tune(servo(0.01, 0.1, 5.0, (0.0, 10.0)), evaluations=4)


@pytest.mark.nightly("many drives")
@settings(max_examples=25, deadline=None)
@given(
    Ts=st.floats(1e-4, 0.1),
    samples=st.floats(2.0, 60.0),
    gain=st.floats(-2.0, 3.0),
    sign=st.sampled_from([-1.0, 1.0]),
    low=st.floats(-20.0, 20.0),
    width=st.floats(0.1, 20.0),
    damping=st.none() | st.floats(0.3, 2.0),
)
def test_references_stay_within_what_was_recorded_at_a_pace_within_the_limits(
    Ts: float,
    samples: float,
    gain: float,
    sign: float,
    low: float,
    width: float,
    damping: float | None,
) -> None:
    model = drive(Ts, samples * Ts, sign * 10.0**gain, (low, low + width), damping)
    limits = recorded_limits([model])
    assert limits is not None
    assert limits[0] <= 0.0 <= limits[1]
    first, last = model.training["output_range"]
    step = drive_step(model, *limits)
    room = 1e-6 * (last - first)
    for name, r in drive_references(model, *limits).items():
        assert np.isfinite(r).all(), name
        assert len(r) > 20, name
        assert r.min() >= first - room, name
        assert r.max() <= last + room, name
        assert np.ptp(r) > 0.08 * (last - first), name
        # the command that the plant would ask for, had it only the gain and the time constant
        u = (r[1:] + step.fopdt.T * np.diff(r) / Ts - step.fopdt.offset) / step.fopdt.K
        over = max(u.max() - limits[1], limits[0] - u.min())
        assert over < 0.35 * (limits[1] - limits[0]), name


@pytest.mark.parametrize(
    ("Ts", "T", "samples"),
    [(1e-3, 0.25, 8), (1e-3, 0.02, 2), (2e-4, 1.0, 40), (0.02, 0.037, 1), (1e-5, 1.0, 64)],
)
def test_the_filter_is_8_ms_or_a_tenth_of_the_time_constant(
    Ts: float, T: float, samples: int
) -> None:
    assert filter_length(Ts, T) == samples


def test_the_catalogue_is_for_a_drive_that_it_suits() -> None:
    sewing = drive(1e-3, 0.25, 490.0, (-20.0, 20.0), unit="RPM")
    assert catalogue_fits(sewing, -20.0, 20.0, "RPM")
    controller = first_controller(sewing)
    assert default_references(sewing, controller) == ["trapezoid", "trapezoids", "random"]
    for other in (
        drive(1e-3, 0.25, 49.0, (-20.0, 20.0), unit="RPM"),
        drive(1e-3, 0.25, 490.0, (0.0, 3.0), unit="RPM"),
        drive(2e-3, 0.25, 490.0, (-20.0, 20.0), unit="RPM"),
        drive(1e-3, 0.25, 490.0, (-20.0, 20.0), unit="rad/s"),
        drive(1e-3, 5.0, 490.0, (-20.0, 20.0), unit="RPM"),
    ):
        low, high = recorded_limits([other]) or (0.0, 0.0)
        assert not catalogue_fits(other, low, high, other.output_unit)


def test_limits_are_not_made_up_and_wide_ones_are_remarked_on() -> None:
    model = drive(0.01, 0.2, 10.0, (1.0, 3.0))
    assert recorded_limits([model]) == (0.0, 3.0)
    wide = sewfast.tune(model, u_min=-20.0, u_max=20.0, evaluations=20).controller
    assert (wide.u_min, wide.u_max) == (-20.0, 20.0)
    assert "limits beyond the recorded input of 0 to 3" in wide.notes
    half = sewfast.tune(model, u_max=5.0, evaluations=20).controller
    assert (half.u_min, half.u_max) == (0.0, 5.0)
    assert "u_min from the recorded input" in half.notes
    both = sewfast.Ensemble.of([model, drive(0.01, 0.2, 10.0, (-4.0, 2.0))])
    assert recorded_limits([both]) == (-4.0, 3.0)
    unknown = replace(model, training={})
    with pytest.raises(SettingError, match=r"u_min and u_max: expected .*--u-min"):
        sewfast.tune(unknown)
    assert sewfast.tune(unknown, u_min=-3.0, u_max=3.0, evaluations=20).controller.u_max == 3.0


def test_a_drive_without_a_brake_is_not_asked_to_fall_faster_than_it_coasts() -> None:
    model = drive(0.01, 0.3, 10.0, (0.0, 5.0))
    r = drive_references(model, 0.0, 5.0)["trapezoid"]
    peak = int(np.argmax(r))
    assert np.all(r[peak:] >= 0.3 * r.max() - 1e-9)
    assert np.all(np.diff(r[peak:]) / 0.01 >= -r[peak + 1 :] / 0.3 - 1e-9)


@pytest.mark.nightly("every seed", by_day=["0-12.0", "0--0.4", "3-12.0"])
@pytest.mark.parametrize("gain", [12.0, -0.4])
@pytest.mark.parametrize("seed", range(6))
def test_levels_of_a_drive_without_a_brake_are_held_where_its_record_was(
    seed: int, gain: float
) -> None:
    """A record of steps comes by its lowest level; a reference that stays there is outside."""
    rng = np.random.default_rng(seed)
    model = drive(0.01, 0.3, gain, (0.0, 80.0))
    u = np.repeat(np.r_[0.0, rng.uniform(15.0, 80.0, 80)], 60)[30:]
    data = sewfast.Dataset.from_arrays(
        u, model.core.simulate(u[:, None], model.core.rest_state()), 0.01, output_unit="rad/s"
    )
    went = [float(data.experiments[0].y.min()), float(data.experiments[0].y.max())]
    training = {
        "input_range": [[0.0, float(u.max())]], "output_range": went,
        "region": training_region(model, data),
    }  # fmt: skip
    model = replace(model, training=training)
    controller = sewfast.tune(model, evaluations=60).controller
    (line, *_) = judge(controller, model, "trapezoid").lines
    assert (line.name, line.verdict) == ("training region", "ok"), line.shown


def test_what_integrates_needs_no_start_and_may_have_one() -> None:
    integrator = LinearOE.from_tf([0.0, 0.02], [1.0, -1.0], 0.01, output_unit="deg")
    integrator = replace(
        integrator, training={"input_range": [[-2.0, 2.0]], "output_range": [-90.0, 90.0]}
    )
    alone = sewfast.tune(integrator, evaluations=40)
    assert alone.cost <= alone.start_cost
    start = Controller(
        Gains.standard(2.0, 1.0, u_unit="", y_unit="deg"), Ts=0.01, u_min=-2.0, u_max=2.0
    )
    found = sewfast.tune(integrator, start=start, evaluations=40)
    r = default_references(integrator, start)[0]
    assert isinstance(r, np.ndarray)
    # 4 a second at the limit: what it goes in 500 samples, well within the record
    assert r.max() == pytest.approx(20.0)
    assert found.cost <= found.start_cost


def test_a_drive_is_not_moved_without_a_reference() -> None:
    controller = first_controller(drive(0.01, 0.2, 10.0, (-3.0, 3.0)))
    with refuses(SettingError, name="reference", expected="for a drive"):
        sewfast.run(controller, object())  # type: ignore[arg-type]


def test_a_model_that_follows_a_drift_is_refused_with_what_to_do() -> None:
    """The steps of a lag, and a pole at 1 whose own part of them is nothing but noise."""
    num = [0.0, 0.0151676, -0.0166623, 0.00154688]
    plant = LinearOE.from_tf(num, [1.0, -1.941696, 0.941696], 20.0)
    drifting = replace(plant, training={"input_range": [[0.0, 80.0]], "output_range": [15.0, 33.0]})
    with refuses(FitError, name="model", received="none up to u = 40", remedy="--detrend 1"):
        sewfast.tune(drifting, evaluations=10)


def test_the_commands_need_nothing_but_the_model(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    rng = np.random.default_rng(0)
    u = np.repeat(rng.uniform(1.0, 2.7, 80), 15)
    y = np.zeros(len(u))
    for k in range(1, len(u)):
        y[k] = 0.8 * y[k - 1] + 0.2 * 160.0 * u[k - 1]
    y += 0.1 * rng.standard_normal(len(y))
    t = 0.02 * np.arange(len(u))
    sewfast.write_table(
        "drive.csv", {"t": t, "u": u, "y": y}, units={"t": "s", "u": "V", "y": "rad/s"}
    )
    with Terminal("any drive", monkeypatch.setenv) as terminal:
        for line in (
            "sewfast identify drive.csv --input u --output y --model oe -o drive.json",
            "sewfast tune drive.json --evaluations 200 -o controller.json",
            "sewfast run controller.json drive.json -o one.csv",
            "sewfast run drive.json controller.json -o other.csv",
            "sewfast run controller.json --on drive.json --reference random -o random.csv",
        ):
            terminal.run(Command(line, ""))
    controller = load_controller("controller.json")
    assert (controller.u_min, controller.u_max) == (0.0, pytest.approx(u.max()))
    assert controller.gains.y_unit == "rad/s"
    assert Path("one.csv").read_bytes() == Path("other.csv").read_bytes()
    found = sewfast.read_table("random.csv")
    assert found.unit("r") == "rad/s"
    assert np.sqrt(np.mean((found["r"] - found["y"]) ** 2)) < 0.03 * np.ptp(found["r"])
    assert json.loads(Path("controller.json").read_text())["filter_samples"] == 1
