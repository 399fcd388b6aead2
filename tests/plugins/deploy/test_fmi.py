"""FMUs both ways: models and controllers for other tools, and plants of other tools as machines.

FMPy and Ecos drive what the package writes; what the package drives was written by PythonFMU.
"""

from __future__ import annotations

import gc
import json
import shutil
import signal
import subprocess
import sys
import zipfile
from collections.abc import Iterator
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import deployed
import kinds
import sewfast
from foreign_fmu import OF_MOTOR, motor_fmu
from sewfast import deploy, paper_controller
from sewfast.cli import main
from sewfast.commissioning import FmuMachine, SteppedBench, fmu_bench
from sewfast.errors import ModelFileError, SettingError

fmpy = pytest.importorskip("fmpy", reason="needs fmpy")
pytestmark = pytest.mark.skipif(
    shutil.which("cc") is None or not sys.platform.startswith("linux"),
    reason="needs Linux and a C compiler",
)
KINDS = (
    "oe", "oe, three inputs", "neural_oe", "neural_ss, nk 0", "neural_ss, abs",
    "ensemble of mixed kinds",
)  # fmt: skip


class Slave:
    """An FMU in FMPy, sample by sample."""

    def __init__(self, file: Path, folder: Path) -> None:
        from fmpy.fmi3 import FMU3Slave

        described = fmpy.read_model_description(str(file), validate=True)
        self.Ts = float(described.coSimulation.fixedInternalStepSize)
        self.references = {v.name: v.valueReference for v in described.modelVariables}
        self.fmu = FMU3Slave(
            guid=described.guid,
            unzipDirectory=fmpy.extract(str(file), str(folder)),
            modelIdentifier=described.coSimulation.modelIdentifier,
            instanceName="slave",
        )
        self.fmu.instantiate()
        self.fmu.enterInitializationMode()
        self.fmu.exitInitializationMode()

    def set(self, **values: float) -> None:
        self.fmu.setFloat64([self.references[n] for n in values], list(values.values()))

    def get(self, name: str) -> float:
        return float(self.fmu.getFloat64([self.references[name]])[0])

    def step(self, k: int, samples: float = 1) -> None:
        self.fmu.doStep(k * self.Ts, samples * self.Ts)


@pytest.fixture
def slave(tmp_path: Path) -> Iterator[Any]:
    """Makes slaves of what is deployed, and frees them."""
    made: list[Slave] = []

    def make(what: Any, name: str = "plant") -> Slave:
        deploy(what, tmp_path, to="fmi", name=name)
        made.append(Slave(tmp_path / f"{name}.fmu", tmp_path / f"unpacked {len(made)}"))
        return made[-1]

    yield make
    for one in made:
        one.fmu.terminate()
        one.fmu.freeInstance()


@pytest.mark.nightly(
    "an FMU for each kind", by_day=["oe", "neural_ss, nk 0", "ensemble of mixed kinds"]
)
@pytest.mark.parametrize("name", KINDS)
def test_the_free_run_is_that_of_the_package(name: str, slave: Any, tmp_path: Path) -> None:
    from fmpy.validation import validate_fmu

    model = kinds.model_of(name)
    plant = slave(model)
    assert validate_fmu(str(tmp_path / "plant.fmu")) == []
    u = kinds.levels(1000, 5, len(model.input_names))
    u[0] = 0.0  # at rest before
    y = np.zeros(len(u))
    for k, row in enumerate(u):
        plant.set(**dict(zip(model.input_names, row, strict=True)))
        y[k] = plant.get(model.output_name)
        plant.step(k)
    expected = model.core.simulate(u, model.core.rest_state())
    assert np.abs(y - expected).max() <= 1e-12 * np.ptp(expected)


@pytest.mark.parametrize("ahead", [None, deployed.LEAD], ids=["plain", "ahead"])
def test_a_controller_is_stepped_alike(ahead: sewfast.Feedforward | None, slave: Any) -> None:
    controller = replace(paper_controller(), feedforward=ahead)
    fmu, core = slave(controller, "loop"), controller.core()
    rng = np.random.default_rng(0)
    for k in range(300):
        r, y = 500.0 + 20.0 * (k % 40), float(rng.normal(300.0, 200.0))
        fmu.set(r=r, y=y, feedforward=0.1)
        fmu.step(k)
        assert fmu.get("u") == core.step(r, y, 0.1)


ECOS = """
import ctypes, json, sys
from pathlib import Path

ctypes.CDLL(str(Path(sys.prefix, "lib", "libtbb.so.12")), mode=ctypes.RTLD_GLOBAL)
from ecospy import EcosSimulation, EcosSimulationStructure

given = json.load(sys.stdin)
structure = EcosSimulationStructure()
for name, file in given["models"].items():
    structure.add_model(name, file)
for source, sink in given["connections"]:
    structure.make_real_connection(source, sink)
run = EcosSimulation(structure=structure, step_size=given["Ts"])
run.init()
found = []
for row in given["inputs"]:
    for name, value in row.items():
        run.set_real(name, value)
    run.step(1)
    found.append([run.get_real(name) for name in given["outputs"]])
run.terminate()
Path(given["file"]).write_text(json.dumps(found))
"""


def _in_ecos(folder: Path, **given: Any) -> np.ndarray[Any, Any]:
    """Outputs after each step of Ecos, a co-simulation engine in C++ with an importer of its own.

    In a process of its own: what it logs and how it ends is no part of the test.
    """
    if find_spec("ecospy") is None or not Path(sys.prefix, "lib", "libtbb.so.12").exists():
        pytest.skip("needs ecospy and tbb")
    file = folder / "found.json"
    given["file"] = str(file)
    done = subprocess.run(
        [sys.executable, "-c", ECOS], input=json.dumps(given), capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    return np.array(json.loads(file.read_text()))


@pytest.mark.nightly("an FMU for each kind", by_day=["neural_oe"])
@pytest.mark.parametrize("name", ["oe", "neural_oe", "neural_ss, nk 0"])
def test_a_second_importer_has_the_same_free_run(name: str, tmp_path: Path) -> None:
    model = kinds.model_of(name)
    deploy(model, tmp_path, to="fmi")
    u = kinds.levels(300, 5, 1)[:, 0]
    u[0] = 0.0
    found = _in_ecos(
        tmp_path, models={"m": str(tmp_path / "model.fmu")}, connections=[], Ts=model.Ts,
        inputs=[{"m::u": float(v)} for v in u], outputs=[f"m::{model.output_name}"],
    )  # fmt: skip
    # after a step the input is still that of the sample before
    held = np.append(u, u[-1])
    for k in (0, 1, 150, 299):
        expected = model.core.simulate(
            np.append(u[: k + 1], u[k])[:, None], model.core.rest_state()
        )
        assert abs(found[k, 0] - expected[-1]) <= 1e-12 * np.ptp(found), k
    if "nk 0" not in name:
        expected = model.core.simulate(held[:, None], model.core.rest_state())[1:]
        assert np.abs(found[:, 0] - expected).max() <= 1e-12 * np.ptp(expected)


def test_a_second_importer_closes_the_loop(tmp_path: Path) -> None:
    """Controller and plant, connected there: each takes what the other gave in the last step."""
    model = kinds.model_of("oe")
    controller = sewfast.Controller(sewfast.Gains.standard(0.01, 0.1), Ts=model.Ts)
    deploy(model, tmp_path, to="fmi", name="plant")
    deploy(controller, tmp_path, to="fmi", name="loop")
    found = _in_ecos(
        tmp_path, Ts=model.Ts,
        models={n: str(tmp_path / f"{n}.fmu") for n in ("plant", "loop")},
        connections=[["loop::u", "plant::u"], [f"plant::{model.output_name}", "loop::y"]],
        inputs=[{"loop::r": 500.0, "loop::feedforward": 0.0}] * 300,
        outputs=["loop::u", f"plant::{model.output_name}"],
    )  # fmt: skip
    u, y = found.T
    core = controller.core()
    rest = float(model.core.simulate(np.zeros((1, 1)), model.core.rest_state())[0])
    expected = [core.step(500.0, v, 0.0) for v in (rest, *y[:-1])]
    assert np.array_equal(u, expected)
    assert 300.0 < y[-1] < 500.0


def test_several_samples_are_one_step_and_parts_are_none(slave: Any) -> None:
    model = kinds.model_of("neural_ss")
    one, many = slave(model), slave(model)
    for each in (one, many):
        each.set(u=2.0)
    for k in range(40):
        one.step(k)
    many.step(0, 40)
    assert one.get("speed") == many.get("speed") != 0.0
    with pytest.raises(fmpy.fmi1.FMICallException):
        one.step(40, 0.5)
    with pytest.raises(fmpy.fmi1.FMICallException):
        one.step(40, 0.0)


def test_a_state_is_kept_and_taken_up_again(slave: Any) -> None:
    plant = slave(kinds.model_of("neural_oe"))
    plant.set(u=3.0)
    plant.step(0, 10)
    state = plant.fmu.getFMUState()
    plant.step(10, 10)
    expected = plant.get("speed")
    stored = plant.fmu.serializeFMUState(state)
    plant.set(u=-1.0)
    plant.step(20, 30)
    again = plant.fmu.deserializeFMUState(stored)
    plant.fmu.setFMUState(again)
    plant.step(10, 10)
    assert plant.get("speed") == expected
    for kept in (state, again):
        plant.fmu.freeFMUState(kept)
    plant.fmu.reset()
    assert plant.get("time") == 0.0


def test_another_token_is_refused(tmp_path: Path) -> None:
    from fmpy.fmi3 import FMU3Slave

    deploy(kinds.model_of("oe"), tmp_path, to="fmi")
    folder = fmpy.extract(str(tmp_path / "model.fmu"), str(tmp_path / "unpacked"))
    other = FMU3Slave(
        guid="{other}", unzipDirectory=folder, modelIdentifier="model", instanceName="slave"
    )
    with pytest.raises(Exception, match="instantiate"):
        other.instantiate()


def test_the_same_model_gives_the_same_bytes(tmp_path: Path) -> None:
    model = kinds.model_of("neural_oe")
    files = [deploy(model, tmp_path / part, to="fmi").folder / "model.fmu" for part in "ab"]
    assert files[0].read_bytes() == files[1].read_bytes()
    assert {"sources/model.c", "sources/fmi3.c", "sources/buildDescription.xml"} <= set(
        zipfile.ZipFile(files[0]).namelist()
    )


def test_what_cannot_be_an_fmu_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    model = kinds.model_of("oe")
    with pytest.raises(SettingError, match="expected f64 for fmi"):
        deploy(model, tmp_path, to="fmi", precision="f32")
    model.save(tmp_path / "drive.json")
    assert main(["deploy", str(tmp_path / "drive.json"), str(tmp_path), "--to", "fmi"]) == 0
    assert "model.fmu" in capsys.readouterr().out
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(SettingError, match="C compiler"):
        deploy(model, tmp_path, to="fmi")


# --- Plants of other tools ------------------------------------------------------------------------


@pytest.fixture(scope="module")
def motor(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A motor that PythonFMU has made an FMU 2.0 of."""
    return motor_fmu(tmp_path_factory.mktemp("a motor"))


def test_a_foreign_plant_is_recorded_identified_and_run(motor: Path) -> None:
    bench = fmu_bench(motor, **OF_MOTOR)
    u = 3.0 * sewfast.signals.excitation("chirp_lo_hi")[:4000]
    recording = sewfast.record(bench, u)
    assert recording.speed_true is not None
    assert np.abs(recording.y - recording.speed_true).max() < 30.0
    assert np.array_equal(sewfast.record(bench, u).counts, recording.counts)
    model = sewfast.identify(recording.dataset(), model="oe")
    assert sewfast.validate(model, recording.dataset()).simulation.fit_percent > 90.0
    controller = sewfast.Controller(sewfast.Gains.standard(0.01, 0.1), u_min=-10.0, u_max=10.0)
    found = sewfast.run(controller, bench, np.full(800, 1000.0))
    assert abs(found.y[-1] - 1000.0) < 20.0


@pytest.mark.nightly("a commissioning of an FMU")
def test_a_foreign_plant_is_commissioned(motor: Path) -> None:
    found = sewfast.commission(fmu_bench(motor, **OF_MOTOR), speed=1500, members=2, evaluations=200)
    assert found.is_verified, found.verdict


def test_counts_come_from_speed_where_there_is_no_angle(motor: Path) -> None:
    both = fmu_bench(motor, **OF_MOTOR)
    alone = fmu_bench(motor, **{k: v for k, v in OF_MOTOR.items() if not k.startswith("angle")})
    u = np.repeat([2.0, 6.0, -3.0], 200)
    counts = [sewfast.record(bench, u).counts for bench in (both, alone)]
    assert np.abs(counts[0] - counts[1]).max() < 5e-4 * counts[0].max()


def test_its_own_fmu_is_a_machine_as_well(tmp_path: Path) -> None:
    model = kinds.model_of("neural_ss")
    deploy(model, tmp_path, to="fmi")
    machine = FmuMachine(
        tmp_path / "model.fmu", Ts=kinds.TS, input="u", speed="speed", counts_per_rev=1000.0
    )
    u = kinds.levels(200, 3, 1)
    u[0] = 0.0
    expected = model.core.simulate(u, model.core.rest_state())
    for k in range(200):
        machine.step(float(u[k, 0]))
        if k + 1 < 200:
            assert abs(machine.speed_rpm - expected[k + 1]) < 1e-9


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"input": "volt"}, "real variable 'volt'.*inputs voltage"),
        ({"speed": None, "angle": None}, "among 2 outputs.*speed, angle"),
        ({"speed_unit": None}, "give speed_unit="),
        ({"angle_unit": "mile"}, "give angle_unit="),
        ({"Ts": 0.0}, "Ts: expected"),
        ({"timeout": float("nan")}, "timeout: expected"),
        ({"input": "speed"}, "an input as input=, received 'speed'"),
    ],
)
def test_variables_that_do_not_fit_are_refused(
    changed: dict[str, Any], message: str, motor: Path
) -> None:
    with pytest.raises(SettingError, match=message):
        fmu_bench(motor, **{**OF_MOTOR, **changed})


def _altered(source: Path, place: Path, **entries: bytes | None) -> Path:
    """A copy with entries replaced, added, or left out."""
    changed = {name.replace("__", "/").replace("_dot_", "."): v for name, v in entries.items()}
    with zipfile.ZipFile(source) as old, zipfile.ZipFile(place, "w") as new:
        for entry in old.infolist():
            if entry.filename not in changed:
                new.writestr(entry, old.read(entry))
        for name, content in changed.items():
            if content is not None:
                new.writestr(name, content)
    return place


def test_what_is_no_fmu_or_would_do_harm_is_refused(tmp_path: Path, motor: Path) -> None:
    def refused(path: Path, message: str) -> None:
        with pytest.raises(ModelFileError, match=message):
            fmu_bench(path, **OF_MOTOR)

    refused(tmp_path / "nix.fmu", "can be read")
    (tmp_path / "text.fmu").write_text("no zip at all")
    refused(tmp_path / "text.fmu", "a zip file")
    cut = tmp_path / "cut.fmu"
    cut.write_bytes(motor.read_bytes()[:5000])
    refused(cut, "a zip file")
    with zipfile.ZipFile(motor) as archive:
        xml = archive.read("modelDescription.xml")
    names = {"modelDescription_dot_xml": b""}
    without = _altered(motor, tmp_path / "a.fmu", **dict.fromkeys(names))
    refused(without, "one modelDescription.xml")
    broken = _altered(motor, tmp_path / "b.fmu", modelDescription_dot_xml=xml[:200])
    refused(broken, "model description is valid")
    entity = xml.replace(b"?>", b'?><!DOCTYPE x [<!ENTITY a "b">]>', 1)
    refused(_altered(motor, tmp_path / "c.fmu", modelDescription_dot_xml=entity), "entities")
    exchange = xml.replace(b"CoSimulation", b"ModelExchange")
    refused(
        _altered(motor, tmp_path / "d.fmu", modelDescription_dot_xml=exchange),
        "co-simulation|valid",
    )
    outside = tmp_path / "e.fmu"
    shutil.copy(motor, outside)
    with zipfile.ZipFile(outside, "a") as archive:
        archive.writestr("../outside.txt", "x")
    refused(outside, "within the FMU")
    assert not (tmp_path / "outside.txt").exists()
    with zipfile.ZipFile(motor) as archive:
        binaries = [n for n in archive.namelist() if n.startswith("binaries/linux64")]
    bare = tmp_path / "f.fmu"
    with zipfile.ZipFile(motor) as old, zipfile.ZipFile(bare, "w") as new:
        for entry in old.infolist():
            if entry.filename not in binaries:
                new.writestr(entry, old.read(entry))
    refused(bare, "a binary for")


def _faulty(folder: Path, fault: str) -> Path:
    """An FMU of a model whose step does something else after a while."""
    deploy(kinds.model_of("oe"), folder, to="fmi")
    unpacked, broken = folder / "unpacked", folder / "faulty.fmu"
    with zipfile.ZipFile(folder / "model.fmu") as archive:
        archive.extractall(unpacked)
    source = unpacked / "sources" / "model.c"
    opening = "model_real model_step(model_model *model, const model_real *u)\n{\n"
    text = source.read_text()
    assert opening in text
    worse = f"static int calls;\n{opening}    if (++calls > 80) {{ {fault} }}\n"
    source.write_text(f"#include <stdio.h>\n#include <stdlib.h>\n{text.replace(opening, worse)}")
    binary = next((unpacked / "binaries").rglob("model.so"))
    files = [str(source), str(source.with_name("fmi3.c"))]
    subprocess.run(["cc", "-w", "-fPIC", "-shared", *files, "-o", str(binary)], check=True)
    with zipfile.ZipFile(broken, "w") as archive:
        for file in unpacked.rglob("*"):
            archive.write(file, file.relative_to(unpacked))
    return broken


OF_FAULTY: dict[str, Any] = {"volt": 5.0, "Ts": kinds.TS, "counts_per_rev": 1000.0}


@pytest.mark.nightly("waits for each fault")
@pytest.mark.parametrize(
    ("fault", "options", "received"),
    [
        ("abort();", {}, "a process that ended (SIGABRT)"),
        ("*(volatile int *)0 = 1;", {}, "a process that ended (SIGSEGV)"),
        ("exit(0);", {}, "a process that ended (code 0)"),
        ("for (;;) ;", {"timeout": 3.0}, "no answer within 3 s"),
        ("return 0.0 / 0.0;", {}, "nan at"),
    ],
)
def test_a_faulty_binary_is_an_error_and_not_the_end(
    fault: str, options: dict[str, float], received: str, tmp_path: Path
) -> None:
    bench = fmu_bench(_faulty(tmp_path, fault), **OF_FAULTY, **options)
    for _ in range(2):  # it stays ended, and says why
        with pytest.raises(SettingError) as found:
            sewfast.record(bench, np.ones(100))
        assert received in str(found.value.received)
        assert found.value.remedy
        if "nan" in received:
            break


@pytest.mark.skipif(not hasattr(signal, "setitimer"), reason="needs POSIX timers")
def test_ctrl_c_ends_a_step_without_end(tmp_path: Path) -> None:
    bench = fmu_bench(_faulty(tmp_path, "for (;;) ;"), **OF_FAULTY)

    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    before = signal.signal(signal.SIGALRM, interrupt)
    try:
        signal.setitimer(signal.ITIMER_REAL, 2.0)
        with pytest.raises(KeyboardInterrupt):
            sewfast.record(bench, np.ones(100))
    finally:
        signal.signal(signal.SIGALRM, before)
    assert isinstance(bench.machine, FmuMachine)
    assert bench.machine._process._process.wait(10.0) < 0


def test_what_an_fmu_prints_is_no_answer(tmp_path: Path) -> None:
    bench = fmu_bench(_faulty(tmp_path, 'puts("mine"); fflush(0);'), **OF_FAULTY)
    assert len(sewfast.record(bench, np.ones(100)).counts) == 100
    assert isinstance(bench.machine, FmuMachine)
    folder = bench.machine._folder
    bench.machine.close()
    assert bench.machine._process._process.poll() == 0
    del bench
    gc.collect()
    assert not Path(folder).exists()


def test_hostile_descriptions_are_refused(tmp_path: Path, motor: Path) -> None:
    with zipfile.ZipFile(motor) as archive:
        xml = archive.read("modelDescription.xml")

    def refused(content: bytes, message: str) -> None:
        path = _altered(motor, tmp_path / "altered.fmu", modelDescription_dot_xml=content)
        with pytest.raises(ModelFileError, match=message):
            fmu_bench(path, **OF_MOTOR)

    # entities that a search for bytes does not see
    laughs = '<?xml version="1.0" encoding="UTF-16"?><!DOCTYPE x [<!ENTITY a "b">]>'
    refused((laughs + xml.decode().partition("?>")[2]).encode("utf-16"), "version 1.0, 2.0 or 3.0")
    refused(xml.replace(b'fmiVersion="2.0"', b'fmiVersion="4.0"'), "3.0, received 4.0")
    refused(xml.replace(b'fmiVersion="2.0"', b""), "3.0, received none")
    refused(
        xml.replace(b'modelIdentifier="Motor"', b'modelIdentifier="../x"'), r"received '\.\./x'"
    )
    refused(b" " * (65 * 1024**2), "at most 67108864 bytes")


def test_without_fmpy_its_name_is_said(motor: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "fmpy", None)
    with pytest.raises(SettingError, match=r'pip install "sewfast\[fmi\]"'):
        fmu_bench(motor, **OF_MOTOR)


def test_a_bench_of_an_fmu_is_a_bench(motor: Path) -> None:
    bench = fmu_bench(motor, **OF_MOTOR)
    assert isinstance(bench, SteppedBench)
    assert (bench.name, bench.volt, bench.Ts) == ("Motor", 10.0, 0.001)


def test_the_commands_take_an_fmu(
    motor: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    on = f"{motor}?volt=10&speed=speed&speed_unit=RPM"
    out = str(tmp_path / "step.csv")
    record = ["record", "--signal", "step", "-o", out]
    assert main([*record, "--on", on]) == 0
    assert "Motor, step: 3000 samples" in capsys.readouterr().out
    controller = sewfast.Controller(sewfast.Gains.standard(0.01, 0.1), u_min=-10.0, u_max=10.0)
    controller.save(tmp_path / "controller.json")
    run = ["run", str(tmp_path / "controller.json"), "--on", on, "--reference", "trapezoid"]
    assert main([*run, "--json"]) == 0
    capsys.readouterr()
    for wrong, said in (
        (str(motor), "add ?volt=24"),
        (f"{motor}?volt=much", "volt as a number"),
        (f"{motor}?voltage=3", "arguments among volt"),
        (str(motor.with_name("nix.fmu?volt=3")), "can be read"),
    ):
        assert main([*record, "--on", wrong]) == 2
        assert said in capsys.readouterr().err
