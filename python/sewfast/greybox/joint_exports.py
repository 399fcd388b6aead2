"""A joint as a part of a simulator, and the way back: what the simulator makes of the record.

Encoder and command show forces only in units of the command. With a known inertia they are in N m
(or N); without it, one unit of the command is 1 N m, or of a controller inside, its gain 1 N m/rad.
Positions of a simulator are the same in either case.
"""

from __future__ import annotations

import importlib
import json
import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal, TypeAlias, get_args

import numpy as np

from ..arrays import FloatArray
from ..dataset import Dataset, Experiment
from ..errors import SettingError, not_installed
from ..motorfit.joint import factor, is_commanded
from ..units import spelled

if TYPE_CHECKING:
    from .joint import Joint

JointTarget: TypeAlias = Literal["mujoco", "urdf", "json"]
TIMESTEP = 1e-3
"""Longest time step of the MuJoCo model [s]."""
GRAVITY = 9.81
POINT = 0.01
"""Share of the inertia in the point mass that carries gravity; it can be any below 1."""
SETTLING = 2.0
"""Least time constant of MuJoCo's friction constraint [time steps]: its `refsafe`."""
LATER = {
    "stribeck": "friction that falls with speed",
    "loaded": "friction per load",
    "directional": "friction per drive and load",
    "quadratic": "friction per square of the drive",
    "dead_band": "dead band of the controller",
    "rate": "limit of the setpoint's rate",
    "backlash": "backlash",
    "cogging": "cogging",
}
"""Terms that MuJoCo's joint and actuator do not have."""


@dataclass(frozen=True)
class Replay:
    """Differences of a simulator's free run from the record and from the joint's own free run.

    Attributes
    ----------
    of_record, of_model : float
        Root mean squares, in the record's unit.
    span : float
        Largest less smallest recorded position.
    missing : tuple of str
        What the simulator's model does not have.
    """

    of_record: float
    of_model: float
    span: float
    missing: tuple[str, ...]
    unit: str

    def __str__(self) -> str:
        share = 100.0 * self.of_model / max(self.span, 1e-300)
        without = f"; it has no {', no '.join(self.missing)}" if self.missing else ""
        return (
            f"MuJoCo's free run differs from the joint's by {self.of_model:.3g} {self.unit} rms, "
            f"{share:.2f} % of the span, and from the record by {self.of_record:.3g} {self.unit}"
            f"{without}"
        )


def export(joint: Joint, target: str, inertia: float | None) -> str:
    """See `Joint.export`."""
    if target not in get_args(JointTarget):
        raise SettingError(
            f"expected {', '.join(get_args(JointTarget))} as target, received {target!r}"
        )
    if inertia is not None and not (math.isfinite(inertia) and inertia > 0.0):
        raise SettingError(
            name="inertia", expected="an inertia of the joint above 0, in kg m^2 (kg of an axis)",
            received=repr(inertia), remedy="leave it out to get forces in units of the command",
        )  # fmt: skip
    if spelled(joint.model.output_unit) == "counts":
        raise SettingError(
            name="joint", expected="positions in rad, deg, rev, m or mm",
            received="counts, which do not say whether it turns or slides",
            remedy="convert command and position: counts * 2 pi / counts of a turn",
        )  # fmt: skip
    parts = _Parts(joint, inertia)
    if target == "mujoco":
        return _mujoco(parts)
    if target == "urdf":
        return f'<dynamics damping="{parts.damping:.6g}" friction="{parts.dry:.6g}"/>\n'
    return json.dumps(parts.named(), indent=1) + "\n"


class _Parts:
    """The joint's parameters as forces: [N m] per rad, with a known inertia."""

    def __init__(self, joint: Joint, inertia: float | None) -> None:
        of = {**joint.model.motor, **joint.model.joint}
        self.of, self.joint, self.known = of, joint, inertia is not None
        k_q = of["k_q"]
        self.scale = inertia / of["k_a"] if inertia is not None else 1.0 / (k_q or 1.0)
        self.is_slide = is_length(joint)
        self.inertia, self.dry = self.scale * of["k_a"], self.scale * of["k_s"]
        self.damping = self.scale * (of["k_e"] + of["k_b"])
        self.gain = self.scale * (k_q or 1.0)
        self.offset = self.scale * of["offset"]
        self.gravity = self.scale * of["load_1c"], self.scale * of["load_1s"]

    @property
    def unit(self) -> str:
        if self.known:
            return "N" if self.is_slide else "N m"
        return "units of k_p" if self.joint.inside else self.joint.model.input_units[0] or "command"

    def missing(self) -> tuple[str, ...]:
        return tuple(text for term, text in LATER.items() if term in self.joint.terms)

    def named(self) -> dict[str, Any]:
        """Parameters by name, as Rhoban's better actuator models and PD simulators call them."""
        of, scale = self.of, self.scale
        found: dict[str, Any] = {
            "force_unit": self.unit,
            "armature": self.inertia,
            "friction_viscous": self.damping,
            "friction_base": self.dry,
            "friction_stribeck": scale * of["k_t"],
            "dtheta_stribeck": of["w_s"] if of["k_t"] else 0.0,
            "alpha": of["exponent"],
            "load_friction": of["k_l"],
            "load_friction_motor": of["k_m"],
            "load_friction_external": of["k_g"],
            "load_friction_motor_quad": of["k_mm"] / scale,
            "gravity_cos": self.gravity[0],
            "gravity_sin": self.gravity[1],
            "offset": self.offset,
            "delay": of["delay"],
            "lag": of["tau"],
            "backlash": 2.0 * of["play"],
            "load_share": of["load_share"],
            "rub_share": of["rub_share"],
            "cogging_cos": scale * of["cogging_c"],
            "cogging_sin": scale * of["cogging_s"],
            "cogging_order": of["cogging_order"],
            "friction_creep": of["creep"],
            "friction_settling": of["creep"] + of["settling"],
        }
        if self.joint.inside:
            found |= {
                "kp": self.gain,
                "kd": scale * of["damping"],
                "force_limit": scale * of["reach"] or None,
                "dead_band": of["dead_band"] / of["k_q"],
                "rate": of["rate"] / of["k_q"] or None,
            }
        return found


def is_length(joint: Joint) -> bool:
    """Whether the joint slides."""
    from ..units import radians

    return radians(joint.model.output_unit) is None


def _mujoco(parts: _Parts) -> str:
    of, scale, inside = parts.of, parts.scale, parts.joint.inside
    step = parts.joint.model.Ts / math.ceil(parts.joint.model.Ts / TIMESTEP)
    kind, name = ("slide", "1 0 0") if parts.is_slide else ("hinge", "0 1 0")
    pull = math.hypot(*parts.gravity)
    mass, arm = 1e-6 * parts.inertia, (0.0, 0.0)
    if pull > 0.0:
        # m g r is the pull and m r^2 a part of the inertia; the pull's direction gives x and z
        mass = pull**2 / (GRAVITY**2 * POINT * parts.inertia)
        arm = (-parts.gravity[0] / (mass * GRAVITY), -parts.gravity[1] / (mass * GRAVITY))
    own = mass if parts.is_slide else mass * (arm[0] ** 2 + arm[1] ** 2)
    # its speed falls off within half of MuJoCo's time constant, as firm as it does not creep
    settling = max(SETTLING * step, 2.0 * (of["creep"] + of["settling"]))
    firm = min(max(1.0 - 2.0 * of["creep"] / settling, 1e-4), 0.9999)
    delay = f' delay="{of["delay"]:.6g}" nsample="{math.ceil(of["delay"] / step) + 2}"'
    late = delay if of["delay"] > 0.0 else ""
    limit = scale * of["reach"]
    clip = f' forcelimited="true" forcerange="{-limit:.6g} {limit:.6g}"' if limit > 0.0 else ""
    lag = f' dyntype="filterexact" dynprm="{of["tau"]:.6g}"' if of["tau"] > 0.0 else ""
    actuator = (
        f'<position name="drive" joint="joint" kp="{parts.gain:.6g}" '
        f'kv="{scale * of["damping"]:.6g}"{clip}{late}/>'
        if inside
        else f'<general name="drive" joint="joint" gainprm="{parts.gain:.6g}"{lag}{late}/>'
    )
    missing = parts.missing()
    note = f"; not in it: {', '.join(missing)}" if missing else ""
    return f"""<mujoco model="joint">
  <!-- forces in {parts.unit.replace("--", "- -")}; the point mass carries gravity{note} -->
  <compiler angle="radian"/>
  <option timestep="{step:.9g}" integrator="implicitfast" gravity="0 0 -{GRAVITY}"/>
  <worldbody>
    <body name="link">
      <joint name="joint" type="{kind}" axis="{name}" armature="{parts.inertia - own:.6g}"
        damping="{parts.damping:.6g}" frictionloss="{parts.dry:.6g}"
        solreffriction="{settling:.6g} 1" solimpfriction="{firm:.6g} {firm:.6g} 0.001"/>
      <inertial pos="{arm[0]:.6g} 0 {arm[1]:.6g}" mass="{mass:.6g}"
        diaginertia="1e-12 1e-12 1e-12"/>
    </body>
  </worldbody>
  <actuator>
    {actuator}
    <general name="offset" joint="joint" biastype="affine" biasprm="{-parts.offset:.6g} 0 0"/>
  </actuator>
</mujoco>
"""


def simulator() -> Any:
    """The package mujoco; `SettingError` without it."""
    try:
        return importlib.import_module("mujoco")
    except ImportError as error:
        raise not_installed("mujoco", "a check in MuJoCo", "mujoco") from error


def checked(joint: Joint, text: str, data: Dataset) -> Replay:
    """Build MuJoCo's model from an export, replay a record, and say how it differs.

    Raises `SettingError` without the package mujoco.
    """
    mujoco = simulator()
    model = mujoco.MjModel.from_xml_string(text)
    off: list[FloatArray] = []
    apart: list[FloatArray] = []
    own = joint.model.core
    to_command = factor(data.input_units[0]) if is_commanded(data) else 1.0
    for e in data.experiments:
        first = e.initial_samples(30)
        state = own.estimate_initial_state(e.u[:first], e.y[:first])
        simulated = _replayed(mujoco, model, joint, e, state, to_command)
        off.append(simulated - e.y)
        apart.append(simulated - own.simulate(e.u, state))
    y = np.concatenate([e.y for e in data.experiments])

    def rms(parts: list[FloatArray]) -> float:
        return float(np.sqrt(np.nanmean(np.concatenate(parts) ** 2)))

    return Replay(
        rms(off), rms(apart), float(np.nanmax(y) - np.nanmin(y)), _Parts(joint, None).missing(),
        data.output_unit,
    )  # fmt: skip


def _replayed(
    mujoco: Any, model: Any, joint: Joint, e: Experiment, state: FloatArray, to_command: float
) -> FloatArray:
    """Positions of MuJoCo's free run at the samples, (N,)."""
    data, s = mujoco.MjData(model), joint.model.settings
    data.qvel[0], data.qpos[0] = state[0] * s["speed_scale"], state[3] * s["unit"]
    u = to_command * e.u[:, 0]
    if model.nhistory:
        count = int(model.actuator_history[0][0])
        held = np.full((count, 1), u[0])
        mujoco.mj_initCtrlHistory(model, data, 0, None, held)
    if model.na:
        data.act[0] = u[0]
    every = round(joint.model.Ts / model.opt.timestep)
    found = np.empty(len(u))
    for k in range(len(u)):
        data.ctrl[0] = u[max(k - 1, 0)]
        mujoco.mj_step(model, data, nstep=every)
        found[k] = data.qpos[0]
    return found / float(s["unit"])
