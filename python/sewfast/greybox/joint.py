"""`Joint`: the parameters of a joint that its positions determine, and the names of the others."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, TypeAlias

import numpy as np

from .. import _core, storage
from ..arrays import FloatArray
from ..dataset import Dataset
from ..dataset.experiment import in_effect, weights_of
from ..frequency.shaft import Parameter
from ..models.grey_box import JOINT as JOINT_NAMES
from ..models.grey_box import NAMES as MOTOR_NAMES
from ..models.grey_box import GreyBox
from ..motorfit.estimation import CONFIDENCE
from ..motorfit.joint import fitted, is_commanded
from .inner_gains import InnerGains, inner_gains
from .joint_exports import JointTarget, Replay, checked, export
from .motor import APART, VAGUE, Findings, stored_parameters

Values: TypeAlias = Mapping[str, float]
_INSIDE = {
    "k_p": "encoder and command show the controller's gain only relative to the inertia; it takes "
    "a known inertia, or a current and its torque constant",
    "inertia_kg_m2": "encoder and command show it only in units of the controller's gain",
    "lag": "behind a controller it acts as a part of the delay",
}
_SIGNED = {"offset", "stribeck"}
_OF_TERM = {"loaded": "load_friction"}
_DIRECT = {
    "inertia_kg_m2": "encoder and command show it only in units of the command; it takes the "
    "torque per command",
}


@dataclass(frozen=True, eq=False, repr=False)
class Joint(Findings):
    """The parameters of a joint, identified from positions.

    Attributes
    ----------
    parameters : mapping of Parameter by name
        Value, 95 % interval and unit, in units of the command, or if `inside`, of the position
        command: `inertia` (per acceleration), `viscous` (per speed), `friction` (against dry
        friction), `offset`, `delay`; if `inside`, `stiffness` (k_p / J). Of the terms that the
        record shows

        - `lag`; `gravity`; `cogging` (amplitude) and `cogging_period`,
        - `stribeck`, `stribeck_speed` and `stribeck_exponent`, `load_friction` (per load that the
          gears carry), `drive_friction` and `outer_friction` (per drive, and per load from
          outside), `quadratic_friction` (per square of the drive),
        - `creep` (speed under a friction that holds, per acceleration of the other forces) and
          `settling` (time in which it stops the joint, beyond `creep`),
        - `dead_band`, `reach` (largest output of the controller) and `damping` (k_d / k_p), `rate`
          (of the controller's setpoint),
        - `backlash` (its whole width), `load_share` and `rub_share` (parts of inertia and dry
          friction behind it).
    undetermined : mapping of str by name
        Parameters that the record does not determine, and why.
    terms : tuple of str
        Terms that the record shows.
    inside : bool
        Whether the command is a position, for a controller inside.
    fit_percent, rmse : float
        Fit of the free runs over the pieces of the record; rmse in `output_unit`.
    model : GreyBox
        The joint as a model: `simulate`, `sewfast.run`, `sewfast.tune`.
    """

    FORMAT: ClassVar[str] = "sewfast-joint"
    VERSION: ClassVar[int] = 1

    parameters: Mapping[str, Parameter]
    undetermined: Mapping[str, str]
    terms: tuple[str, ...]
    inside: bool
    fit_percent: float
    rmse: float
    samples: int
    model: GreyBox

    def to_model(self) -> GreyBox:
        """The joint as a model for loops and free runs."""
        return self.model

    def export(self, target: JointTarget, *, inertia: float | None = None) -> str:
        """The joint as a part of a simulator.

        Parameters
        ----------
        target : "mujoco", "urdf" or "json"
            A MuJoCo model of joint and actuator; the `dynamics` of a URDF joint; or all parameters
            by the names of Rhoban's better actuator models.
        inertia : float, optional
            Known inertia of the joint with its load and motor [kg m^2; kg of an axis], for forces
            in N m (or N). Without it they are in units of the command.

        Raises
        ------
        SettingError
            For another target, or an inertia that is not above 0.
        """
        return export(self, target, inertia)

    def check(self, data: Dataset, *, inertia: float | None = None) -> Replay:
        """Replay a record in MuJoCo on the exported model, and say how its free run differs.

        Parameters
        ----------
        data : Dataset
            A record of the same joint.
        inertia : float, optional
            As for `export`.

        Returns
        -------
        Replay

        Raises
        ------
        SettingError
            If the package mujoco is not installed.
        """
        return checked(self, export(self, "mujoco", inertia), in_effect(data))

    def inner_gains(self, bandwidth: float, *, damping_ratio: float = 1.0) -> InnerGains:
        """Gains of the drive's own controller for a wanted bandwidth, and what they cannot do.

        Parameters
        ----------
        bandwidth : float
            Natural frequency of the position loop [Hz].
        damping_ratio : float
            Of the closed loop; 1 is the least without overshoot.

        Raises
        ------
        SettingError
            If no controller is inside, or for numbers that are not above 0.
        DataError
            If the record does not determine the inertia.

        Notes
        -----
        A rigid joint under PD: Franklin, Powell and Emami-Naeini, *Feedback Control of Dynamic
        Systems*, section 3.4. kp is proportional to the square of the bandwidth, which is its
        stiffness.
        """
        return inner_gains(self, bandwidth, damping_ratio)

    def to_dict(self) -> dict[str, Any]:
        """Everything, as JSON values."""
        return {
            "parameters": {n: vars(p) for n, p in self.parameters.items()},
            "undetermined": dict(self.undetermined),
            "terms": list(self.terms),
            "inside": self.inside,
            "fit_percent": self.fit_percent,
            "rmse": self.rmse,
            "samples": self.samples,
            "model": self.model.to_dict(),
        }

    def __str__(self) -> str:
        terms = ", ".join(self.terms) or "no further terms"
        what = "joint with a controller inside" if self.inside else "joint"
        lines = [
            f"{what}: free run {self.fit_percent:.2f} %, {self.rmse:.3g} {self.model.output_unit} "
            f"rmse of {self.samples:,} samples ({terms}); 95 % intervals"
        ]
        return "\n".join([*lines, *self._lines()])


def joint_of(data: Dataset) -> Joint:
    """The joint of a record of positions: each parameter with its interval, or why it has none."""
    data = in_effect(data)
    data.require_excited()
    inside = is_commanded(data)
    fit = fitted(data, integrates=not inside, covariance=True)
    core, covariance, determined = fit.core, fit.covariance, fit.determined
    assert covariance is not None
    assert determined is not None
    names = [(*MOTOR_NAMES, *JOINT_NAMES)[j] for j in core.settings["free"]]
    known = dict(zip(MOTOR_NAMES, core.settings["values"].tolist(), strict=True))
    known |= dict(zip(JOINT_NAMES, core.settings["joint"], strict=True))
    parameters: dict[str, Parameter] = {}
    undetermined: dict[str, str] = {}
    for name, unit, of in _quantities(core, fit.terms, data, inside):
        value = of(known)
        slope = _slope(known, of, names)
        half = CONFIDENCE * math.sqrt(max(float(slope @ covariance @ slope), 0.0))
        if not determined[slope != 0.0].all():
            half = math.inf
        # an offset or a delay of 0 is a valid result
        least = {"delay": data.Ts, "offset": known["k_s"]}.get(name, 0.0)
        if half < VAGUE * max(abs(value), least):
            low = value - half if name in _SIGNED else max(value - half, 0.0)
            parameters[name] = Parameter(value, low, value + half, unit)
        elif half < APART * max(abs(value), least):
            undetermined[name] = (
                f"its interval, {value - half:.3g} to {value + half:.3g} {unit}, is as wide as its "
                "value"
            )
        else:
            undetermined[name] = "the record does not part it from the others"
    undetermined |= {_OF_TERM.get(t, t): "not shown, if there is any" for t in fit.missing}
    undetermined |= _INSIDE if inside else _DIRECT
    y = np.concatenate([e.y for e in data.experiments])
    w = np.concatenate([weights_of(e) for e in data.experiments])[np.isfinite(y)]
    y = y[np.isfinite(y)]
    spread = math.sqrt(np.average((y - np.average(y, weights=w)) ** 2, weights=w))
    rmse = math.sqrt(core.settings["residual_variance"])
    d = data
    training = {
        "input_range": [list(r) for r in d.input_range],
        "output_range": list(d.output_range),
    }
    model = GreyBox(
        core, d.Ts, d.input_names, d.output_name, d.input_units, d.output_unit, d.counts, training
    )
    return Joint(
        parameters, undetermined, fit.terms, inside,
        100.0 * (1.0 - rmse / max(spread, 1e-300)), rmse, len(y), model,
    )  # fmt: skip


Quantity: TypeAlias = tuple[str, str, Callable[[Values], float]]


def _quantities(
    core: _core.GreyBox, terms: tuple[str, ...], data: Dataset, inside: bool
) -> list[Quantity]:
    """Name, unit and value of every quantity that can be printed."""
    u, y = data.input_units[0] or "command", data.output_unit or "output"
    unit = float(core.settings["unit"])
    found: list[Quantity] = [
        ("inertia", f"{u}/({y}/s^2)", lambda p: p["k_a"] * unit),
        ("viscous", f"{u}/({y}/s)", lambda p: (p["k_e"] + p["k_b"]) * unit),
        ("friction", u, lambda p: p["k_s"]),
        ("offset", u, lambda p: p["offset"]),
        ("delay", "s", lambda p: p["delay"]),
    ]
    if inside:
        found.append(("stiffness", "1/s^2", lambda p: p["k_q"] / p["k_a"]))
    of_terms: dict[str, list[Quantity]] = {
        "lag": [("lag", "s", lambda p: p["tau"])],
        "stribeck": [
            ("stribeck", u, lambda p: p["k_t"]),
            ("stribeck_speed", f"{y}/s", lambda p: p["w_s"] / unit),
            ("stribeck_exponent", "1", lambda p: p["exponent"]),
        ],
        "gravity": [("gravity", u, lambda p: math.hypot(p["load_1c"], p["load_1s"]))],
        "loaded": [("load_friction", "1", lambda p: p["k_l"])],
        "directional": [
            ("drive_friction", "1", lambda p: p["k_m"]),
            ("outer_friction", "1", lambda p: p["k_g"]),
        ],
        "quadratic": [("quadratic_friction", f"1/{u}", lambda p: p["k_mm"])],
        "creep": [("creep", "s", lambda p: p["creep"])],
        "settling": [("settling", "s", lambda p: p["settling"])],
        "reach": [
            ("reach", u, lambda p: p["reach"]),
            ("damping", "s", lambda p: p["damping"] / p["k_q"]),
        ],
        "dead_band": [("dead_band", u, lambda p: p["dead_band"])],
        "rate": [("rate", f"{u}/s", lambda p: p["rate"])],
        "backlash": [
            ("backlash", y, lambda p: 2.0 * p["play"] / unit),
            ("load_share", "1", lambda p: p["load_share"]),
            ("rub_share", "1", lambda p: p["rub_share"]),
        ],
        "cogging": [
            ("cogging", u, lambda p: math.hypot(p["cogging_c"], p["cogging_s"])),
            ("cogging_period", y, lambda p: 2.0 * math.pi / p["cogging_order"] / unit),
        ],
    }
    return found + [q for t in terms for q in of_terms[t]]


def _slope(known: Values, of: Callable[[Values], float], names: list[str]) -> FloatArray:
    """Derivatives of a quantity by the free parameters, (n,)."""
    slope = np.zeros(len(names))
    for j, name in enumerate(names):
        h = 1e-4 * abs(known[name]) or 1e-9
        more, less = (of({**known, name: known[name] + s * h}) for s in (1.0, -1.0))
        slope[j] = (more - less) / (2.0 * h)
    return slope


def load_joint(path: str | os.PathLike[str]) -> Joint:
    """Read a file of `Joint.save`; nothing in it is executed.

    Raises
    ------
    ModelFileError
        For any other file.
    """
    from ..models.files import restored

    document = storage.read(path, Joint.FORMAT, (Joint.VERSION,))
    fields = storage.Fields(str(path), document)
    parameters, undetermined = stored_parameters(fields)
    model = restored(dict(fields.object("model").values), ())
    if not isinstance(model, GreyBox):
        raise fields.refuse("model", "a grey box", model.kind)
    return Joint(
        parameters, undetermined, tuple(map(str, fields.items("terms"))), fields.flag("inside"),
        fields.number("fit_percent"), fields.number("rmse"), fields.integer("samples"), model,
    )  # fmt: skip
