"""Fenced blocks of a page: what a reader would type, in order."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

_FENCE = re.compile(r"^```(\w*)\n(.*?)^```$", re.MULTILINE | re.DOTALL)


@dataclass(frozen=True)
class Block:
    language: str
    text: str
    line: int

    @property
    def commands(self) -> list[str]:
        """Lines of a console block that follow a prompt."""
        return [row[2:] for row in self.text.splitlines() if row.startswith("$ ")]


def blocks(path: Path) -> list[Block]:
    """Every fenced block, with the line that its first line stands on."""
    text = path.read_text(encoding="utf-8")
    return [Block(m[1], m[2], text.count("\n", 0, m.start()) + 2) for m in _FENCE.finditer(text)]
