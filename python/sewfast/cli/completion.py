"""`sewfast completion`: commands, options and files after a press of Tab."""

from __future__ import annotations

import argparse
import re

from ..errors import SettingError
from .arguments import Commands, add_command
from .output import print_json

COMPLETION = """\
Print a script that completes commands, options, choices and file names in bash, zsh or tcsh.
It needs the package shtab: pip install "sewfast[completion]". The script itself needs nothing.
"""

EXAMPLES = """\
examples:
  sewfast completion bash > ~/.local/share/bash-completion/completions/sewfast
  sewfast completion zsh > ~/.zfunc/_sewfast        with `fpath+=~/.zfunc` before compinit
"""

_FILES = re.compile(r"FILE|DATA|OUT|\.json|\.mcap|DIR|PORT|virtual", re.IGNORECASE)
"""What stands in the name of an argument that is a file, or may be one."""


def add(commands: Commands) -> None:
    parser = add_command(
        commands, "completion", completion_command,
        summary="completion for a shell", text=COMPLETION, examples=EXAMPLES,
    )  # fmt: skip
    parser.add_argument("shell", choices=("bash", "zsh", "tcsh"), help="for which shell")


def completion_command(args: argparse.Namespace) -> None:
    try:
        import shtab
    except ImportError as e:
        raise SettingError(
            'completion needs shtab, which is not installed: pip install "sewfast[completion]"'
        ) from e
    from .parser import build_parser

    parser = build_parser()
    _complete_files(parser, shtab.FILE)
    script = shtab.complete(parser, shell=args.shell)
    if args.json:
        print_json({"shell": args.shell, "script": script})
    else:
        print(script)


def _complete_files(parser: argparse.ArgumentParser, files: object) -> None:
    """Let arguments that name files be completed by files, in every command."""
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            for command in action.choices.values():
                _complete_files(command, files)
        elif isinstance(action.metavar, str) and _FILES.search(action.metavar):
            action.complete = files  # type: ignore[attr-defined]
