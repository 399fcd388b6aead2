"""Waiting for what is to happen, however long a busy machine takes over it."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from typing import Any

from sewfast.link import VirtualDevice

PATIENCE = 60.0
"""Long enough for any machine; reached only where something is wrong [s]."""


def until(condition: Callable[[], Any], patience: float = PATIENCE) -> Any:
    """What a condition gives as soon as it is true.

    It is asked less often the longer it takes: a browser that is asked for a text 200 times a
    second keeps a processor from what is waited for.
    """
    began = time.monotonic()
    while not (found := condition()):
        waited = time.monotonic() - began
        assert waited < patience, "it did not happen"
        time.sleep(min(0.005 + 0.05 * waited, 0.1))
    return found


def is_on(device: VirtualDevice) -> bool:
    """Whether the output has been on."""
    return any(entry["event"] == "on" for entry in device.trace())


def once_on(device: VirtualDevice, action: Callable[[], object], after: float) -> threading.Thread:
    """Have something done, some seconds after the output of a device has come on."""

    def act() -> None:
        until(lambda: is_on(device))
        time.sleep(after)
        action()

    thread = threading.Thread(target=act, daemon=True)
    thread.start()
    return thread
