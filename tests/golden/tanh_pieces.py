"""The table of `rust/core/src/simd/tanh/tables.rs`; needs mpmath.

`python tests/golden/tanh_pieces.py`: Remez's algorithm for polynomials of tanh around 0, 1/4, 1/2
... 15/4 with the least relative error.
"""

from __future__ import annotations

import sys

import mpmath as mp
from tanh import polynomial

mp.mp.dps = 50
DEGREE = 11
PIECES = 16
STEP = mp.mpf(1) / 4
GRID = 800


def piece(centre: mp.mpf) -> tuple[list[mp.mpf], mp.mpf]:
    """Coefficients for tanh(centre + t), |t| <= STEP / 2, and the largest relative error.

    Around 0 only t >= 0 is asked for, and t + ... is given: the least numbers stay what they are.
    """
    given = [mp.mpf(0), mp.mpf(1)] if centre == 0 else []
    low, high = (mp.mpf(0) if given else -STEP / 2), STEP / 2
    grid = [(low + high - (high - low) * mp.cos(mp.pi * i / GRID)) / 2 for i in range(GRID + 1)]
    grid = grid[1:] if given else grid
    return polynomial(grid, [mp.tanh(centre + t) for t in grid], given, DEGREE)


def main() -> None:
    found = [piece(i * STEP) for i in range(PIECES)]
    for power in range(DEGREE + 1):
        sys.stdout.write("    [\n")
        for half in (found[:8], found[8:]):
            values = ", ".join(repr(float(coefficients[power])) for coefficients, _ in half)
            sys.stdout.write(f"        Group([{values}]),\n")
        sys.stdout.write("    ],\n")
    errors = [largest for _, largest in found]
    sys.stdout.write(f"relative errors {[mp.nstr(e, 2) for e in errors]}\n")


if __name__ == "__main__":
    main()
