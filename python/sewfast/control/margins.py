"""Margins of the linear loop; `sampled` converts any linear plant to a fraction in z^-1."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .. import _core
from ..dataset import FloatArray
from ..errors import SettingError
from ..evidence.operating import OperatingPoint, operating_range, point_at_level
from ..gains import Gains, real, vector
from ..models import Model
from ..models.conversion import from_state_space, polynomials_of, transfer_function
from ..plotting import SHADE, Drawing, Plotted, legend, stacked
from ..rules import Fopdt
from ..tables import html_of
from ..units import duration
from .controller import Controller
from .loop import plant_units, require_controller, require_units

_GRID = 25
"""Number of constant commands in the search for a speed."""
_HALVINGS = 20
"""Bisections of the interval in which it lies."""


def levels_over(low: float, high: float, rest: float) -> list[float]:
    """The outputs about which nonlinear models are linearised over a range: a tenth, half and nine
    tenths of it. In a range to both sides of rest half way to its nearer end, half and nine tenths
    of the way to the farther: about rest a motor stands in its dry friction.
    """
    near, far = sorted((end - rest for end in (low, high)), key=abs)
    # least way in one direction as a share of that in the other, as of references over both
    if near * far < 0.0 and abs(near) > 0.25 * abs(far):
        return [rest + 0.5 * near, rest + 0.5 * far, rest + 0.9 * far]
    return [low + share * (high - low) for share in (0.1, 0.5, 0.9)]


def sampled(plant: Any, Ts: float, speed: float | None = None) -> tuple[FloatArray, FloatArray]:
    """Numerator and denominator in powers of z^-1, shapes (m,) and (n + 1,). `plant` is an Fopdt, a
    model, an OperatingPoint, or a system of python-control or scipy.signal; a continuous one is
    sampled at `Ts` [s] with a zero-order hold. A nonlinear model is linearised about the steady
    output `speed`. Raises `SettingError` for several inputs or another sample time.
    """
    if all(hasattr(plant, name) for name in ("K", "T", "L")):
        return _core.sampled_fopdt(plant.K, plant.T, plant.L, Ts=Ts)
    if hasattr(plant, "core") and hasattr(plant, "input_names"):
        return _of_model(plant, Ts, speed)
    if all(hasattr(plant, name) for name in ("delay", "settled", "delayed")):
        return _of_point(plant, Ts)
    return _of_system(plant, Ts)


def _of_model(model: Any, Ts: float, speed: float | None) -> tuple[FloatArray, FloatArray]:
    _require(len(model.input_names), model.Ts, Ts)
    if hasattr(model, "to_tf"):
        num, den = transfer_function(model.core)
        return num[0].copy(), den
    if model.members:
        raise SettingError(
            name="plant", expected="one model", received="an ensemble",
            remedy="take the margins of each of its members, or analyse the controller on all of "
            "them",
        )  # fmt: skip
    if speed is None:
        raise SettingError(
            name="speed", expected="that at which the nonlinear model is linearised",
            received="none",
            remedy="give speed, or the linear model about a command: model.linearise(u)",
        )  # fmt: skip
    return _of_point(operating_point(model, speed), Ts)


def operating_point(model: Any, speed: float) -> OperatingPoint:
    """The linear model of a nonlinear one about the steady state whose output is `speed`.

    `margins(controller, point, speed=speed)` then equals `margins(controller, model, speed=speed)`
    to the bit, without the search for the steady state: useful if you try many controllers.

    Parameters
    ----------
    model : Model
        With one input; for an ensemble, use one of its `members`.
    speed : float
        Steady output [y].

    Returns
    -------
    OperatingPoint
        Of `sewfast.evidence`.

    Raises
    ------
    SettingError
        For an ensemble, or if no command within the range of the training data holds that speed.
    """
    if model.members:
        raise SettingError(
            name="plant", expected="one model", received="an ensemble",
            remedy="take the operating point of each of its members",
        )  # fmt: skip
    return point_within(model, command_grid(model), real("speed", speed))


def command_grid(model: Any) -> Sequence[OperatingPoint]:
    """Steady states over the range of the commands that a model was identified on.
    Each is searched from its neighbour towards rest: a network may have others where no data were,
    and would be held there.
    """
    low, high = model.training.get("input_range", [[-1.0, 1.0]])[0]
    grid = [np.array([u]) for u in np.linspace(low, high, _GRID)]
    middle = min(range(_GRID), key=lambda k: abs(float(grid[k][0]) - model.rest.u[0]))
    up = operating_range(model, grid[middle:]).points
    down = operating_range(model, grid[middle::-1]).points
    return (*down[:0:-1], *up)


def point_within(model: Any, grid: Sequence[OperatingPoint], speed: float) -> OperatingPoint:
    """As `operating_point`, on a grid that serves for several outputs."""
    low, high = float(grid[0].u[0]), float(grid[-1].u[0])
    if not any(p.settled for p in grid) and any(p.drift for p in grid):
        return _integrating_point(model, grid, speed)
    pairs = [p for p in itertools.pairwise(grid) if (p[0].y - speed) * (p[1].y - speed) <= 0.0]
    if not pairs:
        reached = [p.y for p in grid]
        raise SettingError(
            name="speed", expected="one that the model holds at a constant command",
            received=f"{speed:g}",
            remedy=f"from {low:.4g} to {high:.4g} it reaches {min(reached):.4g} to "
            f"{max(reached):.4g}",
        )  # fmt: skip
    # a network may hold an output in two ways, one of them where no data were
    below, above = max(pairs, key=lambda pair: pair[0].known + pair[1].known)
    # bisection, as steady outputs can jump where friction breaks away
    for _ in range(_HALVINGS):
        found = operating_range(model, [0.5 * (below.u + above.u)]).points[0]
        if (found.y - speed) * (below.y - speed) > 0.0:
            below = found
        else:
            above = found
    return _require_steady(above, speed)


def _integrating_point(model: Any, grid: Any, level: float) -> OperatingPoint:
    """The operating point of an integrator: the command that keeps its output, at any level."""
    pairs = [p for p in itertools.pairwise(grid) if p[0].drift * p[1].drift <= 0.0]
    if not pairs:
        raise SettingError(
            name="plant", expected="a command at which the integrating model keeps its output",
            received=f"none: from {grid[0].u[0]:.4g} to {grid[-1].u[0]:.4g} it always moves the "
            "same way",
            remedy="record both ways and identify again",
        )  # fmt: skip
    below, above = pairs[0]
    for _ in range(_HALVINGS):
        found = operating_range(model, [0.5 * (below.u + above.u)]).points[0]
        if found.drift * below.drift > 0.0:
            below = found
        else:
            above = found
    return _require_steady(point_at_level(model, above.u, level), level)


def _require_steady(point: OperatingPoint, speed: float) -> OperatingPoint:
    if not point.settled or point.saturated:
        raise SettingError(
            name="speed", expected=f"a steady state at {speed:g}",
            received="one that "
            f"{('lies on a limit of the output' if point.saturated else 'does not settle')}",
            remedy="take another speed",
        )  # fmt: skip
    return point


def _of_point(point: Any, Ts: float) -> tuple[FloatArray, FloatArray]:
    _require(len(point.u), point.Ts, Ts)
    num, den = from_state_space(point.A, point.B, point.C, point.D)
    return np.concatenate([np.zeros(point.delay), num[0]]), den


def _of_system(system: Any, Ts: float) -> tuple[FloatArray, FloatArray]:
    if not any(hasattr(system, name) for name in ("num", "A", "zeros")):
        raise SettingError(
            name="system",
            expected="an Fopdt, a model, an operating point or a system of python-control or "
            "scipy.signal",
            received=type(system).__name__,
        )  # fmt: skip
    inputs, outputs = (getattr(system, name, 1) for name in ("ninputs", "noutputs"))
    _require(inputs or 1, Ts, Ts)
    if (outputs or 1) != 1:
        raise SettingError(
            name="system", expected="one output", received=str(outputs), remedy="take one of them"
        )
    try:
        discrete = _discrete(system, Ts)
    except (ValueError, NotImplementedError) as error:
        raise SettingError(
            name="system", expected="a proper linear system to sample under a zero-order hold",
            received=str(error),
        ) from error  # fmt: skip
    num, den, _ = polynomials_of(discrete, Ts)
    _require(len(num), Ts, Ts)
    return np.ascontiguousarray(num[0]), np.ascontiguousarray(den)


def _discrete(system: Any, Ts: float) -> Any:
    """A continuous system sampled with a zero-order hold; a discrete one unchanged."""
    if getattr(system, "dt", math.nan) not in (0, None):
        return system
    if type(system).__module__.startswith("control."):
        import control

        # python-control keeps None for an unspecified time base: nothing is assumed about it
        return control.sample_system(system, Ts, method="zoh") if system.dt == 0 else system
    if hasattr(system, "to_discrete"):
        return system.to_ss().to_discrete(Ts, method="zoh")
    return system


def _require(inputs: int, of: float, Ts: float) -> None:
    if inputs != 1:
        raise SettingError(
            name="plant", expected="one input", received=str(inputs), remedy="take one of them"
        )
    if not math.isclose(of, Ts, rel_tol=1e-9):
        raise SettingError(
            name="plant", expected=f"the controller's sample time of {Ts:g} s",
            received=f"{of:g} s", remedy="resample one of them",
        )  # fmt: skip


# --- `margins` ------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Margins(Plotted):
    """Margins of the sampled loop, broken at the plant's input (docs/CONVENTIONS.md, Control).

    For an unstable loop the peaks and the noise gain are infinite and the other margins NaN.

    Attributes
    ----------
    stable : bool
        Whether every closed-loop pole is inside the unit circle.
    Ms, Mt : float
        Largest |S| and |T|; `Ms` is the inverse of the distance of L to -1.
    Ms_omega, Mt_omega : float
        Their frequencies [rad/s].
    Ms_robust : float
        What a limit of Ms is compared with: `Ms`, or half of the largest after a change of a plant
        with a resonance.
    gain_margin : float
        The factor above 1 on the loop's gain that makes the loop unstable; inf if none does.
    gain_reduction : float
        The factor below 1 that makes it unstable; 0 if none does.
    phase_margin_deg : float
        The smallest phase change of L, in either direction, that makes it unstable [deg].
    delay_margin_s : float
        The additional delay that makes it unstable [s].
    gain_crossovers, phase_crossovers : tuple of float
        Frequencies at which |L| is 1, and at which L is real and negative [rad/s].
    noise_gain : float
        rms of the command over rms of white noise on the measured output [u/y].
    bandwidth : float
        Frequency at which |S| first reaches 1/sqrt(2) [rad/s]: slower disturbances are weakened by
        3 dB or more.
    largest_pole : float
        Largest magnitude of a closed-loop pole; NaN with a memory of more than 250 samples.
    changed : tuple of float, or None
        For a plant with a resonance, the largest Ms if its gain changes by -20 to +25 %, its delay
        by up to two samples, and the frequency of the resonance by 10 %: that Ms, the factor on the
        gain, the delay [samples], the factor on the frequency. Gain and delay margins move the
        whole plant; a resonance also moves by itself, and leaves its notch.
    u_unit, y_unit : str
    """

    stable: bool
    Ms: float
    Ms_omega: float
    Ms_robust: float
    Mt: float
    Mt_omega: float
    gain_margin: float
    gain_reduction: float
    phase_margin_deg: float
    delay_margin_s: float
    gain_crossovers: tuple[float, ...]
    phase_crossovers: tuple[float, ...]
    noise_gain: float
    bandwidth: float
    largest_pole: float
    changed: tuple[float, float, int, float] | None = None
    u_unit: str = "V"
    y_unit: str = "RPM"

    def to_dict(self) -> dict[str, Any]:
        """Everything by name."""
        return {name: getattr(self, name) for name in self.__dataclass_fields__}

    def drawing(self) -> Drawing:
        """The margins in the plane of the loop transfer L.

        L stays outside the circle of radius 1/Ms about -1. Arrows show how far L can move on the
        real axis (gain) and on the unit circle (phase) before the loop is unstable.
        """
        if not self.stable:
            raise SettingError(
                name="margins", expected="those of a stable loop",
                received="those of an unstable one, which has none to draw",
                remedy="lower the gains",
            )  # fmt: skip
        return stacked([self._draw], (4.0,))

    def _draw(self, ax: Any) -> None:
        turn = np.linspace(0.0, 2.0 * np.pi, 361)
        ax.plot(
            np.cos(turn), np.sin(turn), color="gray", linewidth=0.8, linestyle=":", label="|L| = 1"
        )
        x, y = -1.0 + np.cos(turn) / self.Ms, np.sin(turn) / self.Ms
        ax.fill(x, y, color=SHADE)
        ax.plot(x, y, label=f"Ms {self.Ms:.3g}")
        ax.plot(-1.0, 0.0, linestyle="none", marker="+", color="black", markersize=9)
        for factor, name in ((self.gain_margin, "gain"), (self.gain_reduction, "gain, down to")):
            if math.isfinite(factor) and factor > 0.0:
                # farther out, the rest would become too small to see
                at = -min(1.0 / factor, 4.0)
                ax.plot([-1.0, at], [0.0, 0.0], marker="o", label=f"{name} {factor:.3g}")
        if math.isfinite(self.phase_margin_deg):
            angle = -np.pi + np.linspace(0.0, math.radians(self.phase_margin_deg), 61)
            label = f"phase {self.phase_margin_deg:.3g} deg"
            ax.plot(np.cos(angle), np.sin(angle), linewidth=2.5, label=label)
        ax.set_aspect("equal", adjustable="datalim")
        ax.set_xlabel("real part of L")
        ax.set_ylabel("imaginary part of L")
        legend(ax, columns=3)

    def _repr_html_(self) -> str:
        return html_of(f"margins\n{self}")

    def __str__(self) -> str:
        if not self.stable:
            known = not math.isnan(self.largest_pole)
            return "unstable" + (f", largest pole {self.largest_pole:.6g}" if known else "")
        hertz = ", ".join(f"{w / (2 * math.pi):.4g}" for w in self.gain_crossovers)
        crossing = f"{hertz} Hz" if hertz else "nowhere"
        less = f", down to {self.gain_reduction:.3g}" if self.gain_reduction else ""
        return "\n".join(
            [
                f"Ms {self.Ms:.3f}{_at(self.Ms_omega)}, Mt {self.Mt:.3f}{_at(self.Mt_omega)}",
                f"gain margin {self.gain_margin:.3g}{less}, phase margin "
                f"{self.phase_margin_deg:.1f} deg, delay margin {duration(self.delay_margin_s, 3)}",
                f"crossover {crossing}, noise gain {self.noise_gain:.4g} "
                f"{self.u_unit}/{self.y_unit}",
                *([] if self.changed is None else [self.tolerance]),
            ]
        )

    @property
    def tolerance(self) -> str:
        """`changed` in words; empty for a plant without a resonance."""
        if self.changed is None:
            return ""
        Ms, gain, delay, pitch = self.changed
        what = (
            f"its resonance {100 * abs(pitch - 1):.0f} % {'lower' if pitch < 1 else 'higher'}"
            if pitch != 1.0
            else "its resonance where it is",
            f"gain x {gain:g}" if gain != 1.0 else "",
            f"{delay} samples later" if delay else "",
        )
        became = f"Ms {Ms:.3f}" if math.isfinite(Ms) else "unstable"
        return f"{became} with {', '.join(w for w in what if w)}"


def margins(controller: Controller, plant: Any, *, speed: float | None = None) -> Margins:
    """Margins of a controller on a linear plant at the controller's sample time.

    The loop includes the gains, the derivative's filter, the feedback filters, the encoder's mean
    over a sample if the controller has an encoder, the zero-order hold and every delay. It excludes
    limits, the reference's weights and ramp, and the encoder's rounding.

    Parameters
    ----------
    controller : Controller
    plant : Fopdt, model, OperatingPoint, or system of python-control or scipy.signal
        An `Fopdt` and systems in continuous time are sampled under a zero-order hold. A nonlinear
        model is linearised at the steady state with output `speed`; `operating_range(model)` gives
        operating points. One input.
    speed : float, optional
        Output at which a gain schedule and a nonlinear model are evaluated [y].

    Raises
    ------
    SettingError
        Without a speed where one is needed, for several inputs, another sample time, other units,
        or a plant that responds within the same sample.
    """
    require_controller(controller, plant, "margins(controller, plant)")
    _require_units(controller.gains, plant)
    path, fraction = loop_path(controller, speed=speed), sampled(plant, controller.Ts, speed)
    found = _core.margins(path, *fraction)
    found["Ms_robust"], found["changed"] = _core.tolerance(path, *fraction)
    for name in ("gain_crossovers", "phase_crossovers"):
        found[name] = tuple(found[name])
    gains = controller.gains
    return Margins(**found, u_unit=gains.u_unit, y_unit=gains.y_unit)


def loop_response(
    controller: Controller, plant: Any, omega: ArrayLike, *, speed: float | None = None
) -> NDArray[np.complex128]:
    """L at `omega` [rad/s], shape (len(omega),); S is 1/(1 + L), T is L/(1 + L).

    Parameters as in `margins`.
    """
    require_controller(controller, plant, "loop_response(controller, plant, omega)")
    _require_units(controller.gains, plant)
    w = vector("omega", np.atleast_1d(np.asarray(omega)))
    nyquist = math.pi / controller.Ts
    if not np.all((w > 0.0) & (w <= nyquist * (1 + 1e-12))):
        raise SettingError(
            name="omega",
            expected=f"frequencies above 0 and up to half the sample rate, {nyquist:.6g} rad/s",
            received=repr(omega),
        )  # fmt: skip
    path = loop_path(controller, speed=speed)
    return _core.loop_response(path, *sampled(plant, controller.Ts, speed), w)


def _require_units(gains: Gains, plant: Any) -> None:
    """Raise `SettingError` for a model with other units; systems of toolboxes have none."""
    if isinstance(plant, Fopdt):
        require_units(gains, (plant.u_unit, plant.y_unit))
    elif isinstance(plant, Model):
        require_units(gains, plant_units(plant))


def loop_path(
    controller: Controller, *, speed: float | None = None, position: float = 0.0
) -> _core.LoopPath:
    """The part of the controller in the feedback path, with a schedule's gains at `speed`, and the
    gain of a `position` loop around it [1/s].
    """
    gains, slope = scheduled_gains(controller, speed)
    return _core.LoopPath(
        Kp=gains.Kp,
        Ti=gains.Ti,
        Td=gains.Td,
        slope=slope,
        N=controller.N,
        Ts=controller.Ts,
        filter_samples=controller.filter_samples,
        filter_time=controller.filter_time,
        observer_time=controller.observer_time,
        biquads=controller.sections(),
        encoder=controller.counts_per_rev is not None,
        position=position,
    )


def scheduled_gains(controller: Controller, speed: float | None) -> tuple[Gains, float]:
    """Gains in standard form at the output `speed`, and the schedule's contribution to Kp there:
    `alpha r dKp/dy` at r = y [u/y], as `-Kp alpha r` varies with the output; 0 without a schedule.
    """
    schedule = controller.schedule
    if not schedule:
        return controller.gains.to("standard"), 0.0
    if speed is None:
        raise SettingError(
            name="speed", expected="that at which the gain schedule is taken", received="none",
            remedy="give speed",
        )  # fmt: skip
    at = np.array([point[0] for point in controller.schedule])
    rows = [point[1].to("parallel") for point in controller.schedule]
    size = abs(real("speed", speed))
    Kp, Ki, Kd = (
        float(np.interp(size, at, [getattr(g, name) for g in rows])) for name in ("Kp", "Ki", "Kd")
    )
    slope = 0.0
    above = int(np.searchsorted(at, size, side="right"))
    if 0 < above < len(at):
        steepness = (rows[above].Kp - rows[above - 1].Kp) / (at[above] - at[above - 1])
        slope = float(controller.alpha * size * steepness)
    units = {"u_unit": controller.gains.u_unit, "y_unit": controller.gains.y_unit}
    Ti, Td = Kp / Ki if Ki else math.inf, Kd / Kp if Kp else 0.0
    return Gains.standard(Kp, Ti, Td, **units), slope


def _at(omega: float) -> str:
    return "" if math.isnan(omega) else f" at {omega / (2 * math.pi):.4g} Hz"
