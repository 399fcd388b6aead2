"""The coefficients of `rust/core/src/simd/tanh/tables.rs`: `python tests/golden/tanh_sums.py`.

Needs mpmath. Remez's algorithm for tanh(t) = t (1 + s P(s)), s = t^2, up to an eighth, with the
least relative error; and tanh of the quarters.
"""

from __future__ import annotations

import sys

import mpmath as mp
from tanh import polynomial

mp.mp.dps = 50
DEGREE = 5
END = mp.mpf(1) / 64
GRID = 600


def main() -> None:
    grid = [END * (1 - mp.cos(mp.pi * i / GRID)) / 2 for i in range(1, GRID + 1)]
    wanted = [mp.tanh(mp.sqrt(s)) / mp.sqrt(s) for s in grid]
    found, largest = polynomial(grid, wanted, [mp.mpf(1)], DEGREE)
    for value in found[1:]:
        sys.stdout.write(f"{float(value)!r}\n")
    sys.stdout.write(f"relative error {mp.nstr(largest, 2)}\n")
    quarters = [float(mp.tanh(mp.mpf(i) / 4)) for i in range(16)]
    sys.stdout.write(f"quarters {quarters}\n")


if __name__ == "__main__":
    main()
