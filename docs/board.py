"""Draws assets/board.svg, the loop on the emulated board, from what `sewfast pil` left.

sewfast pil && python docs/board.py pil
"""

from __future__ import annotations

import sys
from pathlib import Path

from sewfast.plotting import Drawing, Trace, loop_panels
from sewfast.readers import read_table

PICTURE = Path(__file__).parent / "assets" / "board.svg"
LABELS = {"predicted": "predicted (networks)", "measured": "measured (emulated board)"}


def main() -> None:
    runs = Path(sys.argv[1] if len(sys.argv) > 1 else "pil") / "commission" / "runs"
    traces = [
        Trace.of(
            read_table(runs / f"trapezoid_{name}.npz").columns,
            "model" if name == "predicted" else "machine",
            label,
        )
        for name, label in LABELS.items()
    ]
    output, error, command = loop_panels(traces, "RPM", "V")
    Drawing(((output,), (error,), (command,)), (2.2, 1.2, 1.2), (1.0,)).plot(file=PICTURE)
    print(f"{PICTURE}: {PICTURE.stat().st_size // 1000} kB")


if __name__ == "__main__":
    main()
