"""Hook of the site: cli.md shows what `--help` prints, so that it cannot fall behind."""

from __future__ import annotations

import argparse
import os
import re
from typing import Any

_PLACE = re.compile(r"^<!-- help(?: (\w+))? -->$", re.MULTILINE)


def on_page_markdown(markdown: str, **_: Any) -> str:
    """Replace `<!-- help COMMAND -->` by what `sewfast COMMAND --help` prints."""
    return _PLACE.sub(lambda m: f"```text\n{help_of(m[1])}```", markdown)


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
