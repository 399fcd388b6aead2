"""`profile`: references that a drive can follow; `Reach`: what its models say that it can do."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from .. import _core
from ..arrays import FloatArray
from ..control.defaults import command_limits, moves_on, recorded_outputs
from ..control.loop import Plants, common_rest, cores_about, each_plant
from ..errors import DataError, FitError, SettingError
from ..gains import real, vector
from ..models import Model
from ..tables import Shown
from ..units import duration

SHARE = 0.9
"""Part of what the models can do that a reference uses: the rest is the feedback's."""
BOUNDS = ("level", "rate", "jerk")


@dataclass(frozen=True, eq=False)
class Reach:
    """What a drive can do, level by level.

    Attributes
    ----------
    low, high : float
        Least and largest level that it reaches [y].
    levels : array, shape (L,)
        Levels [y].
    up, down : array, shape (L,)
        The largest rate at each level in either direction [y/s].
    jerk : float
        The largest change of the rate [y/s^2].
    """

    low: float
    high: float
    levels: FloatArray
    up: FloatArray
    down: FloatArray
    jerk: float

    @classmethod
    def of(
        cls,
        models: Plants,
        *,
        u_min: float | None = None,
        u_max: float | None = None,
        share: float = SHARE,
    ) -> Reach:
        """What all models of a drive can do.

        Each model runs from rest at one limit of the command and back at the other; how fast the
        output passes a level is the rate that is left there, with every limit that the model knows.

        Parameters
        ----------
        models : Model or sequence of them
            Of an ensemble each member counts.
        u_min, u_max : float, optional
            Limits of the command, by default the recorded ones [u].
        share : float
            Part of the rates and the jerk that is used, above 0 to 1.

        Raises
        ------
        SettingError
            For models whose output does not settle, and for limits or a share outside their range.
        FitError
            For a model that does not move both ways under these commands.
        """
        plants = each_plant(models)
        if not 0.0 < real("share", share) <= 1.0:
            raise SettingError(
                name="share", expected="a part above 0, at most 1", received=f"{share:g}"
            )
        low, high, _ = command_limits(plants, u_min, u_max)
        if not plants or any(isinstance(p, Model) and moves_on(p, low, high) for p in plants):
            raise SettingError(
                name="models", expected="models of a speed, or another output that settles",
                received="one that moves on as long as a command acts" if plants else "none",
                remedy="in Python, profile(reference, Ts=, rate=, jerk=) needs no model",
            )  # fmt: skip
        rest = common_rest(plants)
        known = [recorded_outputs(p) for p in plants if isinstance(p, Model)]
        ends = [end for pair in known if pair is not None for end in pair]
        if not ends:
            raise SettingError(
                name="models", expected="a model that stores the outputs it was identified on",
                received="none", remedy="identify it from a record, or give rate and jerk yourself",
            )  # fmt: skip
        span = (min(ends) - rest.y, max(ends) - rest.y)
        found = _core.reach(
            cores_about(rest, plants), Ts=plants[0].Ts,
            u=(low - rest.u[0], high - rest.u[0]), levels=span, share=real("share", share),
        )  # fmt: skip
        least, most, levels, up, down, jerk = found
        return cls(
            least + rest.y, most + rest.y, np.array(levels) + rest.y, np.array(up), np.array(down),
            jerk,
        )  # fmt: skip

    def core(self) -> Any:
        """As the compiled profile takes it."""
        parts = (self.levels.tolist(), self.up.tolist(), self.down.tolist())
        return self.low, self.high, *parts, self.jerk

    def __str__(self) -> str:
        return (
            f"levels {self.low:.4g} to {self.high:.4g}, rates {self.up.min():.4g} to "
            f"{self.up.max():.4g} up and {self.down.min():.4g} to {self.down.max():.4g} down, "
            f"jerk {self.jerk:.4g}"
        )


@dataclass(frozen=True, eq=False)
class Profile(Shown):
    """A reference that a drive can follow.

    Attributes
    ----------
    r : array, shape (N,)
        Its samples [y]; more than those asked for if the last level is met later.
    asked : array, shape (M,)
        What was asked for [y].
    Ts : float
        Sample time [s].
    bounds : tuple of str
        Which bounds acted: ``level``, ``rate``, ``jerk``.
    reach : Reach
        Within which it lies.
    """

    r: FloatArray
    asked: FloatArray
    Ts: float
    bounds: tuple[str, ...]
    reach: Reach

    @property
    def later(self) -> float:
        """By how much it ends later than asked for [s]."""
        return (len(self.r) - len(self.asked)) * self.Ts

    def columns(self) -> dict[str, FloatArray]:
        """t, r, and what was asked for, for a file."""
        t = np.arange(len(self.r)) * self.Ts
        last = np.full(len(self.r) - len(self.asked), self.asked[-1])
        return {"t": t, "r": self.r, "asked": np.append(self.asked, last)}

    def __str__(self) -> str:
        lines = [f"reference of {len(self.r) * self.Ts:g} s within reach: {self.reach}"]
        if not self.bounds:
            return f"{lines[0]}\n  as asked for: no bound acted"
        lines.append(f"  bounds that acted: {', '.join(self.bounds)}")
        off = float(np.max(np.abs(self.columns()["asked"] - self.r)))
        lines.append(f"  up to {off:.4g} from what was asked for")
        if self.later > 0.0:
            lines[-1] += f", {duration(self.later)} longer"
        return "\n".join(lines)


def profile(
    reference: ArrayLike,
    models: Plants | None = None,
    *,
    Ts: float | None = None,
    u_min: float | None = None,
    u_max: float | None = None,
    low: float = -math.inf,
    high: float = math.inf,
    rate: float = math.inf,
    jerk: float = math.inf,
    share: float = SHARE,
) -> Profile:
    """A reference with bounded level, rate and jerk that meets the levels of another in least time.

    Parameters
    ----------
    reference : array, shape (N,)
        What is wanted, steps for example [y].
    models : Model or sequence of them, optional
        The result stays within what these can do (`Reach.of`); without, within the bounds alone.
    Ts : float, optional
        Sample time, by default that of the models [s].
    u_min, u_max : float, optional
        Limits of the command, by default the recorded ones [u].
    low, high : float
        Bounds of the level [y].
    rate, jerk : float
        Bounds of the rate [y/s] and of its change [y/s^2].
    share : float
        Part of what the models can do that is used, above 0 to 1: the rest is the feedback's.

    Returns
    -------
    Profile
        `r` begins where the reference begins, and ends when its last level is met.

    Raises
    ------
    SettingError
        Without models and sample time or bounds, or for values outside their range.
    DataError
        For a reference that is empty or not finite.
    FitError
        For a model that does not move under its limits, a last level that is never met, and bounds
        of the level without the reference's first value.

    Notes
    -----
    For one step with constant bounds it is the S-curve of Biagiotti and Melchiorri, *Trajectory
    Planning for Automatic Machines and Robots*, 2008, chapter 3, sampled.
    """
    r = vector("reference", reference)
    bounds = {"low": low, "high": high, "rate": rate, "jerk": jerk}
    bounds = {name: real(name, value) for name, value in bounds.items()}
    if not (rate > 0.0 and jerk > 0.0 and low <= high):
        raise SettingError(
            name="low, high, rate, jerk", expected="levels in order, rate and jerk above 0",
            received=", ".join(f"{v:g}" for v in bounds.values()), remedy="give inf for none",
        )  # fmt: skip
    if models is None:
        if Ts is None or not (math.isfinite(rate) or math.isfinite(jerk)):
            raise SettingError(
                name="models", expected="models, or Ts and a bound of rate or jerk",
                received="neither", remedy="profile(reference, model), or rate=..., Ts=...",
            )  # fmt: skip
        made = _core.constant_reach(low=low, high=high, rate=rate, jerk=jerk)
        levels, up, down = (np.array(part) for part in made[2:5])
        reach = Reach(made[0], made[1], levels, up, down, made[5])
    else:
        reach = Reach.of(models, u_min=u_min, u_max=u_max, share=share)
        Ts = each_plant(models)[0].Ts if Ts is None else Ts
    least, most = max(low, reach.low), min(high, reach.high)
    if not len(r) or not np.isfinite(r).all():
        raise DataError(
            name="reference", expected="finite samples, at least one",
            received="none" if not len(r) else "some that are not", remedy="fill or cut it",
        )  # fmt: skip
    if not least <= r[0] <= most:
        raise FitError(
            name="reference", expected=f"one that begins between {least:.4g} and {most:.4g}",
            received=f"{r[0]:.4g}", remedy="begin it where the drive stands",
        )  # fmt: skip
    found, acted = _core.profile(r, reach.core(), Ts=real("Ts", Ts), **bounds)
    names = tuple(name for name, did in zip(BOUNDS, acted, strict=True) if did)
    return Profile(found, r.copy(), float(Ts or 0.0), names, reach)
