"""What sewfast does of the benchmarks: each function prepares the work that is timed."""

from __future__ import annotations

import resource
from collections.abc import Callable
from typing import Any

import numpy as np

import problem
import sewfast
import state_space
from sewfast import _core
from sewfast.tuning import costs
from sewfast.tuning.task import TuningTask

Work = Callable[[], dict[str, Any]]
TRACKING = sewfast.Cost(chatter=0.0, overshoot=0.0, saturation=0.0)


def network(hidden: int = problem.HIDDEN, *, scaled: bool = True) -> _core.NeuralOE:
    """The trained network, or a random one of another size; in scaled units or in V and RPM."""
    theta = problem.trained() if hidden == problem.HIDDEN else problem.start(0, 0.1, hidden)
    u_scale, y_scale = (1.0, 1.0) if scaled else (problem.U_SCALE, problem.Y_SCALE)
    return _core.NeuralOE(
        na=2,
        nb=2,
        nk=1,
        n_inputs=1,
        hidden=hidden,
        bypass=False,
        theta=theta,
        u_mean=np.zeros(1),
        u_scale=np.array([u_scale]),
        y_mean=0.0,
        y_scale=y_scale,
        output_low=None,
        output_high=None,
    )


def trained(
    iterations: int,
    samples: int = problem.SAMPLES,
    hidden: int = problem.HIDDEN,
    starts: int = 1,
    threads: int = 1,
    **others: Any,
) -> Callable[[], _core.NeuralFit]:
    """A training in the scaling of the problem, ready to begin."""
    u, y = problem.drive(samples)
    data = [(u[:, None], y)]
    unscaled = {"u_mean": np.zeros(1), "u_scale": np.ones(1), "y_mean": 0.0, "y_scale": 1.0}
    return lambda: _core.fit_neural_oe(
        data,
        [],
        na=2,
        nb=2,
        nk=1,
        hidden=hidden,
        linear=None,
        saturate=None,
        initial_state="zero",
        weight_decay=0.0,
        max_iterations=iterations,
        starts=starts,
        seed=0,
        threads=threads,
        **unscaled,
        **others,
    )


def training(iterations: int) -> Work:
    """Levenberg-Marquardt from the common start."""
    fit = trained(iterations, initial_theta=problem.start()[None])

    def work() -> dict[str, Any]:
        found = fit()
        reached = {"first_cost": float(found.trace[0]), "cost": found.cost}
        reached["iterations"] = found.iterations
        return reached | {"trials": found.trials}

    return work


def several_starts(starts: int, iterations: int, threads: int) -> Work:
    """From the common starts."""
    thetas = np.stack([problem.start(seed) for seed in range(starts)])
    fit = trained(iterations, starts=starts, threads=threads, initial_theta=thetas)
    return lambda: {"costs": sorted(fit().start_costs.tolist())}


def grown_training(iterations: int, samples: int, hidden: int = problem.HIDDEN) -> Work:
    """From a small random start of sewfast's own."""
    fit = trained(iterations, samples, hidden)
    return lambda: {"iterations": fit().iterations}


def free_run(samples: int, hidden: int = problem.HIDDEN) -> Work:
    """Of the trained network."""
    model, rest = network(hidden), np.zeros(2)
    u = problem.drive(samples)[0][:, None]

    def work() -> dict[str, Any]:
        out = model.simulate(u, rest)
        return {"last": float(out[-1]), "sum": float(out.sum())}

    return work


def _gains(row: np.ndarray) -> dict[str, float]:
    """Of a candidate, from scaled units to V/RPM."""
    kp, ki, kd, alpha, beta, n = row
    scale = problem.U_SCALE / problem.Y_SCALE
    return {"Kp": kp * scale, "Ti": kp / ki, "Td": kd / kp, "alpha": alpha, "beta": beta, "N": n}


def controller(row: np.ndarray, *, encoded: bool = False) -> sewfast.Controller:
    """The candidate as a controller of the drive, its limits 0 and 10 V."""
    values = _gains(row)
    given = (values.pop(name) for name in ("Kp", "Ti", "Td"))
    return sewfast.Controller(
        gains=sewfast.Gains.standard(*given),
        Ts=problem.TS,
        Tt=problem.TT,
        u_min=0.0,
        u_max=problem.U_MAX,
        filter_samples=problem.FILTER if encoded else 1,
        counts_per_rev=problem.COUNTS_PER_REV if encoded else None,
        **values,
    )


def _reached(costs: np.ndarray) -> dict[str, Any]:
    return {"mean": float(np.mean(costs)), "least": float(np.min(costs))}


def _candidates(number: int, encoded: bool, threads: int) -> Work:
    controllers = [controller(row, encoded=encoded) for row in problem.gains(number)]
    task = TuningTask.of(
        model(),
        problem.Y_SCALE * problem.reference(),
        start=controllers[0],
        first={},
        cost=TRACKING,
        aggregate="mean",
        constraints=None,
        variations=[(1.0, 0)],
    ).core()
    cores = [c.core() for c in controllers]

    def work() -> dict[str, Any]:
        found = _core.tuning_costs(task, cores, threads=threads)
        return _reached(np.array([cost for cost, *_ in found]))

    return work


def candidates(number: int, threads: int = 1) -> Work:
    """Closed loops over many candidates."""
    return _candidates(number, False, threads)


def encoded_candidates(number: int, threads: int = 1) -> Work:
    """The same with encoder and feedback filter."""
    return _candidates(number, True, threads)


def model() -> sewfast.NeuralOE:
    """The trained network as users have it."""
    return sewfast.NeuralOE(
        core=network(scaled=False),
        Ts=problem.TS,
        input_names=("u",),
        output_name="y",
        input_units=("V",),
        output_unit="RPM",
    )


def public_candidates(number: int) -> Work:
    """The same as `candidates` by the public function."""
    controllers = [controller(row) for row in problem.gains(number)]
    plant, r = model(), problem.Y_SCALE * problem.reference()

    def work() -> dict[str, Any]:
        found = costs(controllers, plant, r, cost=TRACKING, variations=[(1.0, 0)], threads=1)
        return _reached(found)

    return work


def one_loop() -> Work:
    """One closed loop."""
    plant, core = network(scaled=False), controller(problem.gains(1)[0]).core()
    r = problem.Y_SCALE * problem.reference()

    def work() -> dict[str, Any]:
        y = _core.closed_loop(plant, core, r, counts_per_unit=0.0)["y"]
        error = (r - y) / problem.Y_SCALE
        return {"last": float(y[-1]) / problem.Y_SCALE, "mean": float(np.mean(error**2))}

    return work


def arx(samples: int) -> Work:
    """ARX(2, 2, 1)."""
    u, y = problem.noisy_drive(samples)
    data = [(u[:, None], y)]

    def work() -> dict[str, Any]:
        found = _core.fit_arx(data, na=2, nb=2, nk=1, offset=False)
        return {"theta": [*found.a.tolist(), *found.b[0].tolist()]}

    return work


def neural_ss(
    iterations: int, samples: int = state_space.SAMPLES, hidden: int = state_space.HIDDEN
) -> Work:
    """LM iterations of the state-space model from its own start."""
    fit = state_space.training(iterations, samples, hidden)
    return lambda: {"cost": fit().cost}


def machine(excitation: str, samples: int = 50_000) -> Work:
    """The virtual machine over a chirp, or over random voltages that hold 1 or 100 ms."""
    t = np.arange(samples) * problem.TS
    hold = {"chirp": 0, "random, 100 ms": 100, "random, 1 ms": 1}[excitation]
    u = 3.5 + 2.5 * np.sin(2 * np.pi * (0.1 + 0.03 * t) * t)
    if hold:
        u = np.repeat(np.random.default_rng(1).uniform(-20, 20, samples // hold), hold)
    core = _core.Machine()

    def work() -> dict[str, Any]:
        core.reset()
        core.run(u)
        return {}

    return work


def seam(call: str, samples: int) -> Work:
    """A short run by the compiled module, by the public method, or nothing but a conversion."""
    core, public, rest = network(scaled=False), model(), np.zeros(2)
    u = problem.drive(samples)[0][:, None] * problem.U_SCALE
    data = sewfast.Dataset.from_arrays(
        u, np.zeros(samples), problem.TS, input_units="V", output_unit="RPM"
    )
    calls: dict[str, Callable[[], Any]] = {
        "core": lambda: core.simulate(u, rest),
        "public": lambda: public.simulate(data, init=0),
        "rest": core.rest_state,
    }
    chosen = calls[call]

    def work() -> dict[str, Any]:
        chosen()
        return {}

    return work


def memory(samples: int, hidden: int = problem.HIDDEN) -> Work:
    """Bytes per sample that a training takes beside its data, from the process's largest size."""
    fit = trained(2, samples, hidden)
    trained(2, 1000, hidden)()
    # pages of the data are the process's own already: drive() has written them
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    fit()
    grown = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before
    return lambda: {"bytes_per_sample": 1024.0 * grown / samples}
