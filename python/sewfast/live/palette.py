"""`Palette`: which characters and colours a terminal is given."""

from __future__ import annotations

from dataclasses import dataclass

_RESET = "\x1b[0m"


@dataclass(frozen=True)
class Palette:
    """What may be drawn with.

    Attributes
    ----------
    unicode : bool
        Braille dots and box lines; else ASCII only.
    colour : bool
        Escape sequences for colour.
    """

    unicode: bool
    colour: bool

    @property
    def marks(self) -> str:
        """Of the first curve of a panel, the second and so on; told apart without colour."""
        return "\u28ff.+x" if self.unicode else "*.+x"

    @property
    def legend(self) -> str:
        """How the first curve looks in a legend."""
        return "\u2809\u2809" if self.unicode else "**"

    @property
    def box(self) -> tuple[str, ...]:
        """Vertical line, tick on it, corner, horizontal line, tick on that, ellipsis."""
        return tuple("\u2502\u2524\u2514\u2500\u252c\u2026" if self.unicode else "|++-+~")

    def paint(self, text: str, colour: int | None) -> str:
        """The text in one of the terminal's own colours (SGR number)."""
        if not self.colour or colour is None or not text.strip():
            return text
        return f"\x1b[{colour}m{text}{_RESET}"
