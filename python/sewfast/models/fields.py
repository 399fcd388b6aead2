"""`Fields`: one object of a JSON file, read by name and type."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..dataset import FloatArray
from ..errors import ModelFileError


@dataclass(frozen=True)
class Fields:
    """Typed access to `values`; `place` is the path of the object within the file."""

    path: str
    values: Mapping[str, Any]
    place: str = ""

    def refuse(self, name: str, expected: str, received: object) -> ModelFileError:
        shown = repr(received)
        shown = shown if len(shown) <= 60 else shown[:57] + "..."
        return ModelFileError(
            f"{self.path}: field {self.place + name!r}: expected {expected}, received {shown}; the "
            "file is damaged or was edited"
        )

    def require_only(self, known: Collection[str]) -> None:
        """Raise where a field is missing or unknown."""
        for name in self.values:
            if name not in known:
                raise self.refuse(name, f"one of {', '.join(known)}", self.values[name])
        for name in known:
            self.any(name)

    def any(self, name: str) -> Any:
        if name not in self.values:
            raise ModelFileError(
                f"{self.path}: field {self.place + name!r} is missing; the file is damaged"
            )
        return self.values[name]

    def text(self, name: str) -> str:
        value = self.any(name)
        if not isinstance(value, str):
            raise self.refuse(name, "text", value)
        return value

    def flag(self, name: str) -> bool:
        value = self.any(name)
        if not isinstance(value, bool):
            raise self.refuse(name, "true or false", value)
        return value

    def integer(self, name: str) -> int:
        value = self.any(name)
        if type(value) is not int or not 0 <= value <= 1_000_000:
            raise self.refuse(name, "a whole number from 0 to 1,000,000", value)
        return value

    def number(self, name: str) -> float:
        return self._float(name, self.any(name))

    def optional_number(self, name: str) -> float | None:
        return None if self.any(name) is None else self.number(name)

    def positive(self, name: str) -> float:
        value = self.number(name)
        if value <= 0:
            raise self.refuse(name, "a positive number", value)
        return value

    def vector(self, name: str) -> FloatArray:
        return np.array([self._float(name, v) for v in self.items(name)], dtype=np.float64)

    def matrix(self, name: str) -> FloatArray:
        rows = self.items(name)
        if not rows or not all(isinstance(r, list) and len(r) == len(rows[0]) for r in rows):
            raise self.refuse(name, "rows of numbers of one length", rows)
        return np.array([[self._float(name, v) for v in r] for r in rows], dtype=np.float64)

    def items(self, name: str) -> list[Any]:
        value = self.any(name)
        if not isinstance(value, list):
            raise self.refuse(name, "a list", value)
        return value

    def object(self, name: str) -> Fields:
        return self.nested(name, self.any(name))

    def objects(self, name: str) -> list[Fields]:
        return [self.nested(f"{name}[{i}]", v) for i, v in enumerate(self.items(name))]

    def nested(self, name: str, value: Any) -> Fields:
        if not isinstance(value, dict):
            raise self.refuse(name, "an object", value)
        return Fields(self.path, value, f"{self.place}{name}.")

    def _float(self, name: str, value: Any) -> float:
        if type(value) not in (int, float):
            raise self.refuse(name, "a number", value)
        try:
            number = float(value)
        except OverflowError:
            number = math.inf
        if not math.isfinite(number):
            raise self.refuse(name, "a finite number", value)
        return number


def entries(shapes: Mapping[str, tuple[int, ...]]) -> tuple[str, ...]:
    """The name of every entry of matrices that stand one after the other, row by row."""
    return tuple(
        name + (f"[{','.join(map(str, index))}]" if index else "")
        for name, shape in shapes.items()
        for index in np.ndindex(*shape)
    )
