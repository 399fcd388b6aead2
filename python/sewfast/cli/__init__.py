"""The command line: `main`, its exit codes and its treatment of exceptions."""

from __future__ import annotations

import argparse
import errno
import io
import os
import sys
import time
import traceback
from collections.abc import Iterator, Sequence
from pathlib import Path

from ..errors import SettingError, SewfastError, printable
from ..written import forget
from . import interrupts, project
from .drive import is_port
from .output import DONE, FAULT, INTERRUPTED, REFUSED, logging_to_stderr
from .parser import build_parser

_UNUSABLE = (errno.EACCES, errno.ELOOP, errno.ENAMETOOLONG, errno.ENOTDIR, errno.EPERM, errno.EROFS)
"""What is wrong with a name or a place, wherever it is used first, and not with sewfast."""


def main(argv: Sequence[str] | None = None, began: float | None = None) -> int:
    """Run one command.
    `argv` are the arguments after the program's name; None takes the process's own. A time budget
    counts from `began` (`time.monotonic`), by default from now on. Return 0 if it is done, 1 for a
    fault in sewfast, 2 if it is refused, 130 if it is interrupted.
    """
    forget()
    began = time.monotonic() if began is None else began
    try:
        args, found = _parsed(argv)
    except KeyboardInterrupt:
        return _say(f"sewfast: {interrupts.told()}", INTERRUPTED)
    except SewfastError as e:
        return _say(f"sewfast: {e}", REFUSED)
    with logging_to_stderr(quiet=args.quiet, verbose=args.verbose):
        found.fill(args)
        args.began = began
        return _carried_out(args)


def _carried_out(args: argparse.Namespace) -> int:
    """One command: its exit code, or that of the exception that ended it."""
    if isinstance(sys.stdout, io.TextIOWrapper) and sys.stdout.errors == "strict":
        # a file's name can hold bytes that are no text; they are printed as they are
        sys.stdout.reconfigure(errors="surrogateescape")
    try:
        if args.out_of is not None and args.out is None:
            args.out = args.out_of(args)
        require_apart(args)
        code: int | None = args.command(args)
        if sys.stdout is not None:  # None if it was closed before the start
            sys.stdout.flush()
        return code or DONE
    except SewfastError as e:
        if interrupts.is_pressed():  # as of a library that could not be imported to its end
            return _fault(args, e)
        return _say(f"sewfast {args.name}: {e}", REFUSED)
    except KeyboardInterrupt:
        return _say(f"sewfast {args.name}: {interrupts.told()}", INTERRUPTED)
    except BrokenPipeError:
        # the reader closed the pipe; the interpreter must not flush into it again
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return DONE
    except OSError as e:
        if e.errno in _UNUSABLE and e.filename is not None:
            refused = SettingError(
                name=f"{e.filename}", expected="a file or a folder that can be used",
                received=e.strerror, remedy="choose another one",
            )  # fmt: skip
            return _say(f"sewfast {args.name}: {refused}", REFUSED)
        if e.errno not in (errno.ENOSPC, errno.EDQUOT):
            return _fault(args, e)
        # the buffered rest must not raise again when the interpreter flushes it
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return _say(
            f"sewfast {args.name}: expected room for the output, received "
            f"{e.strerror!r}; free some space or write elsewhere",
            REFUSED,
        )
    except Exception as e:
        return _fault(args, e)


def _parsed(argv: Sequence[str] | None) -> tuple[argparse.Namespace, project.Project]:
    """The parsed command line, and the project with defaults for it."""
    parser = build_parser(sys.argv[1:] if argv is None else argv)
    try:
        found = project.find()
    except SewfastError:
        # show help even with a faulty file; every command then reports the fault
        parser.parse_args(argv)
        raise
    found.relax(parser)
    return parser.parse_args(argv), found


def _fault(args: argparse.Namespace, e: Exception) -> int:
    if interrupts.is_pressed():  # an import or a library can turn an interrupt into its own error
        return _say(f"sewfast {args.name}: {interrupts.told()}", INTERRUPTED)
    if args.debug:
        traceback.print_exc()
    return _say(
        f"sewfast {args.name}: a fault in sewfast: {type(e).__name__}: {e}; please report it "
        "with the output of the same command and --debug",
        FAULT,
    )


def _say(message: str, code: int) -> int:
    # names of files, ports and columns in the message must not control the terminal
    print("\n".join(map(printable, message.split("\n"))), file=sys.stderr)
    return code


# --- The files that a command writes differ from those that it reads ------------------------------


_WRITTEN = {
    "out": "-o",
    "samples": "--samples",
    "plot": "--plot",
    "trace": "--trace",
    "fault_log": "--fault-log",
}
"""Attributes that name output files, and their options."""


def require_apart(args: argparse.Namespace) -> None:
    """Refuse to write over a file that the same command reads, or over its own other output."""
    others = [place for place in _read(args) if _is_file(place)]
    for option, path in _written(args):
        for other in others:
            if _is_one(path, other):
                raise SettingError(
                    f"{option} {path}: expected a separate file, got {other}, which this command "
                    "reads or writes as well; choose another name"
                )
        others.append(path)


def _written(args: argparse.Namespace) -> Iterator[tuple[str, Path]]:
    for name, option in _WRITTEN.items():
        path = getattr(args, name, None)
        if isinstance(path, Path):
            yield option, path
    if export := getattr(args, "export", None):
        yield "--export", Path(export[1])
    out = getattr(args, "out", None)
    if isinstance(out, Path) and out.suffix not in ("", ".mcap") and _is_recorded(args):
        # the recording of a drive goes into the same folder as the table
        yield "-o", out.with_suffix(".mcap")


def _is_recorded(args: argparse.Namespace) -> bool:
    on, host_loop = getattr(args, "on", None), getattr(args, "host_loop", None)
    return isinstance(on, str) and is_port(on) and host_loop is None


def _read(args: argparse.Namespace) -> Iterator[Path]:
    for name, value in vars(args).items():
        if name in (*_WRITTEN, "export"):
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
