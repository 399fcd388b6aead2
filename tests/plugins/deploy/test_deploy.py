"""Deployed code: to the last bit the step of the core, on every compiler and processor here."""

from __future__ import annotations

import ctypes
import errno
import json
import math
import os
import re
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import deployed
import kinds
from sewfast import Controller, Dataset, Ensemble, Gains, LinearOE, Model, _core, deploy, identify
from sewfast.cli import main
from sewfast.errors import FitError, ModelFileError, SettingError
from sewfast_deploy.precision import combined_run, embedded_members

needs_compiler = pytest.mark.skipif(not deployed.compilers(), reason="needs gcc or clang")
PRECISIONS = ("f64", "f32")
CASES = dict(deployed.cases())
EMULATED = ("neural_oe", "neural_ss, saturation", "ensemble of mixed kinds", "everything")
SAMPLES = 20_000


@pytest.mark.nightly(
    "the same for every kind",
    by_day=[
        "oe-f64",
        "neural_oe-f32",
        "neural_ss, saturation-f64",
        "ensemble of mixed kinds-f64",
    ],
)
@needs_compiler
@pytest.mark.parametrize("precision", PRECISIONS)
@pytest.mark.parametrize("name", CASES)
def test_the_code_has_the_bits_of_the_core(name: str, precision: str, tmp_path: Path) -> None:
    expected = deployed.prepared(CASES[name], tmp_path, precision, SAMPLES)
    for compiler in deployed.compilers():
        assert deployed.host(tmp_path, "code", compiler) == expected


@pytest.mark.nightly("every level", by_day=["-Os"])
@needs_compiler
@pytest.mark.parametrize("optimise", ["-O0", "-Os", "-O3"])
def test_no_optimisation_changes_a_bit(optimise: str, tmp_path: Path) -> None:
    expected = deployed.prepared(CASES["ensemble of mixed kinds"], tmp_path, "f64", SAMPLES)
    for compiler in deployed.compilers():
        assert deployed.host(tmp_path, "code", compiler, optimise) == expected


@pytest.mark.nightly("the board for every kind", by_day=["neural_oe-f32", "everything-f64"])
@pytest.mark.skipif(not deployed.emulator(), reason="needs arm-none-eabi-gcc and qemu-system-arm")
@pytest.mark.parametrize("precision", PRECISIONS)
@pytest.mark.parametrize("name", EMULATED)
def test_an_emulated_processor_has_the_same_bits(name: str, precision: str, tmp_path: Path) -> None:
    expected = deployed.prepared(CASES[name], tmp_path, precision, 2000)
    assert deployed.cortex_m4(tmp_path, "code") == expected


@pytest.mark.skipif(shutil.which("g++") is None, reason="needs g++")
def test_the_sketch_controls_a_motor_as_the_core_would(tmp_path: Path) -> None:
    """Each duty of examples/firmware/sketch is that of the core for the same counts."""
    gains = Gains.standard(Kp=0.01, Ti=0.05, Td=0.0)  # V/RPM, s
    controller = Controller(gains, Ts=0.001, u_min=-24, u_max=24)
    deploy(controller, tmp_path)
    here = Path(__file__).parents[2] / "support"
    sketch = here.parents[1] / "examples" / "firmware" / "sketch"
    folders = [f"-I{place}" for place in (here / "arduino", sketch, tmp_path)]
    sources = [str(here / "arduino" / "main.cpp"), str(tmp_path / "controller.c")]
    built = tmp_path / "sketch"
    flags = ["-Wall", "-Wextra", "-Werror", "-ffp-contract=off", "-x", "c++"]
    subprocess.run(["g++", *flags, *folders, *sources, "-o", str(built)], check=True)
    made = subprocess.run([str(built)], check=True, capture_output=True, text=True)
    counts, duties = np.array([line.split() for line in made.stdout.splitlines()], dtype=int).T
    # the sketch sees at each period what the motor had done by the one before
    seen = np.concatenate([[0, 0], counts[:-1]])
    core = controller.core().single()
    scale = np.float32(60e6) / np.float32(1572.0) / np.float32(1000.0)
    for moved, duty in zip(np.diff(seen), duties, strict=True):
        u = core.step(1000.0, float(np.float32(moved) * scale))
        assert duty == math.copysign(int(abs(u) / 24 * 255 + 0.5), u)
    speeds = np.diff(counts) * float(scale)
    assert abs(speeds[-100:].mean() - 1000.0) < 10.0


@pytest.mark.nightly(
    "the same for every controller",
    by_day=["pi-f32", "everything-f64", "ramp-f64", "ahead-f32"],
)
@needs_compiler
@pytest.mark.parametrize("precision", PRECISIONS)
@pytest.mark.parametrize("name", deployed.CONTROLLERS)
def test_hostile_inputs_and_changes_of_mode_keep_the_bits(
    name: str, precision: str, tmp_path: Path
) -> None:
    controller = deployed.CONTROLLERS[name]
    code = _library(controller, tmp_path, precision)
    memory = ctypes.create_string_buffer(4096)
    code.code_init(memory)
    core: Any = controller.core()
    core = core.single() if precision == "f32" else core
    rng = np.random.default_rng(7)
    hostile = [np.nan, np.inf, -np.inf, 1e300, -1e38, 1e-310, -0.0, 3e38]
    for k in range(4000):
        r, y, extra = rng.normal(0.0, 1000.0, 3)
        if rng.uniform() < 0.05:
            r, y, extra = (rng.choice(hostile) if rng.uniform() < 0.4 else v for v in (r, y, extra))
        if rng.uniform() < 0.02:
            u = float(rng.choice([*hostile[:4], 1.0, -50.0]))
            taken = code.code_set_manual(memory, u)
            finite = math.isfinite(u) and (precision == "f64" or abs(u) < 3.5e38)
            assert bool(taken) == finite
            if finite:
                core.set_manual(u)
        if rng.uniform() < 0.02:
            code.code_set_automatic(memory)
            core.set_automatic()
        # what is too large for single precision is infinite on both sides
        found, expected = code.code_step_with(memory, r, y, extra), core.step(r, y, extra)
        assert found == expected, (k, r, y, extra)
        assert np.isfinite(found)


CHANGING = (
    "pi", "paper", "p alone", "lag", "tracking", "slew", "biquads", "ahead", "levels ahead",
    "taps ahead",
)  # fmt: skip


@pytest.mark.nightly("the same for every controller", by_day=["tracking-f64", "taps ahead-f32"])
@needs_compiler
@pytest.mark.parametrize("precision", PRECISIONS)
@pytest.mark.parametrize("name", CHANGING)
def test_gains_and_limits_change_as_the_core_changes_its_design(
    name: str, precision: str, tmp_path: Path
) -> None:
    """At any moment, to anything: in manual, before the first sample, among hostile inputs."""
    controller = deployed.CONTROLLERS[name]
    code = _library(controller, tmp_path, precision, changeable=True)
    memory = ctypes.create_string_buffer(4096)
    code.code_init(memory)
    core: Any = controller.core()
    core = core.single() if precision == "f32" else core
    rng = np.random.default_rng(11)
    bumps = []
    for k in range(4000):
        r, y = 500.0 + 1000.0 * (k // 700 % 2), rng.normal(450.0, 30.0)
        if rng.uniform() < 0.02:
            y = float(rng.choice([np.nan, np.inf, -np.inf, 3e4]))
        if rng.uniform() < 0.02:
            r = float(rng.choice([np.nan, np.inf, -np.inf, 0.0]))
        if rng.uniform() < 0.02:
            u = rng.uniform(-12.0, 12.0)
            code.code_set_manual(memory, u)
            core.set_manual(u)
        if rng.uniform() < 0.05:
            code.code_set_automatic(memory)
            core.set_automatic()
        if k == 0 or rng.uniform() < 0.05:
            gains = (rng.uniform(-0.05, 0.05), *rng.uniform(0.01, 1.0, 2) * (1.0, 0.05))
            gains = (gains[0], math.inf if rng.uniform() < 0.3 else gains[1], gains[2])
            gains = (*gains[:2], 0.0) if rng.uniform() < 0.3 else gains
            controller = replace(controller, gains=Gains.standard(*gains))
            assert code.code_set_gains(memory, *gains) == 1
            core.set_design(_core_of(controller, precision))
        if k == 0 or rng.uniform() < 0.02:
            low, high = np.sort(rng.uniform(-20.0, 20.0, 2))
            controller = replace(controller, u_min=low, u_max=high)
            assert code.code_set_limits(memory, low, high) == 1
            core.set_design(_core_of(controller, precision))
        for wrong in ((math.nan, 1, 0), (math.inf, 1, 0), (1, 0, 0), (1, -1, 0), (1, math.nan, 0),
                      (1, 1, -1), (1, 1, math.inf), (1, 1, math.nan)):  # fmt: skip
            assert code.code_set_gains(memory, *wrong) == 0
        for wrong in ((1, 1), (2, 1), (math.nan, 1), (0, math.nan), (math.inf, math.inf)):
            assert code.code_set_limits(memory, *wrong) == 0
        found, expected = code.code_step(memory, r, y), core.step(r, y)
        assert found == expected, (k, r, y)
        bumps.append(found)
    assert len(set(bumps)) > 300


@needs_compiler
def test_a_change_of_gains_is_bumpless(tmp_path: Path) -> None:
    controller = Controller(Gains.standard(0.02, 0.1, 0.004), N=10.0, u_min=-24, u_max=24)
    code = _library(controller, tmp_path, "f64", changeable=True)
    memory = ctypes.create_string_buffer(4096)
    code.code_init(memory)
    y, u = 0.0, 0.0
    for _ in range(3000):
        u = code.code_step(memory, 1000.0, y)
        y += 0.001 / 0.15 * (300.0 * u - y)
    code.code_set_gains(memory, 0.001, 2.0, 0.0)
    changed = code.code_step(memory, 1000.0, y)
    assert abs(changed - u) < 1e-6 * abs(u)
    # and it is the new gains that act: 100 RPM more are 0.1 V at once
    moved = code.code_step(memory, 1100.0, y) - changed
    assert abs(moved - 0.1) < 1e-3


@needs_compiler
def test_what_has_no_gains_to_change_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for what, to in (
        (CASES["pi"], "st"),
        (kinds.model_of("oe"), "c99"),
        (CASES["everything"], "c99"),
    ):
        with pytest.raises(SettingError, match="changeable: expected"):
            deploy(what, tmp_path / "out", to=to, changeable=True)
    assert not (tmp_path / "out").exists()
    CASES["pi"].save(tmp_path / "pi.json")
    assert main(["deploy", str(tmp_path / "pi.json"), str(tmp_path / "out"), "--changeable"]) == 0
    assert "controller_set_gains" in capsys.readouterr().out
    sources = [str(tmp_path / "out" / f"controller{end}.c") for end in ("", "_test")]
    for compiler in deployed.compilers():
        built = [compiler, *deployed.WARNINGS, "-ffp-contract=off", *sources, "-o"]
        subprocess.run([*built, str(tmp_path / "test")], check=True)
        done = subprocess.run([tmp_path / "test"], capture_output=True, text=True, check=True)
        assert done.stdout == "0 of 200 samples differ\n"


def _core_of(controller: Controller, precision: str) -> Any:
    core = controller.core()
    return core.single() if precision == "f32" else core


def _library(
    controller: Controller, folder: Path, precision: str, *, changeable: bool = False
) -> ctypes.CDLL:
    """The deployed controller as a shared library."""
    deploy(controller, folder, precision=precision, name="code", changeable=changeable)
    flags = [*deployed.WARNINGS, "-O2", "-ffp-contract=off", "-fPIC", "-shared"]
    library = folder / "code.so"
    subprocess.run(
        [deployed.compilers()[0], *flags, str(folder / "code.c"), "-o", str(library)], check=True
    )
    code = ctypes.CDLL(str(library))
    real: Any = ctypes.c_float if precision == "f32" else ctypes.c_double
    of = ctypes.c_void_p
    code.code_step.argtypes, code.code_step.restype = [of, real, real], real
    code.code_step_with.argtypes, code.code_step_with.restype = [of, real, real, real], real
    code.code_set_manual.argtypes = [of, real]
    code.code_set_automatic.argtypes = code.code_init.argtypes = [of]
    if changeable:
        code.code_set_gains.argtypes, code.code_set_limits.argtypes = (
            [of, *3 * [real]],
            [of, real, real],
        )
    return code


def test_the_sum_of_bits_sees_every_bit_and_the_order() -> None:
    y = np.random.default_rng(0).normal(size=100)
    sums = {deployed.checksum(y, "f64"), deployed.checksum(y[::-1], "f64")}
    for k in (0, 57, 99):
        other = y.copy()
        other[k] = np.nextafter(y[k], 9.0)
        sums.add(deployed.checksum(other, "f64"))
    assert len(sums) == 5


@needs_compiler
@pytest.mark.parametrize("precision", PRECISIONS)
@pytest.mark.parametrize("name", ["neural_ss, two inputs", "everything"])
def test_the_test_beside_the_code_passes_and_can_fail(
    name: str, precision: str, tmp_path: Path
) -> None:
    deploy(CASES[name], tmp_path, precision=precision, name="drive")

    def outcome(source: str) -> int:
        (tmp_path / "drive.c").write_text(source)
        files = [str(tmp_path / f) for f in ("drive.c", "drive_test.c")]
        built = [deployed.compilers()[0], *deployed.WARNINGS, "-ffp-contract=off", *files]
        subprocess.run([*built, "-o", str(tmp_path / "test")], check=True)
        return subprocess.run([tmp_path / "test"], capture_output=True).returncode

    right = (tmp_path / "drive.c").read_text()
    assert outcome(right) == 0
    # one digit of the first long number
    number = re.search(r"(\d\.\d{4,})", right)
    assert number
    changed = number[1][:3] + str((int(number[1][3]) + 5) % 10) + number[1][4:]
    assert outcome(right.replace(number[1], changed, 1)) == 1


def test_double_precision_is_the_baselines_free_run() -> None:
    """In a process of its own: the level of the kernels is chosen as the package is loaded."""
    program = """
import kinds, numpy as np
from sewfast_deploy.precision import combined_run, embedded_members
for name in kinds.DEPLOYED:
    model = kinds.model_of(name)
    u = kinds.levels(3000, 4, len(model.input_names))
    u[0] = 0.0
    free = model.core.simulate(u, model.core.rest_state())
    step = combined_run(*embedded_members(model, "f64"), u, "f64")
    exact = all(
        m.kind != "neural_ss" or (m.orders["nx"] <= 4 and m.settings["output"] == "linear")
        for m in model.members or (model,)
    )
    span = np.ptp(free)
    assert np.abs(free - step).max() <= (0.0 if exact else 1e-13 * span), name
print("alike")
"""
    environment = {**os.environ, "SEWFAST_CPU": "baseline"}
    paths = [str(Path(deployed.__file__).parent), environment.get("PYTHONPATH", "")]
    environment["PYTHONPATH"] = os.pathsep.join(paths)
    done = subprocess.run(
        [sys.executable, "-c", program], env=environment, capture_output=True, text=True
    )
    assert done.stdout == "alike\n", done.stderr


@needs_compiler
@pytest.mark.parametrize("kind", ["oe", "neural_oe"])
def test_a_deployed_plant_begins_at_its_operating_point(kind: str, tmp_path: Path) -> None:
    """An oven at 70 degrees under 30 % stays there; it does not heat up from zero."""
    u = np.repeat([30.0, 60.0, 45.0, 80.0, 20.0, 55.0], [60, 80, 80, 80, 80, 80])
    y = np.full(len(u), 70.0)
    for k in range(1, len(u)):
        y[k] = y[k - 1] + 0.05 * (70.0 + 0.8 * (u[k - 1] - 30.0) - y[k - 1])
    y += np.random.default_rng(0).normal(scale=0.02, size=len(y))
    data = Dataset.from_arrays(u, y, Ts=1.0)
    model = identify(data, model=kind, seed=0, time_budget=3.0)
    assert model.rest.u == (30.0,)
    deploy(model, tmp_path, precision="f64", name="oven")
    (tmp_path / "main.c").write_text(
        '#include <stdio.h>\n#include "oven.h"\nint main(void) {'
        " oven_model m; double u = 30.0; int k; oven_init(&m);"
        ' for (k = 0; k < 50; k++) printf("%.17g\\n", oven_step(&m, &u)); return 0; }'
    )
    files = [str(tmp_path / f) for f in ("oven.c", "main.c")]
    subprocess.run(
        [deployed.compilers()[0], "-ffp-contract=off", *files, "-o", str(tmp_path / "run")],
        check=True,
    )
    said = subprocess.run([tmp_path / "run"], capture_output=True, check=True).stdout
    found = np.array(said.split(), dtype=float)
    # the model errs at the operating point by a part of the noise, which loops leave out
    assert np.abs(found - model.rest.y).max() < 0.01
    assert abs(model.rest.y - 70.0) < 0.05


# --- Structured text ------------------------------------------------------------------------------


class Block:
    """A function block, run in Python: its statements have the same words in another order.

    Only what the package writes is understood; numbers are numpy's of the block's type.
    """

    def __init__(self, text: str) -> None:
        text = re.sub(r"\(\*.*?\*\)", "", text, flags=re.S)
        self.real: Any = np.float32 if ": REAL" in text else np.float64
        declared, body = re.match(
            r"\s*FUNCTION_BLOCK \w+(.*END_VAR)(.*)END_FUNCTION_BLOCK\s*$", text, flags=re.S
        ).groups()  # type: ignore[union-attr]
        self.values: dict[str, Any] = {"real": self.real, "NOT": None}
        for names, kind, first in re.findall(
            r"([\w, ]+) : ([\w.\[\] ]+?)(?: := (.+?))?;", declared
        ):
            for name in names.split(","):
                self.values[name.strip()] = self._first(kind, first)
        self.program = compile("\n".join(self._lines(body)), "block", "exec")

    def _first(self, kind: str, first: str) -> Any:
        array = re.match(r"ARRAY\[0\.\.(\d+)\] OF", kind)
        if array:
            return [self.real(0.0)] * (int(array[1]) + 1)
        if kind in ("BOOL", "INT"):
            return False if kind == "BOOL" else 0
        return eval(self._expression(first), {"real": self.real}) if first else self.real(0.0)

    def _expression(self, text: str) -> str:
        text = re.sub(r"L?REAL#(-?[\d.]+(?:E[-+]?\d+)?)", r"real('\1')", text)
        text = re.sub(r"(?<![:<>])=", "==", text)
        words = {"NOT": "not", "AND": "and", "OR": "or", "TRUE": "True", "FALSE": "False"}
        return re.sub(r"\b(NOT|AND|OR|TRUE|FALSE)\b", lambda m: words[m[1]], text)

    def _lines(self, body: str) -> list[str]:
        lines, depth = [], 0
        for line in filter(None, (raw.strip() for raw in body.splitlines())):
            indent = "    " * depth
            if line in ("END_IF;", "END_FOR;"):
                depth -= 1
            elif line == "ELSE":
                lines.append("    " * (depth - 1) + "else:")
            elif found := re.fullmatch(r"IF (.*) THEN", line):
                lines.append(f"{indent}if {self._expression(found[1])}:")
                depth += 1
            elif found := re.fullmatch(r"FOR (\w+) := (\d+) TO (\d+) DO", line):
                lines.append(f"{indent}for {found[1]} in range({found[2]}, {found[3]} + 1):")
                depth += 1
            else:
                found = re.fullmatch(r"(\w+|\w+\[[\w -]+\]) := (.*);", line)
                assert found, line
                lines.append(f"{indent}{found[1]} = {self._expression(found[2])}")
        assert depth == 0
        return lines

    def step(self, **inputs: Any) -> float:
        self.values.update(inputs)
        with np.errstate(all="ignore"):
            exec(self.program, self.values)
        return float(self.values["u"])


@pytest.mark.parametrize("precision", PRECISIONS)
@pytest.mark.parametrize("name", deployed.CONTROLLERS)
def test_structured_text_has_the_bits_of_the_core(
    name: str, precision: str, tmp_path: Path
) -> None:
    controller = deployed.CONTROLLERS[name]
    deploy(controller, tmp_path, to="st", precision=precision, name="speed_loop")
    block = Block((tmp_path / "speed_loop.st").read_text())
    real: Any = np.float32 if precision == "f32" else np.float64
    core: Any = controller.core()
    core = core.single() if precision == "f32" else core
    rng = np.random.default_rng(1)
    for k in range(600):
        if k == 250:
            core.set_manual(1.0)
        if k == 300:
            core.set_automatic()
        r, y = real(rng.uniform(-2000, 2000) if k % 40 == 0 else 500.0), real(rng.normal(0, 900))
        if k % 50 == 49:
            y = real(np.nan)
        manual = 250 <= k < 300
        found = block.step(
            r=r, y=y, feedforward=real(-0.0), manual=manual, u_manual=real(1.0), restart=False
        )
        assert found == core.step(float(r), float(y), -0.0), k


NO_NUMBERS = (math.nan, math.inf, -math.inf)
HUGE = (1.7e308, -1e308, 3e38, -2e38, 1e30)


@pytest.mark.nightly("every controller", by_day=["everything-f64", "everything ahead-f32"])
@needs_compiler
@pytest.mark.parametrize("precision", PRECISIONS)
@pytest.mark.parametrize("name", deployed.CONTROLLERS)
def test_what_is_no_number_does_the_same_everywhere(
    name: str, precision: str, tmp_path: Path
) -> None:
    """NaN, infinity and numbers that overflow, at random in every input: core, C and PLC agree."""
    controller = deployed.CONTROLLERS[name]
    core = _core_of(controller, precision)
    code = _library(controller, tmp_path, precision)
    memory = ctypes.create_string_buffer(4096)
    code.code_init(memory)
    deploy(controller, tmp_path, to="st", precision=precision, name="block")
    block = Block((tmp_path / "block.st").read_text())
    real: Any = np.float32 if precision == "f32" else np.float64
    rng = np.random.default_rng(41)
    manual, moved = False, set()
    for k in range(3000):
        often = (0.01, 0.2)[k // 300 % 2]
        r, y, extra, u = (float(v) for v in rng.normal(0.0, (900.0, 900.0, 3.0, 5.0)))
        r, y, extra, u = (
            float(rng.choice((*NO_NUMBERS, *HUGE[: 5 * (k > 1500)])))
            if rng.uniform() < often
            else v
            for v in (r, y, extra, u)
        )
        with np.errstate(over="ignore"):
            r, y, extra, u = (float(real(v)) for v in (r, y, extra, u))
        manual = manual if rng.uniform() > 0.03 else not manual
        if manual:
            code.code_set_manual(memory, u)
            if math.isfinite(u):
                core.set_manual(u)
        else:
            code.code_set_automatic(memory)
            core.set_automatic()
        if restart := bool(rng.uniform() < 0.004):
            code.code_init(memory)
            core.reset()
            if manual and math.isfinite(u):
                code.code_set_manual(memory, u)
                core.set_manual(u)
        expected = core.step(r, y, extra)
        found = code.code_step_with(memory, r, y, extra)
        of_block = block.step(
            r=real(r), y=real(y), feedforward=real(extra), manual=manual, u_manual=real(u),
            restart=restart,
        )  # fmt: skip
        assert math.isfinite(expected)
        assert (found, of_block) == (expected, expected), (k, r, y, extra, u, manual)
        assert float(block.values["y_filtered"]) == core.filtered, k
        moved.add(expected)
    assert len(moved) > 200


def test_a_model_is_no_function_block(tmp_path: Path) -> None:
    with pytest.raises(SettingError, match="structured text"):
        deploy(kinds.model_of("oe"), tmp_path, to="st")


# --- What is refused, and what is written ---------------------------------------------------------


@pytest.mark.parametrize(
    "name", ["", "9x", "Drive", "a-b", "int", "x" * 60, "a b", "../a", "é", "a_test", "fmi3"]
)
def test_names_that_are_none_in_c_are_refused(name: str, tmp_path: Path) -> None:
    with pytest.raises(SettingError, match="name: expected"):
        deploy(CASES["pi"], tmp_path / "out", name=name)
    assert not (tmp_path / "out").exists()


def test_what_cannot_be_deployed_is_refused(tmp_path: Path) -> None:
    with pytest.raises(SettingError, match="precision: expected"):
        deploy(CASES["pi"], tmp_path, precision="f16")
    with pytest.raises(SettingError, match="to: expected"):
        deploy(CASES["pi"], tmp_path, to="rust")
    with pytest.raises(SettingError, match="a model or a controller"):
        deploy("controller.json", tmp_path)  # type: ignore[arg-type]
    (tmp_path / "file").write_text("kept")
    with pytest.raises(SettingError, match="a folder"):
        deploy(CASES["pi"], tmp_path / "file")
    assert (tmp_path / "file").read_text() == "kept"


def _linear(a: list[float], b: list[float]) -> Model:
    core = _core.LinearModel(np.array(a), np.array([b]), 1, 0.0)
    return LinearOE(core, 0.001, ("u",), "y", ("V",), "RPM")


def test_poles_that_single_precision_cannot_keep_are_refused(tmp_path: Path) -> None:
    # two poles at 1 - 1e-4: as coefficients they are 1e-8 from the circle, below 2^-24
    slow = _linear([-2 * 0.9999, 0.9999**2], [1e-8, 0.0])
    with pytest.raises(SettingError, match=r"slowest pole is 0\.9999.*precision f64"):
        deploy(slow, tmp_path / "out")
    assert not (tmp_path / "out").exists()
    assert "double" in deploy(slow, tmp_path / "out", precision="f64").notes[0]


def test_a_model_that_runs_away_is_refused_in_single_precision(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # as one that is not linear, of which nobody knows when it doubles
    monkeypatch.setattr("sewfast_deploy.precision.doubling", lambda _: None)
    with pytest.raises(FitError, match="stays finite"):
        deploy(_linear([-1.5], [1.0]), tmp_path)


@pytest.mark.parametrize(
    ("changed", "received"),
    [
        ({"gains": Gains.standard(1e39, 0.25)}, "inf"),
        ({"gains": Gains.standard(1e-60, 0.25)}, "kp 1e-60"),
        ({"gains": Gains.standard(0.02, 0.25), "slew": 1e-60}, "0"),
        # of 2^24 steps of the integral at its limit an error of 1 % moves none
        ({"gains": Gains.standard(0.02, 1000.0), "u_max": 10.0}, "Ti 1000 s at a sample time of"),
    ],
)
@pytest.mark.parametrize("to", ["c99", "st"])
def test_controllers_that_single_precision_cannot_keep_are_refused(
    changed: dict[str, Any], received: str, to: str, tmp_path: Path
) -> None:
    controller = Controller(**changed)
    with pytest.raises(SettingError) as found:
        deploy(controller, tmp_path / "out", to=to)
    assert found.value.name == "precision"
    assert str(found.value.received).startswith(received)
    assert "f64" in str(found.value.remedy)
    assert not (tmp_path / "out").exists()
    deploy(controller, tmp_path / "out", to=to, precision="f64")


def test_the_error_at_which_an_integral_rests_is_said_and_true(tmp_path: Path) -> None:
    controller = Controller(
        Gains.standard(0.02, 20.0, u_unit="V", y_unit="RPM"), u_min=-16.5, u_max=16.5
    )
    note = deploy(controller, tmp_path).notes[1]
    said = re.search(r"errors below ([\d.e-]+) RPM", note)
    assert said is not None
    rests = float(said[1])
    for error, moves in ((0.9 * rests, False), (1.1 * rests, True)):
        core: Any = controller.core().single()
        core.set_manual(16.25)
        core.step(0.0, 0.0)
        core.set_automatic()
        commands = [core.step(error, 0.0) for _ in range(2000)]
        assert (commands[-1] > commands[0]) == moves


def test_what_single_precision_costs_is_said_and_true(tmp_path: Path) -> None:
    model = kinds.model_of("neural_oe")
    note = deploy(model, tmp_path).notes[1]
    said = float(re.search(r"by ([\d.e-]+) of its span", note)[1])  # type: ignore[index]
    u = kinds.levels(4000, 9, 1)
    double = combined_run(*embedded_members(model, "f64"), u, "f64")
    single = combined_run(*embedded_members(model, "f32"), u, "f32")
    loss = np.abs(double - single).max() / np.ptp(double)
    assert 0.1 * said < loss < 10 * said


@needs_compiler
def test_texts_of_a_user_stay_in_their_comments(tmp_path: Path) -> None:
    hostile = '*/ int main(void){} /* @_step @@_TS \n#error R(1.0) \\\n"'
    controller = Controller(Gains.standard(0.02, 0.25, u_unit="V*/", y_unit="(*@m_"), notes=hostile)
    deploy(controller, tmp_path, name="c")
    for compiler in deployed.compilers():
        built = [compiler, "-std=c99", "-Wall", "-c", str(tmp_path / "c.c"), "-o"]
        subprocess.run([*built, str(tmp_path / "c.o")], check=True)
    text = (
        deploy(controller, tmp_path / "st", to="st", name="c").folder.joinpath("c.st").read_text()
    )
    assert Block(text).step(r=np.float32(1.0), y=np.float32(0.0)) != 0.0


def test_all_files_are_written_or_none(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A header beside the source of another controller would compile."""

    def refused(folder: Path, name: str, received: str) -> None:
        before = {p: p.is_dir() or p.read_bytes() for p in tmp_path.rglob("*")}
        with pytest.raises(ModelFileError) as found:
            deploy(CASES["paper"], folder)
        assert str(found.value.name).endswith(name)
        assert received in str(found.value.received)
        assert {p: p.is_dir() or p.read_bytes() for p in tmp_path.rglob("*")} == before

    there = deploy(CASES["pi"], tmp_path / "there").folder
    (there / "controller_test.c").unlink()
    (there / "controller_test.c").mkdir()
    refused(there, "controller_test.c", "a folder")
    (tmp_path / "file").touch()
    refused(tmp_path / "file" / "below", "below", "directory")
    refused(tmp_path / ("x" * 300), "x", "too long")
    refused(tmp_path / "new" / ("x" * 300), "x", "too long")
    refused(tmp_path / "a\0b", "b", "null byte")

    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    refused(there.parent / "new" / "folder", "controller.h", "No space left")
    refused(there, "controller.h", "No space left")

    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(os, "fsync", interrupt)
    with pytest.raises(KeyboardInterrupt):
        deploy(CASES["paper"], tmp_path / "new" / "folder")
    assert not (tmp_path / "new").exists()


def test_an_ensemble_for_no_processor_is_refused(tmp_path: Path) -> None:
    many = Ensemble.of([_linear([-0.9], [0.1])] * 65)
    with pytest.raises(SettingError, match="at most 64 members"):
        deploy(many, tmp_path)


@pytest.mark.skipif(shutil.which("cmake") is None, reason="needs cmake")
def test_cmake_builds_and_tests_the_folder(tmp_path: Path) -> None:
    deploy(CASES["everything"], tmp_path / "a b", name="loop")
    deploy(CASES["neural_ss"], tmp_path / "a b", name="plant")
    for command in (
        ["cmake", "-S", tmp_path / "a b", "-B", tmp_path / "build"],
        ["cmake", "--build", tmp_path / "build", "--target", "loop_test", "plant_test"],
        ["ctest", "--test-dir", tmp_path / "build"],
    ):
        done = subprocess.run([str(c) for c in command], check=True, capture_output=True, text=True)
    assert "2 tests passed" in done.stdout or "out of 2" in done.stdout


def test_manifests_are_what_their_tools_read(tmp_path: Path) -> None:
    done = deploy(CASES["pi"], tmp_path, name="loop")
    assert {f"loop{end}" for end in (".c", ".h", "_test.c")} <= set(done.files)
    library = json.loads((tmp_path / "library.json").read_text())
    assert library["build"]["srcFilter"] == ["+<*.c>", "-<*_test.c>"]
    assert "cmake: zephyr" in (tmp_path / "zephyr" / "module.yml").read_text()


def test_the_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    CASES["pi"].save(tmp_path / "controller.json")
    kinds.model_of("oe").save(tmp_path / "model.json")
    folder = tmp_path / "with a space"
    assert main(["deploy", str(tmp_path / "controller.json"), str(folder), "--json"]) == 0
    files = json.loads(capsys.readouterr().out)["files"]
    assert all(Path(f).is_file() for f in files)
    assert str(folder / "controller.c") in files
    assert main(["deploy", str(tmp_path / "model.json"), str(folder), "--name", "plant"]) == 0
    assert "plant.c" in capsys.readouterr().out
    assert main(["deploy", str(tmp_path / "nix.json"), str(folder)]) == 2
    (tmp_path / "other.json").write_text('{"format": "something", "version": 1}')
    capsys.readouterr()
    assert main(["deploy", str(tmp_path / "other.json"), str(folder)]) == 2
    said = capsys.readouterr().err
    assert "other.json: expected a model or a controller" in said
    assert "'something'" in said


@pytest.mark.parametrize("pole", [1.002, 1.05, 1.5])
@pytest.mark.parametrize("precision", PRECISIONS)
def test_an_unstable_model_is_said_to_be_one(pole: float, precision: str, tmp_path: Path) -> None:
    model = LinearOE.from_tf([0.0, 0.1], [1.0, -pole], 0.01)
    notes = str(deploy(model, tmp_path, precision=precision))
    assert "the model is unstable" in notes
    assert "in any precision its free run doubles every" in notes
