"""Training of networks: their structures, and many starts at once.

A `Structure` defines a network. A `Request` is for some starts of one structure; requests are split
into jobs of one start each, which threads of this process or a user's workers run in any order with
the same result.
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, TypeAlias

import numpy as np

from .. import _core
from ..dataset import Dataset
from ..errors import FitError
from ..progress import TimeUp
from ..threads import Workers, spread
from .outputs import LINEAR, Output, scale_of
from .task import SHARES, Look, Pairs, Pool, Provenance, Stopped, arrays

Network: TypeAlias = _core.NeuralSS | _core.NeuralOE


@dataclass(frozen=True)
class Structure:
    """The structure of a network: its sizes, delay, weight decay and output function.
    `nx` counts the states, or the past outputs of a lagged network, which has nx + 1 past inputs.
    `nk` is the delay [samples], `hidden` counts the hidden units (tanh), and `output` belongs to a
    state-space network. With an `integrator`, the last state is the sum of a function of the
    others. `kind` is "neural_ss" or "neural_oe".
    """

    nx: int
    nk: int
    hidden: int
    decay: float
    output: Output = LINEAR
    integrator: bool = False
    kind: str = "neural_ss"

    @property
    def size(self) -> tuple[int, bool, str]:
        """The size of a network for comparisons, without its hidden units, decay and output."""
        return self.nx, self.integrator, self.kind

    def parameters(self, inputs: int) -> int:
        """Length of theta."""
        nx, h = self.nx, self.hidden
        if self.kind == "neural_oe":
            regressors = nx + (nx + 1) * inputs
            return h * (regressors + 2) + regressors + 1
        return nx * nx + nx * inputs + 2 * nx * h + h * inputs + 2 * h + nx + inputs + 1

    def operations(self, inputs: int, samples: int) -> float:
        """Multiplications of one iteration: sensitivities, and the sum of outer products."""
        p = self.parameters(inputs)
        # cost of a sample apart from its sensitivities, in multiplications
        return samples * (p * p / 2.0 + self.nx * self.nx * p + 2_000)

    def to_json(self) -> Provenance:
        """For the table of candidates."""
        sizes = {"nx": self.nx} if self.kind == "neural_ss" else {"na": self.nx, "nb": self.nx + 1}
        row: Provenance = {"kind": self.kind, **sizes, "nk": self.nk, "hidden": self.hidden}
        row |= {"output": self.output.name, "weight_decay": self.decay}
        return row | ({"integrator": True} if self.integrator else {})


@dataclass(frozen=True)
class Start:
    """One trained start. `cost` is J on held-out data, else on the training data; `fault` is what
    the guard found, empty for a sound start.
    """

    model: Network
    cost: float
    fault: str = ""

    @property
    def is_sound(self) -> bool:
        """Whether the guard found nothing."""
        return not self.fault


@dataclass(frozen=True)
class Request:
    """Some starts of one structure on some data. `initial` are models to train further, one start
    each; otherwise `starts` new ones are drawn around `linear`, numbered from `first` on.
    """

    structure: Structure
    fitted: Dataset
    held: Dataset | None
    iterations: int
    linear: _core.LinearModel | None = None
    starts: int = 0
    first: int = 0
    initial: Sequence[Network] = field(default=())

    @property
    def count(self) -> int:
        return len(self.initial) or self.starts

    @property
    def operations(self) -> float:
        """Multiplications, if every start takes all its iterations."""
        each = self.structure.operations(self.fitted.n_inputs, len(self.fitted))
        return each * self.iterations * self.count


@dataclass(frozen=True)
class Job:
    """One start with everything a worker needs; picklable for state-space networks."""

    experiments: Pairs
    held: Pairs
    settings: dict[str, Any]
    linear: tuple[Any, ...] | None
    initial: dict[str, Any] | None
    number: int
    seed: int
    deadline: float | None

    def run(self, look: Look | None) -> tuple[Network, float] | None:
        """The trained network and its cost; None if it failed."""
        try:
            fit = self._lagged(look) if "na" in self.settings else self._state_space(look)
        except FitError:
            return None
        cost = float(fit.start_costs[0])
        return (fit.model, cost) if math.isfinite(cost) else None

    def _state_space(self, look: Look | None) -> _core.NeuralSSFit:
        return _core.fit_neural_ss(
            self.experiments,
            self.held,
            **self.settings,
            linear=None if self.linear is None else _core.LinearModel(*self.linear),
            initial=None if self.initial is None else [_core.NeuralSS(**self.initial)],
            starts=1,
            first_start=self.number,
            seed=self.seed,
            threads=1,
            # the search applies the guard to whole records
            guard=False,
            progress=look,
        )

    def _lagged(self, look: Look | None) -> _core.NeuralFit:
        known = self.initial or {}
        return _core.fit_neural_oe(
            self.experiments,
            self.held,
            **self.settings,
            linear=None if self.linear is None else _core.LinearModel(*self.linear),
            u_mean=known.get("u_mean"),
            u_scale=known.get("u_scale"),
            y_mean=known.get("y_mean"),
            y_scale=known.get("y_scale"),
            saturate=1.0,
            initial_state="estimated",
            starts=1,
            # the core numbers these starts from 0 in every call
            seed=(self.seed + self.number * 0x9E3779B97F4A7C15) % 2**64,
            threads=1,
            initial_theta=None if self.initial is None else known["theta"][None, :],
            progress=look,
        )


def run_job(job: Job) -> tuple[dict[str, Any], float] | None:
    """A job of a state-space network on a worker; its result is picklable too."""
    own = Job(
        [_aligned(pair) for pair in job.experiments],
        [_aligned(pair) for pair in job.held],
        dict(zip(job.settings, _aligned(job.settings.values()), strict=True)),
        None if job.linear is None else _aligned(job.linear),
        None if job.initial is None else _values_aligned(job.initial),
        job.number,
        job.seed,
        job.deadline,
    )

    def look(*_: object) -> None:
        if job.deadline is not None and time.time() >= job.deadline:
            raise TimeUp

    try:
        found = own.run(look)
    except KeyboardInterrupt:
        return None
    return None if found is None else (_values(found[0]), found[1])


def train(
    requests: Sequence[Request],
    pool: Pool,
    seed: int,
    *,
    workers: Workers | None = None,
    until: float | None = None,
    share: float | None = None,
    what: str,
) -> list[list[Start]]:
    """Starts with a finite free run of every request, in their order.
    Start `i` of a structure draws from stream `i` of the seed. `workers` train the state-space
    networks; the bits are the same. At the deadline `until`, on `time.perf_counter`, starts return
    their best so far; `share` and `what` are those of `Pool.map`. Raises `Stopped` on Ctrl-C.
    """
    jobs = [job for request in requests for job in _jobs(request, seed, until)]
    if workers is None:
        found = pool.map(lambda job, look: job.run(look), jobs, until=until, share=share, what=what)
    else:
        found = _spread(workers, jobs)
        if jobs and until is not None and time.perf_counter() >= until:
            pool.clock.lose(what)
    left = iter(found)
    starts = [[next(left) for _ in range(request.count)] for request in requests]
    return [[Start(*values) for values in some if values is not None] for some in starts]


def guarded(
    found: Sequence[Sequence[Start]],
    data: Pairs,
    bounds: list[_core.LinearModel],
    pool: Pool,
) -> list[list[Start]]:
    """Starts with the guard's findings; the memory of linear `bounds` limits that of networks."""
    flat = [start for starts in found for start in starts]

    def fault(start: Start, look: Look) -> str:
        return _core.guard(start.model, data, linear=bounds)

    late = "not asked within the time budget"
    until = pool.clock.until(SHARES.guard)
    faults = (
        late if f is None else f
        for f in pool.map(fault, flat, until=until, what="the guard of networks")
    )
    return [[replace(s, fault=next(faults)) for s in starts] for starts in found]


def counting(starts: Iterable[Start]) -> list[Start]:
    """Starts not far worse than the best, sound ones if there are any; best first."""
    starts = list(starts)
    able = sorted([s for s in starts if s.is_sound] or starts, key=lambda s: s.cost)
    # starts whose J exceeds this multiple of the best one's do not count
    return [s for s in able if s.cost <= 3.0 * able[0].cost]


def _spread(workers: Workers, jobs: Sequence[Job]) -> list[tuple[Network, float] | None]:
    """Run state-space networks on the workers, lagged ones (few and quick) in this process."""
    remote = [i for i, job in enumerate(jobs) if "nx" in job.settings]
    try:
        answers = iter(spread(workers, run_job, [jobs[i] for i in remote]))
        found: list[tuple[Network, float] | None] = []
        for job in jobs:
            if "nx" in job.settings:
                answer = next(answers)
                found.append(None if answer is None else (_model(answer[0]), answer[1]))
            else:
                found.append(job.run(None))
    except KeyboardInterrupt:
        raise Stopped from None
    return found


def _jobs(request: Request, seed: int, until: float | None) -> list[Job]:
    s, linear = request.structure, request.linear
    if s.integrator and linear is not None:
        poles = linear.poles()
        slow = (abs(poles[:, 1]) <= 1e-9 * abs(poles[:, 0])) & (poles[:, 0] > 0.0)
        if not slow.any():  # no real mode could become an integrator
            linear = None  # starts begin at random states
    settings: dict[str, Any] = {"nk": s.nk, "hidden": s.hidden, "weight_decay": s.decay}
    settings["max_iterations"] = request.iterations
    if s.kind == "neural_oe":
        settings |= {"na": s.nx, "nb": s.nx + 1}
    else:
        settings |= {"nx": s.nx, "integrator": s.integrator, "output": s.output.name}
        parameters = s.output.parameters(*scale_of(request.fitted, s.output))
        settings |= {"output_parameters": parameters, "hidden_scale": 1.0}
    common: dict[str, Any] = {
        "experiments": arrays(request.fitted),
        "held": [] if request.held is None else arrays(request.held),
        "settings": settings,
        "linear": None if linear is None else (linear.a, linear.b, linear.nk, linear.offset),
        "seed": seed,
        "deadline": None if until is None else time.time() + until - time.perf_counter(),
    }
    if request.initial:
        return [
            _onwards(common, model, request.first + i) for i, model in enumerate(request.initial)
        ]
    return [Job(**common, number=request.first + i, initial=None) for i in range(request.starts)]


def _onwards(common: dict[str, Any], model: Network, number: int) -> Job:
    """A job that goes on from a model, in its own scaling."""
    settings = dict(common["settings"])
    if "nx" in settings:
        settings["output_parameters"] = model.settings["output_parameters"]
    return Job(**{**common, "settings": settings}, number=number, initial=_values(model))


def _values(model: Network) -> dict[str, Any]:
    return {**model.settings, "theta": model.theta}


def _model(values: dict[str, Any]) -> _core.NeuralSS:
    return _core.NeuralSS(**_values_aligned(values))


def _values_aligned(values: dict[str, Any]) -> dict[str, Any]:
    return dict(zip(values, _aligned(values.values()), strict=True))


def _aligned(values: Iterable[Any]) -> Any:
    """Copies in the memory layout of the core, which values from a network connection can lack."""
    return tuple(np.array(v, order="C") if isinstance(v, np.ndarray) else v for v in values)
