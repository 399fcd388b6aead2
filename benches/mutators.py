"""Changes of files by the thousand, for `mutations.py`: JSON, CSV, settings and bytes.

One to three places change: a key dropped, renamed, twice or too many, numbers that are huge,
negative, zero or none, lists of other lengths, texts in place of numbers, other versions, bytes
flipped, cut off or put in.
"""

from __future__ import annotations

import contextlib
import json
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np


def pick(choices: Sequence[Any], rng: np.random.Generator) -> Any:
    return choices[int(rng.integers(0, len(choices)))]


NUMBERS: tuple[Any, ...] = (
    0, -1, 1, 2, 0.5, -0.0, 1e-3, 1e-9, 5e-324, 1e-160, 1e9, -1e9, 1e30, -1e30, 1e155, 1e308,
    -1e308, 10**400, 2**31, 2**63, 2**64, 1_000_000, 999_999_999, 100,
)  # fmt: skip
TEXTS = (
    "", "x", " ", "a\nb", "a\x00b", "\x1b[31mred", "\ud800", "é µ 速", "a'b\"c`$(d)", "-o", "../x",
    "<script>alert(1)</script>", "y" * 5000, "NaN", "1.0", "{u}", "%s", "u", "V", "rad/s", "C:\\x",
)  # fmt: skip
OTHERS: tuple[Any, ...] = (None, True, False, [], {}, [[]], [1], [None], {"a": 1}, "text", 1, 1.5)
RAW = ("NaN", "Infinity", "-Infinity", "1e999", "-1e999", "1e-999", "01", "+1", "'x'", "[" * 3000)
MARK = "\ue000raw"


def changed_value(value: Any, rng: np.random.Generator, texts: Sequence[str]) -> Any:
    """Another value in its place, near or far."""
    draw = rng.random()
    if draw < 0.12:
        return pick(OTHERS, rng)
    if draw < 0.18:
        return MARK + pick(RAW, rng)
    if isinstance(value, bool) or value is None:
        return pick((not value, 0, 1, *NUMBERS, "text"), rng)
    if isinstance(value, (int, float)) and abs(value) < 1e300:
        scaled = (-value, value * 10.0 ** rng.integers(-6, 7), value + 1, value - 1, float(value))
        return pick((*scaled, *NUMBERS), rng)
    if isinstance(value, str):
        return pick((*TEXTS, value[:-1], value.upper(), *texts[:20]), rng)
    if isinstance(value, list):
        return changed_list(value, rng)
    if isinstance(value, dict):
        return changed_keys(value, rng)
    return value


def changed_list(value: list[Any], rng: np.random.Generator) -> list[Any]:
    at = int(rng.integers(0, len(value) + 1))
    numeric = all(type(v) in (int, float) for v in value)
    ways: list[Callable[[], list[Any]]] = [
        list,
        lambda: value[:at],
        lambda: value + value[:1],
        lambda: value[:at] + value[at + 1 :],
        lambda: value[::-1],
        lambda: value * 2,
        lambda: value * (2000 // max(len(value), 1) + 1),
        lambda: [value],
        lambda: [value[i] for i in rng.permutation(len(value))],
        lambda: value[:1] * len(value),
    ]
    if numeric:
        number = pick(NUMBERS, rng)
        ways += [
            lambda: [number] * len(value),
            lambda: [v * 10.0 ** rng.integers(-9, 10) for v in value],
            lambda: [-v for v in value],
            lambda: [0.0] * len(value),
            lambda: [str(v) for v in value],
        ]
    return pick(ways, rng)()


def changed_keys(value: dict[str, Any], rng: np.random.Generator) -> dict[str, Any]:
    if not value:
        return {"a": 1}
    key = pick(list(value), rng)
    other = pick(list(value), rng)
    rest = {k: v for k, v in value.items() if k != key}
    ways: list[Callable[[], dict[str, Any]]] = [
        lambda: rest,
        lambda: rest,
        lambda: {**value, pick(("extra", "", "Ts", "\ud800", "x\ny", "__class__"), rng): 1},
        lambda: {**rest, key + "_": value[key]},
        lambda: {**rest, pick(TEXTS, rng): value[key]},
        lambda: {**value, key: value[other], other: value[key]},
        lambda: {**value, MARK + key: value[key]},  # a key twice
        dict,
    ]
    return pick(ways, rng)()


def places(document: Any, found: list[tuple[Any, Any]] | None = None) -> list[tuple[Any, Any]]:
    """Every container with each key or index in it; long lists of numbers by some of theirs."""
    found = [] if found is None else found
    items: Any = ()
    if isinstance(document, dict):
        items = list(document.items())
    elif isinstance(document, list):
        items = list(enumerate(document))
        if len(items) > 8:
            items = [*items[:3], *items[-3:]]
    for key, value in items:
        found.append((document, key))
        places(value, found)
    return found


def changed_document(document: Any, rng: np.random.Generator) -> str:
    """JSON with one to three places changed."""
    for _ in range(int(rng.choice([1, 1, 1, 1, 2, 2, 3]))):
        found = places(document)
        if not found:
            break
        parent, key = pick(found, rng)
        texts = [p[k] for p, k in found if isinstance(p[k], str)]
        parent[key] = changed_value(parent[key], rng, texts)
    if rng.random() < 0.02:
        document = pick((document, [document], {"a": document}), rng)
    return written(document)


def written(document: Any) -> str:
    text = json.dumps(document, indent=1)
    mark = json.dumps(MARK)[1:-1]
    for raw in RAW:
        text = text.replace(f'"{mark}{json.dumps(raw)[1:-1]}"', raw)
    return text.replace(mark, "")


def changed_json(content: bytes, rng: np.random.Generator) -> bytes:
    if rng.random() < 0.12:
        return changed_bytes(content, rng)
    return changed_document(json.loads(content), rng).encode()


def changed_bytes(content: bytes, rng: np.random.Generator) -> bytes:
    data = bytearray(content)
    n = len(data)
    at = int(rng.integers(0, max(n, 1)))
    way = rng.integers(0, 9)
    if way == 0:
        for k in rng.integers(0, n, int(rng.integers(1, 12))):
            data[k] = rng.integers(0, 256)
    elif way == 1:
        data[at] ^= 1 << int(rng.integers(0, 8))
    elif way == 2:
        del data[at:]
    elif way == 3:
        del data[at : at + int(rng.integers(1, 40))]
    elif way == 4:
        data[at:at] = rng.bytes(int(rng.integers(1, 40)))
    elif way == 5:
        data[:0] = pick((b"\xef\xbb\xbf", b"\xff\xfe", b"\n\n", b"\x00", b"#!"), rng)
    elif way == 6:
        data = bytearray(bytes(data).replace(b"\n", pick((b"\r\n", b"\r", b"\n\n", b""), rng)))
    elif way == 7:
        end = min(n, at + int(rng.integers(1, 400)))
        data += data[at:end]
    else:
        data[at:at] = data[max(0, at - 60) : at]
    return bytes(data)


CELLS = (
    "", "nan", "inf", "-inf", "1e999", "1e308", "-1e308", "x", "1,5", '"', "0x10", "  1  ", "1_000",
    "\x00", "--", "9" * 400, "2026-01-31T12:00:00", "12:00:00", "true", "é", "1e-320", "0", "-1",
    "1e30",
)  # fmt: skip
HEADERS = (
    "", "t", "u", "y", "u [V]", "y [", "[RPM]", "time [ms]", "t [h]", "a,b", '"u"', "u [furlong]",
    "index", "speed [rad/s]", "\x1b[31m", "é" * 300, "counts", "T", "weights", "-o", "'", "{}",
)  # fmt: skip


def changed_table(content: bytes, rng: np.random.Generator) -> bytes:
    """CSV with cells, rows, columns, names or delimiters changed."""
    if rng.random() < 0.2:
        return changed_bytes(content, rng)
    rows = [line.split(",") for line in content.decode().splitlines()]
    for _ in range(int(rng.choice([1, 1, 1, 2, 3]))):
        i, j = int(rng.integers(1, len(rows))), int(rng.integers(0, len(rows[0])))
        column = slice(1, len(rows))
        way = rng.integers(0, 14)
        if way < 3:
            set_cell(rows[i], j, pick(CELLS, rng))
        elif way < 5:
            set_cell(rows[0], j, pick(HEADERS, rng))
        elif way == 5:
            value = pick(CELLS, rng)
            for row in rows[column]:
                set_cell(row, j, value)
        elif way == 6:
            del rows[i]
        elif way == 7:
            rows.insert(i, list(rows[i - 1]))
        elif way == 8:
            rows = [rows[0], *(rows[k] for k in 1 + rng.permutation(len(rows) - 1))]
        elif way == 9:
            rows = rows[: int(rng.integers(1, 12))]
        elif way == 10:
            rows = [row[:j] + row[j + 1 :] for row in rows]
        elif way == 11:
            factor = 10.0 ** int(rng.choice([-300, -100, -9, 3, 9, 100, 300]))
            for row in rows[column]:
                set_cell(row, j, scaled(row, j, factor))
        elif way == 12:
            rows[i] = rows[i] * int(rng.integers(2, 300))
        else:
            rows[i:i] = [["# note"], [""], ["u", "y"]][: int(rng.integers(1, 4))]
        if len(rows) < 2 or not rows[0]:
            break
    sign = pick((",", ",", ",", ",", ";", "\t", " ", "|"), rng)
    text = "\n".join(sign.join(row) for row in rows) + "\n"
    return text.encode("utf-8", "surrogatepass")


def set_cell(row: list[str], j: int, value: str) -> None:
    if j < len(row):
        row[j] = value


def scaled(row: list[str], j: int, factor: float) -> str:
    with contextlib.suppress(ValueError, IndexError):
        return repr(float(row[j]) * factor)
    return ""


LINES = (
    'port = 3', 'port = ""', 'port = "-x"', "[columns]", "[limits]", "[units]", "[other]", "x = 1",
    'input = ["u", 3]', "input = []", "u_min = 5", "volt = -1", "volt = nan", "speed = inf",
    "u = 3",
    'y = "\\u001b[31m"', "ts = 1e999", "ts = true", "counts_per_rev = 0", "a = [[[[[[1]]]]]]",
    "u_max = 10000000000000000000000000000000000000000000000000000", "ts = 2026-01-31",
    'time = "\\u0000"', 'output = {a = 1}', '"" = 1', "volt = 0x7fffffffffffffffff", "u_min = -inf",
)  # fmt: skip


def changed_settings(content: bytes, rng: np.random.Generator) -> bytes:
    if rng.random() < 0.2:
        return changed_bytes(content, rng)
    lines = content.decode().splitlines()
    for _ in range(int(rng.integers(1, 4))):
        i = int(rng.integers(0, len(lines)))
        name, equals, _ = lines[i].partition(" = ")
        way = rng.integers(0, 5)
        if way == 0:
            del lines[i]
        elif way == 1:
            lines.insert(i, lines[int(rng.integers(0, len(lines)))])
        elif way == 2:
            lines.insert(i, pick(LINES, rng))
        else:
            values = [n.partition(" = ")[2] for n in LINES if " = " in n]
            lines[i] = f"{name} = {pick(values, rng)}" if equals else pick(LINES, rng)
        if not lines:
            break
    return "\n".join(lines).encode()
