"""The references of a commission: those that were asked for, checked, or the standard ones."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import ArrayLike

from .. import signals
from ..control.machine import WATCHED, Machine
from ..dataset import FloatArray
from ..errors import DataError, SettingError
from ..gains import vector
from ..tuning.task import GAINS
from .demands import Demands
from .excitations import standard

References = Mapping[str, ArrayLike] | Sequence[str]


def references_of(
    fastest: float, asked: Demands, machine: Machine
) -> tuple[Mapping[str, FloatArray], Mapping[str, FloatArray]]:
    """References for the verification, and for tuning.
    Gains are tuned on plants with down to .8 of the gain, which accelerate less. At the pace of the
    verification these would reach the current limit, where no gains help, and the search would
    minimise windup instead (drive `weak`, seed 5: 13.7 RPM on the machine; 4.96 with slower ones).
    """
    if asked.references is not None:
        return asked.references, asked.practice or asked.references
    return (
        standard(fastest, asked, machine.Ts, short=False),
        asked.practice or standard(min(GAINS) * fastest, asked, machine.Ts, short=True),
    )


def samples_of(
    references: References | None, machine: Machine, seed: int
) -> Mapping[str, FloatArray] | None:
    if references is None:
        return None
    given = isinstance(references, (Mapping, Sequence)) and not isinstance(references, str)
    if not given or not references:
        raise SettingError(
            name="references", expected="a mapping from names to samples, or a sequence of names",
            received=repr(references), remedy="leave it out for the standard ones",
        )  # fmt: skip
    if isinstance(references, Mapping):
        return {str(name): _whole(str(name), r) for name, r in references.items()}
    if abs(machine.Ts - signals.TS) > 1e-9:
        raise SettingError(
            name="references", expected=f"names on a machine at {signals.TS} s only",
            received=f"one at {machine.Ts:g} s", remedy="give references as samples",
        )  # fmt: skip
    return {name: signals.reference(name, seed) for name in references}


def _whole(name: str, reference: ArrayLike) -> FloatArray:
    """The samples of a reference, checked."""
    # least samples of a reference: fewer cannot be judged
    shortest = 2 * WATCHED
    samples = vector(name, reference).copy()
    if not np.all(np.isfinite(samples)):
        raise DataError(
            name=name, expected="finite samples of a reference", received="NaN or infinity"
        )
    if len(samples) < shortest:
        raise DataError(
            name=name, expected=f"{shortest} samples of a reference or more",
            received=f"{len(samples)}", remedy="hold its end for longer",
        )  # fmt: skip
    if not samples.any():
        raise DataError(
            name=name, expected="a reference that moves", received="zeros only",
            remedy="give the speed to follow",
        )  # fmt: skip
    return samples
