"""What commands share that run on a drive behind a port; `sewfast stop`, `sewfast clear`."""

from __future__ import annotations

import argparse
import re
import signal
import stat
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..errors import LinkError, SettingError
from .arguments import Commands, add_command, add_view
from .output import print_json

if TYPE_CHECKING:
    from ..link import Drive

LIMITS = {
    "volt": "volt",
    "speed": "speed_rpm",
    "acceleration": "acceleration",
    "current": "current",
}
"""Names on the command line, and those of `Drive.set_limits`."""

STOP = """\
Make a drive's output safe: command 0, drive disabled. A tripped drive stays tripped.
"""

CLEAR = """\
Take back the trip of a drive once its cause is known. The drive is idle then; nothing moves.
"""


def add(commands: Commands) -> None:
    for name, command, text in (("stop", stop_command, STOP), ("clear", clear_command, CLEAR)):
        parser = add_command(
            commands, name, command,
            summary={"stop": "stop a drive", "clear": "take back a drive's trip"}[name], text=text,
            examples=f"example:\n  sewfast {name} /dev/ttyUSB0",
        )  # fmt: skip
        parser.add_argument("port", metavar="PORT", help="serial port or socket://HOST:PORT")
        _add_baud(parser)


def _add_baud(parser: argparse._ActionsContainer) -> None:
    parser.add_argument(
        "--baud", type=int, default=115_200, metavar="N", help="bits/s of a serial port (115200)"
    )


def add_drive(parser: argparse.ArgumentParser) -> None:
    """Options that matter on a drive only."""
    group = parser.add_argument_group("on a drive (PORT or socket://HOST:PORT)")
    _add_baud(group)
    group.add_argument(
        "--limits", metavar="LIST",
        help="what the drive may do, as volt=10,speed=3500,acceleration=30000,current=15 [V, RPM, "
        "RPM/s, A]; it stops when it does more. inf: none. A virtual drive has limits by default; "
        "a virtual machine without a port has none to set",
    )  # fmt: skip
    group.add_argument(
        "--watchdog", type=float, metavar="MS",
        help="the drive stops when it has not heard from here for this long (100; 250 of its own "
        "time where that runs by credit)",
    )  # fmt: skip
    add_view(group)


def is_port(text: str) -> bool:
    """Whether a text names a serial port or a socket rather than a file or a virtual machine."""
    if text.startswith("socket://") or re.fullmatch(r"COM\d+", text, re.IGNORECASE):
        return True
    if text.startswith("/dev/"):
        return True
    try:
        return stat.S_ISCHR(Path(text).stat().st_mode)
    except (OSError, ValueError):
        return False


def require_no_drive_options(args: argparse.Namespace) -> None:
    """Refuse what only a drive behind a port can be told, where `--on` names none.

    Raises
    ------
    SettingError
        Rather than a run that somebody believes to be within limits.
    """
    given = {
        "--limits": args.limits is not None,
        "--watchdog": args.watchdog is not None,
        "--live": args.live.name not in ("auto", "none"),
    }
    for name, is_given in given.items():
        if is_given:
            raise SettingError(
                f"{name} belongs to a drive behind a port, received --on {args.on}; leave it out, "
                "or serve a virtual machine as a drive, which keeps to limits: "
                "`sewfast device --link DRIVE --fast`, then --on DRIVE"
            )


@contextmanager
def opened(args: argparse.Namespace) -> Iterator[Drive]:
    """The drive behind `args.on`, with its limits set; it is stopped when the block ends."""
    from ..link import connect

    limits = _limits(args.limits) if args.limits else None
    watchdog = None if args.watchdog is None else args.watchdog * 1e-3
    if watchdog is not None and not 0.001 <= watchdog <= 10.0:
        raise SettingError(
            f"--watchdog: expected 1 to 10000 ms, got {args.watchdog:g}; 100 suits most"
        )
    with connect(args.on, baud=args.baud, watchdog=watchdog) as drive:
        if limits is None and not drive.identity.is_computed:
            raise SettingError(
                "expected --limits for a drive that is no virtual one, got none; say what motor "
                "and machine stand: --limits volt=10,speed=3500,acceleration=30000,current=15"
            )
        _require_untripped(args.on, drive)
        # limits that an earlier command has left must not stay in force unnoticed
        drive.set_limits(**(limits or _ceilings(drive)))
        with _ended_by_signals():
            yield drive


def _ceilings(drive: Drive) -> dict[str, float]:
    return dict(zip(LIMITS.values(), drive.limits().ceilings, strict=True))


@contextmanager
def _ended_by_signals() -> Iterator[None]:
    """A run that is told to end, or whose terminal is closed, ends as by Ctrl-C: motor first."""
    numbers = [getattr(signal, name, None) for name in ("SIGTERM", "SIGHUP")]
    before = {n: signal.signal(n, signal.default_int_handler) for n in numbers if n is not None}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _require_untripped(port: str, drive: Drive) -> None:
    """Say why a drive does not take limits, rather than that it does not.

    Raises
    ------
    LinkError
    """
    status = drive.status()
    if status.state == "tripped":
        raise LinkError(
            f"{port}: expected a drive that is ready, it has tripped: {status.reason}; find out "
            f"why, then `sewfast clear {port}`"
        )


def _limits(text: str) -> dict[str, float]:
    """Parse `volt=10,speed=3500,...`.

    Raises
    ------
    SettingError
        Where a limit is missing, unknown, repeated or no number.
    """
    parts = [part.partition("=") for part in text.split(",")]
    names = [name.strip() for name, _, _ in parts]
    if sorted(names) != sorted(LIMITS):
        raise SettingError(
            f"--limits: expected each of {', '.join(LIMITS)} once, got {text!r}; for example "
            "volt=10,speed=3500,acceleration=30000,current=15"
        )
    try:
        return {LIMITS[name.strip()]: float(value) for name, _, value in parts}
    except ValueError:
        raise SettingError(f"--limits: expected numbers, got {text!r}") from None


def recording_place(out: Path | None, *, overwrite: bool) -> Path:
    """Where the recording of a drive goes: the output itself, or `.mcap` beside it.

    Raises
    ------
    SettingError
        Without an output, what a drive did cannot be had again; nor can what another one has done,
        which is kept.
    """
    from ..recordfile.writer import require_free, require_replaceable

    if out is None:
        raise SettingError(
            "expected -o FILE for what is recorded on a drive, got none; as in -o run.mcap"
        )
    place = out.with_suffix(".mcap")
    require_replaceable(place, overwrite=overwrite)
    if not place.exists():
        # a table beside its recording was made from it; this one is all there is
        require_free([out], overwrite=overwrite)
    return place


def say_interrupted(count: int, place: Path) -> int:
    """What a run has left that Ctrl-C ended; the exit code."""
    left = f"{count} samples are in {place}" if count else "nothing had been recorded"
    print(f"interrupted; {left}", file=sys.stderr)
    return 130


def stop_command(args: argparse.Namespace) -> None:
    _told(args, "stop")


def clear_command(args: argparse.Namespace) -> None:
    _told(args, "clear")


def _told(args: argparse.Namespace, what: str) -> None:
    from ..link import connect

    with connect(args.port, baud=args.baud) as drive:
        getattr(drive, what)()
        status = drive.status()
    found: dict[str, Any] = {"state": status.state, "speed_rpm": status.speed_rpm}
    if status.state == "tripped":
        found["reason"] = status.reason
    if args.json:
        print_json(found)
    else:
        why = (
            f" ({status.reason}); see to the cause, then `sewfast clear`"
            if "reason" in found
            else ""
        )
        print(f"{args.port}: {status.state}{why}, {status.speed_rpm:.0f} RPM")
