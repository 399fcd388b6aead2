"""Credit for a device that computes its own time: enough of it, and no flood where none is used."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from sewfast.link import run as chapter
from sewfast.link.run import Run

WATCHDOG_US = 250_000


class Host:
    """What a run asks of its connection; it keeps what was granted and when."""

    def __init__(self) -> None:
        self.newest, self.watchdog, self.watchdog_us = 0, 0.25, WATCHDOG_US
        self.identity = SimpleNamespace(on_credit=True, period_us=1000)
        self.outages: list[float] = []
        self.receiver = SimpleNamespace(anomalies=lambda: [], counters={})
        self.now = 0.0
        self.granted: list[tuple[float, int]] = []

    def grant(self, until: int) -> None:
        self.granted.append((self.now, until))


@pytest.fixture
def host(monkeypatch: pytest.MonkeyPatch) -> Host:
    made = Host()
    monkeypatch.setattr(chapter.time, "monotonic", lambda: made.now)
    return made


def begun(host: Host) -> Run:
    plan = SimpleNamespace(values=np.zeros(10_000), mode="commands")
    made: Any = Run(host, plan, SimpleNamespace(batch=10), None, None)  # type: ignore[arg-type]
    made.start_us = 0
    run: Run = made
    return run


def turned(host: Host, run: Run, seconds: float, advance_us: int) -> int:
    """Grants within so many seconds of turns every millisecond, the device advancing by so much."""
    before = len(host.granted)
    for _ in range(round(1000 * seconds)):
        host.now += 0.001
        host.newest += advance_us
        run._grant(host.now)
    return len(host.granted) - before


def test_a_device_that_is_busy_is_not_drowned_in_grants(host: Host) -> None:
    run = begun(host)
    # 14 bytes of body every 2 ms would be more than a serial port of 115,200 bit/s can carry
    assert turned(host, run, 2.0, 0) < 45
    waits = np.diff([when for when, _ in host.granted])
    assert waits.max() <= 0.065


def test_what_was_lost_is_granted_again_soon(host: Host) -> None:
    run = begun(host)
    turned(host, run, 0.01, 0)
    assert len(host.granted) >= 3
    assert len({until for _, until in host.granted}) == 1


def test_a_device_that_advances_has_always_time_ahead(host: Host) -> None:
    run = begun(host)
    turned(host, run, 1.0, 0)  # it was busy
    turned(host, run, 2.0, 5000)  # five times real time
    ahead = [
        until - 5000 * round(1000 * (when - 1.0)) for when, until in host.granted if when > 1.1
    ]
    assert min(ahead) > 0.5 * WATCHDOG_US
