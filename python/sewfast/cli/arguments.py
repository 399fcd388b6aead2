"""Arguments that several commands share, and `add_command`."""

from __future__ import annotations

import argparse
import re
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

from ..errors import SettingError

if TYPE_CHECKING:
    from ..live import ViewKind

    Commands: TypeAlias = argparse._SubParsersAction[argparse.ArgumentParser]
else:
    Commands: TypeAlias = object

Command: TypeAlias = Callable[[argparse.Namespace], "int | None"]

TABLES = (".csv", ".npz", ".mat", ".parquet")
RECORDINGS = (*TABLES, ".mcap")


class Help(argparse.RawDescriptionHelpFormatter):
    """A help formatter that keeps line breaks."""


def add_command(
    commands: Commands,
    name: str,
    command: Command,
    *,
    summary: str,
    text: str,
    examples: str,
    options: str = "",
) -> argparse.ArgumentParser:
    """Add a command: a summary for the list, a text above and examples below its options, which
    are those common to all commands and those of its table (`add_options`).
    """
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
        help="log the files read and the time of the work; -vv: the files written, too",
    )  # fmt: skip
    parser.add_argument("--debug", action="store_true", help="show the traceback of a fault")
    parser.set_defaults(command=command, out_of=None)
    add_options(parser, options)
    return parser


def time_left(args: argparse.Namespace) -> float | None:
    """The time budget [s] without what the command has taken so far to read modules and files (many
    seconds beside other work); half of it at least is for the work.
    """
    seconds: float | None = args.time_budget
    # whether a number is a budget is for the work to say
    if seconds is None or not seconds > 0.0:
        return seconds
    gone: float = time.monotonic() - args.began
    return max(seconds - gone, 0.5 * seconds)


def whole(text: str) -> int:
    """The kind of a number of samples."""
    try:
        value = int(text)
    except ValueError:
        value = -1
    if value < 0:
        raise argparse.ArgumentTypeError(
            f"expected a whole number of samples, 0 or more, received {text!r}"
        )
    return value


_KINDS: dict[str, Any] = {"text": str, "float": float, "int": int, "whole": whole, "path": Path}
_ROW = re.compile(
    r"(?P<names>\S+)(?: (?P<metavar>\S+))?\s{2,}(?P<kind>\w+|{.*?})(?P<count>\.\.\.|\?|!)?"
    r"(?:=(?P<default>\S+))?\s{2,}(?P<help>.+)",
    re.DOTALL,
)


def add_options(parser: argparse._ActionsContainer, table: str, **kinds: Any) -> None:
    """Arguments and options from a table with a row each: `--name METAVAR  kind  help`.

    Two spaces or more separate the columns; further lines of a help are indented. A kind is text,
    float, int, whole, path, flag, one of {these,values} or a key of `kinds`, which has a type or a
    list of choices. After it `...` means one or several, `?` none or one, `!` required, and
    `=value` is the default.
    """
    for text in re.findall(r"^\S.*(?:\n .*)*", table, re.MULTILINE):
        row = _ROW.fullmatch(text)
        assert row is not None, text
        names, kind, count = row["names"].split(","), row["kind"], row["count"]
        option: dict[str, Any] = {"help": " ".join(row["help"].split())}
        if kind == "flag":
            option["action"] = "store_true"
        else:
            of = kind[1:-1].split(",") if kind[0] == "{" else {**_KINDS, **kinds}[kind]
            of_one = of if callable(of) else str
            option |= {"metavar": row["metavar"], "type": of_one if of_one is not str else None}
            option["choices"] = None if callable(of) else of
            option["default"] = None if row["default"] is None else of_one(row["default"])
        if names[0][0] != "-":
            option["nargs"] = {"...": "+", "?": "?", None: None}[count]
        elif count == "...":
            option["action"] = "append"
        elif count == "!":
            option["required"] = True
        parser.add_argument(*names, **option)


def add_columns(parser: argparse.ArgumentParser, *, from_model: bool) -> None:
    """Options for input, output and sample time of a recording."""
    parser.set_defaults(columns_of="model" if from_model else "file")
    default = "; default: as stored in the model" if from_model else ""
    parser.add_argument(
        "--input", action="append", metavar="COL",
        help=f"column of the input; repeat it for several inputs{default}",
    )  # fmt: skip
    parser.add_argument("--output", metavar="COL", help=f"column of the output{default}")
    if not from_model:
        parser.add_argument(
            "--joint", metavar="NAME",
            help="of a robot's record: the columns of this joint's command and position",
        )  # fmt: skip
        parser.add_argument(
            "--unit", metavar="UNIT",
            help="for --joint: unit of both, if the file has none (rad, deg, m, mm, counts)",
        )  # fmt: skip
    parser.add_argument(
        "--ts", "--Ts", type=float, metavar="S",
        help="sample time [s]; default: from the time column; even time stamps must agree within "
        "1 %%, uneven ones are resampled to it",
    )  # fmt: skip
    parser.add_argument(
        "--time", metavar="COL", help="column of time, if its name does not show it"
    )
    parser.add_argument(
        "--shift-input", type=int, default=0, metavar="N",
        help="read the inputs N samples earlier, if the command was logged late (0)",
    )  # fmt: skip
    parser.add_argument(
        "--counts", metavar="COL",
        help="column of encoder counts; the output is then the speed [RPM] computed from it",
    )  # fmt: skip
    parser.add_argument(
        "--counts-per-rev",
        type=float,
        metavar="N",
        help="encoder counts per revolution; a recording (.mcap) contains them",
    )


def add_weights(parser: argparse.ArgumentParser) -> None:
    """`--weights`, for the commands that fit or judge samples."""
    parser.add_argument(
        "--weights", metavar="COL",
        help="column of weights of the samples' squared errors; 0 leaves a sample out",
    )  # fmt: skip


def add_view(parser: argparse._ActionsContainer) -> None:
    """`--live`: the view of a running record or run, a `sewfast.live.ViewKind`."""
    parser.add_argument(
        "--live", metavar="KIND", type=_kind, default="auto",
        help="watch it run: terminal, none, plotjuggler[:HOST:PORT], foxglove[:PORT]; auto (the "
        "default) is a status line if standard error is a terminal",
    )  # fmt: skip


def _kind(text: str) -> ViewKind:
    from ..live import ViewKind

    try:
        return ViewKind.parse(text)
    except SettingError as e:
        raise argparse.ArgumentTypeError(str(e)) from e


def add_split(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--split-at-gaps", action="store_true",
        help="use the pieces between missing samples as separate experiments",
    )  # fmt: skip


def add_output(
    parser: argparse.ArgumentParser, metavar: str, help: str, *, required: bool = False
) -> None:
    parser.add_argument("-o", dest="out", metavar=metavar, type=Path, required=required, help=help)


def add_named_output(parser: argparse.ArgumentParser, what: str, source: str, help: str) -> None:
    """An output named after the first file of an argument: `run.csv` -> `run-WHAT.json`. It is in
    the working folder, wherever that file is. The ending `-model` of a model is dropped.
    """

    def named(args: argparse.Namespace) -> Path:
        from ..readers import parse_source

        first, _, _ = parse_source(getattr(args, source)[0])
        return Path(f"{Path(first).stem.removesuffix('-model')}-{what}.json")

    add_output(parser, f"{what.upper()}.json", f"{help}; default: FILE-{what}.json")
    parser.set_defaults(out_of=named)


def add_overwrite(parser: argparse._ActionsContainer) -> None:
    """`--overwrite`, for files that cannot be made again."""
    parser.add_argument(
        "--overwrite", action="store_true",
        help="replace even a recording of a drive, which cannot be made again",
    )  # fmt: skip


def add_plot(parser: argparse._ActionsContainer, what: str) -> None:
    """`--plot FILE`, the same for every command with a figure."""
    parser.add_argument("--plot", metavar="FILE", type=Path, help=f"{what}: PNG, SVG or PDF")


def require_plot(path: Path | None) -> None:
    """Raise `SettingError` before the work if its figure cannot be drawn or written."""
    from ..plotting import FILES, require_matplotlib

    if path is not None:
        require_place(path, FILES, option="--plot")
        require_matplotlib()


def require_place(path: Path | None, suffixes: tuple[str, ...], *, option: str = "-o") -> None:
    """Refuse an output file that cannot be written, before the work."""
    if path is None:
        return
    if path.suffix.lower() not in suffixes:
        raise SettingError(
            name=f"{option} {path}", expected=f"a file ending in {', '.join(suffixes)}",
            received=f"{path.suffix or 'none'!r}",
        )  # fmt: skip
    if not path.parent.is_dir():
        raise SettingError(
            name=f"{option} {path}", expected="a folder that exists", received="none",
            remedy=f"create {path.parent}, or name another one",
        )  # fmt: skip
    if path.is_dir():
        raise SettingError(
            name=f"{option} {path}", expected="a file", received="a folder",
            remedy="name a file in it",
        )  # fmt: skip
    from ..storage import require_writable  # loads NumPy

    require_writable(path)
