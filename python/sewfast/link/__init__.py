"""The link to a real or virtual drive: ports, sessions, runs (docs/PROTOCOL.md).

Read in this order: `ports` (transports and their failures), `wire` (the frames' bodies as values),
`connection` (a session: the core's client on a port, and the device's clock), `drive` (`Drive`),
`plan` (a run's commands, its checks and its outcome), `run` (the loop of a run, and how it ends),
`record` (into memory, a file and a live view). Then `host_loop` and `host_run` (a controller on
this computer), `doctor`, and `virtual` (a device without a motor). Plug-ins add classes to this
unit by entry points `link.NAME` of the group `sewfast.names`.
"""

from typing import TYPE_CHECKING, Any

from ..plugins import on_first_use as _on_first_use
from ..plugins import public_name as _public_name

if TYPE_CHECKING:
    from .connection import ClockBounds
    from .doctor import Diagnosis, Finding, examine
    from .drive import Drive, connect
    from .host_loop import at_period, run_on_host
    from .host_run import HostLoopRun, Jitter
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

# whether a text names a port is asked before anything else, and needs `ports` alone
_own, __dir__ = _on_first_use(
    __name__,
    {
        "connection": "ClockBounds",
        "doctor": "Diagnosis Finding examine",
        "drive": "Drive connect",
        "host_loop": "at_period run_on_host",
        "host_run": "HostLoopRun Jitter",
        "plan": "Layout Outcome Plan Sink",
        "ports": "Port PortInfo list_ports open_port",
        "virtual": "VirtualDevice",
        "wire": "Channel Event Identity Limits Status",
    },
)


def __getattr__(name: str) -> Any:
    if name in __all__ or not name[:1].isupper():
        return _own(name)
    return _public_name(f"link.{name}")
