"""A motor's parameters as settings of other tools: feed-forward gains, simulators, boards.

The fit knows a DC motor: volts and amperes whose product is power, and `torque = K i`. Boards for
three phases compute in the amplitudes of phase to neutral, `v = R i + lambda w` along q, of which
`3/2 v i` is power, so that `torque = 3/2 lambda i`. Two terminals of such a motor, one phase behind
the other, have twice its resistance and inductance, and between them the amplitude
`sqrt(3) lambda w`, by whose reciprocal [rpm/V] boards know the motor (KV): `torque = 8.27/KV i`.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from typing import TYPE_CHECKING, Literal, TypeAlias, get_args

from ..errors import SettingError

if TYPE_CHECKING:
    from .motor import Motor

Target: TypeAlias = Literal["wpilib", "mujoco", "urdf", "odrive", "moteus", "simplefoc"]
Winding: TypeAlias = Literal["line", "q"]
BOARDS = ("odrive", "moteus", "simplefoc")
AMPLITUDES = 1.5
"""Power over volts times amperes, where both are amplitudes of the q axis."""


def export(motor: Motor, target: Target, winding: Winding | None) -> str:
    """See `Motor.export`."""
    if target not in get_args(Target):
        raise SettingError(f"expected {', '.join(get_args(Target))} as target, received {target!r}")
    if winding not in (None, *get_args(Winding)) or (winding is None and target in BOARDS):
        raise SettingError(
            name="winding", expected='"line" or "q"', received=repr(winding),
            remedy="line: volts and amperes of the record are those between two terminals, as of a "
            "DC motor; q: amplitudes along the q axis, as boards log them",
        )  # fmt: skip
    factor = AMPLITUDES if winding == "q" else 1.0
    simulators = {"wpilib": _wpilib, "mujoco": _mujoco, "urdf": _urdf}
    if target in simulators:
        return simulators[target](motor, factor)
    return _BOARDS[target](Phase(motor, winding == "q"))


def _wpilib(motor: Motor, factor: float) -> str:
    gains = {"kS": motor.of["k_s"], "kV": motor.value("k_v"), "kA": motor.value("k_a")}
    u = motor.u_unit
    units = {"kS": u, "kV": f"{u}/(rad/s)", "kA": f"{u}/(rad/s^2)"}
    return json.dumps({"feedforward": gains, "units": units}, indent=1) + "\n"


def _torque(motor: Motor, name: str) -> float:
    """A term in N m, nothing where it is not shown."""
    K, R = motor.value("motor_constant"), motor.value("resistance_ohm")
    return motor.of[name] * K * motor.value("volts") / R


def _urdf(motor: Motor, factor: float) -> str:
    viscous, dry = (factor * _torque(motor, name) for name in ("k_b", "k_s"))
    return f'<dynamics damping="{viscous:.6g}" friction="{dry:.6g}"/>\n'


def _mujoco(motor: Motor, factor: float) -> str:
    viscous, dry = (factor * _torque(motor, name) for name in ("k_b", "k_s"))
    K, R, G = (motor.value(n) for n in ("motor_constant", "resistance_ohm", "volts"))
    return (
        f'<joint type="hinge" armature="{factor * motor.value("inertia"):.6g}" '
        f'damping="{viscous:.6g}" frictionloss="{dry:.6g}"/>\n'
        f'<general gainprm="{factor * K * G / R:.6g}" biastype="affine" '
        f'biasprm="0 0 {-factor * K * K / R:.6g}"/>\n'
    )


class Phase:
    """A motor as boards see it: amplitudes of phase to neutral.

    Attributes
    ----------
    resistance, inductance : float
        Of a phase [ohm], [H]; the inductance is None where the record does not show the lag.
    flux : float
        Amplitude of a phase's back-EMF per speed [V s/rad].
    torque_constant : float
        Torque per amplitude of the current along q [N m/A].
    KV : float
        Speed [rpm] per amplitude of the back-EMF between two terminals [V].
    inertia : float
        [kg m^2].
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
        self.origin = (
            "the record's volts and amperes as amplitudes along q: torque = 3/2 K i"
            if is_q
            else "the record's volts and amperes between two terminals: R/2, L/2, K sqrt(3)/2"
        )
        self.missing = "" if shown else "the inductance (the record does not show the lag), "


def _odrive(phase: Phase) -> str:
    axis = "odrv0.axis0"
    lines = [
        f"# ODrive, firmware 0.6; from {phase.origin}",
        f"{axis}.config.motor.torque_constant = {phase.torque_constant:.6g}  "
        f"# N m per A along q, 8.27/KV with KV = {phase.KV:.5g} rpm/V",
        f"{axis}.config.motor.phase_resistance = {phase.resistance:.6g}  # ohm",
        f"{axis}.controller.config.inertia = {2 * math.pi * phase.inertia:.6g}  # N m/(turn/s^2)",
        f"# not known from a record: {phase.missing}motor_type, pole_pairs, current_soft_max, "
        "current_hard_max, encoder and its offset, gains",
    ]
    if phase.inductance is not None:
        lines.insert(3, f"{axis}.config.motor.phase_inductance = {phase.inductance:.6g}  # H")
    return "\n".join(lines) + "\n"


def _moteus(phase: Phase) -> str:
    lines = [
        f"# moteus; from {phase.origin}; lines with # are notes",
        f"conf set motor.resistance_ohm {phase.resistance:.6g}",
        f"conf set motor.Kv {phase.KV:.6g}",
        f"conf set servo.inertia_feedforward {2 * math.pi * phase.inertia:.6g}",
        f"# not known from a record: {phase.missing}motor.poles, motor.phase_invert, motor.offset "
        "(moteus_tool --calibrate), servo.max_current_A, saturation (motor.rotation_...), gains",
    ]
    if phase.inductance is not None:
        lines.insert(3, f"conf set motor.inductance_q_H {phase.inductance:.6g}")
    return "\n".join(lines) + "\n"


def _simplefoc(phase: Phase) -> str:
    lines = [
        f"// SimpleFOC; from {phase.origin}",
        f"motor.phase_resistance = {phase.resistance:.6g};  // ohm, phase to neutral",
        f"motor.KV_rating = {phase.KV:.6g};  // rpm/V: back-EMF = speed/(KV sqrt(3))",
        f"// not known from a record: {phase.missing}pole pairs, direction and zero angle of the "
        "sensor, voltage_limit, current_limit, gains",
    ]
    if phase.inductance is not None:
        lines.insert(3, f"motor.phase_inductance = {phase.inductance:.6g};  // H")
    return "\n".join(lines) + "\n"


_BOARDS: dict[str, Callable[[Phase], str]] = {
    "odrive": _odrive,
    "moteus": _moteus,
    "simplefoc": _simplefoc,
}
