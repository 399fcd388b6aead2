"""The four kinds of message in a recording: channel numbers, topics, JSON schemas."""

from __future__ import annotations

import json
from collections.abc import Mapping
from enum import IntEnum
from typing import Any


class Topic(IntEnum):
    """Channel number of each kind, fixed so that every chunk can be read without the others."""

    HEADER = 1
    SAMPLES = 2
    EVENTS = 3
    COMPLETENESS = 4

    @property
    def path(self) -> str:
        return f"/sewfast/{self.name.lower()}"

    @property
    def schema_name(self) -> str:
        return f"sewfast.{self.name.title()}"


def schema(topic: Topic, columns: Mapping[str, str], *, single: bool = False) -> bytes:
    """JSON schema of a topic's messages, for a recording with these columns.

    `single` is for one message a sample: numbers in place of arrays.
    """
    content = _object(**_PROPERTIES[topic]) if topic in _PROPERTIES else _samples(columns, single)
    return json.dumps({"title": topic.schema_name, **content}).encode()


def _object(**properties: Any) -> dict[str, Any]:
    return {"type": "object", "properties": properties, "required": list(properties)}


def _samples(columns: Mapping[str, str], single: bool) -> dict[str, Any]:
    # null is a value that was not measured
    given = {name: (["number", "null"], f"[{unit}]") for name, unit in columns.items()}
    own = {
        "index": ("integer", "number of the sample, 0 at the start"),
        "t": ("number", "time since the start [s]"),
    }
    properties: dict[str, Any] = {}
    for name, (kind, description) in {**own, **given}.items():
        value = {"type": kind} if single else {"type": "array", "items": {"type": kind}}
        properties[name] = {**value, "description": description}
    return {"type": "object", "properties": properties, "required": list(properties)}


_WHOLE = {"type": "integer"}
_TEXT = {"type": "string"}
_PROPERTIES: dict[Topic, dict[str, Any]] = {
    Topic.HEADER: {
        "format": _TEXT,
        "version": _WHOLE,
        "name": _TEXT,
        "Ts": {"type": "number", "description": "sample time [s]"},
        "columns": {"type": "object", "description": "unit of each column"},
        "n": {"type": ["integer", "null"], "description": "planned number of samples"},
        "counts_per_rev": {"type": ["number", "null"]},
        "device": {"type": "object"},
        "settings": {"type": "object"},
        "started": _TEXT,
    },
    Topic.EVENTS: {
        "kind": _TEXT,
        "index": {"type": ["integer", "null"], "description": "sample at which it happened"},
        "elapsed": {"type": "number", "description": "host's time since the file was opened [s]"},
        "detail": {"type": "object"},
    },
    Topic.COMPLETENESS: {
        "outcome": _TEXT,
        "received": {"type": "integer", "description": "samples written"},
        "expected": {"type": ["integer", "null"], "description": "samples planned"},
        "end": {"type": "integer", "description": "number of the sample after the last one"},
        "gap_count": _WHOLE,
        "gaps": {
            "type": "array",
            "items": {"type": "array", "items": _WHOLE},
            "description": "[first, count] of each gap; the first ones of many",
        },
    },
}
