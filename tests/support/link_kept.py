"""What a run on a drive leaves: a sink that keeps everything, and what it is to do."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

U = 3.0 * np.sin(np.arange(400) / 20.0)
LONG = np.tile(U, 20)
"""For what is to happen before the end, however busy the machine is."""


class Kept:
    """A sink that keeps everything; `on_samples` may do more."""

    def __init__(self, on_samples: Callable[[int], object] = lambda first: None) -> None:
        self.blocks: list[tuple[int, dict[str, np.ndarray]]] = []
        self.events: list[tuple[str, int, dict[str, Any]]] = []
        self._on_samples = on_samples

    def samples(self, first, columns):
        self._on_samples(first)
        self.blocks.append((first, {name: c.copy() for name, c in columns.items()}))

    def event(self, kind, index, **detail):
        self.events.append((kind, index, detail))

    @property
    def kinds(self) -> list[str]:
        return [kind for kind, _, _ in self.events]

    def indexes(self) -> np.ndarray:
        return np.concatenate([f + np.arange(len(c["u"])) for f, c in self.blocks])

    def column(self, name: str) -> np.ndarray:
        return np.concatenate([c[name] for _, c in self.blocks])


def once(action: Callable[[], object], at: int = 100) -> Callable[[int], None]:
    done: list[int] = []

    def act(first: int) -> None:
        if first >= at and not done:
            done.append(first)
            action()

    return act
