"""Recordings as MCAP files: written while the drive runs, readable after whatever happened.

Read in this order: `format` (the bytes), `writer` (by whole chunks), `filing` (where and over what
it may write), `reader` (which salvages what is damaged).
"""

from .header import Header
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
