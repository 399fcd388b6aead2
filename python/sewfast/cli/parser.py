"""The parser: every command of `sewfast`, one group of commands per module."""

from __future__ import annotations

import argparse
import contextlib
import difflib
import re
import sys
from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Any, NoReturn

from .. import plugins
from ..errors import SewfastError, not_installed
from . import (
    check,
    commission,
    control,
    data,
    drive,
    gains,
    identify,
    machine,
    moves,
    project,
    recording,
    tune,
)
from .arguments import Commands, Help, add_command
from .output import print_json

if TYPE_CHECKING:
    from importlib.metadata import EntryPoint

DESCRIPTION = """\
From one recording of a motor drive to a verified controller.

  record  ->  identify  ->  validate  ->  tune  ->  run  ->  report
"""

EPILOG = """\
each command explains itself: sewfast COMMAND --help

a first walk, on the virtual sewing machine:
  sewfast record --on virtual --signal chirp_lo_hi -o chirp.csv
  sewfast record --on virtual --signal saturating -o pulses.csv
  sewfast identify chirp.csv pulses.csv --input u --output y -o drive.json
  sewfast record --on virtual --signal random -o random.csv
  sewfast validate drive.json random.csv
  sewfast tune drive.json -o controller.json
  sewfast run controller.json --on virtual --reference trapezoid -o run.csv

or everything at once, with a report to look at:
  sewfast demo

results go to standard output, progress and messages to standard error

exit codes:
  0    done
  1    a fault in sewfast itself; --debug shows where
  2    refused: the message says what was expected, what was received and what to do
  130  interrupted by Ctrl-C; the best result so far is kept
"""


class Parser(argparse.ArgumentParser):
    """A parser that suggests the nearest name for a typo; without a command it shows its help."""

    def parse_args(  # type: ignore[override]
        self, args: Sequence[str] | None = None, namespace: Any = None
    ) -> argparse.Namespace:
        found: argparse.Namespace
        given = list(sys.argv[1:] if args is None else args)
        if given[:1] == ["help"]:
            given = [*given[1:2], "--help"]
        found, unknown = self.parse_known_args(given, namespace)
        if unknown:
            known = self.options_of(found.name)
            self.error(f"unrecognized arguments: {' '.join(unknown)}{meant(unknown, known)}")
        if found.name is None:
            self.print_help()
            self.exit(0)
        return found

    def error(self, message: str) -> NoReturn:
        """Say what is wrong with the arguments: a value with a minus looks like an option."""
        option = re.fullmatch(r"argument (?:-\w/)?(--[\w-]+): expected one argument", message)
        if option is not None:
            message += f"; one that begins with a minus is written {option[1]}=-VALUE"
        super().error(message)

    def options_of(self, command: str | None) -> list[str]:
        """The long options of a command, or of the program."""
        parser: argparse.ArgumentParser = self
        for action in self._actions:
            if isinstance(action, argparse._SubParsersAction) and command in action.choices:
                parser = action.choices[command]
        return [o for a in parser._actions for o in a.option_strings if o.startswith("--")]

    def _check_value(self, action: argparse.Action, value: Any) -> None:
        choices = None if action.choices is None else [str(c) for c in action.choices]
        if choices is not None and value not in action.choices:  # type: ignore[operator]
            names = ", ".join(choices)
            raise argparse.ArgumentError(
                action,
                f"invalid choice: {value!r}{meant([str(value)], choices)} (choose from {names})",
            )


def meant(given: Iterable[str], known: Sequence[str]) -> str:
    """A question with the nearest names; empty without any."""
    near = [difflib.get_close_matches(g.split("=")[0], known, n=1, cutoff=0.6) for g in given]
    names = [name for some in near for name in some]
    return f"; did you mean {' '.join(names)}?" if names else ""


GROUP = "sewfast.commands"
"""Entry points of plug-ins: the name of a command, and a function that adds it."""


def build_parser(given: Sequence[str] = ()) -> argparse.ArgumentParser:
    """The parser of the command line; a parsed command has its function as `command`.
    `given` are the arguments that it is to parse. If they begin with a command of the package, no
    plug-in is looked for: that takes longer than all the rest.
    """
    parser = Parser(prog="sewfast", description=DESCRIPTION, epilog=EPILOG, formatter_class=Help)
    parser.add_argument("--version", action=_Version, help="print the version and exit")
    commands: Commands = parser.add_subparsers(  # type: ignore[assignment]
        title="commands", metavar="COMMAND", dest="name"
    )
    # in the order of the help
    makers = (
        project.add,
        commission.add,
        commission.add_report,
        recording.add,
        recording.add_files,
        data.add_look,
        identify.add_orders,
        identify.add,
        identify.add_models,
        check.add,
        check.add_compare,
        gains.add,
        tune.add,
        control.add,
        moves.add_profile,
        moves.add_plan,
        moves.add_learn,
        check.add_analyse,
        machine.add,
        machine.add_physics,
        drive.add_ports,
        drive.add_doctor,
        drive.add,
        drive.add_device,
        add_completion,
    )
    for add in makers:
        add(commands)
    asked = given[1:2] if given[:1] == ["help"] else given[:1]
    if not {*commands.choices, "--version"} & {*asked}:
        _add_plugins(commands, asked)
    return parser


def _add_plugins(commands: Commands, asked: Sequence[str]) -> None:
    """Add the commands of plug-ins behind the package's own: the one asked for, else all, by name.
    One that cannot be added gets a line on standard error; the others work.
    """
    points = [p for p in plugins.points(GROUP) if p.name not in commands.choices]
    points = [p for p in points if p.name in asked] or points
    for name in dict.fromkeys(p.name for p in points):
        place, task = f"command {name}", "that adds it"
        try:
            point = plugins.only(tuple(p for p in points if p.name == name), place, task)
            # what a package prints must not get into output that other programs read
            with contextlib.redirect_stdout(sys.stderr):
                _add_plugin(commands, point, place, task)
        except SewfastError as e:
            print(f"sewfast: {e}", file=sys.stderr)
    wanted = [name for name in asked if not name.startswith("-") and name not in commands.choices]
    if wanted and not plugins.are_registered(GROUP):
        print(f"sewfast: {plugins.UNREGISTERED}", file=sys.stderr)


def _add_plugin(commands: Commands, point: EntryPoint, place: str, task: str) -> None:
    add = plugins.function(point, place, task)
    before = set(commands.choices)
    try:
        add(commands)
        received = "" if point.name in commands.choices else "no such command"
    except (Exception, SystemExit) as e:
        # a function of another package can raise anything
        received = plugins.told(e)
    if received:
        added = set(commands.choices) - before
        for name in added:
            del commands.choices[name]
        shown = commands._choices_actions
        shown[:] = [action for action in shown if action.dest not in added]
        raise plugins.unusable(point, place, task, received)


class _Version(argparse.Action):
    """Prints the version, which is in the compiled module that `--help` need not load."""

    def __init__(self, option_strings: list[str], dest: str, help: str | None = None) -> None:
        super().__init__(option_strings, dest=argparse.SUPPRESS, nargs=0, help=help)

    def __call__(self, parser: argparse.ArgumentParser, *_: object) -> None:
        from .. import __version__

        print(f"sewfast {__version__}")
        parser.exit(0)


# --- `sewfast completion`: commands, options and files by the Tab key -----------------------------


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
"""Matches the metavar of an argument that is or can be a file."""


def add_completion(commands: Commands) -> None:
    parser = add_command(
        commands, "completion", completion_command,
        summary="completion for a shell", text=COMPLETION, examples=EXAMPLES,
    )  # fmt: skip
    parser.add_argument("shell", choices=("bash", "zsh", "tcsh"), help="for which shell")


def completion_command(args: argparse.Namespace) -> None:
    try:
        import shtab
    except ImportError as e:
        raise not_installed("shtab", "completion", "sewfast[completion]") from e

    parser = build_parser()
    _complete_files(parser, shtab.FILE)
    script = shtab.complete(parser, shell=args.shell)
    if args.json:
        print_json({"shell": args.shell, "script": script})
    else:
        print(script)


def _complete_files(parser: argparse.ArgumentParser, files: object) -> None:
    """Complete the file arguments of every command by file names."""
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            for command in action.choices.values():
                _complete_files(command, files)
        elif isinstance(action.metavar, str) and _FILES.search(action.metavar):
            action.complete = files  # type: ignore[attr-defined]
