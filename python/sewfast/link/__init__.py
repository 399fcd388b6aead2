"""The link to a real or virtual drive: ports, sessions, runs (docs/PROTOCOL.md).

Read in this order: `ports` (transports, their failures), `wire` (what bodies stand for),
`connection` (a session: commands repeated until answered, heartbeats, the clocks), `drive`
(`Drive`), `plan` (what a run is to do, and what became of it), `run` (the pump of a run with its
way out). Beside them: `host_loop` (a controller on this computer), `doctor`, `virtual` and
`emulated` (devices without a motor).
"""

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
