"""Refusals: what a device's result codes mean and what to do about them."""

from __future__ import annotations

from . import wire

_FIELDS: dict[int, tuple[str, ...]] = {
    wire.Kind.HELLO: ("version from", "version to", "session"),
    wire.Kind.DESCRIBE: ("channel",),
    wire.Kind.LIMITS: ("volt", "speed", "acceleration", "current"),
    wire.Kind.ARM: ("watchdog", "key"),
    wire.Kind.GAINS: (
        "Kp", "Ti", "Td", "alpha", "beta", "N", "Tt", "u_min", "u_max", "slew", "filter_time",
        "counts per unit", "filter_samples", "observer_time", "r_rate", "schedule",
    ),
    wire.Kind.START: ("mode", "watchdog", "at", "length", "mask", "batch"),
}  # fmt: skip


def refusal(kind: int, result: int, detail: int) -> str:
    """What a device's refusal means and what to do."""
    name = wire.Kind(kind).name if kind in wire.Kind._value2member_map_ else f"command {kind:#04x}"
    return f"expected the device to take {name}, it refused: {_refused(kind, result, detail)}"


def _without(kind: int) -> str:
    return "its limit is inf" if kind == wire.Kind.LIMITS else "leave it out"


def _refused(kind: int, result: int, detail: int) -> str:
    where = _field(kind, detail)
    texts = {
        1: "it does not know the command; update the firmware",
        2: f"wrong length, {detail} bytes; update sewfast and the firmware to the same version",
        3: f"{where} is outside its range; change it",
        4: f"not while {wire.name_of(wire.STATES, detail)}; {_way_out(detail)}",
        5: "it has been reset since; connect again, set the limits and start anew",
        6: f"{where} is beyond a limit; lower it or raise the limit",
        7: f"no room in its profile memory, {detail} values would fit; wait for it to play on",
        8: f"it does not offer {where}; {_without(kind)}",
        9: f"values out of order, it expects number {detail}; upload from there",
        10: f"it speaks protocol version {detail}, sewfast {wire.VERSION}; update the older one",
        11: "the motor is moving; wait for rest",
        12: "no limits were set in this session; set them first",
        13: "the key is not that of its reply to HELLO; connect again",
    }
    return texts.get(result, f"result {result} (detail {detail}), which this sewfast does not know")


def _field(kind: int, index: int) -> str:
    if kind == wire.Kind.UPLOAD:
        return f"value {index}"
    names = _FIELDS.get(kind, ())
    return names[index] if index < len(names) else f"field {index}"


def _way_out(state: int) -> str:
    remedies = {
        0: "wait until it has measured well",
        1: "arm it first",
        2: "start or stop it first",
        3: "stop it first",
        4: "find out why, then clear the trip",
    }
    return remedies.get(state, "update sewfast")
