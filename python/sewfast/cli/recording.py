"""`sewfast record`, `signals`, `show`, `export`: recordings and their files."""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..errors import SettingError
from .arguments import (
    RECORDINGS,
    Commands,
    add_command,
    add_output,
    add_overwrite,
    require_place,
)
from .drive import (
    add_drive,
    is_port,
    machine_of,
    opened,
    recording_place,
    require_no_drive_options,
)
from .output import print_json, print_rows, write_columns

if TYPE_CHECKING:
    from ..dataset import FloatArray
    from ..recordfile import RecordedFile
    from ..recording import Recording

RECORD = """\
Excite a machine with a signal and record its encoder.

A signal is a named one (`sewfast signals`), made for the sewing machine, or a file with columns
t [s], u [V] at the machine's sample time. --scale 0.2 makes any of them gentle.

Columns: t [s], u [V], counts, y [RPM] (the speed estimated from the counts) and, for a virtual
machine, speed_true [RPM], which no experiment could measure, for scores.
virtual:SEED is another machine of the same type.

On a drive the recording is written as MCAP while it runs, so no sample that arrived is lost; a file
with another ending is made from it afterwards. Ctrl-C stops the motor and keeps the file.
"""

RECORD_EXAMPLES = """\
examples:
  sewfast record --on virtual --signal chirp_lo_hi -o chirp.csv
  sewfast record --on virtual:7 --signal random --seed 3 -o random.parquet
  sewfast record --on virtual --signal step -o step.mcap
  sewfast record --on /dev/ttyUSB0 --signal step -o step.mcap \\
      --limits volt=10,speed=3500,acceleration=30000,current=15
"""

SIGNALS = """\
List the named signals: excitations [V] for `record --signal`, references [RPM] for
`run --reference` and `tune --reference`.
"""


OPTIONS = """\
--on virtual[:SEED]|FILE.fmu?volt=V|PORT  text!  virtual machine, FMU of another tool, or drive
--signal FILE|NAME  text!  an excitation; see `sewfast signals`
--scale X  float=1.0  factor on the signal (1)
--seed N  int=0  seed of a random signal (0)
"""


def add(commands: Commands) -> None:
    parser = add_command(
        commands, "record", record_command,
        summary="a recording of a drive or of the virtual machine", text=RECORD, options=OPTIONS,
        examples=RECORD_EXAMPLES,
    )  # fmt: skip
    add_output(parser, "OUT", "CSV, .npz, .mat, Parquet or .mcap; default: CSV to standard output")
    add_overwrite(parser)
    add_drive(parser)
    add_command(
        commands, "signals", signals_command,
        summary="the named signals", text=SIGNALS, examples="example:\n  sewfast signals",
    )  # fmt: skip


def record_command(args: argparse.Namespace) -> None:
    require_place(args.out, RECORDINGS)
    u, Ts = _excitation(args)
    if not is_port(args.on):
        require_no_drive_options(args)
        _record_virtual(args, u, Ts)
        return
    place = recording_place(args.out, overwrite=args.overwrite)
    with opened(args) as drive:
        from ..control.record import record

        _require_period(args, Ts, drive.identity.Ts)
        made = record(
            drive, u, name=_name(args), file=place, live=args.live,
            settings=_settings(args), overwrite=args.overwrite,
        )  # fmt: skip
        name = drive.identity.name
    _write(args, made, name, place)


def _name(args: argparse.Namespace) -> str:
    return Path(args.signal).stem


def _settings(args: argparse.Namespace) -> dict[str, Any]:
    """The settings needed to repeat the recording."""
    return {"signal": args.signal, "seed": args.seed, "scale": args.scale}


def _excitation(args: argparse.Namespace) -> tuple[FloatArray, float]:
    """The samples of the signal [V] and their sample time [s]."""
    from ..readers import read_columns
    from ..signals import EXCITATIONS, TS, excitation

    if not math.isfinite(args.scale):
        raise SettingError(f"--scale: expected a number, got {args.scale}; 1 leaves it as it is")
    named = args.signal.replace("-", "_").lower() in EXCITATIONS
    if named or not Path(args.signal).exists():
        return args.scale * excitation(args.signal, args.seed), TS
    data = read_columns(args.signal, inputs="u")
    data.require_inputs()
    return args.scale * data.experiments[0].u[:, 0], data.Ts


def _require_period(args: argparse.Namespace, given: float, machine: float) -> None:
    """Raise `SettingError` for a signal with another sample time than the machine's."""
    if abs(given - machine) > 0.01 * machine:
        raise SettingError(
            f"--signal {args.signal}: expected samples every {machine:g} s, the machine's, got one "
            f"every {given:g} s; resample it into a file with columns t, u"
        )


def _record_virtual(args: argparse.Namespace, u: FloatArray, Ts: float) -> None:
    from ..control.record import record
    from ..recordfile.writer import require_replaceable

    if args.out is not None:
        require_replaceable(args.out, overwrite=args.overwrite)
    machine = machine_of(args.on)
    _require_period(args, Ts, machine.Ts)
    _write(args, record(machine, u, name=_name(args)), machine.name, None)


def _write(args: argparse.Namespace, made: Recording, machine: str, place: Path | None) -> None:
    """Write the columns, unless `place` already has those of a drive, and print a summary."""
    from ..recording import UNITS

    summary, line = _summary(made, machine)
    summary |= _settings(args)
    write_columns(
        args.out, made.columns(), UNITS, summary, [line], as_json=args.json,
        header=made.header(**_settings(args)), written=place,
    )  # fmt: skip


def _summary(made: Recording, machine: str) -> tuple[dict[str, Any], str]:
    """A summary of a recording as values and as a line."""
    import numpy as np

    speed = made.y if made.speed_true is None else made.speed_true
    known = speed[np.isfinite(speed)]
    low, high = (float(known.min()), float(known.max())) if len(known) else (0.0, 0.0)
    missing = int(np.count_nonzero(np.isnan(made.u)))
    summary: dict[str, Any] = {
        "machine": machine,
        "n": len(made),
        "missing": missing,
        "Ts": made.Ts,
        "counts_per_rev": made.counts_per_rev,
        "speed_min_rpm": low,
        "speed_max_rpm": high,
    }
    line = (
        f"{machine}, {made.name}: {len(made)} samples of {made.Ts * 1e3:g} ms, "
        f"{low:.0f} to {high:.0f} RPM"
    )
    if missing:
        line += f"; {missing} samples were lost on the way (NaN)"
    if made.speed_true is not None:
        error = made.y - made.speed_true
        known = error[np.isfinite(error)]
        rmse = float(np.sqrt(np.mean(known**2))) if len(known) else None
        summary["speed_estimate_rmse_rpm"] = rmse
        if rmse is not None:
            line += f"; y is within {rmse:.2g} RPM rms of the true speed"
    return summary, line


def signals_command(args: argparse.Namespace) -> None:
    from ..signals import EXCITATIONS, REFERENCES

    groups = {"excitation": EXCITATIONS, "reference": REFERENCES}
    rows = [(group, s) for group, table in groups.items() for s in table.values()]
    if args.json:
        print_json(
            [
                {
                    "name": s.name,
                    "kind": group,
                    "unit": s.unit,
                    "duration_s": s.duration_s,
                    "description": s.description,
                }
                for group, s in rows
            ]
        )
        return
    head = ("name", "kind", "unit", "seconds", "description")
    print_rows([head, *((s.name, g, s.unit, f"{s.duration_s:g}", s.description) for g, s in rows)])


# --- `sewfast show`, `sewfast export`: the content of a recording, and another format -------------


SHOW = """\
Show the content of a recording (.mcap): its length, gaps, events, damage, the device and its
settings. A recording whose recorder was killed is readable up to that moment ("torn"). Models,
controllers, tables, motors and frequency responses (.json) are shown as Python prints them.
"""

EXPORT = """\
Write the columns of a recording (.mcap) with their time t to a file for other programs. Rows in
gaps are NaN. Events, settings and the device's identity go only into .mcap, with one message a
sample, so that PlotJuggler and Foxglove draw curves.
"""


def add_files(commands: Commands) -> None:
    parser = add_command(
        commands, "show", show_command,
        summary="content of a recording, model or controller", text=SHOW,
        examples="examples:\n  sewfast show run.mcap\n  sewfast show drive.json",
    )  # fmt: skip
    parser.add_argument("recording", metavar="FILE", help="recording (.mcap) or .json file")
    parser = add_command(
        commands, "export", export_command,
        summary="a recording in another format", text=EXPORT,
        examples="examples:\n  sewfast export run.mcap -o run.csv\n"
        "  sewfast export run.mcap -o run.mat",
    )  # fmt: skip
    parser.add_argument("recording", metavar="RECORDING.mcap", help="recording")
    add_output(parser, "OUT", "CSV, .npz, .mat, Parquet or .mcap", required=True)
    parser.add_argument(
        "--compress", action="store_true", help="compress .mcap by zstd (sewfast[zstd])"
    )
    add_overwrite(parser)


def show_command(args: argparse.Namespace) -> None:
    from .. import storage
    from ..recordfile import read_recording

    is_json = Path(args.recording).suffix.lower() == ".json"
    read = _reader(storage.format_of(args.recording)) if is_json else None
    if read is not None:
        shown = read(args.recording)
        if args.json:
            print_json(shown.to_dict())
        else:
            print(shown)
        return
    found = read_recording(args.recording)
    if args.json:
        print_json(_content(found))
    else:
        print(found)


def _reader(stored: str) -> Callable[[str], Any] | None:
    """What reads a .json file of a format; None for one that is not shown."""
    from ..control.files import load_controller, load_table
    from ..frequency import load_response, load_responses
    from ..greybox import load_motor
    from ..models import load_model

    known: dict[str, Callable[[str], Any]] = {
        "sewfast.model": load_model,
        "sewfast.controller": load_controller,
        "sewfast.table": load_table,
        "sewfast-motor": load_motor,
        "sewfast-frequency-response": load_response,
        "sewfast-frequency-responses": load_responses,
    }
    return known.get(stored)


def export_command(args: argparse.Namespace) -> None:
    from ..recordfile import export

    require_place(args.out, RECORDINGS)
    found = export(args.recording, args.out, overwrite=args.overwrite, compress=args.compress)
    if args.json:
        print_json({**_content(found), "file": str(args.out)})
    else:
        print(f"{found.path}: {found.summary}\nwritten to {args.out}")


def _content(found: RecordedFile) -> dict[str, Any]:
    header = found.header
    return {
        "name": header.name,
        "started": header.started,
        "Ts": header.Ts,
        "columns": dict(header.columns),
        "counts_per_rev": header.counts_per_rev,
        "outcome": found.outcome,
        "complete": found.complete,
        "received": found.received,
        "expected": header.n,
        "gaps": [list(gap) for gap in found.gaps],
        "events": [dict(event) for event in found.events],
        "damage": list(found.damage),
        "device": dict(header.device),
        "settings": dict(header.settings),
    }
