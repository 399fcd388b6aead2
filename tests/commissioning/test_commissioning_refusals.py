"""Commissioning: every reason to stop."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest

from commissioned import SMALL, short
from sewfast import (
    Controller,
    DataError,
    Dataset,
    Gains,
    LinearOE,
    Model,
    SettingError,
    VirtualMachine,
    commission,
    run,
)
from sewfast.commissioning import Bench, Followed, Refusal, gains, procedure, training
from sewfast.commissioning.demands import demands
from sewfast.commissioning.gains import held, swing_of
from sewfast.control.benches import MachineBench
from sewfast.recording import Recording


@pytest.fixture(autouse=True, scope="module")
def _short() -> Iterator[None]:
    with short():
        yield


@dataclass
class Bent(Bench):
    """The virtual machine with a bend in what it does or shows."""

    inner: MachineBench
    sign: float = 1.0
    most: float = np.inf
    slips: bool = False
    played: int = 0

    name = "bent"
    speed = np.inf

    @property
    def Ts(self) -> float:
        return self.inner.Ts

    @property
    def counts_per_rev(self) -> float:
        return self.inner.counts_per_rev

    @property
    def volt(self) -> float:
        return self.inner.volt

    def bend(self, recording: Recording) -> Recording:
        counts = np.minimum(self.sign * recording.counts, self.most)
        if self.slips:
            counts = counts * (1.0 + 0.5 * np.sin(np.arange(len(counts)) / 700.0))
        bent = replace(recording, counts=counts)
        return replace(bent, y=bent.speed("savgol"))

    def excite(self, u: np.ndarray, name: str) -> Recording:
        self.played += 1
        return self.bend(self.inner.excite(u, name))

    def follow(self, controller: Controller, r: np.ndarray, name: str) -> Followed:
        self.played += 1
        found = self.inner.follow(controller, r, name)
        return Followed(found.run, self.bend(found.recording))


def bent(parameters: dict[str, float] | None = None, **bend: Any) -> Bent:
    return Bent(MachineBench(VirtualMachine(parameters=parameters)), **bend)


def refused(bench: Bench, match: str, **options: Any) -> Refusal:
    with pytest.raises(Refusal, match=match) as caught:
        commission(bench, **{**SMALL, **options})
    assert caught.value.so_far is not None
    assert caught.value.so_far.verdict == "refused"
    assert caught.value.so_far.stage == caught.value.stage
    return caught.value


def test_a_dead_machine_is_refused_at_the_first_motion() -> None:
    found = refused(
        bent({"coulomb_torque": 10.0}), "expected the machine to move.*no motion: .*free"
    )
    assert found.stage == "first motion"
    assert found.so_far is not None
    assert found.so_far.recordings


def test_a_machine_that_turns_backwards_is_refused_before_a_loop_is_closed() -> None:
    bench = bent(sign=-1.0)
    assert refused(bench, "sign: .*backwards.*swap").stage == "first motion"
    assert bench.played <= 8


def test_an_end_stop_is_too_little_travel() -> None:
    assert refused(bent(most=300.0), "too little travel").stage == "first motion"


def test_a_machine_too_weak_for_its_top_speed_is_refused() -> None:
    found = refused(bent(), "lower speed", u_max=3.0)
    assert found.stage in ("first motion", "step response")


def test_a_loop_that_swings_from_limit_to_limit_is_refused_at_once(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def wild(*args: Any) -> Controller:
        return replace(gains.first_gains(*args), gains=Gains.standard(50.0, 0.05))

    monkeypatch.setattr(procedure, "first_gains", wild)
    found = refused(bent(), "expected a quiet loop at 1000 RPM under a quarter of the gains")
    assert found.stage == "closed loop"


def test_a_step_that_does_not_settle_is_refused() -> None:
    assert refused(bent(slips=True), "expected a s").stage in ("first motion", "step response")


@pytest.mark.nightly("a commissioning of its own")
def test_where_networks_and_rival_do_not_predict_it_is_refused(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(training, "validate_member", lambda *_: (100.0, 40.0))
    monkeypatch.setattr(procedure, "linear_rival", lambda *_: None)
    assert refused(bent(), "free-run fit of 85 %").stage == "training"


def score_networks(
    monkeypatch: pytest.MonkeyPatch, score: Callable[[Model, Dataset], tuple[float, float]]
) -> None:
    """Errors and fits of networks as `score` gives them, of the linear rival as they are."""
    honest = training.validate_member

    def of(model: Model, data: Dataset) -> tuple[float, float]:
        return honest(model, data) if isinstance(model, LinearOE) else score(model, data)

    monkeypatch.setattr(training, "validate_member", of)


@pytest.mark.nightly("a commissioning of its own")
def test_where_networks_alone_do_not_predict_the_linear_model_stands_in(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    score_networks(monkeypatch, lambda *_: (100.0, 40.0))
    found = commission(VirtualMachine(), **SMALL)
    assert found.is_verified
    assert found.models is not None
    assert found.rival is not None
    assert [m.kind for m in found.models.members] == [found.rival.model.kind]
    assert "free-run fit of 85 %" in found.notes[0]
    assert found.controller is not None
    assert found.controller.notes == "commissioned on a linear model"
    told = found.numbers()
    assert told["notes"] == list(found.notes)
    assert told["second_opinion"] is None


@pytest.mark.nightly("a commissioning of its own")
def test_networks_far_behind_the_best_have_no_say(monkeypatch: pytest.MonkeyPatch) -> None:
    def score(model: Model, data: Dataset) -> tuple[float, float]:
        seed = model.training["seed"]
        return (30.0, 99.0) if seed == 1 else (500.0, 60.0)

    score_networks(monkeypatch, score)
    found = commission(bent(), **{**SMALL, "members": 3})
    assert found.models is not None
    assert [m.training["seed"] for m in found.models.members] == [1]


@pytest.mark.nightly("a commissioning of its own")
def test_a_machine_that_changed_is_not_verified() -> None:
    class Changes(Bent):
        def follow(self, controller: Controller, r: np.ndarray, name: str) -> Followed:
            if name in ("trapezoid", "chirp_hi_lo", "chirp_lo_hi", "random"):
                values = {"current_limit": 1.0}
                self.inner = MachineBench(VirtualMachine(parameters=values))
            return super().follow(controller, r, name)

    found = refused(Changes(MachineBench(VirtualMachine())), "verif|limits most")
    assert found.stage == "verification"
    assert found.so_far is not None
    assert found.so_far.controller is not None


@pytest.mark.parametrize(
    ("options", "name", "expected"),
    [
        ({"u_max": 0.0}, "u_max", "above 0 V"),
        ({"u_max": 40.0}, "u_max", "within the machine's limit of 20 V"),
        ({"speed": -1.0}, "speed", "above 0 RPM"),
        ({"members": 0}, "members", "1 or more"),
        ({"members": 10**9}, "members", "up to 100"),
        ({"cost": "x"}, "cost", "a Cost, or None"),
        ({"progress": "x"}, "progress", "a function, or None"),
        ({"between": 5}, "between", "a function, or None"),
        ({"cancel": "x"}, "cancel", "a threading.Event, or None"),
        ({"references": 5}, "references", "a mapping from names to samples, or a sequence of "
         "names"),
        ({"evaluations": 0}, "evaluations", "1 or more"),
        ({"load": -1.0}, "load", "from 0 V to below u_max = 20 V"),
        ({"load": 20.0}, "load", "from 0 V to below u_max = 20 V"),
        ({"references": "trapezoid"}, "references", "a mapping from names to samples, or a "
         "sequence of names"),
        ({"references": ["trapezoid"], "speed": 500.0}, "references", "none beyond the top speed "
         "of 500 RPM"),
    ],
)  # fmt: skip
def test_demands_that_contradict_are_refused_before_anything_moves(
    options: dict[str, Any], name: str, expected: str
) -> None:
    bench = bent()
    with pytest.raises(SettingError) as caught:
        commission(bench, **options)
    assert (caught.value.name, caught.value.expected) == (name, expected)
    assert bench.played == 0


@pytest.mark.parametrize(
    ("options", "match"),
    [
        ({"Ms": 0.9}, "above 1 for Ms"),
        ({"time_budget": 0.0}, "time_budget above 0"),
        ({"references": ["nonsense"]}, "known ones"),
    ],
)
def test_what_a_part_of_it_refuses_is_refused_before_anything_moves(
    options: dict[str, Any], match: str
) -> None:
    bench = bent()
    with pytest.raises(SettingError, match=match):
        commission(bench, **options)
    assert bench.played == 0


@pytest.mark.parametrize(
    ("samples", "received"),
    [
        ([], "0"),
        ([500.0], "1"),
        ([1.0, float("nan")], "NaN or infinity"),
        ([0.0] * 40, "zeros only"),
    ],
)
def test_a_reference_that_cannot_be_run_is_refused(samples: list[float], received: str) -> None:
    bench = bent()
    with pytest.raises(DataError) as caught:
        commission(bench, references={"mine": samples})
    assert (caught.value.name, caught.value.received) == ("mine", received)
    assert bench.played == 0


class Odd(MachineBench):
    """A machine of the user's own that states nonsense, or hands it back."""

    def __init__(self, shown: Any = None, /, **stated: Any) -> None:
        super().__init__(VirtualMachine())
        self.__dict__.update(shown=shown, stated=stated, played=0)

    def __getattribute__(self, name: str) -> Any:
        stated = object.__getattribute__(self, "__dict__").get("stated", {})
        return stated[name] if name in stated else object.__getattribute__(self, name)

    def excite(self, u: np.ndarray, name: str) -> Any:
        self.__dict__["played"] += 1
        return self.shown(super().excite(u, name))


@pytest.mark.parametrize(
    ("name", "value"),
    [
        *(("Ts", value) for value in (np.nan, 0.0, -1e-3, "1 ms", np.inf, 1e-12, 10.0, None)),
        *(("counts_per_rev", value) for value in (0.0, np.nan, -5.0, None, np.inf)),
        *(("volt", value) for value in (0.0, np.nan, None, "20")),
        *(("speed", value) for value in (np.nan, None, -1.0)),
    ],
)
def test_a_machine_whose_numbers_are_none_is_refused_before_it_moves(name: str, value: Any) -> None:
    odd = Odd(**{name: value})
    with pytest.raises(SettingError) as caught:
        commission(odd, **SMALL)
    assert caught.value.name == name
    assert odd.played == 0


def _first_is_missing(recording: Recording) -> Recording:
    counts = recording.counts.copy()
    counts[0] = np.nan
    return replace(recording, counts=counts)


@pytest.mark.parametrize(
    ("shown", "error", "expected"),
    [
        (lambda recording: None, SettingError, "a Recording"),
        (lambda recording: recording.counts, SettingError, "a Recording"),
        (lambda recording: replace(recording, counts=recording.counts[:5]), DataError, "shape"),
        (lambda recording: replace(recording, u=recording.u[:, None]), DataError, "shape"),
        (_first_is_missing, DataError, "finite"),
        (lambda recording: replace(recording, Ts=0.01), DataError, "the machine's Ts"),
    ],
)
def test_a_machine_that_hands_back_nonsense_is_refused_at_its_first_run(
    shown: Callable[[Recording], Any], error: type[Exception], expected: str
) -> None:
    odd = Odd(shown)
    with pytest.raises(error) as caught:
        commission(odd, **SMALL)
    assert expected in caught.value.expected  # type: ignore[attr-defined]
    assert odd.played == 1


def test_only_machines_are_commissioned() -> None:
    with pytest.raises(SettingError, match="VirtualMachine, a Drive or a Machine"):
        commission("virtual")  # type: ignore[arg-type]


@pytest.mark.parametrize("folder", [5, b"folder", "a\0b", ""])
def test_what_names_no_folder_is_refused(folder: Any) -> None:
    with pytest.raises(SettingError) as caught:
        commission(VirtualMachine(), **SMALL, folder=folder)
    assert (caught.value.name, caught.value.expected) == ("folder", "a folder's name")


def test_a_current_limit_is_not_taken_for_a_swing() -> None:
    """A level that is approached faster than the current allows winds the loop up: it rings."""
    machine = VirtualMachine(parameters={"current_limit": 5.0})
    gains = Gains.standard(Kp=0.0098, Ti=0.0262, Td=0.00275)  # V/RPM, s: a quarter of first gains
    controller = Controller(gains, Ts=0.001, N=10, u_min=-20, u_max=20, filter_samples=8)
    fastest = 460.0 * 20.0 / 0.15  # RPM/s, what gain and time constant promise
    wanted = demands(
        MachineBench(machine), u_max=None, speed=None, references=None, members=2, evaluations=10,
        seed=0, threads=1,
    )  # fmt: skip
    r, settled = held(wanted, fastest, 0.001)
    assert swing_of(run(controller, machine, r), settled) is None
    hurried = np.minimum(r * 6.0, r[-1])
    reached = int(np.argmax(hurried >= r[-1]))
    assert swing_of(run(controller, machine, hurried), reached + 200) is not None


@pytest.mark.parametrize(
    ("counts", "named"), [(40.0, "encoder: one count is 188 RPM"), (1e3, "elastic")]
)
def test_a_swing_that_one_count_makes_is_the_encoder_and_no_shaft(
    counts: float, named: str
) -> None:
    asked = Gains.standard(0.02, 0.1, 0.005, u_unit="V", y_unit="RPM")
    loop = Controller(
        asked, Ts=0.001, u_min=-20.0, u_max=20.0, filter_samples=8, counts_per_rev=counts
    )
    assert named in gains.cause(gains.Swing(0.25, 400.0, 5.0, 0.0), None, loop)
