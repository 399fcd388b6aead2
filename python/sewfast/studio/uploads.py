"""`Upload`: a recording sent by a page, piece by piece, into the project folder."""

from __future__ import annotations

import errno
import os
import secrets
from contextlib import suppress
from pathlib import Path
from typing import Any, BinaryIO

from ..errors import SettingError, unwritable
from .commissioning import require
from .project import LARGEST, RECORDINGS

LONGEST_NAME = 100
"""Most bytes of a file's name."""


class Upload:
    """A file that arrives in pieces; it appears under its name when it is complete.

    Parameters
    ----------
    folder : Path
    file : str
        A new, plain name without a folder.
    size : int
        Announced number of bytes.

    Raises
    ------
    SettingError
        For a name that is taken or not a recording's, or a size out of range.
    """

    def __init__(self, folder: Path, file: str, size: int) -> None:
        self.file, self.size, self.received = checked_recording_name(file), size, 0
        require(0 < size <= LARGEST, "size", f"1 byte to {LARGEST >> 20} MB", size)
        self._place = folder / file
        self._require_new()
        # hidden and without a recording's ending, so that it is not used before it is complete
        self._part = folder / f".{secrets.token_hex(8)}.part"
        try:
            self._out: BinaryIO = self._part.open("xb")
        except OSError as e:
            raise self._refusal(e) from e

    def _require_new(self) -> None:
        if self._place.exists() or self._place.is_symlink():
            raise SettingError(
                f"{self.file}: expected a new name, there is such a file, which is not replaced; "
                "rename one of them"
            )

    def add(self, piece: bytes) -> int:
        """Write the next piece; return the bytes received so far.

        Raises
        ------
        SettingError
            For more bytes than announced, or if it cannot be written; then the file is deleted.
        """
        self.received += len(piece)
        if self.received > self.size:
            self.abandon()
            raise SettingError(
                f"{self.file}: expected {self.size} bytes, received more; upload it again"
            )
        try:
            self._out.write(piece)
        except OSError as e:
            self.abandon()
            raise self._refusal(e) from e
        return self.received

    def finish(self) -> str:
        """Give the complete file its name, and return the name.

        Raises
        ------
        SettingError
            For fewer bytes than announced, or a name taken meanwhile; then the file is deleted.
        """
        try:
            if self.received != self.size:
                raise SettingError(
                    f"{self.file}: expected {self.size} bytes, received {self.received}; upload it "
                    "again"
                )
            self._out.close()
            try:
                os.link(self._part, self._place)  # unlike a rename, it replaces nothing
            except FileExistsError:
                self._require_new()
            except OSError:  # a file system without hard links
                self._require_new()
                self._part.rename(self._place)
        except OSError as e:
            raise self._refusal(e) from e
        finally:
            self.abandon()
        return self.file

    def abandon(self) -> None:
        """Delete the part received so far."""
        with suppress(OSError):
            self._out.close()
        with suppress(OSError):
            self._part.unlink()

    def _refusal(self, error: OSError) -> SettingError:
        full = error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
        remedy = "make room in the project folder" if full else "change the rights of the folder"
        return unwritable(SettingError, self.file, error, f"{remedy}, then upload it again")


def checked_recording_name(file: Any) -> str:
    """The plain name of an uploaded recording, without a folder.

    Raises
    ------
    SettingError
    """
    fits = (
        isinstance(file, str)
        and file.isprintable()
        and not file.startswith((".", "~"))
        and not set(file) & set('/\\:*?"<>|')
        and Path(file).suffix.lower() in RECORDINGS
        and len(file.encode()) <= LONGEST_NAME
    )
    require(fits, "file", f"a plain name that ends in {', '.join(RECORDINGS)}", file)
    return str(file)
