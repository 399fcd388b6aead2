"""First gains, the search, and what is required beside its cost."""

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
from ..tuning.objective import Constraints, Cost, LoadStep
from ..tuning.search import TuningResult, costs, recoveries, tune
from .bench import Aborted
from .demands import Demands, Refusal
from .excitations import pace_of
from .slow import Thinning
from .small_signal import SHAKEN_AT, Resonance, SmallSignal

# --- Gains: first ones by rule from the step response, then by search on the ensemble -------------


FILTER = 8e-3
"""Of the feedback's moving average [s]: one count a millisecond of 1,572 a turn is 38 RPM."""
DERIVATIVE_FILTER = 10.0
FIRST_MS, SAFE_MS = 1.8, 2.0
"""Of the first gains on first order with dead time; the largest on the machine's small signals."""
LOWER, STEPS = 0.85, 29
"""Factor by which gains are lowered, and how often."""
SEARCHED = ("Kp", "Ti", "Td", "alpha", "beta", "N", "filter_samples", "filter_time")
"""What is searched: the feedback's filter is worth as much as the gains."""
NOTCH_DEPTHS, NOTCH_WIDTHS = (0.05, 0.2), (0.3, 0.6, 1.2)
"""Of a notch among which the first one is chosen; the search goes on from there."""
WORTH = 1.2
"""Times the integral gain without it, that a notch has to allow."""
ALPHAS, BETAS = (0.0, 0.1, 0.2, 0.4), (-1.0, 0.0, 0.5)
"""Among which the search's start is chosen."""
RATIOS = (0.01, 2.0)
"""L/T between which Eq. 12 is solved."""


def first_gains(
    fopdt: Fopdt, bench: Machine, demands: Demands, small: SmallSignal | None = None
) -> Controller:
    """Gains by Eq. 12 with a limit of Ms; the feedback filter's delay counts as dead time.

    Where the small signals show more than first order with dead time, the gains are lowered until
    the Ms of their model is within the limit, too; where that has a resonance, with a notch there.
    """
    samples = max(1, min(64, round(FILTER / bench.Ts)))
    rule = _rule(fopdt, (samples - 1) / 2 * bench.Ts, FIRST_MS)
    found = Controller(
        gains=rule.gains,
        Ts=bench.Ts,
        alpha=rule.alpha,
        beta=rule.beta,
        N=DERIVATIVE_FILTER,
        u_min=-demands.u_max,
        u_max=demands.u_max,
        filter_samples=samples,
        counts_per_rev=bench.counts_per_rev,
        notes=f"{rule.name} on the recorded step response",
    )
    if small is None:
        return found
    if small.resonance is None:
        return lowered(found, small.model, SAFE_MS)
    return notched(found, small.model, small.resonance, SAFE_MS)


def notched(controller: Controller, plant: Model, resonance: Resonance, Ms: float) -> Controller:
    """The controller lowered to this Ms, with the notch on the resonance that leaves most of it.

    What is left is measured by the integral gain, which fights disturbances down. A notch that
    is not worth it costs phase for nothing and is left out.
    """
    tried = [()] + [
        (Biquad.notch(resonance.frequency, depth, width),)
        for depth, width in product(NOTCH_DEPTHS, NOTCH_WIDTHS)
    ]
    found: list[Controller] = []
    refused: Refusal | None = None
    for biquads in tried:
        try:
            found.append(lowered(replace(controller, biquads=biquads), plant, Ms))
        except Refusal as refusal:
            refused = refused or refusal
    if not found:
        assert refused is not None
        raise refused
    best = max(found, key=_integral)
    plain = next((c for c in found if not c.biquads), None)
    return best if plain is None or _integral(best) >= WORTH * _integral(plain) else plain


def _integral(controller: Controller) -> float:
    return abs(controller.gains.to("parallel").Ki)


def lowered(controller: Controller, plant: Model, Ms: float) -> Controller:
    """The controller with its gains lowered until the loop with `plant` has this Ms: together, and
    where that does not do, with a longer Ti.
    """
    shares = LOWER ** np.arange(STEPS)
    # at the same Ti a lower gain costs phase on a plant that is slow against it; with Kp Ti as it
    # was it does not
    tried = [scaled(controller, s) for s in shares] + [stretched(controller, s) for s in shares]
    for found in tried:
        if margins(found, plant).Ms <= Ms:
            return found
    raise Refusal(
        f"expected gains under which the loop is stable with an Ms of at most {Ms:g} on the "
        "machine's small signals, found none down to a hundredth of the rule's; see the recording "
        "small_signals"
    )


def scaled(controller: Controller, share: float) -> Controller:
    """The same controller with a share of its gain."""
    if share == 1.0:
        return controller
    g = controller.gains.to("standard")
    own = Gains.standard(share * g.Kp, g.Ti, g.Td, u_unit=g.u_unit, y_unit=g.y_unit)
    return replace(controller, gains=own)


def stretched(controller: Controller, share: float) -> Controller:
    """The same controller with a share of its gain and a Ti that is longer by as much."""
    g = controller.gains.to("standard")
    own = Gains.standard(share * g.Kp, g.Ti / share, g.Td, u_unit=g.u_unit, y_unit=g.y_unit)
    return replace(controller, gains=own)


def ruled(fopdt: Fopdt, like: Controller) -> Controller:
    """Eq. 12's gains with an Ms of at most 2, in the surroundings of another controller.

    Without that limit the short dead time of small signals asks for gains that move the command by
    volts for every count of the encoder.
    """
    rule = _rule(fopdt, (like.filter_samples - 1) / 2 * like.Ts + like.filter_time, SAFE_MS)
    return replace(
        like, gains=rule.gains, alpha=rule.alpha, beta=rule.beta, schedule=(),
        notes=f"{rule.name} on the recorded step response",
    )  # fmt: skip


def _rule(fopdt: Fopdt, late: float, Ms: float) -> Rule:
    """Eq. 12 for a feedback that is late.

    Below its least ratio of dead time to time constant that one is taken, which is a longer dead
    time than the plant's: conservative. Beyond its largest SIMC's PI stands for it.
    """
    L = max(fopdt.L + late, min(RATIOS) * fopdt.T)
    if max(RATIOS) < L / fopdt.T:
        return simc(replace(fopdt, L=L))
    return eq_12(replace(fopdt, L=L), Ms=Ms)


def start_of(
    rule: Controller,
    models: Ensemble | VirtualMachine,
    references: Mapping[str, FloatArray],
    cost: Cost,
    threads: int,
) -> Controller:
    """Where the search begins: the rule's loop with the alpha and beta of a coarse grid that cost
    least. The rule's own are for a step of the reference, far from what a slow one asks for.
    """
    tried = [replace(rule, alpha=a, beta=b) for a, b in product(ALPHAS, BETAS)]
    found = costs([rule, *tried], models, list(references.values()), cost=cost, threads=threads)
    return [rule, *tried][int(np.argmin(found))]


def cost_of(references: Mapping[str, FloatArray], Ts: float, demands: Demands) -> Cost:
    """Tracking, chatter and overshoot as the virtual machine's figures weigh them, to scale.

    A cost is a mean over the references; the overshoot is to be that over those that have an edge.
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

    A `rival` gives its second opinion on them.

    Raises
    ------
    Refusal
        Where every loop tried diverges, or none meets the requirements.
    Interrupted
        On Ctrl-C; its `best` is the best controller so far.
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


# --- Requirements: what tuned gains must bear whatever they cost ----------------------------------


LOAD = 0.1
"""Of the largest command: the load that comes on unless another is asked for."""
LEVEL = 0.75
"""Of the top speed, where it comes on and where networks are linearised."""
RECOVERED = 0.01
"""Of what the load would do to the speed without control."""
HAIR = 1.001
"""What a limit taken from the rule's own gains leaves above them, so that these meet it."""
SENSITIVE = 2.0
"""Times the Ms of the small signals' model under the rule's gains, above which a network is wrong
about small signals. Of 44 networks of eleven commissionings 41 had .7 to 1.7 times, three 2.6 and
more: one of `weak`, two of `heavy`."""
AS_IT_IS = ((1.0, 0),)
"""Variations of a member: none, its own gain and no more delay."""


@dataclass(frozen=True)
class Requirements:
    """A load step that no member recovers from later than under the rule's gains; a largest Ms.

    Attributes
    ----------
    loads : tuple of LoadStep
        Empty where none is required.
    rival : Controller or None
        The rule's gains; None where a member runs away under these.
    constraints : Constraints
    """

    loads: tuple[LoadStep, ...] = ()
    rival: Controller | None = None
    constraints: Constraints = field(default_factory=Constraints)

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
        """What is required of gains for these members."""
        loads = _load_steps(fopdt, fastest, demands)
        bears = bool(loads) and _bears(rival, ensemble, loads)
        linear: list[Model] = []
        if demands.Ms is not None:
            # what answers within milliseconds is in no network of a drive, as it is learned from
            # slow records: on `fast02` and `knocking` their Ms is 1.2 to 6 times the small signals'
            linear = (
                _linear(ensemble.members, demands, rival.Ts) if small is None else [small.model]
            )
        speed = LEVEL * demands.speed
        is_stiff = small is None or small.resonance is None
        own = [margins(rival, m, speed=speed).Ms for m in linear] if bears and is_stiff else []
        constraints = Constraints(
            # gains that are no slower than the rule's are hardly less sensitive
            Ms=_limit(demands.Ms, own) if linear else None,
            recovery=rival if bears else None,
            plant=linear or None,
            speed=speed,
        )
        return cls(loads if bears else (), rival if bears else None, constraints)

    def met(self, controller: Controller, ensemble: Ensemble) -> dict[str, Any]:
        """What a controller does of it on the members as they are, as JSON values."""
        members = self.constraints.plant or ()
        told: dict[str, Any] = {
            "Ms_limit": self.constraints.Ms,
            "Ms": [margins(controller, m, speed=self.constraints.speed).Ms for m in members],
        }
        if self.rival is None:
            return told | {"load": None}
        step = self.loads[0]
        of = {"tuned": controller, "rule": self.rival}
        recovery = {
            name: recoveries(c, ensemble, self.loads, variations=AS_IT_IS)[:, 0].tolist()
            for name, c in of.items()
        }
        load = {"level": step.level, "disturbance": step.disturbance, "band": step.band}
        return told | {"load": load, "recovery_ms": recovery}


def _limit(asked: float | None, own: Sequence[float]) -> float | None:
    """The limit of Ms that was asked for, or a hair above the rule's own where that is larger."""
    if asked is None:
        return None
    return max([asked, *(HAIR * x for x in own if math.isfinite(x))])


def _load_steps(fopdt: Fopdt, fastest: float, demands: Demands) -> tuple[LoadStep, ...]:
    """One that brakes, at three quarters of the top speed."""
    volt = LOAD * demands.u_max if demands.load is None else demands.load
    if volt == 0.0:
        return ()
    pace = pace_of(fastest, demands)
    return (
        LoadStep(
            LEVEL * demands.speed, -volt, band=RECOVERED * volt * fopdt.K,
            ramp=0.3 * pace, settle=0.5 * pace, look=0.5 * pace,
        ),
    )  # fmt: skip


def _bears(rival: Controller, ensemble: Ensemble, loads: Sequence[LoadStep]) -> bool:
    """Whether the rule's gains can be measured by: no member runs away under them."""
    try:
        return bool(np.isfinite(recoveries(rival, ensemble, loads)).all())
    except FitError:
        return False


def sensible(
    rule: Controller, ensemble: Ensemble, small: SmallSignal | None, demands: Demands
) -> Ensemble:
    """The ensemble without members that are far more sensitive than the machine's small signals.

    All agree on slow references, and the one that is wrong about fast signals would set the limit
    of recovery for the gains of all.
    """
    if small is None or demands.Ms is None:
        return ensemble
    known = _linear(ensemble.members, demands, rule.Ts)
    most = SENSITIVE * margins(rule, small.model).Ms
    wrong = [m for m in known if not margins(rule, m, speed=LEVEL * demands.speed).Ms <= most]
    kept = [m for m in ensemble.members if not any(m is other for other in wrong)]
    # where most are, it may be the small signals
    return Ensemble.of(kept) if wrong and 2 * len(kept) >= len(ensemble.members) else ensemble


def _linear(members: Sequence[Model], demands: Demands, Ts: float) -> list[Model]:
    """Members that can be linearised where the load comes on."""
    found = []
    for member in members:
        with suppress(SettingError):
            sampled(member, Ts, LEVEL * demands.speed)
            found.append(member)
    return found


# --- Caution: new gains meet the machine in steps, on a short hold, before anything longer is run -


SHARES = (0.25, 0.5, 1.0)
"""Of the gains, one hold after the other."""
HOLD = 0.4
"""How long the level is held [s], at least; a swing is told from that."""
GENTLY = 12.0
"""Times as slowly as the step response promises that the level is reached. A current limit allows a
fifth of that promise, and a loop that was at a limit swings back for reasons of its own."""
SETTLE = 0.2
"""Least time after the ramp, before that [s]."""
PERIODS = 100
"""Samples that it is held at the least."""
CHATTER = 0.12
"""Standard deviation of a quiet loop's command at a held speed, over the largest command."""
EXPECTED = 2.0
"""Times the models' own, which is the encoder's, that it may be in any case."""
RAILED = 0.05
"""Share of the held samples at a limit."""
BACK = 0.5
"""Of the gains that swung, what is kept."""


@dataclass(frozen=True)
class Swing:
    """What a loop that swings does while it should hold a speed.

    Attributes
    ----------
    share : float
        Of the gains.
    frequency : float
        [Hz]
    command, railed : float
        Standard deviation of the command [V], share of samples at a limit.
    """

    share: float
    frequency: float
    command: float
    railed: float


def held(demands: Demands, fastest: float, Ts: float) -> tuple[FloatArray, int]:
    """A reference to a working speed [RPM], and the sample from which it has settled."""
    level = SHAKEN_AT * demands.speed
    rise = max(round(GENTLY * level / fastest / Ts), 20)
    settle = rise + max(round(0.5 * rise), round(SETTLE / Ts), PERIODS // 2)
    hold = max(round(HOLD / Ts), PERIODS)
    return level * np.minimum(1.0, np.arange(settle + hold) / rise), settle


def swing_of(
    found: ClosedLoopRun, settled: int, share: float = 1.0, expected: float = 0.0
) -> Swing | None:
    """Whether the command swings at a held speed; None for a quiet loop.

    `expected` is what models say of its standard deviation [V].
    """
    u, limits = found.u[settled:], found.controller
    u = u[np.isfinite(u)]
    reach = 0.5 * (limits.u_max - limits.u_min)
    railed = float(np.mean((u >= limits.u_max - 1e-9) | (u <= limits.u_min + 1e-9)))
    k = np.arange(len(u))
    # what still settles is no swing
    rest = u - np.polyval(np.polyfit(k, u, 2), k)
    deviation = float(rest.std())
    if deviation <= max(CHATTER * reach, EXPECTED * expected) and railed <= RAILED:
        return None
    power = np.abs(np.fft.rfft(rest * np.hanning(len(rest)))) ** 2
    at = 1 + int(np.argmax(power[1:]))
    return Swing(share, at / (len(u) * found.Ts), deviation, railed)


def cautious(
    bench: Machine,
    controller: Controller,
    demands: Demands,
    fastest: float,
    name: str,
    small: SmallSignal | None,
    models: Ensemble | None = None,
    thinning: Thinning | None = None,
) -> tuple[Controller, Swing | None]:
    """The gains that hold a speed quietly, of those asked for, and the swing that was met.

    `models` know how far the encoder's counts alone move the command; they run at the samples that
    `thinning` leaves.

    Raises
    ------
    Refusal
        Where a quarter of the gains swings already.
    """
    r, settled = held(demands, fastest, bench.Ts)
    for share in SHARES:
        tried = scaled(controller, share)
        expected = 0.0
        if models is not None:
            expected = _chatter(tried, models, r, settled, thinning or Thinning())
        try:
            found = bench.follow(tried, r, f"{name}_{100 * share:g}")
            swing = swing_of(found, settled, share, expected)
        except Aborted as stop:
            if stop.frequency is None:
                raise
            swing = Swing(share, stop.frequency, float(stop.recording.u.std()), 1.0)
        if swing is None:
            continue
        kept = BACK * share
        if kept < SHARES[0]:
            raise Refusal(
                f"expected a quiet loop at {r[-1]:.4g} RPM under a quarter of the gains, it swings "
                f"at {swing.frequency:.3g} Hz ({swing.command:.3g} V rms): {cause(swing, small)}"
            )
        return scaled(controller, kept), swing
    return controller, None


def _chatter(
    controller: Controller, models: Ensemble, r: FloatArray, settled: int, thinning: Thinning
) -> float:
    """Standard deviation of the command at the held speed, the largest of any model [V]."""
    with suppress(FitError):
        coarse, k = thinning.coarse(controller), thinning.k
        return max(float(run(coarse, m, r[::k]).u[settled // k :].std()) for m in models.members)
    return 0.0


def cause(swing: Swing, small: SmallSignal | None) -> str:
    """What makes a loop swing, as far as it is known, and what to do."""
    remedy = "stiffen the shaft or the coupling, take the play out of it, or ask for less speed"
    if small is not None and small.resonance is not None:
        return f"the machine has {small.resonance}; {remedy}"
    if swing.frequency > 15.0:
        return f"a shaft or coupling that gives, play in it, or a belt; {remedy}"
    return (
        "friction, play, or a delay that the step response does not show; see the recording, and "
        "look for play and for a drive with a filter or a controller of its own"
    )
