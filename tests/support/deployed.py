"""Deployed code against the step of the core, bit by bit: here and on an emulated Cortex-M4.

`make bits` runs every kind over ten million samples; with a state file, some minutes of it, from
where the last run stopped. Both sides compute their inputs from a
counter, and every result goes into one sum of its bits, each times an odd number of its own: equal
sums are equal results in equal order.
"""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from portions import portion
from sewfast import Biquad, Controller, Feedforward, Gains, Model, deploy
from sewfast_deploy.precision import combined_run, embedded_members

EMULATED = Path(__file__).parent / "emulated"
WARNINGS = ["-std=c99", "-Wall", "-Wextra", "-Wconversion", "-pedantic", "-Werror"]
CORTEX_M4 = [
    "-mcpu=cortex-m4", "-mthumb", "-mfloat-abi=hard", "-mfpu=fpv4-sp-d16", "-std=gnu99", "-O2",
    "-ffp-contract=off",
]  # fmt: skip
M4 = "thumbv7em-none-eabihf"
HOLD = 16
"""Samples for which an input stays."""

PROGRAM = """
#include <stdint.h>
#include <string.h>
#include "{name}.h"

typedef {bits} word;
void say(const char *text);

/* A number from 0 to 1 for each counter (the finaliser of MurmurHash3). */
static {name}_real drawn(uint32_t n)
{{
    n ^= n >> 16;
    n *= 0x85ebca6bu;
    n ^= n >> 13;
    n *= 0xc2b2ae35u;
    n ^= n >> 16;
    return ({name}_real)(n >> 8) / ({name}_real)16777216.0;
}}

int main(void)
{{
    uint64_t sum = 0, odd = 1;
    uint32_t k;
    char text[20];
    int i;
{declare}
    for (k = 0; k < {samples}u; k++) {{
        {name}_real y;
        word bits;
{step}
        memcpy(&bits, &y, sizeof bits);
        sum += (uint64_t)bits * odd;
        odd += 2;
    }}
    for (i = 15; i >= 0; i--) {{
        text[i] = "0123456789abcdef"[sum & 15];
        sum >>= 4;
    }}
    text[16] = '\\n';
    text[17] = 0;
    say(text);
    return 0;
}}
"""
HOST = """#include <stdio.h>
void say(const char *text);
void say(const char *text)
{
    fputs(text, stdout);
}
"""
MODEL = "    {name}_model model;\n    {name}_real u[{inputs}];\n    {name}_init(&model);\n"
PID = "    {name}_pid c;\n    {name}_init(&c);\n"


def drawn(n: np.ndarray[Any, Any], precision: str) -> np.ndarray[Any, Any]:
    """As in the program, for counters modulo 2^32."""
    n = n.astype(np.uint32)
    n ^= n >> np.uint32(16)
    n *= np.uint32(0x85EBCA6B)
    n ^= n >> np.uint32(13)
    n *= np.uint32(0xC2B2AE35)
    n ^= n >> np.uint32(16)
    real = np.float32 if precision == "f32" else np.float64
    return (n >> np.uint32(8)).astype(real) / real(16777216.0)


def checksum(y: np.ndarray[Any, Any], precision: str) -> str:
    """The sum of all bits, as the program prints it."""
    real, word = (np.float32, np.uint32) if precision == "f32" else (np.float64, np.uint64)
    bits = y.astype(real).view(word).astype(np.uint64)
    odd = np.arange(1, 2 * len(y), 2, dtype=np.uint64)
    return f"{int(np.sum(bits * odd, dtype=np.uint64)):016x}"


def spans(model: Model) -> list[tuple[float, float]]:
    """Lowest input and range, numbers that single precision holds."""
    known = model.training.get("input_range") or [[-3.0, 5.0]] * len(model.input_names)
    return [(float(np.float32(low)), float(np.float32(high - low))) for low, high in known]


def model_program(model: Model, name: str, precision: str, samples: int) -> str:
    """A program that steps a model over drawn inputs."""
    suffix = "f" if precision == "f32" else ""
    inputs = len(model.input_names)
    draw = "".join(
        f"        u[{j}] = {low!r}{suffix} + {span!r}{suffix} * "
        f"drawn(k / {HOLD}u * {inputs}u + {j}u);\n"
        for j, (low, span) in enumerate(spans(model))
    )
    return PROGRAM.format(
        name=name,
        bits="uint32_t" if precision == "f32" else "uint64_t",
        samples=samples,
        declare=MODEL.format(name=name, inputs=inputs),
        step=f"{draw}        y = {name}_step(&model, u);",
    )


def model_result(model: Model, precision: str, samples: int) -> str:
    """What the core makes of the same inputs."""
    k = np.arange(samples, dtype=np.uint32) // np.uint32(HOLD)
    inputs = len(model.input_names)
    real = np.float32 if precision == "f32" else np.float64
    columns = [
        real(low) + real(span) * drawn(k * np.uint32(inputs) + np.uint32(j), precision)
        for j, (low, span) in enumerate(spans(model))
    ]
    u = np.ascontiguousarray(np.stack(columns, axis=1), dtype=np.float64)
    members, embedded, combined = embedded_members(model, precision)
    return checksum(combined_run(members, embedded, combined, u, precision), precision)


def pid_program(controller: Controller, name: str, precision: str, samples: int) -> str:
    """A program that steps a controller; one measurement in 97 is not a number."""
    suffix = "f" if precision == "f32" else ""
    size = _size(controller)
    return PROGRAM.format(
        name=name,
        bits="uint32_t" if precision == "f32" else "uint64_t",
        samples=samples,
        declare=PID.format(name=name),
        step=(
            f"        const {name}_real r = {size!r}{suffix} * (drawn(k / 64u) - 0.5{suffix});\n"
            f"        {name}_real m = {size!r}{suffix} * (drawn(k + 77777u) - 0.5{suffix});\n"
            f"        m = k % 97u == 96u ? (m - m) / (m - m) : m;\n"
            f"        y = {name}_step_with(&c, r, m, 0.01{suffix} * m);"
        ),
    )


def pid_result(controller: Controller, precision: str, samples: int) -> str:
    """What the core makes of the same signals."""
    real = np.float32 if precision == "f32" else np.float64
    core: Any = controller.core()
    core = core.single() if precision == "f32" else core
    k = np.arange(samples, dtype=np.uint32)
    size = real(_size(controller))
    r = size * (drawn(k // np.uint32(64), precision) - real(0.5))
    m = size * (drawn(k + np.uint32(77777), precision) - real(0.5))
    m[96::97] = np.nan
    step = core.step
    feed = (real(0.01) * m).tolist()
    return checksum(
        np.array([step(*s) for s in zip(r.tolist(), m.tolist(), feed, strict=True)]), precision
    )


def _size(controller: Controller) -> float:
    return 8000.0 if controller.schedule else 4000.0


SECTIONS = (Biquad.notch(60.0), Biquad.low_pass(200.0), Biquad.lead_lag(40.0, 160.0))

LEVELS = ((-3000.0, -9.1), (-60.0, -0.9), (60.0, 0.9), (1500.0, 4.7), (3000.0, 9.3))
LEAD = Feedforward(8, 0.5, LEVELS, (0.004, 0.012, -0.003))

CONTROLLERS = {
    "pi": Controller(Gains.standard(0.02, 0.25)),
    "paper": Controller(
        Gains.per_sample(0.02, 0.02, 0.5, Ts=0.001), alpha=0.4, beta=0.2, u_min=-10.0, u_max=10.0
    ),
    "p alone": Controller(Gains.standard(-0.5, np.inf), u_min=-1.0, u_max=3.0),
    "filter": Controller(Gains.standard(0.02, 0.1, 0.01), N=10.0, filter_samples=8),
    "lag": Controller(Gains.standard(0.02, 0.1, 0.01), N=10.0, filter_time=0.004, filter_samples=3),
    "observer": Controller(Gains.standard(0.02, 0.1, 0.01), observer_time=0.005),
    "tracking": Controller(Gains.standard(0.02, 0.05), Tt=0.02, u_min=-8.0, u_max=8.0),
    "slew": Controller(Gains.standard(0.02, 0.05), slew=900.0, u_min=-8.0, u_max=8.0, alpha=-0.1),
    "ramp": Controller(Gains.standard(0.01, 0.2), r_rate=30000.0, u_min=2.0, u_max=20.0),
    "biquads": Controller(
        Gains.standard(0.02, 0.05, 0.002), N=10.0, u_min=-8.0, u_max=8.0, biquads=SECTIONS
    ),
    "everything": Controller(
        Gains.standard(0.02, 0.25, 0.004),
        alpha=0.4,
        beta=0.2,
        N=8.0,
        Tt=0.05,
        u_min=-20.0,
        u_max=20.0,
        slew=4000.0,
        filter_samples=8,
        filter_time=0.002,
        observer_time=0.003,
        r_rate=20000.0,
        biquads=SECTIONS,
        schedule=(
            (300.0, Gains.standard(0.01, 0.3, 0.002)),
            (1000.0, Gains.standard(0.02, 0.2, 0.004)),
            (3000.0, Gains.standard(0.03, 0.1, 0.001)),
        ),
    ),
    "ahead": Controller(
        Gains.standard(0.02, 0.05, 0.002),
        N=10.0,
        u_min=-16.0,
        u_max=16.0,
        filter_samples=5,
        filter_time=0.002,
        feedforward=LEAD,
    ),
    "levels ahead": Controller(
        Gains.standard(0.02, 0.25), r_rate=30000.0, feedforward=Feedforward(0, 0.0, LEVELS[2:])
    ),
    "a level ahead": Controller(
        Gains.standard(-0.5, np.inf),
        u_min=-1.0,
        u_max=3.0,
        feedforward=Feedforward(30, 1.0, LEVELS[:1], (0.01,)),
    ),
    "taps ahead": Controller(
        Gains.standard(0.02, 0.1, 0.01),
        observer_time=0.005,
        biquads=SECTIONS,
        feedforward=Feedforward(1, 0.25, (), tuple(0.02 * 0.7**k for k in range(16))),
    ),
}
CONTROLLERS["everything ahead"] = replace(
    CONTROLLERS["everything"],
    feedforward=Feedforward(
        12, 0.5, ((-4000.0, -14.0), (-100.0, -1.5), *LEVELS[1:], (3500.0, 11.0), (4000.0, 14.0)),
        tuple(0.01 * (-0.8) ** k for k in range(12)),
    ),
)  # fmt: skip


def compilers() -> list[str]:
    """gcc and clang, where they are."""
    return [name for name in ("gcc", "clang") if shutil.which(name)]


def emulator() -> bool:
    """Whether programs for a Cortex-M4 can be made and run."""
    return all(shutil.which(name) for name in ("arm-none-eabi-gcc", "qemu-system-arm"))


def host(folder: Path, name: str, compiler: str, optimise: str = "-O2") -> str:
    """What the program in `folder` prints, compiled for this computer."""
    (folder / "host.c").write_text(HOST)
    program = folder / f"{name}_{compiler}"
    sources = [str(folder / f) for f in (f"{name}.c", "main.c", "host.c")]
    contract = "-ffp-contract=off"
    subprocess.run(
        [compiler, *WARNINGS, optimise, contract, *sources, "-o", str(program)], check=True
    )
    done = subprocess.run([program], capture_output=True, text=True, check=True)
    return done.stdout.strip()


COUNTED = """
#include <stdint.h>
#include "{name}.h"

void say(const char *text);

int main(void)
{{
    volatile uint32_t *const timer = (uint32_t *)0x40000000u;
    volatile {name}_real sink;
    uint32_t k, ticks;
    char text[12];
    int i;
{declare}
    timer[2] = timer[1] = 0xffffffffu;
    timer[0] = 1u;
    for (k = 0; k < {samples}u; k++) {{
{step}
    }}
    ticks = 0xffffffffu - timer[1];
    for (i = 9; i >= 0; i--) {{
        text[i] = (char)('0' + ticks % 10u);
        ticks /= 10u;
    }}
    text[10] = '\\n';
    text[11] = 0;
    say(text);
    return 0;
}}
"""


def instructions(what: Model | Controller, folder: Path, precision: str) -> float:
    """Instructions of a step on the emulated Cortex-M4, its caller's loop included.

    QEMU counts instructions, not cycles: its clock moves a nanosecond with each, and a timer of
    25 MHz reads it.
    """
    deploy(what, folder, precision=precision, name="code")
    samples = 5000
    if isinstance(what, Controller):
        declare = PID.format(name="code")
        step = "        sink = code_step(&c, (code_real)(k & 1023u), (code_real)(k & 511u));"
    else:
        inputs = len(what.input_names)
        declare = MODEL.format(name="code", inputs=inputs)
        fill = "".join(f"        u[{j}] = (code_real)(k & 3u);\n" for j in range(inputs))
        step = f"{fill}        sink = code_step(&model, u);"
    text = COUNTED.format(name="code", declare=declare, step=step, samples=samples)
    (folder / "main.c").write_text(text)
    return int(cortex_m4(folder, "code", "-icount", "shift=0")) * 40 / samples


def cortex_m4(folder: Path, name: str, *options: str) -> str:
    """The same on the emulated Cortex-M4."""
    return emulated(folder, [folder / f"{name}.c", folder / "main.c"], *options)


def emulated(folder: Path, parts: list[Path], *options: str) -> str:
    """What a program of these sources and libraries prints on the emulated Cortex-M4."""
    program = folder / "program.elf"
    subprocess.run(
        ["arm-none-eabi-gcc", *CORTEX_M4, "-nostartfiles", "-Wl,--gc-sections,-z,noexecstack",
         "-T", str(EMULATED / "mps2.ld"), str(EMULATED / "start.c"), *map(str, parts),
         "-o", str(program)],
        check=True,
    )  # fmt: skip
    done = subprocess.run(
        ["qemu-system-arm", "-M", "mps2-an386", "-kernel", str(program), "-display", "none",
         "-monitor", "none", "-serial", "none", "-semihosting-config", "enable=on,target=native",
         *options],
        capture_output=True, text=True, check=True,
    )  # fmt: skip
    return (done.stdout + done.stderr).strip()


def prepared(what: Model | Controller, folder: Path, precision: str, samples: int) -> str:
    """Deploys into `folder`, with a program around; what it is to print."""
    deploy(what, folder, precision=precision, name="code")
    if isinstance(what, Controller):
        program, expected = pid_program, pid_result(what, precision, samples)
        (folder / "main.c").write_text(program(what, "code", precision, samples))
        return expected
    (folder / "main.c").write_text(model_program(what, "code", precision, samples))
    return model_result(what, precision, samples)


def cases() -> Iterator[tuple[str, Model | Controller]]:
    """Every kind of model, and controllers with everything that one may have."""
    import kinds

    for name in kinds.DEPLOYED:
        yield name, kinds.model_of(name)
    yield from CONTROLLERS.items()


def costs() -> Iterator[tuple[str, Model | Controller]]:
    """What the table of docs/deploy.md is about."""
    import kinds
    from sewfast import NeuralOE, _core

    yield "PI controller", CONTROLLERS["pi"]
    yield "mean of 8 samples and derivative", CONTROLLERS["filter"]
    everything = CONTROLLERS["everything"]
    yield "everything: schedule, observer, ramp, slew", replace(everything, biquads=())
    four = (*SECTIONS, Biquad.notch(90.0))
    yield "everything and four biquads", replace(everything, biquads=four)
    levels = [(1000.0 * k, 3.0 * k) for k in range(-3, 4)]
    short = replace(
        CONTROLLERS["filter"], feedforward=Feedforward(8, 0.5, levels[1:-1], [0.01] * 8)
    )
    yield "mean of 8, derivative, feedforward of 5 levels and 8 taps", short
    whole = Feedforward(30, 0.5, [*levels, (4000.0, 12.0)], [0.01] * 16)
    yield (
        "everything and feedforward of 8 levels and 16 taps",
        replace(everything, biquads=(), feedforward=whole),
    )
    yield "linear model, second order", kinds.model_of("oe")
    rng, width, hidden = np.random.default_rng(4), 4, 8
    core = _core.NeuralOE(
        na=2, nb=2, nk=1, n_inputs=1, hidden=hidden, bypass=True,
        theta=np.append(0.3 * rng.normal(size=hidden * (width + 2) + 1), [0.9, -0.2, 0.2, 0.1]),
        u_mean=np.array([1.0]), u_scale=np.array([2.3]), y_mean=4.0, y_scale=8.0,
        output_low=None, output_high=None,
    )  # fmt: skip
    known = {"input_range": [[-3.0, 5.0]]}
    network = NeuralOE(core, 0.001, ("u",), "y", ("V",), "RPM", None, known)
    yield "network, 8 tanh, 2 past outputs and inputs", network
    yield "neural state space, 2 states, 3 tanh", kinds.model_of("neural_ss")


def sizes(folder: Path, kind: str) -> tuple[int, int]:
    """Bytes of code and tables for the Cortex-M4, and of a controller's or model's memory."""
    (folder / "memory.c").write_text(f'#include "code.h"\ncode_{kind} memory;\n')
    found = []
    for name in ("code", "memory"):
        built = str(folder / f"{name}.o")
        source = str(folder / f"{name}.c")
        subprocess.run(["arm-none-eabi-gcc", *CORTEX_M4, "-c", source, "-o", built], check=True)
        size = subprocess.run(
            ["arm-none-eabi-size", built], capture_output=True, text=True, check=True
        )
        found.append([int(v) for v in size.stdout.splitlines()[1].split()[:3]])
    return sum(found[0][:2]), sum(found[1])


def print_positions() -> None:
    """Instructions and memory of the position loop, which is deployed as Rust alone."""
    rust = ["cargo", "build", "--release", "--quiet", "-Zbuild-std=core", "--target", M4]
    crate = EMULATED / "position"
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        own = {"RUSTC": "/usr/bin/rustc", "RUSTC_BOOTSTRAP": "1", "CARGO_TARGET_DIR": place}
        subprocess.run(rust, cwd=crate, env={**os.environ, **own}, check=True)
        library = folder / M4 / "release" / "libposition_steps.a"
        found = emulated(folder, [library], "-icount", "shift=0")
    print("\n| position loop, f32 | instructions a step, mean | most |\n|---|---|---|")
    *phases, memory = found.splitlines()
    for line in phases:
        mean, most = (int(number) for number in line[32:].split())
        print(f"| {line[:32].strip()} | {mean:,} | {most:,} |")
    beyond, speed = (int(number) for number in memory[32:].split())
    print(f"{beyond} bytes beyond the {speed:,} of its speed loop", flush=True)


def print_costs() -> int:
    """The table of docs/deploy.md, and the figures of docs/positions.md."""
    print("| | instructions a step, f32 | f64 | bytes of code and tables, f32 | of memory, f32 |")
    print("|---|---|---|---|---|")
    for name, what in costs():
        with tempfile.TemporaryDirectory() as place:
            folder = Path(place)
            double, single = (instructions(what, folder, p) for p in ("f64", "f32"))
            code, memory = sizes(folder, "pid" if isinstance(what, Controller) else "model")
        print(f"| {name} | {single:.0f} | {double:,.0f} | {code:,} | {memory} |", flush=True)
    print_positions()
    return 0


@dataclass(frozen=True)
class Comparison:
    """A deployed model or controller in one precision."""

    name: str
    what: Model | Controller
    precision: str

    def __str__(self) -> str:
        return f"{self.name}, {self.precision}"

    def same(self, samples: int, emulated: int) -> dict[str, bool]:
        """Whether it computes the core's bits, by compiler and on the emulated processor."""
        found = {}
        with tempfile.TemporaryDirectory() as place:
            folder = Path(place)
            expected = prepared(self.what, folder, self.precision, samples)
            for compiler in compilers():
                found[compiler] = host(folder, "code", compiler) == expected
            if emulator():
                few = emulated if self.precision == "f32" else emulated // 10
                expected = prepared(self.what, folder, self.precision, few)
                found["cortex-m4"] = cortex_m4(folder, "code") == expected
        return found


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--costs", action="store_true", help="instructions and sizes instead")
    parser.add_argument("--samples", type=int, default=10_000_000)
    parser.add_argument("--emulated", type=int, default=1_000_000, help="a tenth of it in f64")
    parser.add_argument("--state", type=Path, help="file that says where to go on")
    parser.add_argument("--minutes", type=float, default=float("inf"), help="begin none later")
    args = parser.parse_args()
    if args.costs:
        return print_costs()
    wrong = total = 0
    work = [Comparison(name, what, p) for name, what in cases() for p in ("f64", "f32")]
    for comparison in portion(work, args.state, args.minutes):
        began = time.perf_counter()
        found = comparison.same(args.samples, args.emulated)
        total += len(found)
        wrong += sum(not same for same in found.values())
        words = ", ".join(f"{k} {'same' if v else 'DIFFERS'}" for k, v in found.items())
        print(f"{comparison}: {words} ({time.perf_counter() - began:.1f} s)", flush=True)
    print(f"{wrong} of {total} comparisons differ")
    return wrong != 0


if __name__ == "__main__":
    sys.exit(main())
