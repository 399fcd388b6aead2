"""Arguments that commands share, and the makers of commands."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, TypeAlias

from ..errors import SettingError

if TYPE_CHECKING:
    from ..live import Kind

    Commands: TypeAlias = argparse._SubParsersAction[argparse.ArgumentParser]
else:
    Commands: TypeAlias = object

Command: TypeAlias = Callable[[argparse.Namespace], "int | None"]

TABLES = (".csv", ".npz", ".mat", ".parquet")
RECORDINGS = (*TABLES, ".mcap")


class Help(argparse.RawDescriptionHelpFormatter):
    """Help that keeps its line breaks."""


def add_command(
    commands: Commands, name: str, command: Command, *, summary: str, text: str, examples: str
) -> argparse.ArgumentParser:
    """A command with its help: a line for the list, a text above, examples below the options."""
    parser = commands.add_parser(
        name, help=summary, description=text, epilog=examples, formatter_class=Help
    )
    parser.add_argument("--json", action="store_true", help="print the result as JSON")
    level = parser.add_mutually_exclusive_group()
    level.add_argument(
        "-q", "--quiet", action="store_true", help="no progress and no notes: result and errors"
    )
    level.add_argument(
        "-v", "--verbose", action="count", default=0,
        help="log what is read and what work takes; -vv: what is written, too",
    )  # fmt: skip
    parser.add_argument("--debug", action="store_true", help="show where a fault comes from")
    parser.set_defaults(command=command, out_of=None)
    return parser


def add_columns(parser: argparse.ArgumentParser, *, from_model: bool) -> None:
    """Which columns of a recording are input and output, and how it is sampled."""
    parser.set_defaults(columns_of="model" if from_model else "file")
    default = "; default: as stored in the model" if from_model else ""
    parser.add_argument(
        "--input", action="append", metavar="COL",
        help=f"column of the input; repeat it for several inputs{default}",
    )  # fmt: skip
    parser.add_argument("--output", metavar="COL", help=f"column of the output{default}")
    parser.add_argument(
        "--ts", "--Ts", type=float, metavar="S",
        help="sample time [s]; default: from the time column; even time stamps must agree within "
        "1 %%, uneven ones are resampled to it",
    )  # fmt: skip
    parser.add_argument(
        "--time", metavar="COL", help="column of time, where its name does not say so"
    )
    parser.add_argument(
        "--counts", metavar="COL",
        help="column of encoder counts; the output is then the speed [RPM] computed from it",
    )  # fmt: skip
    parser.add_argument(
        "--counts-per-rev",
        type=float,
        metavar="N",
        help="encoder counts per revolution; a recording (.mcap) states them itself",
    )


def add_weights(parser: argparse.ArgumentParser) -> None:
    """How much each sample counts, for the commands that look at it."""
    parser.add_argument(
        "--weights", metavar="COL",
        help="column of weights: how much the squared error of each sample counts, 0 not at all",
    )  # fmt: skip


def add_view(parser: argparse._ActionsContainer) -> None:
    """How a running record or run is watched: `args.live` is a `sewfast.live.Kind`."""
    parser.add_argument(
        "--live", metavar="KIND", type=_kind, default="auto",
        help="watch it run: terminal, none, plotjuggler[:HOST:PORT], foxglove[:PORT]; auto (the "
        "default) is a status line where standard error is a terminal",
    )  # fmt: skip


def _kind(text: str) -> Kind:
    from ..live import Kind

    try:
        return Kind.parse(text)
    except SettingError as e:
        raise argparse.ArgumentTypeError(str(e)) from e


def add_split(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--split-at-gaps", action="store_true",
        help="take the pieces between samples that are missing as experiments of their own",
    )  # fmt: skip


def add_output(
    parser: argparse.ArgumentParser, metavar: str, help: str, *, required: bool = False
) -> None:
    parser.add_argument("-o", dest="out", metavar=metavar, type=Path, required=required, help=help)


def add_named_output(parser: argparse.ArgumentParser, what: str, source: str, help: str) -> None:
    """An output that is named after the first file of an argument: `run.csv` -> `run-WHAT.json`.

    It lies in the working folder, wherever that file does. A model's own `-model` goes.
    """

    def named(args: argparse.Namespace) -> Path:
        from ..readers import parse_source

        first, _, _ = parse_source(getattr(args, source)[0])
        return Path(f"{Path(first).stem.removesuffix('-model')}-{what}.json")

    add_output(parser, f"{what.upper()}.json", f"{help}; default: FILE-{what}.json")
    parser.set_defaults(out_of=named)


def add_overwrite(parser: argparse._ActionsContainer) -> None:
    """Whether what cannot be had again may be written over."""
    parser.add_argument(
        "--overwrite", action="store_true",
        help="replace even what a drive did, which cannot be had again",
    )  # fmt: skip


def add_plot(parser: argparse._ActionsContainer, what: str) -> None:
    """`--plot FILE`, the same for every command that has something to show."""
    parser.add_argument("--plot", metavar="FILE", type=Path, help=f"{what}: PNG, SVG or PDF")


def require_plot(path: Path | None) -> None:
    """Refuse a figure that could not be drawn or written, before the work is done.

    Raises
    ------
    SettingError
    """
    from ..plotting import FILES, require_matplotlib

    if path is not None:
        require_place(path, FILES, option="--plot")
        require_matplotlib()


def require_place(path: Path | None, suffixes: tuple[str, ...], *, option: str = "-o") -> None:
    """Refuse an output file that could not be written, before the work is done.

    Raises
    ------
    SettingError
        For an extension that stands for no format, or a folder that does not exist.
    """
    if path is None:
        return
    if path.suffix.lower() not in suffixes:
        raise SettingError(
            f"{option} {path}: expected a file ending in {', '.join(suffixes)}, received "
            f"{path.suffix or 'none'!r}"
        )
    if not path.parent.is_dir():
        raise SettingError(
            name=f"{option} {path}", expected="a folder that exists", received="none",
            remedy=f"create {path.parent}",
        )  # fmt: skip
    if path.is_dir():
        raise SettingError(f"{option} {path}: expected a file, received a folder")
