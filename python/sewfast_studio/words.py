"""What the package says, in the words of the page: its messages name options of the command line
and calls of Python, where a page has fields.
"""

from __future__ import annotations

import re
from typing import Any

from sewfast.errors import SewfastError

FIELDS = {
    "--input": ("inputs", "Input"),
    "--output": ("output", "Output"),
    "--ts": ("Ts", "Sample time of the file"),
    "--resample": ("resample", "Sample time to work at"),
    "--counts": ("counts", "Column of counts"),
    "--counts-per-rev": ("counts-per-rev", "Counts of one turn"),
    "--mask": ("mask", "Leave out"),
    "--shift-input": ("shift", "Input logged late by"),
    "--hold-inputs": ("hold", "Hold missing inputs"),
    "--watchdog": ("watchdog", "Watchdog"),
}
"""Options of the command line, each with the field that does the same: its id and its label."""

PHRASES = {
    "search more variables, ": "",
    "give more evaluations": "raise “Controllers tried”",
    "give more time": "raise “Seconds at most”",
    "the constraints": "the limits",
    ", or name the column (time=...)": "",
}
"""What else a page calls by another name."""

_OPTION = r"(?P<option>--[a-z-]+)(?: (?P<value>[^()]+))?"
_CALL = r"(?:,? (?:data|Dataset)\.\w+(?:\((?:[^()]|\([^()]*\))*\))?)?"
_WAYS = re.compile(rf"{_CALL} \((?:\w+, )?(?:{_OPTION}|`?sewfast [^()]*)\)")
"""A call of Python and the option that does the same, or a command alone."""
_GIVEN = r"(?:--[a-z-]+|\w+=[^(),]+)"
_ASIDE = re.compile(rf" \({_GIVEN}(?:, {_GIVEN})*\)")
"""Options and arguments alone between parentheses: the same once more, for others."""
_BARE = re.compile(r"--[a-z-]+")


def spoken(text: str) -> str:
    """A message with the fields of the page for options; ways that a page lacks are left out."""
    for theirs, ours in PHRASES.items():
        text = text.replace(theirs, ours)
    text = _ASIDE.sub("", _WAYS.sub(_on_page, text))
    return _BARE.sub(lambda bare: _label(bare[0]), text)


def _label(option: str) -> str:
    """The field that does the same, in quotes; the option itself if there is none."""
    _, label = FIELDS.get(option, (None, None))
    return option if label is None else f"“{label}”"


def _on_page(way: re.Match[str]) -> str:
    _, label = FIELDS.get(way["option"], (None, None))
    if label is None:
        return ""
    if way[0].startswith(","):
        return f", with “{label}” set" + (f" to {way['value']}" if way["value"] else "")
    return f" (“{label}”)"


def advice(text: str) -> dict[str, Any]:
    """An advice for the page: its text, and the field with the value that do it, if any."""
    ways = [way for way in _WAYS.finditer(text) if way["option"] in FIELDS]
    chosen = ways[0] if len(ways) == 1 and ways[0][0].startswith(",") else None
    field = None if chosen is None else FIELDS[chosen["option"]][0]
    return {
        "text": spoken(text), "field": field, "value": chosen and (chosen["value"] or True),
        "idle": text.endswith("nothing needs to be done"),
    }  # fmt: skip


def error_text(error: Exception) -> str:
    """The text of an error for the page: a refusal as it is, a fault with its type."""
    if isinstance(error, (ValueError, RecursionError, SewfastError, OSError)):
        return spoken(str(error))
    return f"a fault in sewfast: {type(error).__name__}: {error}"
