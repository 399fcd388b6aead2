"""Gains: first ones by rule from the step response, then by search on the ensemble."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from itertools import product

import numpy as np

from .. import _core
from ..control import Controller, Fopdt
from ..cost import Cost
from ..dataset import FloatArray
from ..errors import DataError, FitError
from ..gains import Gains
from ..machine import VirtualMachine
from ..models import Ensemble, Model
from ..robustness import margins
from ..rules import Rule, eq_12, simc
from ..tuning import TuningResult, costs, tune
from .bench import Bench
from .demands import Demands
from .refusal import Refusal
from .requirements import Requirements

FILTER = 8e-3
"""Of the feedback's moving average [s]: one count a millisecond of 1,572 a turn is 38 RPM."""
DERIVATIVE_FILTER = 10.0
FIRST_MS, SAFE_MS = 1.8, 2.0
"""Of the first gains on first order with dead time; the largest on the machine's small signals."""
LOWER, STEPS = 0.85, 29
"""Factor by which gains are lowered, and how often."""
SEARCHED = ("Kp", "Ti", "Td", "alpha", "beta", "N", "filter_samples", "filter_time")
"""What is searched: the feedback's filter is worth as much as the gains."""
ALPHAS, BETAS = (0.0, 0.1, 0.2, 0.4), (-1.0, 0.0, 0.5)
"""Among which the search's start is chosen."""
RATIOS = (0.01, 2.0)
"""L/T between which Eq. 12 is solved."""


def first_gains(
    fopdt: Fopdt, bench: Bench, demands: Demands, plant: Model | None = None
) -> Controller:
    """Gains by Eq. 12 with a limit of Ms; the feedback filter's delay counts as dead time.

    Where a linear `plant` shows more than first order with dead time, a resonance above all, the
    gains are lowered until its Ms is within the limit, too.
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
    return found if plant is None else lowered(found, plant, SAFE_MS)


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
            variables=SEARCHED,
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
