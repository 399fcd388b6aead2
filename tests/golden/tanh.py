"""The coefficients of `rust/core/src/simd/tanh.rs`: `python tests/golden/tanh.py`; needs mpmath.

Remez's algorithm for tanh(x)/x = P(s)/Q(s), s = x^2, with the least relative error up to x = 19.1.
"""

from __future__ import annotations

import sys

import mpmath as mp

mp.mp.dps = 60
DEGREE = 10
END = mp.mpf("19.1") ** 2
UNKNOWNS = 2 * DEGREE + 2
GRID = 1500


def target(s: mp.mpf) -> mp.mpf:
    x = mp.sqrt(s)
    return mp.tanh(x) / x if x > mp.mpf(10) ** -25 else 1 - s / 3


def placed(t: mp.mpf) -> mp.mpf:
    """Points from 0 to END, dense near 0."""
    return END * t**4


def solved(points: list[mp.mpf], error: mp.mpf) -> tuple[list[mp.mpf], list[mp.mpf], mp.mpf]:
    """P, Q and the error that alternates over the points; the error enters its own equation."""
    for _ in range(8):
        left, right = mp.matrix(UNKNOWNS, UNKNOWNS), mp.matrix(UNKNOWNS, 1)
        for i, s in enumerate(points):
            sign, wanted, share = (-1) ** i, target(s), s / END
            for j in range(DEGREE + 1):
                left[i, j] = share**j
            for j in range(1, DEGREE + 1):
                left[i, DEGREE + j] = -wanted * share**j * (1 + sign * error)
            left[i, UNKNOWNS - 1] = -wanted * sign
            right[i] = wanted
        found = mp.lu_solve(left, right)
        settled = abs(found[UNKNOWNS - 1] - error) < abs(error) * mp.mpf(10) ** -15
        error = found[UNKNOWNS - 1]
        if settled:
            break
    numerator = [found[j] for j in range(DEGREE + 1)]
    denominator = [mp.mpf(1)] + [found[DEGREE + j] for j in range(1, DEGREE + 1)]
    return numerator, denominator, error


def extremes(values: list[mp.mpf]) -> list[int]:
    """Where the error is largest between its changes of sign."""
    best: list[int] = []
    for i, value in enumerate(values):
        if best and values[best[-1]] * value > 0:
            if abs(value) > abs(values[best[-1]]):
                best[-1] = i
        else:
            best.append(i)
    while len(best) > UNKNOWNS:
        best.pop(0 if abs(values[best[0]]) < abs(values[best[-1]]) else -1)
    return best


def main() -> None:
    turns = range(UNKNOWNS)
    points = [placed((1 - mp.cos(mp.pi * (2 * i + 1) / (2 * UNKNOWNS))) / 2) for i in turns]
    grid = [placed(mp.mpf(i) / GRID) for i in range(GRID + 1)]
    best, error = None, mp.mpf(0)
    for _ in range(6):
        p, q, error = solved(points, error)
        quotient = [mp.polyval(p[::-1], s / END) / mp.polyval(q[::-1], s / END) for s in grid]
        errors = [value / target(s) - 1 for value, s in zip(quotient, grid, strict=True)]
        largest = max(abs(e) for e in errors)
        if best is None or largest < best[0]:
            best = (largest, p, q)
        chosen = extremes(errors)
        if len(chosen) < UNKNOWNS:
            break
        points = [grid[i] for i in chosen]
    largest, p, q = best
    for name, values in (("P", p), ("Q", q)):
        sys.stdout.write(f"{name} {[float(v / END**j) for j, v in enumerate(values)]}\n")
    sys.stdout.write(f"relative error {mp.nstr(largest, 3)}\n")


if __name__ == "__main__":
    main()
