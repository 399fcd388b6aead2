"""`Requirements`: what tuned gains must bear whatever they cost."""

from __future__ import annotations

import math
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ..constraints import Constraints
from ..control import Controller, Fopdt
from ..errors import FitError, SettingError
from ..linear_plant import sampled
from ..load_step import LoadStep
from ..models import Ensemble, Model
from ..robustness import margins
from ..tuning import recoveries
from .demands import Demands
from .references import pace_of
from .small_signal import SmallSignal

LOAD = 0.1
"""Of the largest command: the load that comes on unless another is asked for."""
LEVEL = 0.75
"""Of the top speed, where it comes on and where networks are linearised."""
RECOVERED = 0.01
"""Of what the load would do to the speed without control."""
HAIR = 1.001
"""What a limit taken from the rule's own gains leaves above them, so that these meet it."""
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
        linear = _linear(ensemble.members, demands, rival.Ts) if demands.Ms is not None else []
        speed = LEVEL * demands.speed
        if small is not None and demands.Ms is not None:
            # what answers within milliseconds, a shaft above all, is in no network of a drive
            linear = [*linear, small.model]
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


def _linear(members: Sequence[Model], demands: Demands, Ts: float) -> list[Model]:
    """Members that can be linearised where the load comes on."""
    found = []
    for member in members:
        with suppress(SettingError):
            sampled(member, Ts, LEVEL * demands.speed)
            found.append(member)
    return found
