"""`sewfast fleet`: many machines, one row each."""

from __future__ import annotations

import argparse
import dataclasses
import sys
from pathlib import Path

from sewfast.cli.arguments import Commands, add_command, add_plot, require_plot
from sewfast.cli.output import DONE, INTERRUPTED, print_json
from sewfast.kinds import KINDS
from sewfast.progress import Progress

TEXT = """\
Identify and check every recording of a folder, or of a manifest (CSV with a column file and, if
they differ, inputs, output, Ts), on all cores or on a Dask cluster. An unusable recording fails in
its own row only. The same command continues after an interruption, and processes only new or
changed recordings. With --before, it names the machines whose gain, residence time or noise has
moved beyond its band.
"""

EXAMPLES = """\
examples:
  sewfast fleet recordings -o results.parquet
  sewfast fleet machines.csv --input u --output speed -o october.csv
  sewfast fleet november -o november.csv --before october.csv           machines that drifted
  sewfast fleet recordings -o gains.csv --controller template.json      a controller for each
  sewfast fleet recordings -o results.csv --scheduler tcp://host:8786   on a cluster
"""


def add(commands: Commands) -> None:
    parser = add_command(
        commands, "fleet", command,
        summary="many recordings, one row each", text=TEXT, examples=EXAMPLES,
    )  # fmt: skip
    parser.add_argument("recordings", metavar="FOLDER|MANIFEST", help="recordings, or their list")
    parser.add_argument(
        "-o", "--out", required=True, type=Path, metavar="OUT", help=".csv, .json or .parquet"
    )
    parser.add_argument(
        "--input", action="append", metavar="COL", help="column of the input; repeat it for several"
    )
    parser.add_argument(
        "--output", metavar="COL",
        help="column of the output; default: both by their names and units",
    )  # fmt: skip
    parser.set_defaults(columns_of="file", counts=None)
    parser.add_argument(
        "--ts", "--Ts", type=float, metavar="S", help="sample time [s]; default: the time column's"
    )
    parser.add_argument(
        "--model", default="oe", choices=KINDS,
        help="kind of model (oe)",
    )  # fmt: skip
    parser.add_argument(
        "--controller", metavar="FILE.json", help="tune this controller for every model"
    )
    parser.add_argument("--before", metavar="FILE", help="an earlier table, to find drift")
    add_plot(parser, "draw gain, residence time and noise of every machine")
    parser.add_argument("--scheduler", metavar="ADDRESS", help="scheduler of a Dask cluster")
    parser.add_argument(
        "--workers", type=int, metavar="N",
        help="processes on this computer (its cores); 0: in this process, without Dask",
    )  # fmt: skip
    parser.add_argument("--memory", default="500MB", metavar="SIZE", help="of each worker (500MB)")
    parser.add_argument("--seed", type=int, default=0, metavar="N", help="seed of searches (0)")


def command(args: argparse.Namespace) -> int:
    from sewfast.control.files import load_pid

    from . import fleet

    require_plot(args.plot)
    controller = None if args.controller is None else load_pid(args.controller)
    done = 0
    with Progress("fleet", "share failed", quiet=args.quiet) as shown:

        def progress(count: int, total: int, failed: float) -> None:
            nonlocal done
            done = count
            shown(count, total, failed)

        try:
            found = fleet(
                args.recordings,
                inputs=args.input,
                output=args.output,
                Ts=args.ts,
                model=args.model,
                controller=controller,
                before=args.before,
                out=args.out,
                scheduler=args.scheduler,
                workers=args.workers,
                memory=args.memory,
                seed=args.seed,
                progress=progress,
            )
        except KeyboardInterrupt:
            print(
                f"sewfast fleet: interrupted; {done} recordings are done and kept: the same "
                "command continues there",
                file=sys.stderr,
            )
            return INTERRUPTED
    if args.plot is not None:
        found.plot(file=args.plot)
    if args.json:
        drifts = [dataclasses.asdict(drift) for drift in found.drifts]
        failed = [{"file": row.file, "message": row.message} for row in found.failed]
        summary = {"recordings": len(found.rows), "failed": failed, "drifts": drifts}
        drawn = {} if args.plot is None else {"plot": str(args.plot)}
        print_json({**summary, "file": str(args.out), **drawn})
    else:
        print(f"{found}\nwritten to {args.out}")
        if args.plot is not None:
            print(f"written to {args.plot}")
    return DONE
