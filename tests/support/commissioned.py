"""Commissionings cut short: what is tested is what is done, not how well the controller does."""

from __future__ import annotations

import functools
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest

from sewfast import commission, identification
from sewfast.commissioning import procedure, small_signal, training

SMALL: dict[str, Any] = {"members": 2, "evaluations": 25, "seed": 1}


@contextmanager
def short() -> Iterator[None]:
    """Networks that are trained for 15 iterations, linear models of one order each."""
    with pytest.MonkeyPatch.context() as patch:
        quick = functools.partial(identification.seeded, iterations=15)
        patch.setattr(training, "seeded", quick)
        patch.setattr(small_signal, "ORDERS", (2,))
        patch.setattr(procedure, "ORDERS", (2,))
        yield


@contextmanager
def short_experiment() -> Iterator[None]:
    """The paper's experiment with networks and searches cut short."""
    from sewfast_demo import loops

    with short(), pytest.MonkeyPatch.context() as patch:
        quick = functools.partial(identification.identify, iterations=3, starts=1)
        patch.setattr(loops, "identify", quick)
        tried = functools.partial(commission, members=2, evaluations=25)
        patch.setattr(loops, "commission", tried)
        yield
