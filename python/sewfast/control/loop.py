"""`run`: a controller in closed loop with a model or a machine."""

from __future__ import annotations

import itertools
import math
import os
import threading
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Protocol, TypeAlias

import numpy as np
from numpy.typing import ArrayLike

from .. import _core, signals
from ..arrays import FloatArray, bridged
from ..dataset import Dataset
from ..errors import DataError, FitError, SettingError, SewfastError
from ..evidence.region import region_runs
from ..gains import Gains, real, vector
from ..machine import VirtualMachine
from ..models import Ensemble, Model
from ..models.rest import Rest
from ..tables import Table, percent, significant
from ..units import duration, spelled
from .controller import Controller, SampledController, pid_of
from .defaults import default_references, drive_references
from .move import MoveTable, table_of

if TYPE_CHECKING:
    from ..live import ViewKind
    from .machine import Machine

Plant: TypeAlias = Model | VirtualMachine

SMOOTHING = 0.005
"""Centred moving average of the true output before rise time and overshoot are computed [s]."""


@dataclass(frozen=True, eq=False)
class ClosedLoopRun:
    """A run of a controller on a plant; entry k is measured and computed at `t[k]`.

    Attributes
    ----------
    t : array, shape (N,)
        Time [s].
    r, y, feedback : array, shape (N,)
        Reference, true output, measured output after encoder and feedback filter [y].
    u : array, shape (N,)
        Command after its limits [u].
    controller : Controller
    plant, reference : str
        Their names.
    """

    t: FloatArray
    r: FloatArray
    u: FloatArray
    y: FloatArray
    feedback: FloatArray
    controller: SampledController
    plant: str
    reference: str

    @property
    def Ts(self) -> float:
        """Sample time [s]."""
        return self.controller.Ts

    @property
    def units(self) -> dict[str, str]:
        """The unit of each column by name."""
        u, y = self.controller.u_unit, self.controller.y_unit
        return {"t": "s", "r": y, "u": u, "y": y, "feedback": y}

    def columns(self) -> dict[str, FloatArray]:
        """t, r, u, y, feedback by name, for a file or a plot."""
        return {name: getattr(self, name) for name in self.units}

    def metrics(self) -> dict[str, float | None]:
        """Tracking errors and the effort behind them.

        Returns
        -------
        dict
            `rmse` and `max_abs` of r - y [y]; `rise_time_ms`, `reference_rise_time_ms` (10 to 90 %
            of the first edge) and `overshoot_percent`, None if the reference is no step or
            trapezoid or the level is not reached; `u_rms`, `du_rms` (change from sample to sample)
            [u]; `saturated`, the share of samples at a limit. Samples that a link lost (NaN) do not
            count; with any of them there is no rise time and no overshoot.
        """
        error = self.r - self.y
        error = error[np.isfinite(error)]
        u = self.u[np.isfinite(self.u)]
        return {
            "rmse": float(np.sqrt(np.mean(error**2))) if len(error) else None,
            "max_abs": float(np.max(np.abs(error))) if len(error) else None,
            **self._step_metrics(),
            **_core.effort(u, u_min=self.controller.u_min, u_max=self.controller.u_max),
        }

    def _step_metrics(self) -> dict[str, float | None]:
        names = ("rise_time_ms", "reference_rise_time_ms", "overshoot_percent")
        if not np.all(np.isfinite(self.y - self.r)):
            return dict.fromkeys(names)
        try:
            found = _core.step_metrics(self.y, self.r, Ts=self.Ts, smoothing=SMOOTHING)
        except DataError:
            return dict.fromkeys(names)
        return {name: None if math.isnan(value) else value for name, value in found.items()}

    def plot(
        self,
        ax: Any = None,
        *,
        others: Sequence[ClosedLoopRun] = (),
        file: str | os.PathLike[str] | None = None,
    ) -> Any:
        """Draw output and reference, the error and the command in three panels.

        Parameters
        ----------
        ax, file
            As for `Drawing.plot`. One axes shows the output; further axes show error and command.
        others : sequence of ClosedLoopRun
            Other runs over the same reference, such as one predicted by a model.
        """
        from ..plotting import Trace, loop_drawing

        others = [others] if isinstance(others, ClosedLoopRun) else list(others)
        looks = ("machine", "model", "oe", "arx_raw", "arx") if others else ("measured",)
        traces = [
            Trace.of(run.columns(), look, run.plant)
            for run, look in zip((self, *others), itertools.cycle(looks), strict=False)
        ]
        limits = (self.controller.u_min, self.controller.u_max)
        # draw the others over this one, whose line is wider
        return loop_drawing(traces[::-1], self.units["y"], self.units["u"], limits).plot(ax, file)

    def _repr_html_(self) -> str:
        return run_html(
            self, f"{self.reference} on {self.plant}, {duration(len(self.t) * self.Ts)}"
        )

    def __str__(self) -> str:
        unit = self.units | {n: unit or n for n, unit in self.units.items() if n in "uy"}
        metrics = self.metrics()
        lines = [f"{self.reference} on {self.plant}, {duration(len(self.t) * self.Ts)}"]
        if metrics["rmse"] is None:
            return f"{lines[0]}; no sample came"
        lines.append(
            f"  error     {metrics['rmse']:.4g} {unit['y']} rms, {metrics['max_abs']:.4g} at most"
        )
        if metrics["rise_time_ms"] is not None:
            lines.append(
                f"  first edge {_rise(metrics['rise_time_ms'])} from 10 to 90 % (reference "
                f"{_rise(metrics['reference_rise_time_ms'])}), "
                f"overshoot {metrics['overshoot_percent']:.2f} %"
            )
        saturated = 100.0 * (metrics["saturated"] or 0.0)
        lines.append(
            f"  command   {metrics['u_rms']:.4g} {unit['u']} rms, {metrics['du_rms']:.4g} from "
            f"sample to sample, at a limit {saturated:.1f} % of the time"
        )
        return "\n".join(lines)


LEAST_HELD, PART_HELD = 20, 0.1
"""A level is held for so many samples at the end of a reference, for such a part elsewhere."""


def held_levels(r: FloatArray) -> list[tuple[float, slice]]:
    """Levels that a reference holds for a tenth of its length or at its end, with the last quarter
    of each hold.
    """
    edges = np.flatnonzero(np.diff(r, prepend=np.nan, append=np.nan) != 0.0)
    pairs = zip(edges[:-1].tolist(), edges[1:].tolist(), strict=True)
    long = [
        (a, b)
        for a, b in pairs
        if b - a >= (LEAST_HELD if b == len(r) else max(2.0, PART_HELD * len(r)))
    ]
    return [(float(r[a]), slice(b - max(1, (b - a) // 4), b)) for a, b in long]


def missed_levels(found: ClosedLoopRun, within: float) -> list[tuple[float, float, slice]]:
    """Held levels that a run does not meet within a distance [y] in the mean over the last quarter
    of the hold: the mean, the level, and that quarter.
    """
    met = [(float(np.nanmean(found.y[hold])), level, hold) for level, hold in held_levels(found.r)]
    return [(mean, level, hold) for mean, level, hold in met if not abs(mean - level) <= within]


def outside_region(found: ClosedLoopRun, model: Model | None) -> tuple[float, float]:
    """How far a run leaves the region that a model was trained in: the share of samples outside,
    and the largest distance; NaN without a known region.
    """
    if model is None or not len(found.u):
        return math.nan, math.nan
    check_fits(found.controller, model)
    # the response to the command; of an unstable model as long as it stays with the output
    data = Dataset.from_arrays(
        bridged(found.u), bridged(found.y), model.Ts,
        input_names=model.input_names, input_units=model.input_units,
        output_name=model.output_name, output_unit=model.output_unit, name=found.reference,
    )  # fmt: skip
    try:
        place = region_runs(model, data, init=0)
    except SewfastError:
        return 1.0, math.inf
    if place is None:
        return math.nan, math.nan
    distances = place.distances[0]
    return float(np.mean(distances > 1.0)), float(distances.max())


def _rise(ms: float | None) -> str:
    if ms is None:
        return "unknown"
    return f"{ms:.1f} ms" if ms < 1e3 else duration(1e-3 * ms)


class HasMetrics(Protocol):
    """A closed-loop run of any kind."""

    @property
    def units(self) -> dict[str, str]: ...
    def metrics(self) -> dict[str, float | None]: ...


def run_html(found: HasMetrics, caption: str) -> str:
    """A run as a table for a notebook."""
    m, u, y = found.metrics(), found.units["u"], found.units["y"]
    saturated = m["saturated"]

    def size(name: str, unit: str) -> str:
        return f"{significant(m[name])} {unit}".rstrip()

    rows = [("tracking error", f"{size('rmse', y)} rms, {size('max_abs', y)} at most")]
    if m["rise_time_ms"] is not None:
        rise = f"{_rise(m['rise_time_ms'])} (reference {_rise(m['reference_rise_time_ms'])})"
        rows.append(("10 to 90 % of the first edge", rise))
        rows.append(("overshoot", percent(m["overshoot_percent"])))
    rows.append(("command", f"{size('u_rms', u)} rms"))
    rows.append(("change from sample to sample", f"{size('du_rms', u)} rms"))
    rows.append(("at a limit", percent(None if saturated is None else 100.0 * saturated)))
    return Table(caption, (), tuple(rows)).to_html()


def run(
    controller: SampledController,
    on: Plant | Machine,
    reference: str | ArrayLike | None = None,
    *,
    table: MoveTable | None = None,
    feedforward: ArrayLike | None = None,
    disturbance: ArrayLike | None = None,
    noise: float | None = None,
    seed: int = 0,
    name: str | None = None,
    file: str | os.PathLike[str] | None = None,
    live: str | ViewKind = "none",
    overwrite: bool = False,
    cancel: threading.Event | None = None,
) -> ClosedLoopRun:
    """Run a controller on a model, on a virtual machine or on a drive, from rest.

    Order at a sample: measure, filter, control, limit, apply. A machine or drive is measured by
    its own encoder, a model by one of `controller.counts_per_rev`.

    Parameters
    ----------
    controller : Controller or StateFeedback
    on : Model, VirtualMachine, Drive or another Machine
        The plant. A model needs one input. Neither a model nor a virtual machine is changed. A
        drive (`sewfast.link`) runs the controller itself, in single precision; its limits must have
        been set. For your own `sewfast.Machine`, its `follow` is called.
    reference : str or array, shape (N,), optional
        Name of a reference (`sewfast.signals`) or its samples at the controller's sample time [y].
        On a model that is not in RPM at 1 ms a name is the same shape over the model's recorded
        range. By default a trapezoid that suits the plant; a drive needs an explicit one.
    table : MoveTable, optional
        In place of a reference, the table of a known move for this controller: its setpoint is
        played, and the run is compared with its reference.
    feedforward : array, shape (N,), optional
        A command added before the limits [u]; not for a drive.
    disturbance : array, shape (N,), optional
        For a model: a command added after the limiter, unknown to the controller [u]. A virtual
        machine has `set_load`.
    noise : float, optional
        For a model without an encoder in the loop: standard deviation of white noise in what is
        measured, which `y` does not contain [y]. By default that of the model's record
        (`Model.noise`).
    seed : int
        Of the noise and of a named random reference.
    name : str, optional
        Name of the reference in messages and reports.
    file : path, optional
        For a drive: MCAP recording to write while it runs.
    live : str
        For a drive: see `sewfast.live.open_view`.
    overwrite : bool
        Whether `file` may replace a recording of a drive, which cannot be repeated exactly.
    cancel : threading.Event, optional
        For a drive: set it in another thread to end the run as Ctrl-C does.

    Returns
    -------
    ClosedLoopRun
        For a drive, `y` is the speed estimated from its counts, or the true speed of a virtual one.

    Raises
    ------
    SettingError
        If sample times or units of controller, plant and reference disagree, or for signals that
        the plant cannot take.
    DataError
        For signals that are empty, not finite or of different lengths.
    FitError
        If the loop diverges.
    LinkError
        If the port or the drive failed or tripped; the motor is stopped, `recording` holds the
        samples so far.
    Interrupted
        On Ctrl-C or `cancel` with a drive; the motor is stopped, `best` is the run so far.
    """
    require_controller(controller, on, "run(controller, plant, reference)", SampledController)
    if controller.LOOP != "speed":
        raise SettingError(
            name="controller", expected="a controller of the output", received="one of positions",
            remedy="run it by stop_at (--stop-at) or follow_positions (--positions), or run its "
            "speed loop (controller.speed)",
        )  # fmt: skip
    if table is not None:
        played = _setpoint(table, controller, reference)
        found = run(
            controller, on, played, feedforward=feedforward, disturbance=disturbance, noise=noise,
            seed=seed, name=name or table.name, file=file, live=live, overwrite=overwrite,
            cancel=cancel,
        )  # fmt: skip
        return replace(found, r=table.reference[: len(found.t)].copy())
    if reference is None:
        reference, name = usual_reference(on, controller), name or "trapezoid"
    r = reference_samples(reference, controller, seed, plant=on)
    title = name or (reference if isinstance(reference, str) else "reference")
    extra = _given(on, feedforward, disturbance)
    if noise is not None:
        noise = _noise(on, noise)
    if not isinstance(on, (Model, VirtualMachine)):
        return _on_machine(
            controller, on, r, title, cancel, file=file, live=live, overwrite=overwrite
        )
    check_fits(controller, on)
    rest = common_rest([on])
    record = _core.closed_loop(
        single_core(on, rest),
        controller.about(rest).core(),
        r - rest.y,
        counts_per_unit=controller.counts_per_unit,
        feedforward=extra.get("feedforward"),
        disturbance=extra.get("disturbance"),
        noise=noise_in_loop(controller, on) if noise is None else noise,
        seed=seed,
    )
    return ClosedLoopRun(
        t=np.arange(len(r), dtype=np.float64) * controller.Ts,
        r=r,
        **_from(rest, record),
        controller=controller,
        plant=plant_name(on),
        reference=title,
    )


def _setpoint(table: MoveTable, controller: SampledController, reference: Any) -> FloatArray:
    """What the controller gets in place of the reference of a table."""
    if reference is not None:
        raise SettingError(
            name="table", expected="no other reference beside it", received="one",
            remedy="leave one of them out",
        )  # fmt: skip
    table_of(table).require(controller)
    return table.setpoint


def usual_reference(on: Any, controller: SampledController) -> str | FloatArray:
    """A trapezoid for a model or a virtual machine; a real motor needs an explicit reference."""
    if not isinstance(on, (Model, VirtualMachine)):
        raise SettingError(
            name="reference", expected="one for a drive", received="none",
            remedy="give its name or its samples",
        )  # fmt: skip
    (usual,) = default_references(on, controller, ("trapezoid",))
    return usual


def _given(
    on: Any, feedforward: ArrayLike | None, disturbance: ArrayLike | None
) -> dict[str, FloatArray]:
    """The given signals other than the reference."""
    given = {"feedforward": feedforward, "disturbance": disturbance}
    signals = {name: vector(name, v) for name, v in given.items() if v is not None}
    if "disturbance" in signals and not isinstance(on, Model):
        raise SettingError(
            name="disturbance", expected="one on a model only", received="one on a machine",
            remedy="load a virtual machine by its set_load",
        )  # fmt: skip
    if signals and not isinstance(on, (Model, VirtualMachine)):
        raise SettingError(
            name="feedforward", expected="none on a drive, whose device takes a reference only",
            received="one", remedy="run it on a model or a virtual machine",
        )  # fmt: skip
    return signals


def noise_in_loop(controller: SampledController, plant: Plant) -> float:
    """Standard deviation of the noise that a loop measures [y]: with an encoder there is none."""
    if not isinstance(plant, Model) or controller.counts_per_unit > 0.0:
        return 0.0
    return plant.noise


def _noise(on: Any, noise: float) -> float:
    deviation = real("noise", noise)
    if not 0.0 <= deviation < math.inf:
        raise SettingError(
            name="noise", expected="a standard deviation of 0 or more", received=f"{noise!r}",
            remedy="leave it out for that of the record",
        )  # fmt: skip
    if deviation > 0.0 and not isinstance(on, Model):
        raise SettingError(
            name="noise", expected="none on a machine, which has its own", received=f"{noise!r}",
            remedy="leave it out",
        )  # fmt: skip
    return deviation


def require_controller(
    controller: Any, plant: Any, call: str, kind: type[SampledController] = Controller
) -> None:
    """Raise `SettingError` for anything but a controller of this kind, such as a swapped plant."""
    if isinstance(controller, kind):
        return
    if isinstance(controller, SampledController):
        pid_of(controller, call)
    swapped = " and the Controller in another place" * isinstance(plant, SampledController)
    raise SettingError(
        name="controller", expected="a Controller",
        received=f"{type(controller).__name__}{swapped}", remedy=f"the order is {call}",
    )  # fmt: skip


def _on_machine(
    controller: SampledController,
    on: Machine,
    r: FloatArray,
    name: str,
    cancel: threading.Event | None,
    **options: Any,
) -> ClosedLoopRun:
    from .benches import guarded, machine_of
    from .machine import cancelled_by, is_streaming

    if is_streaming(on):
        return on.follow(controller, r, name, **options, **cancelled_by(cancel))
    machine_of(
        on, expected="a Model, a VirtualMachine, a Drive or a Machine",
        remedy="load a model with load_model, or connect to a drive",
    )  # fmt: skip
    return guarded(on).follow(controller, r, name)


def reference_samples(
    reference: str | ArrayLike, controller: SampledController, seed: int = 0, *, plant: Any = None
) -> FloatArray:
    """The samples of a reference given by name or as samples, shape (N,), as a copy. A name is the
    signal of the catalogue for a controller in RPM at 1 ms; otherwise it is the same shape over the
    recorded range of a model with one input (`sewfast.control.defaults.drive_references`).
    """
    if not isinstance(reference, str):
        return vector("reference", reference).copy()
    samples = signals.reference(reference, seed)
    unit, Ts = controller.y_unit, controller.Ts
    if spelled(unit) == "rpm" and math.isclose(Ts, signals.TS, rel_tol=1e-9):
        return samples
    if isinstance(plant, Model):
        made = drive_references(
            plant, controller.u_min, controller.u_max, pace=controller.pace, seed=seed
        )
        return made[reference.replace("-", "_").lower()]
    raise SettingError(
        name="reference", expected=f"a controller in RPM at {signals.TS} s for {reference!r}",
        received=f"{unit or 'an unknown unit'!r} at {Ts} s",
        remedy="give the reference as samples, such as the column r of a run on the drive's "
        "model (run --on MODEL.json -o FILE, --reference FILE)",
    )  # fmt: skip


def check_fits(controller: SampledController, plant: Any) -> None:
    """Raise `SettingError` for a plant with another sample time or units than the controller's."""
    if not isinstance(plant, (Model, VirtualMachine)):
        raise SettingError(
            name="plant", expected="a Model or a VirtualMachine", received=type(plant).__name__,
            remedy="load a model with load_model",
        )  # fmt: skip
    if not math.isclose(plant.Ts, controller.Ts, rel_tol=0.01):
        raise SettingError(
            name="controller", expected=f"the plant's sample time of {plant.Ts} s",
            received=f"{controller.Ts} s", remedy="tune a controller for this plant",
        )  # fmt: skip
    require_units(controller, plant_units(plant))


def require_units(gains: Gains | SampledController, units: tuple[str, str]) -> None:
    """Raise `SettingError` for gains in other units than a plant's; empty units are unknown."""
    own = (gains.u_unit, gains.y_unit)
    for what, theirs, ours in zip(("input", "output"), units, own, strict=True):
        if theirs and ours and spelled(theirs) != spelled(ours):
            raise SettingError(
                name="plant", expected=f"its {what} in the controller's unit {ours!r}",
                received=repr(theirs), remedy="give the gains in the plant's units",
            )  # fmt: skip


def plant_units(plant: Plant) -> tuple[str, str]:
    """Units of a plant's first input and of its output; empty if unknown."""
    if isinstance(plant, VirtualMachine):
        return "V", "RPM"
    return plant.input_units[0], plant.output_unit


def single_core(plant: Plant, rest: Rest) -> Any:
    """The compiled plant of one run about a rest: of an ensemble its first member, the best one."""
    if not isinstance(plant, Model):
        return plant.core
    return (plant.members[0] if isinstance(plant, Ensemble) else plant).about(rest)


def cores_about(rest: Rest, plants: Sequence[Plant]) -> list[Any]:
    """The compiled plants of single plants about a rest."""
    return [p.about(rest) if isinstance(p, Model) else p.core for p in plants]


def common_rest(plants: Sequence[Any]) -> Rest:
    """The rest about which loops run on these plants: that of the first one, zero for machines.
    A loop is computed in deviations from rest: there a controller that is switched on without a
    bump begins at zero, and a constant added to input or output changes no gain.
    """
    if all(isinstance(plant, Model) for plant in plants):
        rest: Rest = plants[0].rest
        return rest
    return Rest((0.0,), 0.0)


def _from(rest: Rest, record: dict[str, FloatArray]) -> dict[str, FloatArray]:
    """The signals of a run in deviations from rest, with the level added again."""
    if rest.is_zero:
        return record
    levels = {"u": rest.u[0], "y": rest.y, "feedback": rest.y}
    return {name: values + levels[name] for name, values in record.items()}


def plant_name(plant: Plant) -> str:
    """The name of a plant: the machine's name, or the model's kind."""
    if isinstance(plant, Ensemble):
        return f"{plant.kind}, first member"
    return plant.name if isinstance(plant, VirtualMachine) else plant.kind


# --- Lists of plants and references: members, titles, samples -------------------------------------


Plants: TypeAlias = Plant | Sequence[Plant]
References: TypeAlias = str | ArrayLike | Sequence[str | ArrayLike] | None


def each_plant(on: Plants | None) -> list[Plant]:
    """A list of single plants: an ensemble is replaced by its members."""
    if on is None:
        return []
    given = list(on) if isinstance(on, Sequence) else [on]
    for plant in given:
        if not isinstance(plant, (Model, VirtualMachine)):
            raise SettingError(
                name="on", expected="models or virtual machines", received=type(plant).__name__,
                remedy="load a model with load_model",
            )  # fmt: skip
    return [m for p in given for m in (p.members if isinstance(p, Ensemble) else (p,))]


def titles(plants: Sequence[Plant]) -> list[str]:
    """A title for each plant."""
    names = [p.name if isinstance(p, VirtualMachine) else p.kind for p in plants]
    if len(plants) == 1:
        return names
    return [f"{name}, {i + 1} of {len(names)}" for i, name in enumerate(names)]


def each_reference(references: Any, default: Sequence[str]) -> list[Any]:
    """A list of references: a name or a vector is one, a sequence of those is several."""
    if references is None:
        return list(default)
    if isinstance(references, str):
        return [references]
    try:
        iter(references)
    except TypeError:
        raise SettingError(
            name="references", expected="names or samples", received=repr(references),
            remedy="for example 'trapezoid'",
        ) from None  # fmt: skip
    several = not isinstance(references, np.ndarray) and any(
        isinstance(r, str) or np.ndim(r) for r in references
    )
    return list(references) if several or np.ndim(references) == 2 else [references]


def trial(
    controller: SampledController, plant: Plant, reference: Any, title: str, seed: int = 0
) -> ClosedLoopRun:
    """A run without noise, which is no oscillation, under the plant's title. If the loop diverges,
    the `FitError` names the plant.
    """
    try:
        return replace(run(controller, plant, reference, noise=0.0, seed=seed), plant=title)
    except FitError as e:
        named = reference if isinstance(reference, str) else "reference"
        raise FitError(
            name="controller", expected="a loop that stays bounded",
            received=f"one that runs away on {title}, {named}: {e}",
        ) from e  # fmt: skip
