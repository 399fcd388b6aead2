"""`deploy`: a model or a controller as code, in a folder."""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from sewfast.control.controller import Controller, SampledController, pid_of
from sewfast.errors import ModelFileError, SettingError
from sewfast.models import Model
from sewfast.storage import making, replace_files

from . import c99, fmi, onnx, structured_text

TARGETS = ("c99", "st", "fmi", "onnx")
PRECISIONS = ("f32", "f64")

_Writer = Callable[[Model | Controller, str, str], tuple[Mapping[str, str | bytes], list[str]]]
_WRITERS: dict[str, _Writer] = {
    "c99": c99.files,
    "st": structured_text.files,
    "fmi": fmi.files,
    "onnx": onnx.files,
}


@dataclass(frozen=True)
class Deployment:
    """The result of `deploy`.

    Attributes
    ----------
    folder : Path
    files : tuple of str
        Their paths within the folder.
    notes : tuple of str
        Properties and cost of the code, one line each.
    """

    folder: Path
    files: tuple[str, ...]
    notes: tuple[str, ...]

    def __str__(self) -> str:
        listed = "\n".join(f"  {name}" for name in self.files)
        notes = "\n".join(self.notes)
        return f"{notes}\nwritten to {self.folder}\n{listed}"


def deploy(
    what: Model | Controller,
    folder: str | os.PathLike[str],
    *,
    to: str = "c99",
    precision: str | None = None,
    name: str | None = None,
    changeable: bool = False,
) -> Deployment:
    """Write a model or a controller as code.

    Parameters
    ----------
    what : Model or Controller
        Linear models, networks, neural state-space models of one output and ensembles of them; a
        PID in all its forms.
    folder : path
        Created if it does not exist. Files of the same names are replaced, all of them or none.
    to : {"c99", "st", "fmi", "onnx"}
        C99 without heap, libm, recursion or global state; IEC 61131-3 structured text, of a
        controller only; a co-simulation FMU of FMI 3.0, for which a C compiler is needed; ONNX, of
        a model only.
    precision : {"f32", "f64"}, optional
        Precision of the arithmetic: f32 by default, f64 for FMI and ONNX. A microcontroller with
        single precision only in hardware takes about fifty times as long for `f64`.
    name : str, optional
        Prefix of every name in the code; by default `controller` or `model`.
    changeable : bool
        Whether gains and limits of a controller in C can be changed while it runs (`set_gains`,
        `set_limits`), without a bump. Then they are in RAM, not among the constants.

    Returns
    -------
    Deployment

    Raises
    ------
    SettingError
        For another target, precision or name, for a model that single precision would change, and
        for changeable gains of anything but a controller in C with constant gains.
    ModelFileError
        If a file cannot be written; then none is written.
    """
    if isinstance(what, SampledController):
        what = pid_of(what, "deploy")
    if not isinstance(what, Model | Controller):
        raise SettingError(
            name="what", expected="a model or a controller", received=type(what).__name__,
            remedy="load it with sewfast.load_model or sewfast.load_controller",
        )  # fmt: skip
    if to not in TARGETS:
        raise SettingError(name="to", expected=f"one of {', '.join(TARGETS)}", received=repr(to))
    if precision is None:
        precision = "f64" if to in ("fmi", "onnx") else "f32"
    if precision not in PRECISIONS:
        raise SettingError(
            name="precision", expected=" or ".join(PRECISIONS), received=repr(precision)
        )
    if name is None:
        name = "controller" if isinstance(what, Controller) else "model"
    taken = name in c99.KEYWORDS or name.endswith("_test")
    if taken or not re.fullmatch(r"[a-z][a-z0-9_]{0,40}", name):
        raise SettingError(
            name="name",
            expected="lower-case letters, digits and underscores that are not a word of the "
            "language or the name of another file (_test, fmi3)",
            received=repr(name), remedy="for example drive",
        )  # fmt: skip
    writer = _WRITERS[to]
    if changeable:
        _require_changeable(what, to)
        writer = partial(c99.files, changeable=True)
    texts, notes = writer(what, name, precision)
    target = Path(folder)
    _write(target, {target / path: _bytes(content) for path, content in texts.items()})
    return Deployment(target, tuple(texts), tuple(notes))


def _bytes(content: str | bytes) -> bytes:
    return content.encode() if isinstance(content, str) else content


def _write(target: Path, contents: Mapping[Path, bytes]) -> None:
    """Write all files or none: a header next to another controller's source would compile."""
    try:
        if target.exists() and not target.is_dir():
            raise SettingError(
                name="folder", expected="a folder", received=f"the file {target}",
                remedy="name another one",
            )  # fmt: skip
        with ExitStack() as folders:
            for folder in dict.fromkeys(path.parent for path in contents):
                folders.enter_context(making(folder))
            replace_files(contents)
    except SettingError:
        raise
    except (OSError, ValueError) as error:  # a name with the character 0 raises a ValueError
        raise ModelFileError(
            name=str(getattr(error, "filename", None) or target),
            expected="a folder that can be written to",
            received=getattr(error, "strerror", None) or str(error),
            remedy="name another one; nothing was written",
        ) from error


def _require_changeable(what: Model | Controller, to: str) -> None:
    """Raise `SettingError` for anything but a controller in C with constant gains."""
    refused = partial(SettingError, name="changeable", remedy="leave it out")
    if to != "c99":
        raise refused(expected="c99", received=to)
    if not isinstance(what, Controller):
        raise refused(expected="a controller", received="a model")
    if what.schedule:
        raise SettingError(
            name="changeable",
            expected="a controller with constant gains",
            received=f"a schedule of {len(what.schedule)} points",
            remedy="leave it out, or deploy the controller without its schedule",
        )
