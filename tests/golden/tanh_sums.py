"""The coefficients of `rust/core/src/simd/tanh/sums.rs`: `python tests/golden/tanh_sums.py`.

Needs mpmath. Remez's algorithm for tanh(t) = t (1 + s P(s)), s = t^2, up to an eighth, with the
least relative error; and tanh of the quarters.
"""

from __future__ import annotations

import sys

import mpmath as mp
from tanh import extremes

mp.mp.dps = 50
DEGREE = 5
END = mp.mpf(1) / 64
GRID = 600


def coefficients() -> tuple[list[mp.mpf], mp.mpf]:
    """Coefficients of s P(s), and the largest relative error."""
    grid = [END * (1 - mp.cos(mp.pi * i / GRID)) / 2 for i in range(1, GRID + 1)]
    wanted = [mp.tanh(mp.sqrt(s)) / mp.sqrt(s) for s in grid]
    chosen = [round((len(grid) - 1) * i / DEGREE) for i in range(DEGREE + 1)]
    best: tuple[list[mp.mpf], mp.mpf] = ([], mp.inf)
    for _ in range(8):
        left, right = mp.matrix(DEGREE + 1, DEGREE + 1), mp.matrix(DEGREE + 1, 1)
        for row, i in enumerate(chosen):
            for j in range(DEGREE):
                left[row, j] = (grid[i] / END) ** (j + 1)
            left[row, DEGREE] = (-1) ** row * wanted[i]
            right[row] = wanted[i] - 1
        found = mp.lu_solve(left, right)
        scaled = [found[j] / END ** (j + 1) for j in range(DEGREE)]
        all_of = [*scaled[::-1], mp.mpf(1)]
        errors = [mp.polyval(all_of, s) / w - 1 for s, w in zip(grid, wanted, strict=True)]
        largest = max(abs(e) for e in errors)
        if largest < best[1]:
            best = (scaled, largest)
        chosen = extremes(errors, DEGREE + 1)
        if len(chosen) < DEGREE + 1:
            break
    return best


def main() -> None:
    found, largest = coefficients()
    for value in found:
        sys.stdout.write(f"{float(value)!r}\n")
    sys.stdout.write(f"relative error {mp.nstr(largest, 2)}\n")
    quarters = [float(mp.tanh(mp.mpf(i) / 4)) for i in range(16)]
    sys.stdout.write(f"quarters {quarters}\n")


if __name__ == "__main__":
    main()
