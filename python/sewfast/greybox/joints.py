"""`Joints`: several joints of a robot, one table; what is left of one that follows another."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from .. import _core
from ..arrays import FloatArray
from ..dataset import Dataset
from ..dataset.faults import sound
from ..errors import DataError, FitError, SettingError
from ..tables import Table, significant
from .joint import Joint, joint_of

FIRST = 20
"""Outputs that give the initial state of a free run."""
PARTS = 4
"""Parts of a record, in each of which a coupling must show by a fit to the others."""
SHOWN = ("inertia", "viscous", "friction", "gravity", "delay", "stiffness")
"""Parameters of the table; all are in each joint."""


@dataclass(frozen=True)
class Coupling:
    """What is left of one joint's free run and follows another joint.

    Attributes
    ----------
    joint, other : str
        Names of the joints.
    gravity, inertia : float
        Shares of the squared error that the other joint's angle explains, and beyond it the
        accelerations of both, on parts of the record that the regression has not seen; 0 where one
        of the parts shows nothing.
    """

    joint: str
    other: str
    gravity: float
    inertia: float

    def __str__(self) -> str:
        told = [
            f"{100.0 * share:.0f} % {what}"
            for share, what in ((self.gravity, "by its angle"), (self.inertia, "by acceleration"))
            if share > 0.0
        ]
        return (
            f"{self.joint}: what is left follows {self.other}, {', '.join(told)}; one joint's "
            f"equations hold where {self.other} stands as it was recorded"
        )


@dataclass(frozen=True, eq=False, repr=False)
class Joints(Mapping[str, Joint]):
    """The joints of a robot, each fitted alone: a mapping of `Joint` by name.

    Attributes
    ----------
    found : mapping of Joint by name
        Those that the record shows.
    unusable : mapping of str by name
        The others, and why: a joint that never moved, for example.
    couplings : tuple of Coupling
        What of each joint is left and follows another, the largest first; of joints with a
        controller inside, whose positions do not drift.
    """

    found: Mapping[str, Joint]
    unusable: Mapping[str, str]
    couplings: tuple[Coupling, ...]

    def __getitem__(self, name: str) -> Joint:
        return self.found[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self.found)

    def __len__(self) -> int:
        return len(self.found)

    def to_dict(self) -> dict[str, Any]:
        """Everything, as JSON values."""
        return {
            "joints": {name: joint.to_dict() for name, joint in self.found.items()},
            "unusable": dict(self.unusable),
            "couplings": [vars(c) for c in self.couplings],
        }

    def _table(self) -> Table:
        names = [n for n in SHOWN if any(n in j.parameters for j in self.values())]
        units = {n: p.unit for j in self.values() for n, p in j.parameters.items()}
        rows = []
        for name, joint in self.items():
            values = [
                significant(joint.parameters[n].value if n in joint.parameters else None)
                for n in names
            ]
            error = f"{significant(joint.rmse)} {joint.model.output_unit}".strip()
            rows.append((name, f"{joint.fit_percent:.1f}", error, *values, ", ".join(joint.terms)))
        header = ("joint", "fit [%]", "rmse", *(f"{n} [{units[n]}]" for n in names), "terms")
        return Table(f"{len(self)} joints, each fitted alone", header, tuple(rows), words=True)

    def _notes(self) -> list[str]:
        return [
            *(f"{n}: not fitted, {w}" for n, w in self.unusable.items()),
            *map(str, self.couplings),
        ]

    def _repr_html_(self) -> str:
        return self._table().to_html(self._notes())

    def __repr__(self) -> str:
        return f"<{len(self)} joints: {', '.join(self)}>"

    def __str__(self) -> str:
        return "\n".join([self._table().to_text(), *self._notes()])


def joints_of(
    data: Mapping[str, Dataset], look: Callable[[str], object] = lambda _: None
) -> Joints:
    """Fit each joint, and look for what is left and follows another."""
    found, records, unusable = dict[str, Joint](), dict[str, Dataset](), dict[str, str]()
    for name, one in data.items():
        look(name)
        try:
            records[name] = sound(one)[0]
            found[name] = joint_of(records[name])
        except (DataError, FitError) as e:
            unusable[name] = str(e)
    if not found:
        raise DataError(
            name="data", expected="at least one joint that moves as its command says",
            received="; ".join(f"{n}: {w}" for n, w in unusable.items()) or "no joint",
            remedy="record moves of each joint, in both directions",
        )  # fmt: skip
    return Joints(found, unusable, _couplings(found, records))


def _couplings(joints: Mapping[str, Joint], records: Mapping[str, Dataset]) -> tuple[Coupling, ...]:
    inside = {name: joint for name, joint in joints.items() if joint.inside}
    runs = {name: _run(joint, records[name]) for name, joint in inside.items()}
    found = []
    for name, (run, left) in runs.items():
        for other, (angle, _) in runs.items():
            if other != name and len(angle) == len(run):
                own, gravity, inertia = _columns(run, angle)
                by_angle = _share(left, own, gravity)
                by_acceleration = _share(left, np.hstack([own, gravity]), inertia)
                if by_angle > 0.0 or by_acceleration > 0.0:
                    found.append(Coupling(name, other, by_angle, by_acceleration))
    return tuple(sorted(found, key=lambda c: -c.gravity - c.inertia))


def _run(joint: Joint, data: Dataset) -> tuple[FloatArray, FloatArray]:
    """Free run [rad] and what it leaves of the record, (N,); NaN where nothing was measured."""
    from ..motorfit.joint import factor

    core, runs, left = joint.model.core, [], []
    for e in data.experiments:
        state = core.estimate_initial_state(e.u[:FIRST], e.y[:FIRST])
        run = core.simulate(np.ascontiguousarray(e.u), state)
        runs.append(factor(data.output_unit) * run)
        left.append(e.y - run)
    return np.concatenate(runs), np.concatenate(left)


def _columns(q: FloatArray, other: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """What a joint's own motion can explain, the other's angle, and the accelerations of both.

    Gravity on a chain is a sum of sines of sums of angles, which are products of these.
    """
    turned = np.column_stack([np.sin(other), np.cos(other)])
    alone = np.column_stack([np.ones_like(q), np.sin(q), np.cos(q)])
    bend, other_bend = (np.gradient(np.gradient(a))[:, None] for a in (q, other))
    gravity = np.hstack([alone * turned[:, :1], alone * turned[:, 1:]])
    inertia = np.hstack([bend * turned, other_bend, other_bend * turned])
    return np.hstack([alone, bend, bend * alone[:, 1:]]), gravity, inertia


def _share(left: FloatArray, own: FloatArray, more: FloatArray) -> float:
    """Share of what `own` columns leave that `more` explain in all parts; 0 unless in each."""
    known = np.isfinite(left)
    x = np.ascontiguousarray(np.hstack([own, more])[known])
    try:
        shares = _core.explained(x, left[known], own=own.shape[1], parts=PARTS)
    except (DataError, SettingError):
        return 0.0
    return float(np.mean(shares)) if min(shares) > 0.0 else 0.0
