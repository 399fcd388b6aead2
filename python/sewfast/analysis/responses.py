"""`Responses`: steps of reference and disturbance on every plant; runs under load."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, TypeVar

import numpy as np
from numpy.typing import ArrayLike

from ..control.controller import Controller
from ..control.loop import (
    ClosedLoopRun,
    Plant,
    check_fits,
    common_rest,
    reference_samples,
    run,
)
from ..dataset import FloatArray
from ..errors import DataError, SettingError
from ..gains import real, vector
from ..machine import VirtualMachine
from .changes import Change
from .points import PlantPoint

# --- Arguments of analyse, checked: numbers, kinds, changes ---------------------------------------


T = TypeVar("T")


def finite(name: str, value: Any) -> float:
    """The value as a finite float, or a `SettingError` with its name."""
    number = real(name, value)
    if not math.isfinite(number):
        raise SettingError(f"expected a finite number for {name}, got {value!r}")
    return number


def finite_each(name: str, values: Any) -> list[float]:
    """The values as finite floats, at least one."""
    try:
        given = [] if isinstance(values, str) else list(values)
    except TypeError:
        given = []
    if not given:
        raise SettingError(f"expected a list of numbers for {name}, got {values!r}")
    return [finite(name, value) for value in given]


def required(name: str, value: Any, kind: type[T]) -> T:
    """The value if it is of that kind; the kind's defaults for None."""
    if not (value is None or isinstance(value, kind)):
        raise SettingError(
            f"expected {kind.__name__} for {name}, got {type(value).__name__}; for example "
            f"{name}={kind.__name__}()"
        )
    return kind() if value is None else value


def each_change(changes: Any) -> Sequence[Change] | None:
    """The changes, or None for the default ones."""
    if changes is None:
        return None
    try:
        given = list(changes)
    except TypeError:
        given = [changes]
    for one in given:
        if not isinstance(one, Change):
            raise SettingError(
                f"expected a list of changes, got {one!r} in it; for example "
                "changes=[sewfast.analysis.changes.gain(0.5)]"
            )
    return given


# --- Runs with a load on the virtual machine's shaft ----------------------------------------------


def run_under_load(
    controller: Controller,
    machine: VirtualMachine,
    reference: str | ArrayLike,
    load: ArrayLike,
    *,
    feedforward: ArrayLike | None = None,
    seed: int = 0,
    name: str | None = None,
) -> ClosedLoopRun:
    """Run a controller on a virtual machine with a load on its shaft, from rest.

    Parameters
    ----------
    controller : Controller
    machine : VirtualMachine
        The machine, which is not changed.
    reference : str or array, shape (N,)
        As for `sewfast.run`.
    load : array, shape (N,)
        Load torque during each sample [N m], in addition to the machine's own; it brakes if it has
        the sign of the speed.
    feedforward : array, shape (N,), optional
        Added to the command before its limits [u].

    Raises
    ------
    SettingError, DataError
        As `sewfast.run`, and for a load of another length than the reference.
    """
    check_fits(controller, machine)
    r = reference_samples(reference, controller, seed)
    torque = _along("load", load, len(r))
    ahead = _along("feedforward", np.zeros(len(r)) if feedforward is None else feedforward, len(r))
    columns = _columns(controller, VirtualMachine(parameters=machine.parameters), r, torque, ahead)
    t = np.arange(len(r), dtype=np.float64) * controller.Ts
    title = name or (reference if isinstance(reference, str) else "reference")
    return ClosedLoopRun(
        t, r, *columns, controller, f"{machine.name} under load", title
    )  # fmt: skip


def _along(name: str, values: ArrayLike, n: int) -> FloatArray:
    found = vector(name, values)
    if len(found) != n or not np.isfinite(found).all():
        raise DataError(
            f"expected a finite {name} for each of the {n} samples of the reference, got "
            f"{len(found)}; give one value per sample"
        )
    return found


def _columns(
    controller: Controller, machine: VirtualMachine, r: FloatArray, torque: FloatArray,
    ahead: FloatArray,
) -> tuple[FloatArray, FloatArray, FloatArray]:  # fmt: skip
    core = controller.core()
    per_speed = machine.counts_per_rev / 60.0 * controller.Ts
    u, y, feedback = (np.empty(len(r)) for _ in range(3))
    counts, speed = machine.counts, machine.speed_rpm
    before, held = counts, 0.0
    for k, wanted in enumerate(controller.early(r).tolist()):
        u[k] = core.step(wanted, (counts - before) / per_speed, float(ahead[k]))
        y[k], feedback[k], before = speed, core.filtered, counts
        if torque[k] != held:
            held = float(torque[k])
            machine.set_load(held)
        counts, speed = machine.step(u[k])
    return u, y, feedback


def torque_of(machine: VirtualMachine, volt: float) -> float:
    """The load torque that takes a steady command of `volt` to balance [N m]."""
    p = machine.parameters
    return volt * p["amplifier_gain"] * p["motor_constant"] / p["resistance"]


# --- Responses: steps of the reference and of a disturbance, on every plant -----------------------


SETTLED = 0.02
"""Part of the step within which a response is settled, unless the output itself varies more."""
RECOVERED = 0.01
"""Part of the disturbance's effect without control within which it is rejected, likewise."""


@dataclass(frozen=True, eq=False)
class Responses:
    """One kind of step on every plant, at one operating point.

    Attributes
    ----------
    kind : str
        `reference` or `disturbance`.
    t : array, shape (N,)
        Time since the step [s]; negative before it.
    r : array, shape (N,)
        Reference [y].
    y, u : array, shape (plants, N)
        True outputs [y] and commands [u].
    plants : tuple of str
    level : float
        The output before the step [y].
    size : float
        Size of the reference step, or effect of the disturbance without control [y].
    disturbance : float
        Step at the plant's input [u]; 0 for a reference step.
    y_unit, u_unit : str
    """

    kind: str
    t: FloatArray
    r: FloatArray
    y: FloatArray
    u: FloatArray
    plants: tuple[str, ...]
    level: float
    size: float
    disturbance: float
    y_unit: str
    u_unit: str

    @property
    def band(self) -> tuple[FloatArray, FloatArray]:
        """The smallest and the largest output of all plants, sample by sample."""
        return self.y.min(axis=0), self.y.max(axis=0)

    def metrics(self) -> tuple[dict[str, float | None], ...]:
        """Metrics of each plant.

        Returns
        -------
        tuple of dict
            For a reference step `rise_ms` (10 to 90 %), `overshoot_percent`, `settling_ms` (within
            `SETTLED` of the step from then on); for a disturbance `peak` [y], `peak_ms`,
            `recovery_ms` (within `RECOVERED` of `size` from then on). None if that never happens.
            Variations before the step, such as those of a load over the turn, are allowed for.
        """
        of = _reference_metrics if self.kind == "reference" else _disturbance_metrics
        return tuple(of(self, y) for y in self.y)

    def to_json(self) -> dict[str, Any]:
        """The metrics as JSON values; the curves are in the figures."""
        return {
            "kind": self.kind,
            "level": self.level,
            "size": self.size,
            "disturbance": self.disturbance,
            "plants": [
                {"plant": name, **m} for name, m in zip(self.plants, self.metrics(), strict=True)
            ],
        }


def _reference_metrics(of: Responses, y: FloatArray) -> dict[str, float | None]:
    after = of.t >= 0.0
    t, share = of.t[after], (y[after] - of.level) / of.size
    # a controller with feedforward begins before the step
    early = ~_quiet(of)
    # from 10 to 90 %
    low, high = (_first(of.t[early], (y[early] - of.level) / of.size >= s) for s in (0.1, 0.9))
    rise = None if low is None or high is None else 1e3 * (high - low)
    return {
        "rise_ms": rise,
        "overshoot_percent": 100.0 * max(float(share.max()) - 1.0, 0.0),
        "settling_ms": _since(t, np.abs(share - 1.0) <= max(SETTLED, _own(of, y) / abs(of.size))),
    }


def _disturbance_metrics(of: Responses, y: FloatArray) -> dict[str, float | None]:
    after = of.t >= 0.0
    t, off = of.t[after], y[after] - of.level
    peak = int(np.argmax(np.abs(off)))
    return {
        "peak": float(off[peak]),
        "peak_ms": 1e3 * float(t[peak]),
        "recovery_ms": _since(t, np.abs(off) <= max(RECOVERED * abs(of.size), _own(of, y))),
    }


def _own(of: Responses, y: FloatArray) -> float:
    """Largest deviation of the output from its mean before the step, plus a quarter."""
    before = y[_quiet(of)]
    return 1.25 * float(np.abs(before - before.mean()).max(initial=0.0))


def _quiet(of: Responses) -> Any:
    """The first half of the time before the step, in which nothing looks ahead to it."""
    return of.t < 0.5 * min(float(of.t[0]), 0.0)


def _first(t: FloatArray, holds: Any) -> float | None:
    return float(t[int(np.argmax(holds))]) if holds.any() else None


def _since(t: FloatArray, holds: Any) -> float | None:
    """Time from which on a condition holds [ms]; None if it does not hold at the end."""
    outside = np.flatnonzero(~holds)
    if len(outside) == 0:
        return 0.0
    last = int(outside[-1])
    return None if last + 1 == len(t) else 1e3 * float(t[last + 1])


# --- simulation -----------------------------------------------------------------------------------


@dataclass(frozen=True)
class Steps:
    """The steps: their operating point, sizes and duration. `level` is the output before the step
    and `step` the reference's step [y]; `disturbance` acts at the plant's input [u]. `samples`
    follow the step; as many lead to the operating point, half of which are shown.
    """

    level: float
    step: float
    disturbance: float
    samples: int


def responses(
    controller: Controller, plants: Sequence[Plant], names: Sequence[str], steps: Steps,
    noise: float | None = 0.0,
) -> tuple[Responses, Responses]:  # fmt: skip
    """Reference step and disturbance step with encoder, filters, limits; `noise` as for `run`."""
    n = steps.samples
    lead = 3 * n
    ramp = np.interp(np.arange(lead), [0, n], [common_rest(plants).y, steps.level])
    r = np.concatenate([ramp, np.full(n, steps.level)])
    raised = np.concatenate([ramp, np.full(n, steps.level + steps.step)])
    d = np.where(np.arange(len(r)) < lead, 0.0, steps.disturbance)
    tracked = [run(controller, p, raised, noise=noise, name="reference step") for p in plants]
    upset = [_disturbed(controller, p, r, d, noise) for p in plants]
    first = lead - n // 2
    made = [_cut(raised, tracked, lead, first, steps, names, "reference")]
    made.append(_cut(r, upset, lead, first, steps, names, "disturbance"))
    return made[0], replace(made[1], disturbance=steps.disturbance)


def _disturbed(
    controller: Controller, plant: Plant, r: FloatArray, d: FloatArray, noise: float | None
) -> ClosedLoopRun:
    """Run with a disturbance; on a machine it is a load torque of opposite sign."""
    if isinstance(plant, VirtualMachine):
        load = torque_of(plant, 1.0) * -d
        return run_under_load(controller, plant, r, load, name="disturbance step")
    return run(controller, plant, r, disturbance=d, noise=noise, name="disturbance step")


def _cut(
    r: FloatArray, runs: Sequence[ClosedLoopRun], lead: int, first: int, steps: Steps,
    names: Sequence[str], kind: str,
) -> Responses:  # fmt: skip
    controller = runs[0].controller
    t = (np.arange(first, len(r), dtype=np.float64) - lead) * runs[0].Ts
    return Responses(
        kind, t, r[first:], np.array([x.y[first:] for x in runs]),
        np.array([x.u[first:] for x in runs]), tuple(names), steps.level, steps.step, 0.0,
        controller.y_unit, controller.u_unit,
    )  # fmt: skip


def default_steps(
    controller: Controller,
    points: Sequence[PlantPoint],
    slowest: float,
    *,
    level: float | None,
    step: float | None,
    disturbance: float | None,
    seconds: float | None,
    span: float | None = None,
) -> Steps:
    """Default steps: a twentieth of the recorded span, and a disturbance of the same effect, on a
    plant that does not settle by their end (an integrator) of the same effect until then.
    `points` are the plants at the operating point, and `slowest` is the time constant of the
    slowest closed-loop pole [s]. `span` reaches from rest to the farther end of the recorded output
    [y]; without it the step is a tenth of the level.
    """
    given = {"level": level, "step": step, "disturbance": disturbance, "seconds": seconds}
    checked = {name: finite(name, v) for name, v in given.items() if v is not None}
    if checked.get("step", 1.0) == 0.0 or checked.get("disturbance", 1.0) == 0.0:
        raise SettingError("expected a step and a disturbance other than 0, got 0; leave it out")
    if checked.get("seconds", 1.0) <= 0.0:
        raise SettingError(f"expected seconds above 0, got {seconds:g}")
    level = points[0].y if level is None else level
    samples = round((5.0 * slowest if seconds is None else seconds) / controller.Ts)
    samples = min(max(samples, 200), 20_000)
    gain = float(np.median([_effect(p, samples) for p in points]))
    half = 0.5 * (controller.u_max - controller.u_min)
    if step is None:
        small = 0.01 * half * gain if math.isfinite(half * gain) else 1.0
        step = 0.05 * span if span else 0.1 * abs(level) if level else small
    if disturbance is None:
        disturbance = -step / gain if gain else -0.05 * (half if math.isfinite(half) else 1.0)
    return Steps(float(level), float(step), float(disturbance), samples)


def _effect(point: PlantPoint, samples: int) -> float:
    """What a unit of input does to the output of a plant without control: its gain, or how far it
    gets until the end if a pole is nearer to 1 than the end can tell [y/u].
    """
    slowest = max(np.abs(np.linalg.eigvals(point.A)), default=0.0)
    settles = slowest == 0.0 or abs(samples * math.log(slowest)) > 1.0
    if settles and math.isfinite(point.gain):
        return abs(point.gain)
    n = len(point.A)
    held = np.block([[point.A, point.B], [np.zeros((1, n)), np.ones((1, 1))]])
    x = np.linalg.matrix_power(held, samples)[:n, -1]
    return abs(float((point.C @ x + point.D[:, 0])[0]))
