"""Files that appear whole or not at all."""

from __future__ import annotations

import errno
import os
import secrets
from pathlib import Path


def replace_file(path: str | os.PathLike[str], content: bytes) -> None:
    """Put `content` in place of a file: a temporary name beside it, renamed once it is whole.

    Raises
    ------
    OSError
        Where the folder does not exist or cannot be written to, or what is there is no file but a
        device or a pipe, which must not be replaced; nothing is left behind.
    """
    if "\0" in os.fspath(path):
        raise OSError(errno.EINVAL, "a name cannot hold the character 0")
    target = Path(path).resolve()
    if target.exists() and not (target.is_file() or target.is_dir()):
        raise OSError(errno.EINVAL, "what has that name is no file")
    temporary = target.with_name(f".{target.name}.{secrets.token_hex(4)}.tmp")
    try:
        with temporary.open("xb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        temporary.replace(target)
    finally:
        temporary.unlink(missing_ok=True)
