"""A recording -> CSV, Parquet, `.mat` or `.npz`."""

from __future__ import annotations

import os

from ..writers import write_table
from .reader import RecordedFile, read_recording


def export(path: str | os.PathLike[str], out: str | os.PathLike[str]) -> RecordedFile:
    """Write a recording's columns with `t` in the format that the extension of `out` says.

    Gaps stay NaN rows. Events, settings and the device's identity stay in the recording.

    Parameters
    ----------
    path : path
        The recording.
    out : path
        `.csv`, `.parquet`, `.mat` or `.npz`.

    Returns
    -------
    RecordedFile
        What was read.

    Raises
    ------
    DataError
        Where the recording cannot be read or the other file not be written.
    SettingError
        Where the extension is unknown or its package is not installed.
    """
    recording = read_recording(path)
    write_table(out, recording.table_columns(), units=recording.units)
    return recording
