"""`bode`: the frequency response of a machine excited about a working speed, or of a record.

A machine is brought to a speed and excited by a multisine: sines of random phases at odd lines, so
that even distortion falls between them; in complete periods, so that there is no leakage; and none
near multiples of the turn, where the load over the turn would look like a response.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, overload

import numpy as np
from numpy.typing import NDArray

from ..arrays import FloatArray
from ..control.benches import guarded
from ..control.controller import Controller
from ..control.machine import Machine, watching
from ..control.margins import margins
from ..dataset import Dataset
from ..errors import DataError, LinkError, SettingError
from ..frequency import FrequencyResponse, ResponsesOverSpeed, local_polynomial, periodic
from ..frequency.local import RecordMethod, of_record
from ..gains import real
from ..recording import Recording
from ..speed import speed_from_counts
from .bench import bench_of

STEPS = 0.05
"""Default amplitude of the reference under a controller, as a share of the working speed."""
HOLD, LONGEST = 2.0, 32.0
"""First and longest hold of a command for measuring its speed [s]."""
NEAR, SETTLED = 0.03, 0.02
"""Tolerance of the working point, and of a settled speed, as shares of the speed."""
SWING, MOST = 0.5, 0.8
"""Largest predicted swing as a share of the working speed: by default, and on request. Nearer to
standstill, friction would act like a step."""


@overload
def bode(
    on: Any, *, speed: float | None = ..., amplitude: float | None = ...,
    controller: Controller | None = ..., period: float = ..., realisations: int = ...,
    periods: int = ..., f_min: float = ..., f_max: float | None = ..., seed: int = ...,
    reference: str | None = ..., method: RecordMethod | None = ..., segment: int | None = ...,
) -> FrequencyResponse: ...  # fmt: skip
@overload
def bode(
    on: Any, *, speed: Sequence[float], amplitude: float | None = ...,
    controller: Controller | None = ..., period: float = ..., realisations: int = ...,
    periods: int = ..., f_min: float = ..., f_max: float | None = ..., seed: int = ...,
    reference: str | None = ..., method: RecordMethod | None = ..., segment: int | None = ...,
) -> ResponsesOverSpeed: ...  # fmt: skip
def bode(
    on: Any,
    *,
    speed: float | Sequence[float] | None = None,
    amplitude: float | None = None,
    controller: Controller | None = None,
    period: float = 2.0,
    realisations: int = 4,
    periods: int = 4,
    f_min: float = 1.0,
    f_max: float | None = None,
    seed: int = 0,
    reference: str | None = None,
    method: RecordMethod | None = None,
    segment: int | None = None,
) -> FrequencyResponse | ResponsesOverSpeed:
    """The frequency response from command to speed, with error bars.

    Parameters
    ----------
    on : machine, Recording or Dataset
        A machine (`VirtualMachine`, drive, `SteppedBench`) is excited about a working speed. A
        recording or a data set is used as it is, with any input; `reference`, `method` and
        `segment` apply to these only.
    speed : float or sequence of float, optional
        Working speed [RPM], required for a machine. It turns at this speed, and a little faster and
        slower. For several speeds, the response about each.
    amplitude : float, optional
        Peak of the multisine [V]; by default six tenths of the command left at that speed. Under a
        controller, the peak of the reference's variation [RPM], by default a twentieth of the
        speed.
    controller : Controller, optional
        Excite the reference of this loop instead of the command. The response is still that of the
        plant, without bias from the feedback; `response.margins(controller)` gives those of the
        loop.
    period : float
        Period of the multisine [s]; its lines are 2 / period apart.
    realisations, periods : int
        Number of multisines with different phases, and number of periods of each after a first one,
        in which the machine settles.
    f_min, f_max : float
        Lowest and highest frequency [Hz]; the highest is four tenths of the sample rate by default.
    seed : int
        Seed of the phases.
    reference : str, optional
        Column of a record with the controller's reference: without it the response of a record
        under feedback is biased.
    method : "segments" or "local", optional
        For a record: spectra averaged over segments (`sewfast.frequency.spectral`, the default), or
        local polynomials, which remove the leakage of beginning and end
        (`sewfast.frequency.local_polynomial`).
    segment : int, optional
        Samples; see `sewfast.frequency.spectral`.

    Returns
    -------
    FrequencyResponse or ResponsesOverSpeed
        From the command [V] to the mean speed over the sample before [RPM] if counts are known,
        else to the record's output. If a drive trips, the response is that of the samples until
        then, and `provenance["incomplete"]` holds the reason. For several speeds, those that could
        be measured.

    Raises
    ------
    SettingError
        For a machine without a speed, a speed or an amplitude out of reach, and arguments that do
        not go together.
    DataError
        If the machine comes near standstill, a command is clipped, the counts show no response, or
        a record cannot be used.
    LinkError
        If a drive fails or trips before enough was recorded.

    Notes
    -----
    Pintelon and Schoukens (2012), System Identification, chapters 4, 5 and 7.

    Examples
    --------
    >>> machine = VirtualMachine(load_inertia=1e-3, stiffness=150.0)
    >>> fit_shaft(bode(machine, speed=1500.0)).has_resonance
    True
    """
    if isinstance(on, (Recording, Dataset)):
        given = {"speed": speed, "amplitude": amplitude, "controller": controller}
        for name in given:
            if given[name] is not None:
                raise SettingError(
                    name=name, expected="a machine that is shaken", received="a record",
                    remedy="leave it out",
                )  # fmt: skip
        return of_record(on, reference, method, segment)
    of_records = {"reference": reference, "method": method, "segment": segment}
    for name in of_records:
        if of_records[name] is not None:
            raise SettingError(
                name=name, expected="none for a machine", received=repr(of_records[name]),
                remedy="it belongs to a record; leave it out",
            )  # fmt: skip
    if speed is None:
        raise SettingError(
            name="speed", expected="the working speed to shake the machine about [RPM]",
            received="none", remedy="for example speed=1500",
        )  # fmt: skip
    design = (period, realisations, periods, f_min, f_max, seed)
    if np.ndim(speed) == 0:
        with bench_of(on, None) as machine:
            plan = _Plan.of(machine, real("speed", speed), *design)
            return _shaken(guarded(machine), plan, amplitude, controller)
    with bench_of(on, None) as machine:
        return _over_speeds(
            guarded(machine),
            [_Plan.of(machine, s, *design) for s in _rising(speed)],
            amplitude,
            controller,
        )


def _rising(speed: Any) -> list[float]:
    found = [real("speed", s) for s in np.atleast_1d(speed).tolist()] if np.ndim(speed) == 1 else []
    if not found or len(set(found)) < len(found):
        raise SettingError(
            name="speed", expected="different working speeds [RPM]", received=repr(speed),
            remedy="for example speed=[500, 1000, 1500]",
        )  # fmt: skip
    return sorted(found)


def _over_speeds(
    machine: Machine, plans: list[_Plan], amplitude: float | None, controller: Controller | None
) -> ResponsesOverSpeed:
    """The responses one after the other; a speed that cannot be measured is skipped."""
    found: dict[float, FrequencyResponse] = {}
    refused: dict[float, str] = {}
    for i, plan in enumerate(plans):
        try:
            found[plan.speed] = _shaken(machine, plan, amplitude, controller)
        except (DataError, SettingError) as error:
            if i == len(plans) - 1 and not found:
                raise
            refused[plan.speed] = str(error)
            continue
        except LinkError as error:
            if not found:
                raise
            refused |= {p.speed: str(error) for p in plans[i:]}
            break
        incomplete = found[plan.speed].provenance.get("incomplete")
        if incomplete is not None:
            # a drive that has tripped does not start again by itself
            refused |= {p.speed: f"not measured after {incomplete}" for p in plans[i + 1 :]}
            break
    return ResponsesOverSpeed(found, refused)


def _shaken(
    machine: Machine, plan: _Plan, amplitude: float | None, controller: Controller | None,
    *, is_whole: bool = False,
) -> FrequencyResponse:  # fmt: skip
    """The response about one speed; with `is_whole` only from a complete run."""
    if controller is None:
        return _in_open_loop(machine, plan, amplitude, is_whole=is_whole)
    return _under_feedback(machine, plan, amplitude, controller, is_whole=is_whole)


# --- Margins, predicted and measured --------------------------------------------------------------


MARGINS = ("Ms", "phase_margin_deg", "gain_margin")


def margins_at_work(
    machine: Machine, controller: Controller, plant: Any, speed: float, seed: int
) -> tuple[dict[str, Any], FrequencyResponse] | None:
    """Margins of a loop, predicted by a linear plant and measured on the machine at a speed, with
    the measured response. The reference is varied by a multisine for half a minute. None if the
    response is too small, the command reaches its limits even at a small amplitude, or the machine
    cannot be excited at that speed.
    """
    # factor for the amplitude if the command reached a limit; the least share of it to try
    again, least_shaken = 0.5, 0.2
    share = 1.0
    while share >= least_shaken:
        try:
            plan = _Plan.of(machine, speed, 2.0, 2, 4, 1.0, None, seed)
            response = _shaken(machine, plan, share * STEPS * abs(speed), controller, is_whole=True)
            measured = response.margins(controller, speed=speed)
        except DataError:
            share *= again
            continue
        except SettingError:
            # this machine or sample time cannot be excited so
            return None
        predicted = margins(controller, plant, speed=speed)
        found = {
            "speed": speed,
            "predicted": {name: getattr(predicted, name) for name in MARGINS},
            "measured": {name: getattr(measured, name) for name in MARGINS}
            # a confidence circle that contains -1 gives no bound
            | {"Ms_band": [x if x < 1e6 else math.inf for x in measured.Ms_band]},
        }
        return found, response
    return None


# --- A machine ------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Plan:
    """Lines and repetitions of an experiment."""

    speed: float
    samples: int
    realisations: int
    periods: int
    lines: Any
    seed: int
    Ts: float

    @classmethod
    def of(
        cls,
        machine: Machine,
        speed: float,
        period: float,
        realisations: int,
        periods: int,
        f_min: float,
        f_max: float | None,
        seed: int,
    ) -> _Plan:
        # multiples of the turn that lines avoid, and the least distance from them [Hz]
        harmonics, apart = 8, 1.0
        Ts = machine.Ts
        if speed == 0.0 or not abs(speed) < machine.speed:
            raise SettingError(
                name="speed",
                expected=f"a working speed other than 0 and below {machine.speed:g} RPM",
                received=f"{speed:g}",
            )  # fmt: skip
        for name, count, least in (("realisations", realisations, 1), ("periods", periods, 1)):
            if isinstance(count, bool) or not isinstance(count, int) or not least <= count <= 1000:
                raise SettingError(
                    name=name, expected="a whole number from 1 to 1000", received=repr(count)
                )
        if realisations * periods < 2:
            raise SettingError(
                name="periods", expected="at least two in all", received="one",
                remedy="use periods=2 or more: noise is estimated from repetitions",
            )  # fmt: skip
        # highest excited frequency as a share of the sample rate
        highest = 0.4 / Ts if f_max is None else real("f_max", f_max)
        if not 0.0 < real("f_min", f_min) < highest <= 0.5 / Ts:
            raise SettingError(
                name="f_min, f_max",
                expected=f"0 < f_min < f_max <= {0.5 / Ts:g} Hz, half the sampling",
                received=f"{f_min!r} and {highest!r}",
            )  # fmt: skip
        if not 2.0 / f_min <= 2.0 * real("period", period) <= 1e7 * Ts:
            raise SettingError(
                name="period",
                expected=f"at least one of f_min, {1.0 / f_min:g} s, and at most "
                f"{5000000.0 * Ts:g} s",
                received=repr(period),
            )  # fmt: skip
        samples = 2 * round(0.5 * period / Ts)
        k = np.arange(1, samples // 2, 2)
        hertz = k / (samples * Ts)
        turn = abs(speed) / 60.0
        harmonic = np.round(hertz / turn)
        off = (np.abs(hertz - harmonic * turn) > apart) | (harmonic < 1) | (harmonic > harmonics)
        k = k[off & (hertz >= f_min) & (hertz <= highest)]
        if len(k) < 3:
            raise SettingError(
                name="period", expected=f"at least 3 lines between {f_min:g} and {highest:g} Hz",
                received=str(len(k)), remedy="lengthen the period or widen the band",
            )  # fmt: skip
        return cls(speed, samples, realisations, periods, k, seed, Ts)

    def multisine(self, realisation: int) -> FloatArray:
        """One period with a peak of 1."""
        random = np.random.default_rng([self.seed, realisation])
        phases = random.uniform(0.0, 2.0 * math.pi, len(self.lines))
        spectrum = np.zeros(self.samples // 2 + 1, dtype=np.complex128)
        for _ in range(100):
            spectrum[self.lines] = np.exp(1j * phases)
            x = np.fft.irfft(spectrum, self.samples)
            # share of its peak at which a multisine is repeatedly clipped to lower its crest factor
            bound = 0.8 * np.abs(x).max()
            phases = np.angle(np.fft.rfft(np.clip(x, -bound, bound))[self.lines])
        found: FloatArray = x / np.abs(x).max()
        return found

    def signal(self) -> FloatArray:
        """All realisations, each with a leading period in which the machine settles."""
        parts = [np.tile(self.multisine(m), self.periods + 1) for m in range(self.realisations)]
        return np.concatenate(parts)

    def blocks(self, signal: FloatArray, start: int) -> FloatArray:
        """Shape (realisations, periods, samples), without the periods of settling."""
        shape = (self.realisations, self.periods + 1, self.samples)
        kept: FloatArray = signal[start : start + math.prod(shape)].reshape(shape)[:, 1:]
        return kept

    def left(self, samples: int) -> _Plan | None:
        """The part of the plan that fits into so many samples; None for fewer than two periods."""
        whole = samples // ((self.periods + 1) * self.samples)
        if whole * self.periods >= 2:
            return replace(self, realisations=min(whole, self.realisations))
        periods = samples // self.samples - 1
        return replace(self, realisations=1, periods=periods) if periods >= 2 else None


def _in_open_loop(
    machine: Machine, plan: _Plan, amplitude: float | None, *, is_whole: bool
) -> FrequencyResponse:
    level, lead, time = _working_point(machine, plan.speed)
    left = machine.volt - abs(level)
    swing = _swing(plan, plan.speed / level, time)
    room = min(abs(plan.speed), machine.speed - abs(plan.speed))
    # default amplitude of the multisine as a share of the command left at the working point
    peak = min(0.6 * left, SWING * room / swing)
    if amplitude is not None:
        peak = real("amplitude", amplitude)
        most = min(left, MOST * room / swing)
        if not 0.0 < peak <= most:
            raise SettingError(
                name="amplitude", expected=f"above 0 and up to {most:.4g} V",
                received=f"{peak:.4g} V",
                remedy=f"more than {left:.4g} V would be clipped beside the {level:.4g} V that "
                f"{plan.speed:g} RPM take, and each V swings the speed by some {swing:.3g} "
                "RPM, less with a higher f_min",
            )  # fmt: skip
    u = np.concatenate([np.full(lead, level), level + peak * plan.signal()])
    more: dict[str, Any] = {"level": level, "amplitude": peak}
    try:
        recording = machine.excite(u, "multisine")
    except LinkError as error:
        recording = _kept(error, lead, plan, is_whole=is_whole)
        more["incomplete"] = f"{error}"
    return _response(machine, plan, recording, lead, None, more)


def _kept(error: LinkError, lead: int, plan: _Plan, *, is_whole: bool) -> Recording:
    """The recording of an aborted run up to its first gap; its `error` if below a period."""
    found = getattr(error.recording, "recording", error.recording)
    if is_whole or not isinstance(found, Recording):
        raise error
    gaps = np.flatnonzero(~(np.isfinite(found.u) & np.isfinite(found.counts)))
    n = int(gaps[0]) if len(gaps) else len(found.u)
    if n < lead + plan.samples:
        raise error
    return replace(
        found, u=found.u[:n], counts=found.counts[:n], y=found.y[:n],
        speed_true=None if found.speed_true is None else found.speed_true[:n],
    )  # fmt: skip


def _swing(plan: _Plan, gain: float, time: float) -> float:
    """Largest deviation of the speed per volt of the multisine's peak [RPM/V], by a first order."""
    hertz = np.arange(plan.samples // 2 + 1) / (plan.samples * plan.Ts)
    lag = gain / (1.0 + 2j * math.pi * hertz * time)
    multisines = (plan.multisine(m) for m in range(plan.realisations))
    return max(
        float(np.abs(np.fft.irfft(np.fft.rfft(x) * lag, plan.samples)).max()) for x in multisines
    )


def _under_feedback(
    machine: Machine,
    plan: _Plan,
    amplitude: float | None,
    controller: Controller,
    *,
    is_whole: bool,
) -> FrequencyResponse:
    peak = STEPS * abs(plan.speed) if amplitude is None else real("amplitude", amplitude)
    if not 0.0 < peak <= MOST * abs(plan.speed):
        raise SettingError(
            name="amplitude",
            expected=f"above 0 and up to {MOST * abs(plan.speed):g} RPM about {plan.speed:g} RPM",
            received=repr(peak),
        )  # fmt: skip
    lead = round(HOLD / plan.Ts)
    ramp = np.minimum(np.arange(lead) / (0.5 * lead), 1.0) * plan.speed
    r = np.concatenate([ramp, plan.speed + peak * plan.signal()])
    more: dict[str, Any] = {"amplitude": peak, "feedback": True}
    limits = (controller.u_min, controller.u_max)

    def watch(first: int, u: FloatArray, counts: FloatArray) -> None:
        """End the run at the first sample at a limit: the rest would be useless."""
        limited = np.isin(u[max(0, lead - first) :], limits)
        if limited.any():
            raise _limited(limited, max(first, lead), plan.Ts)

    try:
        watched = watching(machine.follow, watch)
        recording = machine.follow(controller, r, "multisine", **watched).recording
    except LinkError as error:
        recording = _kept(error, lead, plan, is_whole=is_whole)
        more["incomplete"] = f"{error}"
    limited = np.isin(recording.u[lead:], limits)
    if limited.any():
        raise _limited(limited, lead, plan.Ts)
    return _response(machine, plan, recording, lead, r, more)


def _limited(limited: NDArray[np.bool_], first: int, Ts: float) -> DataError:
    """The error for samples at a limit; the first of them is sample `first` of the run."""
    return DataError(
        name="amplitude", expected="a command within its limits",
        received=f"{limited.sum()} samples at one, the first at "
        f"{(first + int(limited.argmax())) * Ts:.4g} s",
        remedy="the response would be that of the limit; lower the amplitude",
    )  # fmt: skip


def _response(
    machine: Machine,
    plan: _Plan,
    recording: Recording,
    lead: int,
    r: FloatArray | None,
    more: dict[str, Any],
) -> FrequencyResponse:
    y = speed_from_counts(
        recording.counts, recording.Ts, recording.counts_per_rev, method="difference"
    )
    slowest = (recording.y[lead:] * math.copysign(1.0, plan.speed)).min()
    if not slowest > 0.0:
        raise DataError(
            name="amplitude", expected="one at which the speed keeps its sign",
            received=f"a speed down to {slowest:.4g} RPM",
            remedy="at a reversal friction acts like a step: lower it, or raise the speed or f_min",
        )  # fmt: skip
    labels: dict[str, Any] = {
        "u_unit": "V", "y_unit": "RPM", "from_counts": True,
        "provenance": {
            "machine": machine.name, "speed": plan.speed, "seed": plan.seed,
            "counts_per_rev": machine.counts_per_rev, **more,
        },
    }  # fmt: skip
    left, n = plan.left(len(y) - lead), len(y)
    if left is not None:
        found = periodic(
            left.blocks(recording.u, lead), left.blocks(y, lead), Ts=plan.Ts, lines=plan.lines,
            r=None if r is None else left.blocks(r, lead), **labels,
        )  # fmt: skip
    else:
        found = local_polynomial(
            recording.u[lead:], y[lead:], Ts=plan.Ts, r=None if r is None else r[lead:n], **labels
        )
    if found.coherence.max() < 0.5:
        raise DataError(
            name="amplitude", expected="a response to the multisine in the counts",
            received="none that stands out from their rounding and the load",
            remedy="raise amplitude or periods",
        )  # fmt: skip
    return found


def _working_point(machine: Machine, speed: float) -> tuple[float, int, float]:
    """The command that holds the speed [V], by secants; the samples until then, the lag [s]."""
    tried: list[tuple[float, float]] = [(0.0, 0.0)]
    u, hold = math.copysign(0.15 * machine.volt, speed), HOLD
    for _ in range(8):
        held = _held(machine, u, hold)
        while not held.settled and hold < LONGEST:
            hold *= 2.0
            held = _held(machine, u, hold)
        reached = held.speed
        if abs(reached - speed) <= NEAR * abs(speed):
            return u, round(hold / machine.Ts), held.time
        if abs(reached) < 0.02 * abs(speed):  # not broken away
            tried = [(u, 0.0)]
            u *= 2.0
        else:
            tried = sorted([*tried, (u, reached)], key=lambda point: abs(point[1] - speed))[:2]
            (u0, n0), (u1, n1) = tried
            u = u0 + (speed - n0) * (u1 - u0) / (n1 - n0) if n1 != n0 else 1.5 * u0
        if not abs(u) < machine.volt:
            break
    raise SettingError(
        name="speed", expected=f"one that a steady command of up to {machine.volt:g} V holds",
        received=f"{speed:g} RPM",
        remedy=f"the nearest was {min(tried, key=lambda p: abs(p[1] - speed))[1]:.4g} RPM",
    )  # fmt: skip


@dataclass(frozen=True)
class _Held:
    """The response to a steady command.
    `speed` is the mean of the last quarter [RPM], `settled` says whether the mean of the quarter
    before was the same, and `time` is the time until 63 % of the speed were reached [s].
    """

    speed: float
    settled: bool
    time: float


def _held(machine: Machine, u: float, hold: float) -> _Held:
    n = round(hold / machine.Ts)
    recording = machine.excite(np.full(n, u), "hold")
    counts = recording.counts
    at = [counts[n // 2], counts[3 * n // 4], counts[-1]]
    if not np.isfinite(at).all():
        raise DataError(
            name="u", expected="every sample of the run", received="gaps",
            remedy="see `sewfast doctor`",
        )  # fmt: skip
    before, last = np.diff(at) / np.diff([n // 2, 3 * n // 4, n - 1])
    speed = float(last * 60.0 / (machine.counts_per_rev * machine.Ts))
    reached = np.flatnonzero(np.abs(recording.y) >= 0.63 * abs(speed))
    time = float(reached[0] * machine.Ts) if len(reached) else hold
    return _Held(speed, bool(abs(last - before) <= SETTLED * abs(last) + 1e-9), time)
