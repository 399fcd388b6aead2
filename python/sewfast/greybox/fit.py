"""`physics`: parameters of a motor by output error, as far as the record shows them."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Literal, TypeAlias, get_args, overload

from numpy.typing import ArrayLike

from ..dataset import Dataset
from ..dataset.faults import sound
from ..errors import SettingError
from ..motorfit import OPTIONAL, TERMS, WAVES, estimated, records_of
from ..recording import Recording
from ..units import is_position
from .equations import EquationFit, Equations, fit_equations
from .joint import Joint, joint_of
from .joints import Joints, joints_of
from .motor import Motor, motor_of

Intervals: TypeAlias = Literal["curvature", "profile"]
_Given: TypeAlias = dict[str, object]

STRUCTURES = {
    "dcmotor": tuple(t for t in TERMS if t not in OPTIONAL),
    "cogging": WAVES[:3],
}
"""Names for groups of terms."""


@overload
def physics(
    data: Mapping[str, Dataset], *, structure: Literal["joint"] | None = None
) -> Joints: ...


@overload
def physics(  # type: ignore[overload-overlap]
    data: Dataset, *, structure: Literal["joint"]
) -> Joint: ...


@overload
def physics(
    data: Recording | Dataset,
    *,
    structure: str | Sequence[str] | None = None,
    current: str | ArrayLike | None = None,
    volts: float | None = None,
    speed_unit: str | None = None,
    intervals: Intervals = "curvature",
) -> Motor: ...


@overload
def physics(
    data: Recording | Dataset,
    *,
    equations: Equations,
    parameters: Mapping[str, float | Sequence[float]],
    states: int = 1,
    substeps: int = 1,
    speed_unit: str | None = None,
) -> EquationFit: ...


def physics(
    data: Recording | Dataset | Mapping[str, Dataset],
    *,
    structure: str | Sequence[str] | None = None,
    current: str | ArrayLike | None = None,
    volts: float | None = None,
    speed_unit: str | None = None,
    intervals: Intervals = "curvature",
    equations: Equations | None = None,
    parameters: Mapping[str, float | Sequence[float]] | None = None,
    states: int = 1,
    substeps: int = 1,
) -> Motor | EquationFit | Joint | Joints:
    """Friction, inertia and electrical constants of a motor from one record, with 95 % intervals.

    Command and speed alone determine the command per speed `k_v` and per acceleration `k_a`, dry
    friction `k_s`, lag, delay and variations over the turn, all in units of the command. R, Ke and
    J then each scale with an unmeasured quantity and are not printed. A measured `current` adds the
    resistance [command/A] and separates k_v into back-EMF and viscous friction; with `volts` as
    well, all are in SI units.

    If the output is a position (``structure="joint"``), the command drives the joint or, if it has
    the output's unit, is a position command to a controller inside; see docs/joints.md.

    Parameters
    ----------
    data : Recording or Dataset, or mapping of Dataset by name
        One input; of a `Recording` the counts are fitted. Random steps in both directions for 10 s
        show most; several experiments are fitted together. A mapping, as of `read_joints`, is one
        of joints.
    structure : "dcmotor", "joint" or sequence of str, optional
        By default "joint" if the output is an angle or a length, else "dcmotor". Possible terms, of
        `lag`, `delay`, `coulomb`, `offset`, `drop`, `stribeck`, `load_1`, `load_2`, `inertia_2`
        (varying once, twice per turn), `cogging` and `torque_ripple` (whose orders per turn are
        searched), `limit`, `stribeck_difference` (by direction), `sag` (of the supply) and
        `eccentricity` (of the encoder). "dcmotor" means all of them, the last three only if they
        stand out clearly; ``["dcmotor", "sag"]`` tries one of these in any case. A term that the
        record does not show is omitted.
    current : str or array, shape (N,), optional
        Motor current [A]: a channel of the data set, or its samples.
    volts : float, optional
        Volts on the winding per unit of command; 1 if the command is that voltage.
    speed_unit : str, optional
        rpm, rad/s, rev/s or deg/s, if the data set has no unit.
    intervals : "curvature" or "profile"
        Method for the 95 % intervals: curvature of the cost, or profile likelihood, which also
        follows a cost that is not parabolic: asymmetric intervals, at the cost of some seconds.
    equations : callable, optional
        Your own equations instead of the motor's: ``f(x, u, p)`` returns the derivatives of the
        state ``x``, shape (states,), under the command ``u``; ``p`` has the parameters by name. The
        first state is the speed [rad/s], others start at zero. Slow, since Python is called four
        times a sample (for each set of parameters, unless the function takes arrays as well as
        numbers).
    parameters : mapping, optional
        For `equations`: a start by name, or (start, least, largest).
    states : int
        For `equations`: number of states.
    substeps : int
        For `equations`: steps of the Runge-Kutta integration per sample.

    Returns
    -------
    Motor or, with `equations`, EquationFit, of a position Joint, of several joints Joints
        Parameters with intervals, and the names of those that the record does not determine.

    Raises
    ------
    DataError
        If speed or command do not change, the speed falls as the command rises (a sign is
        wrong), the two are exchanged or one is computed from the other, or too few samples are
        left. What a dead sensor said is left out.
    SettingError
        For an unknown term or unit, equations that return another shape, or parameters without
        a start.
    FitError
        If nothing converges to a motor; if the equations raise, give no finite run, or a
        parameter ends at its bound.

    Notes
    -----
    Equations: `rust/core/src/greybox.rs`; conventions of kS, kV, kA as in WPILib's system
    identification. Errors are those of the free run.
    """
    if isinstance(data, Mapping):
        beside: _Given = {"equations": equations, "parameters": parameters}
        if structure not in (None, "joint", ["joint"]):
            beside["structure"] = structure
        _require_none(beside | _of_motors(current, volts, speed_unit, intervals), "several joints")
        return joints_of({name: _positions(one) for name, one in data.items()})
    if equations is not None or parameters is not None:
        if equations is None or parameters is None or structure is not None or current is not None:
            raise SettingError(
                name="equations", expected="equations with parameters, and neither current nor "
                "structure", received="other arguments beside them, or one of the two",
                remedy="pass equations=f, parameters={'J': 1e-3, ...}",
            )  # fmt: skip
        records = records_of(data, None, speed_unit)
        return fit_equations(records, equations, parameters, states=states, substeps=substeps)
    if is_joint(data, structure, speed_unit):
        _require_none(_of_motors(current, volts, speed_unit, intervals), "a joint")
        return joint_of(sound(_positions(data))[0])
    structure = "dcmotor" if structure is None else structure
    if intervals not in get_args(Intervals):
        raise SettingError(
            name="intervals", expected="curvature or profile", received=repr(intervals),
            remedy="profile takes some seconds more, and gives asymmetric intervals",
        )  # fmt: skip
    terms = _terms(structure)
    if volts is not None and not (
        isinstance(volts, (int, float)) and math.isfinite(volts) and volts > 0
    ):
        raise SettingError(f"expected volts per unit of command above 0, received {volts!r}")
    if isinstance(data, Dataset):
        data, _ = sound(data)
    records = records_of(data, current, speed_unit)
    found = estimated(records, terms, if_clear=OPTIONAL if "dcmotor" in structure else ())
    return motor_of(found, volts, profile=intervals == "profile")


def is_joint(data: object, structure: object, speed_unit: str | None) -> bool:
    """Whether the data are those of a joint: as `structure` says, else if the output is a position
    that `speed_unit` does not call a speed.
    """
    if structure is None:
        stated = data.output_unit if isinstance(data, Dataset) else ""
        return speed_unit is None and is_position(stated)
    return structure in ("joint", ["joint"])


def _of_motors(current: object, volts: object, speed_unit: object, intervals: str) -> _Given:
    """The settings that a joint has not, None where they are left out."""
    own = None if intervals == "curvature" else intervals
    return {"current": current, "volts": volts, "speed_unit": speed_unit, "intervals": own}


def _require_none(given: _Given, what: str) -> None:
    for name, value in given.items():
        if value is not None:
            raise SettingError(
                name=name, expected=f"none for {what}, fitted to command and position",
                received=repr(value), remedy="leave it out",
            )  # fmt: skip


def _positions(data: object) -> Dataset:
    """The data, whose output is a position."""
    if not isinstance(data, Dataset):
        raise SettingError(
            name="data", expected="a Dataset whose output is a position",
            received=type(data).__name__,
            remedy="Dataset.from_arrays(u, position, Ts, output_unit='rad') makes one of arrays",
        )  # fmt: skip
    if not is_position(data.output_unit):
        raise SettingError(
            name="output_unit", expected="an angle or a length: rad, deg, rev, m, mm, counts",
            received=repr(data.output_unit), remedy="name the unit of the position",
        )  # fmt: skip
    return data


def _terms(structure: str | Sequence[str]) -> tuple[str, ...]:
    known = ", ".join([*STRUCTURES, *(t for t in TERMS if t not in WAVES[:3])])
    if isinstance(structure, str) and structure not in STRUCTURES:
        raise SettingError(
            f"expected structure {', '.join(STRUCTURES)} or a list of terms, received "
            f"{structure!r}; terms are {known}"
        )
    wanted: list[str] = []
    for t in [structure] if isinstance(structure, str) else structure:
        wanted += STRUCTURES.get(t, (t,))
    for t in wanted:
        if t not in TERMS:
            raise SettingError(f"expected terms of {known}, received {t!r}")
    if "stribeck_difference" in wanted:
        wanted.append("stribeck")
    return tuple(t for t in TERMS if t in wanted)
