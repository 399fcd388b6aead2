"""`Plan`: the commands of a run, and its checks against the device; `Outcome`: its result."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal, Protocol, TypeAlias

import numpy as np
from numpy.typing import NDArray

from ..control.controller import Controller, SampledController
from ..control.position import Playing, PositionController
from ..errors import LinkError, SettingError
from ..gains import Gains, real, vector
from ..units import counts_per_unit, spelled
from . import wire
from .connection import ClockBounds, Connection
from .wire import Channel, Identity, Kind, Limits

Mode: TypeAlias = Literal["commands", "controller", "direct", "positions"]
Columns: TypeAlias = Mapping[str, NDArray[np.float64]]

DEFAULTS: dict[str, tuple[str, ...]] = {
    "commands": ("speed_true",),
    "controller": ("speed_true", "feedback", "r"),
    "direct": ("speed_true",),
    "positions": ("speed_true", "feedback", "r"),
}
"""Streamed besides `counts` and `u` if the device has them; a low baud rate drops the last."""
_CAPABILITIES = {"commands": wire.PROFILE, "controller": wire.PID, "direct": wire.DIRECT}
_CAPABILITIES["positions"] = wire.POSITIONS


@dataclass(frozen=True)
class Plan:
    """The commands or the references of a run, and what to stream.

    Parameters
    ----------
    mode : "commands", "controller", "direct" or "positions"
        Upload `values` as commands; run `controller` on the device with them as references; send
        each as a command at its time, which suits only slow plants; or go from goal to goal.
    values : array, shape (N,)
        Commands in the unit of channel `u`, references in the unit of the controller's output, or
        goals [counts].
    controller : Controller, StateFeedback, PositionController or None
        For mode "controller" and, one of positions, for mode "positions".
    columns : sequence of str or None
        Channels to stream besides `counts` and `u`; None for as many of the mode's usual ones as
        the baud rate carries.
    batch : int or None
        Samples in a frame; None for the smallest number from 10 on that the baud rate carries.

    Raises
    ------
    DataError
        For values that are not numbers or not one-dimensional.
    SettingError
        For a mode, values or a controller that do not go together.
    """

    mode: Mode
    values: NDArray[np.float64]
    controller: SampledController | None = None
    columns: Sequence[str] | None = None
    batch: int | None = None

    def __post_init__(self) -> None:
        if self.mode not in wire.MODES:
            raise SettingError(
                name="mode", expected=f"one of {', '.join(wire.MODES)}", received=repr(self.mode)
            )
        values = vector("values", self.values).copy()
        if not 0 < len(values) < 2**32 or not np.all(np.isfinite(values)):
            raise SettingError(
                name="values", expected="at least one, all finite",
                received=f"{len(values)}, {np.count_nonzero(~np.isfinite(values))} of them not",
                remedy="mend the signal",
            )  # fmt: skip
        values.setflags(write=False)
        object.__setattr__(self, "values", values)
        if (self.controller is None) == (self.mode in ("controller", "positions")):
            raise SettingError(
                name="controller",
                expected="one in the modes 'controller' and 'positions' and none elsewhere",
                received=f"{'none' if self.controller is None else 'one'} in mode {self.mode!r}",
            )  # fmt: skip
        if self.mode == "positions" and not isinstance(self.controller, PositionController):
            raise SettingError(
                name="controller", expected="a PositionController in the mode 'positions'",
                received="a controller without a position loop",
                remedy="tune one with loop='position' (sewfast tune --loop position)",
            )  # fmt: skip


class Sink(Protocol):
    """Receives the samples and events of a run; called on its thread, so it must be quick."""

    def samples(self, first: int, columns: Columns) -> None:
        """Samples `first`, `first + 1`, ... without a gap: arrays (n,) by channel."""

    def event(self, kind: str, index: int, **detail: object) -> None:
        """Something happened at sample `index`.

        Kinds: those of the device (armed, started, finished, stopped, tripped), and stop_at, gap,
        port_lost, resumed, reset, stop_unconfirmed.
        """


@dataclass(frozen=True)
class Outcome:
    """The result of a run.

    Parameters
    ----------
    state : str
        State of the device at the end.
    reason : str
        "finished", "stopped", "cancelled", "interrupted", "failed", or why the device tripped.
    received : int
        Samples that arrived.
    taken : int or None
        Samples that the device took; None if it could not be asked.
    gaps : tuple of (first, count)
        Missing samples.
    anomalies : tuple of (kind, sequence, count)
        Frames out of order: their kind, first sequence number and count.
    clock : ClockBounds or None
        None on credit, where there is no wall clock.
    columns : tuple of str
        Channels streamed.
    batch : int
        Samples in a frame.
    counters : mapping
        Numbers of frames and samples, in and out of order.
    stop : tuple or None
        A stop that was asked for in mid-run (`Drive.stop_at`): the sample with which it began, its
        angle [counts] and whether it went onward.
    """

    state: str
    reason: str
    received: int
    taken: int | None
    gaps: tuple[tuple[int, int], ...]
    anomalies: tuple[tuple[str, int, int], ...]
    clock: ClockBounds | None
    columns: tuple[str, ...] = ()
    batch: int = 0
    counters: Mapping[str, int] = field(default_factory=dict)
    stop: tuple[int, float, bool] | None = None

    @property
    def is_complete(self) -> bool:
        """Whether every sample that the device took arrived."""
        return self.taken == self.received and not self.gaps

    def __str__(self) -> str:
        of = "an unknown number" if self.taken is None else f"{self.taken}"
        gaps = ", ".join(f"{n} from sample {k}" for k, n in self.gaps[:5]) or "none"
        more = f" and {len(self.gaps) - 5} more" if len(self.gaps) > 5 else ""
        return f"{self.reason} ({self.state}); {self.received} of {of} samples; gaps: {gaps}{more}"


@dataclass(frozen=True)
class Layout:
    """The channels that a run streams and the number of samples in a frame."""

    channels: tuple[Channel, ...]
    batch: int

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(c.name for c in self.channels)

    @property
    def mask(self) -> int:
        return sum(1 << c.number for c in self.channels)


def require_capable(plan: Plan, identity: Identity) -> None:
    """Refuse a mode that the device does not offer, or a controller with another sample time."""
    if isinstance(plan.controller, PositionController):
        require_positions(identity)
    if not identity.capabilities & _CAPABILITIES[plan.mode]:
        raise SettingError(
            name="mode", expected="one that the device offers",
            received=f"{plan.mode!r}, which {identity.name!r} does not",
            remedy="choose another mode or update its firmware",
        )  # fmt: skip
    controller = plan.controller
    if controller and not math.isclose(controller.Ts, identity.Ts, rel_tol=1e-6):
        raise SettingError(
            name="controller", expected=f"one for the device's period of {identity.Ts:g} s",
            received=f"one for {controller.Ts:g} s", remedy="tune it at that sample time",
        )  # fmt: skip


def require_positions(identity: Identity) -> None:
    """Refuse positions on a device that has none; the message says how to update it."""
    if identity.capabilities & wire.POSITIONS:
        return
    raise SettingError(
        name="controller", expected="a speed loop for this device", received="a position loop, "
        f"which its firmware does not support (protocol version {identity.version})",
        remedy="build the firmware with this sewfast and set SEWFAST_CAN_POSITIONS, or give it "
        "the speed loop (controller.speed)",
    )  # fmt: skip


def layout(plan: Plan, channels: Sequence[Channel], identity: Identity, baud: float) -> Layout:
    """Channels and batch that the link carries with a tenth to spare.
    `baud` is in bits per second, inf where nothing limits them. Raises `SettingError` if the
    columns asked for are unknown or too many; the message names those to leave out.
    """
    names = {c.name: c for c in channels}
    wanted = DEFAULTS[plan.mode] if plan.columns is None else tuple(plan.columns)
    if plan.columns is None:
        wanted = tuple(w for w in wanted if w in names)
    unknown = [w for w in wanted if w not in names]
    if unknown:
        raise SettingError(
            name="columns", expected=f"some of {', '.join(names)}", received=", ".join(unknown),
            remedy="the device streams no others",
        )  # fmt: skip
    extra = [names[w] for w in wanted if names[w].number > 1]
    for count in range(len(extra), -1, -1):
        chosen = tuple(sorted({*channels[:2], *extra[:count]}, key=lambda c: c.number))
        batch = _batch(plan, chosen, identity, baud)
        if batch is not None and (count == len(extra) or plan.columns is None):
            return Layout(chosen, batch)
        if batch is not None:
            raise _too_much(plan, extra[count:], identity, baud)
    raise _too_much(plan, extra, identity, baud)


def _batch(plan: Plan, chosen: Sequence[Channel], identity: Identity, baud: float) -> int | None:
    """The smallest batch that fits, or the one asked for if it fits."""
    batch = 10
    encodings = [c.encoding for c in chosen]
    tries = range(batch, 101) if plan.batch is None else (plan.batch,)
    fits = (b for b in tries if _fits(encodings, b, identity, baud))
    found = next(fits, None)
    if found is None and plan.batch is None:
        found = next((b for b in range(batch, 0, -1) if _fits(encodings, b, identity, baud)), None)
    return found


def _fits(encodings: Sequence[int], batch: int, identity: Identity, baud: float) -> bool:
    body = wire.body_size(encodings, batch)
    if not 1 <= batch <= 255 or body > wire.MAX_BODY:
        return False
    seconds = batch * identity.Ts
    return wire.wire_size(body) * 10.0 / seconds <= (1.0 - 0.1) * baud


def _too_much(plan: Plan, out: Sequence[Channel], identity: Identity, baud: float) -> SettingError:
    if plan.batch is not None and _batch(plan, out, identity, math.inf) is None:
        return SettingError(
            name="batch", expected=f"one that fits a frame of {wire.MAX_BODY} bytes",
            received=f"{plan.batch}", remedy="leave it to sewfast (batch=None)",
        )  # fmt: skip
    leave = f"leave out {', '.join(c.name for c in out)}" if out else "use a longer period"
    batch = "any batch" if plan.batch is None else f"batches of {plan.batch}"
    return SettingError(
        name="columns",
        expected=f"what {baud:g} baud carries each {identity.Ts:g} s with a tenth to spare in "
        f"{batch}",
        received="more", remedy=f"{leave}, or raise the baud rate of both sides",
    )  # fmt: skip


# --- before anything moves: channels, limits and controllers of the device ------------------------


def channels(link: Connection) -> tuple[Channel, ...]:
    """The device's description of its channels; `LinkError` if it differs from its schema hash."""
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
    """The limit to set: the one asked for, the one in force, or the device's ceiling."""
    if value is None:
        return present if present else ceiling
    if not 0.0 < real(name, value) <= ceiling * (1.0 + 1e-6):
        raise SettingError(
            name=name, expected=f"above 0 and at most {ceiling:g}, the device's ceiling",
            received=f"{value}", remedy=f"{'lower' if value > ceiling else 'raise'} it",
        )  # fmt: skip
    return min(value, ceiling)


def count(name: str, value: float) -> int:
    """The value as a whole number; fractions, booleans and text are refused by name."""
    number = math.nan if isinstance(value, bool) else real(name, value)
    if not number.is_integer():
        raise SettingError(name=name, expected="a whole number of counts", received=repr(value))
    return int(number)


def require_units(controller: SampledController, streamed: Sequence[Channel]) -> None:
    """Refuse a controller whose command or output has another unit than the device's."""
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
    """Body of CONTROLLER for any controller but a PID, with the encoder of the device."""
    require_units(controller, streamed)
    if not identity.capabilities & wire.KINDS:
        raise SettingError(
            name="controller", expected="a PID (Controller) for this device",
            received=f"{type(controller).__name__}, which its firmware does not support",
            remedy="tune a PID (--controller pid), or build the firmware with this sewfast and set "
            "SEWFAST_CAN_KINDS",
        )  # fmt: skip
    kind, numbers = controller.sent()
    return wire.controller(
        kind, counts_per_unit(identity.counts_per_rev, controller.y_unit), numbers
    )


def gains(controller: Controller, streamed: Sequence[Channel], identity: Identity) -> bytes:
    """Body of GAINS for a controller, with the encoder of the device."""
    g, c = fitting(controller, streamed), controller
    named = ("observer_time", bool(c.observer_time)), ("r_rate", c.r_rate != math.inf)
    further = [name for name, used in (*named, ("schedule", bool(c.schedule))) if used]
    unknown = [] if identity.capabilities & wire.DESIGN else list(further)
    if c.biquads and not identity.capabilities & wire.BIQUADS:
        unknown.append("biquads")
    if c.feedforward is not None and not identity.capabilities & wire.FEEDFORWARD:
        unknown.append("feedforward")
    if unknown:
        raise SettingError(
            name="controller", expected=f"one without {' and '.join(unknown)} for this device",
            received="one that its firmware does not support",
            remedy="leave it out (a feedforward: tune --no-feedforward), or build the firmware "
            "with this sewfast and its capabilities (SEWFAST_CAN_FEEDFORWARD)",
        )  # fmt: skip
    values = (
        g.Kp, g.Ti, g.Td, c.alpha, c.beta, c.N, c.Tt, c.u_min, c.u_max, c.slew, c.filter_time,
        counts_per_unit(identity.counts_per_rev, g.y_unit),
    )  # fmt: skip
    design = (c.observer_time, c.r_rate, c.schedule_rows()) if further else None
    return wire.gains(values, c.filter_samples, design)


def require_near(angle: float) -> None:
    """Refuse an angle [counts] of a stop beyond what single precision holds."""
    if not abs(angle) <= wire.FARTHEST:
        raise SettingError(
            name="angle", expected=f"a place within {wire.FARTHEST:g} counts on a device",
            received=f"{angle:g} counts", remedy="give it in its turn",
        )  # fmt: skip


def moves(playing: Playing, identity: Identity, limits: Limits) -> bytes:
    """Body of POSITION for a position loop, whose moves must keep within the device's limits, and
    the angle of a stop within what single precision holds.
    """
    if playing.stop is not None:
        require_near(playing.stop[1])
    rows, unit = playing.rows(), playing.counts_per_unit
    rpm = 60.0 * unit / identity.counts_per_rev  # of one unit of speed
    steepest = max(max(up, down) for _, up, down in rows)
    for what, wanted, limit, name, remedy in (
        ("speeds", playing.fastest, limits.speed_rpm, "RPM", "or use less of it (fastest)"),
        ("rates", steepest, limits.acceleration, "RPM/s", "or use less of them (share)"),
    ):
        if wanted * rpm > limit * (1.0 + 1e-6):
            raise SettingError(
                name="controller", expected=f"{what} of at most {limit:g} {name}, the limit",
                received=f"{wanted * rpm:g}", remedy=f"raise the limit (set_limits), {remedy}",
            )  # fmt: skip
    numbers = (playing.gain, playing.fastest, playing.landing, playing.creep)
    return wire.position(numbers, playing.smoothing, playing.releases, rows)


def _require_units(given: str, device: str, what: str) -> None:
    if spelled(given) != spelled(device):
        raise SettingError(
            name="controller", expected=f"one whose {what} is in {device}, as the device's",
            received=given, remedy="convert its gains",
        )  # fmt: skip
