"""First gains by rule, the search, its requirements, and the cautious trial of new gains."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from itertools import product
from typing import Any

import numpy as np

from .. import _core
from ..control.biquad import Biquad
from ..control.controller import Controller
from ..control.loop import ClosedLoopRun, run
from ..control.machine import Machine
from ..control.margins import margins, sampled
from ..dataset import FloatArray
from ..errors import DataError, FitError, SettingError
from ..gains import Gains
from ..machine import VirtualMachine
from ..models import Ensemble, Model
from ..rules import Fopdt, Rule, eq_12, simc
from ..tuning.judge import costs, recoveries
from ..tuning.lead import Effort, with_lead
from ..tuning.objective import LARGEST_MS, Constraints, Cost, LoadStep
from ..tuning.search import TuningResult, tune
from ..tuning.task import TuningTask
from .bench import Aborted
from .demands import Demands, Refusal
from .excitations import pace_of
from .slow import Thinning
from .small_signal import SHAKEN_AT, Resonance, SmallSignal

# --- Gains: by rule from the step response, then by search on the ensemble ------------------------


SEARCHED = ("Kp", "Ti", "Td", "alpha", "beta", "N", "filter_samples", "filter_time")
"""Variables of the search: the feedback's filter matters as much as the gains."""


def first_gains(
    fopdt: Fopdt, machine: Machine, demands: Demands, small: SmallSignal | None = None
) -> Controller:
    """Gains by Eq. 12 with a limit of Ms; the feedback filter's delay counts as dead time.
    With a model of the small signals, the gains are lowered until its Ms is within the limit, too;
    if it has a resonance, with a notch there.
    """
    # length of the feedback's moving average [s]: one count of 1,572 per ms is 38 RPM
    samples = max(1, min(64, round(8e-3 / machine.Ts)))
    rule = _rule(fopdt, (samples - 1) / 2 * machine.Ts, LARGEST_MS)
    found = Controller(
        gains=rule.gains,
        Ts=machine.Ts,
        alpha=rule.alpha,
        beta=rule.beta,
        N=10.0,
        u_min=-demands.u_max,
        u_max=demands.u_max,
        filter_samples=samples,
        counts_per_rev=machine.counts_per_rev,
        notes=f"{rule.name} on the recorded step response",
    )
    if small is None:
        return found
    if small.resonance is None:
        return lowered(found, small.model, LARGEST_MS)
    return notched(found, small.model, small.resonance, LARGEST_MS)


def notched(controller: Controller, plant: Model, resonance: Resonance, Ms: float) -> Controller:
    """The controller lowered to this Ms, with the notch that allows the largest gains.
    They are compared by the integral gain, which rejects disturbances. A search can flatten a notch
    that gains nothing, but cannot add one.
    """
    # depths and widths to try for the first notch; the search starts from the best. A narrower one
    # does not hold a resonance that moves by a tenth
    notch_depths, notch_widths = (0.05, 0.2), (0.6, 1.2, 2.0)
    found: list[Controller] = []
    for depth, width in product(notch_depths, notch_widths):
        notch = Biquad.notch(resonance.frequency, depth, width)
        with suppress(Refusal):
            found.append(lowered(replace(controller, biquads=(notch,)), plant, Ms))
    return max(found, key=_integral) if found else lowered(controller, plant, Ms)


def _integral(controller: Controller) -> float:
    return abs(controller.gains.to("parallel").Ki)


def lowered(controller: Controller, plant: Model, Ms: float) -> Controller:
    """The controller with its gains lowered until the loop with `plant` has this Ms.
    It lowers Kp alone first; if that is not enough, it also lengthens Ti by the same factor. Raises
    `Refusal` if no gains reach this Ms.
    """
    # factor from one trial of lower gains to the next, and the number of trials
    lower, steps = 0.85, 29
    shares = lower ** np.arange(steps)
    # at the same Ti, a lower Kp costs phase on a plant slower than Ti; at the same Kp Ti not
    tried = [scaled(controller, s) for s in shares] + [stretched(controller, s) for s in shares]
    for found in tried:
        if margins(found, plant).Ms_robust <= Ms:
            return found
    raise Refusal(
        f"expected gains under which the loop is stable with an Ms of at most {Ms:g} on the "
        "machine's small signals, found none down to a hundredth of the rule's; see the recording "
        "small_signals"
    )


def scaled(controller: Controller, share: float) -> Controller:
    """The same controller with Kp times `share`."""
    if share == 1.0:
        return controller
    g = controller.gains.to("standard")
    own = Gains.standard(share * g.Kp, g.Ti, g.Td, u_unit=g.u_unit, y_unit=g.y_unit)
    return replace(controller, gains=own)


def stretched(controller: Controller, share: float) -> Controller:
    """The same controller with Kp times `share` and Ti divided by it."""
    g = controller.gains.to("standard")
    own = Gains.standard(share * g.Kp, g.Ti / share, g.Td, u_unit=g.u_unit, y_unit=g.y_unit)
    return replace(controller, gains=own)


def ruled(fopdt: Fopdt, like: Controller) -> Controller:
    """Eq. 12's gains with an Ms of at most 1.8, and all other settings of another controller.
    Without that limit, the short dead time of small signals leads to gains that move the command by
    volts for every count of the encoder.
    """
    rule = _rule(fopdt, (like.filter_samples - 1) / 2 * like.Ts + like.filter_time, LARGEST_MS)
    return replace(
        like, gains=rule.gains, alpha=rule.alpha, beta=rule.beta, schedule=(),
        notes=f"{rule.name} on the recorded step response",
    )  # fmt: skip


def _rule(fopdt: Fopdt, late: float, Ms: float) -> Rule:
    """Eq. 12 for a feedback that is `late` [s]; SIMC's PI above the largest L/T of Eq. 12.
    Below the smallest L/T of Eq. 12 that ratio is used, a longer dead time than the plant's:
    conservative.
    """
    # range of L/T in which Eq. 12 is solved
    ratios = (0.01, 2.0)
    L = max(fopdt.L + late, min(ratios) * fopdt.T)
    if max(ratios) < L / fopdt.T:
        return simc(replace(fopdt, L=L))
    return eq_12(replace(fopdt, L=L), Ms=Ms)


def start_of(
    rule: Controller,
    models: Ensemble | VirtualMachine,
    references: Mapping[str, FloatArray],
    cost: Cost,
    threads: int,
) -> Controller:
    """The rule's gains, with alpha and beta of least cost on a grid: the rule's suit steps only."""
    # values to try for the start of the search
    alphas, betas = (0.0, 0.1, 0.2, 0.4), (-1.0, 0.0, 0.5)
    tried = [replace(rule, alpha=a, beta=b) for a, b in product(alphas, betas)]
    found = costs([rule, *tried], models, list(references.values()), cost=cost, threads=threads)
    return [rule, *tried][int(np.argmin(found))]


def cost_of(references: Mapping[str, FloatArray], Ts: float, demands: Demands) -> Cost:
    """Weights of tracking, chatter and overshoot: the virtual machine's, scaled.
    A cost is a mean over all references; the overshoot's weight is scaled to make it the mean over
    the references with an edge.
    """
    edges = sum(_has_edge(r, Ts) for r in references.values())
    size = demands.speed / 2000.0
    return Cost(
        tracking=1.0,
        chatter=5.0 * size * (20.0 / demands.u_max),
        overshoot=3.0 * size * len(references) / max(edges, 1),
        overshoot_limit=1.0,
        saturation=0.0,
    )


def _has_edge(r: FloatArray, Ts: float) -> bool:
    try:
        _core.step_metrics(r, r, Ts=Ts, smoothing=Ts)
    except DataError:
        return False
    return True


def search(
    models: Ensemble | VirtualMachine,
    references: Mapping[str, FloatArray],
    start: Controller,
    demands: Demands,
    cost: Cost,
    progress: Callable[[int, int], object],
    *,
    requirements: Requirements | None = None,
    variations: Sequence[tuple[float, int]] | None = None,
    disturbances: Sequence[FloatArray] | None = None,
    rival: Model | None = None,
) -> TuningResult:
    """The gains of least cost over all members, each with the usual gain spread and delay.
    A `rival` gives a second opinion on them. Raises `Refusal` if every loop tried diverges, or none
    meets the requirements, and `Interrupted` on Ctrl-C; its `best` is the best controller so far.
    """
    asked = requirements or Requirements()
    try:
        return tune(
            models,
            list(references.values()),
            start=start,
            variables=[*SEARCHED, "notches"] if start.biquads else SEARCHED,
            cost=cost,
            constraints=asked.constraints,
            loads=asked.loads,
            disturbances=disturbances,
            rival=rival,
            variations=variations,
            feedforward="none",
            evaluations=demands.evaluations,
            seed=demands.seed,
            threads=demands.threads,
            time_budget=demands.time_budget,
            progress=lambda done, total, best: progress(done, total),
        )
    except FitError as error:
        raise Refusal(
            f"expected gains under which every member of the ensemble does what is required "
            f"({error}); record longer, raise evaluations, or ask for less: a larger Ms, load=0"
        ) from error


def led(
    tuning: TuningResult,
    ensemble: Ensemble,
    references: Mapping[str, FloatArray],
    cost: Cost,
    disturbances: Sequence[FloatArray] | None,
    threads: int,
    every: int,
) -> TuningResult:
    """The tuned gains with a feedforward, if no member follows the references worse with it; a
    sample of the ensemble is `every` so many of the machine's.
    """
    task = TuningTask.of(
        ensemble, list(references.values()), start=tuning.pid, first={}, cost=cost,
        aggregate="mean", constraints=None, variations=None, disturbances=disturbances,
    )  # fmt: skip
    effort = Effort(threads=threads)
    controller, found = with_lead(task, tuning.pid, "preview", effort=effort, every=every)
    return replace(tuning, controller=controller, lead=found)


# --- Requirements of tuned gains besides their cost -----------------------------------------------


LEVEL = 0.75
"""Speed of the load step, and of the linearisation of networks, as a share of the top speed."""
SENSITIVE = 2.0
"""Largest Ms of a network under the rule's gains, as a multiple of that of the small signals'
model: above it the network is wrong about small signals. Of 44 networks of eleven commissionings 41
had .7 to 1.7 times, three 2.6 and more: one of `weak`, two of `heavy`."""
AS_IT_IS = ((1.0, 0),)
"""Variations of a member: only its own gain, without added delay."""


@dataclass(frozen=True)
class Requirements:
    """A largest Ms, and a load step with a recovery no slower than under the rule's gains.
    `loads` is empty if none is required; `rival` has the rule's gains, slowed down to the limit of
    Ms, and is None if a member diverges under the rule's.
    """

    loads: tuple[LoadStep, ...] = ()
    rival: Controller | None = None
    constraints: Constraints = field(default_factory=lambda: Constraints(Ms=math.inf))

    @classmethod
    def of(
        cls,
        ensemble: Ensemble,
        fopdt: Fopdt,
        fastest: float,
        rival: Controller,
        demands: Demands,
        small: SmallSignal | None,
    ) -> Requirements:
        """The requirements for gains on these members."""
        loads = _load_steps(fopdt, fastest, demands)
        bears = bool(loads) and _bears(rival, ensemble, loads)
        linear: list[Model] = []
        if demands.Ms is not None:
            # networks are trained on slow records and miss dynamics of milliseconds: on `fast02`
            # and `knocking` their Ms is 1.2 to 6 times that of the small signals
            linear = (
                _linear(ensemble.members, demands, rival.Ts) if small is None else [small.model]
            )
        speed = LEVEL * demands.speed
        is_stiff = small is None or small.resonance is None
        if bears and is_stiff and demands.Ms is not None:
            # no limit is raised for the recovery: it is that of the rule's gains within the limit
            rival = _within(rival, linear, speed, demands.Ms)
        constraints = Constraints(
            Ms=demands.Ms if linear else math.inf,
            recovery=rival if bears else None,
            plant=linear or None,
            speed=speed,
        )
        return cls(loads if bears else (), rival if bears else None, constraints)

    def met(self, controller: Controller, ensemble: Ensemble) -> dict[str, Any]:
        """How a controller meets them on the members without variations, as JSON values."""
        speed, members = self.constraints.speed, self.constraints.plant or ()
        loops = [margins(controller, m, speed=speed) for m in members]
        found: dict[str, Any] = {
            "Ms_limit": self.constraints.Ms if self.constraints.limits_Ms else None,
            "Ms": [loop.Ms for loop in loops],
            "tolerance": [loop.tolerance for loop in loops if loop.tolerance],
        }
        if self.rival is None:
            return found | {"load": None}
        step = self.loads[0]
        of = {"tuned": controller, "rule": self.rival}
        recovery = {
            name: recoveries(c, ensemble, self.loads, variations=AS_IT_IS)[:, 0].tolist()
            for name, c in of.items()
        }
        load = {"level": step.level, "disturbance": step.disturbance, "band": step.band}
        return found | {"load": load, "recovery_ms": recovery}


def _within(rule: Controller, plants: Sequence[Model], speed: float, limit: float) -> Controller:
    """The rule's gains, slowed down until they keep the limit of Ms on every plant."""
    # times that the rule's gains are lowered by a tenth; .04 of them are left after all
    for k in range(30):
        slowed = stretched(rule, 0.9**k)
        if all(margins(slowed, m, speed=speed).Ms_robust <= limit for m in plants):
            return slowed
    return slowed


def _load_steps(fopdt: Fopdt, fastest: float, demands: Demands) -> tuple[LoadStep, ...]:
    """A braking load step at three quarters of the top speed."""
    # default of the load step as a share of the largest command
    volt = 0.1 * demands.u_max if demands.load is None else demands.load
    if volt == 0.0:
        return ()
    pace = pace_of(fastest, demands)
    return (
        LoadStep(
            # band of recovery as a share of the load's effect on the speed without control
            LEVEL * demands.speed, -volt, band=0.01 * volt * fopdt.K,
            ramp=0.3 * pace, settle=0.5 * pace, look=0.5 * pace,
        ),
    )  # fmt: skip


def _bears(rival: Controller, ensemble: Ensemble, loads: Sequence[LoadStep]) -> bool:
    """Whether the rule's gains can serve as a yardstick: no member diverges under them."""
    try:
        return bool(np.isfinite(recoveries(rival, ensemble, loads)).all())
    except FitError:
        return False


def sensible(
    rule: Controller, ensemble: Ensemble, small: SmallSignal | None, demands: Demands
) -> Ensemble:
    """The ensemble without members whose Ms is far above that of the machine's small signals.
    All agree on slow references, but a member that is wrong about fast signals would set the limit
    of recovery for all.
    """
    if small is None or demands.Ms is None:
        return ensemble
    known = _linear(ensemble.members, demands, rule.Ts)
    most = SENSITIVE * margins(rule, small.model).Ms
    wrong = [m for m in known if not margins(rule, m, speed=LEVEL * demands.speed).Ms <= most]
    kept = [m for m in ensemble.members if not any(m is other for other in wrong)]
    # if most members deviate, the small signals may be wrong instead
    return Ensemble.of(kept) if wrong and 2 * len(kept) >= len(ensemble.members) else ensemble


def _linear(members: Sequence[Model], demands: Demands, Ts: float) -> list[Model]:
    """The members that can be linearised at the speed of the load step."""
    found = []
    for member in members:
        with suppress(SettingError):
            sampled(member, Ts, LEVEL * demands.speed)
            found.append(member)
    return found


# --- Caution: new gains are tried in steps on a short hold before anything longer -----------------


EXPECTED = 2.0
"""Deviation of a quiet loop's command as a multiple of the models', which is due to the encoder."""


@dataclass(frozen=True)
class Swing:
    """An oscillation of a loop that should hold a speed, with a `share` of the gains.
    `frequency` is in [Hz], `command` is the command's standard deviation [V], and `railed` the
    share of samples at a limit.
    """

    share: float
    frequency: float
    command: float
    railed: float


def held(demands: Demands, fastest: float, Ts: float) -> tuple[FloatArray, int]:
    """A ramp to a working speed and a hold [RPM], and the sample at which the hold begins."""
    # least samples of the hold
    periods = 100
    level = SHAKEN_AT * demands.speed
    # the ramp takes this many times as long as at the acceleration of the step response. A current
    # limit can allow only a fifth of that, and a loop that comes off a limit swings back anyway
    rise = max(round(12.0 * level / fastest / Ts), 20)
    # least time between the ramp and the hold [s]
    settle = rise + max(round(0.5 * rise), round(0.2 / Ts), periods // 2)
    # the hold in which an oscillation is looked for lasts .4 s or 100 samples
    hold = max(round(0.4 / Ts), periods)
    return level * np.minimum(1.0, np.arange(settle + hold) / rise), settle


def swing_of(
    found: ClosedLoopRun, settled: int, share: float = 1.0, expected: float = 0.0
) -> Swing | None:
    """The oscillation of a command at a held speed beyond the `expected` rms [V]; None if quiet."""
    u, limits = found.u[settled:], found.controller
    u = u[np.isfinite(u)]
    reach = 0.5 * (limits.u_max - limits.u_min)
    railed = float(np.mean((u >= limits.u_max - 1e-9) | (u <= limits.u_min + 1e-9)))
    rest = unsettled(u)
    # a quiet loop's command deviates little, as a share of the largest one or of what the models
    # expect, and few of the held samples are at a limit
    if rest.std() <= max(0.12 * reach, EXPECTED * expected) and railed <= 0.05:
        return None
    return Swing(share, frequency_of(rest, found.Ts), float(rest.std()), railed)


def unsettled(u: FloatArray) -> FloatArray:
    """A command without its slow part: one that is still settling is not an oscillation."""
    k = np.arange(len(u))
    rest: FloatArray = u - np.polyval(np.polyfit(k, u, 2), k)
    return rest


def frequency_of(rest: FloatArray, Ts: float) -> float:
    power = np.abs(np.fft.rfft(rest * np.hanning(len(rest)))) ** 2
    return (1 + int(np.argmax(power[1:]))) / (len(rest) * Ts)


def cautious(
    machine: Machine,
    controller: Controller,
    demands: Demands,
    fastest: float,
    name: str,
    small: SmallSignal | None,
    models: Ensemble | None = None,
    thinning: Thinning | None = None,
) -> tuple[Controller, Swing | None]:
    """The largest share of the gains that holds a speed quietly, and the oscillation met, if any.
    The `models` predict how far the encoder's counts alone move the command; they run at the
    samples that `thinning` leaves. Raises `Refusal` if the loop oscillates even with a quarter of
    the gains.
    """
    # shares of the gains to try, one hold after the other
    shares = (0.25, 0.5, 1.0)
    r, settled = held(demands, fastest, machine.Ts)
    for share in shares:
        tried = scaled(controller, share)
        expected = 0.0
        if models is not None:
            expected = _chatter(tried, models, r, settled, thinning or Thinning())
        try:
            found = machine.follow(tried, r, f"{name}_{100 * share:g}")
            swing = swing_of(found, settled, share, expected)
        except Aborted as stop:
            if stop.frequency is None:
                raise
            u = np.trim_zeros(stop.recording.u, "b")  # then it came to rest
            swing = Swing(share, stop.frequency, float(u.std()), 1.0)
        if swing is None:
            continue
        # share that is kept of gains that oscillated
        kept = 0.5 * share
        if kept < shares[0]:
            raise Refusal(
                f"expected a quiet loop at {r[-1]:.4g} RPM under a quarter of the gains, it swings "
                f"at {swing.frequency:.3g} Hz ({swing.command:.3g} V rms): "
                f"{cause(swing, small, tried)}"
            )
        return scaled(controller, kept), swing
    return controller, None


def _chatter(
    controller: Controller, models: Ensemble, r: FloatArray, settled: int, thinning: Thinning
) -> float:
    """Standard deviation of the command at the held speed, the largest among the models [V]."""
    with suppress(FitError):
        coarse, k = thinning.coarse(controller), thinning.k
        return max(float(run(coarse, m, r[::k]).u[settled // k :].std()) for m in models.members)
    return 0.0


def _count(controller: Controller) -> tuple[float, float]:
    """What a single count is in the filtered feedback [RPM], and how far it moves the command [V]:
    from its least to its largest value over the mean that the count passes.
    """
    if controller.counts_per_rev is None:
        return 0.0, 0.0
    core, n = controller.core(), controller.filter_samples
    count = 60.0 / (controller.counts_per_rev * controller.Ts)
    u = [core.step(0.0, count * (k == 0)) for k in range(n + 2)]
    return count / n, max(u) - min(u)


def cause(swing: Swing, small: SmallSignal | None, controller: Controller) -> str:
    """The likely cause of an oscillation under a controller, and its remedy."""
    count, moved = _count(controller)
    # the deviation of a command that goes from one of the two values to the other
    if swing.command <= 0.5 * moved:
        return (
            f"the steps of the encoder: one count is {count:.3g} RPM in the feedback, and moves "
            f"the command by {moved:.3g} V; take an encoder with more counts, or a longer mean"
        )
    remedy = "stiffen the shaft or the coupling, remove its play, or demand less speed"
    if small is not None and small.resonance is not None:
        return f"the machine has {small.resonance}; {remedy}"
    if swing.frequency > 15.0:
        return f"an elastic shaft or coupling, play in it, or a belt; {remedy}"
    return (
        "friction, play, or a delay that the step response does not show; see the recording, and "
        "look for play and for a filter or a controller inside the drive"
    )
