"""`Model`: what every identified model is to its user."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from ..dataset import Dataset
from ..dynamic_model import INIT, DynamicModel
from ..errors import SettingError
from ..evidence import Bands, OperatingPoint, ReportCard, bands, check, operating_range
from ..validation import Validation, validate

_OF_LINEAR_MODELS = (
    "dc_gain", "frequency_response", "poles", "steady_output", "to_continuous", "to_control",
    "to_scipy", "to_ss", "to_tf", "transfer_function",
)  # fmt: skip
"""What other models have about an operating point only."""


class NotLinearError(SettingError, AttributeError):
    """A transfer function, or what follows from one, was asked of a model that has none."""


@dataclass(frozen=True, eq=False, repr=False)
class Model(DynamicModel):
    """A model of one plant, in the units of the data it was identified from.

    Made by `identify` or `load_model`.

    Parameters
    ----------
    core : compiled model
        Its arithmetic; takes part in `sewfast.run` and `sewfast.tune` as a plant.
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

    alternatives: tuple[Model, ...] = ()

    @property
    def members(self) -> tuple[Model, ...]:
        """The models that an ensemble consists of; a single model has none."""
        return ()

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
            For an ensemble, whose members are linear models of their own.
        DataError
            Where `u` has not one finite value per input, or is not given and the model does not
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
            given = [np.atleast_1d(np.asarray(u, dtype=np.float64))]
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
        """Where measured samples are to be expected; see `sewfast.evidence.bands`."""
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
        # the compiled model is made again from its numbers, as when a file is read
        from .files import restored

        return restored, (self.to_dict(), self.alternatives)
