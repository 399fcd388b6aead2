"""Gains, controllers and their files, the step-response fit, Table 1."""

import json
import math
from dataclasses import FrozenInstanceError, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sewfast import signals
from sewfast.control import (
    Controller,
    Fopdt,
    Gains,
    fit_fopdt,
    load_controller,
    paper_controller,
    table_1,
)
from sewfast.errors import DataError, ModelFileError, SettingError
from sewfast.machine import VirtualMachine

POSITIVE = st.floats(1e-6, 1e6)
SIGNED = POSITIVE | POSITIVE.map(lambda x: -x)


def times_or_none(none: float) -> st.SearchStrategy[float]:
    return POSITIVE | st.just(none)


@given(SIGNED, times_or_none(math.inf), times_or_none(0.0), st.floats(1e-5, 1.0))
def test_gains_survive_every_form(Kp: float, Ti: float, Td: float, Ts: float) -> None:
    gains = Gains.standard(Kp, Ti, Td)
    for back in (
        gains.to("parallel").to("standard"),
        gains.to("per_sample", Ts=Ts).to("standard"),
        gains.to("per_sample", Ts=Ts).to("per_sample", Ts=2 * Ts).to("parallel").to("standard"),
    ):
        assert (back.Kp, back.Ti, back.Td) == pytest.approx((Kp, Ti, Td), rel=1e-14)


def test_the_papers_gains_in_every_form() -> None:
    gains = paper_controller().gains
    assert gains.units == {"Kp": "V/RPM", "Ki": "V/RPM", "Kd": "V/RPM", "Ts": "s"}
    parallel, standard = gains.to("parallel"), gains.to("standard")
    assert (parallel.Ki, parallel.Kd) == pytest.approx((20.0, 5e-4))
    assert (standard.Ti, standard.Td) == pytest.approx((1e-3, 0.025))
    assert parallel.units == {"Kp": "V/RPM", "Ki": "V/(RPM s)", "Kd": "V s/RPM"}
    assert str(gains) == "Kp 0.02 V/RPM, Ki 0.02 V/RPM, Kd 0.5 V/RPM (per-sample at 0.001 s)"


@pytest.mark.parametrize(
    ("make", "says"),
    [
        (lambda: Gains.standard(1.0, 0.0), "Ti"),
        (lambda: Gains.standard(math.nan, 1.0), "Kp"),
        (lambda: Gains.standard(1.0, 1.0, -1.0), "Td"),
        (lambda: Gains.standard("1", 1.0), "Kp"),
        (lambda: Gains.parallel(0.0, 1.0), "Ki"),
        (lambda: Gains.parallel(1.0, -1.0), "sign of Kp"),
        (lambda: Gains.per_sample(1.0, 1.0, Ts=0.0), "Ts"),
        (lambda: Gains("serial", 1.0, 1.0, 1.0), "serial"),
        (lambda: Gains("standard", 1.0, 1.0, 1.0, Ts=0.1), "Ts"),
        (lambda: Gains.standard(1.0, 1.0).to("per_sample"), "give Ts"),
        (lambda: Gains.standard(1.0, 1.0).to("serial"), "serial"),
        (lambda: Gains.standard(1.0, 1.0).Ki, r"\.to\('parallel'\)"),
        (lambda: Gains.parallel(1.0, 1.0).Ti, r"\.to\('standard'\)"),
    ],
)
def test_gains_that_make_no_sense_are_refused(make: Any, says: str) -> None:
    with pytest.raises(SettingError, match=says):
        make()


def test_values_do_not_change() -> None:
    controller = paper_controller()
    with pytest.raises(FrozenInstanceError):
        controller.alpha = 1.0  # type: ignore[misc]
    assert replace(controller, alpha=1).alpha == 1.0


@pytest.mark.parametrize(
    ("settings", "says"),
    [
        ({"Ts": 0.002}, "convert them"),
        ({"alpha": math.inf}, "alpha"),
        ({"N": 0.0}, "N"),
        ({"Tt": 1e-6}, "Tt"),
        ({"u_min": 20.0}, "u_max"),
        ({"slew": -1.0}, "slew"),
        ({"filter_samples": 0}, "filter_samples"),
        ({"filter_samples": 65}, "filter_samples"),
        ({"filter_samples": 1.5}, "filter_samples"),
        ({"filter_samples": -1}, "filter_samples"),
        ({"filter_samples": True}, "filter_samples"),
        ({"filter_time": math.inf}, "filter_time"),
        ({"observer_time": -1.0}, "observer_time"),
        ({"observer_time": math.inf}, "observer_time"),
        ({"r_rate": 0.0}, "r_rate"),
        ({"r_rate": "fast"}, "r_rate"),
        ({"schedule": 3}, "schedule"),
        ({"schedule": [1.0]}, "schedule"),
        ({"schedule": [(1.0, 2.0)]}, "Gains"),
        ({"schedule": [("slow", Gains.standard(1, 1))]}, "speed"),
        ({"schedule": [(-1.0, Gains.standard(1, 1))]}, "0 or more"),
        ({"schedule": [(1.0, Gains.standard(1, 1))] * 2}, "growing"),
        ({"schedule": [(k, Gains.standard(1, 1)) for k in range(9)]}, "at most 8"),
        ({"schedule": [(k, Gains.standard(1 - 2 * k, 1)) for k in range(2)]}, "one sign"),
        ({"schedule": [(1.0, Gains.standard(1, 1, u_unit="A"))]}, "units"),
        ({"schedule": [(1.0, Gains.per_sample(1, 1, Ts=0.002))]}, "convert them"),
        ({"counts_per_rev": 0.0}, "counts_per_rev"),
        ({"u_max": None}, "u_max"),
        ({"notes": 1}, "notes"),
    ],
)
def test_settings_out_of_range_are_refused(settings: dict[str, Any], says: str) -> None:
    with pytest.raises(SettingError, match=says):
        replace(paper_controller(), **settings)


def test_one_step_by_hand() -> None:
    core = Controller(Gains.parallel(2.0, 100.0), alpha=0.5, u_max=4.0).core()
    assert core.step(1.0, 0.0) == pytest.approx(2.0 * 0.5 + 100.0 * 0.001)
    assert core.step(10.0, 0.0) == 4.0
    core.reset()
    assert core.step(1.0, 1.0) == pytest.approx(-1.0)
    assert core.filtered == 1.0
    assert core.step(1.0, 1.0, 0.25) == pytest.approx(-0.75)


def test_the_core_changes_gains_and_mode_without_a_bump() -> None:
    slow, fast = Controller(Gains.standard(1.0, 0.5)), Controller(Gains.standard(3.0, 0.1))
    core = slow.core()
    before = [core.step(2.0, 1.0) for _ in range(50)][-1]
    core.set_design(fast.core())
    assert core.step(2.0, 1.0) == pytest.approx(before + 3.0 * 0.001 / 0.1)
    core.set_manual(-4.0)
    assert core.manual
    assert core.step(2.0, 1.0) == -4.0
    core.set_automatic()
    assert not core.manual
    assert core.step(2.0, 1.0) == pytest.approx(-4.0 + 3.0 * 0.001 / 0.1)
    core.set_design(core)
    for refused in (
        lambda: core.set_manual(math.nan),
        lambda: core.set_design(replace(fast, Ts=0.002).core()),
    ):
        with pytest.raises(SettingError):
            refused()


def test_ramp_observer_and_schedule_by_hand() -> None:
    points = [(100.0, Gains.standard(1.0, math.inf)), (300.0, Gains.parallel(2.0, 0.0))]
    core = Controller(Gains.standard(9.0, 9.0), schedule=points, r_rate=1000.0).core()  # type: ignore[arg-type]
    assert core.step(0.0, 50.0) == pytest.approx(1.0 * (49.0 - 50.0))
    assert core.step(0.0, -200.0) == pytest.approx(1.5 * (48.0 + 200.0))
    assert core.step(0.0, 900.0) == pytest.approx(2.0 * (47.0 - 900.0))
    core = Controller(Gains.standard(1.0, math.inf), observer_time=0.002).core()
    theta = math.exp(-0.5)
    core.step(0.0, 10.0)
    assert core.filtered == 10.0
    core.step(0.0, 20.0)
    assert core.filtered == pytest.approx(10.0 + 10.0 * (1 - theta) ** 2)


CONTROLLERS = st.builds(
    Controller,
    gains=st.builds(Gains.standard, SIGNED, times_or_none(math.inf), times_or_none(0.0)),
    Ts=st.floats(1e-5, 1.0),
    alpha=st.floats(-2, 2),
    beta=st.floats(-9, 2),
    N=times_or_none(math.inf),
    Tt=st.sampled_from([0.0, 1.0, math.inf]),
    u_min=st.sampled_from([-math.inf, -20.0]),
    u_max=st.sampled_from([math.inf, 20.0]),
    slew=times_or_none(math.inf),
    filter_samples=st.integers(1, 64),
    filter_time=st.floats(0, 1),
    observer_time=st.floats(0, 1),
    r_rate=times_or_none(math.inf),
    schedule=st.lists(
        st.tuples(
            st.floats(0, 1e6),
            st.builds(Gains.standard, POSITIVE, times_or_none(math.inf), times_or_none(0.0)),
        ),
        max_size=8,
        unique_by=lambda point: round(point[0]),
    ).map(lambda points: tuple(sorted(points, key=lambda point: point[0]))),
    counts_per_rev=st.none() | POSITIVE,
    notes=st.text(st.characters(exclude_categories=("C", "Z")) | st.just(" "), max_size=20),
)


@given(CONTROLLERS)
def test_a_file_gives_back_every_bit(tmp_path_factory: Any, controller: Controller) -> None:
    path = tmp_path_factory.mktemp("c") / "controller.json"
    controller.save(path)
    assert load_controller(path) == controller


def test_files_of_every_form_and_without_infinities(tmp_path: Path) -> None:
    path = tmp_path / "c.json"
    for form in ("standard", "parallel", "per_sample"):
        gains = Gains.parallel(0.02, 0.0, 5e-4, u_unit="A", y_unit="rad/s").to(form, Ts=0.001)
        controller = Controller(gains, notes="unbounded")
        controller.save(path)
        assert load_controller(path) == controller
        assert "Infinity" not in path.read_text()


def test_a_file_of_version_1_is_read() -> None:
    controller = load_controller(Path(__file__).parents[1] / "golden" / "controller_1.json")
    assert controller == Controller(
        Gains.parallel(0.02, 0.1, 6e-5), alpha=0.3, beta=-1.25, N=5, Tt=0.05, u_min=-20, u_max=20,
        filter_samples=8, filter_time=0.001, counts_per_rev=1572, notes="a file of version 1",
    )  # fmt: skip


def test_a_file_of_version_1_holds_nothing_of_version_2(tmp_path: Path) -> None:
    path = tmp_path / "mixed.json"
    paper_controller().save(path)
    path.write_text(json.dumps({**json.loads(path.read_text()), "version": 1}))
    with pytest.raises(ModelFileError, match=r"observer_time|r_rate|schedule|kind"):
        load_controller(path)


def test_a_controller_prints_its_parts() -> None:
    gains = Gains.standard(0.02, 0.1)
    told = str(Controller(gains, observer_time=0.004, r_rate=5e3, schedule=((300.0, gains),)))
    assert "observer of 0.004 s" in told
    assert "ramp of 5000 RPM/s" in told
    assert "at 300 RPM: Kp 0.02 V/RPM" in told
    plain = str(Controller(gains))
    assert "observer" not in plain
    assert "ramp" not in plain


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"schedule": None}, "schedule"),
        ({"schedule": [{"speed": 1.0}]}, "gains"),
        ({"schedule": [{"speed": None, "gains": {}}]}, "speed"),
        ({"schedule": [{"speed": 1.0, "gains": {"form": "serial"}}]}, "form"),
        ({"observer_time": None}, "observer_time"),
        ({"alpha": "0.4"}, "alpha"),
        ({"alpha": None}, "alpha"),
        ({"alpha": True}, "alpha"),
        ({"filter_samples": 8.0}, "filter_samples"),
        ({"filter_samples": 65}, "filter_samples"),
        ({"gains": [1, 2, 3]}, "gains"),
        ({"gains": {"form": "serial", "Kp": 1, "Ti": 1, "Td": 0}}, "form"),
        ({"gains": {"form": "standard", "Kp": 1, "Ti": 1}}, "Td"),
        ({"gains": {"form": "standard", "Kp": 1, "Ti": 1, "Td": 0, "Ki": 1}}, "Ki"),
        ({"gains": {"form": "standard", "Kp": None, "Ti": 1, "Td": 0}}, "Kp"),
        ({"gains": {"form": "standard", "Kp": 1, "Ti": -1, "Td": 0}}, "Ti"),
        ({"surprise": 1}, "surprise"),
        ({"u_max": -30.0}, "u_max"),
        ({"notes": 3}, "notes"),
        ({"format": "sewfast.model"}, "sewfast.controller"),
        ({"version": 99}, "version"),
    ],
)
def test_damaged_files_are_refused_by_name(
    tmp_path: Path, change: dict[str, Any], says: str
) -> None:
    path = tmp_path / "damaged.json"
    paper_controller().save(path)
    path.write_text(json.dumps({**json.loads(path.read_text()), **change}))
    with pytest.raises(ModelFileError, match=r"damaged\.json") as caught:
        load_controller(path)
    assert says in str(caught.value)


@pytest.mark.parametrize("missing", sorted(json.loads(json.dumps(paper_controller().to_dict()))))
def test_files_with_a_field_missing_are_refused(tmp_path: Path, missing: str) -> None:
    path = tmp_path / "damaged.json"
    paper_controller().save(path)
    values = json.loads(path.read_text())
    del values[missing]
    path.write_text(json.dumps(values))
    with pytest.raises(ModelFileError, match=missing):
        load_controller(path)


def test_fits_the_raw_step_of_the_machine() -> None:
    u = signals.excitation("step")
    counts = VirtualMachine().run(u).counts
    raw = np.diff(counts, prepend=0.0) / (0.001 * 1572 / 60)
    fopdt = fit_fopdt(u, raw, Ts=0.001)
    gain, time = fopdt.K, fopdt.T
    assert (gain, time) == pytest.approx((490, 0.25), rel=0.1)
    assert 0.004 < fopdt.L < 0.02
    assert fopdt.fit_percent > 95
    t = (np.arange(len(u)) - np.argmax(u > 0)) * 0.001
    response = fopdt.response(t)
    assert np.sqrt(np.mean((response - raw) ** 2)) < 50


def test_a_fit_needs_a_step_that_settles() -> None:
    t = np.arange(2000) * 0.001
    u = np.where(t < 0.5, 0.0, 1.0)
    y = np.where(t < 0.5, 0.0, t - 0.5)
    with pytest.raises(DataError, match="settles"):
        fit_fopdt(u, y, Ts=0.001)
    with pytest.raises(DataError, match="step"):
        fit_fopdt(np.ones(100), np.ones(100), Ts=0.001)
    with pytest.raises(SettingError):
        fit_fopdt(u, y, Ts=0.0)
    for bad in (y[:5], np.full_like(y, np.nan), y[:, None], ["a"] * len(u)):
        with pytest.raises(DataError):
            fit_fopdt(u, bad, Ts=0.001)


def test_table_1_gives_its_row_and_says_what_to_do_outside() -> None:
    rule = table_1(Fopdt(K=490.0, T=0.2, L=0.1))
    assert rule.gains.Kp * 490 == pytest.approx(2.5)
    assert (rule.gains.Ti / 0.2, rule.gains.Td / 0.2) == pytest.approx((0.83, 0.18))
    assert (rule.alpha, rule.beta) == pytest.approx((0.58, 0.69))
    short = Fopdt(K=490.0, T=0.25, L=0.0075)
    with pytest.raises(SettingError, match="nearest"):
        table_1(short)
    assert table_1(short, outside="nearest").gains.Kp * 490 == pytest.approx(12.5)
    with pytest.raises(SettingError, match="outside="):
        table_1(short, outside="guess")  # type: ignore[arg-type]
