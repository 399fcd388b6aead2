"""Defaults for a drive: limits, feedback filter and references.

They come from the model and the data stored with it: the ranges of input and output, the sample
time, and the step response. The catalogue of `sewfast.signals` is made for one drive, in RPM at
1 ms; here its shapes are scaled to any other.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np

from .. import _core, signals
from ..arrays import limits_about, on_grid
from ..dataset import FloatArray
from ..errors import DataError, FitError, SettingError
from ..evidence.operating import INTEGRATES, integrating_pole
from ..evidence.region import stored_region
from ..gains import real
from ..models import Model
from ..models.linear import LinearDifference
from ..rules import Fopdt, fit_fopdt
from ..units import spelled
from ..validation import largest_pole
from .controller import SampledController

NAMES = ("trapezoid", "trapezoids", "random")
"""Default references for tuning."""
_STEP_SHARES = (0.25, 0.5, 0.1)
"""Sizes of the step response to try, as shares of the larger limit."""
_STEP_SAMPLES = (4_000, 16_000)
_UNSETTLED = (
    "identify it again with --detrend 1 if the record drifts (detrend(1) in Python), or give a "
    "controller to start from"
)
"""What to do about a model with no step response that settles: a pole at 1 follows a drift."""
_RECORDED = 0.9
"""Top of the references as a share of the recorded output, beyond which the model extrapolates."""
_HELD_UNSTABLE = 0.3
"""Top of the references as a share of the output that an unstable plant can be held at with the
least of the commands' limits: beyond it nothing brings the plant back."""
_EDGES = 8
"""Edges of a shortened random reference."""


def recorded_limits(models: Sequence[Any]) -> tuple[float, float] | None:
    """Least and largest command that the models were identified on, and at rest; None if unknown.
    A controller must be able to give the command of a plant at rest: 0, unless the record shows
    another by standing still.
    """
    known = [r[0] for m in models if isinstance(m, Model) for r in _stored(m, "input_range")]
    ends = [float(end) for pair in known for end in pair]
    if not ends or not np.isfinite(ends).all() or not any(ends):
        return None
    rests = [m.rest for m in models if isinstance(m, Model)]
    ends += [r.u[0] if r.source == "standing samples" else 0.0 for r in rests]
    return min(ends), max(ends)


def _stored(model: Model, name: str) -> list[Any]:
    """A range of the training data stored in a model, or in the members of an ensemble."""
    own = model.training.get(name)
    return [own] if own else [m.training[name] for m in model.members if m.training.get(name)]


def _output_range(model: Model) -> tuple[float, float] | None:
    """Least and largest recorded output [y]; None if unknown."""
    ends = [float(end) for pair in _stored(model, "output_range") for end in pair]
    return (min(ends), max(ends)) if ends and np.isfinite(ends).all() else None


def recorded_outputs(model: Model) -> tuple[float, float] | None:
    """Least and largest output that a model was identified on, and at rest [y]; None if unknown."""
    known, rest = _output_range(model), model.rest.y
    return None if known is None else (min(known[0], rest), max(known[1], rest))


def command_limits(
    models: Sequence[Any], u_min: float | None, u_max: float | None
) -> tuple[float, float, str]:
    """Limits of the command [u], as given or as recorded, and a note on them.
    Raises `SettingError` if one is not given and the models do not store the range of their inputs:
    a limit must not be guessed.
    """
    recorded = recorded_limits(models)
    missing = [name for name, value in (("u_min", u_min), ("u_max", u_max)) if value is None]
    if missing and recorded is None:
        raise SettingError(
            name=" and ".join(missing),
            expected="the limits of the command that the drive can take (--u-min, --u-max)",
            received="none, and the model does not store the range of its training inputs",
            remedy="give them",
        )  # fmt: skip
    low = recorded[0] if u_min is None and recorded else real("u_min", u_min)
    high = recorded[1] if u_max is None and recorded else real("u_max", u_max)
    if missing:
        return low, high, f"{' and '.join(missing)} from the recorded input"
    return low, high, beyond_record(models, low, high)


def beyond_record(models: Sequence[Any], u_min: float, u_max: float) -> str:
    """A note on limits beyond the recorded input; empty otherwise."""
    recorded = recorded_limits(models)
    if recorded is None:
        return ""
    room = 1e-6 * (recorded[1] - recorded[0])
    if u_min >= recorded[0] - room and u_max <= recorded[1] + room:
        return ""
    return f"limits beyond the recorded input of {recorded[0]:g} to {recorded[1]:g}"


def filter_length(Ts: float, time_constant: float) -> int:
    """Samples of the feedback's mean: 8 ms, at most a tenth of the time constant, at least one."""
    # 8 ms for a slow drive, at most a tenth of the time constant
    wanted = min(0.008, 0.1 * time_constant) / Ts
    # of at most 64 samples, as the core has them
    return int(min(max(1, round(wanted)), 64))


@dataclass(frozen=True)
class DriveStep:
    """A model's step response from rest: first order with dead time, the output `rest` at the
    command of rest [y], and the dominant time constant `slowest` [s]. For a response with
    overshoot, the latter is a third of the time until it stays within 5 %.
    """

    fopdt: Fopdt
    rest: float
    slowest: float


def require_one_input(model: Model) -> None:
    """Refuse a model with several inputs."""
    if len(model.input_names) != 1:
        raise SettingError(
            name="model", expected="one input to tune on", received=str(len(model.input_names)),
            remedy="identify it from the command alone",
        )  # fmt: skip


# the start of a search, its default references and its verdict need it, of every member
@lru_cache(maxsize=32)
def drive_step(model: Model, u_min: float, u_max: float) -> DriveStep:
    """The step response at the first size and length at which it settles. Raises `FitError` if no
    step settles, `SettingError` for several inputs or limits that are not finite or both 0.
    """
    require_one_input(model)
    size, about = _known_step(model, u_min, u_max), model.rest
    if not np.isfinite(size) or size == 0.0:
        raise SettingError(
            name="u_min, u_max",
            expected=f"finite limits of the command, not both {about.u[0]:g}, to size a step by",
            received=f"{u_min} and {u_max}", remedy="give the amplifier's limits",
        )  # fmt: skip
    reason: Exception | None = None
    for u, at in _steps(size):
        try:
            y = _from_rest(model, u)
            fopdt = fit_fopdt(u, y, Ts=model.Ts)
        except (DataError, FitError) as error:
            reason = error
            continue
        slowest = _slowest(fopdt, y[at:], model.Ts)
        return DriveStep(_raised(fopdt, about.u[0], about.y), float(y[at - 1]) + about.y, slowest)
    raise FitError(
        name="model", expected="one whose step response settles",
        received=f"none up to u = {about.u[0] + max(_STEP_SHARES) * size:g} ({reason})",
        remedy=_UNSETTLED,
    ) from reason  # fmt: skip


@lru_cache(maxsize=32)
def rate_step(model: Model, u_min: float, u_max: float) -> DriveStep | None:
    """The step response of the output's rate [y/s], for a model that integrates; None for others.
    A position keeps moving as long as the command acts; its rate settles. Raises `FitError` if the
    rate settles after no step.
    """
    size = _largest_step(model, u_min, u_max)
    pole = integrating_pole(model)
    if pole is None or not _moves_on(model, _STEP_SHARES[0] * size):
        return None
    reason: Exception | None = None
    for u, _ in _steps(size):
        y = _from_rest(model, u)
        try:
            # exclude the decay of a pole slightly below 1 from the rate
            rate = (y[1:] - y[0] - pole * (y[:-1] - y[0])) / model.Ts
            fopdt = fit_fopdt(u[1:], rate, Ts=model.Ts)
        except (DataError, FitError) as error:
            reason = error
            continue
        fopdt = _raised(fopdt, model.rest.u[0], 0.0)
        return DriveStep(fopdt, float(y[0]) + model.rest.y, fopdt.T)
    raise FitError(
        name="model", expected="one that integrates its input and whose rate settles after a step",
        received=f"none up to u = {model.rest.u[0] + max(_STEP_SHARES) * size:g} ({reason})",
        remedy=_UNSETTLED,
    ) from reason  # fmt: skip


def _largest_step(model: Model, u_min: float, u_max: float) -> float:
    """The larger of the two changes of the command from rest to its limits [u]."""
    down, up = limits_about(u_min, u_max, model.rest.u[0])
    return up if up >= -down else down


def _known_step(model: Model, u_min: float, u_max: float) -> float:
    """As `_largest_step`, but the other way if the model is lost that way: the output leaves the
    recorded ones, or moves the same way under both commands, and less. A network of a drive that
    was recorded in one direction has any sign in the other.
    """
    size = _largest_step(model, u_min, u_max)
    down, up = limits_about(u_min, u_max, model.rest.u[0])
    other = down if size == up else up
    known = recorded_outputs(model)
    if not (math.isfinite(size) and math.isfinite(other)) or size * other >= 0.0 or known is None:
        return size
    (ours, theirs), margin = _moved(model, (size, other)), 0.1 * (known[1] - known[0])
    low, high = known[0] - margin - model.rest.y, known[1] + margin - model.rest.y
    inside = [low <= y <= high for y in (ours, theirs)]
    is_lost = inside == [False, True] or (ours * theirs > 0.0 and abs(theirs) > abs(ours))
    return other if is_lost else size


def _moved(model: Model, sizes: Sequence[float]) -> tuple[float, ...]:
    """Changes of the output after the first of the steps of each size [y]."""
    first = [next(_steps(size))[0] for size in sizes]
    return tuple(float(_from_rest(model, u)[-1]) for u in first)


def _from_rest(model: Model, u: FloatArray) -> FloatArray:
    """Changes of the output from rest in the free run under changes of the command [u], shape (N,).
    Levels are added to what is found of them: beside one, numbers lose digits.
    """
    core = model.about_rest
    y: FloatArray = core.simulate(u[:, None], core.rest_state())
    return y


def _raised(fopdt: Fopdt, u: float, y: float) -> Fopdt:
    """What was fitted to deviations from a level of command and output, of the values."""
    return replace(
        fopdt, u_low=fopdt.u_low + u, u_high=fopdt.u_high + u,
        offset=fopdt.offset + y - fopdt.K * u,
    )  # fmt: skip


def _steps(size: float) -> Iterator[tuple[FloatArray, int]]:
    """Changes of the command with a step, and its sample: small to large, short to long."""
    for share in _STEP_SHARES:
        for samples in _STEP_SAMPLES:
            u = np.zeros(samples)
            u[samples // 20 :] = share * size
            yield u, samples // 20


def _slowest(fopdt: Fopdt, y: FloatArray, Ts: float) -> float:
    if not fopdt.overshoot_percent:
        return fopdt.T
    outside = np.flatnonzero(np.abs(y - y[-1]) > 0.05 * abs(y[-1] - y[0]))
    return max(fopdt.T, (int(outside[-1]) + 1) * Ts / 3.0 if len(outside) else 0.0)


def growth_rate(model: Model) -> float:
    """The rate at which an unstable linear model leaves its rest [1/s]; 0 for others."""
    largest = largest_pole(model)
    # an integrator's pole is 1 but for its estimate
    return math.log(largest) / model.Ts if largest > 1.0 + INTEGRATES else 0.0


def moves_on(model: Model, u_min: float, u_max: float) -> bool:
    """Whether the output keeps moving as long as a command acts, so that no step settles."""
    size = _largest_step(model, u_min, u_max)
    return (
        bool(np.isfinite(size))
        and integrating_pole(model) is not None
        and _moves_on(model, _STEP_SHARES[0] * size)
    )


def _moves_on(model: Model, size: float) -> bool:
    """Whether a long step moves on: a pole at 1 that a zero nearly cancels does not."""
    samples = _STEP_SAMPLES[-1]
    u = np.zeros(samples)
    # after some samples, as the model's rest state assumes the first command before the start
    u[samples // 20 :] = size
    y = _from_rest(model, u)
    # share of a step's response in the second half of the longest one, above which the output
    # integrates: a lag that settles in time has less there, so every model is one or the other
    return bool(abs(y[-1] - y[samples // 2]) > 0.15 * abs(y[-1] - y[0]))


@dataclass(frozen=True)
class _Span:
    """Levels of the references [y], and the time of their fastest edge [s]."""

    rest: float
    low: float
    top: float
    other: float
    edge: float


def catalogue_fits(model: Any, u_min: float, u_max: float, unit: str) -> bool:
    """Whether `sewfast.signals` suit a drive's unit, sample time and range, if that is known."""
    if spelled(unit) != "rpm" or not math.isclose(model.Ts, signals.TS, rel_tol=1e-9):
        return False
    known = _output_range(model) if isinstance(model, Model) else None
    if known is None:
        return True
    if not model.rest.is_standstill:
        return False  # the catalogue begins at a standstill
    try:
        fopdt = drive_step(model, u_min, u_max).fopdt
    except (FitError, SettingError):
        return True
    # the steepest edge of the catalogue is that of the trapezoid
    top, rate = 3000.0, 3000.0 / 0.15
    needed = (top + fopdt.T * rate - fopdt.offset) / fopdt.K
    return bool(known[1] >= top and u_min <= needed <= u_max)


def drive_references(
    model: Model, u_min: float, u_max: float, *, pace: float | None = None, seed: int = 0
) -> dict[str, FloatArray]:
    """The shapes of the catalogue of references over a drive's own range, at its own pace.

    The top is .9 of the recorded output or .7 of the steady output at the limit of the command,
    whichever is less. The fastest edge uses the rest of the command, and takes at least half a time
    constant and ten dead times. If the command cannot brake (limits on one side of 0), the
    references stay above .3 of the top and within the model's training region, and fall no faster
    than the drive coasts. If the record has both directions, `random` has both, too.

    Parameters
    ----------
    model : Model
        With one input.
    u_min, u_max : float
        Limits of the command [u].
    pace : float, optional
        Time constant for a model whose step response does not settle [s].
    seed : int
        Chooses the random levels.

    Returns
    -------
    dict of str to array, shape (N,)
        `trapezoid`, `chirp_hi_lo`, `chirp_lo_hi`, `random`, `trapezoids` at the model's sample
        time, and `step`, which the catalogue has not, from rest to their top [y].

    Raises
    ------
    SettingError, FitError
        If the model has neither a step response that settles nor a stored range of its record.
    """
    made, rest = _shapes(_span(model, u_min, u_max, pace), model.Ts, seed), model.rest.y
    # on the grid on which a search has them
    return {n: rest + on_grid(r - rest, float(np.ptp(r))) for n, r in made.items()}


def _span(model: Model, u_min: float, u_max: float, pace: float | None) -> _Span:
    # top of the references as a share of the steady output at the limit: the rest accelerates
    reached = 0.7
    # share of the output at the limit that the ramps leave to the controller
    margin = 0.1
    u_min, u_max = _finite_limits(model, u_min, u_max)
    low, high = _output_range(model) or (-math.inf, math.inf)
    moving = rate_step(model, u_min, u_max)
    if moving is not None and math.isfinite(high - low):
        return _way(moving, u_min, u_max, low, high, model.Ts)
    try:
        step = drive_step(model, u_min, u_max)
    except FitError:
        if pace is None or not math.isfinite(high - low):
            raise
        rest = model.rest.y
        way = high - rest if abs(high - rest) >= abs(low - rest) else low - rest
        # the command that holds a level is known of linear models only: else the record is all
        gain = math.inf
        if isinstance(model, LinearDifference) and growth_rate(model):
            gain = abs(model.dc_gain[0])
        room = min(u_max - model.rest.u[0], model.rest.u[0] - u_min)
        top = math.copysign(min(_RECORDED * abs(way), _HELD_UNSTABLE * gain * room), way)
        return _Span(rest, rest, rest + top, rest, 4.0 * pace)
    fopdt, rest = step.fopdt, step.rest
    levels = [fopdt.K * u + fopdt.offset for u in (u_min, u_max)]
    if min(*levels, rest) <= model.rest.y <= max(*levels, rest):
        rest = model.rest.y  # where the plant was seen to rest, whatever offset the model has there
    reach = [level - rest for level in levels]
    up = max(0.0, min(_RECORDED * (high - rest), reached * max(reach)))
    down = max(0.0, min(_RECORDED * (rest - low), reached * -min(reach)))
    sign, x, other = (1.0, up, down) if up >= down else (-1.0, down, up)
    if x == 0.0:
        raise SettingError(
            name="u_min, u_max", expected="limits that move the drive within its recorded range",
            received=f"{u_min:g} to {u_max:g}",
            remedy="give wider ones, or the references as samples",
        )  # fmt: skip
    strong, weak = (max(reach), -min(reach)) if sign > 0 else (-min(reach), max(reach))
    slow = 0.0
    if weak <= 0.25 * x:
        # lowest level as a share of the top for a drive that cannot brake: it coasts down to that
        slow = max(0.3 * x, _lowest_held(model, fopdt, rest, sign))
    # for a record that never came near rest: not below its lowest output
    floor = (low - rest if sign > 0 else rest - high) + 0.1 * (high - low)
    slow = min(max(slow, floor), 0.6 * x) if math.isfinite(floor) else slow
    upward = max(strong - x - margin * strong, 0.05 * strong)
    downward = max(slow + weak - margin * strong, 0.05 * strong)
    average = max(1, filter_length(model.Ts, step.slowest)) * model.Ts
    edge = max(
        step.slowest * (x - slow) / min(upward, downward),
        0.5 * step.slowest,
        10.0 * (fopdt.L + model.Ts) + 4.0 * average,
    )
    both = other if other > 0.25 * x else 0.0
    return _Span(rest, rest + sign * slow, rest + sign * x, rest - sign * both, edge)


def _lowest_held(model: Model, fopdt: Fopdt, rest: float, sign: float) -> float:
    """The lowest level above rest at which a held reference stays within the training region [y].
    A record of steps passes every level, but stays at the lowest ones for less time than a
    reference does.
    """
    region = stored_region(model)
    if region is None:
        return 0.0
    # largest distance of a held level from the record's mean, as a share of the region's bound
    (u, y), (far_u, far_y) = region.centre, 0.95 * region.level
    levels = (fopdt.K * (u - sign * np.sign(fopdt.K) * far_u) + fopdt.offset, y - sign * far_y)
    return max(sign * (float(level) - rest) for level in levels)


def _way(step: DriveStep, u_min: float, u_max: float, low: float, high: float, Ts: float) -> _Span:
    """Levels of a position: within the record, and within the travel of a few time constants."""
    # longest travel of a position: that at the limit in so many time constants, or in so many
    # samples for a drive with hardly a time constant
    travel, travel_samples = 10.0, 500
    fopdt, rest = step.fopdt, step.rest
    rates = [fopdt.K * u + fopdt.offset for u in (u_min, u_max)]
    slower = min(max(rates), -min(rates))
    if slower <= 0.05 * max(map(abs, rates)):
        raise SettingError(
            name="u_min, u_max", expected="limits that move a position both ways",
            received=f"{u_min:g} to {u_max:g}, which move it at {min(rates):g} to {max(rates):g} "
            "a second", remedy="give wider ones, or the references as samples",
        )  # fmt: skip
    inside = low <= rest <= high
    up, down = (high - rest, rest - low) if inside else (high - low, 0.0)
    sign, x = (1.0, up) if up >= down else (-1.0, down)
    lag = step.slowest + fopdt.L + Ts
    x = min(_RECORDED * x, max(travel * lag, travel_samples * Ts) * slower)
    average = max(1, filter_length(Ts, step.slowest)) * Ts
    # rate of a position's ramps as a share of its rate at the limit: the rest starts and stops it
    edge = max(x / (0.4 * slower), 10.0 * (fopdt.L + Ts) + 4.0 * average)
    other = min(min(up, down), x)
    return _Span(
        rest, rest, rest + sign * x, rest - sign * (other if other > 0.25 * x else 0.0), edge
    )


def _finite_limits(model: Model, u_min: float, u_max: float) -> tuple[float, float]:
    """The limits, with the recorded ones in place of infinite ones."""
    recorded = recorded_limits([model]) or (-math.inf, math.inf)
    low = u_min if math.isfinite(u_min) else recorded[0]
    high = u_max if math.isfinite(u_max) else recorded[1]
    if not (math.isfinite(low) and math.isfinite(high)):
        raise SettingError(
            name="reference",
            expected="a controller with limits, or a model with the range of its training "
            "inputs, to size it by",
            received="neither", remedy="give the reference as samples",
        )  # fmt: skip
    return low, high


def _shapes(span: _Span, Ts: float, seed: int) -> dict[str, FloatArray]:
    """The catalogue's shapes; its fastest edge, .15 s of the trapezoid, becomes `span.edge`."""
    pace = span.edge / 0.15
    # a random reference with more samples is shortened to `_EDGES`: tuning runs it thousands of
    # times
    most = 20_000 * Ts
    # keep the rates: the rise from rest is longer than that from the slow run
    height = span.top - span.low
    first = span.edge * (span.top - span.rest) / height
    begin = span.edge * abs(span.low - span.rest) / abs(height)

    def drawn(points: Sequence[tuple[float, float]]) -> FloatArray:
        """Straight lines through (time since the last point, level), from rest."""
        lasts, levels = zip((0.0, span.rest), *points, strict=True)
        t = np.cumsum(lasts)
        found: FloatArray = np.interp(np.arange(max(2, round(t[-1] / Ts))) * Ts, t, levels)
        return found

    def levels(share: FloatArray) -> FloatArray:
        """From the slow run at 0 to the top at 1, approached from rest."""
        approach = np.linspace(span.rest, span.low, 1 + round(2.0 * begin / Ts))[:-1]
        return np.concatenate([approach, span.low + np.clip(share, 0.0, 1.0) * height])

    steps = [(2.0 * begin + 0.01 * pace, span.low)]
    # as in the catalogue, from its slow run of 400 RPM to 3,500
    for tall, rise, hold, fall, after in signals.TRAPEZOIDS:
        top = span.low + height * (tall - 400.0) / 3100.0
        steps += [(0.1 * pace, span.low), (rise * pace, top), (hold * pace, top)]
        steps += [(fall * pace, span.low), (after * pace, span.low)]

    def chirp(amplitude: tuple[float, float], offset: tuple[float, float]) -> FloatArray:
        return levels(
            _core.chirp(
                duration=20.0 * pace, Ts=Ts, f_start=0.1 / pace, f_end=3.0 / pace,
                amplitude_start=amplitude[0] / 2160.0, amplitude_end=amplitude[1] / 2160.0,
                offset_start=offset[0] / 2160.0, offset_end=offset[1] / 2160.0,
            )
        )  # fmt: skip

    between = sorted((span.other if span.other != span.rest else span.low, span.top))
    lowest = between[0] + (0.1 * (between[1] - between[0]) if between[0] == span.rest else 0.0)
    highest = between[1] - (0.1 * (between[1] - between[0]) if between[1] == span.rest else 0.0)
    # a change over both directions is longer than the catalogue's, and so are the holds after it
    wider = max(1.0, (between[1] - between[0]) / abs(height))
    holds = 0.25 * pace * wider, 0.9 * pace * wider
    usual = 10.0 * pace * wider
    least = _EDGES * 0.5 * sum(holds)
    return {
        "trapezoid": drawn(
            [
                (0.1 * pace, span.rest), (first, span.top), (0.6 * pace, span.top),
                (span.edge, span.low), (0.5 * pace, span.low),
            ]
        ),
        "chirp_hi_lo": chirp((1080.0, 150.0), (1080.0, 400.0)),
        "chirp_lo_hi": chirp((50.0, 250.0), (50.0, 350.0)),
        "random": _core.random_steps(
            duration=min(usual, max(least, most)), Ts=Ts, low=lowest, high=highest,
            hold_min=max(holds[0], Ts), hold_max=max(holds[1], 2.0 * Ts),
            smoothing=0.2 * pace * wider, seed=seed, start=span.rest,
        ),
        "trapezoids": drawn(steps),
        "step": np.repeat(
            [span.rest, span.top], [max(1, round(0.1 * pace / Ts)), max(2, round(0.9 * pace / Ts))]
        ),
    }  # fmt: skip


def default_references(
    plant: Any, controller: SampledController, names: Sequence[str] = NAMES
) -> list[str | FloatArray]:
    """Default references for a controller on a plant: names, or samples [y].
    They are names if the catalogue suits the plant, else the same shapes over its own range,
    without those that have too many samples for tuning. Raises the errors of `drive_references`.
    """
    low, high = controller.u_min, controller.u_max
    if not isinstance(plant, Model) or catalogue_fits(plant, low, high, controller.y_unit):
        return list(names)
    made = drive_references(plant, low, high, pace=controller.pace)
    first, *others = (made[name] for name in names)
    # a reference with more samples is not used for tuning
    return [first, *(r for r in others if len(r) <= 60_000)]


def default_step(plant: Any, controller: SampledController) -> FloatArray | None:
    """The step that a user of a plant may ask for beside the default references: from rest to their
    top [y]. None where the catalogue suits the plant, which has ramps.
    """
    low, high = controller.u_min, controller.u_max
    if not isinstance(plant, Model) or catalogue_fits(plant, low, high, controller.y_unit):
        return None
    return drive_references(plant, low, high, pace=controller.pace)["step"]
