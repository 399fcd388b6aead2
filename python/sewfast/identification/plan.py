"""`Plan`: how much training the amount of data allows; the same on every machine."""

from __future__ import annotations

from dataclasses import dataclass

from .task import Task


@dataclass(frozen=True)
class Plan:
    """Sizes of a search.

    Attributes
    ----------
    trial_samples : int
        Fitted samples of a trial.
    held_samples : int
        Samples that a trial is judged by.
    trial_starts, trial_iterations : int
        Of each candidate.
    final_starts, final_iterations : int
        Of the chosen one, on `trial_samples`.
    all_iterations : int
        On everything that is fitted to, where that is more than `trial_samples`.
    refit_iterations : int
        On all data, the held-out part included.
    decay, decay_step : float
        Weight decay to begin with, and the factor to the next one.
    most_hidden : int
    worth_a_step : float
        A step in the ladder must bring the error below this part.
    """

    trial_samples: int
    held_samples: int
    trial_starts: int
    trial_iterations: int
    final_starts: int
    final_iterations: int
    all_iterations: int
    refit_iterations: int
    decay: float
    decay_step: float
    most_hidden: int
    worth_a_step: float


SEARCH_OPERATIONS = 1.5e11
"""Multiplications after which no further candidate is tried; a core makes a few 1e9 in a second."""
FINAL_OPERATIONS = 1.2e11
"""Multiplications that either stage of the final training may take."""

SMALL = Plan(12_000, 12_000, 6, 60, 24, 100, 0, 15, 1e-4, 10.0, 16, 0.97)
MEDIUM = Plan(12_000, 12_000, 4, 60, 8, 150, 60, 15, 1e-5, 10.0, 16, 0.97)
LARGE = Plan(12_000, 12_000, 4, 60, 4, 300, 60, 10, 1e-8, 1e3, 32, 0.97)
"""Much data: little variance to average out, but larger networks to gain from."""


def plan_of(task: Task, samples: int) -> Plan:
    """The plan for so many fitted samples."""
    if samples <= 3_000:
        return SMALL
    return MEDIUM if samples <= 15_000 else LARGE
