"""`Model`: what every identified model is to its user."""

from __future__ import annotations

import os
from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, ClassVar, Protocol

import numpy as np

from .. import jsonfile
from ..dataset import (
    Dataset,
    Experiment,
    FloatArray,
    labelled,
    require_dataset,
    require_same_units,
)
from ..errors import DataError, SettingError, SewfastError
from .choice import choice_lines, verdict_lines

if TYPE_CHECKING:
    from ..evidence import Bands, ReportCard
    from ..validation import Validation

FORMAT = "sewfast.model"
VERSION = 1
INIT = 20
"""Samples that set the initial state, unless told otherwise."""
_STEPS_SHOWN = 4


def require_init(init: int) -> None:
    """A whole number of samples, or a `SettingError`."""
    whole = isinstance(init, (int, np.integer)) and not isinstance(init, bool)
    if not whole or init < 0:
        raise SettingError(f"init: expected a whole number of 0 or more, received {init!r}")


class Core(Protocol):
    """What the compiled models share."""

    def rest_state(self) -> FloatArray: ...
    def simulate(self, u: FloatArray, state: FloatArray) -> FloatArray: ...
    def predict(
        self, u: FloatArray, y: FloatArray, state: FloatArray, horizon: int
    ) -> FloatArray: ...
    def estimate_initial_state(self, u: FloatArray, y: FloatArray) -> FloatArray: ...
    def jacobian(self, u: FloatArray, state: FloatArray) -> tuple[FloatArray, FloatArray]: ...


@dataclass(frozen=True, eq=False, repr=False)
class Model(ABC):
    """A model of one plant, in the units of the data it was identified from.

    Made by `identify` or `load_model`.

    Parameters
    ----------
    core : compiled model
        Its arithmetic; takes part in `sewfast.loop` and `sewfast.tuning` as a plant.
    Ts : float
        Sample time [s].
    input_names, input_units, output_name, output_unit
        As in the data set.
    counts : tuple (column, counts_per_rev) or None
        Set where the output is a speed computed from encoder counts.
    training : mapping
        How it came about: data, settings, cost with its horizon, termination. JSON values only.
    alternatives : tuple of Model
        What `identify` would have chosen next, the best first; not written to the model's file.
    """

    core: Any
    Ts: float
    input_names: tuple[str, ...]
    output_name: str
    input_units: tuple[str, ...]
    output_unit: str
    counts: tuple[str, float] | None = None
    training: Mapping[str, Any] = field(default_factory=dict)
    alternatives: tuple[Model, ...] = ()

    kind: ClassVar[str]
    title: ClassVar[str]

    @property
    @abstractmethod
    def orders(self) -> dict[str, int]:
        """`na`, `nb`, `nk` and whatever else sizes the model."""

    @abstractmethod
    def parameters(self) -> dict[str, Any]:
        """Everything that the compiled model is made from, as JSON values."""

    @abstractmethod
    def describe(self) -> list[str]:
        """Lines about the model itself, for `str`."""

    @property
    def members(self) -> tuple[Model, ...]:
        """The models that an ensemble consists of; a single model has none."""
        return ()

    @property
    def columns(self) -> dict[str, Any]:
        """Arguments for `read` that name this model's columns in another recording."""
        column, per_rev = self.counts or (None, None)
        return {
            "inputs": self.input_names,
            "output": self.output_name,
            "counts": column,
            "counts_per_rev": per_rev,
        }

    def simulate(self, data: Dataset, *, init: int = INIT) -> list[FloatArray]:
        """Free run: from the inputs and the initial state alone.

        Parameters
        ----------
        data : Dataset
            Inputs are complete; outputs may be NaN, and are not looked at after the initial ones.
        init : int
            The initial state is estimated from this many measured outputs, the first ones; 0 starts
            from rest.

        Returns
        -------
        list of array, shape (N,)
            One per experiment, in the output's unit, from the first sample on.

        Raises
        ------
        DataError
            Where the data do not fit the model: inputs, sample time, values that are not finite.
        FitError
            Where the model is unstable on this input.
        """
        self._require_match(data)
        try:
            return [self.core.simulate(e.u, self.initial_state(e, init)) for e in data.experiments]
        except SewfastError:
            # the core looks at every input, too, but does not know where it came from
            data.require_inputs()
            raise

    def predict(self, data: Dataset, horizon: int = 1, *, init: int = INIT) -> list[FloatArray]:
        """Outputs `horizon` steps ahead of the measured ones.

        Parameters
        ----------
        data : Dataset
            Inputs are complete. In the place of an output that was not measured (NaN) stands the
            model's own prediction of it.
        horizon : int
            1 is one-step prediction.
        init : int
            As for `simulate`; it matters for the first samples only.

        Returns
        -------
        list of array, shape (N,)
            One per experiment, in the output's unit.

        Raises
        ------
        DataError, SettingError, FitError
            As for `simulate`; a horizon below 1.
        """
        if horizon < 1:
            raise SettingError(f"horizon: expected 1 step or more, received {horizon}")
        self._require_match(data)
        data.require_measured(0)
        return [
            self.core.predict(e.u, e.y, self.initial_state(e, init), horizon)
            for e in data.experiments
        ]

    def validate(
        self, data: Dataset, *, init: int = INIT, against: str | None = None
    ) -> Validation:
        """Free-run and one-step errors on data; see `sewfast.validation.validate`."""
        from ..validation import validate

        return validate(self, data, init=init, against=against)

    def check(
        self, data: Dataset, training: Dataset | None = None, *, init: int = INIT
    ) -> ReportCard:
        """Whether the model can be trusted on these data; see `sewfast.evidence.check`."""
        from ..evidence import check

        return check(self, data, training=training, init=init)

    def bands(self, data: Dataset, level: float = 0.95, *, init: int = INIT) -> Bands:
        """Where measured samples are to be expected; see `sewfast.evidence.bands`."""
        from ..evidence import bands

        return bands(self, data, level, init=init)

    def initial_state(self, experiment: Experiment, init: int) -> FloatArray:
        """What a run over an experiment starts from, by its first `init` measured outputs.

        Past outputs y(-1), y(-2), .. of a lagged model, the states of a state-space model. Where
        some of the first outputs are missing, more samples are looked at.
        """
        require_init(init)
        if init == 0:
            rest: FloatArray = self.core.rest_state()
            return rest
        first = experiment.initial_samples(init)
        state: FloatArray = self.core.estimate_initial_state(
            experiment.u[:first], experiment.y[:first]
        )
        return state

    def _require_match(self, data: Dataset) -> None:
        if not isinstance(data, Dataset):
            require_dataset(data, "data")
        if data.n_inputs != len(self.input_names):
            raise DataError(
                f"{data.source}: expected {len(self.input_names)} inputs "
                f"({', '.join(self.input_names)}), received {data.n_inputs}"
            )
        if abs(data.Ts - self.Ts) > 0.01 * self.Ts:
            raise DataError(
                f"{data.source}: the model was identified at Ts = {self.Ts:g} s, the data have "
                f"{data.Ts:g} s; resample the data or identify again"
            )
        require_same_units(self, data)

    def to_dict(self) -> dict[str, Any]:
        """The model as JSON values, as in its file."""
        inputs = zip(self.input_names, self.input_units, strict=True)
        column, per_rev = self.counts or (None, None)
        return {
            "kind": self.kind,
            "Ts": self.Ts,
            "inputs": [{"name": name, "unit": unit} for name, unit in inputs],
            "output": {"name": self.output_name, "unit": self.output_unit},
            "counts": self.counts and {"column": column, "counts_per_rev": per_rev},
            "parameters": self.parameters(),
            "training": dict(self.training),
        }

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the model as versioned JSON, whole or not at all; `load_model` reads it.

        Raises
        ------
        ModelFileError
            Where the file cannot be written.
        """
        jsonfile.write(path, FORMAT, VERSION, self.to_dict())

    def __reduce__(self) -> tuple[Any, ...]:
        # the compiled model is made again from its numbers, as when a file is read
        from .files import restored

        return restored, (self.to_dict(), self.alternatives)

    def __repr__(self) -> str:
        orders = ", ".join(f"{k}={v}" for k, v in self.orders.items())
        return f"{type(self).__name__}({orders}, Ts={self.Ts:g} s, {self.signature})"

    @property
    def signature(self) -> str:
        """`u [V] -> y [RPM]`."""
        inputs = ", ".join(map(labelled, self.input_names, self.input_units))
        return f"{inputs} -> {labelled(self.output_name, self.output_unit)}"

    def __str__(self) -> str:
        orders = ", ".join(f"{k} = {v}" for k, v in self.orders.items())
        lines = [f"{self.title}: {self.signature}", f"{orders}, Ts = {self.Ts:g} s"]
        return "\n".join([*lines, *self.describe(), *self._story()])

    def _story(self) -> list[str]:
        t = self.training
        if not t:
            return []
        names = ", ".join(dict.fromkeys(d["name"] for d in t.get("data", [])))
        lines = [f"trained on {t.get('samples')} samples of {names}"]
        if t.get("termination"):
            count = t.get("iterations")
            steps = "" if count is None else f"{count} iterations, "
            lines[0] += f"; {steps}{t['termination']}"
        prepared = [f"prepared: {note}" for note in t.get("preparation", [])]
        if len(prepared) > _STEPS_SHOWN:
            prepared[_STEPS_SHOWN:] = [f"prepared: and {len(prepared) - _STEPS_SHOWN} more"]
        lines += prepared
        lines += choice_lines(t, self.output_unit)
        lines += [str(note) for note in t.get("notes", [])]
        return lines + verdict_lines(t)
