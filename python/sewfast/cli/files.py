"""`sewfast show`, `sewfast export`: what is in a recording, and its columns in another format."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING, Any

from .arguments import (
    RECORDINGS,
    Commands,
    add_command,
    add_output,
    add_overwrite,
    require_place,
)
from .output import print_json

if TYPE_CHECKING:
    from ..recordfile import RecordedFile

SHOW = """\
Say what is in a recording (.mcap): how much of it is there, gaps, events, damage, the device and
its settings. A recording whose recorder was killed reads up to that moment ("torn").
"""

EXPORT = """\
Write the columns of a recording (.mcap) with their time t to a file that other programs read.
Rows in gaps are not a number. Events, settings and the device's identity go into .mcap only, which
has one message a sample, so that PlotJuggler and Foxglove draw curves.
"""


def add(commands: Commands) -> None:
    parser = add_command(
        commands, "show", show_command,
        summary="what is in a recording", text=SHOW, examples="example:\n  sewfast show run.mcap",
    )  # fmt: skip
    parser.add_argument("recording", metavar="RECORDING.mcap", help="recording")
    parser = add_command(
        commands, "export", export_command,
        summary="a recording in another format", text=EXPORT,
        examples="examples:\n  sewfast export run.mcap -o run.csv\n"
        "  sewfast export run.mcap -o run.mat",
    )  # fmt: skip
    parser.add_argument("recording", metavar="RECORDING.mcap", help="recording")
    add_output(parser, "OUT", "CSV, .npz, .mat, Parquet or .mcap", required=True)
    add_overwrite(parser)


def show_command(args: argparse.Namespace) -> None:
    from ..recordfile import read_recording

    found = read_recording(args.recording)
    if args.json:
        print_json(_content(found))
    else:
        print(found)


def export_command(args: argparse.Namespace) -> None:
    from ..recordfile import export

    require_place(args.out, RECORDINGS)
    found = export(args.recording, args.out, overwrite=args.overwrite)
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
