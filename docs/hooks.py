"""Hook of the site: pages show what `--help` prints and files hold, so as not to fall behind."""

from __future__ import annotations

import argparse
import os
import re
from pathlib import Path
from typing import Any

_ROOT = Path(__file__).resolve().parents[1]
_FILE = re.compile(r'^<!-- file (\w+) (\S+)(?: from "(.+)" to "(.+)")? -->$', re.MULTILINE)
_PLACE = re.compile(r"^<!-- help(?: (\w+))? -->$", re.MULTILINE)


def on_page_markdown(markdown: str, **_: Any) -> str:
    """Replace `<!-- help COMMAND -->` by what `sewfast COMMAND --help` prints, and
    `<!-- file LANGUAGE PATH from "TEXT" to "TEXT" -->` by the file, or by its lines from that which
    holds the first text to the one before the other.
    """
    shown = _FILE.sub(lambda m: f"```{m[1]}\n{lines_of(m[2], m[3], m[4])}```", markdown)
    return _PLACE.sub(lambda m: f"```text\n{help_of(m[1])}```", shown)


def lines_of(path: str, first: str | None, end: str | None) -> str:
    """A file of the project, or some of its lines; ValueError where a text is not in it."""
    text = (_ROOT / path).read_text(encoding="utf-8")
    if first is None or end is None:
        return text
    start = text.rindex("\n", 0, text.index(first)) + 1
    stop = text.rindex("\n", 0, text.index(end, start)) + 1
    return text[start:stop].rstrip() + "\n"


def help_of(command: str | None) -> str:
    """The help text of one command, or of the program, 88 columns wide and without colour."""
    from sewfast.cli.parser import build_parser

    os.environ.update(COLUMNS="90", NO_COLOR="1")
    parser = build_parser()
    if command is None:
        return parser.format_help()
    groups = (a for a in parser._actions if isinstance(a, argparse._SubParsersAction))
    found: str = next(groups).choices[command].format_help()
    return found
