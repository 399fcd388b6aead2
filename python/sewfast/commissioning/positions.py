"""A position loop over commissioned gains, and the stops that it is verified by."""

from __future__ import annotations

import statistics
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ..control.controller import Controller
from ..control.machine import Machine
from ..control.position import PositionController
from ..control.stops import AFTER, PositionRun, stop_at
from ..dataset import FloatArray
from ..errors import FitError, SettingError
from ..models import Ensemble, Model
from ..recording import Recording
from ..tuning.objective import Constraints, Cost
from ..tuning.position import PositionTuning, ending, with_position
from ..tuning.task import Budget, TuningTask
from .demands import Refusal

STOPS = ((0.25, "90deg"), (0.5, "180deg"), (1.0, "270deg"))
"""Speeds of the stops that verify, as parts of the top of the working range, and their angles."""


class Unsuited(Refusal):
    """The models allow no position loop. The machine has kept to its references: nothing is wrong
    with it.
    """


@dataclass(frozen=True, eq=False)
class Stop:
    """A stop at an angle: predicted by each model, and on the machine, None before it ran."""

    name: str
    predicted: tuple[PositionRun, ...]
    measured: PositionRun | None = None

    def to_json(self) -> dict[str, Any]:
        """What the models and the machine did, in degrees, turns and seconds."""
        names = ("off", "passed", "turns", "time", "rest_counts")
        every = [run.metrics() for run in self.predicted]
        measured = None if self.measured is None else self.measured.metrics()
        return {
            "name": self.name,
            "predicted": {name: _median([m[name] for m in every]) for name in names},
            "measured": None if measured is None else {name: measured[name] for name in names},
        }

    def __str__(self) -> str:
        found = self.to_json()
        text = f"  {self.name:<14} off predicted {found['predicted']['off']:.3g}"
        if found["measured"] is None:
            return f"{text} deg"
        m = found["measured"]
        return f"{text}, measured {m['off']:.3g} deg; passed by {m['passed']:.3g} deg"


def _median(values: Sequence[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return statistics.median(known) if len(known) == len(values) else None


def position_loop(
    controller: Controller, ensemble: Ensemble, practice: Mapping[str, FloatArray], cost: Cost,
    small: Model | None, top: float,
) -> PositionTuning:  # fmt: skip
    """The position loop over a verified speed loop; `Unsuited` if there is none within its limits.

    Ms is that on the machine's `small` signals or, without them, on every member. No stop begins
    above the `top` of the planned speeds [RPM].
    """
    if ensemble.members[0].Ts > 1.01 * controller.Ts:
        raise Unsuited(
            "expected models at the machine's sample time for a position loop, got slower ones of "
            f"a slow drive at {ensemble.members[0].Ts:g} s; the speed loop is verified and kept"
        )
    task = TuningTask.of(
        ensemble, list(practice.values()), start=controller, first={}, cost=cost, aggregate="mean",
        constraints=None if small is None else Constraints(plant=small), variations=None,
    ).with_loops(Budget(None))  # fmt: skip
    try:
        found = with_position(task, controller)
    except FitError as error:
        raise Unsuited(f"{error}; the speed loop is verified and kept") from error
    law = replace(found.controller, fastest=min(found.controller.fastest, top))
    return replace(found, controller=law)


def verified_stops(
    law: PositionController, machine: Machine, ensemble: Ensemble, speed: float,
    keep: Callable[[tuple[Stop, ...]], object],
) -> tuple[Stop, ...]:  # fmt: skip
    """The stops on the models, then on the machine until it misses one: the next ones are faster.
    `keep` gets them as they come.
    """
    asked = [(angle, min(share * speed, law.fastest)) for share, angle in STOPS]

    def run(on: Model | Machine, angle: str, begun: float) -> PositionRun:
        return stop_at(law, on, angle, speed=begun, after=AFTER + ending(law))

    stops = [
        Stop(f"{angle} from {begun:.4g} RPM", tuple(run(m, angle, begun) for m in ensemble.members))
        for angle, begun in asked
    ]
    keep(tuple(stops))
    for k, (angle, begun) in enumerate(asked):
        try:
            measured = run(machine, angle, begun)
        except SettingError as error:  # moves beyond the limits of a device
            raise Unsuited(f"{error}; the speed loop is verified and kept") from error
        stops[k] = replace(stops[k], measured=measured)
        keep(tuple(stops))
        if unmet(stops):
            break
    return tuple(stops)


def telling(
    runs: Sequence[Recording], stops: Sequence[Stop], law: PositionController
) -> list[Recording]:
    """The runs of a machine, of which the last are its stops, without what says little about it: a
    shaft that lands creeps, or is held, and friction decides which commands move it.
    """
    made = [stop.measured for stop in stops if stop.measured is not None]
    first = len(runs) - len(made)
    return [
        *runs[:first],
        *(_until(r, _landed(m, law)) for r, m in zip(runs[first:], made, strict=True)),
    ]


def _landed(run: PositionRun, law: PositionController) -> int:
    """The sample from which a shaft stays within the landing before its goal; N if it does not."""
    # a goal that is unknown, as the link lost samples, is none to land at
    far = ~(np.abs(run.counts - run.goal[-1]) <= law.landing)
    return int(np.max(np.flatnonzero(far), initial=-1)) + 1


def _until(recording: Recording, samples: int) -> Recording:
    columns = {name: getattr(recording, name)[:samples] for name in ("u", "counts", "y")}
    return replace(recording, **columns, speed_true=None)


def unmet(stops: Sequence[Stop]) -> str:
    """What the machine's stops did that must not be; empty if nothing."""
    found = []
    for stop in stops:
        if stop.measured is not None:
            found += [f"{stop.name}: {warning}" for warning in stop.measured.warnings]
            if not found and stop.measured.metrics()["rest_counts"] is None:
                found.append(f"{stop.name}: has not come to rest within its run")
    return "; ".join(found)
