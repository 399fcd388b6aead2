"""What the command line refuses, and what is left after a refusal or Ctrl-C."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

import sewfast as api
from cli import PROGRAM, environment
from cli import call_refused as refused
from cli import called as sewfast
from cli import sewfast as started
from sewfast import cli
from sewfast.recordfile import Header, RecordWriter

IDENTIFY = ("identify", "run.csv", "--input", "u", "--output", "y", "-o", "m.json")


def recording(n: int = 400) -> dict[str, np.ndarray]:
    u = np.repeat(np.random.default_rng(0).uniform(0, 5, n // 20), 20)
    y = np.zeros(n)
    for k in range(1, n):
        y[k] = 0.9 * y[k - 1] + 50 * u[k - 1]
    noise = np.random.default_rng(1).normal(0, 1, n)
    return {"t": 0.001 * np.arange(n), "u": u, "y": y + noise, "extra": noise}


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A good recording, a model and a controller, for one test to spoil."""
    units = {"u": "V", "y": "RPM"}
    api.write_table(tmp_path / "run.csv", recording(), units=units)
    data = api.read(tmp_path / "run.csv", inputs="u", output="y")
    api.identify(data, model="oe").save(tmp_path / "drive.json")
    gains = api.Gains.standard(0.001, 0.02)
    api.Controller(gains, u_min=-20, u_max=20).save(tmp_path / "c.json")
    return tmp_path


def spoil(folder: Path, **columns: np.ndarray) -> None:
    api.write_table(folder / "run.csv", {**recording(), **columns})


def spoiled(name: str, at: int | slice, value: float) -> dict[str, np.ndarray]:
    column = recording()[name].copy()
    column[at] = value
    return {name: column}


# --- recordings -----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("columns", "expected"),
    [
        (spoiled("y", slice(None), np.nan), ["'y'", "NaN"]),
        (spoiled("u", 7, np.nan), ["'u'", "sample 7", "--split-at-gaps"]),
        (spoiled("y", 7, np.inf), ["'y'", "sample 7"]),
        (spoiled("u", 7, np.inf), ["'u'", "7"]),
        (spoiled("u", slice(None), 2.0), ["'u'", "constant"]),
        (spoiled("y", slice(None), 2.0), ["'y'", "constant"]),
        (spoiled("t", 9, 0.0), ["'t'", "increasing", "line 11"]),
    ],
    ids=[
        "all-nan",
        "nan",
        "inf-output",
        "inf",
        "constant-input",
        "constant-output",
        "backwards",
    ],
)
def test_unusable_columns(
    folder: Path, columns: dict[str, np.ndarray], expected: list[str]
) -> None:
    spoil(folder, **columns)
    message = refused(folder, *IDENTIFY)
    for word in ["run.csv", *expected]:
        assert word in message


def test_empty_file(folder: Path) -> None:
    (folder / "run.csv").write_bytes(b"")
    assert "empty" in refused(folder, *IDENTIFY)


def test_header_alone(folder: Path) -> None:
    (folder / "run.csv").write_text("t,u,y\n")
    assert "run.csv" in refused(folder, *IDENTIFY)


def test_too_few_samples(folder: Path) -> None:
    api.write_table(folder / "run.csv", {k: v[10:28] for k, v in recording().items()})
    assert "samples" in refused(folder, *IDENTIFY)


def test_missing_file(folder: Path) -> None:
    message = refused(
        folder, "identify", "nil.csv", "--input", "u", "--output", "y", "-o", "m.json"
    )
    assert "nil.csv" in message
    assert "No such file" in message


def test_wrong_column_names_what_there_is(folder: Path) -> None:
    message = refused(
        folder, "identify", "run.csv", "--input", "v", "--output", "y", "-o", "m.json"
    )
    assert "'v'" in message
    assert "u, y, extra" in message


def test_columns_in_doubt_are_named_with_the_options(folder: Path) -> None:
    names = {"t": "t", "u": "a", "y": "b", "extra": "c"}
    api.write_table(folder / "run.csv", {names[k]: v for k, v in recording().items()})
    for given in ((), ("--input", "a"), ("--output", "b")):
        message = refused(folder, "identify", "run.csv", *given, "-o", "m.json")
        assert "received t, a, b, c; name them: --input COL, --output COL" in message


def test_sample_time_that_disagrees(folder: Path) -> None:
    assert "1 %" in refused(folder, *IDENTIFY, "--ts", 0.002)
    api.write_table(folder / "run.csv", {k: v for k, v in recording().items() if k != "t"})
    assert "--ts" in refused(folder, *IDENTIFY)


def test_counts_need_their_resolution(folder: Path) -> None:
    assert "counts_per_rev" in refused(folder, *IDENTIFY, "--counts", "extra")


# --- settings -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("options", "word"),
    [
        (("--na", 0), "na"),
        (("--nb", -1), "nb"),
        (("--hidden", 0), "hidden"),
        (("--starts", 0), "starts"),
        (("--seed", -1), "seed"),
        (("--train", "5:5"), "5:5"),
        (("--train", "0:9999"), "0:9999"),
        (("--train", "x"), "A:B"),
        (("--train", "0:300", "--validate", "200:400"), "overlap"),
        (("--validate", "0:400"), "samples left to train on, received none"),
        (("--preset", "paper", "--hidden", 9), "paper"),
        (("--model", "oe", "--preset", "paper"), "paper"),
        (("--model", "tree"), "--model"),
        (("--na", "two"), "--na"),
    ],
)
def test_settings_of_identify(folder: Path, options: tuple[object, ...], word: str) -> None:
    assert word in refused(folder, *IDENTIFY, *options)


@pytest.mark.parametrize("out", ["nowhere/m.json", "m.txt", "m"])
def test_an_output_that_cannot_be_is_refused_before_the_work(folder: Path, out: str) -> None:
    message = refused(folder, *IDENTIFY[:-1], out, "--starts", 100_000)
    assert out in message


def test_unknown_commands_and_options_are_answered_with_the_nearest(folder: Path) -> None:
    assert "learn" in refused(folder, "learn")
    assert "did you mean identify?" in refused(folder, "identfy")
    assert "did you mean --input?" in refused(folder, *IDENTIFY, "--inptu", "u")
    assert "did you mean neural-ss?" in refused(folder, *IDENTIFY, "--model", "neural_ss")
    assert "did you mean" not in refused(folder, *IDENTIFY, "--zzz")


# --- models, controllers --------------------------------------------------------------------------


def test_damaged_model(folder: Path) -> None:
    text = (folder / "drive.json").read_text()
    (folder / "drive.json").write_text(text[:50])
    assert "drive.json" in refused(folder, "validate", "drive.json", "run.csv")


@pytest.mark.parametrize("version", [99, "1", None])
def test_unknown_version(folder: Path, version: object) -> None:
    document = json.loads((folder / "drive.json").read_text()) | {"version": version}
    (folder / "drive.json").write_text(json.dumps(document))
    assert "version 1" in refused(folder, "simulate", "drive.json", "run.csv")


def test_a_controller_is_no_model(folder: Path) -> None:
    message = refused(folder, "validate", "c.json", "run.csv")
    assert "sewfast.model" in message
    assert "sewfast.controller" in message


def test_data_that_do_not_fit_the_model(folder: Path) -> None:
    slow = recording() | {"t": 0.01 * np.arange(400)}
    api.write_table(folder / "slow.csv", slow)
    assert "0.01" in refused(folder, "validate", "drive.json", "slow.csv")
    assert "'w'" in refused(folder, "validate", "drive.json", "run.csv", "--input", "w")


@pytest.mark.parametrize("options", [("--range", "0:20"), ("--init", -1), ("--init", "x")])
def test_nothing_left_to_score(folder: Path, options: tuple[object, ...]) -> None:
    assert "init" in refused(folder, "validate", "drive.json", "run.csv", *options)


def test_simulation_without_the_samples_that_start_it(folder: Path) -> None:
    spoil(folder, **spoiled("y", slice(7, None), np.nan))
    assert "--init" in refused(folder, "simulate", "drive.json", "run.csv")


def test_unstable_model(folder: Path) -> None:
    document = json.loads((folder / "drive.json").read_text())
    document["parameters"]["a"] = [-30.0, 200.0]
    (folder / "drive.json").write_text(json.dumps(document))
    assert "unstable" in refused(folder, "simulate", "drive.json", "run.csv", "-o", "p.csv")


@pytest.mark.parametrize(
    ("field", "value"),
    [("input_range", None), ("input_range", [[1]]), ("input_range", 3), ("data", 1), ("notes", 1)],
)
def test_damaged_training_record(folder: Path, field: str, value: object) -> None:
    document = json.loads((folder / "drive.json").read_text())
    document["training"][field] = value
    (folder / "drive.json").write_text(json.dumps(document))
    assert field in refused(folder, "validate", "drive.json", "run.csv")


def test_init_that_is_no_number(folder: Path) -> None:
    message = refused(folder, "validate", "drive.json", "run.csv", "--init", "x")
    assert "expected a whole number of samples, 0 or more, received 'x'" in message


def test_values_whose_span_overflows(folder: Path) -> None:
    spoil(folder, y=np.where(np.arange(400) % 2, 1e308, -1e308))
    assert "expected" in refused(folder, *IDENTIFY, "--model", "oe")


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no /dev/full on this system")
def test_standard_output_on_a_full_disk(folder: Path) -> None:
    with open("/dev/full", "w") as full:
        found = subprocess.run(
            [*PROGRAM, "validate", "drive.json", "run.csv", "--json"],
            cwd=folder, env=environment(), stdout=full, stderr=subprocess.PIPE, text=True,
        )  # fmt: skip
    assert found.returncode == 2
    assert "free some space" in found.stderr
    assert "fault" not in found.stderr


@pytest.mark.parametrize(
    "option",
    [
        ("--limits", "volt=1,speed=300,acceleration=3000,current=5"),
        ("--watchdog", 50),
        ("--live", "terminal"),
    ],
)
@pytest.mark.parametrize(
    "command",
    [
        ("record", "--signal", "step", "-o", "out.csv"),
        ("run", "c.json", "--reference", "trapezoid", "-o", "out.csv"),
        ("commission", "--out", "out"),
    ],
)
def test_what_only_a_drive_keeps_to_is_refused_without_one(
    folder: Path, command: tuple[str, ...], option: tuple[str, object]
) -> None:
    said = refused(folder, *command, "--on", "virtual", *option)
    assert f"{option[0]}: expected a drive" in said
    assert "sewfast device" in said


@pytest.mark.parametrize("on", ["virtual:x", "virtual:-1", "nil.json", "real"])
def test_unknown_plant(folder: Path, on: str) -> None:
    message = refused(folder, "run", "c.json", "--on", on, "--reference", "step.csv")
    assert on in message


@pytest.mark.parametrize("command", ["tune", "run"])
def test_unknown_reference_names_the_known(folder: Path, command: str) -> None:
    arguments = {"tune": ("drive.json", "-o", "new.json"), "run": ("c.json", "--on", "virtual")}
    message = refused(folder, command, *arguments[command], "--reference", "zigzag")
    assert "zigzag" in message
    assert "trapezoid" in message


def test_reference_file_without_r_or_at_another_rate(folder: Path) -> None:
    run = ("run", "c.json", "--on", "virtual", "--reference")
    assert "'r'" in refused(folder, *run, "run.csv")
    t = 0.01 * np.arange(50)
    api.write_table(folder / "slow.csv", {"t": t, "r": t})
    assert "0.01 s" in refused(folder, *run, "slow.csv")
    api.write_table(folder / "gap.csv", {"t": 0.1 * t, "r": np.where(t > 0.2, np.nan, t)})
    assert "gap.csv" in refused(folder, *run, "gap.csv")


@pytest.mark.parametrize(
    "options",
    [
        ("--u-min", 5, "--u-max", -5),
        ("--filter", 0),
        ("--counts-per-rev", -1),
        ("--cost", "chater=1"),
        ("--cost", "chatter"),
        ("--cost", "chatter=-1"),
        ("--constraint", "plant=1"),
        ("--constraint", "Ms=0.5"),
        ("--variables", "Kp=1"),
        ("--variables", "Kq"),
        ("--evaluations", 0),
        ("--front", "front.csv"),
        ("--pareto", "tracking"),
        ("--pareto", "tracking,chatter", "--front", "front.txt"),
        ("--pareto", "tracking,chatter", "--method", "cma-es"),
    ],
)
def test_settings_of_tune(folder: Path, options: tuple[object, ...]) -> None:
    refused(folder, "tune", "drive.json", "-o", "new.json", *options)


def test_record_refuses_unknown_names(folder: Path) -> None:
    assert "zigzag" in refused(folder, "record", "--on", "virtual", "--signal", "zigzag")
    assert "moon" in refused(folder, "record", "--on", "moon", "--signal", "step")
    arguments = ("record", "--on", "virtual", "--signal", "step", "-o", "step.xlsx")
    assert ".xlsx" in refused(folder, *arguments)


def test_report_of_no_results(folder: Path) -> None:
    assert "results.json" in refused(folder, "report", ".")
    assert "nil" in refused(folder, "report", "nil")


# --- faults, Ctrl-C -------------------------------------------------------------------------------


def test_a_fault_is_one_line_and_exit_code_1(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("sewfast.signals.EXCITATIONS", None)
    assert cli.main(["signals"]) == cli.FAULT
    err = capsys.readouterr().err
    assert "please report" in err
    assert len(err.splitlines()) == 1
    assert cli.main(["signals", "--debug"]) == cli.FAULT
    assert "Traceback" in capsys.readouterr().err


needs_sigint = pytest.mark.skipif(sys.platform == "win32", reason="needs SIGINT")


@needs_sigint
@pytest.mark.budget
def test_ctrl_c_keeps_the_best_model(folder: Path) -> None:
    api.write_table(folder / "run.csv", recording(4000))
    settings = ("--model", "neural-oe", "--hidden", "40", "--starts", "100000")
    err = _interrupted(folder, *IDENTIFY, *settings)
    assert "kept the best so far in m.json" in err
    assert api.load_model(folder / "m.json").kind in ("oe", "neural_oe")


@needs_sigint
@pytest.mark.budget
def test_ctrl_c_keeps_the_best_controller(folder: Path) -> None:
    t = 0.001 * np.arange(400_000)
    api.write_table(folder / "long.npz", {"t": t, "r": 1000.0 + 500.0 * np.sin(t)})
    err = _interrupted(folder, "tune", "drive.json", "--reference", "long.npz", "-o", "new.json")
    assert "kept the best so far in new.json" in err
    recorded = api.load_model(folder / "drive.json").training["input_range"][0][1]
    assert api.load_controller(folder / "new.json").u_max == recorded


@needs_sigint
def test_ctrl_c_while_the_program_is_read_ends_it_without_a_traceback(folder: Path) -> None:
    code = """
import signal, sys
from sewfast.__main__ import main

class Pressed:
    def find_spec(self, name, path, target=None):
        if name == "sewfast.cli.parser":
            signal.raise_signal(signal.SIGINT)

sys.meta_path.insert(0, Pressed())
sys.exit(main())
"""
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=folder, env=environment(), capture_output=True, text=True
    )
    assert done.returncode == -signal.SIGINT
    assert done.stderr == ""


def _interrupted(folder: Path, *arguments: str) -> str:
    """Start a command, press Ctrl-C once the compiled work is under way; its messages."""
    start_up = _start_up(folder)
    process = subprocess.Popen(
        [*PROGRAM, *arguments],
        cwd=folder,
        env=environment(),
        stderr=subprocess.PIPE,
        text=True,
    )
    try:
        _wait_until_busy(process, start_up)
        process.send_signal(signal.SIGINT)
        _, err = process.communicate(timeout=120)
    finally:
        process.kill()
        process.wait()
    assert process.returncode == cli.INTERRUPTED, err
    return err


def _start_up(folder: Path) -> float:
    """What a short command takes of the processor [s]."""
    resource = pytest.importorskip("resource")
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    started(folder, "validate", "drive.json", "run.csv")
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return float(after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime)


def _wait_until_busy(process: subprocess.Popen[str], start_up: float) -> None:
    """Wait until it has had far more of the processor than start-up takes."""
    began = time.monotonic()
    while _used(process, began) < 4.0 * start_up + 1.0:
        time.sleep(0.1)
        assert process.poll() is None, process.communicate()


def _used(process: subprocess.Popen[str], began: float) -> float:
    """Time that the processor has given to a process; time that passed where that is not told."""
    try:
        fields = Path(f"/proc/{process.pid}/stat").read_text().rpartition(")")[2].split()
    except FileNotFoundError:
        return time.monotonic() - began
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def test_refusals_are_documented(tmp_path: Path) -> None:
    text = sewfast(tmp_path, "--help").out
    for code in (cli.DONE, cli.FAULT, cli.REFUSED, cli.INTERRUPTED):
        assert f"  {code} " in text


def test_a_reference_in_another_unit(folder: Path) -> None:
    columns = {"t": 0.001 * np.arange(400), "r": np.zeros(400)}
    for unit, done in (("rad/s", 2), ("mm", 2), ("rpm", 0), ("", 0)):
        api.write_table(folder / "r.csv", columns, units={"t": "s", "r": unit})
        given = ("run", "c.json", "--on", "drive.json", "--reference", "r.csv", "-o", "out.csv")
        assert ("expected r in RPM" in sewfast(folder, *given, done=done).err) == (done == 2)


@pytest.mark.parametrize(
    ("step", "told"),
    [(0, "nothing was written"), (1, "written: a.csv"), (2, "written: a.csv, run.mcap"),
     (3, "written: 4 files in .")],
)  # fmt: skip
def test_an_interrupted_command_names_what_it_wrote(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    step: int,
    told: str,
) -> None:
    monkeypatch.chdir(tmp_path)

    def interrupted(args: object) -> None:
        if step > 0:
            api.write_table("a.csv", {"u": np.zeros(1)})
        if step > 1:
            RecordWriter("run.mcap", Header("step", 0.001, {"u": "V"}, n=1)).close()
        if step > 2:
            api.write_table("b.csv", {"u": np.zeros(1)})
            api.write_table("c.csv", {"u": np.zeros(1)})
        raise KeyboardInterrupt

    monkeypatch.setattr("sewfast.cli.recording.record_command", interrupted)
    assert cli.main(["record", "--on", "virtual", "--signal", "step"]) == 130
    assert capsys.readouterr().err == f"sewfast record: interrupted; {told}\n"


DEAF = """
import os, signal, sys, time
from sewfast import cli
from sewfast.storage import replace_file

def deaf(args):
    replace_file("done.csv", b"whole")
    fsync = os.fsync
    def slow(descriptor):
        fsync(descriptor)
        while True:
            try:
                signal.raise_signal(signal.SIGINT)
                time.sleep(60)
            except KeyboardInterrupt:
                pass
    os.fsync = slow
    replace_file("half.csv", b"half")

cli.recording.record_command = deaf
from sewfast.__main__ import main
sys.argv[1:] = ["record", "--on", "virtual", "--signal", "step"]
sys.exit(main())
"""


@needs_sigint
def test_a_command_that_does_not_hear_ctrl_c_ends_in_time(tmp_path: Path) -> None:
    began = time.monotonic()
    done = subprocess.run(
        [sys.executable, "-c", DEAF],
        cwd=tmp_path,
        env=environment(),
        capture_output=True,
        text=True,
    )
    assert time.monotonic() - began < 10.0
    assert done.returncode == cli.INTERRUPTED
    assert done.stderr == "sewfast record: interrupted; written: done.csv\n"
    assert [path.name for path in tmp_path.iterdir()] == ["done.csv"]


def test_interrupted_before_the_command_is_known(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def interrupted(given: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(cli, "build_parser", interrupted)
    assert cli.main(["record"]) == 130
    assert "nothing was written" in capsys.readouterr().err


def test_standard_output_that_is_closed(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "stdout", None)
    assert cli.main(["signals"]) == 0
    assert capsys.readouterr().err == ""


def test_a_recording_in_place_of_a_model_is_told_from_a_damaged_one(tmp_path: Path) -> None:
    (tmp_path / "run.csv").write_text("t,u,y\n0,1,2\n1,2,3\n")
    for command in (("tune", "run.csv"), ("run", "run.csv", "run.csv")):
        assert "sewfast identify makes a model" in refused(tmp_path, *command)


@pytest.mark.parametrize(
    ("given", "words"),
    [
        (["--limits", "volt=1"], "expected each of volt, speed, acceleration, current once"),
        (["--limits", "volt=1,speed=a,acceleration=3,current=5"], "expected numbers"),
        (["--watchdog", "0"], "expected 1 to 10000 ms"),
    ],
)
def test_limits_are_looked_at_before_a_port_is_opened(
    given: list[str], words: str, tmp_path: Path
) -> None:
    on = ["record", "--signal", "random", "--on", "socket://127.0.0.1:1", "-o", "run.mcap"]
    assert words in refused(tmp_path, *on, *given)
