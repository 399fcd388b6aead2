"""Terms of host and device: channels, limits, controllers, and when the motor is at rest."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence

from ..control.controller import Controller
from ..errors import LinkError, SettingError
from ..gains import Gains, real
from ..units import counts_per_unit
from . import wire
from .connection import Connection
from .wire import Channel, Identity, Kind

# --- Terms of host and device: its channels, limits within its ceilings, controllers in its units -


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
            "expected channels that match the device's schema hash, got others; connect again, "
            "or mend the firmware"
        )
    found = tuple(map(wire.channel, bodies))
    if (found[0].encoding, found[1].encoding) != (0, 1):
        raise LinkError("expected channel 0 to be counts and 1 the command; mend the firmware")
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
            f"expected {name} above 0 and at most {ceiling:g}, the device's ceiling, got {value}; "
            f"{'lower' if value > ceiling else 'raise'} it"
        )
    return min(value, ceiling)


def fitting(controller: Controller, streamed: Sequence[Channel]) -> Gains:
    """The controller's gains in standard form.

    Raises
    ------
    SettingError
        Where they are not in the device's units.
    """
    units = {c.name: c.unit for c in streamed}
    gains = controller.gains.to("standard")
    _require_units(gains.u_unit, units.get("u", ""), "command")
    _require_units(gains.y_unit, units.get("feedback", "RPM"), "output")
    return gains


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
    if further and not identity.capabilities & wire.DESIGN:
        raise SettingError(
            f"expected a controller without {' and '.join(further)} for this device, whose "
            "firmware does not know them; leave them out, or build the firmware with this sewfast"
        )
    values = (
        g.Kp, g.Ti, g.Td, c.alpha, c.beta, c.N, c.Tt, c.u_min, c.u_max, c.slew, c.filter_time,
        counts_per_unit(identity.counts_per_rev, g.y_unit),
    )  # fmt: skip
    body = wire.gains(values, c.filter_samples)
    if not further:
        return body
    return body + wire.design(c.observer_time, c.r_rate, c.schedule_rows())


def _require_units(given: str, device: str, what: str) -> None:
    if given.lower() != device.lower():
        raise SettingError(
            f"expected a controller whose {what} is in {device}, as the device's, got {given}; "
            "convert its gains"
        )


# --- Rest: time that passes on the device until its motor stands still or it has measured well ----


REST_US = 120_000
"""Device's time without a count after which a motor is at rest; ARM wants 100 ms."""
STEP_US = 20_000
MEASURED_WITHIN = 1.0


def wait_for_rest(link: Connection, timeout: float) -> None:
    """Wait until the encoder has not moved for a while, as `Drive.wait_for_rest` says."""
    status = link.status()
    since = began = status.time_us
    # a device on credit that takes none must not be waited for either
    deadline = time.monotonic() + timeout + (5.0 if link.identity.on_credit else 0.0)
    while status.time_us - since < REST_US:
        if status.time_us - began > timeout * 1e6 or time.monotonic() > deadline:
            raise LinkError(
                f"expected the motor at rest within {timeout:g} s, it turns at "
                f"{status.speed_rpm:.0f} RPM; brake it or wait longer"
            )
        let_pass(link, STEP_US)
        before, status = status, link.status()
        if status.counts != before.counts:
            since = status.time_us


def await_measurement(link: Connection) -> None:
    """Boot ends by itself after some good samples; a device on credit needs time for them."""
    deadline = time.monotonic() + MEASURED_WITHIN
    while link.status().state == "boot" and time.monotonic() < deadline:
        let_pass(link, STEP_US)


def let_pass(link: Connection, us: int) -> None:
    """Grant time to a device on credit; take turns for as long with another."""
    if link.identity.on_credit:
        link.grant(link.newest + us)
        return
    until = time.monotonic() + us * 1e-6
    while (rest := until - time.monotonic()) > 0.0:
        link.turn(rest)
