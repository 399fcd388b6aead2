"""`margins`: how far a controller on a linear plant is from instability."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from . import _core
from .control import Controller, Fopdt
from .errors import SettingError
from .gains import Gains, real, vector
from .linear_plant import sampled
from .loop import plant_units, require_controller, require_units
from .models import Model

__all__ = ["Margins", "loop_path", "loop_response", "margins"]


@dataclass(frozen=True)
class Margins:
    """Margins of the sampled loop, broken at the plant's input (docs/CONVENTIONS.md, Control).

    Of an unstable loop the peaks and the noise gain are infinite and the other margins NaN.

    Attributes
    ----------
    stable : bool
        Whether every closed-loop pole lies inside the unit circle.
    Ms, Mt : float
        Largest |S| and |T|; `Ms` is the inverse of the distance of L to -1.
    Ms_omega, Mt_omega : float
        Where [rad/s].
    gain_margin : float
        The factor above 1 on the loop's gain that makes it unstable; inf where none does.
    gain_reduction : float
        The factor below 1 that does; 0 where none does.
    phase_margin_deg : float
        The least turn of L, to either side, that does [deg].
    delay_margin_s : float
        The additional delay that does [s].
    gain_crossovers, phase_crossovers : tuple of float
        Where |L| is 1, and where L is real and negative [rad/s].
    noise_gain : float
        rms of the command over rms of white noise on the measured output [u/y].
    largest_pole : float
        Largest size of a closed-loop pole; NaN with a memory of more than 250 samples.
    u_unit, y_unit : str
    """

    stable: bool
    Ms: float
    Ms_omega: float
    Mt: float
    Mt_omega: float
    gain_margin: float
    gain_reduction: float
    phase_margin_deg: float
    delay_margin_s: float
    gain_crossovers: tuple[float, ...]
    phase_crossovers: tuple[float, ...]
    noise_gain: float
    largest_pole: float
    u_unit: str = "V"
    y_unit: str = "RPM"

    def to_dict(self) -> dict[str, Any]:
        """Everything by name."""
        return {name: getattr(self, name) for name in self.__dataclass_fields__}

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
                f"{self.phase_margin_deg:.1f} deg, delay margin {1e3 * self.delay_margin_s:.3g} ms",
                f"crossover {crossing}, noise gain {self.noise_gain:.4g} "
                f"{self.u_unit}/{self.y_unit}",
            ]
        )


def margins(controller: Controller, plant: Any, *, speed: float | None = None) -> Margins:
    """Margins of a controller on a linear plant at the controller's sample time.

    What is in the loop: the gains, the derivative's filter, the feedback filters, the encoder's
    mean over a sample where the controller has one, the zero-order hold, every delay. What is
    not: limits, the reference's weights and ramp, the encoder's rounding.

    Parameters
    ----------
    controller : Controller
    plant : Fopdt, model, OperatingPoint, or system of python-control or scipy.signal
        An `Fopdt` and systems in continuous time are sampled under a zero-order hold. A nonlinear
        model is linearised at the steady state with output `speed`; `operating_range(model)` gives
        operating points. One input.
    speed : float, optional
        Output at which the gains of a schedule, and a nonlinear model, are taken [y].

    Raises
    ------
    SettingError
        Without a speed where one is needed, for several inputs, another sample time, other units,
        or a plant that answers within the same sample.
    """
    require_controller(controller, plant, "margins(controller, plant)")
    _require_units(controller.gains, plant)
    found = _core.margins(loop_path(controller, speed=speed), *sampled(plant, controller.Ts, speed))
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
            f"omega: expected frequencies above 0 and up to half the sample rate, {nyquist:.6g} "
            f"rad/s, received {omega!r}"
        )
    path = loop_path(controller, speed=speed)
    return _core.loop_response(path, *sampled(plant, controller.Ts, speed), w)


def _require_units(gains: Gains, plant: Any) -> None:
    """Refuse a first-order model or a model whose units are others; toolboxes' systems have none.

    Raises
    ------
    SettingError
        Naming both.
    """
    if isinstance(plant, Fopdt):
        require_units(gains, (plant.u_unit, plant.y_unit))
    elif isinstance(plant, Model):
        require_units(gains, plant_units(plant))


def loop_path(controller: Controller, *, speed: float | None = None) -> _core.LoopPath:
    """What of the controller lies in the loop, with a schedule's gains at `speed`.

    Raises
    ------
    SettingError
        For a schedule without a speed.
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
        encoder=controller.counts_per_rev is not None,
    )


def scheduled_gains(controller: Controller, speed: float | None) -> tuple[Gains, float]:
    """Gains in standard form where the output is `speed`, and what the schedule adds to Kp there.

    That is `alpha r dKp/dy` at r = y [u/y]: `-Kp alpha r` follows the output, too. 0 without a
    schedule.

    Raises
    ------
    SettingError
        For a schedule without a speed.
    """
    schedule = controller.schedule
    if not schedule:
        return controller.gains.to("standard"), 0.0
    if speed is None:
        raise SettingError(
            "expected the speed at which the gain schedule is taken, received none; give speed"
        )
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
