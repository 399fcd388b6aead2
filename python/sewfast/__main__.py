"""`sewfast` and `python -m sewfast`: the command line."""

from __future__ import annotations

# the module signal takes longer to import, and until SIGINT is set Ctrl-C shows a traceback
import _signal as signal  # type: ignore[import-not-found]
import sys
import time


def main() -> int:
    """Run one command, with the process's own arguments; its exit code."""
    began = time.monotonic()
    # While modules are read nothing is lost by Ctrl-C: the process ends as any other does, without
    # a traceback. Where SIGINT is ignored (a job in the background) it stays ignored.
    listening = signal.getsignal(signal.SIGINT)
    if listening is signal.default_int_handler:
        signal.signal(signal.SIGINT, signal.SIG_DFL)
    from .cli import interrupts
    from .cli import main as run

    interrupts.listen()
    try:
        code = run(began=began)
    finally:
        interrupts.deaf()
    if interrupts.is_pressed():
        interrupts.leave(code)
    return code


if __name__ == "__main__":
    sys.exit(main())
