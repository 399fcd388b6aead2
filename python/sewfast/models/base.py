"""`Model`: the interface of every identified model, and `Ensemble`."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, ClassVar, Literal, Protocol, TypeAlias

import numpy as np
from numpy.typing import ArrayLike

from ..dataset import Dataset, FloatArray
from ..dynamic_model import INIT, Core, DynamicModel, FreeRunJacobian, real_numbers
from ..errors import FitError, SettingError
from ..evidence import Bands, OperatingPoint, ReportCard, bands, check, operating_range
from ..storage import Fields
from ..validation import Validation, validate
from .rest import Rest

_OF_LINEAR_MODELS = (
    "dc_gain", "frequency_response", "poles", "steady_output", "to_continuous", "to_control",
    "to_scipy", "to_ss", "to_tf", "transfer_function",
)  # fmt: skip
"""Methods of linear models that other models have only at an operating point."""


class NotLinearError(SettingError, AttributeError):
    """A linear method was called on a model that is not linear."""


@dataclass(frozen=True, eq=False, repr=False)
class Model(DynamicModel):
    """A model of one plant, in the units of the data it was identified from.

    Made by `identify` or `load_model`.

    Parameters
    ----------
    core : compiled model
        The compiled arithmetic; `sewfast.run` and `sewfast.tune` use it as a plant.
    Ts : float
        Sample time [s].
    input_names, input_units, output_name, output_unit
        As in the data set.
    counts : tuple (column, counts_per_rev) or None
        Set if the output is a speed computed from encoder counts.
    training : mapping
        Provenance: data, settings, cost with its horizon, termination. JSON values only.
    alternatives : tuple of Model
        The next choices of `identify`, best first; not written to the model's file.
    """

    alternatives: tuple[Model, ...] = ()

    @property
    def members(self) -> tuple[Model, ...]:
        """The members of an ensemble; empty for a single model."""
        return ()

    @cached_property
    def rest(self) -> Rest:
        """The level at which the plant stands still, as `identify` found it; else zero.

        Free runs from rest, closed loops and default references begin there.
        """
        known = self.training.get("rest")
        if known is None:
            return Rest((0.0,) * len(self.input_names), 0.0)
        return Rest(
            tuple(map(float, known["u"])), float(known["y"]), str(known.get("source", "")),
            bool(known.get("near_zero", False)),
        )  # fmt: skip

    @property
    def noise(self) -> float:
        """Standard deviation of the white noise in the recorded output [y]; 0 if unknown.

        Closed loops on the model measure it, unless they have an encoder.
        """
        return float(self.training.get("noise", 0.0))

    def rest_state(self) -> FloatArray:
        # deviations from rest are zero there, so that past outputs are the level at rest
        state: FloatArray = self.about_rest.rest_state()
        return state + self.rest.y if "na" in self.orders else state

    @cached_property
    def about_rest(self) -> Any:
        """The compiled model of the deviations from rest; at a rest of zero the model itself."""
        return self.about(self.rest)

    @abstractmethod
    def about(self, rest: Rest) -> Any:
        """The compiled model of the deviations of inputs and output from a level.

        Raises
        ------
        SettingError
            For a kind that has a zero of its own: the equations of a motor, an output without sign.
        """

    def linearise(self, u: ArrayLike | None = None) -> OperatingPoint:
        """The linear model about the equilibrium at constant inputs.

        Parameters
        ----------
        u : float or array, shape (n_inputs,), optional
            By default the middle of the training inputs.

        Returns
        -------
        OperatingPoint
            With A, B, C, D, poles, steady gain and `to_control()`; see
            `sewfast.evidence.operating_range` for many points at once.

        Raises
        ------
        SettingError
            For an ensemble; linearise its members instead.
        DataError
            If `u` has not one finite value per input, or is not given and the model does not
            store the range of its training inputs.
        """
        if self.members:
            raise SettingError(
                "linearise: expected a single model, received an ensemble; linearise its members"
            )
        if u is None:
            middle = np.mean(np.atleast_2d(self.training.get("input_range", np.nan)), axis=1)
            given = [np.asarray(middle, dtype=np.float64)]
        else:
            names = ", ".join(self.input_names)
            given = [np.atleast_1d(real_numbers(u, "u", f"a number for each of {names}"))]
        return operating_range(self, given).points[0]

    def validate(
        self, data: Dataset, *, init: int = INIT, against: str | None = None
    ) -> Validation:
        """Free-run and one-step errors on data; see `sewfast.validation.validate`."""
        return validate(self, data, init=init, against=against)

    def check(
        self, data: Dataset, training: Dataset | None = None, *, init: int = INIT
    ) -> ReportCard:
        """Whether the model can be trusted on these data; see `sewfast.evidence.check`."""
        return check(self, data, training=training, init=init)

    def bands(self, data: Dataset, level: float = 0.95, *, init: int = INIT) -> Bands:
        """Bands in which measured samples are expected; see `sewfast.evidence.bands`."""
        return bands(self, data, level, init=init)

    if not TYPE_CHECKING:

        def __getattr__(self, name: str) -> Any:
            if name not in _OF_LINEAR_MODELS:
                raise AttributeError(f"{type(self).__name__!r} object has no attribute {name!r}")
            one = "members[0]." if self.members else ""
            raise NotLinearError(
                f"{name}: expected a linear model, received {self.title}; linearise it about a "
                f"constant input first, as in model.{one}linearise(u).to_control()"
            )

    def __reduce__(self) -> tuple[Any, ...]:
        # the compiled model is rebuilt from its numbers, as when a file is read
        from .files import restored

        return restored, (self.to_dict(), self.alternatives)


class SingleModel(Model):
    """A model of one kind, with the methods for its file and its variations."""

    @staticmethod
    @abstractmethod
    def core_from(fields: Fields) -> Any:
        """The compiled model from the parameters of a file."""

    @abstractmethod
    def with_output_scaled(self, factor: float) -> dict[str, Any]:
        """The parameters that change if the output is scaled by a factor."""

    def with_input_delayed(self, samples: int) -> dict[str, Any]:
        """The parameters that change if the input acts some samples later."""
        return {"nk": self.parameters()["nk"] + samples}

    def with_zero_at(self, u: FloatArray, y: float) -> dict[str, Any] | None:
        """The parameters that change if inputs and output are counted from `u` (nu,) and `y`.

        None for a kind that has a zero of its own.
        """
        return None

    def about(self, rest: Rest) -> Any:
        if rest.is_zero:
            return self.core
        moved = self.with_zero_at(np.array(rest.u), rest.y)
        if moved is None and rest.near_zero:
            return self.core
        if moved is None:
            raise SettingError(
                name="rest", expected=f"zero for {self.title}, which has a zero of its own",
                received=f"input {', '.join(f'{v:g}' for v in rest.u)}, output {rest.y:g}",
                remedy="identify another kind of model",
            )  # fmt: skip
        from .files import from_dict

        return from_dict({**self.to_dict(), "parameters": {**self.parameters(), **moved}}).core


class Fitted(Protocol):
    """A compiled fit: the model, its cost and its termination."""

    @property
    def model(self) -> Any: ...
    @property
    def cost(self) -> float: ...
    @property
    def iterations(self) -> int: ...
    @property
    def termination(self) -> str: ...
    @property
    def trace(self) -> FloatArray: ...


class StructuredModel(SingleModel):
    """A lagged model that is fitted in free run in one of several structures."""

    @staticmethod
    @abstractmethod
    def structures(size: int | None) -> tuple[Mapping[str, int], ...]:
        """Structures to try, the simplest first; with one size if given."""

    @staticmethod
    @abstractmethod
    def fitted(experiments: Any, **settings: Any) -> Fitted:
        """Fit one structure: its entries, `na`, `nb`, `nk`, `max_iterations`, `progress`."""


# --- Ensemble: several models of one plant as one -------------------------------------------------


Combine: TypeAlias = Literal["midmean", "median", "mean"]
COMBINATIONS: tuple[Combine, ...] = ("midmean", "median", "mean")
MOST_MEMBERS = 1000
_OF_ALL_MEMBERS = ("input_range", "output_range", "region", "rest", "noise", "verdict")
"""Entries that a file stores once for all members."""


def kept(combine: str, count: int) -> tuple[int, int]:
    """The outputs that are averaged of so many in their order: the first, and the one after the
    last. A midmean leaves out at least a quarter at each end, and at least one value remains.
    """
    ends = {"mean": 0, "median": (count - 1) // 2, "midmean": min(-(-count // 4), (count - 1) // 2)}
    return ends[combine], count - ends[combine]


@dataclass(frozen=True, eq=False)
class EnsembleCore:
    """The members' arithmetic; the state consists of the members' states in order.
    A member that diverges on an input is left out of that run; the others remain. If fewer than
    half are left, a `FitError` is raised.
    """

    members: tuple[Core, ...]
    combine: Combine

    def rest_state(self) -> FloatArray:
        """Every member at rest."""
        return np.concatenate([m.rest_state() for m in self.members])

    def estimate_initial_state(self, u: FloatArray, y: FloatArray) -> FloatArray:
        """The members' estimates."""
        return np.concatenate([m.estimate_initial_state(u, y) for m in self.members])

    def simulate(self, u: FloatArray, state: FloatArray) -> FloatArray:
        """The members' free runs combined sample by sample, (N,)."""
        return self.combined(self.simulations(u, state))

    def simulations(self, u: FloatArray, state: FloatArray) -> FloatArray:
        """Free runs of the members that do not diverge on this input, (members, N)."""
        return self._runs(state, lambda m, x: m.simulate(u, x))

    def predict(self, u: FloatArray, y: FloatArray, state: FloatArray, horizon: int) -> FloatArray:
        """The members' predictions combined sample by sample, (N,)."""
        return self.combined(self._runs(state, lambda m, x: m.predict(u, y, x, horizon)))

    def jacobian(self, u: FloatArray, state: FloatArray) -> tuple[FloatArray, FloatArray]:
        """The run and its derivatives with respect to all members' parameters and states.
        Columns are member by member. A median has the derivative of the middle member or two.
        """
        found = [m.jacobian(u, x) for m, x in self._with_states(state)]
        runs = np.array([run for run, _ in found])
        weights = self._weights(runs)
        rows = [w[:, None] * rows for w, (_, rows) in zip(weights, found, strict=True)]
        return self.combined(runs), np.hstack(rows)

    def _weights(self, runs: FloatArray) -> FloatArray:
        """Weight of each member at each sample, (members, N)."""
        first, after = kept(self.combine, len(runs))
        rank = runs.argsort(axis=0, kind="stable").argsort(axis=0, kind="stable")
        return ((rank >= first) & (rank < after)) / np.float64(after - first)

    def combined(self, runs: FloatArray) -> FloatArray:
        if self.combine != "mean":
            first, after = kept(self.combine, len(runs))
            runs = np.sort(runs, axis=0)[first:after]
        return np.asarray(np.mean(runs, axis=0), dtype=np.float64)

    def _runs(self, state: FloatArray, run: Callable[[Core, FloatArray], FloatArray]) -> FloatArray:
        found: list[FloatArray] = []
        reason: FitError | None = None
        for member, x in self._with_states(state):
            try:
                found.append(run(member, x))
            except FitError as e:
                reason = e
        # part of the members that must not diverge for the ensemble to have a run
        if len(found) < 0.5 * len(self.members):
            raise FitError(
                f"expected at least half of {len(self.members)} members to stand this input, "
                f"received {len(found)} ({reason}); identify from data that cover it"
            ) from reason
        return np.array(found)

    def _with_states(self, state: FloatArray) -> list[tuple[Core, FloatArray]]:
        sizes = [len(m.rest_state()) for m in self.members]
        pieces = np.split(state, np.cumsum(sizes)[:-1])
        return [(m, np.ascontiguousarray(x)) for m, x in zip(self.members, pieces, strict=True)]


class Ensemble(Model):
    """Models of one plant, combined; a model like any other.

    A closed loop is simulated, and a controller tuned, on its `members`: each is a plant.
    """

    kind: ClassVar[str] = "ensemble"
    title: ClassVar[str] = "Ensemble"
    core: _ModelsCore

    @classmethod
    def of(
        cls,
        members: Sequence[Model],
        combine: Combine = "median",
        training: Mapping[str, Any] | None = None,
    ) -> Ensemble:
        """Combine models of one plant.

        Parameters
        ----------
        members : sequence of Model
            With the same inputs, output and sample time; none of them an ensemble.
        combine : {"median", "midmean", "mean"}
            How to combine the members' runs, sample by sample. A median ignores members that go
            astray on a new input, but follows the majority alone; a midmean, the mean without at
            least a quarter at each end, ignores as many and is still a mean of the others.
        training : mapping, optional
            Provenance of the ensemble.

        Raises
        ------
        SettingError
            If there is no member, or the members are of different plants.
        """
        _require_members(members)
        if combine not in COMBINATIONS:
            expected = ", ".join(COMBINATIONS)
            raise SettingError(f"combine: expected one of {expected}, received {combine!r}")
        first = members[0]
        core = _ModelsCore(tuple(m.core for m in members), combine, tuple(members))
        names = (first.input_names, first.output_name, first.input_units, first.output_unit)
        return cls(core, first.Ts, *names, first.counts, training or {})

    @cached_property
    def members(self) -> tuple[Model, ...]:
        """The models it consists of, with the entries on training data that it stores once."""
        known = {k: self.training[k] for k in _OF_ALL_MEMBERS if k in self.training}
        return tuple(
            m if known.keys() <= m.training.keys() else replace(m, training={**known, **m.training})
            for m in self.core.models
        )

    @property
    def combine(self) -> Combine:
        """`midmean`, `median` or `mean`."""
        return self.core.combine

    @property
    def orders(self) -> dict[str, int]:
        """The orders common to all members, and the number of members."""
        first, *others = (m.orders for m in self.members)
        common = {k: v for k, v in first.items() if all(o.get(k) == v for o in others)}
        return {"members": len(self.members), **common}

    @property
    def theta(self) -> FloatArray:
        """The members' parameters, one member after the other."""
        return np.concatenate([m.theta for m in self.members])

    @property
    def parameter_names(self) -> tuple[str, ...]:
        """The members' parameter names, each with the member's number (from 0)."""
        return tuple(f"{i}: {n}" for i, m in enumerate(self.members) for n in m.parameter_names)

    @property
    def state_names(self) -> tuple[str, ...]:
        """As `parameter_names`."""
        return tuple(f"{i}: {n}" for i, m in enumerate(self.members) for n in m.state_names)

    def _jacobian(self, u: FloatArray, state: FloatArray) -> FreeRunJacobian:
        # the core's columns are member by member, first parameters, then states
        y, rows = self.core.jacobian(u, state)
        theta, states, at = [], [], 0
        for m in self.members:
            p, s = len(m.theta), len(m.core.rest_state())
            theta.append(rows[:, at : at + p])
            states.append(rows[:, at + p : at + p + s])
            at += p + s
        return FreeRunJacobian(y, np.hstack(theta), np.hstack(states))

    def about(self, rest: Rest) -> Any:
        if rest.is_zero:
            return self.core
        return EnsembleCore(tuple(m.about(rest) for m in self.members), self.combine)

    def rest_state(self) -> FloatArray:
        return np.concatenate([m.rest_state() for m in self.members])

    def parameters(self) -> dict[str, Any]:
        members = [
            {"kind": m.kind, "parameters": m.parameters(), "training": dict(m.training)}
            for m in self.core.models
        ]
        return {"combine": self.combine, "members": members}

    def describe(self) -> list[str]:
        counted: dict[str, int] = {}
        for m in self.members:
            counted[m.title] = counted.get(m.title, 0) + 1
        parts = ", ".join(f"{n} x {title}" for title, n in counted.items())
        return [f"{self.combine} of {parts}"]


@dataclass(frozen=True, eq=False)
class _ModelsCore(EnsembleCore):
    """The arithmetic together with its models."""

    models: tuple[Model, ...]


def _require_members(members: Sequence[Model]) -> None:
    if not 1 <= len(members) <= MOST_MEMBERS:
        raise SettingError(f"members: expected 1 to {MOST_MEMBERS} models, received {len(members)}")
    for m in members:
        if not isinstance(m, Model) or isinstance(m, Ensemble):
            raise SettingError(
                f"members: expected single models, received {type(m).__name__}; pass the members "
                "of an ensemble"
            )
    for m in members[1:]:
        if _plant(m) != _plant(members[0]):
            raise SettingError(
                f"members: expected models of one plant, received {members[0].signature} at "
                f"{members[0].Ts:g} s and {m.signature} at {m.Ts:g} s"
            )


def _plant(model: Model) -> tuple[object, ...]:
    names = (model.input_names, model.output_name, model.input_units, model.output_unit)
    return (model.Ts, *names, model.counts)
