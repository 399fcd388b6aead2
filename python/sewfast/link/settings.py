"""Before anything moves: the device's channels, limits within its ceilings, its controllers."""

from __future__ import annotations

import math
from collections.abc import Sequence

from ..control.controller import Controller, SampledController
from ..errors import LinkError, SettingError
from ..gains import Gains, real
from ..units import counts_per_unit, spelled
from . import wire
from .connection import Connection
from .wire import Channel, Identity, Kind


def channels(link: Connection) -> tuple[Channel, ...]:
    """What the device can stream, as it describes it.

    Raises
    ------
    LinkError
        Where that is not what its schema hash stands for.
    """
    identity = link.identity
    bodies = [link.ask(Kind.DESCRIBE, bytes([k])) for k in range(identity.channels)]
    if wire.schema_hash(identity.version, identity.period_us, bodies) != identity.schema:
        raise LinkError(
            name=link.port.url, expected="channels that match the device's schema hash",
            received="others", remedy="connect again, or fix the firmware",
        )  # fmt: skip
    found = tuple(map(wire.channel, bodies))
    if (found[0].encoding, found[1].encoding) != (0, 1):
        raise LinkError(
            name=link.port.url, expected="channel 0 to be counts and 1 the command",
            received=f"encodings {found[0].encoding} and {found[1].encoding}",
            remedy="fix the firmware",
        )  # fmt: skip
    return found


def limit(name: str, value: float | None, present: float, ceiling: float) -> float:
    """The limit to set: the one asked for, the one in force, or the device's ceiling.

    Raises
    ------
    SettingError
        For a limit that is not above 0 or is above the ceiling.
    """
    if value is None:
        return present if present else ceiling
    if not 0.0 < real(name, value) <= ceiling * (1.0 + 1e-6):
        raise SettingError(
            name=name, expected=f"above 0 and at most {ceiling:g}, the device's ceiling",
            received=f"{value}", remedy=f"{'lower' if value > ceiling else 'raise'} it",
        )  # fmt: skip
    return min(value, ceiling)


def require_units(controller: SampledController, streamed: Sequence[Channel]) -> None:
    """Refuse a controller in other units than the device's.

    Raises
    ------
    SettingError
        Where they are not in the device's units.
    """
    units = {c.name: c.unit for c in streamed}
    _require_units(controller.u_unit, units.get("u", ""), "command")
    _require_units(controller.y_unit, units.get("feedback", "RPM"), "output")


def fitting(controller: Controller, streamed: Sequence[Channel]) -> Gains:
    """The controller's gains in standard form; refuses other units as `require_units`."""
    require_units(controller, streamed)
    return controller.gains.to("standard")


def other_kind(
    controller: SampledController, streamed: Sequence[Channel], identity: Identity
) -> bytes:
    """Body of CONTROLLER for one that is no PID; the encoder is the device's own.

    Raises
    ------
    SettingError
        Where it is not in the device's units, or the device does not know it.
    """
    require_units(controller, streamed)
    if not identity.capabilities & wire.KINDS:
        raise SettingError(
            name="controller", expected="a PID (Controller) for this device",
            received=f"{type(controller).__name__}, which its firmware does not know",
            remedy="tune a PID (--controller pid), or build the firmware with this sewfast and set "
            "SEWFAST_CAN_KINDS",
        )  # fmt: skip
    kind, numbers = controller.sent()
    return wire.controller(
        kind, counts_per_unit(identity.counts_per_rev, controller.y_unit), numbers
    )


def gains(controller: Controller, streamed: Sequence[Channel], identity: Identity) -> bytes:
    """Body of GAINS for a controller; the encoder is the device's own.

    Raises
    ------
    SettingError
        Where its gains are not in the device's units, or the device does not know its parts.
    """
    g, c = fitting(controller, streamed), controller
    named = ("observer_time", bool(c.observer_time)), ("r_rate", c.r_rate != math.inf)
    further = [name for name, used in (*named, ("schedule", bool(c.schedule))) if used]
    unknown = [] if identity.capabilities & wire.DESIGN else list(further)
    if c.biquads and not identity.capabilities & wire.BIQUADS:
        unknown.append("biquads")
    if unknown:
        raise SettingError(
            name="controller", expected=f"one without {' and '.join(unknown)} for this device",
            received="one with what its firmware does not know",
            remedy="leave it out, or build the firmware with this sewfast",
        )  # fmt: skip
    values = (
        g.Kp, g.Ti, g.Td, c.alpha, c.beta, c.N, c.Tt, c.u_min, c.u_max, c.slew, c.filter_time,
        counts_per_unit(identity.counts_per_rev, g.y_unit),
    )  # fmt: skip
    design = (c.observer_time, c.r_rate, c.schedule_rows()) if further else None
    return wire.gains(values, c.filter_samples, design)


def _require_units(given: str, device: str, what: str) -> None:
    if spelled(given) != spelled(device):
        raise SettingError(
            name="controller", expected=f"one whose {what} is in {device}, as the device's",
            received=given, remedy="convert its gains",
        )  # fmt: skip
