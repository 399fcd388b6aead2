"""What a command reads is not what it writes."""

from __future__ import annotations

import argparse
import os
from collections.abc import Iterator
from pathlib import Path

from ..errors import SettingError
from .drive import is_port

_WRITTEN = {
    "out": "-o",
    "samples": "--samples",
    "plot": "--plot",
    "trace": "--trace",
    "fault_log": "--fault-log",
}
"""Attributes that name files to be written, and their options."""


def require_apart(args: argparse.Namespace) -> None:
    """Refuse to write over a file that the same command reads, or over its own other output.

    Raises
    ------
    SettingError
        Where two of its files are one.
    """
    others = [place for place in _read(args) if _is_file(place)]
    for option, path in _written(args):
        for other in others:
            if _is_one(path, other):
                raise SettingError(
                    f"{option} {path}: expected a file of its own, got {other}, which this command "
                    "reads or writes as well; choose another name"
                )
        others.append(path)


def _written(args: argparse.Namespace) -> Iterator[tuple[str, Path]]:
    for name, option in _WRITTEN.items():
        path = getattr(args, name, None)
        if isinstance(path, Path):
            yield option, path
    out = getattr(args, "out", None)
    if isinstance(out, Path) and out.suffix not in ("", ".mcap") and _is_recorded(args):
        # what a drive does is recorded beside the table
        yield "-o", out.with_suffix(".mcap")


def _is_recorded(args: argparse.Namespace) -> bool:
    on, host_loop = getattr(args, "on", None), getattr(args, "host_loop", None)
    return isinstance(on, str) and is_port(on) and host_loop is None


def _read(args: argparse.Namespace) -> Iterator[Path]:
    for name, value in vars(args).items():
        if name in _WRITTEN:
            continue
        for text in value if isinstance(value, (list, tuple)) else (value,):
            if isinstance(text, (str, Path)):
                yield Path(text)
                # FILE:IN:OUT
                yield Path(str(text).split(":")[0])


def _is_file(path: Path) -> bool:
    try:
        return path.is_file()
    except (OSError, ValueError):
        return False


def _is_one(path: Path, other: Path) -> bool:
    if _is_file(path) and _is_file(other):
        return path.samefile(other)
    return os.path.abspath(path) == os.path.abspath(other)
