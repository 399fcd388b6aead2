"""The objective of a search: cost of a run, constraints, load steps."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any, cast

import numpy as np

from .. import _core
from ..control.controller import Controller
from ..control.loop import ClosedLoopRun
from ..dataset import FloatArray
from ..errors import DataError, SettingError
from ..gains import real

SHARES = ("chatter", "overshoot", "saturation")
"""Weights whose default depends on the references' span."""


@dataclass(frozen=True)
class Cost:
    """Weights of the terms of a run (docs/CONVENTIONS.md, Tuning); the sum is in the output's unit.

    A weight is per unit of its term. None is the default, given below in terms of the references'
    span R (the largest minus the smallest value).

    Parameters
    ----------
    tracking : float
        Weight of rms(r - y) [y], y the true output.
    chatter : float or None
        Weight of rms(du) [u], du the command's change from sample to sample; .5 R/(u_max - u_min).
    effort : float
        Weight of rms(u) [u].
    overshoot : float or None
        Weight of the overshoot above its limit [%] on a step or trapezoid; R/100.
    overshoot_limit : float
        Overshoot about which its cost begins, gradually within a tenth of it [%].
    rise : float
        Weight of the 10-to-90 % rise time beyond the reference's own [ms], on a step or trapezoid.
    lag : float
        Weight of the shift of the output against the reference with the least rms difference [ms].
    saturation : float or None
        Weight of the share of samples at a limit; .02 R.
    recovery : float
        Weight of the recovery time from a load step [ms] (`LoadStep`), the mean over these.
    load : float
        Weight of the rms deviation under a load step [y].

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

    def of(self, runs: ClosedLoopRun | Sequence[ClosedLoopRun]) -> float:
        """The cost of runs: the mean over them, as in `sewfast.tune` over references.

        Recovery and load do not count, as the runs are along references.

        Raises
        ------
        DataError
            Without a run, for anything but runs, and for a run with missing samples.
        """
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
        span, command = float(np.ptp(r)), limits.u_max - limits.u_min
        costs = [
            _core.run_cost(self.named(), terms(run), span=span, command=command) for run in several
        ]
        return float(np.mean(costs))


def terms(run: ClosedLoopRun) -> dict[str, float]:
    """The terms of a run's cost: tracking [y], chatter and effort [u], overshoot [%], rise and lag
    [ms], saturation (a share), u_max (largest \\|u\\|) [u]. Overshoot and rise are 0 unless the
    reference is a step or trapezoid; if the response does not reach 90 %, rise is the whole time
    available. Raises `DataError` if samples are missing.
    """
    limits = run.controller
    return _core.cost_terms(
        run.r, run.u, run.y, u_min=limits.u_min, u_max=limits.u_max, Ts=limits.Ts
    )


# --- Constraints ----------------------------------------------------------------------------------


LARGEST_MS = 1.8
"""Limit of Ms if none is given: a gain margin of 2.25 and a phase margin of 32 degrees for sure.
Without one the search goes as close to instability as calm references allow: to 2.6 to 3.7 with
seeds 0 to 2 on the linear model of docs/reading-margins.md. Commissioned with it, the virtual
machine costs 5.72 RPM; with 2 it costs 5.71."""


@dataclass(frozen=True)
class Constraints:
    """Limits that come before the cost (docs/CONVENTIONS.md, Tuning).

    A controller within all limits is better than one that violates any; of two that violate limits,
    the one with the smaller sum of relative violations is better.

    Parameters
    ----------
    Ms : float, optional
        Largest sensitivity of the linear loop (`sewfast.margins`), 1.4 to 2 for a robust one; with
        a gain schedule at each of its points. By default `LARGEST_MS`, which gives way if no
        controller keeps to it; inf for no limit.
    overshoot : float, optional
        Largest overshoot on steps and trapezoids [%], on every plant.
    u : float, optional
        Largest \\|u\\| in every run [u].
    recovery : float or Controller, optional
        Longest recovery from any load step, on every plant in every variation [ms]. A controller
        stands for its own recovery on each plant, at least one sample: no plant may recover later
        than with it. This is judged on the unchanged plant, or in every variation if none leaves it
        unchanged.
    load : float or Controller, optional
        Largest rms deviation under any load step [y], likewise.
    plant : linear plant or list of them, optional
        The plants for Ms: anything that `sewfast.margins` accepts. A `FrequencyResponse` next to
        one of these counts with its bands: Ms is the largest that they allow. By default the models
        used for tuning.
    speed : float, optional
        Output at which nonlinear models are linearised [y]; by default at a tenth,
        half and nine tenths of the references.

    Raises
    ------
    SettingError
        For a limit that is not finite and above 0, or Ms not above 1.
    """

    Ms: float | None = None
    overshoot: float | None = None
    u: float | None = None
    recovery: float | Controller | None = None
    load: float | Controller | None = None
    plant: Any = None
    speed: float | None = None

    def __post_init__(self) -> None:
        for name in LIMITS:
            value, least = getattr(self, name), 1.0 if name == "Ms" else 0.0
            if value is None or (name in BY_RIVAL and isinstance(value, Controller)):
                continue
            limit = real(name, value)
            if not (limit > least and (math.isfinite(limit) or name == "Ms")):
                raise SettingError(
                    f"expected a finite limit above {least:g} for {name}, got {value!r}"
                )
            object.__setattr__(self, name, limit)
        if self.speed is not None:
            object.__setattr__(self, "speed", real("speed", self.speed))

    @property
    def limits_Ms(self) -> bool:
        """Whether there is a limit of Ms."""
        return self.Ms is not None and math.isfinite(self.Ms)

    @property
    def limits(self) -> _core._Limits:
        """The limits by name, for the core."""
        values = {name: getattr(self, name) for name in LIMITS}
        cores = {n: v.core() if isinstance(v, Controller) else v for n, v in values.items()}
        if not self.limits_Ms:
            cores["Ms"] = None
        return cast("_core._Limits", cores)

    def __str__(self) -> str:
        given = {n: getattr(self, n) for n in LIMITS if getattr(self, n) is not None}
        return ", ".join(_described(n, v) for n, v in given.items()) or "none"


LIMITS = {"Ms": "", "overshoot": " %", "u": "", "recovery": " ms", "load": ""}
"""Every limit with its unit."""
BY_RIVAL = ("recovery", "load")


def _described(name: str, limit: float | Controller) -> str:
    if isinstance(limit, Controller):
        return f"{name} no larger than under {limit.notes or 'another controller'}"
    if math.isinf(limit):
        return f"{name} not limited"
    return f"{name} <= {limit:g}{LIMITS[name]}"


# --- LoadStep: a disturbance while a level is held ------------------------------------------------


MOST_SAMPLES = 10_000_000
"""Most samples of a load step, which every candidate runs."""


@dataclass(frozen=True)
class LoadStep:
    """A level is approached and held; then a command unknown to the controller is added.

    It acts like a load on the shaft: a motor's torque corresponds to the voltage given by its
    current times resistance (docs/tuning.md). The run's recovery [ms] is the last time after it
    that the true output, in the mean of the last `mean` seconds, is farther than `band` from the
    level; its load is the rms of that deviation from then on [y].

    Parameters
    ----------
    level : float
        The held level [y].
    disturbance : float
        Added to the command after its limits [u]; a braking one has the opposite sign.
    band : float, optional
        Band of recovery [y]; a hundredth of the level by default.
    ramp, settle, look : float
        Duration of the rise to the level, of the hold before the load, and of the load [s].
    mean : float
        Duration of the moving mean of the deviation [s]: one turn if a load varies over it, 0 for
        none.

    Raises
    ------
    SettingError
        For values that are not finite, no disturbance, times below 0 or no time under load.
    """

    level: float
    disturbance: float
    band: float | None = None
    ramp: float = 0.3
    settle: float = 0.5
    look: float = 0.5
    mean: float = 0.0

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            if field.name == "band" and value is None:
                # default band of recovery as a share of the level
                value = 0.01 * abs(real("level", self.level))
            number = real(field.name, value)
            least = -math.inf if field.name in ("level", "disturbance") else 0.0
            if not (math.isfinite(number) and number >= least):
                raise SettingError(
                    f"expected a finite {field.name} of a load step"
                    + ("" if math.isinf(least) else " of 0 or more")
                    + f", got {value!r}"
                )
            object.__setattr__(self, field.name, number)
        for name in ("disturbance", "band", "look"):
            if getattr(self, name) == 0.0:
                raise SettingError(f"expected a {name} of a load step other than 0, got 0")

    def samples(self, Ts: float, rest: float = 0.0) -> tuple[FloatArray, FloatArray, float, int]:
        """Reference as a deviation from rest [y], disturbance [u], band [y], samples of the mean.

        Raises
        ------
        SettingError
            For more than `MOST_SAMPLES`.
        """
        lasts = self.ramp + self.settle + self.look + self.mean
        if not lasts / Ts <= MOST_SAMPLES:
            raise SettingError(
                name="load step", expected=f"up to {MOST_SAMPLES * Ts:g} s with its mean",
                received=f"{lasts:g} s", remedy="shorten ramp, settle, look or mean",
            )  # fmt: skip
        on = round((self.ramp + self.settle) / Ts)
        k = np.arange(on + max(1, round(self.look / Ts)))
        share = np.minimum(1.0, k * Ts / self.ramp) if self.ramp > 0.0 else np.ones(len(k))
        assert self.band is not None
        return (
            (self.level - rest) * share,
            np.where(k < on, 0.0, self.disturbance),
            self.band,
            max(1, round(self.mean / Ts)),
        )
