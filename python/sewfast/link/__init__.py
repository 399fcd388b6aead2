"""The link to a real or virtual drive: ports, sessions, runs (docs/PROTOCOL.md)."""

from .connection import ClockBounds
from .doctor import Diagnosis, Finding, examine
from .drive import Drive, connect
from .host_loop import HostLoopRun, Jitter, at_period, run_on_host
from .plan import Layout, Outcome, Plan, Sink
from .ports import Port, PortInfo, list_ports, open_port
from .virtual import VirtualDevice
from .wire import Channel, Event, Identity, Limits, Status

__all__ = [
    "Channel",
    "ClockBounds",
    "Diagnosis",
    "Drive",
    "Event",
    "Finding",
    "HostLoopRun",
    "Identity",
    "Jitter",
    "Layout",
    "Limits",
    "Outcome",
    "Plan",
    "Port",
    "PortInfo",
    "Sink",
    "Status",
    "VirtualDevice",
    "at_period",
    "connect",
    "examine",
    "list_ports",
    "open_port",
    "run_on_host",
]
