"""`FrequencyResponse`: gain and phase with their uncertainty, and the loop around them."""

from __future__ import annotations

import math
import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from .. import _core, storage
from ..arrays import FloatArray
from ..control.controller import Controller
from ..control.margins import loop_path
from ..errors import DataError, SettingError
from ..plotting import LOOKS, Drawing, stacked
from ..tables import Shown

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from .shaft import ShaftFit

Complex = NDArray[np.complex128]

"""Before version 2, `blocks` was always one number."""

PROVENANCE = {"properties": {"cautions": {"type": "array", "items": {"type": "string"}}}}
"""Schema of the provenance that is printed."""

LEAST_LINES = 3
"""For margins."""


@dataclass(frozen=True, eq=False, repr=False)
class FrequencyResponse(storage.Stored, Shown):
    """Frequency response of a sampled system, as measured.

    Attributes
    ----------
    hertz : array, shape (n,)
        Frequencies [Hz], increasing, up to half the sample rate.
    value : array of complex, shape (n,)
        Output over input [y/u].
    variance : array, shape (n,)
        Expected squared magnitude of the error of `value`, from noise and, if different excitations
        were averaged, from nonlinear distortion.
    noise : array, shape (n,), or None
        The part of it due to noise alone, from repetitions of the same excitation.
    coherence : array, shape (n,)
        Share of the output's power that the response explains, 0 to 1.
    blocks : float or array, shape (n,)
        Number of averaged independent blocks; the variance has one degree of freedom fewer.
    Ts : float
        Sample time [s].
    u_unit, y_unit : str
    from_counts : bool
        Whether the output is a difference of encoder counts: the mean speed over the sample before.
    provenance : mapping
        Machine, speed, method; `cautions` on a record, `incomplete` if the run broke off.
    """

    FORMAT: ClassVar[str] = "sewfast-frequency-response"
    VERSION: ClassVar[int] = 2

    hertz: FloatArray
    value: Complex
    variance: FloatArray
    coherence: FloatArray
    blocks: float | FloatArray
    Ts: float
    noise: FloatArray | None = None
    u_unit: str = ""
    y_unit: str = ""
    from_counts: bool = False
    provenance: Mapping[str, Any] = field(default_factory=dict)

    @property
    def magnitude_db(self) -> FloatArray:
        """20 log10 of the gain in y/u, shape (n,)."""
        return 20.0 * np.log10(np.maximum(np.abs(self.value), 1e-300))

    @property
    def phase_deg(self) -> FloatArray:
        """Unwrapped phase, shape (n,) [deg]; between -180 and 180 at the lowest frequency."""
        return np.rad2deg(np.unwrap(np.angle(self.value)))

    @property
    def distortion(self) -> FloatArray | None:
        """Standard deviation between excitations beyond the noise [y/u].

        For one excitation, shape (n,); None if it was not measured.
        """
        if self.noise is None:
            return None
        return np.sqrt(np.maximum(self.variance - self.noise, 0.0) * self.blocks)

    def radius(self, level: float = 0.95) -> FloatArray:
        """Radius of the circle about `value` in which the response lies [y/u], shape (n,).

        With nu = blocks - 1 complex degrees of freedom the squared error over the estimated
        variance follows F(2, 2 nu) (Pintelon and Schoukens 2012, section 2.4).
        """
        if not 0.0 < level < 1.0:
            raise SettingError(
                name="level", expected="a share between 0 and 1", received=repr(level)
            )
        nu = np.maximum(np.asarray(self.blocks) - 1.0, 1.0)
        quantile = nu * ((1.0 - level) ** (-1.0 / nu) - 1.0)
        found: FloatArray = np.sqrt(self.variance * quantile)
        return found

    def at(self, hertz: float) -> complex:
        """The response between two measured frequencies, magnitude and phase interpolated.

        Raises
        ------
        SettingError
            For a frequency outside the measured range.
        """
        if not self.hertz[0] <= hertz <= self.hertz[-1]:
            raise SettingError(
                name="hertz",
                expected=f"a frequency from {self.hertz[0]:.4g} to {self.hertz[-1]:.4g} Hz, which "
                "were measured",
                received=repr(hertz),
            )  # fmt: skip
        size = np.interp(hertz, self.hertz, np.log(np.maximum(np.abs(self.value), 1e-300)))
        turn = np.interp(hertz, self.hertz, np.unwrap(np.angle(self.value)))
        return complex(np.exp(size + 1j * turn))

    # --- The loop that a controller closes around it ----------------------------------------------

    def loop(self, controller: Controller, *, speed: float | None = None) -> Complex:
        """Loop gain L, broken at the plant's input, at each frequency, shape (n,).

        Raises
        ------
        SettingError
            For another sample time or other units.
        """
        return self.value * self._feedback(controller, speed)

    def _feedback(self, controller: Controller, speed: float | None) -> Complex:
        """Response from the measured output to the command, with reversed sign."""
        if not math.isclose(controller.Ts, self.Ts, rel_tol=1e-9):
            raise SettingError(
                name="controller", expected=f"the response's sample time, {self.Ts:g} s",
                received=f"{controller.Ts:g} s",
            )  # fmt: skip
        gains = controller.gains
        for name, mine, theirs in (
            ("u", self.u_unit, gains.u_unit),
            ("y", self.y_unit, gains.y_unit),
        ):
            if mine and mine != theirs:
                raise SettingError(
                    name="controller", expected=f"its {name} in {mine}", received=str(theirs),
                    remedy="convert it",
                )  # fmt: skip
        path = loop_path(controller, speed=speed)
        omega = 2.0 * np.pi * self.hertz
        # the plant here is a delay of one sample, which is removed again
        one, delay = np.array([1.0]), np.array([0.0, 1.0])
        found = _core.loop_response(path, delay, one, omega) * np.exp(1j * omega * self.Ts)
        if self.from_counts and controller.counts_per_rev is not None:
            # the response already includes the mean over a sample
            found = found / (0.5 * (1.0 + np.exp(-1j * omega * self.Ts)))
        feedback: Complex = found
        return feedback

    def lines(self, controller: Controller) -> tuple[FloatArray, Complex, FloatArray, bool]:
        """Lines with a coherence above a half, on which `sewfast.tune` limits Ms.

        Frequencies [rad/s], response and radius, and whether the response includes the controller's
        encoder. Between two measured lines the response is interpolated, as for `margins`.
        """
        self._feedback(controller, controller.schedule[0][0] if controller.schedule else None)
        seen = self.coherence > 0.5
        if seen.sum() < LEAST_LINES:
            raise DataError(
                name="response",
                expected=f"at least {LEAST_LINES} frequencies with a coherence above .5",
                received=str(seen.sum()), remedy="excite more, or longer",
            )  # fmt: skip
        hertz, value, radius = self.hertz[seen], self.value[seen], self.radius()[seen]
        n = len(hertz)
        # points per measured line at which a search evaluates the sensitivity
        fine = np.interp(np.arange(0, n - 1 + 1e-9, 1.0 / 4), np.arange(n), hertz)
        size = np.interp(fine, hertz, np.log(np.maximum(np.abs(value), 1e-300)))
        turn = np.interp(fine, hertz, np.unwrap(np.angle(value)))
        found: Complex = np.exp(size + 1j * turn)
        return 2.0 * np.pi * fine, found, np.interp(fine, hertz, radius), self.from_counts

    def margins(self, controller: Controller, *, speed: float | None = None) -> LoopMargins:
        """Margins of the loop where the coherence is above a half.

        Assumes that the loop is stable, because a response alone cannot show it.
        """
        feedback, seen = self._feedback(controller, speed), self.coherence > 0.5
        L, radius = self.value * feedback, self.radius() * np.abs(feedback)
        return LoopMargins.of(self.hertz[seen], L[seen], radius[seen])

    # --- Files, other tools, pictures -------------------------------------------------------------

    def to_dict(self) -> dict[str, Any]:
        """Everything by name, as JSON values."""
        return {
            "hertz": self.hertz.tolist(),
            "real": self.value.real.tolist(),
            "imaginary": self.value.imag.tolist(),
            "variance": self.variance.tolist(),
            "noise": None if self.noise is None else self.noise.tolist(),
            "coherence": self.coherence.tolist(),
            "blocks": self.blocks.tolist() if isinstance(self.blocks, np.ndarray) else self.blocks,
            "Ts": self.Ts,
            "u_unit": self.u_unit,
            "y_unit": self.y_unit,
            "from_counts": self.from_counts,
            "provenance": dict(self.provenance),
        }

    def to_control(self) -> Any:
        """The response as `control.FrequencyResponseData` (python-control)."""
        from ..models.conversion import require_control

        return require_control().FrequencyResponseData(self.value, 2.0 * np.pi * self.hertz)

    def plot(
        self,
        ax: Any = None,
        *,
        fit: ShaftFit | None = None,
        file: str | os.PathLike[str] | None = None,
    ) -> Any:
        """Draw gain and phase with their 95 % bands, coherence, and the curve of a fit if given.

        Frequencies with a coherence below a half are drawn pale. Other arguments and result are
        those of `Dataset.plot`.
        """
        return self.drawing(fit).plot(ax, file)

    def drawing(self, fit: ShaftFit | None = None) -> Drawing:
        """The picture."""
        f, size, radius = self.hertz, np.abs(self.value), self.radius()
        seen = self.coherence >= 0.5
        phase = self.phase_deg
        half = np.rad2deg(np.arcsin(np.minimum(radius / np.maximum(size, 1e-300), 1.0)))
        unit = f"{self.y_unit}/{self.u_unit}" if self.y_unit else "1"
        fine = np.geomspace(f[0], f[-1], 1000)
        curve = None if fit is None else fit.at(fine)

        def dots(ax: Axes, values: FloatArray) -> None:
            ax.plot(f[seen], values[seen], ".", ms=3, color=LOOKS["measured"]["color"])
            ax.plot(f[~seen], values[~seen], ".", ms=2, color="0.8", zorder=1)
            ax.set_xscale("log")
            ax.grid(True, which="both", alpha=0.3)

        def gain_panel(ax: Axes) -> None:
            low = 20.0 * np.log10(np.maximum(size - radius, 0.05 * size))
            high = 20.0 * np.log10(size + radius)
            _band(ax, f, low, high, seen)
            dots(ax, self.magnitude_db)
            if curve is not None:
                ax.plot(fine, 20.0 * np.log10(np.abs(curve)), color=LOOKS["model"]["color"], lw=1.0)
            ax.set_ylabel(f"gain [dB re 1 {unit}]")

        def phase_panel(ax: Axes) -> None:
            _band(ax, f, phase - half, phase + half, seen)
            dots(ax, phase)
            if curve is not None:
                turn = np.rad2deg(np.unwrap(np.angle(curve)))
                near = turn[np.abs(fine - f[0]).argmin()] - phase[0]
                turn = turn - 360.0 * round(near / 360.0)
                ax.plot(fine, turn, color=LOOKS["model"]["color"], lw=1.0)
            if seen.any():
                ax.set_ylim(
                    min(phase[seen].min(), -190.0) - 20.0, max(phase[seen].max(), 0.0) + 20.0
                )
            ax.set_ylabel("phase [deg]")

        def coherence_panel(ax: Axes) -> None:
            dots(ax, self.coherence)
            ax.set_ylim(0.0, 1.05)
            ax.set_ylabel("coherence")
            ax.set_xlabel("frequency [Hz]")

        return stacked((gain_panel, phase_panel, coherence_panel), (2.4, 2.0, 1.2))

    def __str__(self) -> str:
        known = self.coherence > 0.95
        best = self.hertz[known]
        span = f"{best[0]:.4g} to {best[-1]:.4g} Hz" if len(best) else "no frequency"
        db = 20.0 * np.log10(1.0 + self.radius() / np.maximum(np.abs(self.value), 1e-300))
        lines = [
            f"frequency response, {len(self.hertz)} lines from {self.hertz[0]:.4g} to "
            f"{self.hertz[-1]:.4g} Hz, {np.median(self.blocks):.0f} blocks",
            f"  coherence  above .95 at {100 * known.mean():.0f} % of them, {span}",
            f"  band       95 %: {np.median(db):.2g} dB in the median, {db.max():.2g} dB at most",
        ]
        if self.noise is not None:
            beyond = np.maximum(self.variance - self.noise, 0.0)
            share = np.sqrt(np.median(beyond / np.maximum(self.variance, 1e-300)))
            lines.append(
                f"  distortion {100 * share:.0f} % of the uncertainty is no noise (in the median)"
            )
        lines += [f"  caution    {text}" for text in self.provenance.get("cautions", ())]
        if "incomplete" in self.provenance:
            lines.append(f"  incomplete {self.provenance['incomplete']}")
        return "\n".join(lines)


def _band(
    ax: Axes, x: FloatArray, low: FloatArray, high: FloatArray, where: NDArray[np.bool_]
) -> None:
    color = LOOKS["measured"]["color"]
    ax.fill_between(x, low, high, where=where, alpha=0.25, lw=0, color=color)


def load_response(path: str | os.PathLike[str]) -> FrequencyResponse:
    """Read a file of `FrequencyResponse.save`.

    Raises
    ------
    ModelFileError
        For any other file.
    """
    stored = storage.read(path, FrequencyResponse.FORMAT, (1, 2))
    return response_of(storage.Fields(str(path), stored))


def response_of(fields: storage.Fields) -> FrequencyResponse:
    """The response of the values of `FrequencyResponse.to_dict`, or a `ModelFileError`."""
    hertz = fields.vector("hertz")
    noise = None if fields.any("noise") is None else fields.vector("noise")
    arrays = {name: fields.vector(name) for name in ("real", "imaginary", "variance", "coherence")}
    Ts = fields.positive("Ts")
    blocks: float | FloatArray
    if isinstance(fields.any("blocks"), list):
        blocks = arrays["blocks"] = fields.vector("blocks")
        if not np.all(blocks > 0.0):
            raise fields.refuse("blocks", "numbers above 0", fields.any("blocks"))
    else:
        blocks = fields.positive("blocks")
    if (
        not len(hertz)
        or np.any(np.diff(hertz) <= 0.0)
        or not 0.0 < hertz[0] <= hertz[-1] <= 0.5 / Ts
    ):
        raise fields.refuse("hertz", "rising frequencies up to half the sample rate", hertz)
    for name, array in {**arrays, **({} if noise is None else {"noise": noise})}.items():
        if array.shape != hertz.shape:
            raise fields.refuse(name, f"{len(hertz)} numbers, one per frequency", len(array))
        if name in ("variance", "noise", "coherence") and array.min() < 0.0:
            raise fields.refuse(name, "numbers of 0 or more", fields.any(name))
    provenance = fields.object("provenance")
    provenance.conform(PROVENANCE)
    return FrequencyResponse(
        hertz, arrays["real"] + 1j * arrays["imaginary"], arrays["variance"], arrays["coherence"],
        blocks, Ts, noise, fields.text("u_unit"), fields.text("y_unit"),
        fields.flag("from_counts"), provenance.values,
    )  # fmt: skip


@dataclass(frozen=True)
class LoopMargins:
    """Margins of a loop known only at some frequencies.

    Attributes
    ----------
    Ms, Ms_hertz : float
        Largest |S|, and its frequency [Hz].
    Ms_band : tuple of (float, float)
        Its 95 % band due to the uncertain response.
    phase_margin_deg : float
        Least rotation of L to -1 where |L| is 1 [deg]; inf if |L| is nowhere 1.
    gain_margin : float
        Least factor above 1 that takes L through -1; inf if there is none.
    crossovers : tuple of float
        Frequencies at which |L| is 1 [Hz].
    """

    Ms: float
    Ms_hertz: float
    Ms_band: tuple[float, float]
    phase_margin_deg: float
    gain_margin: float
    crossovers: tuple[float, ...]

    @classmethod
    def of(cls, hertz: FloatArray, L: Complex, radius: FloatArray) -> LoopMargins:
        """Margins from L at rising frequencies and its radius of uncertainty, all shape (n,)."""
        if len(hertz) < LEAST_LINES:
            raise DataError(
                name="response", expected=f"at least {LEAST_LINES} frequencies for margins",
                received=str(len(hertz)),
            )  # fmt: skip
        # between two lines log magnitude and phase of L are straight lines
        fine = np.interp(np.arange(0, len(hertz) - 1 + 1e-9, 0.1), np.arange(len(hertz)), hertz)
        size = np.interp(fine, hertz, np.log(np.maximum(np.abs(L), 1e-300)))
        turn = np.interp(fine, hertz, np.unwrap(np.angle(L)))
        distance = np.abs(1.0 + np.exp(size + 1j * turn))
        off = np.interp(fine, hertz, radius)
        worst = int(distance.argmin())
        near = np.maximum(distance - off, 1e-12).min()
        crossing = _crossings(fine, size, turn)
        through = _crossings(fine, np.sin(turn), size, np.cos(turn) < 0.0)
        phases = [abs(math.remainder(t + math.pi, 2.0 * math.pi)) for _, t in crossing]
        gains = [math.exp(-s) for _, s in through if s < 0.0]
        return cls(
            Ms=float(1.0 / distance[worst]),
            Ms_hertz=float(fine[worst]),
            Ms_band=(float(1.0 / (distance + off).min()), float(1.0 / near)),
            phase_margin_deg=math.degrees(min(phases, default=math.inf)),
            gain_margin=min(gains, default=math.inf),
            crossovers=tuple(f for f, _ in crossing),
        )

    def __str__(self) -> str:
        low, high = self.Ms_band
        places = ", ".join(f"{f:.4g}" for f in self.crossovers)
        return (
            f"Ms {self.Ms:.3f} ({low:.3f} to {high:.3f}) at {self.Ms_hertz:.4g} Hz, phase margin "
            f"{self.phase_margin_deg:.1f} deg, gain margin {self.gain_margin:.3g}, crossover "
            f"{places + ' Hz' if places else 'nowhere'}"
        )


def _crossings(
    x: FloatArray, zero: FloatArray, value: FloatArray, holds: NDArray[np.bool_] | None = None
) -> list[tuple[float, float]]:
    """Sign changes of `zero` (where `holds`): the position and the value there."""
    at = np.flatnonzero(np.signbit(zero[:-1]) != np.signbit(zero[1:]))
    if holds is not None:
        at = at[holds[at] & holds[at + 1]]
    share = zero[at] / (zero[at] - zero[at + 1])
    return [
        (float(x[k] + s * (x[k + 1] - x[k])), float(value[k] + s * (value[k + 1] - value[k])))
        for k, s in zip(at, share, strict=True)
    ]
