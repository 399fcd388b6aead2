"""`ResponsesOverSpeed`: the frequency responses of one machine at several speeds."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from .. import storage
from ..arrays import FloatArray
from ..control.controller import Controller
from ..errors import DataError, FitError, SettingError
from ..plotting import Drawing, stacked
from ..tables import Shown
from .response import FrequencyResponse, LoopMargins, response_of
from .shaft import ShaftFit, fit_shaft

if TYPE_CHECKING:
    from matplotlib.axes import Axes


@dataclass(frozen=True, eq=False, repr=False)
class ResponsesOverSpeed(storage.Stored, Shown):
    """Frequency responses at several working speeds; iterating gives the responses.

    Attributes
    ----------
    responses : mapping from float to FrequencyResponse
        Responses by working speed [RPM], rising.
    refused : mapping from float to str
        Speeds without a response, and why.
    """

    FORMAT: ClassVar[str] = "sewfast-frequency-responses"
    VERSION: ClassVar[int] = 1

    responses: Mapping[float, FrequencyResponse]
    refused: Mapping[float, str] = field(default_factory=dict)

    @property
    def speeds(self) -> tuple[float, ...]:
        """Speeds with a response [RPM]."""
        return tuple(self.responses)

    def __len__(self) -> int:
        return len(self.responses)

    def __iter__(self) -> Iterator[FrequencyResponse]:
        return iter(self.responses.values())

    def __getitem__(self, speed: float) -> FrequencyResponse:
        if speed not in self.responses:
            raise SettingError(
                name="speed",
                expected=f"one of {', '.join(f'{s:g}' for s in self.speeds)} RPM, which were "
                "measured",
                received=repr(speed),
            )  # fmt: skip
        return self.responses[speed]

    @cached_property
    def fits(self) -> Mapping[float, ShaftFit]:
        """Results of `fit_shaft`, without the responses that it refuses."""
        found = {}
        for speed, response in self.responses.items():
            try:
                found[speed] = fit_shaft(response)
            except (DataError, FitError):
                continue
        return found

    def margins(self, controller: Controller) -> Mapping[float, LoopMargins]:
        """Margins of the loop at each speed, with the controller's scheduled gains there."""
        return {s: r.margins(controller, speed=s) for s, r in self.responses.items()}

    # --- Files, pictures --------------------------------------------------------------------------

    def to_dict(self) -> dict[str, Any]:
        """Everything by name, as JSON values."""
        return {
            "speeds": list(self.speeds),
            "responses": [r.to_dict() for r in self],
            "refused": [[speed, why] for speed, why in self.refused.items()],
        }

    def plot(self, ax: Any = None, *, file: str | os.PathLike[str] | None = None) -> Any:
        """Draw gain and phase at all speeds in one panel each, and the coherence.

        Frequencies with a coherence below a half are left out; the phase is drawn between -270 and
        90 degrees. Other arguments and result are those of `Dataset.plot`.
        """
        return self.drawing().plot(ax, file)

    def drawing(self) -> Drawing:
        """The picture."""
        first = next(iter(self))
        unit = f"{first.y_unit}/{first.u_unit}" if first.y_unit else "1"
        shades = np.linspace(0.05, 0.85, len(self))

        def lines(ax: Axes, of: Any, label: str) -> None:
            from matplotlib import colormaps

            for shade, (speed, r) in zip(shades, self.responses.items(), strict=True):
                seen = np.where(r.coherence >= 0.5, of(r), np.nan)
                color = colormaps["viridis"](shade)
                ax.plot(r.hertz, seen, ".-", ms=3, lw=0.8, color=color, label=f"{speed:g} RPM")
            ax.set_xscale("log")
            ax.grid(True, which="both", alpha=0.3)
            ax.set_ylabel(label)

        def coherence(ax: Axes) -> None:
            lines(ax, lambda r: r.coherence, "coherence")
            ax.set_ylim(0.0, 1.05)
            ax.set_xlabel("frequency [Hz]")

        def turned(r: FrequencyResponse) -> FloatArray:
            # unwrapping over incoherent lines would add random turns
            return 90.0 - np.mod(90.0 - np.rad2deg(np.angle(r.value)), 360.0)

        panels = (
            lambda ax: lines(ax, lambda r: r.magnitude_db, f"gain [dB re 1 {unit}]"),
            lambda ax: lines(ax, turned, "phase [deg]"),
            coherence,
        )
        return stacked(panels, (2.4, 2.0, 1.2), legend=min(len(self), 6))

    def __str__(self) -> str:
        lines = [
            f"frequency responses at {len(self)} speeds",
            f"  {'RPM':>8}  {'gain':>8}  {'resonance':>12}  {'damping':>8}  coherence above .95",
        ]
        for speed, r in self.responses.items():
            fit = self.fits.get(speed)
            gain = swings = damping = "-"
            if fit is not None:
                gain = f"{fit.parameters['gain'].value:.4g}"
                if fit.has_resonance:
                    swings = f"{fit.parameters['resonance_hertz'].value:.4g} Hz"
                    damping = f"{fit.parameters['resonance_damping'].value:.3g}"
                else:
                    swings = "rigid"
            share = 100.0 * float((r.coherence > 0.95).mean())
            lines.append(f"  {speed:>8g}  {gain:>8}  {swings:>12}  {damping:>8}  {share:.0f} %")
        lines += [f"  {speed:>8g}  {why}" for speed, why in self.refused.items()]
        return "\n".join(lines)


def load_responses(path: str | os.PathLike[str]) -> ResponsesOverSpeed:
    """Read a file of `ResponsesOverSpeed.save`.

    Raises
    ------
    ModelFileError
        For any other file.
    """
    of = ResponsesOverSpeed
    fields = storage.Fields(str(path), storage.read(path, of.FORMAT, (of.VERSION,)))
    speeds, inner = fields.vector("speeds"), fields.objects("responses")
    if not inner or np.any(np.diff(speeds) <= 0.0):
        raise fields.refuse("speeds", "rising speeds", speeds)
    if len(inner) != len(speeds):
        raise fields.refuse("responses", f"{len(speeds)} responses, one per speed", len(inner))
    refused = fields.any("refused")
    if not isinstance(refused, list) or not all(
        isinstance(x, list) and len(x) == 2 and isinstance(x[0], (int, float))
        and isinstance(x[1], str) for x in refused
    ):  # fmt: skip
        raise fields.refuse("refused", "pairs of a speed and a reason", refused)
    found = {float(speed): response_of(part) for speed, part in zip(speeds, inner, strict=True)}
    return of(found, {float(s): why for s, why in refused})
