"""`Session`: a page that gave its token, a thread for each direction; its messages, checked."""

from __future__ import annotations

import contextlib
import json
import math
import queue
import struct
import sys
import threading
import time
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from sewfast.errors import SettingError

if TYPE_CHECKING:
    from websockets.sync.server import ServerConnection

    from sewfast.dataset import FloatArray


PROMPT, ROW = 0.15, 10
"""A page can arm a drive after `ROW` answers in a row, each within `PROMPT` [s]."""

MOST_UNANSWERED = 20
"""Most heartbeats without an answer; then no further ones are sent."""

MOST_WAITING = 200
"""Most queued messages of a page; a page that sends more is closed."""


class Session:
    """A page that has given its token.
    Sending to the page and answering its requests have a thread each, so that a page that no longer
    reads holds up nobody, and a long request of a page does not delay its STOP.
    """

    def __init__(
        self, connection: ServerConnection, answer: Callable[[Session, str | bytes], object]
    ) -> None:
        self.connection = connection
        self._outgoing: queue.SimpleQueue[str | bytes | None] = queue.SimpleQueue()
        self._incoming: queue.SimpleQueue[str | bytes | None] = queue.SimpleQueue()
        self._answer = answer
        self._is_over = False
        self._beats: dict[int, float] = {}
        self._beat = 0
        #: Number of heartbeats in a row with a prompt answer.
        self.prompt = 0
        #: The page of which it was told that it holds the control of a drive.
        self.told: Session | None = None
        self._threads = [
            threading.Thread(target=run, daemon=True) for run in (self._send, self._work)
        ]
        for thread in self._threads:
            thread.start()

    def send(self, message: str | bytes) -> None:
        self._outgoing.put(message)

    def take(self, message: str | bytes) -> None:
        """Queue a message for its answer."""
        if self._incoming.qsize() >= MOST_WAITING:
            self.connection.close(1008, "too many messages wait for an answer")
            return
        self._incoming.put(message)

    def end(self) -> None:
        """End the threads; messages that still wait are dropped."""
        self._is_over = True
        self._outgoing.put(None)
        self._incoming.put(None)

    def wait(self, seconds: float) -> None:
        """Wait for the threads, so that Python does not exit during a computation."""
        self.end()
        for thread in self._threads:
            thread.join(seconds)

    def _send(self) -> None:
        from websockets.exceptions import ConnectionClosed

        with contextlib.suppress(ConnectionClosed):
            while (message := self._outgoing.get()) is not None and not self._is_over:
                self.connection.send(message)

    def _work(self) -> None:
        while (message := self._incoming.get()) is not None and not self._is_over:
            self._answer(self, message)

    def beat(self) -> None:
        """Send a heartbeat for the page to answer."""
        now = time.monotonic()
        if len(self._beats) >= MOST_UNANSWERED:
            self.prompt = 0
            oldest = min(self._beats)
            if now - self._beats[oldest] > 10.0:  # the page may have lost them
                self._beats.clear()
            return
        self._beat += 1
        self._beats[self._beat] = now
        self.send(to_text({"event": "beat", "n": self._beat, "prompt": self.prompt}))

    def answered(self, n: int) -> float | None:
        """Time of the answer to a heartbeat [s]; None for an unknown number."""
        sent = self._beats.pop(n, None)
        if sent is None:
            return None
        took = time.monotonic() - sent
        self.prompt = self.prompt + 1 if took <= PROMPT else 0
        return took


def packed(head: dict[str, Any], curves: Mapping[str, FloatArray]) -> bytes:
    """A message with curves: length of the head, head as JSON, then every curve in float32.
    The head's `curves` are names and lengths in order; it is padded so that a browser can map an
    array onto the rest.
    """
    names = [[name, len(values)] for name, values in curves.items()]
    text = to_text({**head, "curves": names}).encode()
    text += b" " * (-len(text) % 4)
    rows = [np.asarray(values, dtype="<f4").tobytes() for values in curves.values()]
    return b"".join([struct.pack("<I", len(text)), text, *rows])


def to_text(value: Any) -> str:
    """The value as JSON, with null for NaN and infinity."""
    return json.dumps(finite(value), allow_nan=False)


def finite(value: Any) -> Any:
    """The value for JSON, with None for NaN and infinity."""
    if isinstance(value, float) and not math.isfinite(value):
        return None
    if isinstance(value, Mapping):
        return {str(k): finite(v) for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [finite(v) for v in value]
    return value


# --- The messages of a page: a JSON schema for each, and the check against it ---------------------


SEED = {"type": "integer", "minimum": 0, "maximum": 2**32 - 1}
NAME = {"type": "string", "maxLength": 200}
WORDS = {"type": "array", "items": NAME, "maxItems": 100}
LIMIT = {"type": ["number", "null"], "exclusiveMinimum": 0}
VALUES = {"type": "object", "additionalProperties": {"type": "number"}, "maxProperties": 40}

_STEP = {
    "file": NAME,
    "inputs": WORDS,
    "output": {**NAME, "type": ["string", "null"]},
    "resample": {"type": ["number", "null"]},
    "Ts": {"type": ["number", "null"], "exclusiveMinimum": 0},
    "counts": {**NAME, "type": ["string", "null"]},
    "counts_per_rev": {"type": ["number", "null"], "exclusiveMinimum": 0},
    "mask": {**NAME, "type": ["string", "null"]},
    "shift": {"type": ["integer", "null"], "minimum": -10_000, "maximum": 10_000},
    "hold": {"type": "boolean"},
    "model": NAME,
    "seed": {**SEED, "type": ["integer", "null"]},
    "model_file": NAME,
    "replace": {"type": "boolean"},
}
NUMBERS = {"type": "array", "items": {"type": "number"}, "maxItems": 3}
WEIGHTS = (
    "tracking", "chatter", "effort", "overshoot", "overshoot_limit", "rise", "lag", "saturation"
)  # fmt: skip
_TUNE = {
    "model": NAME,
    "controller": {**NAME, "type": ["string", "null"]},
    "values": VALUES,
    "notches": {"type": "array", "items": NUMBERS, "maxItems": 4},
    "weights": {
        "type": "object",
        "additionalProperties": {"type": "number", "minimum": 0},
        "propertyNames": {"enum": list(WEIGHTS)},
        "maxProperties": len(WEIGHTS),
    },
}
_EFFORT = {
    "seed": SEED,
    "members": {"type": "integer", "minimum": 1, "maximum": 16},
    "evaluations": {"type": "integer", "minimum": 10, "maximum": 20_000},
}
_SIGNAL = {
    "seed": SEED,
    "scale": {"type": "number", "exclusiveMinimum": 0, "maximum": 10},
    "file": NAME,
}

_SEARCH = (
    {
        **_TUNE,
        "evaluations": {"type": "integer", "minimum": 10, "maximum": 20_000},
        "seed": SEED,
        "seconds": {"type": ["number", "null"], "exclusiveMinimum": 0, "maximum": 3600},
        "constraints": {
            "type": "object",
            "additionalProperties": {"type": "number", "exclusiveMinimum": 0},
            "propertyNames": {"enum": ["Ms", "overshoot", "u"]},
            "maxProperties": 3,
        },
    },
    ("model", "values", "evaluations", "seed"),
)
# name: (fields, required fields)
_MESSAGES: dict[str, tuple[dict[str, Any], tuple[str, ...]]] = {
    "take": ({"over": {"type": "boolean"}}, ()),
    "cancel": ({}, ()),
    **dict.fromkeys(("columns", "look", "validate", "identify"), (_STEP, ("file",))),
    "commission": ({"machine": NAME, **_EFFORT}, ()),
    "tune_open": (_TUNE, ("model",)),
    "tune_move": ({**_TUNE, "noise": {"type": "boolean"}}, ("model", "values")),
    **dict.fromkeys(("tune_judge", "tune_verdict"), (_TUNE, ("model", "values"))),
    **dict.fromkeys(("tune_search", "tune_front"), _SEARCH),
    "loop": ({**_TUNE, "response": {"type": ["integer", "null"]}}, ("model", "values")),
    "bode": (
        {
            **_STEP,
            "reference": {**NAME, "type": ["string", "null"]},
            "segment": {"type": ["integer", "null"], "minimum": 8, "maximum": 10_000_000},
        },
        ("file",),
    ),
    "report": ({}, ()),
    "upload": ({"file": NAME, "size": {"type": "integer", "minimum": 0}}, ("file", "size")),
    "upload_end": ({}, ()),
    "tune_save": (
        {**_TUNE, "file": NAME, "replace": {"type": "boolean"}},
        ("model", "values", "file"),
    ),
    "tune_copy": ({**_TUNE, "file": NAME}, ("model", "values", "file")),
    "ports": ({}, ()),
    "drive_connect": (
        {
            "port": NAME,
            "baud": {"type": "integer", "minimum": 300, "maximum": 100_000_000},
            "watchdog": {"type": ["number", "null"], "minimum": 0.001, "maximum": 10},
        },
        ("port",),
    ),
    "drive_disconnect": ({}, ()),
    "drive_limits": (
        dict.fromkeys(("volt", "speed_rpm", "acceleration", "current"), LIMIT),
        ("volt", "speed_rpm", "acceleration", "current"),
    ),
    "drive_arm": ({}, ()),
    "drive_disarm": ({}, ()),
    "drive_clear": ({}, ()),
    "drive_go": ({}, ()),
    "drive_record": ({"signal": NAME, **_SIGNAL}, ("signal", "seed", "scale", "file")),
    "drive_run": (
        {"controller": NAME, "reference": NAME, **_SIGNAL},
        ("controller", "reference", "seed", "scale", "file"),
    ),
    "drive_commission": (
        {**_EFFORT, "go_on": {"type": "boolean"}},
        ("seed", "members", "evaluations", "go_on"),
    ),
    "stop": ({}, ()),
    "alive": ({"n": {"type": "integer", "minimum": 0}}, ("n",)),
    "live": (
        {
            "seconds": {"type": "number", "exclusiveMinimum": 0, "maximum": 30},
            "columns": {"type": "integer", "minimum": 2, "maximum": 4000},
        },
        ("seconds", "columns"),
    ),
}

SCHEMAS: dict[str, dict[str, Any]] = {
    name: {
        "type": "object",
        "properties": {"do": {"const": name}, "id": {"type": "integer"}, **fields},
        "required": ["do", *required],
        "additionalProperties": False,
    }
    for name, (fields, required) in _MESSAGES.items()
}
"""JSON schemas of the messages of a page, by name."""

_KINDS: dict[str, type | tuple[type, ...]] = {
    "string": str, "object": dict, "array": list, "boolean": bool, "null": type(None),
    "integer": int, "number": (int, float),
}  # fmt: skip


def checked(asked: dict[str, Any]) -> dict[str, Any]:
    """The fields of a message, checked against its schema.
    Raises `SettingError`, which names the field, the expected and the received value.
    """
    name = asked.get("do")
    schema = SCHEMAS.get(name) if isinstance(name, str) else None
    if schema is None:
        raise SettingError(f"expected a known step, received {str(name)[:40]!r}")
    fields = schema["properties"]
    for field in schema["required"]:
        if field not in asked:
            raise SettingError(f"{field}: expected a value, received none")
    for field, value in asked.items():
        if field not in fields:
            raise SettingError(f"{field[:40]}: expected no such field in {name}; leave it out")
        if field not in ("do", "id"):
            _check(field, value, fields[field])
    return {field: value for field, value in asked.items() if field not in ("do", "id")}


def _check(field: str, value: Any, rule: dict[str, Any]) -> None:
    kinds = [rule["type"]] if isinstance(rule["type"], str) else rule["type"]
    if not any(_is(value, kind) for kind in kinds):
        raise _refusal(field, " or ".join(kinds), value)
    if isinstance(value, str) and len(value) > rule.get("maxLength", math.inf):
        raise _refusal(field, f"at most {rule['maxLength']} letters", value)
    if isinstance(value, list):
        if len(value) > rule["maxItems"]:
            raise _refusal(field, f"at most {rule['maxItems']} entries", value)
        for entry in value:
            _check(field, entry, rule["items"])
    if isinstance(value, dict):
        if len(value) > rule["maxProperties"]:
            raise _refusal(field, f"at most {rule['maxProperties']} entries", value)
        known = rule.get("propertyNames", {}).get("enum")
        for key, entry in value.items():
            if known is not None and key not in known:
                raise _refusal(field, f"names among {', '.join(known)}", key)
            _check(key, entry, rule["additionalProperties"])
    if isinstance(value, (int, float)) and not isinstance(value, bool):
        low, high = rule.get("minimum", -math.inf), rule.get("maximum", math.inf)
        above = rule.get("exclusiveMinimum", -math.inf)
        # a whole number in JSON can have thousands of digits, too many for a float
        finite = -sys.float_info.max <= value <= sys.float_info.max
        if not (finite and low <= value <= high and value > above):
            least = f"above {above:g}" if above > low else f"from {low:,g}"
            most = f" to {high:,g}" if math.isfinite(high) else ""
            bounded = math.isfinite(max(low, above))
            raise _refusal(field, f"a number {least}{most}" if bounded else "a number", value)


def _is(value: Any, kind: str) -> bool:
    if isinstance(value, bool) and kind != "boolean":
        return False
    return isinstance(value, _KINDS[kind])


def _refusal(field: str, expected: str, value: object) -> SettingError:
    return SettingError(f"{field[:40]}: expected {expected}, received {repr(value)[:80]}")
