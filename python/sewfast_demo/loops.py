"""The experiment's machine, recordings, models and closed loops."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from importlib.util import find_spec
from typing import Any, Literal, TypeVar

import numpy as np
from numpy.typing import NDArray

from sewfast import _core, signals
from sewfast.commissioning import Commissioning, commission
from sewfast.commissioning.bench import DriveBench
from sewfast.commissioning.result import run_numbers
from sewfast.control.controller import Controller, SampledController, paper_controller
from sewfast.control.loop import ClosedLoopRun, run
from sewfast.control.machine import RecordedRun, Watch
from sewfast.control.record import record
from sewfast.dataset import Dataset
from sewfast.errors import FitError, LinkError
from sewfast.evidence.figures import figures
from sewfast.gains import Gains
from sewfast.identification import identify
from sewfast.link import VirtualDevice, connect
from sewfast.machine import VirtualMachine
from sewfast.models import LinearOE, Model
from sewfast.plotting import style, svg
from sewfast.recording import Recording
from sewfast.report.artefacts import PLANTS, REFERENCES, SCORED, record_of
from sewfast.report.pictures import CAPTIONS
from sewfast.rules import Fopdt, fit_fopdt, table_1
from sewfast.signals import excitation
from sewfast.speed import Method, floor_of_J
from sewfast.validation import Validation, validate

# --- ExperimentDrive: the virtual machine as a drive behind a port --------------------------------


T = TypeVar("T")


@dataclass(eq=False)
class ExperimentDrive(DriveBench):
    """The virtual machine as a drive, with figures of its link. `machine` is the one behind the
    port (`port` is `pty` or `tcp`), used only for figures that no drive can provide. `samples`
    counts those that the device took and the host received; `seconds` is the time of the runs [s].
    """

    machine: VirtualMachine
    port: str
    samples: int = 0
    seconds: float = 0.0

    def excite(self, u: NDArray[np.float64], name: str) -> Recording:
        """Excite the drive, as a `Machine`."""
        return self.record(u, name)

    def follow(
        self,
        controller: SampledController,
        r: NDArray[np.float64],
        name: str,
        *,
        watch: Watch | None = None,
    ) -> RecordedRun:
        """Run a controller on the drive, as a `Machine`."""
        began = time.perf_counter()
        return self._counted(super().follow(controller, r, name, watch=watch), began)

    def record(self, u: NDArray[np.float64], name: str) -> Recording:
        """Excite the drive from rest; see `sewfast.record`."""
        began = time.perf_counter()
        return self._counted(record(self.drive, u, name=name), began)

    def run(
        self, controller: Controller, reference: str, *, seed: int = 0, volt: float | None = None
    ) -> ClosedLoopRun:
        """Run a controller on the drive, optionally with another volt limit."""
        began = time.perf_counter()
        before = self.drive.limits().volt
        self.drive.set_limits(volt=volt)
        found = run(controller, self.drive, reference, seed=seed)
        self.drive.set_limits(volt=before)
        return self._counted(found, began)

    def _counted(self, found: T, began: float) -> T:
        """The result, after checking that no sample is missing and counting the samples."""
        outcome = self.drive.outcome
        if outcome is None or not outcome.is_complete:
            raise LinkError(f"expected every sample of the run, received: {outcome}; run it again")
        self.samples += outcome.received
        self.seconds += time.perf_counter() - began
        return found

    def numbers(self) -> dict[str, Any]:
        """`link` of `results.json`."""
        return {
            "port": self.port,
            "protocol": self.drive.identity.version,
            "samples": self.samples,
            "missing": 0,
            "times_real_time": self.samples * self.Ts / self.seconds,
        }


@contextmanager
def drive_of(machine: VirtualMachine) -> Iterator[ExperimentDrive]:
    """Serve a machine on a new port and connect to it, with limits at their ceilings."""
    port = _port()
    with (
        VirtualDevice(machine.name, fast=True, endpoint=port) as device,
        connect(device.port) as drive,
    ):
        drive.set_limits()
        yield ExperimentDrive(drive, machine, port)


def _port() -> Literal["pty", "tcp"]:
    """A pty if the system has them and pyserial is installed, else TCP."""
    return "pty" if find_spec("serial") and find_spec("pty") and find_spec("termios") else "tcp"


# --- Models of the experiment, and their predictions ----------------------------------------------


PAPER_RECORDS = ("chirp_lo_hi",)
"""The paper's training data."""
ALL_RECORDS = ("chirp_lo_hi", "saturating", "closed_loop")
"""The default network's training data, which include the drive's limits and a closed loop."""
_SCALE = 1000.0
"""The paper's unit of speed [RPM]."""


def paper(recordings: Mapping[str, Recording], seed: int) -> Model:
    """The paper's network, on differences of counts as in the paper."""
    lo_hi = recordings["chirp_lo_hi"]
    data = lo_hi.dataset(lo_hi.speed("difference"))
    return identify(data, model="neural_oe", preset="paper", seed=seed)


def ideal_cost(machine: VirtualMachine, seed: int) -> float:
    """J of the paper's network in free run on Lo-Hi, on an ideal machine.
    It has exact positions instead of counts, and means of load, inertia and torque over the turn.
    """
    parameters = machine.parameters | {"angle_dependence": 0.0, "quantisation": 0.0}
    ideal = VirtualMachine(parameters=parameters)
    lo_hi = record(ideal, excitation("chirp_lo_hi", seed), name="ideal", method="difference")
    model = identify(lo_hi.dataset(), model="neural_oe", preset="paper", seed=seed)
    return float(model.training["cost"])


def arx_raw(recordings: Mapping[str, Recording]) -> Model:
    """ARX on differences of counts, as in the paper."""
    lo_hi = recordings["chirp_lo_hi"]
    return identify(lo_hi.dataset(lo_hi.speed("difference")), model="arx")


def linear(
    recordings: Mapping[str, Recording], kind: Literal["arx", "oe"], records: tuple[str, ...]
) -> Model:
    """A linear model by least squares or by output error."""
    return identify(_together(recordings, records), model=kind)


def neural(recordings: Mapping[str, Recording], seed: int) -> Model:
    """The default network."""
    return identify(_together(recordings, ALL_RECORDS), model="neural_oe", seed=seed)


def scores(
    models: Mapping[str, Model], recordings: Mapping[str, Recording]
) -> dict[str, dict[str, Validation]]:
    """Scores of every model on every scored record, from rest, against the true speed."""
    data = {r: recordings[record_of(r)].dataset() for r in SCORED}
    return {
        name: {r: validate(m, d, init=0, against="speed_true") for r, d in data.items()}
        for name, m in models.items()
    }


def report_card(model: Model, recording: Recording) -> tuple[dict[str, Any], dict[str, str]]:
    """The card of a model on a recording as JSON values, and its figures as inline SVG."""
    card = model.check(recording.dataset())
    with style():
        drawn = {
            name: svg(figure, f"check-{name}", CAPTIONS[name][1])
            for name, figure in figures(card, page=True).items()
        }
    return {**card.to_json(), "figures": list(drawn)}, drawn


def predictions(
    scored: Mapping[str, Mapping[str, Validation]],
) -> dict[str, dict[str, np.ndarray[tuple[int, ...], np.dtype[np.float64]]]]:
    """For each scored record, the series of every model for the report."""
    columns: dict[str, dict[str, Any]] = {r: {} for r in SCORED}
    for model, by_record in scored.items():
        for name, validation in by_record.items():
            series = validation.experiments[0]
            columns[name][f"{model}_simulation"] = series.simulated
            columns[name][f"{model}_one_step"] = series.one_step
    return columns


def identification_numbers(
    models: Mapping[str, Model],
    scored: Mapping[str, Mapping[str, Validation]],
    cost_floor: float,
) -> dict[str, dict[str, Any]]:
    """`identification` of `results.json`."""
    numbers = {
        name: {r: _score(v) for r, v in scored[name].items()} | _story(model)
        for name, model in models.items()
    }
    training = models["paper"].training
    on_training = scored["paper"]["chirp_lo_hi"]
    numbers["paper"] |= {
        "cost": training["cost"],
        "cost_floor": cost_floor,
        "cost_true": _cost(on_training.simulation.rmse),
        "cost_one_step": _cost(on_training.one_step.rmse),
        "iterations": training["iterations"],
    }
    return numbers


def _together(recordings: Mapping[str, Recording], records: tuple[str, ...]) -> Dataset:
    return Dataset.concat([recordings[r].dataset() for r in records])


def _score(validation: Validation) -> dict[str, dict[str, float]]:
    horizons = {"simulation": validation.simulation, "one_step": validation.one_step}
    return {
        horizon: {"rmse_rpm": s.rmse, "fit_percent": s.fit_percent}
        for horizon, s in horizons.items()
    }


def _story(model: Model) -> dict[str, Any]:
    return {
        "trained_on": [d["name"] for d in model.training["data"]],
        "seconds": model.training["seconds"],
        "termination": model.training["termination"],
    }


def _cost(rmse: float) -> float:
    """J of an error [RPM] in the paper's scaled units (paper Eq. 4)."""
    return (rmse / _SCALE) ** 2 / 2.0


# --- Recordings of the experiment -----------------------------------------------------------------


EXCITATIONS = ("step", "chirp_lo_hi", "chirp_hi_lo", "random", "saturating", "saturating_2")
FILTER_SAMPLES = 8
"""Moving average of the feedback: one count in a sample is 38 RPM, in eight it is 5."""
LIMIT = 20.0
"""Largest command in either direction [V]."""
DERIVATIVE_FILTER = 10.0
_METHODS: tuple[Method, ...] = ("difference", "savgol", "kalman")


def open_loop(drive: ExperimentDrive, seed: int) -> dict[str, Recording]:
    """Every excitation on the drive, each from rest."""
    return {name: drive.record(signals.excitation(name, seed), name) for name in EXCITATIONS}


def first_order(step: Recording) -> Fopdt:
    """Gain, time constant and dead time from the step response (paper Eq. 10-11)."""
    return fit_fopdt(step.u, step.y, Ts=step.Ts)


def coarse_controller(fopdt: Fopdt, *, Ts: float, counts_per_rev: float) -> Controller:
    """Gains by Table 1, nearest row; the delay of the feedback's filter counts as dead time."""
    delayed = replace(fopdt, L=fopdt.L + (FILTER_SAMPLES - 1) / 2 * Ts)
    rule = table_1(delayed, outside="nearest")
    return Controller(
        gains=rule.gains,
        Ts=Ts,
        alpha=rule.alpha,
        beta=rule.beta,
        N=DERIVATIVE_FILTER,
        u_min=-LIMIT,
        u_max=LIMIT,
        filter_samples=FILTER_SAMPLES,
        counts_per_rev=counts_per_rev,
        notes="Table 1 on the recorded step response",
    )


def closed_loop(drive: ExperimentDrive, controller: Controller) -> Recording:
    """A recording of a closed loop that follows trapezoids with the first gains.
    The machine is deterministic: the command is replayed to record its counts.
    """
    return drive.record(drive.run(controller, "trapezoids").u, "closed_loop")


def speed_numbers(recording: Recording) -> dict[str, dict[str, float]]:
    """Error and floor of J of each estimate of the speed, against the true one."""
    true = recording.speed_true
    assert true is not None, "of a virtual machine"
    estimates = {m: recording.speed(m) for m in _METHODS}
    return {
        method: {
            "rmse_rpm": float(np.sqrt(np.mean((y - true) ** 2))),
            "cost_floor": floor_of_J(y, true),
        }
        for method, y in estimates.items()
    }


# --- Closed loops of the experiment: the commissioned controller, and the paper's gains -----------


Runs = dict[tuple[str, str], ClosedLoopRun]

PRACTICE = ("trapezoid", "trapezoids", "random")
"""References for tuning, half as long as those for the verification."""
PAPER_LIMIT = 10.0
"""Limit of the command with the paper's gains [V]."""


def commissioned(drive: ExperimentDrive, seed: int) -> Commissioning:
    """The drive, commissioned for the experiment's references."""
    return commission(drive, references=REFERENCES, practice=PRACTICE, seed=seed)


def commissioned_runs(found: Commissioning) -> Runs:
    """The runs of every reference: predicted by the ensemble, and measured."""
    runs: Runs = {}
    for c in found.comparisons:
        runs[c.reference, "model"] = c.predicted
        if c.measured is not None:
            runs[c.reference, "machine"] = c.measured
    return runs


def paper_runs(drive: ExperimentDrive) -> Runs:
    """The paper's gains on the plant of its Eq. 8 with ideal feedback, and on the machine."""
    gains = paper_controller()
    return {
        ("paper_gains", "eq8"): run(replace(gains, counts_per_rev=None), eq8(), "trapezoid"),
        ("paper_gains", "machine"): drive.run(gains, "trapezoid", volt=PAPER_LIMIT),
    }


def readings() -> dict[str, dict[str, float | None]]:
    """The paper's gains on the plant of its Eq. 8, for each unit of the error and form of gains."""
    paper = replace(paper_controller(), counts_per_rev=None)
    numbers = (paper.gains.Kp, paper.gains.Ki, paper.gains.Kd)
    units = {"rpm": 1.0, "cps": 60.0 / (1572.0 * paper.Ts), "krpm": 1000.0}
    found = {}
    for unit, size in units.items():
        Kp, Ki, Kd = (gain / size for gain in numbers)
        forms = {
            "per_sample": Gains.per_sample(Kp, Ki, Kd, Ts=paper.Ts),
            "continuous": Gains.parallel(Kp, Ki, Kd),
        }
        for form, gains in forms.items():
            found[f"{form}_{unit}"] = _tried(replace(paper, gains=gains))
    return found


def _tried(controller: Controller) -> dict[str, float | None]:
    names = ("rmse_rpm", "rise_time_ms", "overshoot_percent")
    try:
        numbers = run_numbers(run(controller, eq8(), "trapezoid"))
    except FitError:
        return dict.fromkeys(names)
    return {name: numbers[name] for name in names}


def eq8() -> LinearOE:
    """The plant of the paper's Eq. 8, as printed."""
    core = _core.LinearModel(np.array([-1.87, 0.8705]), np.array([[0.1228, 0.1224]]), 1, 0.0)
    return LinearOE(core, 0.001, ("u",), "y", ("V",), "RPM")


def control_numbers(runs: Mapping[tuple[str, str], ClosedLoopRun]) -> dict[str, dict[str, Any]]:
    """`control` of `results.json`."""
    return {r: _pair({p: runs[r, p] for p in PLANTS}) for r in REFERENCES}


def paper_numbers(runs: Mapping[tuple[str, str], ClosedLoopRun]) -> dict[str, dict[str, Any]]:
    """`paper_gains` of `results.json`."""
    return {plant: run_numbers(r) for (_, plant), r in runs.items()}


def _pair(runs: Mapping[str, ClosedLoopRun]) -> dict[str, Any]:
    apart = runs["model"].y - runs["machine"].y
    return {
        **{plant: run_numbers(r) for plant, r in runs.items()},
        "model_vs_machine_rmse_rpm": float(np.sqrt(np.mean(apart**2))),
        "reference_rise_time_ms": runs["machine"].metrics()["reference_rise_time_ms"],
    }
