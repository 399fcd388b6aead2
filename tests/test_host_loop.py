"""The loop on the host: its thread over a pseudo-terminal, its results."""

from __future__ import annotations

import contextlib
import os
import tty
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

from sewfast import Controller, Gains, _core
from sewfast.errors import SettingError

CONTROLLER = Controller(
    Gains.standard(0.004, 0.15, 0.0), Ts=0.01, u_min=-10.0, u_max=10.0, counts_per_rev=1572
)


@pytest.fixture
def terminal() -> Iterator[tuple[int, int]]:
    """Descriptors of a pseudo-terminal: the device's end, the host's."""
    device, host = os.openpty()
    tty.setraw(host)
    yield device, host
    for descriptor in (device, host):
        with contextlib.suppress(OSError):
            os.close(descriptor)


def _host_loop(port: int, **changed: Any) -> dict[str, Any]:
    settings: dict[str, Any] = {
        "tag": 1, "command": 0, "heartbeat": 0, "device_period": 1000, "ratio": 10,
        "watchdog": 50_000, "batch": 10, "mask": 1, "channels": [(0, 1)], "counts_per_unit": 26.2,
    }  # fmt: skip
    return _core.host_loop(port, CONTROLLER.core(), np.full(10, 100.0), **settings | changed)


def test_a_device_that_is_not_there_is_an_outcome(terminal: tuple[int, int]) -> None:
    found = _host_loop(terminal[1])
    assert found["outcome"] == {"name": "unanswered", "command": 0x05}
    assert not found["stopped"]
    assert len(found["times"]) == 0
    assert found["sequences"] == (2, 0)
    frames = os.read(terminal[0], 4096).split(b"\0")
    assert len(frames) == 21, "ten times ARM, ten times STOP"


def test_a_port_that_vanishes_is_an_outcome(terminal: tuple[int, int]) -> None:
    os.close(terminal[0])
    found = _host_loop(terminal[1])
    assert found["outcome"]["name"] == "port_lost"
    assert "os error" in found["outcome"]["text"]


def test_refuses_what_cannot_run(terminal: tuple[int, int]) -> None:
    with pytest.raises(SettingError, match="watchdog time longer than"):
        _host_loop(terminal[1], watchdog=5000)
    with pytest.raises(SettingError, match="an open port"):
        _host_loop(-1)
