"""Gains of a drive's own position controller for a wanted bandwidth, and what they cannot do."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

from ..errors import SettingError
from ..gains import real
from ..motorfit.joint import factor
from ..tables import significant

if TYPE_CHECKING:
    from .joint import Joint


@dataclass(frozen=True)
class InnerGains:
    """Gains of a drive's own controller, relative to those that the record was made with.

    Attributes
    ----------
    bandwidth : float
        Natural frequency of the position loop [Hz].
    kp_factor : float
        New proportional gain over the present one.
    kd_change : float
        What is added to the derivative gain, in present proportional gains [s]; below 0 it is less.
    damping_ratio : float
        Of the closed loop.
    phase_margin : float
        Of the open loop [deg], if the controller inside is not late and all damping is its own.
    delay_margin : float
        By how much it may be late until the loop is unstable [s].
    sag, stick : float
        Position error under the weight at its largest, and against dry friction [`unit`]: a
        controller without integral and feedforward of gravity leaves it.
    reach : float or None
        Position error at which the controller is at its limit [`unit`]; None if the record does not
        show one.
    unit : str
        Unit of the position command.
    """

    bandwidth: float
    kp_factor: float
    kd_change: float
    damping_ratio: float
    phase_margin: float
    delay_margin: float
    sag: float
    stick: float
    reach: float | None
    unit: str

    def to_dict(self) -> dict[str, Any]:
        """Everything, as JSON values."""
        return asdict(self)

    def __str__(self) -> str:
        lines = [
            f"for {significant(self.bandwidth)} Hz and a damping ratio of "
            f"{significant(self.damping_ratio)}: kp times {significant(self.kp_factor)}, "
            f"{significant(1e3 * self.kd_change)} ms times the present kp added to kd",
            f"  phase margin {self.phase_margin:.0f} deg if the controller inside is not late; it "
            f"may be late by {significant(1e3 * self.delay_margin)} ms",
            f"  stays {significant(self.stick)} {self.unit} off against friction, sags "
            f"{significant(self.sag)} {self.unit} under the weight: only an integral or a "
            "feedforward of gravity brings that to 0",
        ]
        if self.reach is not None:
            lines.append(
                f"  at its limit from an error of {significant(self.reach)} {self.unit} on: larger "
                "steps are not followed at this bandwidth"
            )
        return "\n".join(lines)


def inner_gains(joint: Joint, bandwidth: float, damping_ratio: float) -> InnerGains:
    """The gains of `Joint.inner_gains`. With the present gain as the unit the closed loop is
    ``inertia s^2 + viscous s + 1``, where `viscous` holds the present kd (and `damping` it, if a
    limit parted the two).
    """
    if not joint.inside:
        raise SettingError(
            name="joint", expected="a controller inside, whose command is a position",
            received="a command that drives the joint", remedy="tune a controller: sewfast.tune",
        )  # fmt: skip
    bandwidth, damping_ratio = real("bandwidth", bandwidth), real("damping_ratio", damping_ratio)
    for name, value, least, most in (
        ("bandwidth", bandwidth, 1e-6, 1e6), ("damping_ratio", damping_ratio, 1e-3, 1e3),
    ):  # fmt: skip
        if not least <= value <= most:
            raise SettingError(
                name=name, expected=f"a number from {least:g} to {most:g}", received=f"{value:g}",
                remedy="bandwidth in Hz, damping_ratio 1 for no overshoot",
            )  # fmt: skip
    of, model = joint.parameters, joint.model
    # in position errors per acceleration, and per speed
    same = factor(model.input_units[0]) / factor(model.output_unit)
    k_a = same * joint.value("inertia")

    def known(name: str) -> float:
        return abs(of[name].value) if name in of else 0.0

    w = 2.0 * math.pi * bandwidth
    kp, damping = k_a * w * w, 2.0 * damping_ratio * w * k_a
    # |kp + damping s| = |inertia s^2| at the crossover, which is 1 in squares of w
    crossover = w * math.sqrt(2.0 * damping_ratio**2 + math.sqrt(4.0 * damping_ratio**4 + 1.0))
    margin = math.atan2(damping * crossover, kp)
    return InnerGains(
        bandwidth, kp, damping - same * known("viscous") - known("damping"), damping_ratio,
        math.degrees(margin), margin / crossover, (known("gravity") + known("offset")) / kp,
        known("friction") / kp, known("reach") / kp or None, model.input_units[0],
    )  # fmt: skip
