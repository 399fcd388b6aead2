"""Rest: time that passes on the device until its motor stands still or it has measured well."""

from __future__ import annotations

import time

from ..errors import LinkError
from .connection import Connection

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
