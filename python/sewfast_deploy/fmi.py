"""FMI 3.0: a model or a controller as a co-simulation FMU, with its C source and a Linux binary.

The FMU advances in whole sample times. Its arithmetic is the C of `c99`, in double precision.
"""

from __future__ import annotations

import hashlib
import io
import platform
import shutil
import subprocess
import sys
import tempfile
import zipfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from xml.sax.saxutils import quoteattr

from sewfast import __version__
from sewfast.control import Controller
from sewfast.errors import SettingError
from sewfast.models import Model

from . import c99
from .precision import at_rest, embedded_members

_UNITS = {
    "V": ("kg=1, m=2, s=-3, A=-1", 1.0),
    "A": ("A=1", 1.0),
    "rad/s": ("rad=1, s=-1", 1.0),
    "RPM": ("rad=1, s=-1", 0.10471975511965977),
    "rad": ("rad=1", 1.0),
    "m": ("m=1", 1.0),
    "m/s": ("m=1, s=-1", 1.0),
    "N": ("kg=1, m=1, s=-2", 1.0),
    "s": ("s=1", 1.0),
}
"""SI exponents and factor of the units that importers can convert."""


@dataclass(frozen=True)
class _System:
    name: str
    title: str
    Ts: float
    inputs: Sequence[tuple[str, str]]
    starts: Sequence[float]
    """The inputs until they are set: those of a plant at rest."""
    output: tuple[str, str]
    direct: bool
    """Whether the output depends on the inputs of the same sample."""
    kind: str
    advance: str
    now: str


def files(
    what: Model | Controller, name: str, precision: str
) -> tuple[dict[str, bytes], list[str]]:
    """The FMU by its file name, and notes on it."""
    if precision != "f64":
        raise SettingError(
            name="precision", expected="f64 for fmi", received=repr(precision),
            remedy="leave it out",
        )  # fmt: skip
    code, _ = c99.files(what, name, "f64")
    system = _of(what, name)
    sources = {f"{name}.{end}": code[f"{name}.{end}"] for end in ("c", "h")}
    text = "".join(sources.values())
    token = "{" + hashlib.sha256(text.encode()).hexdigest()[:32] + "}"
    sources["fmi3.c"] = _functions(system, token)
    entries: dict[str, bytes] = {
        "modelDescription.xml": _description(system, token).encode(),
        "sources/buildDescription.xml": _build(name).encode(),
        **{f"sources/{file}": text.encode() for file, text in sources.items()},
        f"binaries/{_platform()}/{name}.so": _compiled(name, sources),
    }
    notes = [
        f"{system.title} as FMU 3.0 for co-simulation: {', '.join(n for n, _ in system.inputs)} -> "
        f"{system.output[0]}, in steps of {system.Ts:g} s",
        f"binary for {_platform()}; other platforms build from its sources",
    ]
    return {f"{name}.fmu": _zipped(entries)}, notes


def _of(what: Model | Controller, name: str) -> _System:
    if isinstance(what, Controller):
        u, y = what.gains.u_unit, what.gains.y_unit
        ahead = what.feedforward.preview if what.feedforward else 0
        title = (
            f"PID controller, its reference {ahead} samples early" if ahead else "PID controller"
        )
        return _System(
            name, title, what.Ts, [("r", y), ("y", y), ("feedforward", u)],
            (0.0, 0.0, 0.0), ("u", u), False, f"{name}_pid",
            f"return {name}_step_with(system, u[0], u[1], u[2]);", "return now->system.u;",
        )  # fmt: skip
    inputs = list(zip(what.input_names, what.input_units, strict=True))
    names = [*what.input_names, what.output_name, "time"]
    if len(set(names)) < len(names):
        raise SettingError(
            name="model", expected="names of inputs and output that differ and are not time",
            received=", ".join(names[:-1]), remedy="rename the columns and identify again",
        )  # fmt: skip
    members, embedded, _ = embedded_members(what, "f64")
    direct = any(e.orders["nk"] == 0 for e in embedded)
    _, starts = at_rest(members)
    return _System(
        name, what.title, what.Ts, inputs, starts.tolist(), (what.output_name, what.output_unit),
        direct, f"{name}_model", f"return {name}_step(system, u);",
        f"{name}_model copy = now->system;\n    return advance(&copy, now->u);",
    )  # fmt: skip


def _functions(system: _System, token: str) -> str:
    code = c99.Code(system.name, "f64")
    opening = code.opening(f"{system.name}: the functions of an FMU", [f"{system.title}."])
    return code.template(
        "fmi3.c",
        OPENING=opening,
        NAME=system.name,
        TOKEN=token,
        INPUTS=str(len(system.inputs)),
        STARTS=code.literals(system.starts),
        TS=code.literal(system.Ts),
        KIND=system.kind,
        ADVANCE=f"    {system.advance}\n",
        OUTPUT_NOW=f"    {system.now}\n",
    )


def _description(system: _System, token: str) -> str:
    """`modelDescription.xml`."""
    units = sorted({unit for _, unit in [*system.inputs, system.output] if unit})
    output = len(system.inputs) + 1
    references = " ".join(str(i + 1) for i in range(len(system.inputs)))
    lines = [
        '<?xml version="1.0" encoding="UTF-8"?>',
        f'<fmiModelDescription fmiVersion="3.0" modelName={quoteattr(system.name)} '
        f"instantiationToken={quoteattr(token)} description={quoteattr(system.title)} "
        f'generationTool="sewfast {__version__}" variableNamingConvention="flat">',
        f"  <CoSimulation modelIdentifier={quoteattr(system.name)} "
        'canHandleVariableCommunicationStepSize="true" canGetAndSetFMUState="true" '
        f'canSerializeFMUState="true" fixedInternalStepSize="{system.Ts!r}"/>',
    ]
    if units:
        lines += ["  <UnitDefinitions>", *(_unit(unit) for unit in units), "  </UnitDefinitions>"]
    lines += [
        f'  <DefaultExperiment startTime="0" stepSize="{system.Ts!r}"/>',
        "  <ModelVariables>",
        '    <Float64 name="time" valueReference="0" causality="independent" '
        'variability="continuous"/>',
    ]
    for i, ((name, unit), start) in enumerate(zip(system.inputs, system.starts, strict=True)):
        lines.append(
            f'    <Float64 name={quoteattr(name)} valueReference="{i + 1}" causality="input" '
            f'variability="discrete" start="{start:.17g}"{_with_unit(unit)}/>'
        )
    name, unit = system.output
    lines += [
        f'    <Float64 name={quoteattr(name)} valueReference="{output}" causality="output" '
        f'variability="discrete" initial="calculated"{_with_unit(unit)}/>',
        "  </ModelVariables>",
        "  <ModelStructure>",
    ]
    dependencies = references if system.direct else ""
    lines += [
        f'    <{tag} valueReference="{output}" dependencies="{dependencies}"/>'
        for tag in ("Output", "InitialUnknown")
    ]
    return "\n".join([*lines, "  </ModelStructure>", "</fmiModelDescription>", ""])


def _unit(unit: str) -> str:
    if unit not in _UNITS:
        return f"    <Unit name={quoteattr(unit)}/>"
    exponents, factor = _UNITS[unit]
    base = " ".join(f'{n}="{e}"' for n, _, e in (p.partition("=") for p in exponents.split(", ")))
    scale = "" if factor == 1.0 else f' factor="{factor!r}"'
    return f"    <Unit name={quoteattr(unit)}><BaseUnit {base}{scale}/></Unit>"


def _with_unit(unit: str) -> str:
    return f" unit={quoteattr(unit)}" if unit else ""


def _build(name: str) -> str:
    """`buildDescription.xml`, with which importers on other platforms compile the FMU."""
    return f"""<?xml version="1.0" encoding="UTF-8"?>
<fmiBuildDescription fmiVersion="3.0">
  <BuildConfiguration modelIdentifier="{name}">
    <SourceFileSet language="C99">
      <SourceFile name="{name}.c"/>
      <SourceFile name="fmi3.c"/>
    </SourceFileSet>
  </BuildConfiguration>
</fmiBuildDescription>
"""


def _platform() -> str:
    """Architecture and system, as FMI 3.0 spells them."""
    machine = {"amd64": "x86_64", "arm64": "aarch64"}.get(platform.machine().lower())
    return f"{machine or platform.machine()}-linux"


def _compiled(name: str, sources: dict[str, str]) -> bytes:
    compiler = next((c for c in map(shutil.which, ("cc", "gcc", "clang")) if c), None)
    if compiler is None or not sys.platform.startswith("linux"):
        raise SettingError(
            name="to", expected="Linux and a C compiler to build an FMU", received="none",
            remedy="install gcc or clang, or deploy to c99",
        )  # fmt: skip
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        for file, text in sources.items():
            (folder / file).write_text(text, encoding="utf-8")
        made = folder / f"{name}.so"
        flags = ["-std=c99", "-O2", "-ffp-contract=off", "-fPIC", "-fvisibility=hidden", "-shared"]
        files = [str(folder / file) for file in sources if file.endswith(".c")]
        done = subprocess.run(
            [compiler, *flags, *files, "-o", str(made)], capture_output=True, text=True
        )
        if done.returncode:
            errors = done.stderr.strip().splitlines() or ["an error without a message"]
            raise SettingError(
                name="to", expected=f"{compiler} to compile the FMU", received=errors[0][:300]
            )
        return made.read_bytes()


def _zipped(entries: dict[str, bytes]) -> bytes:
    place = io.BytesIO()
    with zipfile.ZipFile(place, "w", zipfile.ZIP_DEFLATED) as archive:
        for path, content in sorted(entries.items()):
            # date of all files within, so that the same model gives the same bytes
            entry = zipfile.ZipInfo(path, (1980, 1, 1, 0, 0, 0))
            entry.external_attr = 0o644 << 16
            entry.compress_type = zipfile.ZIP_DEFLATED
            archive.writestr(entry, content)
    return place.getvalue()
