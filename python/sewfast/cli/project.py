"""`sewfast init`, and the project file `sewfast.toml` with defaults for the commands.

The file is searched in the working folder and in those above it. Options on the command line take
precedence, and so do the columns stored in a model.
"""

from __future__ import annotations

import argparse
import difflib
import importlib
import math
import os
import sys
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..errors import SettingError, not_installed, printable, unwritable
from .arguments import Commands, add_command
from .drive import LIMITS, is_port
from .output import note, print_json

if TYPE_CHECKING:
    from ..readers import Table

NAME = "sewfast.toml"
_RANGE = ("u_min", "u_max")
_KEYS: dict[str, tuple[str, ...]] = {
    "columns": ("input", "output", "time", "counts", "counts_per_rev", "ts", "weights"),
    "limits": (*LIMITS, *_RANGE),
}
_TOP = ("port", "columns", "units", "limits")


@dataclass(frozen=True)
class Project:
    """The content of a project file; a field without a setting is empty.
    `columns` has the keys `input` (a list), `output`, `time`, `counts`, `counts_per_rev`, `ts`,
    `weights`; `units` are those of columns whose file states none. `limits` are enforced by the
    drive: volt, speed, acceleration, current; all four or none. `command` holds `u_min` and
    `u_max`, the range of a controller's command.
    """

    path: Path | None = None
    port: str | None = None
    columns: Mapping[str, Any] = field(default_factory=dict)
    units: Mapping[str, str] = field(default_factory=dict)
    limits: Mapping[str, float] = field(default_factory=dict)
    command: Mapping[str, float] = field(default_factory=dict)

    def relax(self, parser: argparse.ArgumentParser) -> None:
        """Make the port optional in all commands if the file names one."""
        if self.port is None:
            return
        for action in parser._actions:
            if isinstance(action, argparse._SubParsersAction):
                for command in action.choices.values():
                    self.relax(command)
            elif action.dest == "on":
                action.required = False
            elif action.dest == "port" and not action.option_strings:
                action.required, action.nargs = False, "?"

    def fill(self, args: argparse.Namespace) -> None:
        """Fill in the settings of the file that the command line leaves out, with a note."""
        args.units = dict(self.units)
        taken: dict[str, Any] = {}
        if args.name in ("record", "commission", "run") and getattr(args, "plant", None) is None:
            self._take(args, taken, "on", self.port)
        if args.name in ("doctor", "stop", "clear"):
            self._take(args, taken, "port", self.port)
        if getattr(args, "columns_of", None) == "file":
            self._fill_columns(args, taken)
        elif hasattr(args, "time"):
            # a model stores its columns, but not that of the time
            self._take(args, taken, "time", self.columns.get("time"))
        port = getattr(args, "on", None) or getattr(args, "port", None)
        if self.limits and isinstance(port, str) and is_port(port):
            text = ",".join(f"{name}={value:g}" for name, value in self.limits.items())
            self._take(args, taken, "limits", text)
        if getattr(args, "start", None) is None and getattr(args, "limits_of", None) is None:
            for name, value in self.command.items():
                self._take(args, taken, name, value)
        if taken:
            shown = printable(", ".join(f"{name} = {value}" for name, value in taken.items()))
            note(f"from {self.path}: {shown}")

    def _fill_columns(self, args: argparse.Namespace, taken: dict[str, Any]) -> None:
        names = dict(self.columns)
        if args.counts is not None or args.output is not None:
            # an output on the command line replaces any in the file
            for name in ("output", "counts", "counts_per_rev"):
                names.pop(name, None)
        for name, value in names.items():
            self._take(args, taken, name, value)

    def _take(self, args: argparse.Namespace, taken: dict[str, Any], name: str, value: Any) -> None:
        if value is not None and getattr(args, name, 0) is None:
            setattr(args, name, value)
            taken[name] = "+".join(value) if isinstance(value, list) else value


def find(folder: Path | None = None) -> Project:
    """The project that a folder belongs to: its own file's, or that of the next folder above."""
    try:
        folder = Path.cwd() if folder is None else folder
        places = (place / NAME for place in (folder, *folder.parents))
        found = next((p for p in places if p.is_file()), None)
        if found is None:
            return Project()
        if not _is_trusted(found):
            print(f"{found} belongs to another user and is left out; copy it", file=sys.stderr)
            return Project()
    except OSError:
        # a folder that was deleted, or one above that this user cannot read
        return Project()
    return load(found)


def _is_trusted(path: Path) -> bool:
    """Whether a file is the user's or the system's: nobody else may set the limits of a drive."""
    if not hasattr(os, "getuid"):
        return True
    return path.stat().st_uid in (os.getuid(), 0)


def load(path: Path) -> Project:
    """The project that a file describes."""
    found = _parsed(path)
    _require_known(path, "", found, _TOP)
    tables = {name: _table(path, found, name) for name in ("columns", "units", "limits")}
    for name, known in _KEYS.items():
        _require_known(path, f"[{name}] ", tables[name], known)
    numbers = {
        name: _number(path, f"[limits] {name}", value) for name, value in tables["limits"].items()
    }
    for name, value in numbers.items():
        if name in LIMITS and value <= 0.0:
            raise SettingError(
                f"{path}: [limits] {name}: expected a positive number, received {value:g}"
            )
    low, high = (numbers.get(name) for name in _RANGE)
    if low is not None and high is not None and low >= high:
        raise SettingError(
            f"{path}: [limits]: expected u_min below u_max, received u_min = {low:g} and "
            f"u_max = {high:g}; exchange or correct them"
        )
    limits = {name: numbers[name] for name in LIMITS if name in numbers}
    if limits and len(limits) < len(LIMITS):
        missing = ", ".join(name for name in LIMITS if name not in limits)
        raise SettingError(
            f"{path}: [limits]: expected volt, speed, acceleration and current together, {missing} "
            "missing; inf means that there is no limit"
        )
    port = found.get("port")
    return Project(
        path,
        None if port is None else _text(path, "port", port),
        {name: _column(path, name, value) for name, value in tables["columns"].items()},
        {name: _text(path, f"[units] {name}", value) for name, value in tables["units"].items()},
        limits,
        {name: numbers[name] for name in _RANGE if name in numbers},
    )


def _parsed(path: Path) -> dict[str, Any]:
    toml: Any
    try:
        toml = importlib.import_module("tomllib" if sys.version_info >= (3, 11) else "tomli")
    except ModuleNotFoundError:
        raise not_installed("tomli", f"{path} on Python 3.10") from None
    from ..storage import file_bytes  # loads NumPy

    raw = file_bytes(path, SettingError, largest=1 << 20)
    try:
        found: dict[str, Any] = toml.loads(raw.decode("utf-8-sig"))
    except (UnicodeDecodeError, ValueError, RecursionError) as e:
        raise SettingError(f"{path}: expected TOML, received something else: {e}") from e
    return found


def _require_known(
    path: Path, where: str, given: Mapping[str, Any], known: tuple[str, ...]
) -> None:
    for name in given:
        if name not in known:
            near = difflib.get_close_matches(name.lower(), known, n=1, cutoff=0.6)
            guess = f"did you mean {near[0]!r}? " if near else ""
            raise SettingError(
                f"{path}: {where}{name!r} is not a setting; {guess}expected {', '.join(known)}"
            )


def _table(path: Path, found: Mapping[str, Any], name: str) -> dict[str, Any]:
    value = found.get(name, {})
    if not isinstance(value, dict):
        raise SettingError(f"{path}: {name}: expected a table, [{name}], received {value!r}")
    return value


def _column(path: Path, name: str, value: Any) -> Any:
    where = f"[columns] {name}"
    if name == "input":
        names = value if isinstance(value, list) else [value]
        if not names:
            raise SettingError(f"{path}: {where}: expected at least one name, received none")
        return [_text(path, where, one) for one in names]
    if name in ("counts_per_rev", "ts"):
        number = _number(path, where, value)
        if not 0.0 < number < math.inf:
            raise SettingError(f"{path}: {where}: expected a positive number, received {number:g}")
        return number
    return _text(path, where, value)


def _text(path: Path, where: str, value: Any) -> str:
    if not isinstance(value, str) or not value:
        raise SettingError(f'{path}: {where}: expected a text, as in "speed", received {value!r}')
    return value


def _number(path: Path, where: str, value: Any) -> float:
    if isinstance(value, bool) or not isinstance(value, (int, float)) or value != value:
        raise SettingError(f"{path}: {where}: expected a number, received {value!r}")
    try:
        return float(value)
    except OverflowError:  # TOML's whole numbers have any length
        raise SettingError(
            f"{path}: {where}: expected a number below 1e308, received {len(str(value))} digits"
        ) from None


def with_units(table: Table, args: argparse.Namespace) -> Table:
    """A table with the project's units where its file states none; another is refused."""
    units: dict[str, str] = getattr(args, "units", {})
    known = {name: unit for name, unit in units.items() if name in table}
    if not known:
        return table
    from dataclasses import replace

    from ..units import spelled

    for name, unit in known.items():
        stated = table.units.get(name, "")
        if stated and spelled(stated) != spelled(unit):
            raise SettingError(
                name=f"{table.path}: column {name!r}", expected=f"the unit of {NAME}, {unit}",
                received=f"{stated}", remedy="correct one of them",
            )  # fmt: skip
    return replace(table, units={**table.units, **known})


# --- `sewfast init` -------------------------------------------------------------------------------


INIT = """\
Set up a folder for one drive: sewfast.toml with limits, columns, units and port, a folder for
recordings and a README with the commands in their order. Existing files stay unchanged.

Every command reads sewfast.toml from the working folder or from one above it. Options on the
command line take precedence. On Python 3.10 reading it needs tomli (pip install tomli).
"""

EXAMPLES = """\
examples:
  sewfast init spindle
  sewfast init --recording bench.csv        columns and units as in this file, in this folder
"""

_TOML = """\
# Settings of this drive, for every sewfast command that runs in this folder or below it.
# Remove the # before a setting to use it. Options on the command line take precedence.

# port = "/dev/ttyUSB0"       # or "COM3", or "socket://localhost:5000"

[columns]
{columns}
[units]                       # for columns whose file states none
{units}
[limits]
# Limits enforced by the drive, which stops beyond them. All four or none; inf: no limit.
# volt = 10.0                 # V
# speed = 3500.0              # RPM
# acceleration = 30000.0      # RPM/s
# current = 15.0              # A

# Range of a controller's command; by default the recorded range.
# u_min = -10.0
# u_max = 10.0
"""

_COLUMNS = """\
# input = "u"                 # or a list: ["u", "load"]
# output = "speed"
# counts = "encoder"          # encoder counts instead of an output, and
# counts_per_rev = 4096       # counts of one turn
# time = "clock"              # if its name does not show that it is the time
# ts = 0.001                  # s, for a file without a time column
"""

_UNITS = """\
# u = "V"
# speed = "RPM"
"""

_README = """\
# {name}

Recordings are in `recordings/`; settings common to all of them are in `sewfast.toml`.

    sewfast look recordings/one.csv                       # its properties, with advice
    sewfast identify recordings/one.csv -o drive.json     # a model
    sewfast validate drive.json recordings/two.csv        # on a recording it has never seen
    sewfast tune drive.json -o controller.json            # a controller, on the model alone
    sewfast run controller.json drive.json -o loop.csv    # the closed loop on the model

`sewfast COMMAND --help` explains each of them.
"""


OPTIONS = """\
folder DIR  path?=.  folder (this one)
--recording FILE  text  take names and units of the columns from this file
"""


def add(commands: Commands) -> None:
    add_command(
        commands, "init", init_command,
        summary="a folder for a drive, with its settings",
        text=INIT, options=OPTIONS, examples=EXAMPLES,
    )  # fmt: skip


def init_command(args: argparse.Namespace) -> None:
    folder: Path = args.folder
    columns, units = (_COLUMNS, _UNITS) if args.recording is None else _described(args.recording)
    if folder.exists() and not folder.is_dir():
        raise SettingError(f"{folder}: expected a folder, received a file; name another one")
    place = folder / NAME
    if place.exists():
        raise SettingError(
            name=str(place), expected="a new file", received="one that exists",
            remedy="change it, or take it away first",
        )  # fmt: skip
    # realpath, as a link to itself is refused below
    name = printable(os.path.basename(os.path.realpath(folder)))
    texts = {
        place: _TOML.format(columns=columns, units=units),
        folder / "README.md": _README.format(name=name),
    }
    from ..storage import making, replace_files  # loads NumPy

    try:
        with making(folder / "recordings"):
            made = [path for path in texts if not path.exists()]
            replace_files({path: texts[path].encode() for path in made})
    except OSError as e:
        raise unwritable(SettingError, folder, e) from e
    load(place)  # check that it can be read
    if args.json:
        print_json({"folder": str(folder), "files": [str(path) for path in made]})
        return
    for path in made:
        print(f"written to {path}")
    print(f"put recordings into {folder / 'recordings'}; then: sewfast look FILE")


def _described(recording: str) -> tuple[str, str]:
    """The lines on columns and units of a recording."""
    from ..readers import read_table, roles

    table = read_table(recording)
    found = roles(table)
    if found is None:
        raise SettingError(
            f"{recording}: expected columns that show which is the input and which the output, "
            f"received {', '.join(table.names)}; leave --recording out and name them in {NAME}"
        )
    role = "output" if found.counts is None else "counts"
    names = {"input": found.input, role: found.output or found.counts or ""}
    units = {n: table.unit(n) for n in names.values() if table.unit(n)}
    columns = "".join(f"{role} = {_quoted(n)}\n" for role, n in names.items())
    return columns, "".join(f"{_quoted(n)} = {_quoted(u)}\n" for n, u in units.items()) or _UNITS


def _quoted(text: str) -> str:
    """A TOML string; a name from a file can contain any character."""
    import json

    return json.dumps(text)
