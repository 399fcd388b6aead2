"""Fenced blocks of a page: what a reader would type, in order."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

_FENCE = re.compile(r"^```(\w*)\n(.*?)^```$", re.MULTILINE | re.DOTALL)


@dataclass(frozen=True)
class Command:
    """A line that follows a prompt, and what the page shows below it."""

    text: str
    shown: str

    @property
    def refusal_is_shown(self) -> bool:
        """Whether the page shows a command that sewfast refuses."""
        return re.match(r"sewfast \w+: ", self.shown) is not None

    def shows(self, printed: str) -> bool:
        """Whether `printed` is what is shown; `...` stands for anything, blanks for any blanks."""
        parts = (r"\s+".join(map(re.escape, part.split())) for part in self.shown.split("..."))
        return re.fullmatch(r"\s*.*?\s*".join(parts), printed.strip(), re.DOTALL) is not None


@dataclass(frozen=True)
class Block:
    language: str
    text: str
    line: int

    @property
    def commands(self) -> list[Command]:
        """Commands of a console block: the lines that follow a prompt; `\\` continues a line."""
        text = re.sub(r"\\\n *", "", self.text)
        parts = re.split(r"^\$ ", text, flags=re.MULTILINE)[1:]
        return [Command(text, shown) for text, _, shown in (p.partition("\n") for p in parts)]


def blocks(path: Path) -> list[Block]:
    """Every fenced block, with the line that its first line stands on."""
    text = path.read_text(encoding="utf-8")
    return [Block(m[1], m[2], text.count("\n", 0, m.start()) + 2) for m in _FENCE.finditer(text)]
