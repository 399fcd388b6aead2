"""Recordings as MCAP files: written while the drive runs, readable after a crash or damage.

Read in this order: `format` (the bytes), `header`, `writer` (samples and events, exports),
`filing` (the thread that owns the file), `reader` (which salvages damaged files).
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
