"""Model files in: versioned JSON -> `Model`."""

from __future__ import annotations

import os
from collections.abc import Mapping
from typing import Any, TypeAlias

from .. import jsonfile
from ..errors import ModelFileError, SewfastError
from .base import FORMAT, VERSION, Model
from .fields import Fields
from .linear import ARX, IV, LinearOE
from .neural import NeuralOE
from .neural_ss import NeuralSS

_Kind: TypeAlias = type[ARX] | type[IV] | type[LinearOE] | type[NeuralOE] | type[NeuralSS]
_KINDS: dict[str, _Kind] = {c.kind: c for c in (ARX, IV, LinearOE, NeuralOE, NeuralSS)}
_FIELDS = ("version", "kind", "Ts", "inputs", "output", "counts", "parameters", "training")


def load_model(path: str | os.PathLike[str]) -> Model:
    """Read a model that `Model.save` wrote; nothing in the file is executed.

    Parameters
    ----------
    path : path

    Returns
    -------
    Model
        Equal to the saved one in every bit.

    Raises
    ------
    ModelFileError
        Where the file is missing, damaged, of another format, or of an unknown version or kind;
        the message names the file and the field.
    """
    return _read(Fields(os.fspath(path), jsonfile.read(path, FORMAT, (VERSION,))))


def from_dict(values: dict[str, Any]) -> Model:
    """The model that `Model.to_dict` gave these values."""
    return _read(Fields("model", {"version": VERSION} | values))


def _read(fields: Fields) -> Model:
    fields.require_only(_FIELDS)
    kind = fields.text("kind")
    if kind not in _KINDS:
        raise fields.refuse("kind", f"one of {', '.join(_KINDS)}", kind)
    return _model(fields, _KINDS[kind])


def _model(fields: Fields, cls: _Kind) -> Model:
    inputs, output = fields.objects("inputs"), fields.object("output")
    if not inputs:
        raise fields.refuse("inputs", "at least one input", [])
    core = _core(fields.object("parameters"), cls)
    _require_width(fields, core, len(inputs))
    return cls(
        core,
        fields.positive("Ts"),
        tuple(i.text("name") for i in inputs),
        output.text("name"),
        tuple(i.text("unit") for i in inputs),
        output.text("unit"),
        _counts(fields),
        _training(fields.object("training"), len(inputs)),
    )


def _training(training: Fields, inputs: int) -> Mapping[str, Any]:
    """What is read back later must have its form; the rest is the trainer's own record."""
    known = training.values
    if "input_range" in known and training.matrix("input_range").shape != (inputs, 2):
        raise training.refuse("input_range", f"{inputs} pairs of numbers", known["input_range"])
    if "data" in known:
        for source in training.objects("data"):
            source.text("name")
    if "notes" in known:
        training.items("notes")
    return known


def _core(parameters: Fields, cls: _Kind) -> object:
    try:
        return cls.core_from(parameters)
    except ModelFileError:
        raise
    except (SewfastError, ValueError, OverflowError, MemoryError) as e:
        raise ModelFileError(
            f"{parameters.path}: field 'parameters': {e}; the file is damaged or was edited"
        ) from e


def _require_width(fields: Fields, core: object, inputs: int) -> None:
    """Names and parameters must speak of the same number of inputs."""
    parameters = fields.object("parameters")
    width = len(parameters.any("b")) if "b" in parameters.values else parameters.integer("n_inputs")
    if width != inputs:
        raise fields.refuse("inputs", f"{width} inputs, as in the parameters", fields.any("inputs"))


def _counts(fields: Fields) -> tuple[str, float] | None:
    if fields.any("counts") is None:
        return None
    counts = fields.object("counts")
    return counts.text("column"), counts.positive("counts_per_rev")
