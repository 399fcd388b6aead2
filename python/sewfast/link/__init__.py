"""The link to a real or virtual drive: ports, sessions, runs (docs/PROTOCOL.md)."""

from .clock import ClockBounds
from .drive import Drive, connect
from .plan import Layout, Outcome, Plan, Sink
from .ports import Port, PortInfo, list_ports, open_port
from .virtual import VirtualDevice
from .wire import Channel, Event, Identity, Limits, Status

__all__ = [
    "Channel",
    "ClockBounds",
    "Drive",
    "Event",
    "Identity",
    "Layout",
    "Limits",
    "Outcome",
    "Plan",
    "Port",
    "PortInfo",
    "Sink",
    "Status",
    "VirtualDevice",
    "connect",
    "list_ports",
    "open_port",
]
