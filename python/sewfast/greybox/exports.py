"""A motor's parameters as settings of other tools: feed-forward gains, simulators, boards.

The fit is that of a DC motor: the product of volts and amperes is power, and `torque = K i`. Boards
for three phases compute with amplitudes of phase to neutral, `v = R i + lambda w` along q, with
power `3/2 v i`, so that `torque = 3/2 lambda i`. Between two terminals of such a motor, two phases
in series, there is twice the resistance and inductance, and the amplitude of the back-EMF is
`sqrt(3) lambda w`; its reciprocal [rpm/V] is the KV of boards: `torque = 8.27/KV i`.
"""

from __future__ import annotations

import json
import math
from typing import TYPE_CHECKING, Literal, TypeAlias, get_args

from ..errors import SettingError

if TYPE_CHECKING:
    from .motor import Motor

Target: TypeAlias = Literal["wpilib", "mujoco", "urdf", "odrive", "moteus", "simplefoc"]
Winding: TypeAlias = Literal["line", "q"]
AMPLITUDES = 1.5
"""Power over volts times amperes, for amplitudes along the q axis."""


def export(motor: Motor, target: Target, winding: Winding | None, gear: float) -> str:
    """See `Motor.export`."""
    if target not in get_args(Target):
        raise SettingError(f"expected {', '.join(get_args(Target))} as target, received {target!r}")
    if winding not in (None, *get_args(Winding)) or (winding is None and target in BOARDS):
        raise SettingError(
            name="winding", expected='"line" or "q"', received=repr(winding),
            remedy="line: volts and amperes of the record are those between two terminals, as of a "
            "DC motor; q: amplitudes along the q axis, as boards log them",
        )  # fmt: skip
    if not (isinstance(gear, (int, float)) and math.isfinite(gear) and gear > 0):
        raise SettingError(
            name="gear", expected="turns of the motor per turn of the joint, above 0",
            received=repr(gear), remedy="1 (the default) where the joint is the motor's shaft",
        )  # fmt: skip
    factor = AMPLITUDES if winding == "q" else 1.0
    simulators = {"wpilib": _wpilib, "mujoco": _mujoco, "urdf": _urdf}
    if target in simulators:
        return simulators[target](motor, factor, float(gear))
    if gear != 1:
        raise SettingError(
            name="gear", expected=f"none with {target}", received=f"{gear:g}",
            remedy="leave it out: a board's settings are those of the motor's own shaft",
        )  # fmt: skip
    return _board(target, Phase(motor, winding == "q"))


def _wpilib(motor: Motor, factor: float, gear: float) -> str:
    k_v, k_a = (gear * motor.value(name) for name in ("k_v", "k_a"))
    gains = {"kS": motor.of["k_s"], "kV": k_v, "kA": k_a}
    u = motor.u_unit
    units = {"kS": u, "kV": f"{u}/(rad/s)", "kA": f"{u}/(rad/s^2)"}
    if "offset" in motor.parameters:  # a constant load, as that of an elevator
        gains["kG"], units["kG"] = motor.value("offset"), u
    if (
        "load_1" in motor.parameters and gear == 1.0
    ):  # an arm on the shaft: kG cos(angle - horizontal)
        of = motor.of
        gains["kG_cos"], units["kG_cos"] = motor.value("load_1"), u
        gains["horizontal"], units["horizontal"] = math.atan2(of["load_1s"], of["load_1c"]), "rad"
    return json.dumps({"feedforward": gains, "units": units}, indent=1) + "\n"


def _torque(motor: Motor, name: str) -> float:
    """A term in N m; 0 if the record does not show it."""
    K, R = motor.value("motor_constant"), motor.value("resistance_ohm")
    return motor.of[name] * K * motor.value("volts") / R


def _at_joint(motor: Motor, factor: float, gear: float) -> tuple[float, float]:
    """Viscous [N m s/rad] and dry friction [N m] of the motor, reflected to its joint."""
    viscous, dry = (factor * _torque(motor, name) for name in ("k_b", "k_s"))
    return gear**2 * viscous, gear * dry


def _urdf(motor: Motor, factor: float, gear: float) -> str:
    viscous, dry = _at_joint(motor, factor, gear)
    return f'<dynamics damping="{viscous:.6g}" friction="{dry:.6g}"/>\n'


def _mujoco(motor: Motor, factor: float, gear: float) -> str:
    viscous, dry = _at_joint(motor, factor, gear)
    K, R, G = (motor.value(n) for n in ("motor_constant", "resistance_ohm", "volts"))
    gears = "" if gear == 1.0 else f'gear="{gear:.6g}" '
    return (
        f'<joint type="hinge" armature="{factor * gear**2 * motor.value("inertia"):.6g}" '
        f'damping="{viscous:.6g}" frictionloss="{dry:.6g}"/>\n'
        f'<general {gears}gainprm="{factor * K * G / R:.6g}" biastype="affine" '
        f'biasprm="0 0 {-factor * K * K / R:.6g}"/>\n'
    )


class Phase:
    """A motor in the quantities of boards: amplitudes of phase to neutral.
    `resistance` [ohm] and `inductance` [H] are those of a phase; the latter is None if the lag is
    not shown. `flux` is the amplitude of a phase's back-EMF per speed [V s/rad], `torque_constant`
    is per amplitude of the current along q [N m/A], and `KV` per amplitude of the back-EMF between
    two terminals [rpm/V]. `inertia` is in kg m^2, `inertia_of_turns` per turn instead of radian.
    """

    def __init__(self, motor: Motor, is_q: bool) -> None:
        half = 1.0 if is_q else 0.5
        self.resistance = half * motor.value("resistance_ohm")
        shown = "inductance" in motor.parameters
        self.inductance = half * motor.value("inductance") if shown else None
        self.flux = motor.value("motor_constant") / (1.0 if is_q else math.sqrt(3.0))
        self.torque_constant = AMPLITUDES * self.flux
        self.KV = 30.0 / math.pi / (math.sqrt(3.0) * self.flux)
        self.inertia = motor.value("inertia") * (AMPLITUDES if is_q else 1.0)
        self.inertia_of_turns = 2.0 * math.pi * self.inertia
        self.origin = (
            "the record's volts and amperes as amplitudes along q: torque = 3/2 K i"
            if is_q
            else "the record's volts and amperes between two terminals: R/2, L/2, K sqrt(3)/2"
        )
        self.missing = "" if shown else "the inductance (the record does not show the lag), "


BOARDS = {
    "odrive": (
        "# ODrive, firmware 0.6; from {p.origin}",
        "odrv0.axis0.config.motor.torque_constant = {p.torque_constant:.6g}  "
        "# N m per A along q, 8.27/KV with KV = {p.KV:.5g} rpm/V",
        "odrv0.axis0.config.motor.phase_resistance = {p.resistance:.6g}  # ohm",
        "odrv0.axis0.config.motor.phase_inductance = {p.inductance:.6g}  # H",
        "odrv0.axis0.controller.config.inertia = {p.inertia_of_turns:.6g}  # N m/(turn/s^2)",
        "# not known from a record: {p.missing}motor_type, pole_pairs, current_soft_max, "
        "current_hard_max, encoder and its offset, gains",
    ),
    "moteus": (
        "# moteus; from {p.origin}; lines with # are notes",
        "conf set motor.resistance_ohm {p.resistance:.6g}",
        "conf set motor.Kv {p.KV:.6g}",
        "conf set motor.inductance_q_H {p.inductance:.6g}",
        "conf set servo.inertia_feedforward {p.inertia_of_turns:.6g}",
        "# not known from a record: {p.missing}motor.poles, motor.phase_invert, motor.offset "
        "(moteus_tool --calibrate), servo.max_current_A, saturation (motor.rotation_...), gains",
    ),
    "simplefoc": (
        "// SimpleFOC; from {p.origin}",
        "motor.phase_resistance = {p.resistance:.6g};  // ohm, phase to neutral",
        "motor.KV_rating = {p.KV:.6g};  // rpm/V: back-EMF = speed/(KV sqrt(3))",
        "motor.phase_inductance = {p.inductance:.6g};  // H",
        "// not known from a record: {p.missing}pole pairs, direction and zero angle of the "
        "sensor, voltage_limit, current_limit, gains",
    ),
}
"""Lines of each board's settings; an unknown inductance is left out."""


def _board(target: str, phase: Phase) -> str:
    lines = [
        line
        for line in BOARDS[target]
        if phase.inductance is not None or "{p.inductance" not in line
    ]
    return "\n".join(lines).format(p=phase) + "\n"
