"""Controller files: `load_controller`, and the table of the kinds."""

from __future__ import annotations

import os

from .. import storage
from ..errors import ModelFileError, SewfastError, located
from ..storage import Fields
from .controller import FORMAT, Controller, SampledController
from .state_feedback import StateFeedback

KINDS: dict[str, type[SampledController]] = {
    kind.KIND: kind for kind in (Controller, StateFeedback)
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
    fields = Fields(os.fspath(path), storage.read(path, FORMAT, (1, 2, 3, 4, 5)))
    kind = fields.text("kind") if fields.integer("version") > 3 else Controller.KIND
    if kind not in KINDS:
        raise fields.refuse("kind", ", ".join(KINDS), kind)
    try:
        return KINDS[kind].read(fields)
    except ModelFileError:
        raise
    except SewfastError as error:
        raise located(ModelFileError, path, error) from error


def load_pid(path: str | os.PathLike[str]) -> Controller:
    """`load_controller` for code that supports only PIDs; another kind is a `ModelFileError`."""
    found = load_controller(path)
    if not isinstance(found, Controller):
        raise ModelFileError(
            name=os.fspath(path), expected="a PID", received=f"a controller of kind {found.KIND}",
            remedy="this is for PIDs only; run the other kinds on a model or a drive (sewfast run)",
        )  # fmt: skip
    return found
