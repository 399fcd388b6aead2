"""`Cost`: what a run costs, as a weighted sum of terms in the units of the field."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING

import numpy as np

from . import _core
from .errors import DataError, SettingError
from .gains import real

if TYPE_CHECKING:
    from .control.loop import ClosedLoopRun

SHARES = ("chatter", "overshoot", "saturation")
"""Weights whose default depends on the references' span."""


@dataclass(frozen=True)
class Cost:
    """Weights of the terms of a run (docs/CONVENTIONS.md, Tuning); the sum is in the output's unit.

    A weight is per unit of its term. None is the default in shares of the references' span R (the
    largest minus the smallest value).

    Parameters
    ----------
    tracking : float
        Of rms(r - y) [y], y the true output.
    chatter : float or None
        Of rms(du) [u], du the command's change from sample to sample; .5 R/(u_max - u_min).
    effort : float
        Of rms(u) [u].
    overshoot : float or None
        Of the overshoot above its limit [%], where the reference is a step or trapezoid; R/100.
    overshoot_limit : float
        Overshoot that costs nothing [%].
    rise : float
        Of the 10-to-90 % rise time beyond the reference's own [ms], on a step or trapezoid.
    lag : float
        Of the shift of the output against the reference with the least rms difference [ms].
    saturation : float or None
        Of the share of samples at a limit; .02 R.
    recovery : float
        Of the time until a load step is fought down [ms] (`LoadStep`), the mean over these.
    load : float
        Of the rms deviation under a load step [y].

    Raises
    ------
    SettingError
        For a weight that is not a finite number of 0 or more.
    """

    tracking: float = 1.0
    chatter: float | None = None
    effort: float = 0.0
    overshoot: float | None = None
    overshoot_limit: float = 1.0
    rise: float = 0.0
    lag: float = 0.0
    saturation: float | None = None
    recovery: float = 0.0
    load: float = 0.0

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            if value is None and field.name in SHARES:
                continue
            weight = real(field.name, value)
            if not (weight >= 0.0 and np.isfinite(weight)):
                raise SettingError(
                    f"expected a finite weight of 0 or more for {field.name}, got {value!r}"
                )
            object.__setattr__(self, field.name, weight)

    def named(self) -> dict[str, float]:
        """The weights that are numbers, by name."""
        values = {field.name: getattr(self, field.name) for field in fields(self)}
        return {name: value for name, value in values.items() if value is not None}

    def resolved(self, span: float, u_range: float) -> Cost:
        """The same with numbers in place of None, for references of this span and limits of u this
        far apart.
        """
        shares = {
            "chatter": 0.5 * span / u_range,
            "overshoot": span / 100.0,
            "saturation": 0.02 * span,
        }
        return Cost(**(shares | self.named()))

    def of(self, runs: ClosedLoopRun | Sequence[ClosedLoopRun]) -> float:
        """What runs cost: the mean over them, as in `sewfast.tune` over references.

        Runs along references are meant: recovery and load do not count.

        Raises
        ------
        DataError
            Where there is no run, or what is none, or one has samples missing.
        """
        from .control.loop import ClosedLoopRun

        several = list(runs) if isinstance(runs, Sequence) else [runs]
        for one in several:
            if not isinstance(one, ClosedLoopRun):
                raise DataError(
                    f"expected closed-loop runs to take the cost of, got {type(one).__name__}; "
                    "run(controller, plant, reference) gives one"
                )
        if not several:
            raise DataError("expected at least one run to take the cost of, got none")
        r = np.concatenate([run.r for run in several])
        limits = several[0].controller
        cost = self.resolved(float(np.ptp(r)), limits.u_max - limits.u_min)
        return float(np.mean([cost._of(terms(run)) for run in several]))

    def _of(self, terms: dict[str, float]) -> float:
        above = {**terms, "overshoot": max(terms["overshoot"] - self.overshoot_limit, 0.0)}
        weights = self.named()
        return sum(weights[name] * value for name, value in above.items() if name in weights)


def terms(run: ClosedLoopRun) -> dict[str, float]:
    """What a run was like: tracking [y], chatter and effort [u], overshoot [%], rise and lag [ms],
    saturation (a share), u_max (largest \\|u\\|) [u].

    Overshoot and rise are 0 where the reference is no step or trapezoid; where the response does
    not reach 90 %, rise is the whole time that it had.

    Raises
    ------
    DataError
        Where samples are missing.
    """
    limits = run.controller
    return _core.cost_terms(
        run.r, run.u, run.y, u_min=limits.u_min, u_max=limits.u_max, Ts=limits.Ts
    )
