"""Files of controllers and of tables of moves: `load_controller`, `load_table`; the kinds."""

from __future__ import annotations

import os

from .. import storage
from ..errors import ModelFileError, SewfastError, located
from ..storage import Fields
from .controller import Controller, SampledController
from .move import COLUMNS, MoveTable, Repetition
from .position import PositionController
from .state_feedback import StateFeedback

KINDS: dict[str, type[SampledController]] = {
    kind.KIND: kind for kind in (Controller, StateFeedback, PositionController)
}
"""The kinds by name. A file of versions 1 to 3 has no kind and is a PID."""


def load_controller(path: str | os.PathLike[str]) -> SampledController:
    """Read a controller of any kind that `save` wrote; nothing in the file is executed.

    Raises
    ------
    ModelFileError
        If the file is missing, damaged, of another format or of an unknown version, or holds a
        setting outside its range; the message names the file and the field.
    """
    fields = Fields(os.fspath(path), storage.read(path, Controller.FORMAT, (1, 2, 3, 4, 5)))
    try:
        return read_controller(fields)
    except ModelFileError:
        raise
    except SewfastError as error:
        raise located(ModelFileError, path, error) from error


def read_controller(fields: Fields) -> SampledController:
    """The controller of any kind in a file or a part of one."""
    kind = fields.text("kind") if fields.integer("version") > 3 else Controller.KIND
    if kind not in KINDS:
        raise fields.refuse("kind", ", ".join(KINDS), kind)
    return KINDS[kind].read(fields)


def load_pid(path: str | os.PathLike[str]) -> Controller:
    """`load_controller` for code that supports only PIDs; another kind is a `ModelFileError`."""
    found = load_controller(path)
    if not isinstance(found, Controller):
        raise ModelFileError(
            name=os.fspath(path), expected="a PID", received=f"a controller of kind {found.KIND}",
            remedy="this is for PIDs only; run the other kinds on a model or a drive (sewfast run)",
        )  # fmt: skip
    return found


def load_table(path: str | os.PathLike[str]) -> MoveTable:
    """Read a table that `MoveTable.save` wrote; nothing in the file is executed.

    Raises
    ------
    ModelFileError
        If the file is missing, damaged, of another format or of an unknown version, or holds a
        setting outside its range; the message names the file and the field.
    """
    fields = Fields(os.fspath(path), storage.read(path, MoveTable.FORMAT, (MoveTable.VERSION,)))
    fields.require_only(
        ("version", "name", "controller", "errors", "limited", *COLUMNS, "correction",
         "repetitions")
    )  # fmt: skip
    columns = {name: fields.vector(name) for name in COLUMNS}
    lengths = {len(column) for column in columns.values()}
    if len(lengths) != 1 or 0 in lengths:
        raise fields.refuse("setpoint", "as many samples as the reference, at least one", lengths)
    errors = fields.objects("errors")
    for part in errors:
        part.require_only(("without", "with"))
    try:
        controller = read_controller(fields.object("controller"))
        return MoveTable(
            **columns,
            controller=controller,
            name=fields.text("name"),
            errors=tuple((part.number("without"), part.number("with")) for part in errors),
            limited=fields.number("limited"),
            correction=fields.vector("correction"),
            repetitions=tuple(map(Repetition.read, fields.objects("repetitions"))),
        )
    except ModelFileError:
        raise
    except SewfastError as error:
        raise located(ModelFileError, path, error) from error
