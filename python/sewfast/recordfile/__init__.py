"""Recordings as MCAP files: written while the drive runs, readable after whatever happened."""

from .export import export
from .header import Header
from .reader import RecordedFile, read_recording
from .writer import RecordWriter, save_columns

__all__ = [
    "Header",
    "RecordWriter",
    "RecordedFile",
    "export",
    "read_recording",
    "save_columns",
]
