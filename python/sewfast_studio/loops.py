"""Bode plots: a recording's frequency response with its bands, and the tuned loop over it."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from sewfast.errors import DataError, FitError

from .tuning import band, bode_curves

if TYPE_CHECKING:
    from sewfast.analysis.points import LoopBode, PlantPoint
    from sewfast.control.margins import Margins
    from sewfast.dataset import FloatArray
    from sewfast.frequency import FrequencyResponse, ShaftFit

    from .tuning import Tuning

LEAST_COHERENCE = 0.5
"""Lines of a response with a smaller coherence are left out of the curves."""

FINE = 400
"""Number of frequencies at which a fit is drawn."""

Curves = dict[str, "FloatArray"]


def shown_response(response: FrequencyResponse) -> tuple[dict[str, Any], Curves]:
    """A measured response for the page: curves, the fitted shaft, and a notch for it."""
    from sewfast.frequency import fit_shaft

    fit: ShaftFit | None = None
    try:
        fit = fit_shaft(response)
        shaft = str(fit)
    except (DataError, FitError) as refused:
        shaft = f"no shaft fitted: {refused}"
    notch = None
    if fit is not None and fit.has_resonance:
        try:
            notch = list(fit.notch().numbers)
        except FitError as refused:
            shaft = f"{shaft}\nno notch: {refused}"
    unit = f"{response.y_unit}/{response.u_unit}" if response.y_unit else "1"
    curves = {"hertz": response.hertz, "coherence": response.coherence}
    curves |= _measured("P", response, response.value, response.radius())
    if fit is not None:
        fine = np.geomspace(response.hertz[0], response.hertz[-1], FINE)
        value = fit.at(fine)
        curves |= {"fit_hertz": fine, "fit_db": _db(value)}
        curves["fit_deg"] = _turned(value, response.value[0])
    return {"text": str(response), "shaft": shaft, "notch": notch, "unit": unit}, curves


def _measured(
    name: str, response: FrequencyResponse, value: NDArray[np.complex128], radius: FloatArray
) -> Curves:
    """Gain [dB] and phase [deg] with their 95 % bands; gaps at low coherence."""
    size = np.maximum(np.abs(value), 1e-300)
    phase = np.degrees(np.unwrap(np.angle(value)))
    half = np.degrees(np.arcsin(np.minimum(radius / size, 1.0)))
    curves = {
        f"{name}_db": _db(value),
        # a band that includes 0 has no logarithm at its lower end
        f"{name}_db_low": 20.0 * np.log10(np.maximum(size - radius, 0.05 * size)),
        f"{name}_db_high": 20.0 * np.log10(size + radius),
        f"{name}_deg": phase,
        f"{name}_deg_low": phase - half,
        f"{name}_deg_high": phase + half,
    }
    seen = response.coherence >= LEAST_COHERENCE
    return {key: np.where(seen, values, np.nan) for key, values in curves.items()}


def shown_loop(
    tuning: Tuning, values: Mapping[str, Any], response: FrequencyResponse | None
) -> tuple[dict[str, Any], Curves]:
    """Plant, L, S and T of the loop with these values, with marked margins and a measured response.
    Raises `SettingError` for a response with another sample time or other units.
    """
    from sewfast.analysis.points import loop_bodes

    controller = tuning.controller(values)
    (bode,) = loop_bodes(controller, [tuning.points], tuning.slowest)
    curves = bode_curves(bode)
    counted = response is not None and response.from_counts
    P = np.array([_plant(point, bode.hertz, counted=counted) for point in tuning.points])
    curves |= band("P_db", _db(P)) | band("P_deg", np.degrees(np.unwrap(np.angle(P), axis=1)))
    worst = bode.worst
    found: dict[str, Any] = {
        "marks": _marks(bode, worst),
        "stable": worst.stable,
        "text": str(worst),
        "level": bode.level,
        "members": len(bode.points),
        "measured": None,
    }
    if response is None:
        return found, curves
    L = response.loop(controller, speed=bode.level)
    radius = response.radius() * np.abs(L / response.value)
    curves["measured_hertz"] = response.hertz
    curves |= {f"measured_{k}": v for k, v in _measured("P", response, response.value,
                                                        response.radius()).items()}  # fmt: skip
    curves |= {f"measured_{k}": v for k, v in _measured("L", response, L, radius).items()}
    seen = response.coherence >= LEAST_COHERENCE
    curves["measured_S_db"] = np.where(seen, -_db(1.0 + L), np.nan)
    curves["measured_T_db"] = np.where(seen, _db(L) - _db(1.0 + L), np.nan)
    try:
        found["measured"] = str(response.margins(controller, speed=bode.level))
    except DataError as refused:
        found["measured"] = str(refused)
    return found, curves


def _plant(point: PlantPoint, hertz: FloatArray, *, counted: bool) -> NDArray[np.complex128]:
    """Response from held command to output; with `counted` to its mean over a sample."""
    z = np.exp(2j * np.pi * hertz * point.Ts)
    poles, V = np.linalg.eig(point.A)
    # a defective A (a delay line) lacks eigenvectors: solve at each frequency instead
    if np.linalg.cond(V) < 1e8:
        left, right = point.C @ V, np.linalg.solve(V, point.B)
        value = (left[0] * right[:, 0] / (z[:, None] - poles)).sum(axis=1) + point.D[0, 0]
    else:
        identity = np.eye(len(point.A))
        value = np.array(
            [(point.C @ np.linalg.solve(q * identity - point.A, point.B) + point.D)[0, 0]
             for q in z]
        )  # fmt: skip
    mean = 0.5 * (1.0 + 1.0 / z) if counted else 1.0
    return np.asarray(value * mean, dtype=np.complex128)


def _marks(bode: LoopBode, worst: Margins) -> list[dict[str, Any]]:
    """Marks for the margins of the worst member: frequency, gain or phase, and a label."""
    if not worst.stable:
        return []
    L = bode.L[bode.margins.index(worst)]
    turn = np.unwrap(np.angle(L))
    marks: list[dict[str, Any]] = []

    def mark(plot: str, omega: float, value: Callable[[float], float], label: str) -> None:
        hertz = omega / (2.0 * math.pi)
        if bode.hertz[0] <= hertz <= bode.hertz[-1]:
            marks.append({"plot": plot, "x": hertz, "y": value(hertz), "label": label})

    def phase(hertz: float) -> float:
        return math.degrees(float(np.interp(hertz, bode.hertz, turn)))

    def gain(hertz: float) -> float:
        return float(np.interp(hertz, bode.hertz, _db(L)))

    def distance(omega: float) -> float:
        """Angle from L to -1 [deg]."""
        return abs(math.remainder(phase(omega / (2.0 * math.pi)) + 180.0, 360.0))

    if worst.gain_crossovers:
        omega = min(worst.gain_crossovers, key=distance)
        label = f"phase margin {worst.phase_margin_deg:.0f} deg"
        mark("L_db", omega, lambda _: 0.0, "crossover")
        mark("L_deg", omega, phase, label)
    below = [w for w in worst.phase_crossovers if gain(w / (2.0 * math.pi)) < 0.0]
    if below:
        omega = max(below, key=lambda w: gain(w / (2.0 * math.pi)))
        mark("L_db", omega, gain, f"gain margin {worst.gain_margin:.2g}")
    mark("S_db", worst.Ms_omega, lambda _: 20.0 * math.log10(worst.Ms), f"Ms {worst.Ms:.2f}")
    return marks


def _db(value: NDArray[np.complex128]) -> FloatArray:
    found: FloatArray = 20.0 * np.log10(np.maximum(np.abs(value), 1e-300))
    return found


def _turned(value: NDArray[np.complex128], first: complex) -> FloatArray:
    """Phase [deg], shifted by whole turns to be nearest to that of the first measured line."""
    turn = np.degrees(np.unwrap(np.angle(value)))
    near = turn[0] - math.degrees(math.atan2(first.imag, first.real))
    found: FloatArray = turn - 360.0 * round(near / 360.0)
    return found
