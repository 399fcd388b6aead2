"""Statistical tests of a record: does the output integrate, was it made in a closed loop.

`rust/core/src/feedback.rs` computes them and states their assumptions.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from .. import _core

if TYPE_CHECKING:
    from .dataset import Dataset


@dataclass(frozen=True)
class Integration:
    """How an output that inputs drive returns to its level, over the whole record.
    `gain` is the output's change per second and unit of `input`, which drives it most clearly, at
    low frequencies. `time_constant` [s] is that of the slowest pole, a sum if several are slow, inf
    for an integral; `lengths` is the longest experiment in it, 0 or below for an integral. The pole
    lies inside by `restoring` standard errors, and the input drives the change by `driving`.
    """

    is_integral: bool
    input: int
    lengths: float
    time_constant: float
    gain: float
    restoring: float
    driving: float


def integration(data: Dataset) -> Integration | None:
    """Test for a pole at 1 that an input drives; None where the record is too short or still."""
    found = _core.integration([(e.u, e.y) for e in data.experiments], Ts=data.Ts)
    return None if found is None else Integration(*found)


@dataclass(frozen=True)
class Feedback:
    """How one input follows the output's innovations, `lead` samples later. `correlation` is that
    of the innovations at this lead, and `significance` the same in standard errors. `misfit` is the
    largest correlation with the input's past beyond the regression, in standard errors.
    """

    input: int
    lead: int
    correlation: float
    significance: float
    misfit: float


def feedback(data: Dataset) -> Feedback | None:
    """The input with the clearest response to noise of the output; None if no input responds."""
    if data.looks_ahead:
        return None
    found = _core.feedback([(e.u, e.y) for e in data.experiments])
    return None if found is None else Feedback(*found)
