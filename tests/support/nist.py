"""The regressions of NIST's StRD: models, starts and certified parameters, read from its files."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
Function = Callable[[FloatArray], FloatArray]

#: Digits that the certified values carry.
DIGITS = 11


def _gauss(b: FloatArray, x: FloatArray) -> FloatArray:
    bells = [b[i] * np.exp(-((x - b[i + 1]) ** 2) / b[i + 2] ** 2) for i in (2, 5)]
    return b[0] * np.exp(-b[1] * x) + bells[0] + bells[1]


def _exponentials(b: FloatArray, x: FloatArray) -> FloatArray:
    return sum(b[i] * np.exp(-b[i + 1] * x) for i in (0, 2, 4))


def _enso(b: FloatArray, x: FloatArray) -> FloatArray:
    turn = 2 * np.pi * x
    year = b[0] + b[1] * np.cos(turn / 12) + b[2] * np.sin(turn / 12)
    cycles = [b[i + 1] * np.cos(turn / b[i]) + b[i + 2] * np.sin(turn / b[i]) for i in (3, 6)]
    return year + cycles[0] + cycles[1]


def _cubics(b: FloatArray, x: FloatArray) -> FloatArray:
    top = b[0] + b[1] * x + b[2] * x**2 + b[3] * x**3
    return top / (1 + b[4] * x + b[5] * x**2 + b[6] * x**3)


def _chwirut(b: FloatArray, x: FloatArray) -> FloatArray:
    return np.exp(-b[0] * x) / (b[1] + b[2] * x)


MODELS: dict[str, Callable[[FloatArray, FloatArray], FloatArray]] = {
    "Bennett5": lambda b, x: b[0] * (b[1] + x) ** (-1 / b[2]),
    "BoxBOD": lambda b, x: b[0] * (1 - np.exp(-b[1] * x)),
    "Chwirut1": _chwirut,
    "Chwirut2": _chwirut,
    "DanWood": lambda b, x: b[0] * x ** b[1],
    "ENSO": _enso,
    "Eckerle4": lambda b, x: b[0] / b[1] * np.exp(-0.5 * ((x - b[2]) / b[1]) ** 2),
    "Gauss1": _gauss,
    "Gauss2": _gauss,
    "Gauss3": _gauss,
    "Hahn1": _cubics,
    "Kirby2": lambda b, x: (b[0] + b[1] * x + b[2] * x**2) / (1 + b[3] * x + b[4] * x**2),
    "Lanczos1": _exponentials,
    "Lanczos2": _exponentials,
    "Lanczos3": _exponentials,
    "MGH09": lambda b, x: b[0] * (x**2 + x * b[1]) / (x**2 + x * b[2] + b[3]),
    "MGH10": lambda b, x: b[0] * np.exp(b[1] / (x + b[2])),
    "MGH17": lambda b, x: b[0] + b[1] * np.exp(-x * b[3]) + b[2] * np.exp(-x * b[4]),
    "Misra1a": lambda b, x: b[0] * (1 - np.exp(-b[1] * x)),
    "Misra1b": lambda b, x: b[0] * (1 - (1 + b[1] * x / 2) ** -2),
    "Misra1c": lambda b, x: b[0] * (1 - (1 + 2 * b[1] * x) ** -0.5),
    "Misra1d": lambda b, x: b[0] * b[1] * x / (1 + b[1] * x),
    "Nelson": lambda b, x: b[0] - b[1] * x[0] * np.exp(-b[2] * x[1]),
    "Rat42": lambda b, x: b[0] / (1 + np.exp(b[1] - b[2] * x)),
    "Rat43": lambda b, x: b[0] / (1 + np.exp(b[1] - b[2] * x)) ** (1 / b[3]),
    "Roszman1": lambda b, x: b[0] - b[1] * x - np.arctan(b[2] / (x - b[3])) / np.pi,
    "Thurber": _cubics,
}


@dataclass(frozen=True)
class Regression:
    """Starts (2, n), certified parameters and deviations (n,), x (N,) or (2, N), y (N,)."""

    name: str
    starts: FloatArray
    certified: FloatArray
    deviations: FloatArray
    x: FloatArray
    y: FloatArray

    def residuals(self, b: FloatArray) -> FloatArray:
        """Model less data; complex where the parameters are."""
        return MODELS[self.name](b, self.x) - self.y

    def jacobian(self, b: FloatArray) -> FloatArray:
        """Exact derivatives, by complex steps."""
        return complex_step(self.residuals, b)

    def digits(self, b: FloatArray) -> float:
        """Log relative error of the worst parameter, 0 to 11."""
        return lre(b, self.certified)


def lre(values: FloatArray, certified: FloatArray) -> float:
    """Correct digits of the worst value: 0 where none is, 11 at most."""
    if not np.isfinite(values).all():
        return 0.0
    worst = float(np.max(np.abs(values / certified - 1)))
    return min(DIGITS, max(0.0, -np.log10(max(worst, 1e-300))))


def complex_step(function: Function, b: FloatArray) -> FloatArray:
    """Jacobian (N, n) without cancellation: the imaginary part along a tiny imaginary step."""
    size = 1e-150
    columns = []
    for j in range(len(b)):
        moved = b.astype(complex)
        moved[j] += 1j * size
        columns.append(np.imag(function(moved)) / size)
    return np.column_stack(columns)


def read(path: Path) -> Regression:
    """One of NIST's files."""
    text = path.read_text(encoding="ascii")
    number = r"[-+]?[\d.]+(?:[eE][-+]?\d+)?"
    row = re.compile(rf"^\s*b\d+\s*=\s*({number})\s+({number})\s+({number})\s+({number})", re.M)
    table = np.array(row.findall(text), float)
    rows = re.split(r"^Data:.*$", text, flags=re.M)[-1].splitlines()
    data = np.array([r.split() for r in rows if r.strip()], float)
    y = np.log(data[:, 0]) if path.stem == "Nelson" else data[:, 0]
    x = data[:, 1:].T if data.shape[1] > 2 else data[:, 1]
    return Regression(path.stem, table[:, :2].T, table[:, 2], table[:, 3], x, y)


def read_all(folder: Path) -> list[Regression]:
    """All 27, by name."""
    return [read(folder / f"{name}.dat") for name in MODELS]
