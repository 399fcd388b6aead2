"""Reading model files: versioned JSON -> `Model`."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from copy import deepcopy
from dataclasses import replace
from functools import cache
from importlib.resources import files
from typing import Any

from .. import storage
from ..dynamic_model import DynamicModel
from ..errors import ModelFileError, SettingError, SewfastError, located
from ..storage import Fields
from .base import COMBINATIONS, MOST_MEMBERS, Ensemble, Model, SingleModel, StructuredModel
from .grey_box import GreyBox
from .hammerstein import HammersteinWiener
from .linear import ARX, IV, LinearOE
from .neural import NeuralOE, NeuralSS

SCHEMA = f"model-{DynamicModel.VERSION}.json"
SINGLE: tuple[type[SingleModel], ...] = (
    ARX, IV, LinearOE, HammersteinWiener, GreyBox, NeuralOE, NeuralSS,
)  # fmt: skip
"""Every kind of model except the ensemble."""
STRUCTURED = tuple(c for c in SINGLE if issubclass(c, StructuredModel))
"""Kinds with several structures, one of which is chosen on held-out data."""
_KINDS = {c.kind: c for c in SINGLE}
_FIELDS = ("version", "kind", "Ts", "inputs", "output", "counts", "parameters", "training")


def load_model(path: str | os.PathLike[str]) -> Model:
    """Read a model written by `Model.save`; nothing in the file is executed.

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
        If the file is missing, damaged, of another format, or of an unknown version or kind;
        the message names the file and the field.
    """
    stored = storage.read(path, DynamicModel.FORMAT, (DynamicModel.VERSION,))
    model = _read(Fields(os.fspath(path), stored))
    try:
        _ = model.about_rest
    except SettingError as e:
        raise located(ModelFileError, f"{path}: field 'training.rest'", e) from e
    return model


def from_dict(values: dict[str, Any]) -> Model:
    """The model of these values, the inverse of `Model.to_dict`."""
    return _read(Fields("model", {"version": DynamicModel.VERSION} | values))


def restored(values: dict[str, Any], alternatives: tuple[Model, ...]) -> Model:
    """The model of `from_dict` with its alternatives, for unpickling."""
    return replace(from_dict(values), alternatives=alternatives)


def model_schema() -> dict[str, Any]:
    """The JSON schema (draft 2020-12) of the files that `Model.save` writes in this version."""
    return deepcopy(_schema())


@cache
def _schema() -> dict[str, Any]:
    text = files("sewfast").joinpath("schema", SCHEMA).read_text(encoding="utf-8")
    schema: dict[str, Any] = json.loads(text)
    return schema


def _read(fields: Fields) -> Model:
    fields.require_only(_FIELDS)
    if fields.text("kind") == Ensemble.kind:
        return _ensemble(fields)
    return _single(fields, fields)


def _ensemble(fields: Fields) -> Model:
    parameters = fields.object("parameters")
    parameters.require_only(("combine", "members"))
    combine = next((c for c in COMBINATIONS if c == parameters.text("combine")), None)
    if combine is None:
        raise parameters.refuse("combine", " or ".join(COMBINATIONS), parameters.any("combine"))
    listed = parameters.items("members")
    if not 1 <= len(listed) <= MOST_MEMBERS:
        raise parameters.refuse("members", f"1 to {MOST_MEMBERS} models", len(listed))
    members = [_single(fields, m) for m in parameters.objects("members")]
    training = _training(fields.object("training"), len(members[0].input_names))
    return Ensemble.of(members, combine, training)


def _single(fields: Fields, own: Fields) -> Model:
    """A model with the file's names and units, and its own kind, parameters and training."""
    kind = own.text("kind")
    if kind not in _KINDS:
        known = (*_KINDS, Ensemble.kind) if own is fields else tuple(_KINDS)
        raise own.refuse("kind", f"one of {', '.join(known)}", kind)
    inputs, output = fields.objects("inputs"), fields.object("output")
    if not inputs:
        raise fields.refuse("inputs", "at least one input", [])
    parameters = own.object("parameters")
    core = _core(parameters, _KINDS[kind])
    _require_width(fields, parameters, len(inputs))
    return _KINDS[kind](
        core,
        fields.positive("Ts"),
        tuple(i.text("name") for i in inputs),
        output.text("name"),
        tuple(i.text("unit") for i in inputs),
        output.text("unit"),
        _counts(fields),
        _training(own.object("training"), len(inputs)),
    )


def _training(training: Fields, inputs: int) -> Mapping[str, Any]:
    """Provenance; entries of the schema, which are used later, are checked, the rest is kept."""
    known = training.values
    training.conform(_schema()["$defs"]["training"])
    if "input_range" in known:
        ranges = training.matrix("input_range")
        if ranges.shape != (inputs, 2) or (ranges[:, 0] > ranges[:, 1]).any():
            expected = f"{inputs} pairs of numbers, the lower one first"
            raise training.refuse("input_range", expected, known["input_range"])
    if "rest" in known:
        rest = known["rest"]["u"]
        if len(rest) != inputs:
            raise training.refuse("rest.u", f"{inputs} inputs at rest", rest)
    return known


def _core(parameters: Fields, cls: type[SingleModel]) -> object:
    try:
        return cls.core_from(parameters)
    except ModelFileError:
        raise
    except (SewfastError, ValueError, OverflowError, MemoryError) as e:
        raise located(ModelFileError, f"{parameters.path}: field 'parameters'", e) from e


def _require_width(fields: Fields, parameters: Fields, inputs: int) -> None:
    """Require the same number of inputs in names and parameters."""
    width = len(parameters.any("b")) if "b" in parameters.values else parameters.integer("n_inputs")
    if width != inputs:
        raise fields.refuse("inputs", f"{width} inputs, as in the parameters", fields.any("inputs"))


def _counts(fields: Fields) -> tuple[str, float] | None:
    if fields.any("counts") is None:
        return None
    counts = fields.object("counts")
    return counts.text("column"), counts.positive("counts_per_rev")
