"""Frequency responses: machines whose truth is known, other people's estimators, hostile input."""

from __future__ import annotations

import json
import math
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from matplotlib import pyplot

import sewfast
from effort import FULL
from refusals import refuses
from sewfast import VirtualMachine, bode, fit_shaft, load_response
from sewfast.cli import main
from sewfast.commissioning import SteppedBench
from sewfast.errors import DataError, FitError, ModelFileError, SettingError
from sewfast.frequency import FrequencyResponse, periodic, spectral
from sewfast.frequency.shaft import ShaftFit

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "benches"))

COMPLIANT = {"load_inertia": 1e-3, "stiffness": 150.0, "damping": 0.01}


@pytest.fixture(scope="module")
def compliant() -> FrequencyResponse:
    return bode(VirtualMachine(**COMPLIANT), speed=1500.0)


@pytest.fixture(scope="module")
def shaft(compliant: FrequencyResponse) -> ShaftFit:
    return fit_shaft(compliant)


def controller(**more: Any) -> sewfast.Controller:
    gains = sewfast.Gains.standard(Kp=0.01, Ti=0.2, Td=0.0)
    return sewfast.Controller(
        gains, Ts=0.001, u_min=-20, u_max=20, counts_per_rev=1572, filter_samples=4, **more
    )


# --- A machine ------------------------------------------------------------------------------------


def test_a_shaken_machine_shows_its_small_signals(compliant: FrequencyResponse) -> None:
    from bode import small_signals

    exact = small_signals(VirtualMachine(**COMPLIANT), compliant.hertz, 1500.0)
    good = compliant.coherence > 0.95
    assert good.sum() > 40
    ratio = compliant.value[good] / exact[good]
    assert np.percentile(np.abs(20 * np.log10(np.abs(ratio))), 90) < 0.5
    assert np.percentile(np.abs(np.rad2deg(np.angle(ratio))), 90) < 3.0


@pytest.mark.nightly("a measurement for each shaft", by_day=["150.0-0.001"])
@pytest.mark.parametrize(("stiffness", "load"), [(40.0, 2e-3), (150.0, 1e-3), (600.0, 2e-3)])
def test_the_shaft_is_found_within_its_intervals(stiffness: float, load: float) -> None:
    from bode import modes, virtual

    machine = VirtualMachine(load_inertia=load, stiffness=stiffness, damping=0.01)
    near = math.sqrt(stiffness * (1 / 2e-3 + 1 / load)) / (2 * math.pi)
    truth = modes(virtual(machine, 1500.0)[0], near)
    fit = fit_shaft(bode(machine, speed=1500.0, seed=3))
    assert fit.has_resonance
    for name in ("resonance_hertz", "antiresonance_hertz"):
        assert fit.parameters[name].value == pytest.approx(truth[name], rel=0.01)
    assert fit.parameters["resonance_damping"].value == pytest.approx(
        truth["resonance_damping"], rel=0.2
    )
    assert fit.parameters["inertia_ratio"].value == pytest.approx(load / 2e-3, rel=0.05)
    assert "two masses" in str(fit)


@pytest.mark.nightly("a measurement for each seed", by_day=["3"])
@pytest.mark.parametrize("seed", [None, 1, 3, 12, 13] if FULL else [None, 3])
def test_a_rigid_machine_has_no_shaft(seed: int | None) -> None:
    fit = fit_shaft(bode(VirtualMachine(seed), speed=1500.0, seed=seed or 0))
    assert not fit.has_resonance
    assert "resonance_hertz" not in fit.parameters


@pytest.mark.nightly("a record for each signal", by_day=["random-1"])
@pytest.mark.parametrize(("signal", "seed"), [("random", 1), ("prbs", 1)])
def test_a_few_frequencies_of_an_ordinary_record_are_no_shaft(signal: str, seed: int) -> None:
    u = sewfast.signals.excitation(signal, seed)
    fit = fit_shaft(bode(sewfast.record(VirtualMachine(seed), u, name=signal)))
    assert not fit.has_resonance


def test_the_fit_is_a_model_like_any_other(compliant: FrequencyResponse, shaft: ShaftFit) -> None:
    fit = shaft
    model = fit.to_model()
    step = np.exp(-2j * np.pi * compliant.hertz * 1e-3)
    num, den = model.to_tf()
    num, den = np.ravel(num), np.ravel(den)
    speed = sum(b * step**k for k, b in enumerate(num)) / sum(
        a * step**k for k, a in enumerate(den)
    )
    # the mean over a sample is nearly that of both its ends
    seen = speed * 0.5 * (1.0 + step)
    low = compliant.hertz < 60.0
    np.testing.assert_allclose(seen[low], fit.at(compliant.hertz)[low], rtol=0.02)
    assert sewfast.margins(controller(), model).stable


def test_margins_agree_with_those_of_the_fit_and_of_the_loop(
    compliant: FrequencyResponse, shaft: ShaftFit
) -> None:
    measured = compliant.margins(controller())
    predicted = sewfast.margins(controller(), shaft.to_model())
    assert measured.phase_margin_deg == pytest.approx(predicted.phase_margin_deg, abs=3.0)
    assert measured.Ms == pytest.approx(predicted.Ms, rel=0.05)
    low, high = measured.Ms_band
    assert low <= measured.Ms <= high
    again = bode(VirtualMachine(**COMPLIANT), speed=1500.0, controller=controller())
    remeasured = again.margins(controller())
    assert remeasured.phase_margin_deg == pytest.approx(predicted.phase_margin_deg, abs=3.0)
    assert remeasured.Ms == pytest.approx(predicted.Ms, rel=0.05)


@pytest.mark.nightly("the measurement once more on a machine of Python")
def test_a_machine_of_the_users_own_is_shaken_the_same_way() -> None:
    class Own:
        """Gain 100 RPM/V, time constant 50 ms, delay of a sample."""

        def __init__(self) -> None:
            self.reset()

        def reset(self) -> None:
            self.speed = self.angle = self.before = 0.0

        @property
        def counts(self) -> float:
            return math.floor(self.angle * 4000)

        def step(self, u: float) -> None:
            self.speed += (100.0 * self.before - self.speed) * 1e-3 / 0.05
            self.before = u
            self.angle += self.speed / 60.0 * 1e-3

    bench = SteppedBench(Own(), Ts=1e-3, counts_per_rev=4000, volt=24.0)
    found = fit_shaft(bode(bench, speed=1000.0))
    assert not found.has_resonance
    assert found.parameters["gain"].value == pytest.approx(100.0, rel=0.01)
    lags = [found.parameters[n].value for n in ("lag_1", "lag_2")]
    assert sum(lags) + found.parameters["delay"].value == pytest.approx(0.0505, abs=2e-3)


def test_a_seed_gives_the_same_bits() -> None:
    first, second = (
        bode(VirtualMachine(), speed=1500.0, seed=5, realisations=1, periods=2) for _ in range(2)
    )
    np.testing.assert_array_equal(first.value, second.value)


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        ({}, "the working speed"),
        ({"speed": 0.0}, "other than 0"),
        ({"speed": math.nan}, "speed"),
        ({"speed": 1e6}, "steady command"),
        ({"speed": 1500.0, "amplitude": 19.0}, "amplitude: expected above 0"),
        ({"speed": 1500.0, "amplitude": -1.0}, "amplitude"),
        ({"speed": 1500.0, "amplitude": 1e-6}, "none that stands out"),
        ({"speed": 1500.0, "f_min": 600.0}, "f_min"),
        ({"speed": 1500.0, "period": 0.1}, "period"),
        ({"speed": 1500.0, "period": 1e9}, "period"),
        ({"speed": 1500.0, "periods": 0}, "periods"),
        ({"speed": 1500.0, "periods": 1, "realisations": 1}, "two in all"),
        ({"speed": 1500.0, "realisations": 2**40}, "realisations"),
        ({"speed": 1500.0, "segment": 100}, "belongs to a record"),
        ({"speed": 200.0, "amplitude": 15.0, "f_max": 20.0}, "swings the speed"),
    ],
)
def test_what_cannot_be_shaken_is_refused(wrong: dict[str, Any], said: str) -> None:
    with pytest.raises((SettingError, DataError), match=said):
        bode(VirtualMachine(), **wrong)


def test_a_limited_command_is_refused() -> None:
    tight = controller()
    gains = sewfast.Gains.standard(Kp=0.05, Ti=0.2, Td=0.0)
    tight = sewfast.Controller(gains, Ts=0.001, u_min=0, u_max=4, counts_per_rev=1572)
    with pytest.raises(DataError, match="within its limits"):
        bode(VirtualMachine(), speed=1500.0, controller=tight, amplitude=300.0)


# --- Signals --------------------------------------------------------------------------------------


def test_bands_hold_the_truth_as_often_as_they_say() -> None:
    rng = np.random.default_rng(0)
    inside = []
    lines = np.arange(1, 80, 2)
    for _ in range(200):
        spectrum = np.zeros((4, 101), dtype=np.complex128)
        spectrum[:, lines] = np.exp(2j * np.pi * rng.random((4, len(lines))))
        u = np.repeat(np.fft.irfft(spectrum, 200)[:, None], 2, axis=1)
        y = 2.0 * u + 0.1 * rng.normal(size=u.shape)
        found = periodic(u, y, Ts=1.0, lines=lines)
        inside.append(np.abs(found.value - 2.0) < found.radius())
    assert 0.93 < np.mean(inside) < 0.97


def test_noise_is_told_from_distortion() -> None:
    rng = np.random.default_rng(1)
    lines = np.arange(1, 60, 2)
    spectrum = np.zeros((20, 129), dtype=np.complex128)
    spectrum[:, lines] = np.exp(2j * np.pi * rng.random((20, len(lines))))
    x = np.fft.irfft(spectrum, 256)
    u = np.repeat(x[:, None] / x.std(), 3, axis=1)
    for bend, share in ((0.0, (0.0, 0.8)), (0.1, (0.9, 1.0))):
        y = u + bend * u**3 + 0.05 * rng.normal(size=u.shape)
        found = periodic(u, y, Ts=1.0, lines=lines)
        assert found.noise is not None
        extra = np.maximum(found.variance - found.noise, 0.0).sum() / found.variance.sum()
        assert share[0] <= extra <= share[1]
        # a cubic of a Gaussian signal adds three times its variance to the gain
        assert np.mean(found.value.real) == pytest.approx(1.0 + 3.0 * bend, rel=0.1)


def test_feedback_does_not_bias_the_response() -> None:
    """The naive quotient is off by more than 3 dB; that with the reference is not."""
    rng = np.random.default_rng(2)
    n = 400_000
    r, v = rng.normal(size=n), 1.5 * rng.normal(size=n)
    u, y = np.zeros(n), np.zeros(n)
    x = 0.0
    for k in range(n - 1):
        u[k] = r[k] - 0.8 * y[k]
        x = 0.7 * x + 0.3 * u[k]
        y[k + 1] = x + v[k + 1]
    naive = spectral(u, y, Ts=1e-3, segment=256)
    joint = spectral(u, y, Ts=1e-3, segment=256, r=r)
    inside = slice(2, -2)
    step = np.exp(-2j * np.pi * joint.hertz * 1e-3)
    truth = 0.3 * step / (1.0 - 0.7 * step)
    bias = np.abs(20 * np.log10(np.abs(naive.value / truth)))[inside]
    assert np.median(bias) > 3.0
    error = 20 * np.log10(np.abs(joint.value / truth))[inside]
    assert np.abs(np.mean(error)) < 0.3
    held = np.abs(joint.value - truth) < joint.radius()
    assert 0.9 < np.mean(held[inside]) < 1.0


def test_spectra_are_those_of_scipy() -> None:
    signal = pytest.importorskip("scipy.signal")
    rng = np.random.default_rng(3)
    u = rng.normal(size=20_000)
    y = signal.lfilter([0.0, 0.2], [1.0, -0.8], u) + 0.3 * rng.normal(size=len(u))
    found = spectral(u, y, Ts=0.01, segment=1000)
    options = {"fs": 100.0, "window": "hann", "nperseg": 1000, "noverlap": 500}
    f, crossed = signal.csd(u, y, detrend="constant", **options)
    _, power = signal.welch(u, detrend="constant", **options)
    _, coherence = signal.coherence(u, y, detrend="constant", **options)
    np.testing.assert_allclose(found.hertz, f[1:], rtol=1e-12)
    np.testing.assert_allclose(found.value, (crossed / power)[1:], rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(found.coherence, coherence[1:], rtol=1e-9, atol=1e-12)


def test_a_record_is_taken_as_it_is_measured() -> None:
    recording = sewfast.record(VirtualMachine(), sewfast.signals.excitation("multisine"))
    found = bode(recording)
    assert found.from_counts
    assert found.at(1.0).real > 50.0
    with pytest.raises(DataError, match="smoothed"):
        bode(recording.dataset())
    plain = sewfast.Dataset.from_arrays(recording.u, recording.speed("difference"), 1e-3)
    np.testing.assert_array_equal(bode(plain).value, found.value)
    with refuses(SettingError, name="speed", received="a record"):
        bode(recording, speed=1500.0)
    with pytest.raises(SettingError, match="reference"):
        bode(plain, reference="r")


@pytest.mark.parametrize(("scale", "r", "match"), [(1.0, 1.0, "moves"), (1e300, None, "squares")])
@pytest.mark.filterwarnings("ignore:.*encountered")
def test_what_gives_no_response_is_refused(scale: float, r: float | None, match: str) -> None:
    u = scale * np.random.default_rng(5).normal(size=5000)
    with pytest.raises(DataError, match=match):
        spectral(u, u, Ts=1e-3, r=None if r is None else np.full(5000, r))


def test_a_reference_that_has_nothing_to_do_with_it_is_refused() -> None:
    rng = np.random.default_rng(4)
    u = rng.normal(size=5000)
    with pytest.raises(DataError, match="nothing to do with it"):
        spectral(u, u, Ts=1.0, r=rng.normal(size=5000))


@pytest.mark.parametrize(
    ("u", "said"),
    [
        (np.zeros(5000), "constant"),
        (np.full(5000, np.nan), "finite"),
        (np.zeros((50, 2)), "shape"),
        (np.arange(10.0), "segments"),
        (["a"] * 5000, "numbers"),
        (np.arange(5000) % 7 * 1e-300, "differ by 1e-60"),
    ],
)
def test_signals_without_a_response_are_refused(u: Any, said: str) -> None:
    y = np.random.default_rng(0).normal(size=len(u))
    with pytest.raises(DataError, match=said):
        spectral(u, y, Ts=1e-3)


@settings(max_examples=40)
@given(
    st.lists(st.floats(allow_nan=True, allow_infinity=True), min_size=0, max_size=200),
    st.integers(-5, 300),
)
def test_any_signal_gives_a_response_or_a_refusal(values: list[float], segment: int) -> None:
    u = np.array(values)
    try:
        found = spectral(u, u[::-1], Ts=1e-3, segment=segment)
    except (DataError, SettingError):
        return
    assert np.isfinite(found.value).all()
    assert np.isfinite(found.variance).all()


# --- Results --------------------------------------------------------------------------------------


def test_files_come_back(compliant: FrequencyResponse, tmp_path: Path) -> None:
    place = tmp_path / "response.json"
    compliant.save(place)
    again = load_response(place)
    for name in ("hertz", "value", "variance", "noise", "coherence"):
        np.testing.assert_array_equal(getattr(again, name), getattr(compliant, name))
    assert again.provenance == compliant.provenance
    assert str(again) == str(compliant)
    content = json.loads(place.read_text())
    for name, value in (("real", [1.0]), ("hertz", []), ("Ts", -1.0), ("blocks", "four")):
        place.write_text(json.dumps({**content, name: value}))
        with pytest.raises(ModelFileError, match=name):
            load_response(place)


@pytest.mark.nightly("pictures of a response; `test_plotting` draws the others")
def test_a_response_draws_itself(compliant: FrequencyResponse, tmp_path: Path) -> None:
    panels = compliant.plot(fit=fit_shaft(compliant))
    assert [ax.get_ylabel() for ax in panels][1:] == ["phase [deg]", "coherence"]
    assert panels[0].get_xscale() == "log"
    pyplot.close(panels[0].figure)
    compliant.plot(file=tmp_path / "bode.png")
    assert (tmp_path / "bode.png").stat().st_size > 10_000
    assert "<" in compliant._repr_html_()


def test_other_tools_take_it(compliant: FrequencyResponse) -> None:
    pytest.importorskip("control")
    theirs = compliant.to_control()
    omega = 2 * np.pi * compliant.hertz[5]
    assert complex(np.squeeze(theirs(1j * omega))) == pytest.approx(compliant.value[5])


def test_what_does_not_fit_together_is_refused(compliant: FrequencyResponse) -> None:
    slow = sewfast.Controller(sewfast.Gains.standard(0.01, 0.2, 0.0), Ts=0.01)
    with pytest.raises(SettingError, match="sample time"):
        compliant.margins(slow)
    with pytest.raises(SettingError, match="measured"):
        compliant.at(1e4)
    with pytest.raises(SettingError, match="level"):
        compliant.radius(95.0)
    rng = np.random.default_rng(0)
    noise = spectral(rng.normal(size=4000), rng.normal(size=4000), Ts=1e-3)
    with pytest.raises(DataError, match="at least 20"):
        fit_shaft(noise)
    with pytest.raises(FitError, match="resonance"):
        fit_shaft(bode(VirtualMachine(), speed=1500.0, f_max=30.0), resonance=True)


def test_the_command_shows_the_resonance(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    name = "virtual?load_inertia=0.001&shaft_stiffness=150"
    controller().save("controller.json")
    words = ["bode", "--on", name, "--speed", "1500", "-o", "r.json", "--model", "m.json"]
    assert main([*words, "--plot", "bode.svg"]) == 0
    assert "resonance_hertz" in capsys.readouterr().out
    assert main(["bode", "r.json", "--controller", "controller.json", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["shaft"]["resonance"]
    assert 60.0 < found["margins"]["phase_margin_deg"] < 90.0
    assert main(["analyse", "controller.json", "m.json"]) == 0
    capsys.readouterr()
    assert main(["record", "--on", "virtual", "--signal", "random", "-o", "run.csv"]) == 0
    counts = ["--input", "u", "--counts", "counts", "--counts-per-rev", "1572"]
    assert main(["bode", "run.csv", *counts]) == 0
    assert "frequency response" in capsys.readouterr().out
    # again over its own model, and over nothing else
    assert main(["bode", "r.json", "--model", "m.json"]) == 0
    assert main(["identify", "run.csv", *counts, "--model", "arx", "-o", "identified.json"]) == 0
    for other in ("identified.json", "controller.json"):
        before = Path(other).read_bytes()
        for command in (["bode", "r.json"], ["physics", "run.csv", *counts]):
            assert main([*command, "--model", other]) == 2
            assert "choose another name" in capsys.readouterr().err
        assert Path(other).read_bytes() == before
    for wrong in (["bode"], ["bode", "run.csv", "--on", "virtual"], ["bode", "controller.json"]):
        assert main(wrong) == 2
    assert main(["bode", "run.csv", *counts, "--amplitude", "3"]) == 2
    assert "expected a machine" in capsys.readouterr().err
