"""The coefficients of `rust/control/src/model/tanh.rs`; run it with Python, it needs mpmath.

Remez's algorithm for tanh(x)/x = P(s)/Q(s), s = x^2, with the least relative error: up to where
tanh is 1 to the last bit; of lower degree up to 8; and for single precision.
"""

from __future__ import annotations

import sys

import mpmath as mp

mp.mp.dps = 60
QUOTIENTS = ((10, mp.mpf("19.1")), (7, mp.mpf(8)), (4, mp.mpf("9.1")))
GRID = 1500


def target(s: mp.mpf) -> mp.mpf:
    x = mp.sqrt(s)
    return mp.tanh(x) / x if x > mp.mpf(10) ** -25 else 1 - s / 3


def placed(t: mp.mpf, end: mp.mpf) -> mp.mpf:
    """Points from 0 to end, dense near 0."""
    return end * t**4


def solved(
    points: list[mp.mpf], error: mp.mpf, degree: int, end: mp.mpf
) -> tuple[list[mp.mpf], list[mp.mpf], mp.mpf]:
    """P, Q and the error that alternates over the points; the error enters its own equation."""
    unknowns = 2 * degree + 2
    for _ in range(8):
        left, right = mp.matrix(unknowns, unknowns), mp.matrix(unknowns, 1)
        for i, s in enumerate(points):
            sign, wanted, share = (-1) ** i, target(s), s / end
            for j in range(degree + 1):
                left[i, j] = share**j
            for j in range(1, degree + 1):
                left[i, degree + j] = -wanted * share**j * (1 + sign * error)
            left[i, unknowns - 1] = -wanted * sign
            right[i] = wanted
        found = mp.lu_solve(left, right)
        settled = abs(found[unknowns - 1] - error) < abs(error) * mp.mpf(10) ** -15
        error = found[unknowns - 1]
        if settled:
            break
    numerator = [found[j] for j in range(degree + 1)]
    denominator = [mp.mpf(1)] + [found[degree + j] for j in range(1, degree + 1)]
    return numerator, denominator, error


def extremes(values: list[mp.mpf], unknowns: int) -> list[int]:
    """Where the error is largest between its changes of sign."""
    best: list[int] = []
    for i, value in enumerate(values):
        if best and values[best[-1]] * value > 0:
            if abs(value) > abs(values[best[-1]]):
                best[-1] = i
        else:
            best.append(i)
    while len(best) > unknowns:
        best.pop(0 if abs(values[best[0]]) < abs(values[best[-1]]) else -1)
    return best


def polynomial(
    grid: list[mp.mpf], wanted: list[mp.mpf], given: list[mp.mpf], degree: int
) -> tuple[list[mp.mpf], mp.mpf]:
    """Coefficients with the least relative error on a grid, and that error; the first are given."""
    free, high = degree + 1 - len(given), grid[-1]
    chosen = [round((len(grid) - 1) * i / free) for i in range(free + 1)]
    best: tuple[list[mp.mpf], mp.mpf] = ([], mp.inf)
    for _ in range(8):
        left, right = mp.matrix(free + 1, free + 1), mp.matrix(free + 1, 1)
        for row, i in enumerate(chosen):
            share = grid[i] / high
            for j in range(free):
                left[row, j] = share ** (j + len(given))
            left[row, free] = (-1) ** row * wanted[i]
            right[row] = wanted[i] - mp.polyval(given[::-1], grid[i])
        found = mp.lu_solve(left, right)
        scaled = [found[j] / high ** (j + len(given)) for j in range(free)]
        coefficients = given + scaled
        errors = [
            mp.polyval(coefficients[::-1], t) / value - 1
            for t, value in zip(grid, wanted, strict=True)
        ]
        largest = max(abs(e) for e in errors)
        if largest < best[1]:
            best = (coefficients, largest)
        chosen = extremes(errors, free + 1)
        if len(chosen) < free + 1:
            break
    return best


def quotient(degree: int, end: mp.mpf) -> tuple[mp.mpf, list[mp.mpf], list[mp.mpf]]:
    """The largest relative error, P and Q of s/end up to end."""
    unknowns = 2 * degree + 2
    turns = [(1 - mp.cos(mp.pi * (2 * i + 1) / (2 * unknowns))) / 2 for i in range(unknowns)]
    points = [placed(t, end) for t in turns]
    grid = [placed(mp.mpf(i) / GRID, end) for i in range(GRID + 1)]
    best: tuple[mp.mpf, list[mp.mpf], list[mp.mpf]] = (mp.inf, [], [])
    error = mp.mpf(0)
    for _ in range(6):
        p, q, error = solved(points, error, degree, end)
        values = [mp.polyval(p[::-1], s / end) / mp.polyval(q[::-1], s / end) for s in grid]
        errors = [value / target(s) - 1 for value, s in zip(values, grid, strict=True)]
        largest = max(abs(e) for e in errors)
        if largest < best[0]:
            best = (largest, p, q)
        chosen = extremes(errors, unknowns)
        if len(chosen) < unknowns:
            break
        points = [grid[i] for i in chosen]
    return best


def main() -> None:
    for degree, limit in QUOTIENTS:
        end = limit**2
        largest, p, q = quotient(degree, end)
        for name, values in (("P", p), ("Q", q)):
            sys.stdout.write(f"{name} {[float(v / end**j) for j, v in enumerate(values)]}\n")
        sys.stdout.write(f"relative error {mp.nstr(largest, 3)}\n")


if __name__ == "__main__":
    main()
