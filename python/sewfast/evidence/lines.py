"""`Line` and `Judged`: questions with value, limit and verdict, and what shows them together."""

from __future__ import annotations

import math
import textwrap
from dataclasses import dataclass
from html import escape
from typing import Any, Literal, TypeAlias

Verdict: TypeAlias = Literal["ok", "warn", "fail", "info"]
_ORDER: dict[Verdict, int] = {"info": 0, "ok": 1, "warn": 2, "fail": 3}
_WIDTH = 100


@dataclass(frozen=True)
class Line:
    """One question.

    Attributes
    ----------
    name : str
        What was looked at.
    value : float
        The number; NaN where there is none.
    shown : str
        The number as text, with its unit.
    limit : str
        What it is held against; empty for information alone.
    verdict : "ok", "warn", "fail" or "info"
    meaning : str
        What it says and what to do.
    """

    name: str
    value: float
    shown: str
    limit: str
    verdict: Verdict
    meaning: str

    def to_json(self) -> dict[str, Any]:
        """As JSON values."""
        value = self.value if math.isfinite(self.value) else None
        return {
            "name": self.name,
            "value": value,
            "shown": self.shown,
            "limit": self.limit,
            "verdict": self.verdict,
            "meaning": self.meaning,
        }


class Judged:
    """What consists of lines: its verdict is the worst of theirs."""

    lines: tuple[Line, ...]
    heading = "Report card"
    style = "report-card"
    """Class of the table in `to_html`."""

    @property
    def title(self) -> str:
        """What was judged."""
        raise NotImplementedError

    @property
    def verdict(self) -> Verdict:
        """The worst of the lines."""
        return max((line.verdict for line in self.lines), key=_ORDER.__getitem__, default="info")

    @property
    def summary(self) -> str:
        """What the lines amount to and what to do, in a sentence; empty where they stand alone."""
        return ""

    def line(self, name: str) -> Line:
        """The line of that name.

        Raises
        ------
        KeyError
            Where there is none.
        """
        for line in self.lines:
            if line.name == name:
                return line
        raise KeyError(f"no line {name!r}; there are {', '.join(x.name for x in self.lines)}")

    def to_html(self) -> str:
        """A table for a page: no script, no style of its own, verdicts as classes of the cells."""
        rows = "\n".join(
            f'<tr><th scope="row">{escape(x.name)}</th><td>{escape(x.shown)}</td>'
            f"<td>{escape(x.limit)}</td>"
            f'<td class="verdict {x.verdict}">{x.verdict}</td><td>{escape(x.meaning)}</td></tr>'
            for x in self.lines
        )
        heads = "".join(
            f'<th scope="col">{h}</th>'
            for h in ("question", "value", "limit", "verdict", "meaning")
        )
        closing = f"<br>{escape(self.summary)}" if self.summary else ""
        return (
            f'<table class="{self.style}"><caption>{escape(self.title)}: '
            f'<b class="verdict {self.verdict}">{self.verdict}</b>{closing}</caption>\n'
            f"<thead><tr>{heads}</tr></thead>\n<tbody>\n{rows}\n</tbody></table>"
        )

    def __repr__(self) -> str:
        counts = {v: sum(x.verdict == v for x in self.lines) for v in _ORDER}
        text = ", ".join(f"{n} {v}" for v, n in reversed(counts.items()) if n)
        return f"{type(self).__name__}({self.verdict}: {text})"

    def __str__(self) -> str:
        wide = [
            max((len(getattr(x, k)) for x in self.lines), default=0)
            for k in ("name", "shown", "limit")
        ]
        found = [f"{self.heading}: {self.title}", f"verdict: {self.verdict}", ""]
        before = ""
        for x in self.lines:
            cells = zip((x.name, x.shown, x.limit), wide, strict=True)
            found.append(f"{x.verdict:4}  " + "  ".join(c.ljust(w) for c, w in cells).rstrip())
            if x.meaning != before:
                found += textwrap.wrap(
                    x.meaning, _WIDTH, initial_indent=" " * 6, subsequent_indent=" " * 6
                )
            before = x.meaning
        if self.summary:
            found += ["", *textwrap.wrap(f"in short: {self.summary}", _WIDTH)]
        return "\n".join(found)
