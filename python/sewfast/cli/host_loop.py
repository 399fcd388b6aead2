"""`sewfast run --host-loop`: the controller on this computer, for slow plants."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..errors import Interrupted, SettingError
from .arguments import RECORDINGS, TABLES, require_place
from .drive import is_port, opened
from .output import print_json, write_columns
from .progress import Progress

if TYPE_CHECKING:
    from ..control.controller import Controller
    from ..dataset import FloatArray
    from ..link import HostLoopRun


def add_host_loop(parser: argparse.ArgumentParser) -> None:
    """Options of a controller that runs here and not on the drive."""
    group = parser.add_argument_group(
        "on a drive, with the controller on this computer",
        "For slow plants: this computer's jitter and the link's delay are in the loop. Both are\n"
        "measured and shown; nothing bounds them. Columns: t [s], r, u, y (speed over a period),\n"
        "feedback, late [s], age [s] (of the newest sample).",
    )
    group.add_argument(
        "--host-loop", nargs="?", const=0.0, type=float, metavar="MS",
        help="decide each command here, every MS ms (the controller's own sample time)",
    )  # fmt: skip
    group.add_argument(
        "--samples", type=Path, metavar="FILE", help="keep what the drive sent, at its own period"
    )
    group.add_argument(
        "--real-time", action="store_true",
        help="try real-time scheduling and locked memory; a refusal is reported",
    )  # fmt: skip


def at_loops_period(args: argparse.Namespace, controller: Controller) -> Controller:
    """The controller at the sample time asked for; other arguments are checked too.

    Raises
    ------
    SettingError
        For what cannot be, before anything moves.
    """
    from ..link import at_period
    from ..recordfile.writer import require_free

    if not is_port(args.on):
        raise SettingError(
            f"--host-loop: expected --on PORT or socket://HOST:PORT, got {args.on!r}; leave "
            "--host-loop out to simulate"
        )
    require_place(args.out, TABLES)
    require_place(args.samples, RECORDINGS)
    require_free([args.out, args.samples, args.plot], overwrite=args.overwrite)
    if not args.host_loop:
        return controller
    if not 0.0 < args.host_loop <= 10_000.0:
        raise SettingError(f"--host-loop: expected up to 10000 ms, got {args.host_loop:g}")
    return at_period(controller, args.host_loop * 1e-3)


def run_host_loop(
    args: argparse.Namespace, controller: Controller, reference: str | FloatArray
) -> int | None:
    """Run it, write what is asked for, and say how it ended.

    Returns
    -------
    int or None
        2 where the run did not complete, 130 where it was interrupted; the files are written
        then too.
    """
    from ..link import run_on_host

    code = None
    with opened(args) as drive:
        try:
            with Progress("run") as progress:
                found = run_on_host(
                    drive,
                    controller,
                    reference,
                    name=Path(args.reference).stem,
                    real_time=args.real_time,
                    progress=lambda done, total, _: progress.count(done, total),
                )
        except Interrupted as e:
            found, code = e.best, 130
        _show(args, found)
    if found.outcome != "completed":
        print(f"sewfast run: {found.message}", file=sys.stderr)
        code = code or 2
    return code


def _show(args: argparse.Namespace, found: HostLoopRun) -> None:
    summary: dict[str, Any] = {
        "plant": found.plant, "reference": found.reference, "unit": found.units["y"],
        "n": len(found.t), "Ts": found.Ts, "outcome": found.outcome, "message": found.message,
        "stop_confirmed": found.stop_confirmed,
        "samples": len(found.samples["t"]), "taken": found.taken, "gaps": found.gaps,
        **found.metrics(), "jitter": found.jitter.to_dict(),
    }  # fmt: skip
    lines = str(found).splitlines()
    if args.samples is not None:
        found.save_samples(args.samples, overwrite=args.overwrite)
        lines.append(f"samples written to {args.samples}")
    if args.plot is not None:
        found.plot(file=args.plot)
        summary["plot"] = str(args.plot)
        lines.append(f"drawn to {args.plot}")
    if args.out is None and args.samples is not None:
        print_json(summary) if args.json else print("\n".join(lines))
        return
    write_columns(args.out, found.columns(), found.units, summary, lines, as_json=args.json)
