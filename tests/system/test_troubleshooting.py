"""The messages that docs/troubleshooting.md quotes are those that the program says."""

from __future__ import annotations

import ast
import errno
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest

from documents import blocks
from sewfast.errors import SettingError
from sewfast.link.ports import explain, open_port

ROOT = Path(__file__).resolve().parents[2]
PAGE = ROOT / "docs" / "troubleshooting.md"
QUOTED = [
    line for b in blocks(PAGE) if b.language == "text" for line in b.text.splitlines() if line
]


def _texts(tree: ast.AST) -> Iterator[str]:
    """Every text in a module; a placeholder is `\\0`."""
    for node in ast.walk(tree):
        if isinstance(node, ast.JoinedStr):
            yield "".join(v.value if isinstance(v, ast.Constant) else "\0" for v in node.values)
        elif isinstance(node, ast.Constant) and isinstance(node.value, str):
            yield node.value
        elif isinstance(node, ast.Call):
            fields = {k.arg: next(_texts(k.value), "\0") for k in node.keywords if k.arg}
            if "expected" in fields:
                yield str(SettingError(**{k: v for k, v in fields.items() if k in FIELDS}))


def _explained() -> Iterator[str]:
    """What the failures of a port are told as."""
    numbers = [errno.ENOENT, errno.EACCES, errno.EBUSY, errno.ENOTTY, errno.EIO]
    for number in numbers:
        yield str(explain("/dev/ttyUSB0", "open", OSError(number, "")))
        yield str(explain("/dev/ttyUSB0", "read", OSError(number, "")))
    yield str(explain("/dev/ttyUSB0", "open", ValueError("rate")))
    for error in (ConnectionRefusedError(errno.ECONNREFUSED, ""), TimeoutError("")):
        yield str(explain("socket://drive:1", "open", error))
    with pytest.raises(SettingError) as another:
        open_port("another://drive")
    yield str(another.value)


FIELDS = ("name", "expected", "received", "remedy")


@cache
def messages() -> tuple[str, ...]:
    files = sorted((ROOT / "python").rglob("*.py"))
    found = [t for f in files for t in _texts(ast.parse(f.read_text(encoding="utf-8")))]
    return (*found, *_explained())


def is_said(quoted: str) -> bool:
    """Whether some message has the pieces between the `...` of a quotation, in this order."""
    pieces = [piece.strip() for piece in quoted.split("...") if piece.strip()]
    return any(_holds(message, pieces) for message in messages())


def _holds(message: str, pieces: list[str]) -> bool:
    at = 0
    for piece in pieces:
        at = message.find(piece, at)
        if at < 0:
            return False
        at += len(piece)
    return True


@pytest.mark.parametrize("quoted", QUOTED)
def test_a_quoted_message_is_one_of_the_program(quoted: str) -> None:
    assert is_said(quoted), f"{PAGE.name} quotes what nothing says: {quoted}"


def test_quotations_are_compared() -> None:
    assert len(QUOTED) > 30
    assert not is_said("expected a port that you may open, nobody knows why")
    assert not is_said("did not come back ... it vanished")
