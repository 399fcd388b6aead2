"""The command line: `main`, its exit codes and what becomes of an exception."""

from __future__ import annotations

import argparse
import errno
import os
import sys
import time
import traceback
from collections.abc import Sequence
from pathlib import Path

from ..errors import SewfastError
from .apart import require_apart
from .parser import build_parser

DONE, FAULT, REFUSED, INTERRUPTED = 0, 1, 2, 130


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command.

    Parameters
    ----------
    argv : sequence of str or None
        Arguments after the program's name; None takes the process's own.

    Returns
    -------
    int
        0 done, 1 a fault in sewfast, 2 refused, 130 interrupted.
    """
    try:
        args = build_parser().parse_args(argv)
    except KeyboardInterrupt:
        return _say("sewfast: interrupted; nothing was written", INTERRUPTED)
    except SewfastError as e:
        return _say(f"sewfast: {e}", REFUSED)
    began = time.time()
    try:
        require_apart(args)
        code: int | None = args.command(args)
        if sys.stdout is not None:  # as it is where it was closed before the start
            sys.stdout.flush()
        return code or DONE
    except SewfastError as e:
        return _say(f"sewfast {args.name}: {e}", REFUSED)
    except KeyboardInterrupt:
        return _say(f"sewfast {args.name}: {_interrupted(args, began)}", INTERRUPTED)
    except BrokenPipeError:
        # the reader of the pipe has seen enough; the interpreter must not flush into it again
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return DONE
    except OSError as e:
        if e.errno not in (errno.ENOSPC, errno.EDQUOT):
            return _fault(args, e)
        # what is still buffered must not raise again when the interpreter flushes it
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return _say(
            f"sewfast {args.name}: expected room for the output, received "
            f"{e.strerror!r}; free some space or write elsewhere",
            REFUSED,
        )
    except Exception as e:
        return _fault(args, e)


def _interrupted(args: argparse.Namespace, began: float) -> str:
    """What is left of a command that was interrupted again while it closed its recording."""
    out = getattr(args, "out", None)
    place = out.with_suffix(".mcap") if isinstance(out, Path) and out.name else None
    try:
        written = place is not None and place.stat().st_mtime >= began - 1.0
    except OSError:
        written = False
    return (
        f"interrupted; what came is in {place}" if written else "interrupted; nothing was written"
    )


def _fault(args: argparse.Namespace, e: Exception) -> int:
    if args.debug:
        traceback.print_exc()
    return _say(
        f"sewfast {args.name}: a fault in sewfast: {type(e).__name__}: {e}; please report it "
        "with the output of the same command and --debug",
        FAULT,
    )


def _say(message: str, code: int) -> int:
    print(message, file=sys.stderr)
    return code
