"""Mistakes around gains, controllers, rules, margins and analyses are refused."""

from __future__ import annotations

import copy
import math
import pickle
import signal
import stat
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cli import called as command
from loops import QUIET, drive
from refusals import refuses
from sewfast import (
    Constraints,
    Controller,
    Cost,
    Gains,
    LinearOE,
    VirtualMachine,
    analyse,
    fit_fopdt,
    load_controller,
    margins,
    pareto,
    rules,
    run,
    tune,
)
from sewfast.analysis import changes
from sewfast.control import Fopdt
from sewfast.control.forms import to_control, to_matlab
from sewfast.control.margins import loop_response
from sewfast.control.systems import LinearLoop, simulate
from sewfast.errors import DataError, ModelFileError, SettingError, SewfastError
from sewfast.storage import replace_file
from sewfast.trust import Limits, judge
from sewfast.tuning import costs
from sewfast.tuning.front import NAMES

PLANT = Fopdt(490.0, 0.25, 0.0075)
EDGE = np.repeat([0.0, 1000.0], [20, 130])
IN_RADIANS = LinearOE.from_tf(
    [0.0, 1.0], [1.0, -0.99], 0.001, input_units=["V"], output_unit="rad/s"
)


def wrong(value: Any) -> Any:
    """A value whose type is not what the signature asks for."""
    return value


CASES: dict[str, tuple[Callable[[], Any], str]] = {
    "gains as a tuple": (lambda: Controller(wrong((0.1, 0.2, 0.3))), "gains: expected Gains"),
    "a unit as a number": (lambda: Gains.standard(1, 1, u_unit=wrong(5)), "u_unit"),
    "a form in a list": (lambda: QUIET.gains.to(wrong(["standard"])), "standard, parallel"),
    "MATLAB's form in a list": (lambda: to_matlab(QUIET, wrong(["pid"])), "pid2"),
    "gains for MATLAB": (lambda: to_matlab(wrong(QUIET.gains)), "expected a Controller"),
    "gains for python-control": (lambda: to_control(wrong(QUIET.gains)), "expected a Controller"),
    "T of 0": (lambda: Fopdt(1.0, 0.0, 0.1), "T above 0 s"),
    "L below 0": (lambda: Fopdt(1.0, 1.0, -0.1), "L of 0 s or more"),
    "K as text": (lambda: Fopdt(wrong("a"), 1.0, 0.1), "K: expected a number"),
    "K of NaN": (lambda: Fopdt(math.nan, 1.0, 0.1), "K: expected a number"),
    "a rule for gains": (lambda: rules.eq_12(wrong(QUIET.gains)), "expected an Fopdt"),
    "a rule for a number": (lambda: rules.simc(wrong(3)), "expected an Fopdt"),
    "margins in other units": (
        lambda: margins(QUIET, replace(PLANT, y_unit="rad/s")),
        "unit 'RPM', received 'rad/s'",
    ),
    "margins on a model in other units": (lambda: margins(QUIET, IN_RADIANS), "received 'rad/s'"),
    "frequencies as text": (lambda: loop_response(QUIET, PLANT, wrong(["a"])), "omega"),
    "complex frequencies": (lambda: loop_response(QUIET, PLANT, wrong([1j])), "omega"),
    "the schedule of constant gains": (
        lambda: tune(drive(), EDGE, variables=["schedule"], evaluations=5),
        "gain schedule",
    ),
    "no whole number of samples": (
        lambda: tune(drive(), EDGE, variables=[("filter_samples", 2.2, 2.8)]),
        "whole number",
    ),
    "a front of one evaluation": (lambda: pareto(drive(), EDGE, evaluations=1), "2 evaluations"),
    "an objective twice": (
        lambda: pareto(drive(), EDGE, objectives=["chatter", "chatter"]),
        "'chatter' twice",
    ),
    "plants by name": (lambda: tune(wrong("virtual"), EDGE), "expected models"),
    "a start by name": (lambda: tune(drive(), EDGE, start=wrong("c.json")), "load_controller"),
    "one number as reference": (lambda: tune(drive(), wrong(5.0)), "names or samples"),
    "a variation as a number": (lambda: tune(drive(), EDGE, variations=wrong(5)), "pairs"),
    "a method of None": (lambda: tune(drive(), EDGE, method=wrong(None)), "genetic"),
    "costs of nothing": (lambda: costs(wrong(None), drive(), EDGE), "controllers"),
    "costs at several sample times": (
        lambda: costs([QUIET, replace(QUIET, Ts=0.002)], drive(), EDGE),
        "sample time",
    ),
    "the cost of a number": (lambda: Cost().of(wrong(5)), "closed-loop runs"),
    "limits that are a number": (
        lambda: judge(run(QUIET, drive(), EDGE), limits=wrong(5)),
        "expected Limits",
    ),
    "a run judged by a model in other units": (
        lambda: judge(run(QUIET, drive(), EDGE), IN_RADIANS),
        "received 'rad/s'",
    ),
    "one speed": (lambda: analyse(QUIET, drive(), speeds=wrong(500)), "speeds"),
    "no speed": (lambda: analyse(QUIET, drive(), speeds=[]), "speeds"),
    "a speed of NaN": (lambda: analyse(QUIET, drive(), speeds=[math.nan]), "speeds"),
    "a step of 0": (lambda: analyse(QUIET, drive(), step=0.0), "other than 0"),
    "a disturbance without end": (
        lambda: analyse(QUIET, drive(), disturbance=math.inf),
        "disturbance",
    ),
    "no time": (lambda: analyse(QUIET, drive(), seconds=0.0), "seconds above 0"),
    "a cost that is a number": (lambda: analyse(QUIET, drive(), cost=wrong(5)), "expected Cost"),
    "limits for an analysis": (lambda: analyse(QUIET, drive(), limits=wrong(5)), "Limits"),
    "changes that are none": (lambda: analyse(QUIET, drive(), changes=wrong([5])), "changes"),
    "a gain of 0": (lambda: changes.gain(0.0), "above 0"),
    "a delay backwards": (lambda: changes.delay(-5), "samples"),
    "half a sample": (lambda: changes.delay(wrong(1.5)), "samples"),
    "no time constants": (lambda: changes.time_constants(0.0), "above 0"),
    "an unknown parameter": (lambda: changes.parameters("x", mass=2.0), "'mass'"),
    "friction that drives": (lambda: changes.friction(-1.0), "0 or more"),
    "a load of NaN": (lambda: changes.load(math.nan), "torque"),
    "a loop around a model": (lambda: LinearLoop.of(QUIET, wrong(drive())), "to_ss"),
    "inputs of another shape": (
        lambda: simulate(LinearLoop.of(QUIET, drive().to_ss()).closed, np.zeros((5, 3))),
        r"\(N, 2\)",
    ),
    "a system by another name": (
        lambda: LinearLoop.of(QUIET, drive().to_ss()).to_control("G"),
        "tracking",
    ),
    "a file named by a null": (lambda: load_controller("a\0b"), "can be read"),
    "a file to a null": (lambda: QUIET.save("a\0b"), "can be written"),
}


@pytest.mark.parametrize("name", CASES)
def test_a_mistake_is_refused_by_name(name: str) -> None:
    make, says = CASES[name]
    with pytest.raises(SewfastError, match=says):
        make()


def test_systems_that_are_no_plant_are_refused() -> None:
    control = pytest.importorskip("control", reason="needs the extra 'control'")
    for system, says in (
        (control.tf([1, 0, 0], [1, 1]), "proper"),
        (control.tf([[[1], [2]]], [[[1, 1], [1, 2]]]), "one input, received 2"),
        (control.tf([[[1]], [[2]]], [[[1, 1]], [[1, 2]]]), "one output, received 2"),
    ):
        with pytest.raises(SettingError, match=says):
            margins(QUIET, system)


def test_numbers_in_messages_keep_their_size() -> None:
    u = np.repeat([0.0, 1e100], [50, 50])
    with pytest.raises(DataError) as refused:
        fit_fopdt(u, 1e100 * np.random.default_rng(0).standard_normal(100), Ts=0.001)
    assert len(str(refused.value)) < 200
    with pytest.raises(SettingError, match=r"got 1\.000e-5"):
        rules.eq_12(Fopdt(1.0, 1.0, 1e-5))


def test_what_is_no_file_is_not_replaced(tmp_path: Path) -> None:
    import os

    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    with pytest.raises(OSError, match="a pipe or a device"):
        replace_file(pipe, b"content")
    with pytest.raises(ModelFileError, match="a pipe or a device"):
        QUIET.save(pipe)
    assert stat.S_ISFIFO(pipe.stat().st_mode)
    assert list(tmp_path.iterdir()) == [pipe]
    link = tmp_path / "link.json"
    link.symlink_to(tmp_path / "real.json")
    QUIET.save(link)
    assert link.is_symlink()
    assert load_controller(tmp_path / "real.json") == QUIET


def test_points_and_plants_that_are_not_there() -> None:
    found = analyse(QUIET, drive(), references=EDGE, changes=[])
    with pytest.raises(SettingError, match="operating points"):
        found.linear(9)
    with pytest.raises(SettingError, match="1 plants"):
        found.linear(plant=1)


def test_a_loop_that_never_crosses_has_no_frequency() -> None:
    text = str(margins(Controller(Gains.standard(0.0, math.inf)), PLANT))
    assert "nowhere," in text
    assert "nan" not in text


@pytest.mark.parametrize(
    "value",
    [
        QUIET, QUIET.gains, PLANT, rules.simc(PLANT), margins(QUIET, PLANT), Cost(),
        Constraints(Ms=1.6), Limits(),
    ],
    ids=lambda v: type(v).__name__,
)  # fmt: skip
def test_values_can_be_copied_pickled_and_hashed(value: Any) -> None:
    for twin in (copy.deepcopy(value), pickle.loads(pickle.dumps(value))):
        assert repr(twin) == repr(value)
    assert isinstance(hash(value), int)


def test_gains_on_the_command_line_names_the_option(tmp_path: Path) -> None:
    plant = ["gains", "--K", "490", "--T", "0.25", "--L", "0.01"]
    for option in ("--filter", "--ts"):
        assert option in command(tmp_path, *plant, option, "0", done=2).err


def test_a_front_needs_a_folder(tmp_path: Path) -> None:
    pytest.importorskip("matplotlib", reason="needs the extra 'report'")
    front = pareto(drive(), EDGE, evaluations=40, size=4, threads=1)
    with refuses(SettingError, expected="can be written"):
        front.plot(file=tmp_path / "none" / "front.png")


def test_a_machine_is_no_linear_plant() -> None:
    with pytest.raises(SettingError, match="VirtualMachine"):
        margins(QUIET, VirtualMachine())


def test_limits_of_a_virtual_machine_are_not_passed_over(tmp_path: Path) -> None:
    done = command(
        tmp_path, "commission", "--on", "virtual", "--out", "x", "--limits", "a=1", done=2
    )
    assert "--limits" in done.err


def test_ctrl_c_is_heard_by_work_that_has_no_result_yet() -> None:
    """It was lost where work ended without having looked: the next stage went on."""
    u = np.repeat([0.0, 1.0], [1000, 60_000])
    y = PLANT.response((np.arange(len(u)) - 1000) * 0.001)

    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    before = signal.signal(signal.SIGALRM, interrupt)
    try:
        signal.setitimer(signal.ITIMER_REAL, 0.05)
        with pytest.raises(KeyboardInterrupt):
            fit_fopdt(u, y, Ts=0.001)
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, before)


def test_every_objective_has_a_name_in_the_figure_of_a_front() -> None:
    with pytest.raises(SettingError, match="objectives among") as refused:
        pareto(drive(), EDGE, objectives=["tracking", "beauty"], evaluations=10)
    told = str(refused.value).partition("among ")[2].partition(r",\ got")[0].partition(", got")[0]
    known = told.replace(" and ", ", ").split(", ")
    assert {"tracking", "recovery", "Ms"} <= set(known) <= set(NAMES)
