"""C99 of models and controllers: coefficients from the core, the steps from the files in `c99/`.

The C computes bit for bit what `sewfast_control`, the Rust crate for microcontrollers, computes in
the same precision.

Placeholders in the files: `@_` is the prefix of every function, `@@_` the same in capitals, `@m_`
and `@M_` the prefixes of a model's member; `R(1.0)` is a literal of the precision.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from importlib.resources import files as resources
from typing import Any

import numpy as np

from sewfast import __version__, _core
from sewfast.control import Controller
from sewfast.dataset import FloatArray
from sewfast.errors import SettingError
from sewfast.gains import Gains
from sewfast.models import Model
from sewfast.models.base import Combine, kept

from .precision import (
    Lead,
    at_rest,
    combined_run,
    controller_step,
    early,
    embedded_members,
    excitation,
    lead_of,
    model_loss,
    runs_away,
    signals,
)

KEYWORDS = frozenset(
    keyword
    for line in (
        "auto bool break case char class const continue default delete do double else enum",
        "extern float for goto if inline int long main namespace new private public register",
        "restrict return short signed sizeof static struct switch template this typedef union",
        "unsigned using void volatile while fmi3",
    )
    for keyword in line.split()
)
"""Words of C and C++, and the file `fmi3`, which cannot be names."""
_LARGEST = float(np.finfo(np.float32).max)
_VECTORS = 200
"""Samples of the test that is written with the code."""
_FILTERED = """    @_real samples[@@_SAMPLES];
    @_real lag, speed, innovation; /* of the feedback filter */
"""
_FILTERED_AHEAD = """    @_filtering of_feedback, of_kept; /* measured, and expected */
    @_real kept[@@_KEPT]; /* the last references, a ring */
"""
_LICENCE = "The code in this file may be used under MIT, Apache-2.0 or 0BSD, as you like."


def files(
    what: Model | Controller, name: str, precision: str, *, changeable: bool = False
) -> tuple[dict[str, str], list[str]]:
    """The texts of all files by file name, and notes on them."""
    code = Code(name, precision)
    if isinstance(what, Controller):
        header, source, vectors, notes = _controller(what, code, changeable)
    else:
        header, source, vectors, notes = _model(what, code)
    texts = {
        f"{name}.h": header,
        f"{name}.c": source,
        f"{name}_test.c": vectors,
        **_build_files(name, what),
    }
    return texts, notes


@dataclass(frozen=True)
class Code:
    """A name and a number type, and how both are written in C."""

    name: str
    precision: str

    @property
    def single(self) -> bool:
        return self.precision == "f32"

    @property
    def real(self) -> str:
        return "float" if self.single else "double"

    def literal(self, value: float) -> str:
        """The shortest decimal that a compiler reads as this number."""
        if math.isnan(value):
            raise SettingError(
                name="model", expected="numbers to write", received="NaN",
                remedy="identify the model again",
            )  # fmt: skip
        if self.single and _LARGEST < abs(value) < math.inf:
            raise SettingError(
                name="precision", expected="numbers that single precision holds",
                received=f"{value:g}", remedy="deploy it with precision f64",
            )  # fmt: skip
        if math.isinf(value):
            largest = "3.40282347e+38f" if self.single else "1.7976931348623157e+308"
            return largest if value > 0 else f"-{largest}"
        text = str(np.float32(value)) if self.single else repr(float(value))
        text = text if re.search(r"[.e]", text) else f"{text}.0"
        return f"{text}f" if self.single else text

    def literals(self, values: Iterable[float], indent: str = "    ") -> str:
        """Numbers separated by commas, six in a row."""
        written = [self.literal(float(v)) for v in values]
        rows = [", ".join(written[i : i + 6]) for i in range(0, len(written), 6)]
        return f",\n{indent}".join(rows)

    def table(self, name: str, values: Iterable[float]) -> str:
        """A constant array."""
        numbers = list(values)
        body = self.literals(numbers)
        return f"static const {self.name}_real {name}[{len(numbers)}] = {{\n    {body}\n}};\n"

    def template(self, file: str, member: str = "", **values: str) -> str:
        """A file of `c99/` with its placeholders replaced."""
        text = resources(__package__).joinpath("c99", file).read_text(encoding="utf-8")
        for key in sorted(values, key=len, reverse=True):
            text = text.replace(f"@{key}", values[key])
        prefix = member or self.name
        text = text.replace("@m_", f"{prefix}_").replace("@M_", f"{prefix.upper()}_")
        text = text.replace("@@_", f"{self.name.upper()}_").replace("@_", f"{self.name}_")
        suffix = "f" if self.single else ""
        return re.sub(r"R\((-?[0-9.]+)\)", rf"\g<1>{suffix}", text)

    def tanh(self) -> str:
        """The hyperbolic tangent of the core, with its coefficients."""
        values: dict[str, str] = {}
        for name, (numerator, denominator, end) in _core.tanh_quotients().items():
            wide = Code(self.name, "f32" if name == "single" else "f64")
            values[f"{name.upper()}_P"] = wide.literals(numerator, " " * 12)
            values[f"{name.upper()}_Q"] = wide.literals(denominator, " " * 12)
            values[f"{name.upper()}_END"] = wide.literal(end)
        return self.template(f"tanh_{self.precision}.c", **values)

    def opening(self, what: str, about: Iterable[str]) -> str:
        """The comment at the start of every file."""
        lines = [
            what,
            "",
            *about,
            "",
            _LICENCE,
            f"Written by sewfast {__version__}; change it there.",
        ]
        body = "\n".join(f" * {_safe(line)}".rstrip() for line in lines)
        return f"/*\n{body}\n */\n"

    def framed(self, file: str, opening: str, body: str) -> str:
        """A whole file: a header, or code that does not compile with fast-math."""
        return self.template(file, OPENING=opening, REAL=self.real, NAME=self.name, BODY=body)


def _safe(text: str) -> str:
    """Text of a user without control characters, ends of comments and placeholders."""
    return re.sub(r"[\x00-\x1f\x7f]", " ", text.replace("*/", "* /").replace("/*", "/ *")).replace(
        "@", "(at)"
    )


# --- Models ---------------------------------------------------------------------------------------


def _model(model: Model, code: Code) -> tuple[str, str, str, list[str]]:
    members, embedded, combined = embedded_members(model, code.precision)
    functions = ", ".join(f"{code.name}_{f}" for f in ("init", "begin", "step"))
    notes = [f"{model.title} as C99 in {code.real}: {functions}"]
    notes += runs_away(members)
    if code.single:
        notes.append(model_loss(model, members, embedded, combined))
    numbers = sum(len(v) for e in embedded for v in e.parts.values())
    size = 4 if code.single else 8
    rooms = [e.orders["na"] + e.orders["inputs"] * _kept(e) for e in embedded]
    notes.append(
        f"{numbers * size} bytes of coefficients, {sum(rooms) * size} bytes of memory a model"
    )
    inputs = ", ".join(
        _named(n, u) for n, u in zip(model.input_names, model.input_units, strict=True)
    )
    output = _named(model.output_name, model.output_unit)
    about = [
        f"{model.title}: from {inputs} to {output} every {model.Ts:g} s.",
        *model.describe(),
        f"Parameters: {_digest(model)}.",
        "",
        "Compile with -ffp-contract=off where a step is to have the bits of sewfast's own.",
        "No heap, no C library, no global state; a step takes the same path every time.",
    ]
    return (
        _model_header(model, code, embedded, about),
        _model_source(code, members, embedded, combined, about),
        _model_test(model, code, members, embedded, combined),
        notes,
    )


def _named(name: str, unit: str) -> str:
    return f"{name} [{unit}]" if unit else name


def _digest(model: Model) -> str:
    """The start of the hash of all parameters, by which two models can be distinguished."""
    import hashlib

    return f"SHA-256 {hashlib.sha256(model.theta.tobytes()).hexdigest()[:16]}"


def _kept(embedded: _core.EmbeddedModel) -> int:
    return embedded.orders["nk"] + embedded.orders["nb"]


def _model_header(
    model: Model, code: Code, embedded: list[_core.EmbeddedModel], about: list[str]
) -> str:
    memories, fields = "", ""
    for prefix, e in zip(_prefixes(code, embedded), embedded, strict=True):
        sizes = {"SIZE": e.orders["na"], "ROOM": e.orders["inputs"] * _kept(e)}
        memories += code.template("memory.h", prefix, **{k: str(v) for k, v in sizes.items()})
        fields += f"    {prefix}_memory {_member_name(prefix, code)};\n"
    body = code.template(
        "model.h",
        INPUTS=str(len(model.input_names)),
        STATES=str(sum(e.orders["na"] for e in embedded)),
        TS=Code(code.name, "f64").literal(model.Ts),
        MEMORIES=memories,
        FIELDS=fields,
    )
    return code.framed("frame.h", code.opening(f"{code.name}: an identified model", about), body)


def _prefixes(code: Code, embedded: list[_core.EmbeddedModel]) -> list[str]:
    if len(embedded) == 1:
        return [code.name]
    return [f"{code.name}_{i}" for i in range(len(embedded))]


def _member_name(prefix: str, code: Code) -> str:
    return "only" if prefix == code.name else f"member_{prefix.rsplit('_', 1)[1]}"


def _model_source(
    code: Code,
    members: list[Model],
    embedded: list[_core.EmbeddedModel],
    combined: Combine,
    about: list[str],
) -> str:
    prefixes = _prefixes(code, embedded)
    networks = any(e.kind != "linear" for e in embedded)
    functions = {e.output[0] for e in embedded if e.kind == "states"}
    parts = [code.template("common.c")]
    if networks:
        parts += [code.tanh(), code.template("lanes.c")]
    parts += [code.template(f"{f}.c") for f in sorted(functions - {"linear"})]
    for prefix, e in zip(prefixes, embedded, strict=True):
        parts.append(_member(code, prefix, e))
    parts.append(_whole(code, prefixes, members, embedded, combined))
    opening = code.opening(f"{code.name}: an identified model", about)
    return code.framed("frame.c", opening, "\n".join(parts))


def _member(code: Code, prefix: str, e: _core.EmbeddedModel) -> str:
    orders, upper = e.orders, prefix.upper()
    sizes = {"NB": orders["nb"], "NK": orders["nk"], "KEPT": _kept(e), "NA": orders["na"]}
    if e.kind == "network":
        sizes["HIDDEN"] = len(e.parts["b1"])
    if e.kind == "states":
        sizes |= {"NX": orders["na"], "HIDDEN": len(e.parts["bh"])}
        del sizes["NB"]
    defines = "".join(f"#define {upper}_{key} {value}\n" for key, value in sizes.items())
    limits = {k: float(e.parts[k][0]) for k in ("low", "high") if k in e.parts}
    tables = "".join(
        code.table(f"{prefix}_{key}", values)
        for key, values in e.parts.items()
        if key not in limits
    )
    scaled, begin, restored = "", "state[i]", "y"
    scaling = e.scaling
    if scaling is not None:
        tables += code.table(f"{prefix}_u_mean", scaling["u_mean"])
        tables += code.table(f"{prefix}_u_scale", scaling["u_scale"])
        mean, scale = code.literal(scaling["y_mean"][0]), code.literal(scaling["y_scale"][0])
        scaled = f"({{}} - {prefix}_u_mean[j]) / {prefix}_u_scale[j]"
        restored = f"y * {scale} + {_signed(mean)}"
        if e.kind == "network":
            begin = f"(state[i] - {_signed(mean)}) / {scale}"
    limited = ""
    if limits and not (math.isinf(limits["low"]) and math.isinf(limits["high"])):
        low, high = code.literal(limits["low"]), code.literal(limits["high"])
        limited = f"    sum = sum < {low} ? {low} : sum;\n    sum = sum > {high} ? {high} : sum;\n"
    function, values = e.output
    output = {
        "linear": "sum",
        "saturation": "@_saturated(sum, {})",
        "abs": "@_hypotenuse(sum, {})",
    }[function].format(", ".join(code.literal(v) for v in values))
    body = code.template(f"{e.kind}.c", prefix, LIMITS=limited, OUTPUT=output)
    frame = code.template("member.c", prefix, BEGIN_STATE=begin, RESTORED=restored)
    frame = re.sub(
        r"@SCALED\((\w+\[j\])\)", lambda m: scaled.format(m[1]) if scaled else m[1], frame
    )
    return f"/* ---- {prefix} ---- */\n\n{defines}\n{tables}\n{body}\n{frame}"


def _signed(literal: str) -> str:
    return f"({literal})" if literal.startswith("-") else literal


def _whole(
    code: Code,
    prefixes: list[str],
    members: list[Model],
    embedded: list[_core.EmbeddedModel],
    combined: Combine,
) -> str:
    """The public functions, which run all members and combine their outputs."""
    count = len(prefixes)
    names = [_member_name(p, code) for p in prefixes]
    at, begins = 0, ""
    for prefix, name, e in zip(prefixes, names, embedded, strict=True):
        begins += f"    {prefix}_begin_member(&model->{name}, state + {at}, held);\n"
        at += e.orders["na"]
    steps = [f"{p}_step_member(&model->{name}, u)" for p, name in zip(prefixes, names, strict=True)]
    combine = ""
    if count == 1:
        step = f"    return {steps[0]};\n"
    else:
        runs = "".join(f"    y[{i}] = {s};\n" for i, s in enumerate(steps))
        step = f"    @_real y[{count}];\n{runs}    return @_combined(y);\n"
        middle = range(*kept(combined, count))
        total = " + ".join(f"y[{i}]" for i in middle)
        mean = f"({total}) / R({len(middle)}.0)" if len(middle) > 1 else total
        template = "mean.c" if combined == "mean" else "median.c"
        combine = code.template(template, COUNT=str(count), NAME=combined, MIDDLE=mean)
    states, held = at_rest(members)
    rest, before = (code.literals(v, " " * 8) for v in (np.concatenate(states), held))
    return combine + code.template("model.c", BEGINS=begins, REST=rest, HELD=before, STEP=step)


def _model_test(
    model: Model,
    code: Code,
    members: list[Model],
    embedded: list[_core.EmbeddedModel],
    combined: Combine,
) -> str:
    u = excitation(model, _VECTORS)
    if code.single:
        u = u.astype(np.float32).astype(np.float64)
    y = combined_run(members, embedded, combined, u, code.precision)
    return _test(code, "test_model.c", {"u": u.ravel(), "y": y})


def _test(code: Code, file: str, vectors: Mapping[str, FloatArray], **places: str) -> str:
    opening = code.opening(
        f"A test of {code.name}: its results are compared with those of sewfast, to the last bit.",
        ["Returns 0 where all are equal."],
    )
    tables = "\n".join(code.table(name, values) for name, values in vectors.items())
    body, count = code.template(file, COUNT=str(_VECTORS), **places), str(_VECTORS)
    values = {"OPENING": opening, "NAME": code.name, "TABLES": tables, "BODY": body}
    return code.template("test.c", COUNT=count, **values)


# --- The controller -------------------------------------------------------------------------------


def _controller(
    controller: Controller, code: Code, changeable: bool
) -> tuple[str, str, str, list[str]]:
    core, loss = controller_step(controller, code.precision)
    numbers: dict[str, Any] = core.numbers
    u, y = controller.gains.u_unit or "u", controller.gains.y_unit or "y"
    about = [
        *str(controller).splitlines(),
        "",
        f"Reference and measurement in {y}, command in {u}.",
        f"Call {code.name}_step once every {controller.Ts:g} s.",
        "Compile with -ffp-contract=off where a step is to have the bits of sewfast's own.",
        "No heap, no C library, no global state.",
    ]
    size = 4 if code.single else 8
    lead = lead_of(numbers)
    kept = numbers["samples"] + 10 + 6 * len(numbers["biquads"]) + 7 * changeable
    kept += lead.kept + numbers["samples"] + 3 if lead else 0
    functions = [f"{code.name}_init", f"{code.name}_step"]
    if changeable:
        functions += [f"{code.name}_set_gains", f"{code.name}_set_limits"]
    notes = [
        f"PID as C99 in {code.real}: {', '.join(functions)}; about "
        f"{kept * size + 10 + 12 * bool(lead)} bytes of memory",
        *loss,
        *early(numbers),
    ]
    return (
        _controller_header(controller, code, numbers, about, changeable),
        _controller_source(controller, code, numbers, about, changeable),
        _controller_test(controller, code, core, changeable),
        notes,
    )


def _controller_header(
    controller: Controller,
    code: Code,
    numbers: Mapping[str, Any],
    about: list[str],
    changeable: bool,
) -> str:
    units = {
        "UNIT_U": _safe(controller.gains.u_unit or "u"),
        "UNIT_Y": _safe(controller.gains.y_unit or "y"),
    }
    members, flags, biquads = "", "", ""
    if sections := len(numbers["biquads"]):
        biquads = code.template("biquads.h", SECTIONS=str(sections))
        members += "    @_biquad of_y[@@_BIQUADS], of_r[@@_BIQUADS]; /* of y and r */\n"
        flags += ", y_begun, r_begun"
    if changeable:
        members += "    @_terms terms;\n    @_real u_min, u_max;\n"
        flags += ", held"
    memory, counter = _FILTERED, "    int next;\n"
    filtering, ahead, told = "averaging, lagging, observing, ", "", ""
    if lead := lead_of(numbers):
        memory = _FILTERED_AHEAD
        filtering, counter = "", "    int newest;\n"
        flags += ", ahead"
        ahead = code.template("ahead.h", PREVIEW=str(lead.preview), KEPT=str(lead.kept))
        if lead.preview:
            told = f"\n * The reference arrives {code.name.upper()}_PREVIEW samples early."
    body = code.template(
        "pid.h",
        FILTER_MEMORY=memory,
        FILTER_NEXT=counter,
        FILTER_FLAGS=filtering,
        AHEAD_TYPE=ahead,
        EARLY=told,
        TS=Code(code.name, "f64").literal(controller.Ts),
        SAMPLES=str(numbers["samples"]),
        BIQUADS_TYPE=biquads,
        TERMS_TYPE=code.template("terms.h", RATE=", rate") if changeable else "",
        MEMBERS=members,
        FLAGS=flags,
        CHANGES=code.template("changes.h", **units) if changeable else "",
        **units,
    )
    opening = code.opening(f"{code.name}: a two-degree-of-freedom PID controller", about)
    return code.framed("frame.h", opening, body)


def _controller_source(
    controller: Controller,
    code: Code,
    numbers: Mapping[str, Any],
    about: list[str],
    changeable: bool,
) -> str:
    def number(name: str) -> str:
        return _signed(code.literal(numbers[name]))

    observer = ""
    if numbers["observes"]:
        observer = code.template("observer.c", KEEP=number("keep"), GAIN=number("gain"))
    if numbers["tracks"]:
        windup = f"        kept = integral + {number('tracking')} * excess;"
    else:
        windup = (
            "        /* the integral stops where it pushes on, and still moves away */\n"
            "        kept = (integral - c->integral) * excess < R(0.0) ? c->integral : integral;"
        )
    names = ("ALPHA", "BETA", "LAG", "U_MIN", "U_MAX")
    places = {name: number(name.lower()) for name in names}
    terms = code.template("terms.h", RATE=", rate" if changeable else "")
    empty = ("BIQUADS", "AHEAD", "OF_Y", "OF_AHEAD", "OF_R", "INIT", "HELD", "CHANGES")
    places |= dict.fromkeys(empty, "")
    places |= {"TERMS_TYPE": terms, "GAINS_NOW": "@_gains(filtered)"}
    places |= {"MEMORY": "@_pid", "WITHIN": "c", "PASS": "held", "PASSED": ""}
    if lead := lead_of(numbers):
        places |= {
            "MEMORY": "@_filtering",
            "WITHIN": "&c->of_feedback",
            "PASS": "passed",
            "PASSED": code.template("passed.c"),
            "AHEAD": _ahead(code, lead),
            "OF_AHEAD": code.template("ahead_r.c"),
            "INIT": "    c->newest = 0;\n    c->ahead = 0;\n",
        }
    # no bound is none at all: the largest number would be one, next to it
    places |= {"FROM": "    (void)start;\n", "RAMPED": "r"}
    if math.isfinite(numbers["ramp"]):
        places["FROM"] = "    const @_real from = c->ramping ? c->ramped : start;\n"
        places["RAMPED"] = "@_limit(r, from - {0}, from + {0})".format(number("ramp"))
    if numbers["biquads"]:
        rows = [f"{{{', '.join(map(code.literal, row))}}}" for row in numbers["biquads"]]
        places |= {
            "BIQUADS": code.template("biquads.c", SECTIONS=",\n    ".join(rows)),
            "OF_Y": code.template("biquads_y.c", PASS=places["PASS"]),
            "OF_R": code.template("biquads_r.c"),
        }
        places["INIT"] += "    c->y_begun = 0;\n    c->r_begun = 0;\n"
    if changeable:
        step = {"FILTER": _derivative_lag(code, numbers), "STEP": code.literal(numbers["ts"])}
        own = ", ".join(
            code.literal(v)
            for v in (numbers["kp"], numbers["ki"], controller.gains.to("standard").Td)
        )
        places["INIT"] += f"    c->terms = @_terms_of({own});\n"
        places["INIT"] += f"    c->u_min = {number('u_min')};\n    c->u_max = {number('u_max')};\n"
        places["INIT"] += "    c->held = 0;\n"
        places |= {
            "HELD": "    c->held = 1;\n",
            "TERMS_TYPE": "",  # the header declares it
            "GAINS_OF": code.template("terms.c", **step),
            "GAINS_NOW": "c->terms",
            "CHANGES": code.template(
                "changes.c", ALPHA=number("alpha"), LARGEST=code.literal(math.inf), **step
            ),
            "U_MIN": "c->u_min",
            "U_MAX": "c->u_max",
        }
    else:
        places["GAINS_OF"] = code.template("gains.c", GAINS=_gains(code, numbers).rstrip()) + "\n"
    limited = f"@_limit(wanted, {places['U_MIN']}, {places['U_MAX']})"
    if math.isfinite(numbers["change"]):
        change = number("change")
        limited = f"@_limit({limited}, c->u - {change}, c->u + {change})"
    places["LIMITED"] = limited
    body = code.template(
        "pid.c",
        OBSERVER=observer,
        WINDUP=windup,
        FILTER_WORDS=", then an observer" if numbers["observes"] else "",
        **places,
    )
    opening = code.opening(f"{code.name}: a two-degree-of-freedom PID controller", about)
    return code.framed("frame.c", opening, body)


def _ahead(code: Code, lead: Lead) -> str:
    """The functions of a feedforward."""
    levels, tabs = "", ",\n" + " " * 8
    if len(lead.levels) == 1:
        (y, u) = (_signed(code.literal(v)) for v in lead.levels[0])
        levels = code.template("level.c", Y=y, U=u)
    elif lead.levels:
        rows = [f"{{{', '.join(map(code.literal, row))}}}" for row in lead.levels]
        levels = code.template("levels.c", COUNT=str(len(rows)), TABLE=tabs.join(rows))
    held = "@_held(c->kept[c->newest]) + " if levels else ""
    if lead.taps:
        table = code.literals(lead.taps, " " * 8)
        needed = code.template("taps.c", COUNT=str(len(lead.taps)), TABLE=table, SUM=f"{held}sum")
    else:
        needed = f"    return {held}R(0.0);\n"
    late = _signed(code.literal(lead.late))
    return code.template("ahead.c", LATE=late, LEVELS=levels, NEEDED=needed)


def _derivative_lag(code: Code, numbers: Mapping[str, Any]) -> str:
    """`Td/N`, which is 0 for an infinite N."""
    return "R(0.0)" if math.isinf(numbers["n"]) else f"td / {code.literal(numbers['n'])}"


def _gains(code: Code, numbers: Mapping[str, Any]) -> str:
    """The body of the function that returns the gains of a sample."""
    rows = numbers["rows"]
    if not rows:
        terms = ", ".join(code.literal(numbers[k]) for k in ("kp", "ki", "kd", "pole"))
        return code.template("constant.c", TERMS=terms)
    # the last point, whose distance to the next is 0, is listed twice
    used = rows[: next(i for i, row in enumerate(rows) if row[4] == 0.0) + 2]
    lines = [f"{{{', '.join(code.literal(v) for v in row)}}}" for row in used]
    return code.template(
        "schedule.c",
        ROWS=str(len(used)),
        TABLE=(",\n" + " " * 8).join(lines),
        FILTER=_derivative_lag(code, numbers),
        STEP=code.literal(numbers["ts"]),
    )


def _controller_test(controller: Controller, code: Code, core: Any, changeable: bool) -> str:
    r, y = signals(controller, _VECTORS, code.precision)
    u, switch = [], ""
    middle = _VECTORS // 2
    if changeable:
        other = _other_gains(controller.gains.to("standard"))
        given = ", ".join(code.literal(v) for v in (other.Kp, other.Ti, other.Td))
        switch = f"        wrong += k == {middle} && !@_set_gains(&c, {given});\n"
    for k, (a, b) in enumerate(zip(r, y, strict=True)):
        if changeable and k == middle:
            changed: Any = replace(controller, gains=other).core()
            core.set_design(changed.single() if code.single else changed)
        u.append(core.step(float(a), float(b)))
    vectors = {"r": r, "y": y, "u": np.array(u)}
    return _test(code, "test_pid.c", vectors, SWITCH=switch)


def _other_gains(gains: Gains) -> Gains:
    """Gains to change to: weaker, with another derivative."""
    return Gains.standard(
        0.5 * gains.Kp, 2.0 * gains.Ti, 1.5 * gains.Td, u_unit=gains.u_unit, y_unit=gains.y_unit
    )


# --- Files for build systems: CMake, PlatformIO, Zephyr, and a page of instructions ---------------


def _build_files(name: str, what: Model | Controller) -> dict[str, str]:
    """Texts by file name; the build systems include everything deployed into the folder."""
    return {
        "CMakeLists.txt": _CMAKE,
        "library.json": _platformio(),
        "zephyr/module.yml": "name: deployed\nbuild:\n  cmake: zephyr\n",
        "zephyr/CMakeLists.txt": _ZEPHYR,
        f"{name}.md": _page(name, what),
    }


_CMAKE = """cmake_minimum_required(VERSION 3.10)
project(deployed C)
enable_testing()

# every NAME.c of this folder is a library NAME, with the test NAME_test
file(GLOB tests ${CMAKE_CURRENT_SOURCE_DIR}/*_test.c)
foreach(test ${tests})
  get_filename_component(file ${test} NAME_WE)
  string(REGEX REPLACE "_test$" "" name ${file})
  add_library(${name} STATIC ${CMAKE_CURRENT_SOURCE_DIR}/${name}.c)
  target_include_directories(${name} PUBLIC ${CMAKE_CURRENT_SOURCE_DIR})
  set_target_properties(${name} PROPERTIES C_STANDARD 99)
  # the bits of sewfast's own step: no fused multiply-add
  target_compile_options(${name} PRIVATE -ffp-contract=off)
  add_executable(${file} EXCLUDE_FROM_ALL ${test})
  target_link_libraries(${file} ${name})
  add_test(NAME ${name} COMMAND ${file})
endforeach()
"""

_ZEPHYR = """file(GLOB sources ${CMAKE_CURRENT_LIST_DIR}/../*.c)
list(FILTER sources EXCLUDE REGEX "_test\\.c$")
zephyr_library()
zephyr_library_sources(${sources})
zephyr_library_compile_options(-ffp-contract=off)
zephyr_include_directories(..)
"""


def _platformio() -> str:
    library = {
        "name": "deployed",
        "version": __version__,
        "description": "Written by sewfast",
        "license": "0BSD",
        "frameworks": "*",
        "platforms": "*",
        "build": {
            "srcFilter": ["+<*.c>", "-<*_test.c>"],
            "srcDir": ".",
            "includeDir": ".",
            "flags": ["-ffp-contract=off"],
        },
    }
    return json.dumps(library, indent=2) + "\n"


def _page(name: str, what: Model | Controller) -> str:
    if isinstance(what, Controller):
        use = (
            f"static {name}_pid pid;\n\n{name}_init(&pid);           /* once */\n"
            f"u = {name}_step(&pid, r, y); /* every {what.Ts:g} s */"
        )
    else:
        use = (
            f"static {name}_model plant;\n\n{name}_init(&plant);          /* once */\n"
            f"y = {name}_step(&plant, &u); /* every {what.Ts:g} s */"
        )
    return f"""# {name}

```c
#include "{name}.h"

{use}
```

- `{name}.c` and `{name}.h` are all that the firmware needs.
- `{name}_test.c` compares the results on your processor with those of sewfast, bit by bit:
  `cc -std=c99 -ffp-contract=off {name}.c {name}_test.c && ./a.out`
- CMake: `add_subdirectory`, then link `{name}`. PlatformIO: put this folder into `lib/`. Zephyr:
  name it in `ZEPHYR_EXTRA_MODULES`.

You may use the code under MIT, Apache-2.0 or 0BSD, as you like.
"""
