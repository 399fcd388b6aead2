"""A recording -> CSV, Parquet, `.mat`, `.npz`, or MCAP with one message a sample."""

from __future__ import annotations

import os
from pathlib import Path

from ..errors import DataError, SettingError
from ..writers import write_table
from .curves import save_curves
from .keeping import require_replaceable
from .reader import RecordedFile, read_recording


def _is_earlier(out: Path, recording: RecordedFile) -> bool:
    """Whether a file is an earlier export of this recording, and holds no more than it."""
    if out.suffix.lower() != ".mcap" or not out.is_file():
        return False
    try:
        found = read_recording(out)
    except DataError:
        return False
    return found.header == recording.header and found.received <= recording.received


def export(
    path: str | os.PathLike[str], out: str | os.PathLike[str], *, overwrite: bool = False
) -> RecordedFile:
    """Write a recording's columns with `t` in the format that the extension of `out` says.

    Gaps are rows of NaN. Events, settings and the device's identity go into `.mcap` only.

    Parameters
    ----------
    path : path
        The recording.
    out : path
        `.csv`, `.parquet`, `.mat`, `.npz`, or `.mcap`: one message a sample, for programs that
        plot; also the repair of a file that lacks its end. A file that exists is replaced in one
        step, save a recording of a drive.
    overwrite : bool
        Whether that may be replaced as well.

    Returns
    -------
    RecordedFile
        What was read.

    Raises
    ------
    DataError
        Where the recording cannot be read or the other file not be written.
    SettingError
        Where the extension is unknown or its package is not installed, `out` is the recording
        itself, or another one that cannot be had again.
    """
    recording = read_recording(path)
    if Path(out).exists() and Path(out).samefile(path):
        raise SettingError(
            f"{out}: expected another file than the recording, which cannot be had again, got the "
            "same; choose another name"
        )
    require_replaceable(out, overwrite=overwrite or _is_earlier(Path(out), recording))
    if Path(out).suffix.lower() == ".mcap":
        save_curves(out, recording)
    else:
        write_table(out, recording.table_columns(), units=recording.units)
    return recording
