"""Files of sewfast itself, changed by the thousand: each is refused, or loads and can be used.

    python benches/mutations.py --count 1000
    python benches/mutations.py --formats model --replay 17 --seed 3

A whole file of one of nine formats is changed in one to three places: a key dropped, renamed, twice
or too many, numbers that are huge, negative, zero or none, lists of other lengths, texts in place
of numbers, other versions, bytes flipped, cut off or put in. It is then loaded; where it loads it
is printed, saved, read again, simulated, checked and deployed, and some of the files are given to
the command line as well. Good outcomes are `refused` (a `SewfastError` on load) and `used`. What an
error of sewfast ends in use only is listed as `declined`, with its words: an unstable model loads,
prints and is not deployed. Each file is tried in a fork with bounded memory and time.
"""

from __future__ import annotations

import argparse
import contextlib
import functools
import io
import json
import os
import re
import resource
import select
import shutil
import signal
import sys
import tempfile
import traceback
import warnings
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np

import sewfast
from sewfast import cli
from sewfast.cli import project
from sewfast.errors import SewfastError
from sewfast.greybox.equations import load_equations
from sewfast.recordfile import Header, RecordWriter, read_recording
from sewfast.recordfile import export as exported
from sewfast.report import report
from sewfast_fleet.table import load_fleet

sys.path.append(str(Path(__file__).parents[1] / "tests" / "support"))
from commissioned import SMALL, short
from kinds import TS, levels, model_of, recording

PATIENCE = 20.0
"""Longest time of one file, with everything that is done with it [s]."""
MEMORY = 2 << 30
"""Most address space of one process above what it has at its start [bytes]."""
COMMANDS = 20
"""Of so many files one is given to the command line as well."""
GOOD = ("refused", "used", "declined")


class Declined(Exception):
    """sewfast refused what was asked of a value that it had loaded."""


class Useless(Exception):
    """A value that was loaded cannot even be printed, saved or read again."""


# --- Mutations ------------------------------------------------------------------------------------


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


def changed_recording(content: bytes, rng: np.random.Generator) -> bytes:
    """Bytes of a record file, or its header with the sums of its chunks as they should be."""
    if rng.random() < 0.5:
        for _ in range(int(rng.integers(1, 4))):
            content = changed_bytes(content, rng)
        return content
    text = changed_document(json.loads(header_of_example().encode()), rng).encode()
    with (
        tempfile.TemporaryDirectory() as folder,
        mock.patch.object(Header, "encode", return_value=text),
    ):
        return write_recording(Path(folder) / "a.mcap").read_bytes()


def pick(choices: Sequence[Any], rng: np.random.Generator) -> Any:
    return choices[int(rng.integers(0, len(choices)))]


# --- Whole files ----------------------------------------------------------------------------------


MODELS = (
    "arx", "arx, two inputs, nk 2", "iv", "oe", "oe, integrator", "hammerstein_wiener", "grey_box",
    "grey_box, late by 1.4 samples", "neural_oe", "neural_oe, saturates", "neural_ss",
    "neural_ss, abs", "neural_ss, integrator", "ensemble of mixed kinds", "ensemble, two inputs",
)  # fmt: skip


def make_models(folder: Path) -> list[Path]:
    made = []
    for i, name in enumerate(MODELS):
        model = model_of(name)
        rest = {"u": [0.5] * len(model.input_names), "y": 2.0, "source": "record"}
        at_zero = "abs" in name or "grey_box" in name
        known = {**model.training, "noise": 0.1, **({} if at_zero else {"rest": rest})}
        made.append(folder / f"model-{i}.json")
        replace(model, training=known).save(made[-1])
    return made


def make_controllers(folder: Path) -> list[Path]:
    gains = sewfast.Gains.standard(0.02, 0.2, 0.01)
    notch = sewfast.Biquad.notch(20.0)
    made = (
        sewfast.Controller(gains, u_min=-20, u_max=20, Ts=TS, counts_per_rev=1572.0),
        sewfast.paper_controller(),
        sewfast.Controller(
            gains, u_min=-10, u_max=10, slew=500.0, Ts=TS, biquads=[notch],
            schedule=[(0.0, gains), (500.0, sewfast.Gains.standard(0.01, 0.3, 0.0))],
        ),
        sewfast.StateFeedback.from_model(model_of("oe"), u_min=-9.0, u_max=9.0),
        sewfast.Controller(
            gains, u_min=-20, u_max=20, Ts=TS, filter_samples=4, feedforward=sewfast.Feedforward(
                8, 0.5, ((-900.0, -3.0), (-50.0, -0.8), (50.0, 0.8), (900.0, 3.0)), (0.01, 0.02),
            ),
        ),
    )  # fmt: skip
    return saved(folder, "controller", made)


def saved(folder: Path, name: str, made: Sequence[Any]) -> list[Path]:
    found = [folder / f"{name}-{i}.json" for i in range(len(made))]
    for path, value in zip(found, made, strict=True):
        value.save(path)
    return found


def motor_record() -> sewfast.Dataset:
    return recording(model_of("grey_box, no network"), n=600, noise=0.002)


def turning(x: Any, u: Any, p: Any) -> Any:
    return (u / p["k_e"] - x) / p["T"]


def make_motors(folder: Path) -> list[Path]:
    data = motor_record()
    usual = sewfast.physics(data)
    turned = sewfast.physics(
        data, structure=["lag", "coulomb", "offset", "drop", "stribeck", "sag", "load_1"]
    )
    own = sewfast.physics(
        data, equations=turning, parameters={"k_e": (0.02, 1e-4, 10.0), "T": (0.2, 1e-3, 10.0)}
    )
    return saved(folder, "motor", (usual, turned, own))


def make_responses(folder: Path) -> list[Path]:
    one, other = response(24), replace(response(24), blocks=np.full(24, 8.0), noise=None)
    # of so few lines no shaft is fitted, which takes seconds
    speeds = {500.0: response(12), 900.0: response(15)}
    more = sewfast.ResponsesOverSpeed(speeds, {1500.0: "the drive tripped"})
    return saved(folder, "response", (one, other, more))


def response(lines: int) -> sewfast.FrequencyResponse:
    f = np.geomspace(1.0, 40.0, lines)
    s = 2j * np.pi * f
    value = 50.0 / (1.0 + 0.05 * s) * np.exp(-0.01 * s)
    return sewfast.FrequencyResponse(
        f, value, (0.01 * abs(value)) ** 2, np.linspace(0.999, 0.9, lines), 16.0, TS,
        (0.008 * abs(value)) ** 2, "V", "RPM", False, {"method": "segments", "cautions": ["few"]},
    )  # fmt: skip


def make_tables(folder: Path) -> list[Path]:
    data = recording(model_of("oe"), n=120)
    u, y = data.experiments[0].u[:, 0], data.experiments[0].y
    place, plain = folder / "recording-0.csv", folder / "recording-1.csv"
    columns = {"t": TS * np.arange(len(u)), "u": u, "y": np.round(y, 4)}
    sewfast.write_table(place, columns, units={"t": "s", "u": "V", "y": "RPM"})
    counts = np.cumsum(np.round(10.0 * y))
    sewfast.write_table(plain, {"time": columns["t"], "duty": u, "encoder": counts})
    return [place, plain]


def header_of_example() -> Header:
    return Header(
        "steps", TS, {"u": "V", "y": "RPM", "counts": "1"}, 100, 1572.0,
        {"name": "virtual", "boot_id": 7}, {"seed": 3, "limits": {"u": 20.0}},
        "2026-01-31T12:00:00+00:00",
    )  # fmt: skip


def write_recording(path: Path) -> Path:
    u = levels(100, 3, 1)[:, 0]
    with RecordWriter(path, header_of_example()) as writer:
        writer.event("armed", 0, limits={"u": 20.0})
        for first in range(0, 100, 10):
            if first != 40:
                k = slice(first, first + 10)
                part = {"u": u[k], "y": 3.0 * u[k], "counts": np.arange(first, first + 10)}
                writer.samples(first, part)
        writer.event("disarmed", 100)
    return path


def make_recordings(folder: Path) -> list[Path]:
    return [write_recording(folder / "recording.mcap")]


SETTINGS = """\
port = "/dev/ttyUSB0"
[columns]
input = "u"
output = "y"
time = "t"
ts = 0.01
[units]
u = "V"
y = "RPM"
[limits]
volt = 10.0
speed = 3500.0
acceleration = 30000.0
current = inf
u_min = -10.0
u_max = 10
"""


def make_projects(folder: Path) -> list[Path]:
    path = folder / project.NAME
    path.write_text(SETTINGS)
    return [path]


def make_commissionings(folder: Path) -> list[Path]:
    with short():
        found = sewfast.commission(sewfast.VirtualMachine(1), **SMALL)
    place = folder / "commissioned"
    found.save(place)
    numbers = place / "commissioning.json"
    document = json.loads(numbers.read_bytes())
    document["references"] = dict([*document["references"].items()][:1])  # each takes a second
    numbers.write_text(json.dumps(document, indent=1))
    return [numbers, place / "analysis.json"]


def make_fleets(folder: Path) -> list[Path]:
    records = folder / "records"
    records.mkdir(exist_ok=True)
    for i in range(3):
        data = recording(model_of("oe, na 1"), n=300, seed=i)
        columns = {
            "t": TS * np.arange(300),
            "u": data.experiments[0].u[:, 0],
            "y": data.experiments[0].y,
        }
        sewfast.write_table(records / f"{i}.csv", columns)
    (records / "3.csv").write_text("t,u,y\n0,1,2\n")
    found = sewfast.fleet(records, model="oe", workers=1)
    made = [folder / "fleet.csv", folder / "fleet.json"]
    for path in made:
        found.save(path)
    return made


# --- Use ------------------------------------------------------------------------------------------


@contextlib.contextmanager
def must() -> Iterator[None]:
    """What whatever was loaded has to be able to do."""
    try:
        yield
    except SewfastError as error:
        raise Useless(f"{type(error).__name__}: {error}") from error


@contextlib.contextmanager
def may(what: str, declined: list[str]) -> Iterator[None]:
    """What can be refused, as it depends on the values, but only in words."""
    try:
        yield
    except SewfastError as error:
        declined.append(f"{what}: {error}")


def shown(value: Any) -> None:
    """Print a value in every way, also to a terminal in UTF-8, and without control characters."""
    html = value._repr_html_() if hasattr(value, "_repr_html_") else ""
    for text in (str(value), repr(value), html):
        text.encode()
        if re.search(r"[\x00-\x08\x0b-\x1f\x7f]", text):
            raise AssertionError(f"control characters in {text[:200]!r}")


def kept(value: Any, load: Callable[[Path], Any], folder: Path) -> None:
    """Save it, read it, save it again: the same bytes."""
    with must():
        shown(value)
        first, second = folder / "kept-1.json", folder / "kept-2.json"
        value.save(first)
        load(first).save(second)
    if first.read_bytes() != second.read_bytes():
        raise AssertionError("saved, read and saved again it is another file")


def finite(values: Any) -> None:
    if not np.isfinite(np.asarray(values, dtype=np.float64)).all():
        raise AssertionError("numbers that are not finite, without a word")


def command(declined: list[str], *arguments: object) -> None:
    """One command, in this process: exit code 0 or 2."""
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try:
            code = cli.main([str(a) for a in arguments])
        except SystemExit as error:
            code = error.code
    if code not in (0, 2) or "Traceback" in err.getvalue():
        raise AssertionError(f"{arguments[0]} ended with {code}: {err.getvalue()[-2000:]}")
    (out.getvalue() + err.getvalue()).encode()
    if code == 2:
        declined.append(f"{arguments[0]}: {err.getvalue().strip()[-300:]}")


def use_model(path: Path, folder: Path, declined: list[str], *, commands: bool) -> None:
    model = sewfast.load_model(path)
    kept(model, sewfast.load_model, folder)
    with must():
        _ = model.orders, model.parameters, model.theta, model.state_names, model.noise
        _ = model.parameter_names, model.rest, model.columns, model.signature
    n = 150
    u = levels(n, 2, len(model.input_names))
    with may("simulate", declined):
        y = model.simulate(u)
        finite(y)
    noise = np.random.default_rng(0).normal(size=n)
    y = 3.0 * u[:, 0] + noise
    with may("data", declined):
        data = sewfast.Dataset.from_arrays(
            u, y, model.Ts, input_names=model.input_names, input_units=model.input_units,
            output_name=model.output_name, output_unit=model.output_unit,
        )  # fmt: skip
        with may("validate", declined):
            shown(model.validate(data))
        with may("check", declined):
            shown(model.check(data))
        with may("linearise", declined):
            shown(model.linearise())
    with may("run", declined):
        gains = sewfast.Gains.standard(
            0.01, 0.5, u_unit=model.input_units[0] or "V", y_unit=model.output_unit or "RPM"
        )
        pid = sewfast.Controller(gains, Ts=model.Ts, u_min=-5, u_max=5)
        shown(sewfast.run(pid, model, np.repeat([0.0, 5.0], 30)))
    with may("deploy", declined):
        shown(sewfast.deploy(model, folder / "code"))
    if commands:
        record = folder / "record.csv"
        names = ["c0", "c1", "c2"][: u.shape[1]]
        columns = {"t": 0.01 * np.arange(n), **dict(zip(names, u.T, strict=False)), "y": y}
        sewfast.write_table(record, columns)
        roles = [a for name in names for a in ("--input", name)] + ["--output", "y"]
        for name in ("simulate", "check", "validate"):
            command(declined, name, path, record, *roles)
        command(declined, "deploy", path, folder / "code2")
        command(declined, "check", path, record, "--json", *roles)


def use_controller(path: Path, folder: Path, declined: list[str], *, commands: bool) -> None:
    controller = sewfast.load_controller(path)
    kept(controller, sewfast.load_controller, folder)
    core = controller.core()
    finite([core.step(5.0, 0.1 * k, 0.0) for k in range(30)])
    with may("run", declined):
        u_unit, y_unit = controller.u_unit, controller.y_unit
        plant = sewfast.LinearOE.from_tf(
            [0.0, 1.0], [1.0, -0.9], controller.Ts, input_units=[u_unit], output_unit=y_unit
        )
        shown(sewfast.run(controller, plant, np.repeat([0.0, 5.0], 30)))
        with may("margins", declined):
            shown(sewfast.margins(controller, plant))
    with may("deploy", declined):
        shown(sewfast.deploy(controller, folder / "code"))
    with may("structured text", declined):
        shown(sewfast.deploy(controller, folder / "plc", to="st"))
    if commands:
        command(declined, "run", path, "virtual", "--reference", "step", "-o", folder / "run.csv")
        command(declined, "deploy", path, folder / "code2")
        command(declined, "analyse", path, "virtual", "--seconds", "0.2")


def use_motor(path: Path, folder: Path, declined: list[str], *, commands: bool) -> None:
    if '"sewfast-equations"' in path.read_bytes().decode("utf-8", "replace"):
        fit = load_equations(path)
        kept(fit, load_equations, folder)
        with may("simulate", declined):
            own = fit.with_equations(turning)
            finite(own.simulate(levels(20, 2, 1)[:, 0]))
        return
    motor = sewfast.load_motor(path)
    kept(motor, sewfast.load_motor, folder)
    with may("simulate", declined):
        finite(motor.simulate(levels(60, 2, 1)[:, 0]))
    with may("model", declined):
        kept(motor.to_model(), sewfast.load_model, folder)
    with may("machine", declined):
        shown(motor.machine())
    with may("load", declined):
        finite(motor.turn_load(np.arange(5.0)))
    for target in ("wpilib", "mujoco", "urdf", "odrive", "moteus", "simplefoc"):
        with may(f"export {target}", declined):
            motor.export(target, winding="line").encode()
    with may("plot", declined):
        motor.plot(file=folder / "motor.svg")


def use_response(path: Path, folder: Path, declined: list[str], *, commands: bool) -> None:
    gains = sewfast.Gains.standard(0.01, 0.5)
    if b'"sewfast-frequency-responses"' in path.read_bytes():
        several = sewfast.load_responses(path)
        kept(several, sewfast.load_responses, folder)
        responses = list(several)
        with must():
            _ = several.fits
        if commands:
            with may("plot", declined):
                several.plot(file=folder / "responses.svg")
    else:
        responses = [sewfast.load_response(path)]
        kept(responses[0], sewfast.load_response, folder)
    for one in responses:
        finite(one.radius())
        finite(one.magnitude_db)
        finite(one.phase_deg)
        finite([abs(one.at(float(one.hertz[0])))])
        pid = sewfast.Controller(gains, Ts=one.Ts)
        with may("margins", declined):
            shown(one.margins(pid))
        if commands:
            with may("plot", declined):
                one.plot(file=folder / "response.svg")
    if commands and len(responses) == 1:
        command(declined, "bode", path)


def use_table(path: Path, folder: Path, declined: list[str], *, commands: bool) -> None:
    table = sewfast.read_table(path)
    with must():
        shown(table)
    with may("read", declined):
        data = sewfast.read(path)
        with must():
            shown(data)
        with may("diagnose", declined):
            shown(sewfast.diagnose(data))
        with may("identify", declined):
            model = sewfast.identify(data, model="oe", na=1, nb=1, nk=1)
            kept(model, sewfast.load_model, folder)
    if commands:
        command(declined, "look", path)
        command(declined, "identify", path, "--model", "arx", "-o", folder / "model.json")


def use_recording(path: Path, folder: Path, declined: list[str], *, commands: bool) -> None:
    found = read_recording(path)
    with must():
        shown(found)
        found.summary.encode()
    with may("read", declined):
        shown(sewfast.read(path, inputs="u", output="y"))
    with may("export", declined):
        out = folder / "again.mcap"
        out.unlink(missing_ok=True)
        exported(path, out)
        read_recording(out)
    if commands:
        command(declined, "show", path)
        command(declined, "export", path, "-o", folder / "x.csv", "--overwrite")
        command(declined, "look", path, "--input", "u", "--output", "y")


def use_project(path: Path, folder: Path, declined: list[str], *, commands: bool) -> None:
    project.load(path)
    before = Path.cwd()
    os.chdir(path.parent)
    try:
        if not Path("run.csv").exists():
            shutil.copy(make_tables(Path.cwd())[0], "run.csv")
        command(declined, "look", "run.csv")
        if commands:
            command(declined, "identify", "run.csv", "--model", "arx", "-o", "m.json")
            command(declined, "tune", "m.json", "--evaluations", "4", "-o", "c.json")
            command(declined, "stop")
    finally:
        os.chdir(before)


def use_commissioning(path: Path, folder: Path, declined: list[str], *, commands: bool) -> None:
    report(path.parent)
    if commands:
        command(declined, "report", path.parent)


def use_fleet(path: Path, folder: Path, declined: list[str], *, commands: bool) -> None:
    fleet = load_fleet(path)
    with must():
        shown(fleet)
        first, second = folder / f"kept-1{path.suffix}", folder / f"kept-2{path.suffix}"
        fleet.save(first)
        load_fleet(first).save(second)
    if first.read_bytes() != second.read_bytes():
        raise AssertionError("saved, read and saved again it is another file")
    with may("columns", declined):
        fleet.columns()
    if commands:
        with may("plot", declined):
            fleet.plot(file=folder / "fleet.svg")


# --- The bench ------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Format:
    make: Callable[[Path], list[Path]]
    change: Callable[[bytes, np.random.Generator], bytes]
    use: Callable[..., None]
    beside: bool = False
    """Whether it is read together with the other files of its folder."""


FORMATS = {
    "model": Format(make_models, changed_json, use_model),
    "controller": Format(make_controllers, changed_json, use_controller),
    "motor": Format(make_motors, changed_json, use_motor),
    "response": Format(make_responses, changed_json, use_response),
    "recording": Format(make_recordings, changed_recording, use_recording),
    "table": Format(make_tables, changed_table, use_table),
    "project": Format(make_projects, changed_settings, use_project, beside=True),
    "commissioning": Format(make_commissionings, changed_json, use_commissioning, beside=True),
    "fleet": Format(
        make_fleets,
        lambda c, rng: changed_json(c, rng) if c[:1] == b"{" else changed_table(c, rng),
        use_fleet,
    ),
}


@functools.cache
def originals(name: str, folder: Path) -> tuple[tuple[Path, bytes], ...]:
    folder.mkdir(parents=True, exist_ok=True)
    return tuple((path, path.read_bytes()) for path in FORMATS[name].make(folder))


def mutated(name: str, folder: Path, seed: int, k: int) -> Path:
    """File `k` of a seed."""
    rng = np.random.default_rng([seed, sorted(FORMATS).index(name), k])
    found = originals(name, folder)
    path, content = found[k % len(found)]
    changed = FORMATS[name].change(content, rng)
    if FORMATS[name].beside:
        for other, whole in found:
            other.write_bytes(whole)
    else:
        path = path.with_name(f"mutated{path.suffix}")
    path.write_bytes(changed)
    return path


def outcome(name: str, folder: Path, seed: int, k: int) -> tuple[str, str]:
    """What became of one file, and why."""
    path = mutated(name, folder, seed, k)
    declined: list[str] = []
    works = folder / "works"
    works.mkdir(exist_ok=True)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        # a unit in letters that the fonts of this computer have not
        warnings.filterwarnings("ignore", "Glyph")
        try:
            FORMATS[name].use(path, works, declined, commands=k // 15 % COMMANDS == 0)
        except SewfastError as error:
            if not str(error).strip() or "\n" in str(error)[:60]:
                return "WRONG", f"no words: {error!r}"
            return "refused", f"{type(error).__name__}: {error}"
        except Useless as error:
            return "USELESS", "".join(traceback.format_exception(error))
        except Warning:
            return "WARNED", traceback.format_exc()
        except MemoryError:
            return "MEMORY", traceback.format_exc()
        except BaseException:
            return "WRONG", traceback.format_exc()
    return ("declined", "\n".join(declined)) if declined else ("used", "")


def tried(
    name: str, folder: Path, seed: int, indices: Sequence[int]
) -> Iterator[tuple[int, str, str]]:
    """Outcomes of files in forks; a fork that hangs or dies is replaced at the next file."""
    originals(name, folder)
    todo = list(indices)
    while todo:
        read, write = os.pipe()
        child = os.fork()
        if child == 0:
            os.close(read)
            _serve(name, folder, seed, todo, write)
        os.close(write)
        buffer = b""
        while todo:
            ready, _, _ = select.select([read], [], [], PATIENCE)
            part = os.read(read, 1 << 16) if ready else b""
            if not part:
                break
            *lines, buffer = (buffer + part).split(b"\n")
            for line in lines:
                k, result, why = json.loads(line)
                todo.remove(k)
                yield k, result, why
        os.close(read)
        if todo:
            os.kill(child, signal.SIGKILL)
        status = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
        if todo:
            hung = not ready
            why = f"nothing for {PATIENCE:g} s" if hung else f"the process ended with {status}"
            yield todo.pop(0), "HANG" if hung else "CRASH", why


def _serve(name: str, folder: Path, seed: int, indices: Sequence[int], write: int) -> None:
    """In the fork; it does not return."""
    with contextlib.suppress(OSError, ValueError):
        size = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
        resource.setrlimit(resource.RLIMIT_AS, (size + MEMORY, size + MEMORY))
    nothing = os.open(os.devnull, os.O_RDWR)
    if not os.environ.get("MUTATIONS_LOUD"):
        os.dup2(nothing, 1)
        os.dup2(nothing, 2)
    try:
        for k in indices:
            line = json.dumps([k, *outcome(name, folder, seed, k)]) + "\n"
            os.write(write, line.encode())
    finally:
        os._exit(0)


def bench(name: str, folder: Path, seed: int, indices: Sequence[int], words: int) -> Counter[str]:
    """Outcomes of one format, and what was wrong, printed."""
    counts: Counter[str] = Counter()
    roots: dict[str, list[int]] = {}
    declined: Counter[str] = Counter()
    for k, result, why in tried(name, folder, seed, indices):
        counts[result] += 1
        if result == "declined":
            for line in why.split("\n"):
                declined[re.sub(r"[-\d.e+]+", "#", line)[:150]] += 1
        elif result not in GOOD:
            roots.setdefault(f"{result} {_root(why)}", []).append(k)
    print(f"{name}: {sum(counts.values())} files, {dict(counts)}", flush=True)
    for root, ks in sorted(roots.items(), key=lambda r: -len(r[1])):
        print(f"  {len(ks):4d} {root}  [{', '.join(map(str, ks[:6]))}]")
    for text, count in declined.most_common(words):
        print(f"  {count:4d} {text}")
    sys.stdout.flush()
    return counts


def _root(why: str) -> str:
    """The line of sewfast at which it went wrong, with the error."""
    frames = re.findall(r'sewfast/(\S+)", line (\d+)', why)
    last = [line for line in why.strip().splitlines() if line.strip()]
    at = ":".join(frames[-1]) if frames else ""
    return f"{at} {last[-1][:160] if last else ''}"


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--count", type=int, default=1000, help="files of each format (1000)")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--formats", nargs="*", default=list(FORMATS), choices=list(FORMATS))
    parser.add_argument("--declined", type=int, default=0, help="most frequent words to print")
    parser.add_argument("--replay", type=int, help="only this file; it is kept")
    args = parser.parse_args()
    if args.replay is not None:
        folder = Path(tempfile.mkdtemp(prefix="mutated-"))
        print(mutated(args.formats[0], folder, args.seed, args.replay))
        print(*outcome(args.formats[0], folder, args.seed, args.replay))
        return 0
    wrong = 0
    with tempfile.TemporaryDirectory() as place:
        for name in args.formats:
            counts = bench(name, Path(place) / name, args.seed, range(args.count), args.declined)
            wrong += sum(n for result, n in counts.items() if result not in GOOD)
    print(f"traceback, hang, or loads and cannot be used: {wrong} (seed {args.seed})")
    return int(wrong > 0)


if __name__ == "__main__":
    sys.exit(main())
