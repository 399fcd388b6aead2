"""Every command of the command line, on small data."""

from __future__ import annotations

import argparse
import csv
import json
import math
import os
import subprocess
import time
from pathlib import Path

import numpy as np
import pytest

import sewfast as api
from cli import PROGRAM, environment
from cli import called as sewfast
from cli import sewfast as started
from sewfast.cli import main
from sewfast.cli.arguments import time_left


def lagged(u: np.ndarray) -> np.ndarray:
    """A drive with a pole at 0.9 and a gain of 500 RPM/V."""
    y = np.zeros(len(u))
    for k in range(1, len(u)):
        y[k] = 0.9 * y[k - 1] + 50.0 * u[k - 1]
    return y


def recording(seed: int, n: int = 600, Ts: float = 0.001) -> dict[str, np.ndarray]:
    random = np.random.default_rng(seed)
    u = np.repeat(random.uniform(0.0, 6.0, n // 20), 20)
    y = lagged(u) + random.normal(0.0, 2.0, n)
    return {"t": Ts * np.arange(n), "u": u, "speed": y}


UNITS = {"t": "s", "u": "V", "speed": "RPM"}


@pytest.fixture(scope="module")
def walk(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two recordings, a model and a controller, made once; tests must not change them."""
    folder = tmp_path_factory.mktemp("walk")
    for name, seed in (("one", 1), ("two", 2)):
        api.write_table(folder / f"{name}.csv", recording(seed), units=UNITS)
    columns = ("--input", "u", "--output", "speed")
    started(folder, "identify", "one.csv", *columns, "--model", "oe", "-o", "drive.json")
    gains = api.Gains.standard(0.001, 0.02)
    api.Controller(gains, u_min=-20, u_max=20, counts_per_rev=1572).save(folder / "c.json")
    return folder


def header_and_rows(path: Path) -> tuple[list[str], list[list[str]]]:
    head, *rows = csv.reader(path.read_text().splitlines())
    return head, rows


# --- help ---------------------------------------------------------------------------------------

COMMANDS = [
    "demo",
    "commission",
    "record",
    "signals",
    "orders",
    "identify",
    "validate",
    "simulate",
    "tune",
    "run",
    "report",
    "ports",
    "doctor",
]


def test_help_lists_every_command_and_exit_code(tmp_path: Path) -> None:
    text = started(tmp_path, "--help").out
    for word in (*COMMANDS, "exit codes", "130"):
        assert word in text


def test_help_is_a_command_as_well(tmp_path: Path) -> None:
    assert sewfast(tmp_path, "help").out == sewfast(tmp_path, "--help").out
    assert sewfast(tmp_path, "help", "tune").out == sewfast(tmp_path, "tune", "--help").out


def test_no_command_shows_the_help(tmp_path: Path) -> None:
    assert sewfast(tmp_path).out == sewfast(tmp_path, "--help").out


@pytest.mark.parametrize("command", COMMANDS)
def test_each_command_teaches(tmp_path: Path, command: str) -> None:
    text = sewfast(tmp_path, command, "--help").out
    assert "example" in text
    assert f"sewfast {command}" in text
    assert "--json" in text


def test_version(tmp_path: Path) -> None:
    assert started(tmp_path, "--version").out == f"sewfast {api.__version__}\n"


# --- record, signals ----------------------------------------------------------------------------


def test_signals(tmp_path: Path) -> None:
    text = sewfast(tmp_path, "signals").out
    found = sewfast(tmp_path, "signals", "--json").json()
    assert {s["name"] for s in found} >= {"chirp_lo_hi", "random", "trapezoid"}
    for signal in found:
        assert signal["unit"] == {"excitation": "V", "reference": "RPM"}[signal["kind"]]
        assert signal["name"] in text
        assert signal["description"] in text


@pytest.mark.parametrize("suffix", ["csv", "npz", "mat", "parquet"])
def test_record_writes_every_format(tmp_path: Path, suffix: str) -> None:
    out = f"step.{suffix}"
    sewfast(tmp_path, "record", "--on", "virtual:3", "--signal", "step", "-o", out)
    table = api.read_table(tmp_path / out)
    assert set(table.names) == {"t", "u", "counts", "y", "speed_true"}
    assert len(table["t"]) == 3000
    run = api.VirtualMachine(3).run(api.signals.excitation("step"))
    np.testing.assert_array_equal(table["counts"], run.counts)
    np.testing.assert_array_equal(table["speed_true"], run.speed_rpm)
    assert np.sqrt(np.mean((table["y"] - run.speed_rpm) ** 2)) < 20.0


def test_record_without_file_prints_csv(tmp_path: Path) -> None:
    found = started(tmp_path, "record", "--on", "virtual", "--signal", "step")
    lines = found.out.splitlines()
    assert lines[0] == "t [s],u [V],counts,y [RPM],speed_true [RPM]"
    assert len(lines) == 3001
    assert "3000 samples" in found.err


def test_record_of_a_random_signal_follows_its_seed(tmp_path: Path) -> None:
    def command(seed: int) -> list[float]:
        arguments = ("--on", "virtual", "--signal", "random", "--seed", seed, "--json")
        return sewfast(tmp_path, "record", *arguments).json()["columns"]["u"]

    assert command(1) == command(1) != command(2)


# --- identify, validate, simulate ---------------------------------------------------------------


def test_identify_finds_the_plant(walk: Path) -> None:
    model = api.load_model(walk / "drive.json")
    assert model.kind == "oe"
    assert model.signature == "u [V] -> speed [RPM]"
    assert model.dc_gain[0] == pytest.approx(500.0, rel=0.02)


def test_identify_tells_what_it_found(tmp_path: Path, walk: Path) -> None:
    arguments = ("identify", walk / "one.csv", "--input", "u", "--output", "speed")
    arguments += ("--model", "arx", "-o", "m.json")
    text = sewfast(tmp_path, *arguments).out
    assert "ARX" in text
    assert "m.json" in text
    told = sewfast(tmp_path, *arguments, "--json").json()
    assert told["file"] == "m.json"
    assert told["kind"] == "arx"
    assert told["scores"]["train"]["simulation"]["fit_percent"] > 90


def test_identify_network_is_the_same_for_a_seed(tmp_path: Path, walk: Path) -> None:
    arguments = ("identify", walk / "one.csv", "--input", "u", "--output", "speed")
    arguments += ("--model", "neural-oe", "--hidden", 2, "--starts", 1, "--seed", 5)
    for name in ("a", "b"):
        sewfast(tmp_path, *arguments, "-o", f"{name}.json")
    a, b = (api.load_model(tmp_path / f"{name}.json") for name in ("a", "b"))
    assert a.kind == "neural_oe"
    assert a.parameters() == b.parameters()


def test_identify_ranges(tmp_path: Path, walk: Path) -> None:
    def trained_on(*ranges: str) -> list[str]:
        arguments = ("--input", "u", "--output", "speed", "--model", "oe", *ranges)
        told = sewfast(tmp_path, "identify", walk / "one.csv", *arguments, "-o", "m.json", "--json")
        return [e["range"] for e in told.json()["scores"]["train"]["experiments"]]

    assert trained_on("--train", "0:400") == ["0:400"]
    assert trained_on("--train", "0:400", "--validate", "400:600") == ["0:400"]
    assert trained_on("--validate", "200:300") == ["0:200", "300:600"]


def test_identify_scores_what_was_held_out(tmp_path: Path, walk: Path) -> None:
    arguments = ("--input", "u", "--output", "speed", "--model", "oe", "--validate", "400:600")
    told = sewfast(tmp_path, "identify", walk / "one.csv", *arguments, "-o", "m.json", "--json")
    held = told.json()["scores"]["validation"]
    assert held["n"] == 200 - held["init"]
    again = sewfast(
        tmp_path, "validate", "m.json", walk / "one.csv", "--range", "400:600", "--json"
    )
    assert again.json()["simulation"] == held["simulation"]


def test_identify_several_files_with_their_own_columns(tmp_path: Path) -> None:
    first, second = recording(1), recording(2)
    api.write_table(tmp_path / "a.csv", first)
    api.write_table(
        tmp_path / "b.npz", {"time": second["t"], "volt": second["u"], "rpm": second["speed"]}
    )
    arguments = ("a.csv:u:speed", "b.npz:volt:rpm", "--model", "oe", "-o", "m.json", "--json")
    told = sewfast(tmp_path, "identify", *arguments).json()
    assert [e["name"] for e in told["scores"]["train"]["experiments"]] == ["a.csv", "b.npz"]


def test_identify_from_counts_and_validate_with_the_stored_columns(tmp_path: Path) -> None:
    sewfast(tmp_path, "record", "--on", "virtual", "--signal", "step", "-o", "step.csv")
    arguments = ("--input", "u", "--counts", "counts", "--counts-per-rev", 1572, "--model", "oe")
    sewfast(tmp_path, "identify", "step.csv", *arguments, "-o", "m.json")
    model = api.load_model(tmp_path / "m.json")
    assert model.counts == ("counts", 1572.0)
    assert model.output_unit == "RPM"
    stored = sewfast(tmp_path, "validate", "m.json", "step.csv", "--json").json()
    true = sewfast(
        tmp_path, "validate", "m.json", "step.csv", "--output", "speed_true", "--json"
    ).json()
    assert stored["against"] == "speed"
    assert true["against"] == "speed_true"
    assert stored["simulation"]["rmse"] != true["simulation"]["rmse"]


def test_validate_prints_a_table_or_json(walk: Path) -> None:
    text = sewfast(walk, "validate", "drive.json", "two.csv").out
    told = sewfast(walk, "validate", "drive.json", "two.csv", "--json").json()
    assert told["n"] == 580
    assert told["init"] == 20
    for horizon in ("simulation", "one_step"):
        assert set(told[horizon]) == {"rmse", "fit_percent", "max_abs"}
    assert told["simulation"]["rmse"] == pytest.approx(2.0, abs=0.5)
    assert f"{told['simulation']['fit_percent']:.2f}" in text


def test_simulate_is_the_free_run_of_the_api(tmp_path: Path, walk: Path) -> None:
    sewfast(tmp_path, "simulate", walk / "drive.json", walk / "two.csv", "-o", "p.csv")
    head, rows = header_and_rows(tmp_path / "p.csv")
    assert head == ["t", "u", "y_hat"]
    data = api.read(walk / "two.csv", inputs="u", output="speed")
    (expected,) = api.load_model(walk / "drive.json").simulate(data)
    np.testing.assert_array_equal([float(r[2]) for r in rows], expected)


def test_simulate_says_that_an_unstable_model_runs_away(tmp_path: Path) -> None:
    falling = api.LinearOE.from_tf([0.0, 1.0], [1.0, -1.05], 0.001, input_names=("u",))
    falling.save(tmp_path / "falling.json")
    api.write_table(tmp_path / "inputs.csv", {"t": 0.001 * np.arange(2000), "u": np.ones(2000)})
    arguments = ("simulate", "falling.json", "inputs.csv", "--init", 0, "-o", "p.csv")
    assert "doubles every 14 samples" in sewfast(tmp_path, *arguments).out
    found = json.loads(sewfast(tmp_path, *arguments, "--json").out)
    assert found["doubles_every"] == 14


def test_simulate_needs_no_output_beyond_its_start(tmp_path: Path, walk: Path) -> None:
    head, rows = header_and_rows(walk / "two.csv")
    emptied = [row if k < 20 else [*row[:2], ""] for k, row in enumerate(rows)]
    (tmp_path / "empty.csv").write_text("\n".join(map(",".join, [head, *emptied])) + "\n")
    whole = sewfast(tmp_path, "simulate", walk / "drive.json", walk / "two.csv").out
    assert sewfast(tmp_path, "simulate", walk / "drive.json", "empty.csv").out == whole


def test_simulate_from_rest_needs_no_output_at_all(tmp_path: Path, walk: Path) -> None:
    u = recording(2)["u"]
    (tmp_path / "inputs.csv").write_text("u\n" + "\n".join(map(repr, u.tolist())) + "\n")
    arguments = ("simulate", walk / "drive.json", "inputs.csv", "--init", 0, "--json")
    columns = sewfast(tmp_path, *arguments).json()["columns"]
    assert columns["t"][:2] == [0.0, 0.001]
    data = api.Dataset.from_arrays(u, None, 0.001, input_units="V")
    (expected,) = api.load_model(walk / "drive.json").simulate(data, init=0)
    assert columns["y_hat"] == expected.tolist()


def test_several_inputs_keep_their_names(tmp_path: Path) -> None:
    one, two = recording(1), recording(2)
    columns = {"t": one["t"], "left": one["u"], "right": two["u"]}
    columns["y"] = lagged(one["u"] - 0.5 * two["u"]) + one["speed"] - lagged(one["u"])
    api.write_table(tmp_path / "belt.csv", columns)
    arguments = ("--input", "left", "--input", "right", "--output", "y", "--model", "arx")
    sewfast(tmp_path, "identify", "belt.csv", *arguments, "-o", "m.json")
    sewfast(tmp_path, "simulate", "m.json", "belt.csv", "-o", "p.csv")
    assert header_and_rows(tmp_path / "p.csv")[0] == ["t", "left", "right", "y_hat"]


# --- tune, run ----------------------------------------------------------------------------------


def test_tune_refuses_a_model_that_identify_called_useless(tmp_path: Path, walk: Path) -> None:
    stored = json.loads((walk / "drive.json").read_text())
    verdict = {"grade": "useless", "text": "useless: it explains 3 %", "fit_percent": 3.0}
    stored["training"]["verdict"] = {**verdict, "next": []}
    (tmp_path / "poor.json").write_text(json.dumps(stored))
    few = ("--evaluations", 60, "-o", "c.json")
    assert "useless" not in sewfast(tmp_path, "tune", walk / "drive.json", *few).err
    (tmp_path / "c.json").unlink()
    refused = sewfast(tmp_path, "tune", "poor.json", *few, done=2).err
    assert "received useless: it explains 3 %" in refused
    assert "--force" in refused
    assert not (tmp_path / "c.json").exists()
    assert (
        "warning: poor.json: useless: it explains 3 %"
        in sewfast(tmp_path, "tune", "poor.json", *few, "--force").err
    )
    assert (tmp_path / "c.json").exists()


def test_tune_prints_gains_in_every_form(tmp_path: Path, walk: Path) -> None:
    t = np.arange(400) * 0.001
    api.write_table(tmp_path / "cycle.csv", {"t": t, "r": np.where(t > 0.05, 1000.0, 0.0)})
    arguments = ("tune", walk / "drive.json", "--reference", "cycle.csv", "-o", "c.json")
    arguments += ("--u-min", -10, "--u-max", 10, "--filter", 4, "--counts-per-rev", 2000)
    text = sewfast(tmp_path, *arguments).out
    for word in ("standard", "parallel", "per-sample", "V/RPM", "V/(RPM s)"):
        assert word in text
    controller = api.load_controller(tmp_path / "c.json")
    assert (controller.u_min, controller.u_max) == (-10.0, 10.0)
    assert (controller.filter_samples, controller.counts_per_rev) == (4, 2000.0)
    told = sewfast(tmp_path, *arguments, "--json").json()
    assert told["cost"] <= told["start_cost"]
    assert told["gains"]["standard"]["Kp"] == controller.gains.Kp
    assert told["gains"]["parallel"]["Ki"] == pytest.approx(controller.gains.to("parallel").Ki)


@pytest.mark.parametrize("plant", ["drive.json", "virtual", "virtual:4"])
def test_run_closes_the_loop(tmp_path: Path, walk: Path, plant: str) -> None:
    on = walk / plant if plant.endswith("json") else plant
    arguments = ("run", walk / "c.json", "--on", on, "--reference", "trapezoid")
    told = sewfast(tmp_path, *arguments, "-o", "run.csv", "--json").json()
    head, rows = header_and_rows(tmp_path / "run.csv")
    assert head == ["t [s]", "r [RPM]", "u [V]", "y [RPM]", "feedback [RPM]"]
    t, r, u, y, _ = np.array(rows, dtype=float).T
    assert told["rmse"] == pytest.approx(np.sqrt(np.mean((r - y) ** 2)))
    assert t[-1] == pytest.approx(1.499)
    assert np.abs(u).max() <= 20.0


def test_run_follows_a_reference_from_a_file(tmp_path: Path, walk: Path) -> None:
    t = np.arange(300) * 0.001
    api.write_table(tmp_path / "cycle.parquet", {"t": t, "r": np.full(300, 800.0)})
    arguments = ("run", walk / "c.json", "--on", walk / "drive.json")
    columns = sewfast(tmp_path, *arguments, "--reference", "cycle.parquet", "--json").json()
    assert columns["columns"]["r"] == [800.0] * 300
    assert columns["columns"]["y"][-1] == pytest.approx(800.0, abs=40.0)


# --- terminal -----------------------------------------------------------------------------------


def test_a_closed_pipe_is_no_fault(tmp_path: Path) -> None:
    command = [*PROGRAM, "record", "--on", "virtual", "--signal", "staircase"]
    with subprocess.Popen(
        command, cwd=tmp_path, env=environment(), stdout=subprocess.PIPE, stderr=subprocess.PIPE
    ) as process:
        assert process.stdout is not None
        assert process.stderr is not None
        assert process.stdout.readline().startswith(b"t [s]")
        process.stdout.close()
        err = process.stderr.read()
    assert process.returncode == 0
    assert err == b""


BROKEN_BY_CTRL_C = """
import builtins, os, signal, time
class Left:
    def __del__(self, abort=os.abort):
        abort()
builtins.left = Left()
try:
    os.kill(os.getpid(), signal.SIGINT)
    time.sleep(1.0)
except KeyboardInterrupt:
    raise ImportError("half of it") from None
"""
"""A library that turns Ctrl-C into an error of its own and leaves what aborts the interpreter."""


@pytest.mark.skipif(os.name != "posix", reason="signals of a terminal")
def test_ctrl_c_while_a_library_is_imported_is_told_as_ctrl_c(tmp_path: Path) -> None:
    (tmp_path / "matplotlib.py").write_text(BROKEN_BY_CTRL_C)
    k = np.arange(50.0)
    api.write_table(tmp_path / "one.csv", {"t": 0.001 * k, "u": k > 9, "y": np.sqrt(k)})
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PYTHONPATH", str(tmp_path), prepend=os.pathsep)
        found = started(tmp_path, "look", "one.csv", "--plot", "one.png", done=130)
    assert found.err == "sewfast look: interrupted; nothing was written\n"


@pytest.mark.skipif(os.name != "posix", reason="needs a pseudo-terminal")
def test_progress_is_drawn_on_a_terminal_only(tmp_path: Path, walk: Path) -> None:
    import pty

    arguments = ["identify", str(walk / "one.csv"), "--input", "u", "--output", "speed"]
    arguments += ["--model", "neural-oe", "-o", "m.json", "--json"]
    quiet = started(tmp_path, *arguments)
    assert quiet.err == ""
    ours, theirs = pty.openpty()
    with subprocess.Popen(
        [*PROGRAM, *arguments],
        cwd=tmp_path, env=environment(), stdout=subprocess.PIPE, stderr=theirs,
    ) as process:  # fmt: skip
        os.close(theirs)
        drawn = _read_all(ours)
        assert process.stdout is not None
        assert json.loads(process.stdout.read())["kind"] == "neural_oe"
    assert "identify [" in drawn
    assert "best" in drawn


def _read_all(terminal: int) -> str:
    found = b""
    while True:
        try:
            chunk = os.read(terminal, 65536)
        except OSError:  # Linux reports the other side's end so
            chunk = b""
        if not chunk:
            os.close(terminal)
            return found.decode()
        found += chunk


# --- time budgets ---------------------------------------------------------------------------------


def test_a_time_budget_counts_from_the_start_of_the_command() -> None:
    def left(seconds: float | None, ago: float) -> float | None:
        began = time.monotonic() - ago
        return time_left(argparse.Namespace(time_budget=seconds, began=began))

    assert left(10.0, 3.0) == pytest.approx(7.0, abs=0.1)
    # modules that took longer than that to read leave half of it for the work
    assert left(10.0, 30.0) == 5.0
    assert left(None, 3.0) is None
    for meaningless in (0.0, -1.0, math.inf):  # refused by the work
        assert left(meaningless, 3.0) == meaningless


def test_a_budget_of_the_command_is_what_is_left_of_it(
    walk: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    given: list[float] = []

    def noted(args: argparse.Namespace) -> None:
        given.append(args.began)

    for module in ("identify", "tune"):
        monkeypatch.setattr(f"sewfast.cli.{module}.time_left", noted)
    sewfast(walk, "tune", "drive.json", "--evaluations", 5, "--force", "-o", tmp_path / "c.json")
    sewfast(walk, "identify", "one.csv", "--model", "oe", "-o", tmp_path / "m.json")
    assert len(given) == 2
    assert time.monotonic() - 600.0 < given[0] <= given[1] <= time.monotonic()
    # the program says when it began, before it has read a module
    asked = ["tune", str(walk / "drive.json"), "--evaluations", "5", "--force"]
    assert main([*asked, "-o", str(tmp_path / "d.json")], began=7.0) == 0
    assert given[2] == 7.0
