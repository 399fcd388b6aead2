"""`Structure`: the size and form of one state-space network; starts of it, trained anywhere."""

from __future__ import annotations

import math
import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from .. import _core
from ..dataset import Dataset
from ..errors import FitError
from ..workers import spread
from .clock import stopping
from .memory import Memory
from .outputs import LINEAR, Output, scale_of
from .task import Pairs, Story, Task, arrays

HIDDEN_SCALE = 1.0
OVERHEAD = 2_000
"""What a sample costs beside its sensitivities, in multiplications."""


@dataclass(frozen=True)
class Structure:
    """What distinguishes one candidate from another."""

    nx: int
    nk: int
    hidden: int
    decay: float
    output: Output = LINEAR
    integrator: bool = False

    def parameters(self, inputs: int) -> int:
        """Length of theta."""
        nx, h = self.nx, self.hidden
        return nx * nx + nx * inputs + 2 * nx * h + h * inputs + 2 * h + nx + inputs + 1

    def operations(self, inputs: int, samples: int) -> float:
        """Multiplications of one iteration: sensitivities, and the sum of outer products."""
        p = self.parameters(inputs)
        return samples * (p * p / 2.0 + self.nx * self.nx * p + OVERHEAD)

    def to_json(self) -> Story:
        """For the table of candidates."""
        story: Story = {"nx": self.nx, "nk": self.nk, "hidden": self.hidden}
        story |= {"output": self.output.name, "weight_decay": self.decay}
        return story | ({"integrator": True} if self.integrator else {})


@dataclass(frozen=True)
class Start:
    """One trained start: the model, J on what is held out (else on training), the guard's word."""

    model: _core.NeuralSS
    cost: float
    is_sound: bool


@dataclass(frozen=True)
class Job:
    """Some starts of one structure: all that a worker needs, picklable."""

    experiments: Pairs
    validation: Pairs
    settings: dict[str, Any]
    linear: tuple[Any, ...] | None
    starts: int
    first_start: int
    initial: tuple[dict[str, Any], ...] | None = None
    deadline: float | None = None
    threads: int = 1


@dataclass(frozen=True)
class Training:
    """How a structure is trained: data, where it starts, how long."""

    fitted: Dataset
    held: Dataset | None
    linear: _core.LinearModel | None
    starts: int
    iterations: int
    first_start: int = 0
    initial: Sequence[_core.NeuralSS] = field(default=())
    memory: Memory | None = None

    def operations(self, structure: Structure) -> float:
        """Multiplications, if every start takes all its iterations."""
        each = structure.operations(self.fitted.n_inputs, len(self.fitted))
        return each * self.iterations * (len(self.initial) or self.starts)

    def affordable(self, structure: Structure, operations: float) -> Training:
        """With as many iterations as that much work allows, at least a tenth."""
        share = min(1.0, max(0.1, operations / self.operations(structure)))
        return replace(self, iterations=max(1, round(share * self.iterations)))


def train(task: Task, structure: Structure, training: Training) -> list[Start]:
    """Starts with a finite free run, in their order; none where every one failed."""
    starts = _trained(task, _job(task, structure, training))
    memory = training.memory
    if memory is None:
        return starts
    return [replace(s, is_sound=s.is_sound and memory.allows(s.model)) for s in starts]


def _trained(task: Task, job: Job) -> list[Start]:
    """By threads of this process, or by the workers."""
    if task.workers is None:
        return _in_threads(task, job)
    jobs = [_part(job, i) for i in range(job.starts)]
    try:
        found = spread(task.workers, run_job, jobs)
    except KeyboardInterrupt:
        raise Stopped([]) from None
    task.clock.over()
    return [_start(*values) for results in found for values in results]


def _part(job: Job, i: int) -> Job:
    """The i-th start alone."""
    initial = job.initial and (job.initial[i],)
    return replace(job, starts=1, first_start=job.first_start + i, initial=initial)


def run_job(job: Job) -> list[tuple[dict[str, Any], float, bool]]:
    """Train the job's starts; what comes back is picklable too."""
    return [(_values(s.model), s.cost, s.is_sound) for s in _fitted(job, None)[0]]


def _in_threads(task: Task, job: Job) -> list[Start]:
    """In this process, from this thread, which hears Ctrl-C and shows progress."""
    starts, was_stopped = _fitted(replace(job, threads=task.threads), task.progress)
    if was_stopped and not task.clock.over():
        raise Stopped(starts)
    return starts


class Stopped(Exception):
    """Ctrl-C while starts were trained; what there is of them."""

    def __init__(self, starts: list[Start]) -> None:
        super().__init__("interrupted")
        self.starts = starts


def _fitted(job: Job, progress: Any) -> tuple[list[Start], bool]:
    """The starts, and whether they were stopped before their end."""
    linear = None if job.linear is None else _core.LinearModel(*_copied(job.linear))
    initial = None if job.initial is None else [_model(v) for v in job.initial]
    try:
        fit = _core.fit_neural_ss(
            [_copied(pair) for pair in job.experiments],
            [_copied(pair) for pair in job.validation],
            **job.settings,
            linear=linear,
            initial=initial,
            starts=job.starts,
            first_start=job.first_start,
            threads=job.threads,
            progress=stopping(progress, _seconds(job)),
        )
    except FitError:
        return [], False
    except KeyboardInterrupt:
        return [], True
    found = zip(fit.start_models, fit.start_costs.tolist(), fit.sounds, strict=True)
    starts = [Start(m, c, s) for m, c, s in found if m is not None and math.isfinite(c)]
    return starts, fit.termination == "interrupted"


def _job(task: Task, structure: Structure, training: Training) -> Job:
    s, linear = structure, training.linear
    if training.initial:
        output_parameters = training.initial[0].settings["output_parameters"]
    else:
        output_parameters = s.output.parameters(*scale_of(training.fitted, s.output))
    return Job(
        experiments=arrays(training.fitted),
        validation=[] if training.held is None else arrays(training.held),
        settings={
            "nx": s.nx,
            "nk": s.nk,
            "hidden": s.hidden,
            "integrator": s.integrator,
            "output": s.output.name,
            "output_parameters": output_parameters,
            "weight_decay": s.decay,
            "hidden_scale": HIDDEN_SCALE,
            "max_iterations": training.iterations,
            "seed": task.seed,
        },
        linear=None if linear is None else (linear.a, linear.b, linear.nk, linear.offset),
        starts=len(training.initial) or training.starts,
        first_start=training.first_start,
        initial=tuple(_values(m) for m in training.initial) or None,
        deadline=None if task.clock.left is None else time.time() + task.clock.left,
    )


def _seconds(job: Job) -> float | None:
    return None if job.deadline is None else max(0.0, job.deadline - time.time())


def _values(model: _core.NeuralSS) -> dict[str, Any]:
    return {**model.settings, "theta": model.theta}


def _start(values: dict[str, Any], cost: float, is_sound: bool) -> Start:
    return Start(_model(values), cost, is_sound)


def _model(values: dict[str, Any]) -> _core.NeuralSS:
    return _core.NeuralSS(**dict(zip(values, _copied(values.values()), strict=True)))


def _copied(values: Iterable[Any]) -> Any:
    """Copies as the core takes them: what came through a network may lie in memory otherwise."""
    return tuple(np.array(v, order="C") if isinstance(v, np.ndarray) else v for v in values)
