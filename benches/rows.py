"""The rows of the benchmarks: who works on what, what must agree, what is to be reached."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

from problem import LOOP_SAMPLES, SAMPLES
from state_space import FIRST, HIDDEN, STEPS
from state_space import SAMPLES as STATES
from turns import ONE_THREAD, Contender

MU = 1.0
"""First damping of sewfast's trainings; the rivals take the same."""
ITERATIONS = 100
CANDIDATES = 1000
MILLION = 1_000_000


@dataclass(frozen=True)
class Row:
    """One comparison; the first contender is sewfast, `unit` a name and how many there are per s.

    `agree` names what the contenders must reach alike, with the relative tolerance. The time of
    the contenders that `less` names is taken off, and what is left is divided by `parts`. `judge`
    is the contender that sewfast's numbers must be next to, in shares of the largest of them.
    """

    key: str
    section: str
    title: str
    contenders: tuple[Contender, ...]
    unit: tuple[str, float] = ("ms", 1e3)
    parts: float = 1.0
    less: dict[str, str] = field(default_factory=dict)
    agree: dict[str, float] = field(default_factory=dict)
    judge: tuple[str, float] | None = None
    bars: dict[str, float] = field(default_factory=dict)
    wanted: str = ""
    limit: str = ""
    turns: int = 9
    quick: bool = True

    @property
    def clock(self) -> str:
        """Of the processor where everybody has one core."""
        return "wall" if any(c.threads > 1 for c in self.contenders) else "cpu"


def ours(work: str, name: str = "sewfast", **arguments: Any) -> Contender:
    """sewfast on one core."""
    return Contender(name, "ours", work, arguments)


def numba(work: str, **arguments: Any) -> Contender:
    """numba on one core."""
    return Contender("numba", "rivals.numba_works", work, arguments)


def jax(work: str, **arguments: Any) -> Contender:
    """JAX on one core."""
    return Contender("JAX", "rivals.jax_works", work, arguments)


def other(name: str, work: str, turns: int | None = None, **arguments: Any) -> Contender:
    """Another rival on one core."""
    return Contender(name, "rivals.other_works", work, arguments, turns=turns)


def forced(level: str, work: str, **arguments: Any) -> Contender:
    """sewfast on a level of the processor."""
    return Contender(
        f"sewfast, {level}", "ours", work, arguments, environment={"SEWFAST_CPU": level}
    )


def both(contender: Contender) -> Contender:
    """The same on two cores."""
    return replace(contender, threads=2)


TRAINING = {"cost": 0.01, "trials": 0.02}
RUN = {"last": 1e-9, "sum": 1e-9}


def training() -> list[Row]:
    return [
        Row(
            "training",
            "training",
            "100 LM iterations, 49 parameters, N = 20,000",
            (
                ours("training", iterations=ITERATIONS),
                numba("training", iterations=ITERATIONS, mu=MU),
                jax("training", iterations=ITERATIONS, mu=MU),
            ),
            agree=TRAINING,
            bars={"numba": 4.0, "JAX": 5.5},
            limit="94 to 98 ms",
        ),
        Row(
            "training_pyrenn",
            "training",
            "one LM iteration of the same",
            (
                replace(ours("training", iterations=ITERATIONS), parts=ITERATIONS),
                other("pyrenn", "pyrenn_training", turns=1, iterations=2),
                other("first", "pyrenn_training", turns=1, iterations=1),
            ),
            less={"pyrenn": "first"},
            agree={"first_cost": 1e-6},
            bars={"pyrenn": 1500.0},
            turns=5,
            quick=False,
        ),
        Row(
            "free_run",
            "free_run",
            "free run, N = 20,000",
            (
                ours("free_run", samples=SAMPLES),
                numba("free_run", samples=SAMPLES),
                jax("free_run", samples=SAMPLES),
            ),
            unit=("ns/sample", 1e9),
            parts=SAMPLES,
            agree=RUN,
            bars={"numba": 2.5, "JAX": 2.5},
            wanted="17 ns",
            limit="15.4 ns",
            turns=15,
        ),
        Row(
            "jacobian_rivals",
            "training",
            "rivals' J'J and J'e with the free run in it",
            (numba("jacobian_pass"), jax("jacobian_pass")),
            unit=("ns/sample", 1e9),
            parts=SAMPLES,
            agree={"cost": 1e-9},
        ),
    ]


def levels() -> list[Row]:
    def each(work: str, **arguments: Any) -> tuple[Contender, ...]:
        return tuple(forced(level, work, **arguments) for level in ("avx512", "avx2", "baseline"))

    return [
        Row(
            "levels_training",
            "levels",
            "100 LM iterations",
            each("training", iterations=ITERATIONS),
            agree=TRAINING,
            bars={"sewfast, avx2": -1.8},
            turns=5,
        ),
        Row(
            "levels_free_run",
            "levels",
            "free run, N = 20,000",
            each("free_run", samples=SAMPLES),
            unit=("ns/sample", 1e9),
            parts=SAMPLES,
            agree=RUN,
            turns=9,
        ),
        Row(
            "levels_candidates",
            "levels",
            "1,000 closed loops of 4,000 samples",
            each("candidates", number=CANDIDATES),
            agree={"mean": 1e-9},
            turns=5,
        ),
        Row(
            "levels_neural_ss",
            "levels",
            "neural state space, 10 LM iterations and its start",
            each("neural_ss", iterations=STEPS),
            agree={"cost": 1e-3},
            turns=3,
            quick=False,
        ),
    ]


def neural_ss() -> list[Row]:
    return [
        Row(
            "neural_ss",
            "neural_ss",
            "LM iteration, nx 3, H 15, 155 parameters, N = 65,000",
            (
                ours("neural_ss", iterations=FIRST + STEPS),
                Contender("first", "ours", "neural_ss", {"iterations": FIRST}),
                numba("neural_ss", steps=STEPS),
            ),
            parts=STEPS,
            less={"sewfast": "first"},
            agree={"cost": 1e-5},
            bars={"numba": 5.0},
            wanted="25 ms",
            limit="16 to 20 ms",
            turns=5,
        )
    ]


def closed_loops() -> list[Row]:
    def row(key: str, title: str, work: str, wanted: str, tolerance: float) -> Row:
        return Row(
            key,
            "closed_loop",
            title,
            (
                ours(work, number=CANDIDATES),
                numba(work, number=CANDIDATES),
                jax(work, number=CANDIDATES),
            ),
            agree={"mean": tolerance, "least": tolerance},
            bars={"numba": 2.5, "JAX": 2.5},
            wanted=wanted,
            limit="15 ms" if work == "candidates" else "",
        )

    return [
        row("candidates", "1,000 closed loops of 4,000 samples", "candidates", "18 ms", 1e-9),
        row(
            "encoded_candidates",
            "the same with encoder and feedback filter",
            "encoded_candidates",
            "30 ms",
            1e-4,
        ),
        Row(
            "public_candidates",
            "closed_loop",
            "`sewfast.tuning.costs` over them",
            (
                ours("public_candidates", number=CANDIDATES),
                ours("candidates", name="compiled function", number=CANDIDATES),
            ),
            agree={"mean": 1e-12},
            turns=5,
        ),
        Row(
            "one_loop",
            "closed_loop",
            "one closed loop of 4,000 samples",
            (
                ours("one_loop"),
                numba("one_loop"),
                other("python-control", "control_loop", turns=2),
            ),
            unit=("ns/sample", 1e9),
            parts=LOOP_SAMPLES,
            agree={"last": 1e-9, "mean": 1e-9},
            bars={"numba": 2.5, "python-control": 1500.0},
        ),
    ]


def arx() -> list[Row]:
    def row(samples: int, title: str, wanted: str, limit: str, bars: dict[str, float]) -> Row:
        return Row(
            f"arx_{samples}",
            "arx",
            f"ARX(2, 2, 1), N = {title}",
            (
                ours("arx", samples=samples),
                other("NumPy slices", "arx_gram", samples=samples),
                numba("arx", samples=samples),
                other("lstsq", "arx_lstsq", samples=samples, turns=3),
            ),
            agree={"theta": 1e-6},
            judge=("lstsq", 1e-9),
            bars=bars,
            wanted=wanted,
            limit=limit,
        )

    return [
        row(MILLION, "1,000,000", "0.5 ms", "0.22 ms", {"NumPy slices": 8.0}),
        row(SAMPLES, "20,000", "", "", {}),
    ]


def machine() -> list[Row]:
    return [
        Row(
            f"machine_{excitation}",
            "machine_speed",
            f"virtual machine, {excitation}, 50 s",
            (ours("machine", excitation=excitation),),
            wanted="3,000 x real time",
            turns=7,
        )
        for excitation in ("chirp", "random, 100 ms", "random, 1 ms")
    ]


def threads() -> list[Row]:
    def starts(number: int, threads: int, name: str) -> Contender:
        arguments = {"starts": number, "iterations": ITERATIONS, "threads": threads}
        return both(ours("several_starts", name=name, **arguments))

    rivals = {"starts": 10, "iterations": ITERATIONS, "mu": MU}
    return [
        Row(
            "ten_starts",
            "threads",
            "10 starts x 100 iterations, 2 cores",
            (
                starts(10, 2, "sewfast"),
                # two processes: each with a BLAS of one thread, or four would share two cores
                replace(both(numba("several_starts", **rivals)), environment=ONE_THREAD),
                both(jax("several_starts", **rivals)),
            ),
            unit=("s", 1.0),
            agree={"costs": 0.1},
            bars={"numba": 3.5, "JAX": 11.0},
            wanted="0.7 s",
            turns=3,
        ),
        Row(
            "two_threads",
            "threads",
            "two starts x 100 iterations",
            (starts(2, 2, "sewfast, 2 threads"), starts(2, 1, "sewfast, 1 thread")),
            agree={"costs": 0.0},
            bars={"sewfast, 1 thread": 1.85},
            turns=7,
        ),
        Row(
            "two_threads_candidates",
            "threads",
            "1,000 closed loops of 4,000 samples",
            tuple(
                both(ours("candidates", name=f"sewfast, {n}", number=CANDIDATES, threads=count))
                for n, count in (("2 threads", 2), ("1 thread", 1))
            ),
            agree={"mean": 0.0},
            turns=7,
        ),
    ]


def seam() -> list[Row]:
    def row(call: str, title: str, samples: int) -> Row:
        return Row(
            f"seam_{call}_{samples}",
            "seam",
            f"{title}, {samples} samples",
            (ours("seam", call=call, samples=samples),),
            unit=("us", 1e6),
            turns=15,
        )

    return [
        row("core", "`_core.NeuralOE.simulate`", 100),
        row("core", "`_core.NeuralOE.simulate`", 1100),
        row("public", "`model.simulate(data, init=0)`", 100),
        row("public", "`model.simulate(data, init=0)`", 1100),
        row("rest", "a call that does nothing", 100),
    ]


def growth() -> list[Row]:
    rows = []
    for samples in (1000, 10_000, SAMPLES, 100_000, MILLION, 10 * MILLION):
        steps = max(2, min(60, 1_000_000 // samples))
        arguments = {"samples": samples}
        rows += [
            Row(
                f"growth_training_{samples}",
                "growth",
                f"LM iteration, N = {samples:,}",
                (
                    ours("grown_training", iterations=steps + 1, **arguments),
                    ours("grown_training", name="first", iterations=1, **arguments),
                ),
                unit=("ns/sample", 1e9),
                parts=steps * samples,
                less={"sewfast": "first"},
                turns=5 if samples <= MILLION else 2,
                quick=False,
            ),
            Row(
                f"growth_free_run_{samples}",
                "growth",
                f"free run, N = {samples:,}",
                (ours("free_run", **arguments),),
                unit=("ns/sample", 1e9),
                parts=samples,
                turns=5 if samples <= MILLION else 3,
                quick=False,
            ),
        ]
    for hidden in (8, 16, 32, 64):
        arguments = {"samples": SAMPLES, "hidden": hidden}
        rows += [
            Row(
                f"growth_hidden_{hidden}",
                "growth",
                f"LM iteration, {hidden} hidden units, {6 * hidden + 1} parameters",
                (
                    ours("grown_training", iterations=11, **arguments),
                    ours("grown_training", name="first", iterations=1, **arguments),
                ),
                unit=("ns/sample", 1e9),
                parts=10 * SAMPLES,
                less={"sewfast": "first"},
                turns=3,
                quick=False,
            ),
            Row(
                f"growth_hidden_run_{hidden}",
                "growth",
                f"free run, {hidden} hidden units",
                (ours("free_run", **arguments),),
                unit=("ns/sample", 1e9),
                parts=SAMPLES,
                turns=5,
                quick=False,
            ),
        ]
    rows += state_space_growth()
    rows += [
        Row(
            f"growth_starts_{starts}",
            "growth",
            f"100 iterations of {starts} starts, 2 cores, per start",
            (both(ours("several_starts", starts=starts, iterations=ITERATIONS, threads=2)),),
            parts=starts,
            turns=3,
            quick=False,
        )
        for starts in (1, 2, 4, 8, 16)
    ]
    return rows


def state_space_growth() -> list[Row]:
    sizes = [(samples, HIDDEN) for samples in (1000, 10_000, STATES, MILLION)]
    rows = []
    for samples, hidden in (*sizes, (STATES, 8), (STATES, 30)):
        steps = max(2, min(20, 1_000_000 // samples))
        arguments = {"samples": samples, "hidden": hidden}
        rows.append(
            Row(
                f"growth_neural_ss_{samples}_{hidden}",
                "growth",
                f"state-space LM iteration, {9 * hidden + 20} parameters, N = {samples:,}",
                (
                    ours("neural_ss", iterations=FIRST + steps, **arguments),
                    ours("neural_ss", name="first", iterations=FIRST, **arguments),
                ),
                unit=("ns/sample", 1e9),
                parts=steps * samples,
                less={"sewfast": "first"},
                turns=3,
                quick=False,
            )
        )
    return rows


def all_rows() -> list[Row]:
    """Every row, in the order of the page."""
    groups = (training, neural_ss, closed_loops, arx, machine, threads, seam, levels, growth)
    return [row for group in groups for row in group()]
