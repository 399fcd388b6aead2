"""Gains: first ones by rule from the step response, then by search on the ensemble."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

from .. import _core
from ..control import Controller, Fopdt, table_1
from ..cost import Cost
from ..dataset import FloatArray
from ..errors import DataError, FitError
from ..machine import VirtualMachine
from ..models import Ensemble
from ..tuning import TuningResult, tune
from .bench import Bench
from .demands import Demands
from .refusal import Refusal

FILTER = 8e-3
"""Of the feedback's moving average [s]: one count a millisecond of 1,572 a turn is 38 RPM."""
DERIVATIVE_FILTER = 10.0


def first_gains(fopdt: Fopdt, bench: Bench, demands: Demands) -> Controller:
    """Gains by Table 1, nearest row; the delay of the feedback's filter counts as dead time."""
    samples = max(1, min(64, round(FILTER / bench.Ts)))
    delayed = replace(fopdt, L=fopdt.L + (samples - 1) / 2 * bench.Ts)
    rule = table_1(delayed, outside="nearest")
    return Controller(
        gains=rule.gains,
        Ts=bench.Ts,
        alpha=rule.alpha,
        beta=rule.beta,
        N=DERIVATIVE_FILTER,
        u_min=-demands.u_max,
        u_max=demands.u_max,
        filter_samples=samples,
        counts_per_rev=bench.counts_per_rev,
        notes="Table 1 on the recorded step response",
    )


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
    variations: Sequence[tuple[float, int]] | None = None,
) -> TuningResult:
    """The gains of least cost over all members, each with the usual gain spread and delay.

    Raises
    ------
    Refusal
        Where every loop tried diverges.
    Interrupted
        On Ctrl-C; its `best` is the best controller so far.
    """
    try:
        return tune(
            models,
            list(references.values()),
            start=start,
            cost=cost,
            variations=variations,
            evaluations=demands.evaluations,
            seed=demands.seed,
            threads=demands.threads,
            progress=lambda done, total, best: progress(done, total),
        )
    except FitError as error:
        raise Refusal(
            f"expected gains under which no member of the ensemble runs away ({error}); record "
            "longer, or verify the first gains by hand"
        ) from error
