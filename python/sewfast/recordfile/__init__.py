"""Recordings as MCAP files: written while the drive runs, readable after whatever happened."""

from .format import Header
from .reader import RecordedFile, read_recording
from .writer import RecordWriter, export, save_columns

__all__ = [
    "Header",
    "RecordWriter",
    "RecordedFile",
    "export",
    "read_recording",
    "save_columns",
]
