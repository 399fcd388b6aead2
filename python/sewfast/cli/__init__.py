"""The command line: `main`, its exit codes and what becomes of an exception."""

from __future__ import annotations

import argparse
import errno
import os
import sys
import traceback
from collections.abc import Sequence

from ..errors import SewfastError
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
    args = build_parser().parse_args(argv)
    try:
        code: int | None = args.command(args)
        sys.stdout.flush()
        return code or DONE
    except SewfastError as e:
        return _say(f"sewfast {args.name}: {e}", REFUSED)
    except KeyboardInterrupt:
        return _say(f"sewfast {args.name}: interrupted; nothing was written", INTERRUPTED)
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
