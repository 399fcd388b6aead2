"""`DynamicModel`: free run, prediction, derivatives and file of a model of any kind."""

from __future__ import annotations

import json
import os
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar, NamedTuple, Protocol, overload

import numpy as np
from numpy.typing import ArrayLike

from . import storage
from .arrays import is_whole
from .dataset import (
    Dataset,
    Experiment,
    FloatArray,
    labelled,
    require_dataset,
    require_same_units,
)
from .dataset.experiment import without_weightless
from .dataset.standing import SIGMAS, standing
from .equilibrium import linearise
from .errors import DataError, SettingError, SewfastError
from .tables import html_of

INIT = 20
"""Default number of samples that determine the initial state."""


class AtRest(NamedTuple):
    """The equilibrium at which an experiment begins: its output, and the state of the model."""

    y: float
    state: FloatArray


class FreeRunJacobian(NamedTuple):
    """A free run and its derivatives, all in the output's unit.
    `y` (N,) is the free run. `theta` (N, p) holds its derivatives by the parameters, in the order
    of `Model.theta` and `Model.parameter_names`, and `state` (N, s) those by the initial state, in
    the order of `Model.state_names`.
    """

    y: FloatArray
    theta: FloatArray
    state: FloatArray


def require_init(init: int) -> None:
    """Raise a `SettingError` unless `init` is a whole number of samples."""
    if not is_whole(init) or init < 0:
        raise SettingError(f"init: expected a whole number of 0 or more, received {init!r}")


def real_numbers(values: ArrayLike, name: str, expected: str) -> FloatArray:
    """A copy as C-contiguous float64; raises a `DataError` for anything but real numbers."""
    try:
        given = np.asarray(values)
        if given.dtype.kind == "c":
            raise TypeError("complex ones")
        return np.array(given, dtype=np.float64, order="C")
    except (TypeError, ValueError) as e:
        raise DataError(name=name, expected=expected, received=str(e)) from e


class Core(Protocol):
    """Common interface of the compiled models."""

    def rest_state(self) -> FloatArray: ...
    def simulate(self, u: FloatArray, state: FloatArray) -> FloatArray: ...
    def predict(
        self, u: FloatArray, y: FloatArray, state: FloatArray, horizon: int
    ) -> FloatArray: ...
    def estimate_initial_state(self, u: FloatArray, y: FloatArray) -> FloatArray: ...
    def jacobian(self, u: FloatArray, state: FloatArray) -> tuple[FloatArray, FloatArray]: ...


@dataclass(frozen=True, eq=False, repr=False)
class DynamicModel(ABC, storage.Stored):
    """A model of one plant that can run, in the units of the data it was identified from.

    The interface for validation and evidence; users have a `sewfast.Model`, which builds on them
    and documents the parameters.
    """

    FORMAT: ClassVar[str] = "sewfast.model"
    VERSION: ClassVar[int] = 1

    core: Any
    Ts: float
    input_names: tuple[str, ...]
    output_name: str
    input_units: tuple[str, ...]
    output_unit: str
    counts: tuple[str, float] | None = None
    training: Mapping[str, Any] = field(default_factory=dict)
    alternatives: tuple[DynamicModel, ...] = ()

    kind: ClassVar[str]
    title: ClassVar[str]

    @property
    @abstractmethod
    def orders(self) -> dict[str, int]:
        """`na`, `nb`, `nk` and other sizes of the model."""

    @abstractmethod
    def parameters(self) -> dict[str, Any]:
        """All parameters of the compiled model, as JSON values."""

    @abstractmethod
    def describe(self) -> list[str]:
        """Lines about the model itself, for `str`."""

    @property
    @abstractmethod
    def theta(self) -> FloatArray:
        """All parameters as one vector, shape (p,), in the order of docs/CONVENTIONS.md, Models.

        Those of a network are in its scaled units.
        """

    @property
    @abstractmethod
    def parameter_names(self) -> tuple[str, ...]:
        """One name for each entry of `theta`; indices count from 0, those of a_i and b_i from 1."""

    @property
    def state_names(self) -> tuple[str, ...]:
        """One name for each entry of an initial state: past outputs, the newest first, or states.

        Past outputs are in the output's unit, states of a state-space model in scaled units.
        """
        na = self.orders.get("na")
        if na is not None:
            return tuple(f"{self.output_name}(-{i + 1})" for i in range(na))
        return tuple(f"x[{i}]" for i in range(self.orders["nx"]))

    @property
    def members(self) -> tuple[DynamicModel, ...]:
        """The members of an ensemble; empty for a single model."""
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

    @overload
    def simulate(self, data: Dataset, *, init: int = INIT) -> list[FloatArray]: ...
    @overload
    def simulate(
        self, data: ArrayLike, *, initial_state: ArrayLike | None = None
    ) -> FloatArray: ...

    def simulate(
        self,
        data: Dataset | ArrayLike,
        *,
        init: int = INIT,
        initial_state: ArrayLike | None = None,
    ) -> list[FloatArray] | FloatArray:
        """Free run: from the inputs and the initial state alone.

        Parameters
        ----------
        data : Dataset or array, shape (N,) or (N, n_inputs)
            Inputs must be complete; outputs of a data set can be NaN, and are not used after the
            initial ones. An array has only inputs, in the model's units and at its sample time.
        init : int
            The initial state is estimated from the first `init` measured outputs; 0 starts from
            rest.
        initial_state : array, shape (s,), optional
            Initial state of a run on an array, as listed in `state_names`. By default rest.

        Returns
        -------
        list of array, shape (N,), or array, shape (N,)
            In the output's unit, from the first sample on: one run per experiment of a data set, or
            the run on an array.

        Raises
        ------
        DataError
            If the data do not match the model: inputs, sample time, shapes, values that are not
            finite.
        SettingError
            For an initial state together with a data set, whose outputs determine it.
        FitError
            If the model is unstable on this input.

        Examples
        --------
        >>> import numpy as np
        >>> import sewfast
        >>> model = sewfast.LinearOE.from_tf([0.0, 0.5], [1.0, -0.5], Ts=0.01)
        >>> model.simulate(np.ones(4))
        array([0.5  , 0.75 , 0.875, 0.9375])

        Inputs before the first sample count as equal to it.
        """
        if not isinstance(data, Dataset):
            return self._simulate_array(data, initial_state)
        _require_no_state(initial_state)
        self._require_match(data)
        try:
            return [self.core.simulate(e.u, self.initial_state(e, init)) for e in data.experiments]
        except SewfastError:
            # the core checks every input, too, but cannot name its origin
            data.require_inputs()
            raise

    def _simulate_array(self, u: ArrayLike, initial_state: ArrayLike | None) -> FloatArray:
        run: FloatArray = self.core.simulate(self._inputs(u), self._state(initial_state))
        return run

    @overload
    def jacobian(self, data: Dataset, *, init: int = INIT) -> list[FreeRunJacobian]: ...
    @overload
    def jacobian(
        self, data: ArrayLike, *, initial_state: ArrayLike | None = None
    ) -> FreeRunJacobian: ...

    def jacobian(
        self,
        data: Dataset | ArrayLike,
        *,
        init: int = INIT,
        initial_state: ArrayLike | None = None,
    ) -> list[FreeRunJacobian] | FreeRunJacobian:
        """Free run and its derivatives by every parameter and by the initial state.

        The sensitivities are simulated together with the model and exact; training, standard errors
        and bands use the same ones. An estimated initial state counts as given.

        Parameters
        ----------
        data, init, initial_state
            As for `simulate`.

        Returns
        -------
        FreeRunJacobian or list of it, one per experiment
            `y` (N,), `theta` (N, p) and `state` (N, s); `parameter_names` and `state_names` name
            the columns. The median of an ensemble has the derivatives of the member in the middle
            at each sample; parameters of the others have 0 there.

        Raises
        ------
        DataError, SettingError, FitError
            As for `simulate`; for an ensemble also if any member is unstable on this input.
        """
        if not isinstance(data, Dataset):
            return self._jacobian(self._inputs(data), self._state(initial_state))
        _require_no_state(initial_state)
        self._require_match(data)
        data.require_inputs()
        return [self._jacobian(e.u, self.initial_state(e, init)) for e in data.experiments]

    def _jacobian(self, u: FloatArray, state: FloatArray) -> FreeRunJacobian:
        y, rows = self.core.jacobian(u, state)
        split = rows.shape[1] - len(state)
        return FreeRunJacobian(y, rows[:, :split], rows[:, split:])

    def predict(self, data: Dataset, horizon: int = 1, *, init: int = INIT) -> list[FloatArray]:
        """Outputs `horizon` steps ahead of the measured ones.

        Parameters
        ----------
        data : Dataset
            Inputs must be complete. An output that was not measured (NaN, or of weight 0) is
            replaced by the model's prediction of it.
        horizon : int
            1 is one-step prediction.
        init : int
            As for `simulate`; it only affects the first samples.

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
            for e in map(without_weightless, data.experiments)
        ]

    def initial_state(self, experiment: Experiment, init: int) -> FloatArray:
        """The initial state of a run over an experiment, from its first `init` measured outputs.

        Past outputs y(-1), y(-2), .. of a lagged model, or the states of a state-space model. If
        some of the first outputs are missing, more samples are used. An experiment that stands
        still at the model's equilibrium and moves within these samples begins there: its response
        must not be taken for a state.
        """
        require_init(init)
        if init == 0:
            return self.rest_state()
        if (experiment.u[:init] != experiment.u[0]).any():
            rest = self.standing(experiment)
            if rest is not None:
                return rest.state
        experiment = without_weightless(experiment)
        first = experiment.initial_samples(init)
        state: FloatArray = self.core.estimate_initial_state(
            experiment.u[:first], experiment.y[:first]
        )
        return state

    def standing(self, experiment: Experiment) -> AtRest | None:
        """The equilibrium at which an experiment stands before its inputs move, if it does."""
        found = standing(experiment)
        if found is None:
            return None
        u, states = np.array(found.u), []
        for model in self.members or (self,):
            small = linearise(model.core, u, level=found.y)
            # an integrator stands at any level, so at the recorded one
            off = abs(small.y - found.y) + abs(small.drift) * len(experiment)
            if not off <= SIGMAS * found.scatter:
                return None
            states.append(small.state)
        return AtRest(found.y, np.concatenate(states))

    def rest_state(self) -> FloatArray:
        """The state of the plant at rest, as listed in `state_names`."""
        rest: FloatArray = self.core.rest_state()
        return rest

    def _inputs(self, values: ArrayLike) -> FloatArray:
        n = len(self.input_names)
        expected = "(N,) or (N, 1)" if n == 1 else f"(N, {n})"
        if values is None or isinstance(values, (str, os.PathLike)):
            raise DataError(
                name="data", expected=f"a Dataset, or an array of inputs of shape {expected}",
                received=type(values).__name__,
                remedy="make a Dataset with sewfast.read or Dataset.from_arrays",
            )  # fmt: skip
        u = real_numbers(values, "u", f"numbers of shape {expected}")
        shape = u.shape
        if u.ndim == 1 and n == 1:
            u = u[:, None]
        if u.ndim != 2 or u.shape[1] != n or len(u) == 0:
            raise DataError(
                f"u: expected shape {expected} for {', '.join(self.input_names)}, received "
                f"{shape}; time comes first"
            )
        unknown = np.flatnonzero(~np.isfinite(u).all(axis=1))
        if len(unknown):
            raise DataError(
                f"u: expected finite inputs, received {u[unknown[0]].tolist()} at sample "
                f"{unknown[0]}; fill it first"
            )
        return u

    def _state(self, values: ArrayLike | None) -> FloatArray:
        """An initial state for the core; None is rest."""
        rest = self.rest_state()
        if values is None:
            return rest
        state = real_numbers(values, "initial_state", f"numbers of shape {rest.shape}")
        if state.shape != rest.shape:
            raise DataError(
                f"initial_state: expected shape {rest.shape}, one value for each of "
                f"{', '.join(self.state_names)}; received {state.shape}"
            )
        if not np.isfinite(state).all():
            raise DataError(f"initial_state: expected finite values, received {state.tolist()}")
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
                name=str(data.source), expected=f"the model's sample time, Ts = {self.Ts:g} s",
                received=f"{data.Ts:g} s", remedy="resample the data or identify again",
            )  # fmt: skip
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

    def __eq__(self, other: object) -> bool:
        """Whether both have the same kind, numbers, names, units and provenance, as in a file."""
        if not isinstance(other, DynamicModel):
            return NotImplemented
        return self is other or (type(self) is type(other) and self._text() == other._text())

    def __hash__(self) -> int:
        return hash((self.kind, self.Ts, self.input_names, self.output_name, self.theta.tobytes()))

    def _text(self) -> str:
        return json.dumps(self.to_dict(), sort_keys=True, default=repr)

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

    def _repr_html_(self) -> str:
        first, *lines = str(self).splitlines()
        return html_of("\n".join([first, f"orders: {lines[0]}", *lines[1:]]))

    def _story(self) -> list[str]:
        steps_shown = 4
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
        if len(prepared) > steps_shown:
            prepared[steps_shown:] = [f"prepared: and {len(prepared) - steps_shown} more"]
        lines += prepared
        lines += choice_lines(t, self.output_unit)
        lines += [str(note) for note in t.get("notes", [])]
        return lines + verdict_lines(t)


def _require_no_state(initial_state: ArrayLike | None) -> None:
    if initial_state is not None:
        raise SettingError(
            "initial_state: expected with an array of inputs, received with a data set, whose "
            "first measured outputs set the state (init)"
        )


# --- The choice of `identify` as a table for `print` ----------------------------------------------


def choice_lines(training: Mapping[str, Any], unit: str) -> list[str]:
    """The candidates with their free-run errors on data not trained on, and the reason."""
    choice = training.get("choice")
    if not isinstance(choice, Mapping):
        return []
    listed = choice.get("candidates")
    listed = listed if isinstance(listed, Sequence) else ()
    candidates = [c for c in listed if isinstance(c, Mapping)][:40]
    lines = _table(candidates, choice, unit) if candidates else []
    return [*lines, f"chosen: {choice.get('chosen')}; {choice.get('reason')}"]


def verdict_lines(training: Mapping[str, Any]) -> list[str]:
    """The verdict in lines: whether it is good enough to tune on, why, and what to do next."""
    verdict = training.get("verdict")
    if not isinstance(verdict, Mapping):
        return []
    return [f"verdict: {verdict.get('text')}", *(f"  {n}" for n in verdict.get("next", ()))]


def _table(
    candidates: Sequence[Mapping[str, Any]], choice: Mapping[str, Any], unit: str
) -> list[str]:
    heading = f"free-run rmse{f' [{unit}]' if unit else ''} on data not trained on:"
    rows = [_row(c, choice) for c in candidates]
    widths = [max(len(r[i]) for r in rows) for i in range(5)]
    padded = (["  ", *(t.ljust(w + 2) for t, w in zip(r, widths, strict=True))] for r in rows)
    return [heading, *("".join(p).rstrip() for p in padded)]


def _row(c: Mapping[str, Any], choice: Mapping[str, Any]) -> tuple[str, ...]:
    """Model, output function, weight decay, error, mark: chosen, or its weight among several."""
    error, weight = _number(c.get("free_run_rmse"), "runs away"), c.get("weight")
    mark = ""
    if isinstance(weight, (int, float)):
        mark = "chosen" if weight == 1.0 else f"{100.0 * weight:.0f} %"
    if c.get("kind") == "oe":
        return (
            f"oe, na = {c.get('na')}, nb = {c.get('nb')}, nk = {c.get('nk')}",
            "",
            "",
            error,
            mark,
        )
    if c.get("kind") == "grey_box":
        beside = f", {c['hidden']} tanh" if c.get("hidden") else ""
        is_chosen = choice.get("chosen") == "grey_box"
        own = mark or ("chosen" if is_chosen else "")
        return f"grey_box, a motor{beside}", "", "", error, own
    orders = ", ".join(f"{k} = {c[k]}" for k in ("nx", "na", "nb") if k in c)
    size = f"{c.get('kind')}, {orders}, {c.get('hidden')} tanh, nk = {c.get('nk')}"
    size += ", integrator" if c.get("integrator") else ""
    decay = f"decay {_number(c.get('weight_decay'), '?')}"
    chosen = choice.get("chosen_structure")
    is_chosen = isinstance(chosen, Mapping) and all(c.get(k) == v for k, v in chosen.items())
    return size, str(c.get("output")), decay, error, mark or ("chosen" if is_chosen else "")


def _number(value: Any, otherwise: str) -> str:
    return f"{value:.4g}" if isinstance(value, (int, float)) else otherwise
