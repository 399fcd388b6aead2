"""`sewfast record`, `sewfast signals`: recordings, and what to excite a machine with."""

from __future__ import annotations

import argparse

from .arguments import RECORDINGS, Commands, add_command, add_output, require_place
from .output import print_json, print_rows, write_columns

RECORD = """\
Excite a machine with a named signal and record what its encoder says.

Columns: t [s], u [V], counts, y [RPM] (the speed estimated from the counts) and, of a virtual
machine, speed_true [RPM], which no experiment could see; it is there for scores.
virtual:SEED is another machine of the same type.
"""

RECORD_EXAMPLES = """\
examples:
  sewfast record --on virtual --signal chirp_lo_hi -o chirp.csv
  sewfast record --on virtual:7 --signal random --seed 3 -o random.parquet
  sewfast record --on virtual --signal step -o step.mcap
"""

SIGNALS = """\
List the named signals: excitations [V] for `record --signal`, references [RPM] for
`run --reference` and `tune --reference`.
"""


def add(commands: Commands) -> None:
    parser = add_command(
        commands, "record", record_command,
        summary="a recording of the virtual machine", text=RECORD, examples=RECORD_EXAMPLES,
    )  # fmt: skip
    parser.add_argument("--on", required=True, metavar="virtual[:SEED]", help="the machine")
    parser.add_argument(
        "--signal", required=True, metavar="NAME", help="an excitation; see `sewfast signals`"
    )
    parser.add_argument(
        "--seed", type=int, default=0, metavar="N", help="seed of a random signal (0)"
    )
    add_output(parser, "OUT", "CSV, .npz, .mat, Parquet or .mcap; default: CSV to standard output")
    add_command(
        commands, "signals", signals_command,
        summary="the named signals", text=SIGNALS, examples="example:\n  sewfast signals",
    )  # fmt: skip


def record_command(args: argparse.Namespace) -> None:
    import numpy as np

    from ..machine import VirtualMachine
    from ..recordfile import Header
    from ..signals import excitation
    from ..speed import speed_from_counts

    require_place(args.out, RECORDINGS)
    machine = VirtualMachine.from_name(args.on)
    u = excitation(args.signal, args.seed)
    run = machine.run(u)
    y = speed_from_counts(run.counts, machine.Ts, machine.counts_per_rev)
    error = float(np.sqrt(np.mean((y - run.speed_rpm) ** 2)))
    low, high = float(run.speed_rpm.min()), float(run.speed_rpm.max())
    write_columns(
        args.out,
        {
            "t": np.arange(len(u)) * machine.Ts,
            "u": u,
            "counts": run.counts,
            "y": y,
            "speed_true": run.speed_rpm,
        },
        {"t": "s", "u": "V", "y": "RPM", "speed_true": "RPM"},
        {
            "machine": machine.name,
            "signal": args.signal,
            "seed": args.seed,
            "n": len(u),
            "Ts": machine.Ts,
            "counts_per_rev": machine.counts_per_rev,
            "speed_min_rpm": low,
            "speed_max_rpm": high,
            "speed_estimate_rmse_rpm": error,
        },
        [
            f"{machine.name}, {args.signal}: {len(u)} samples of {machine.Ts * 1e3:g} ms, "
            f"{low:.0f} to {high:.0f} RPM; y is within {error:.2g} RPM rms of the true speed"
        ],
        as_json=args.json,
        header=Header(
            args.signal,
            machine.Ts,
            {"u": "V", "counts": "1", "y": "RPM", "speed_true": "RPM"},
            len(u),
            machine.counts_per_rev,
            {"kind": "virtual", "name": machine.name},
            {"signal": args.signal, "seed": args.seed},
        ),
    )


def signals_command(args: argparse.Namespace) -> None:
    from ..signals import EXCITATIONS, REFERENCES

    groups = {"excitation": EXCITATIONS, "reference": REFERENCES}
    rows = [(group, s) for group, table in groups.items() for s in table.values()]
    if args.json:
        print_json(
            [
                {
                    "name": s.name,
                    "kind": group,
                    "unit": s.unit,
                    "duration_s": s.duration_s,
                    "description": s.description,
                }
                for group, s in rows
            ]
        )
        return
    head = ("name", "kind", "unit", "seconds", "description")
    print_rows([head, *((s.name, g, s.unit, f"{s.duration_s:g}", s.description) for g, s in rows)])
