"""Biquads of a controller: their responses, the loop with them, files, devices, the search."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from effort import FULL
from link_kept import Kept
from refusals import refuses
from sewfast import (
    Biquad,
    Constraints,
    Controller,
    FitError,
    Gains,
    LinearOE,
    ModelFileError,
    SettingError,
    fit_shaft,
    load_controller,
    margins,
    run,
    tune,
)
from sewfast.cli import main
from sewfast.control import forms
from sewfast.control.margins import loop_response
from sewfast.control.systems import LinearLoop, response, simulate
from sewfast.frequency import FrequencyResponse, ShaftFit, propose
from sewfast.link import Plan, VirtualDevice, connect

TS = 1e-3
ALL = (
    Biquad.notch(60.0, depth=0.1, width=0.5),
    Biquad.low_pass(200.0),
    Biquad.lead_lag(20.0, 90.0),
    Biquad.resonance(76.0, 0.03, 62.0, 0.4),
)
PAIR = LinearOE.from_tf(
    [0.0, 0.1228, 0.1224], [1.0, -1.87, 0.8705], TS, input_units=("V",), output_unit="RPM"
)


def controller(**settings: Any) -> Controller:
    gains = Gains.standard(0.002, 0.1, 0.003)
    base: dict[str, Any] = {"alpha": 0.3, "beta": 0.5, "N": 8.0, "biquads": ALL}
    return Controller(gains, Ts=TS, **(base | settings))


def test_notch_and_low_pass_are_scipys_prewarped_bilinear_transform() -> None:
    signal = pytest.importorskip("scipy.signal")
    w, v = 2.0 * math.pi * 60.0, 2.0 * math.pi * 200.0
    for biquad, num, den, kept in (
        (ALL[0], [1.0, 0.05 * w, w * w], [1.0, 0.5 * w, w * w], w),
        (ALL[1], [v * v], [1.0, math.sqrt(2.0) * v, v * v], v),
    ):
        # bilinear with the frequency that keeps `kept`
        fs = kept / (2.0 * math.tan(0.5 * kept * TS))
        b, a = signal.bilinear(num, den, fs)
        mine = biquad.to_tf(TS)
        np.testing.assert_allclose(mine[0], b, rtol=1e-8, atol=1e-12)
        np.testing.assert_allclose(mine[1], a, rtol=1e-8, atol=1e-12)


@pytest.mark.parametrize("biquad", ALL, ids=lambda b: b.kind)
def test_gain_is_1_at_standstill_and_the_response_that_of_the_fraction(biquad: Biquad) -> None:
    num, den = biquad.to_tf(TS)
    assert num.sum() == pytest.approx(den.sum(), rel=1e-9)
    hertz = np.array([1.0, 30.0, 60.0, 300.0])
    q = np.exp(-2j * np.pi * hertz * TS)
    np.testing.assert_allclose(
        biquad.response(hertz, TS), np.polyval(num[::-1], q) / np.polyval(den[::-1], q), rtol=1e-10
    )
    assert abs(biquad.response(60.0, TS)[0]) == pytest.approx(0.1) or biquad.kind != "notch"


def test_the_loop_is_that_of_the_linear_equations() -> None:
    c = controller()
    loop = LinearLoop.of(c, PAIR.to_ss(), encoder=False)
    hertz = np.geomspace(0.5, 480.0, 60)
    mine = loop_response(c, PAIR, 2.0 * np.pi * hertz)
    np.testing.assert_allclose(mine, response(loop.L, hertz, TS), rtol=1e-8)
    poles = np.abs(loop.poles())
    assert margins(c, PAIR).largest_pole == pytest.approx(poles.max(), rel=1e-8)
    r = np.where(np.arange(600) < 5, 0.0, 100.0) + 30.0 * np.sin(0.2 * np.arange(600))
    r[0] = 0.0
    found = run(c, PAIR, r)
    exact = simulate(loop.closed, np.column_stack([r, np.zeros(600)]))
    np.testing.assert_allclose(found.y, exact[:, 0], atol=1e-8 * np.abs(exact[:, 0]).max())
    np.testing.assert_allclose(found.u, exact[:, 1], atol=1e-8 * np.abs(exact[:, 1]).max())


def test_python_control_gets_the_same_loop() -> None:
    control = pytest.importorskip("control")
    c = controller()
    system = forms.to_control(c)
    z = np.exp(2j * np.pi * np.array([3.0, 60.0, 200.0]) * TS)
    plain = forms.to_control(replace(c, biquads=()))
    filters = np.prod([b.response([3.0, 60.0, 200.0], TS) for b in ALL], axis=0)
    for k, one in enumerate(z):
        np.testing.assert_allclose(system(one), plain(one) * filters[k], rtol=1e-8)
    assert control.ss(system).nstates == 2 * 2 * len(ALL) + plain.nstates
    with refuses(SettingError, name="controller", expected="biquads"):
        forms.to_matlab(c)
    with pytest.raises(SettingError, match="poles of a PID"):
        forms.from_control(system)


def test_files_keep_them_and_older_ones_have_none(tmp_path: Path) -> None:
    c = controller(counts_per_rev=1572.0)
    c.save(tmp_path / "c.json")
    assert load_controller(tmp_path / "c.json") == c
    found = json.loads((tmp_path / "c.json").read_text())
    assert found["version"] == 5
    assert found["biquads"][0] == {"kind": "notch", "frequency": 60.0, "depth": 0.1, "width": 0.5}
    assert "notch at 60 Hz, depth 0.1, width 0.5" in str(c)
    later = ("biquads", "kind", "feedforward")
    older = {k: v for k, v in found.items() if k not in later} | {"version": 2}
    (tmp_path / "2.json").write_text(json.dumps(older))
    assert load_controller(tmp_path / "2.json") == replace(c, biquads=())
    for bad, message in (
        ([{"kind": "comb", "frequency": 1.0}], "biquads.0..kind"),
        ([{"kind": "notch", "frequency": 60.0}], "depth"),
        ([{"kind": "low_pass", "frequency": 900.0, "damping": 0.7}], "half the sample rate"),
        ([found["biquads"][0]] * 5, "biquads: expected at most 4"),
        ("notch", "biquads"),
    ):
        (tmp_path / "bad.json").write_text(json.dumps(found | {"biquads": bad}))
        with pytest.raises(ModelFileError, match=message):
            load_controller(tmp_path / "bad.json")


@pytest.mark.parametrize(
    ("biquads", "message"),
    [
        ([Biquad.notch(60.0)] * 5, "at most 4"),
        ([Biquad.notch(500.0)], "half the sample rate"),
        ([Biquad.notch(-1.0)], "half the sample rate"),
        ([Biquad.notch(60.0, depth=2.0)], "0 to 1 for depth"),
        ([Biquad.notch(60.0, width=0.0)], "above 0 for width"),
        ([60.0], "Biquad.notch"),
        (60.0, "Biquad.notch"),
        ("notch", "Biquad.notch"),
    ],
)
def test_what_is_no_biquad_is_refused(biquads: Any, message: str) -> None:
    with pytest.raises(SettingError, match=message):
        controller(biquads=biquads)


def test_kinds_and_numbers_are_checked() -> None:
    with pytest.raises(SettingError, match="notch, low_pass"):
        Biquad("comb", (1.0,))
    with pytest.raises(SettingError, match="frequency, depth, width"):
        Biquad("notch", (1.0,))
    with pytest.raises(SettingError):
        Biquad.notch("sixty")  # type: ignore[arg-type]
    with pytest.raises(SettingError, match="frequency: expected a number"):
        Biquad.notch(math.nan)


def test_a_device_runs_them_as_the_core_does_in_single_precision() -> None:
    c = controller(u_min=-20.0, u_max=20.0, counts_per_rev=1572.0, filter_samples=4)
    r = np.linspace(0.0, 1000.0, 400)
    sink, plain = Kept(), Kept()
    with VirtualDevice(fast=True) as device, connect(device.port) as drive:
        drive.set_limits(volt=20.0, speed_rpm=4000.0)
        drive.stream(Plan("controller", r, c), sink)
        drive.stream(Plan("controller", r, replace(c, biquads=())), plain)
    counts, command = sink.column("counts"), sink.column("u")
    core = c.core().single()
    speed = np.diff(counts, prepend=counts[0]) * 60.0 / (1572.0 * TS)
    u = [core.step(float(a), float(b)) for a, b in zip(r, speed, strict=True)]
    np.testing.assert_allclose(command, u, atol=1e-3)
    # gains without biquads leave none of those before
    assert np.abs(plain.column("u") - command).max() > 0.01


def test_a_loop_that_swings_is_calm_with_a_notch() -> None:
    model, _ = two_masses()
    plain = Controller(Gains.standard(0.22, 0.3), Ts=TS, u_min=-20.0, u_max=20.0)
    notched = replace(plain, biquads=[Biquad.notch(60.0, depth=0.05, width=0.8)])
    assert not margins(plain, model).stable
    assert margins(notched, model).stable
    r = np.minimum(1000.0, 2.0 * np.arange(3000))
    swing = [float(run(c, model, r).u[2500:].std()) for c in (plain, notched)]
    assert swing[0] > 1.0
    assert swing[1] < 0.01


def two_masses() -> tuple[LinearOE, FrequencyResponse]:
    """A shaft at 60 Hz behind a lag of .25 s, and its response as if it had been measured."""
    p, q = math.exp(-TS / 0.25), math.exp(-TS / 0.004)
    wr, wa = 2.0 * math.pi * 60.0, 2.0 * math.pi * 45.0
    poles = np.exp(TS * wr * (-0.03 + 1j * math.sqrt(1.0 - 0.03**2)))
    zeros = np.exp(TS * wa * (-0.03 + 1j * math.sqrt(1.0 - 0.03**2)))
    den = np.real(np.poly([p, q, poles, np.conj(poles)]))
    num = np.real(np.poly([zeros, np.conj(zeros)]))
    num *= 490.0 * den.sum() / num.sum()
    model = LinearOE.from_tf(
        np.concatenate([[0.0, 0.0], num]), den, TS, input_units=("V",), output_unit="RPM"
    )
    hertz = np.arange(1.0, 400.0, 1.0)
    value = response(model.to_ss(), hertz, TS)
    return model, FrequencyResponse(
        hertz, value, (0.02 * np.abs(value)) ** 2, np.full(len(hertz), 0.99), 16.0, TS,
        u_unit="V", y_unit="RPM",
    )  # fmt: skip


@cache
def fitted_shaft() -> ShaftFit:
    return fit_shaft(two_masses()[1])


def test_notches_are_searched_with_the_gains_under_ms_on_the_response() -> None:
    model, measured = two_masses()
    gains = Gains.standard(0.002, 0.1, 0.0)
    start = Controller(gains, Ts=TS, u_min=-10.0, u_max=10.0)
    r = np.minimum(1000.0, np.arange(600) * 10.0)
    limit = Constraints(Ms=1.6, plant=[model, measured])
    settings: dict[str, Any] = {"constraints": limit, "evaluations": 400, "variations": [(1.0, 0)]}
    plain = tune(model, r, start=start, **settings)
    notched = tune(model, r, start=replace(start, biquads=[Biquad.notch(60.0)]), **settings)
    names = [v.name for v in notched.variables]
    assert names[-3:] == ["notch_frequency[0]", "notch_depth[0]", "notch_width[0]"]
    (notch,) = notched.controller.biquads
    assert notch != Biquad.notch(60.0)
    assert 40.0 <= notch.named()["frequency"] <= 90.0
    assert notched.cost < 0.8 * plain.cost
    for found in (plain, notched):
        assert margins(found.controller, model).Ms <= 1.6
        # the bands count: their worst is within the limit too
        assert measured.margins(found.controller).Ms_band[1] <= 1.6 * 1.02
    # wider bands leave less
    wide = replace(measured, variance=(0.15 * np.abs(measured.value)) ** 2)
    settings["constraints"] = Constraints(Ms=1.6, plant=[model, wide])
    careful = tune(model, r, start=replace(start, biquads=[Biquad.notch(60.0)]), **settings)
    assert careful.cost > notched.cost


def test_a_response_alone_or_a_variable_of_no_notch_is_refused() -> None:
    model, measured = two_masses()
    start = Controller(Gains.standard(0.002, 0.1), Ts=TS, u_min=-10.0, u_max=10.0)
    r = np.minimum(1000.0, np.arange(300) * 10.0)
    with pytest.raises(SettingError, match="linear plant beside the measured"):
        tune(model, r, start=start, constraints=Constraints(Ms=1.6, plant=measured), evaluations=2)
    with pytest.raises(SettingError, match="start with a notch"):
        tune(model, r, start=start, variables=["Kp", "notches"], evaluations=2)
    low = replace(start, biquads=[Biquad.low_pass(100.0)])
    with pytest.raises(SettingError, match="biquad of that number is a notch"):
        tune(model, r, start=low, variables=["Kp", "notch_width[0]"], evaluations=2)
    slower = replace(measured, Ts=2e-3, hertz=measured.hertz / 2.0)
    with pytest.raises(SettingError, match="sample time"):
        tune(
            model, r, start=start, constraints=Constraints(Ms=1.6, plant=[model, slower]),
            evaluations=2,
        )  # fmt: skip


def test_filters_are_proposed_where_the_shaft_swings() -> None:
    _, measured = two_masses()
    fit = fitted_shaft()
    assert fit.has_resonance
    own = fit.notch()
    assert own.named()["frequency"] == pytest.approx(60.0, rel=0.02)
    found = propose(fit, Ms=1.7, u_max=20.0)
    shaft = found.controller.biquads[0].named()
    assert 40.0 < shaft.get("frequency", shaft.get("zero_frequency")) < 90.0
    assert found.margins.stable
    assert found.margins.Ms <= 1.7 * 1.01
    assert measured.margins(found.controller).Ms_band[1] <= 1.7 * 1.03
    assert found.without is not None
    assert found.bandwidth_hertz > 1.3 * found.without.bandwidth_hertz
    assert not found.without.controller.biquads
    # above the lines that were measured the loop's gain is low, whatever the fit says there
    above = np.geomspace(measured.hertz[measured.coherence > 0.5].max(), 0.49 / TS, 200)
    L = loop_response(found.controller, fit.to_model(), 2.0 * np.pi * above)
    assert np.abs(L).max() < 0.45
    # what is stated is what the loop does: |S| reaches 1/sqrt(2) there, and not before
    hertz = found.bandwidth_hertz * np.append(np.geomspace(0.05, 0.98, 200), 1.0)
    S = 1.0 / np.abs(1.0 + loop_response(found.controller, fit.to_model(), 2.0 * np.pi * hertz))
    assert S[:-1].max() < math.sqrt(0.5)
    assert S[-1] == pytest.approx(math.sqrt(0.5), rel=0.01)


def test_what_cannot_be_proposed_for_is_refused() -> None:
    _, measured = two_masses()
    fit = fitted_shaft()
    for Ms in (1.0, 0.5, math.nan, math.inf):
        with pytest.raises(SettingError, match=r"Ms"):
            propose(fit, Ms=Ms)
    with pytest.raises(SettingError, match="sample time"):
        propose(fit, like=Controller(Gains.standard(1.0, 1.0), Ts=2e-3))
    with pytest.raises(SettingError, match="RPM"):
        propose(fit, like=Controller(Gains.standard(1.0, 1.0, y_unit="rad/s"), Ts=TS))
    rigid = fit_shaft(measured, resonance=False)
    with pytest.raises(FitError, match="rigid"):
        rigid.notch()


@pytest.mark.skipif(not FULL, reason="three more searches of some seconds: SEWFAST_SOAK=1")
def test_without_a_notch_the_gains_alone_are_proposed_and_a_larger_ms_is_faster() -> None:
    fit = fitted_shaft()
    found = propose(fit, Ms=1.7, u_max=20.0)
    assert found.without is not None
    plain = propose(fit, Ms=1.7, u_max=20.0, notch=False)
    assert plain.controller == found.without.controller
    assert plain.without is None
    assert propose(fit, Ms=2.2).bandwidth_hertz > found.bandwidth_hertz


def test_the_command_line_proposes_and_tunes_with_notches(tmp_path: Path, capsys: Any) -> None:
    model, measured = two_masses()
    measured.save(tmp_path / "response.json")
    model.save(tmp_path / "model.json")
    response, out = str(tmp_path / "response.json"), str(tmp_path / "c.json")
    main(["bode", response, "--propose", out, "--u-max", "10", "--Ms", "1.6"])
    assert "disturbances weakened up to" in capsys.readouterr().out
    assert load_controller(out).biquads
    assert load_controller(out).u_max == 10.0
    tune_it = [
        "tune", str(tmp_path / "model.json"), "--reference", "trapezoid", "--u-min", "-10",
        "--u-max", "10", "--evaluations", "80", "-o", out,
    ]  # fmt: skip
    limits = ["--constraint", "Ms=3", "--response", response]
    assert not main([*tune_it, "--notch", "60:0.2:0.4", *limits])
    assert [b.kind for b in load_controller(out).biquads] == ["notch"]
    assert not main([*tune_it, "--response", response])  # the default limit holds for it, too
    for more, message in (
        (["--notch", "x"], "HZ:DEPTH"),
        (["--notch", "60:1:1:1"], "HZ:DEPTH"),
        (["--notch", "900"], "half the sample rate"),
    ):
        assert main([*tune_it, *more]) == 2
        assert message in capsys.readouterr().err
    assert main(["bode", response, "--Ms", "1.6"]) == 2
    assert "--propose" in capsys.readouterr().err
