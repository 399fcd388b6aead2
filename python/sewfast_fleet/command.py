"""`sewfast fleet`: many machines, one row each."""

from __future__ import annotations

import argparse
import dataclasses
import sys

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


OPTIONS = """\
recordings FOLDER|MANIFEST  text  recordings, or their list
-o,--out OUT  path!  .csv, .json or .parquet
--input COL  text...  column of the input; repeat it for several
--output COL  text  column of the output; default: both by their names and units
--ts,--Ts S  float  sample time [s]; default: the time column's
--controller FILE.json  text  tune this controller for every model
--before FILE  text  an earlier table, to find drift
--scheduler ADDRESS  text  scheduler of a Dask cluster
--workers N  int  processes on this computer (its cores); 0: in this process, without Dask
--memory SIZE  text=500MB  of each worker (500MB)
--seed N  int=0  seed of searches (0)
"""


def add(commands: Commands) -> None:
    parser = add_command(
        commands, "fleet", command,
        summary="many recordings, one row each", text=TEXT, options=OPTIONS, examples=EXAMPLES,
    )  # fmt: skip
    parser.set_defaults(columns_of="file", counts=None)
    parser.add_argument(
        "--model", default="oe", choices=KINDS,
        help="kind of model (oe)",
    )  # fmt: skip
    add_plot(parser, "draw gain, residence time and noise of every machine")


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
