"""A machine that is shaken: at several speeds, and when it breaks off."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib import pyplot

import sewfast
from refusals import refuses
from sewfast import VirtualMachine, bode, load_response, load_responses
from sewfast.cli import main
from sewfast.commissioning.bench import MachineBench, SteppedBench
from sewfast.errors import DataError, LinkError, ModelFileError, SettingError
from sewfast.recording import Recording

COMPLIANT = {"load_inertia": 1e-3, "stiffness": 150.0, "damping": 0.01}
QUICK = {"realisations": 1, "periods": 2}


def controller() -> sewfast.Controller:
    gains = sewfast.Gains.standard(Kp=0.01, Ti=0.2, Td=0.0)
    return sewfast.Controller(
        gains, Ts=0.001, u_min=-20, u_max=20, counts_per_rev=1572, filter_samples=4
    )


# --- Several speeds -------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def speeds() -> sewfast.ResponsesOverSpeed:
    return bode(VirtualMachine(**COMPLIANT), speed=[2000.0, 1000.0, 1e5], **QUICK)


def test_several_speeds_are_one_result(speeds: sewfast.ResponsesOverSpeed) -> None:
    assert speeds.speeds == (1000.0, 2000.0)
    assert "steady command" in speeds.refused[1e5] or "below" in speeds.refused[1e5]
    alone = bode(VirtualMachine(**COMPLIANT), speed=1000.0, **QUICK)
    np.testing.assert_array_equal(speeds[1000.0].value, alone.value)
    assert [r.provenance["speed"] for r in speeds] == [1000.0, 2000.0]
    for fit in speeds.fits.values():
        assert fit.parameters["resonance_hertz"].value == pytest.approx(75.5, rel=0.02)
    text = str(speeds)
    assert text.count("Hz") == 2
    assert "100000" in text or "1e+05" in text
    margins = speeds.margins(controller())
    assert list(margins) == [1000.0, 2000.0]
    assert margins[1000.0] == speeds[1000.0].margins(controller(), speed=1000.0)
    with refuses(SettingError, name="speed", expected="1000, 2000 RPM"):
        speeds[1500.0]


def test_their_files_come_back(
    speeds: sewfast.ResponsesOverSpeed, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    place, loop = tmp_path / "speeds.json", tmp_path / "controller.json"
    speeds.save(place)
    controller().save(loop)
    assert main(["bode", str(place), "--controller", str(loop)]) == 0
    assert capsys.readouterr().out.startswith(str(speeds))
    assert main(["bode", str(place), "--controller", str(loop), "--json"]) == 0
    shown = json.loads(capsys.readouterr().out)
    assert len(shown["shafts"]) == 2
    margins = speeds.margins(controller())
    assert [m["Ms"] for m in shown["margins"]] == [m.Ms for m in margins.values()]
    again = load_responses(place)
    assert str(again) == str(speeds)
    for one, other in zip(again, speeds, strict=True):
        np.testing.assert_array_equal(one.value, other.value)
    content = json.loads(place.read_text())
    for name, value in (("speeds", [1.0]), ("responses", 3), ("refused", ["no"])):
        place.write_text(json.dumps({**content, name: value}))
        with pytest.raises(ModelFileError, match=name):
            load_responses(place)
    with pytest.raises(ModelFileError):
        load_response(place)


def test_they_are_drawn_over_each_other(speeds: sewfast.ResponsesOverSpeed) -> None:
    panels = speeds.plot()
    assert [line.get_label() for line in panels[0].lines] == ["1000 RPM", "2000 RPM"]
    assert [ax.get_ylabel() for ax in panels][1:] == ["phase [deg]", "coherence"]
    pyplot.close(panels[0].figure)


@pytest.mark.parametrize("wrong", [[], [100.0, 100.0], [[100.0]], [500.0, float("nan")]])
def test_speeds_that_are_none_are_refused(wrong: Any) -> None:
    with refuses(SettingError, name="speed"):
        bode(VirtualMachine(), speed=wrong)


@pytest.mark.nightly("a second measurement at several speeds; the library's runs in `make test`")
def test_the_command_takes_several_speeds(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    controller().save("controller.json")
    words = ["bode", "--on", "virtual", "--speed", "1000,2000", "--realisations", "1"]
    assert main([*words, "--periods", "2", "-o", "speeds.json", "--plot", "speeds.png"]) == 0
    assert "at 2 speeds" in capsys.readouterr().out
    assert Path("speeds.png").stat().st_size > 10_000
    assert main(["bode", "speeds.json", "--controller", "controller.json", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["speeds"] == [1000.0, 2000.0]
    assert len(found["margins"]) == 2
    assert main(["bode", "speeds.json", "--model", "model.json"]) == 2
    assert "--model: expected a response about one speed" in capsys.readouterr().err


# --- A resonance beyond what was measured ---------------------------------------------------------


@pytest.mark.nightly("a measurement for each shaft", by_day=["470.0-0.03"])
@pytest.mark.parametrize(("hertz", "near"), [(470.0, 0.03), (700.0, 0.05), (None, None)])
def test_a_resonance_beyond_the_measured_frequencies_is_said_to_be_there(
    hertz: float | None, near: float | None
) -> None:
    """Below and above half the sample rate, 500 Hz; a rigid machine has none."""
    shaft: dict[str, float] = {}
    if hertz is not None:
        motor, load = 1.5e-3, 1.5e-3
        reduced, w = motor * load / (motor + load), 2.0 * np.pi * hertz
        shaft = {"load_inertia": load, "stiffness": reduced * w**2, "damping": 0.04 * w * reduced}
    machine = VirtualMachine(quantisation=False, parameters={"inertia": 1.5e-3}, **shaft)
    fit = sewfast.fit_shaft(bode(machine, speed=1500.0, realisations=2))
    assert not fit.has_resonance
    if hertz is None:
        assert fit.beyond_hertz is None
        assert "beyond" not in str(fit)
    else:
        assert fit.beyond_hertz == pytest.approx(hertz, rel=near)
        assert "a resonance beyond 399.5 Hz" in str(fit)
        assert fit.to_dict()["beyond_hertz"] == fit.beyond_hertz


# --- A run that breaks off ------------------------------------------------------------------------


@dataclass(frozen=True)
class Tripping:
    """A machine that trips some seconds into the multisine."""

    inner: MachineBench
    after: float

    name, Ts, counts_per_rev, volt, speed = "tripping", 1e-3, 1572.0, 20.0, 4000.0

    def _trip(self, whole: Recording, keeps: Any) -> None:
        n = round(self.after / self.Ts)
        error = LinkError(
            expected="a run that finishes",
            received="one that tripped: current",
            remedy="find out why",
        )
        error.recording = keeps(
            replace(whole, u=whole.u[:n], counts=whole.counts[:n], y=whole.y[:n], speed_true=None)
        )
        raise error

    def excite(self, u: Any, name: str) -> Recording:
        found = self.inner.excite(u, name)
        if name == "multisine" and len(u) * self.Ts > self.after:
            self._trip(found, lambda kept: kept)
        return found

    def follow(self, controller: Any, r: Any, name: str) -> Any:
        found = self.inner.follow(controller, r, name)
        self._trip(found.recording, lambda kept: replace(found, recording=kept))


def tripping(after: float) -> Tripping:
    return Tripping(MachineBench(VirtualMachine(**COMPLIANT)), after)


@pytest.mark.nightly("a measurement and fits for each limit; by day a trip under feedback")
@pytest.mark.parametrize(("after", "blocks"), [(25.0, 2.0), (12.5, 3.0)])
def test_a_trip_in_mid_shake_keeps_the_whole_periods(after: float, blocks: float) -> None:
    """Two of four multisines, or three periods of the first."""
    found = bode(tripping(after), speed=1500.0)
    whole = bode(VirtualMachine(**COMPLIANT), speed=1500.0)
    assert found.blocks == blocks
    assert "tripped: current" in found.provenance["incomplete"]
    assert "incomplete expected a run that finishes" in str(found)
    good = (found.coherence > 0.95) & (whole.coherence > 0.95)
    assert good.sum() > 40
    assert np.percentile(np.abs(found.value / whole.value - 1.0)[good], 90) < 0.15
    assert sewfast.fit_shaft(found).has_resonance


def test_a_trip_before_two_periods_leaves_a_record() -> None:
    found = bode(tripping(7.0), speed=1500.0)
    assert np.ndim(found.blocks) == 1
    whole = bode(VirtualMachine(**COMPLIANT), speed=1500.0)
    low = (found.coherence > 0.95) & (found.hertz > 2.0) & (found.hertz < 50.0)
    near = np.array([whole.at(f) for f in found.hertz[low]])
    assert low.sum() > 10
    assert np.percentile(np.abs(found.value[low] / near - 1.0), 90) < 0.2


def test_a_trip_with_nothing_to_keep_is_an_error() -> None:
    with pytest.raises(LinkError, match="tripped"):
        bode(tripping(2.5), speed=1500.0)


def test_a_trip_under_feedback_keeps_what_there_is() -> None:
    found = bode(tripping(14.0), speed=1500.0, controller=controller())
    assert found.blocks == 4.0
    whole = bode(VirtualMachine(**COMPLIANT), speed=1500.0, controller=controller())
    assert found.margins(controller()).phase_margin_deg == pytest.approx(
        whole.margins(controller()).phase_margin_deg, abs=3.0
    )


def test_speeds_after_a_trip_are_not_measured() -> None:
    found = bode(tripping(25.0), speed=[1000.0, 1500.0, 2000.0])
    assert found.speeds == (1000.0,)
    assert set(found.refused) == {1500.0, 2000.0}
    assert "not measured after" in found.refused[2000.0]


def test_a_speed_that_reverses_is_refused() -> None:
    """A slow period swings the speed further than it is predicted from the steady gain."""
    machine = MachineBench(VirtualMachine())

    @dataclass(frozen=True)
    class Strong:
        """Takes three times the command."""

        name, Ts, counts_per_rev, volt, speed = "strong", 1e-3, 1572.0, 20.0, 4000.0

        def excite(self, u: Any, name: str) -> Recording:
            # what holds the speed stays, what shakes it is larger
            level = u[0]
            return machine.excite(level + 4.0 * (u - level), name)

        def follow(self, controller: Any, r: Any, name: str) -> Any:
            raise NotImplementedError

    with refuses(sewfast.DataError, name="amplitude", expected="keeps its sign"):
        bode(Strong(), speed=500.0, **QUICK)


class Lag:
    """100 RPM/V with a time constant of .1 s, and the commands that it was advanced with."""

    def __init__(self) -> None:
        self.sent: list[float] = []
        self.reset()

    def reset(self) -> None:
        self.turns = self.speed = self.counts = 0.0

    def step(self, u: float) -> None:
        if self.turns > 0.0:
            self.sent.append(u)
        self.speed += 0.01 * (100.0 * u - self.speed)
        self.turns += self.speed / 60.0 * 1e-3
        self.counts = float(np.floor(self.turns * 4096.0))


def test_a_loop_that_is_shaken_to_its_limit_is_ended_at_once() -> None:
    """Not after half a minute from limit to limit: nothing of it could be used."""
    lag = Lag()
    on = SteppedBench(lag, Ts=0.001, counts_per_rev=4096.0, volt=10.0)
    gains = sewfast.Gains.standard(Kp=0.2, Ti=0.2, Td=0.0)
    tight = sewfast.Controller(
        gains, Ts=0.001, u_min=0, u_max=4, counts_per_rev=4096, filter_samples=4
    )
    with refuses(DataError, name="amplitude", expected="within its limits"):
        bode(on, speed=300.0, controller=tight, amplitude=60.0)
    # until it is left to come to rest
    assert np.isin(np.trim_zeros(lag.sent, "b"), (0.0, 4.0)).sum() < 100
