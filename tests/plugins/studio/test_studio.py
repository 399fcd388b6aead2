"""The studio: who is let in, what its steps find, its copies, and the page in a real browser."""

from __future__ import annotations

import http.client
import json
import shutil
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import sewfast
from cli import PROGRAM, environment
from effort import FULL
from moments import until
from sewfast.errors import SettingError
from sewfast.tuning import costs, first_controller, led, verdict_on
from sewfast_studio import Project, Step, Studio
from sewfast_studio.requests import envelope
from studio_page import EVIL, Page, websockets

STEP = {"file": "run.csv", "inputs": ["u"], "output": "y", "resample": 0.02, "model": "oe"}


# --- Who is let in --------------------------------------------------------------------------------


def _get(studio: Studio, path: str, **headers: str) -> tuple[int, dict[str, str], bytes]:
    connection = http.client.HTTPConnection("127.0.0.1", studio.port, timeout=10)
    connection.putrequest("GET", path, skip_host=True)
    for name, value in {"Host": f"127.0.0.1:{studio.port}", **headers}.items():
        connection.putheader(name, value)
    connection.endheaders()
    answer = connection.getresponse()
    return answer.status, dict(answer.getheaders()), answer.read()


def test_the_page_is_served_with_a_strict_policy(studio: Studio) -> None:
    status, headers, body = _get(studio, "/")
    assert status == 200
    assert b"sewfast studio" in body
    policy = headers["Content-Security-Policy"]
    assert "default-src 'none'" in policy
    assert "unsafe" not in policy
    assert studio.token.encode() not in body


@pytest.mark.parametrize("host", ["evil.example", "evil.example:{port}", "127.0.0.1", "0.0.0.0"])
def test_a_foreign_host_is_refused(studio: Studio, host: str) -> None:
    assert _get(studio, "/", Host=host.format(port=studio.port))[0] == 403


def test_a_rebound_name_is_refused_though_its_origin_agrees(studio: Studio) -> None:
    evil = f"evil.example:{studio.port}"
    assert _get(studio, "/", Host=evil, Origin=f"http://{evil}")[0] == 403
    assert _get(studio, "/", Origin=f"http://{evil}")[0] == 403


@pytest.mark.parametrize(
    "path",
    ["/../project.py", "/%2e%2e/project.py", "/run.csv", "//etc/passwd", "/page/index.html",
     "/studio.js/../../server.py", "/..%5cproject.py", "/index.html%00"],
)  # fmt: skip
def test_only_the_page_s_files_are_served(studio: Studio, path: str) -> None:
    assert _get(studio, path)[0] == 404


@pytest.mark.parametrize("origin", ["http://evil.example", "null", None, "https://127.0.0.1"])
def test_a_socket_of_a_foreign_origin_is_refused(studio: Studio, origin: str | None) -> None:
    from websockets.exceptions import InvalidStatus

    with pytest.raises(InvalidStatus) as refused:
        Page(studio, origin=origin)
    assert refused.value.response.status_code == 403


@pytest.mark.parametrize("token", ["", "wrong", "x" * 43, "ü" * 10])
def test_a_wrong_token_hears_nothing(studio: Studio, token: str) -> None:
    from websockets.exceptions import ConnectionClosed

    with Page(studio, token) as found, pytest.raises(ConnectionClosed):
        found.socket.recv(timeout=10)


def test_a_large_message_ends_its_socket_and_no_other(studio: Studio, page: Page) -> None:
    from websockets.exceptions import ConnectionClosed

    with Page(studio) as other:
        other.event("state")
        with pytest.raises(ConnectionClosed):
            other.ask("look", file="x" * 70_000)
    assert page.ask("columns", **STEP)["found"]["names"][-1] == EVIL


def test_a_body_is_refused(studio: Studio) -> None:
    with socket.create_connection(("127.0.0.1", studio.port), timeout=10) as raw:
        head = (
            f"POST / HTTP/1.1\r\nHost: 127.0.0.1:{studio.port}\r\nContent-Length: 9999999\r\n\r\n"
        )
        raw.sendall(head.encode())
        answer = raw.recv(100)
    assert not answer.startswith(b"HTTP/1.1 200")


@pytest.mark.parametrize(
    "file",
    ["../secret.csv", "/etc/passwd", "link.csv", "sub/run.csv", "", "run.csv\0", "model.json"],
)
def test_nothing_outside_the_project_is_opened(folder: Path, page: Page, file: str) -> None:
    (folder.parent / "secret.csv").write_text("t,u,y\n0,1,2\n", encoding="utf-8")
    (folder / "link.csv").symlink_to(folder.parent / "secret.csv")
    assert "in the project folder" in page.ask("columns", file=file)["error"]


@pytest.mark.parametrize(
    "message", ["", "[]", "1", "{", '{"do":5}', "[" * 5000, '{"do":"__init__"}']
)
def test_a_malformed_message_is_answered(page: Page, message: str) -> None:
    page.socket.send(message)
    assert page.hear(lambda m: "error" in m)["id"] is None
    assert "found" in page.ask("columns", **STEP)


@pytest.mark.parametrize(
    "wrong",
    [
        {"inputs": "u"},
        {"model": "os"},
        {"seed": -1},
        {"resample": "1"},
        {"seed": True},
        {"file": 3},
    ],
)
def test_a_wrong_setting_is_named(page: Page, wrong: dict[str, Any]) -> None:
    assert page.ask("look", **{**STEP, **wrong})["error"].startswith(next(iter(wrong)))


def test_one_page_writes_and_others_look_on(studio: Studio, page: Page) -> None:
    assert page.event("state")["writes"]
    with Page(studio) as reader:
        assert not reader.event("state")["writes"]
        assert "looks on" in reader.ask("identify", **STEP)["error"]
        assert "curves" in reader.ask("look", **STEP)["found"]
        reader.ask("take")
        assert "looks on" in page.ask("identify", **STEP)["error"]


# --- Tuning ---------------------------------------------------------------------------------------


MOVE: dict[str, Any] = {"model": "drive.json", "values": {"Kp": 0.03, "Ti": 0.07}}


def test_a_move_gives_what_the_library_gives(tuned: Studio) -> None:
    model = sewfast.load_model(tuned.project.folder / "drive.json")
    tuning = tuned.project.tuning("drive.json")
    start = first_controller(model)
    gains = sewfast.Gains.standard(0.03, 0.07, start.gains.Td, u_unit="V", y_unit="RPM")
    wanted = replace(start, gains=gains)
    with Page(tuned) as page:
        found = page.ask("tune_move", **MOVE)
    shown, curves = found["found"], found["curves"]
    direct = [
        sewfast.margins(wanted, m, speed=shown_at)
        for m, shown_at in zip(model.members, [tuning.steps.level] * 4, strict=True)
    ]
    assert shown["Ms"] == pytest.approx(max(m.Ms for m in direct), rel=1e-9)
    assert shown["phase_margin_deg"] == pytest.approx(min(m.phase_margin_deg for m in direct))
    r = np.interp(np.arange(4 * tuning.steps.samples), [0, tuning.steps.samples], [0, 1])
    r = tuning.steps.level * r + tuning.steps.step * (np.arange(len(r)) >= 3 * tuning.steps.samples)
    runs = np.array([sewfast.run(wanted, m, r, noise=0.0).y for m in model.members])
    n = len(curves["reference_y"])
    np.testing.assert_array_equal(curves["reference_y_high"], runs.max(axis=0)[-n:].astype("f4"))
    np.testing.assert_array_equal(curves["reference_y"], np.median(runs, 0)[-n:].astype("f4"))


def test_limits_and_costs_are_judged_as_tune_does(tuned: Studio) -> None:
    model = sewfast.load_model(tuned.project.folder / "drive.json")
    start = first_controller(model)
    with Page(tuned) as page:
        found = page.ask("tune_judge", **MOVE)["found"]
        assert found["start_cost"] == costs(start, model)[0] != found["cost"]
        # gains that a search kept within limits are within them on the page
        limits = {"Ms": 1.5, "overshoot": 3.0}
        page.ask("tune_search", evaluations=60, seed=0, constraints=limits, **MOVE)
        values = page.event("searched")["found"]["values"]
        found = page.ask("tune_judge", **{**MOVE, "values": values})["found"]
    assert found["Ms"] <= 1.001 * limits["Ms"]
    assert 0.0 < found["overshoot"] <= limits["overshoot"]
    assert 0.0 < found["u"] <= start.u_max


def test_noise_and_feedforward_are_those_of_the_library(tuned: Studio) -> None:
    model = sewfast.load_model(tuned.project.folder / "drive.json")
    tuning, start = tuned.project.tuning("drive.json"), first_controller(model)
    with Page(tuned) as page:
        calm = page.ask("tune_move", **MOVE)["curves"]
        noisy = page.ask("tune_move", **MOVE, noise=True)["curves"]
    assert np.array_equal(noisy["L_db"], calm["L_db"])
    assert not np.array_equal(noisy["reference_u"], calm["reference_u"])
    wanted, _ = led(start, model)
    assert wanted.feedforward is not None
    with_lead = tuning.controller({"feedforward": 1, "alpha": 0.0, "beta": 0.0})
    assert replace(with_lead, notes=wanted.notes) == wanted
    with_lead.save(tuned.project.folder / "led.json")
    other = tuned.project.tuning("drive.json", "led.json")
    assert other.controller({}).feedforward == wanted.feedforward
    assert other.controller({"feedforward": 0}).feedforward is None


def test_the_verdict_is_that_of_tune(tuned: Studio) -> None:
    tuning = tuned.project.tuning("drive.json")
    found = sewfast.tune(tuning.model, evaluations=60, feedforward="none")
    assert verdict_on(found.controller, tuning.model) == found.verdict
    with Page(tuned) as page:
        hot = page.ask("tune_verdict", **{**MOVE, "values": {"Kp": 0.1}})["found"]
    assert hot["grade"] == "poor"
    assert "Ms is" in hot["text"]
    assert "lower Kp" in hot["text"]


@pytest.mark.parametrize(
    "wrong",
    [
        {"values": {"feedforward": 2}},
        {"values": {"Kp": "1"}},
        {"values": {"Kp": float("inf")}},
        {"values": {"Kp": True}},
        {"values": {"filter_samples": 2.5}},
        {"values": {"filter_samples": 1e30}},
        {"values": {"u_max": 1.0}},
        {"values": {"notes": "x"}},
        {"values": [1]},
        {"model": "../drive.json"},
        {"model": ["drive.json"]},
        {"model": None},
        {"controller": "drive.json"},
        {"controller": "/etc/passwd"},
    ],
)
def test_a_wrong_move_is_refused(tuned: Studio, wrong: dict[str, Any]) -> None:
    with Page(tuned) as page:
        answer = page.ask("tune_move", **{**MOVE, **wrong})
        assert "fault" not in answer["error"]
        assert "found" in page.ask("tune_move", **MOVE)


@pytest.mark.parametrize(
    "file",
    ["../c.json", "/tmp/c.json", ".c.json", "c.csv", "", "a/b.json", "x" * 80 + ".json", None,
     "drive.json", "link.json", "c.json\n"],
)  # fmt: skip
def test_a_controller_is_written_nowhere_else(tuned: Studio, file: str | None) -> None:
    folder = tuned.project.folder
    (folder / "link.json").symlink_to(folder.parent / "outside.json")
    before = sorted(folder.rglob("*"))
    model = (folder / "drive.json").read_bytes()
    with Page(tuned) as page:
        assert "error" in page.ask("tune_save", file=file, **MOVE)
    assert sorted(folder.rglob("*")) == before
    assert (folder / "drive.json").read_bytes() == model
    assert not (folder.parent / "outside.json").exists()


def test_only_the_writer_searches_and_saves(tuned: Studio) -> None:
    with Page(tuned) as writer:
        assert writer.event("state")["writes"]
        with Page(tuned) as reader:
            for name in ("tune_search", "tune_save", "cancel"):
                assert "looks on" in reader.ask(name, file="c.json", **MOVE)["error"]
            assert "found" in reader.ask("tune_move", **MOVE)


def _run_copies(folder: Path, script: str, commands: str) -> list[bytes]:
    """The controller file that each copy writes."""
    place, found = folder / "controller.json", []
    shell = f'sewfast() {{ "{sys.executable}" -m sewfast "$@"; }}\nset -e\n{commands}'
    for command in ([sys.executable, "-c", script], ["sh", "-c", shell]):
        place.unlink()
        subprocess.run(command, cwd=folder, env=environment(), check=True, capture_output=True)
        found.append(place.read_bytes())
    return found


@pytest.mark.nightly("a search, made twice")
@pytest.mark.parametrize("lead", [0, 1])
def test_copies_of_a_controller_give_the_same_file(tuned: Studio, lead: int) -> None:
    folder, values = tuned.project.folder, {**MOVE["values"], "feedforward": lead}
    with Page(tuned) as page:
        asked = {**MOVE, "values": values}
        said = page.ask("tune_save", file="controller.json", **asked)["found"]
    written = (folder / "controller.json").read_bytes()
    assert _run_copies(folder, said["python"], said["commands"]) == [written, written]


@pytest.mark.nightly("a search, made twice; controllers' copies run in `make test`")
@pytest.mark.parametrize("lead", [0, 1])
def test_copies_of_a_search_give_the_same_file(tuned: Studio, lead: int) -> None:
    folder, values = tuned.project.folder, {**MOVE["values"], "feedforward": lead}
    with Page(tuned) as page:
        page.ask("tune_search", evaluations=60, seed=3, **{**MOVE, "values": values})
        assert page.event("progress")["of"] == "searched"
        found = page.event("searched")["found"]
        assert found["cost"] < found["start_cost"]
        asked = {**MOVE, "values": found["values"], "file": "controller.json"}
        said = page.ask("tune_save", **asked)["found"]
    assert "sewfast.tune(" in said["python"]
    written = (folder / "controller.json").read_bytes()
    assert _run_copies(folder, said["python"], said["commands"]) == [written, written]


def test_why_a_search_failed_is_told_to_the_page_that_asked(tuned: Studio) -> None:
    impossible = {"evaluations": 10, "seed": 0, "constraints": {"u": 1e-6, "Ms": 1.01}}
    with Page(tuned) as other, Page(tuned) as page:
        page.ask("take")
        page.ask("tune_search", **impossible, **MOVE)
        assert page.event("searched")["error"]
        assert other.hear(lambda m: m.get("event") == "searched") == {"event": "searched"}
        # its page is gone by the end: then the others are told
        page.ask("tune_search", **impossible, **MOVE)
        page.socket.close()
        assert other.hear(lambda m: m.get("event") == "searched")["error"]


def test_a_cancelled_search_gives_its_best_so_far(tuned: Studio) -> None:
    with Page(tuned) as page:
        page.ask("tune_search", evaluations=20_000, seed=0, **MOVE)
        assert "a job that runs" in page.ask("tune_search", evaluations=10, seed=0, **MOVE)["error"]
        page.hear(lambda m: m.get("event") == "progress" and m["done"] > 100)
        page.ask("cancel")
        found = page.event("searched")["found"]
        assert found["interrupted"]
        asked = {**MOVE, "values": found["values"], "file": "controller.json"}
        assert "sewfast.tune(" not in page.ask("tune_copy", **asked)["found"]["python"]


def test_a_file_is_replaced_only_where_a_page_asks_for_it(folder: Path, page: Page) -> None:
    asked = {**STEP, "model": "oe"}
    page.ask("identify", **asked)
    assert page.event("identified")["found"]["file"] == "model.json"
    page.hear(lambda m: m.get("event") == "state" and m["models"] == ["model.json"])
    first = (folder / "model.json").read_bytes()
    for more in ({}, {"replace": True, "model_file": "run.csv"}):
        assert "error" in page.ask("identify", **asked, **more)
    page.ask("identify", **asked, model_file="second.json")
    assert "model='oe'" in page.event("identified")["found"]["python"]
    said = page.ask("validate", **asked, model_file="second.json")["found"]
    assert "load_model('second.json')" in said["python"]
    assert "check second.json" in said["commands"]
    assert (folder / "model.json").read_bytes() == first
    tune = {"model": "second.json", "values": {}, "file": "controller.json"}
    assert "found" in page.ask("tune_save", **tune)
    assert "is there already" in page.ask("tune_save", **tune)["error"]
    assert "found" in page.ask("tune_save", **tune, replace=True)
    assert "error" in page.ask("tune_save", **{**tune, "file": "model.json"}, replace=True)


def test_a_controller_file_is_a_start(tuned: Studio) -> None:
    with Page(tuned) as page:
        page.ask("tune_save", file="mine.json", **MOVE)
        assert tuned.project.state()["controllers"] == ["mine.json"]
        opened = page.ask("tune_open", model="drive.json", controller="mine.json")["found"]
    values = {knob["name"]: knob["value"] for knob in opened["knobs"]}
    assert (values["Kp"], values["Ti"]) == (0.03, 0.07)


def test_an_unstable_loop_is_said_to_be_one(tuned: Studio) -> None:
    with Page(tuned) as page:
        found = page.ask("tune_move", model="drive.json", values={"Kp": 5.0, "Td": 0.0})["found"]
    assert not found["stable"]
    assert found["Ms"] is None


# --- Commissioning --------------------------------------------------------------------------------

BRIEF = {"machine": "virtual:1", "seed": 0, "members": 1, "evaluations": 100}


@pytest.mark.nightly("a commissioning, made twice")
@pytest.mark.alone
def test_the_machine_is_commissioned_and_the_copies_do_the_same(tuned: Studio) -> None:
    folder = tuned.project.folder
    place = folder / "commissioned" / "controllers" / "tuned.json"
    with Page(tuned) as page:
        assert page.ask("commission", **BRIEF)["found"] is None
        assert page.event("progress")["best"] == "first motion"
        found = page.hear(lambda m: m.get("event") == "commissioned", 300)["found"]
        assert found["verdict"].startswith("verified")
        names = [curve["name"] for curve in found["references"][0]["curves"]]
        assert names == ["measured", "predicted"]
        start = "commissioned/controllers/tuned.json"
        asked = {"model": "commissioned/models/ensemble.json", "controller": start}
        assert page.ask("tune_move", values={}, **asked)["found"]["stable"]
    written = place.read_bytes()
    shell = f'sewfast() {{ "{sys.executable}" -m sewfast "$@"; }}\n{found["commands"]}'
    copies = [["sh", "-c", shell], [sys.executable, "-c", found["python"]]]
    for command in copies if FULL else copies[:1]:
        place.unlink()
        subprocess.run(command, cwd=folder, env=environment(), check=True, capture_output=True)
        assert place.read_bytes() == written


def test_a_cancelled_commissioning_writes_nothing(tuned: Studio) -> None:
    with Page(tuned) as page:
        page.ask("commission", **BRIEF)
        page.event("progress")
        page.ask("cancel")
        assert "cancelled" in page.event("commissioned")["error"]
    assert not (tuned.project.folder / "commissioned").exists()


@pytest.mark.parametrize(
    "wrong",
    [
        {"machine": "/dev/ttyUSB0"},
        {"machine": "virtual?u_limit=1e9"},
        {"machine": "virtual:1;touch hit"},
        {"machine": 1},
        {"seed": -1},
        {"members": 10_000},
        {"evaluations": 1.5},
    ],
)
def test_no_other_machine_is_commissioned(tuned: Studio, wrong: dict[str, Any]) -> None:
    with Page(tuned) as page:
        assert page.ask("commission", **{**BRIEF, **wrong})["error"].startswith(next(iter(wrong)))


def test_a_folder_of_somebody_else_is_left_alone(tuned: Studio) -> None:
    outside = tuned.project.folder.parent / "outside"
    outside.mkdir()
    (tuned.project.folder / "commissioned").symlink_to(outside)
    with Page(tuned) as page:
        page.ask("commission", **BRIEF)
        assert "a link" in page.event("commissioned")["error"]
    assert list(outside.iterdir()) == []


# --- Steps ----------------------------------------------------------------------------------------


def test_a_model_is_identified_and_validated(folder: Path, page: Page) -> None:
    assert page.ask("identify", **STEP)["found"] is None
    assert page.event("progress")["of"] == "identified"
    found = page.event("identified")["found"]
    assert found["fit"] > 50
    assert (folder / "model.json").is_file()
    checked = page.ask("validate", **{**STEP, "file": "run2.csv"})["found"]
    assert {"name", "shown", "limit", "verdict", "meaning"} <= set(checked["lines"][0])
    assert checked["grade"] in ("good", "warn", "bad")
    assert len(checked["error"]["low"]) == len(checked["free_run"][0]["low"])
    assert len(checked["free_run"]) == 2


def test_what_was_left_out_of_a_file_is_said(folder: Path, page: Page) -> None:
    torn = folder / "torn.csv"
    torn.write_text((folder / "run.csv").read_text(encoding="utf-8")[:-9], encoding="utf-8")
    found = page.ask("look", **{**STEP, "file": "torn.csv"})["found"]
    assert found["advice"][0]["text"].startswith("torn.csv: the last line is cut off")
    assert not found["advice"][0]["idle"]


def test_a_cancelled_search_writes_nothing(folder: Path, page: Page) -> None:
    page.ask("identify", **{**STEP, "model": "auto"})
    assert "a job that runs" in page.ask("identify", **STEP)["error"]
    page.ask("cancel")
    assert "cancelled" in page.event("identified")["error"]
    assert not (folder / "model.json").exists()


def _model(folder: Path) -> dict[str, Any]:
    """A model file without the seconds that its search took."""
    found = json.loads((folder / "model.json").read_text(encoding="utf-8"))
    found["training"].pop("seconds")
    return dict(found)


@pytest.mark.nightly("a process for each kind", by_day=["oe"])
@pytest.mark.parametrize("kind", ["oe", "neural_oe"])
def test_copies_give_the_same_bits(folder: Path, tmp_path: Path, kind: str) -> None:
    project, step = Project(folder), Step("run.csv", ("u",), "y", 0.02, kind, 3)
    project.identify(step)
    first = _model(folder)
    script = project.python(step, "identify") + project.python(step, "validate")
    (folder / "model.json").unlink()
    subprocess.run([sys.executable, "-c", script], cwd=folder, check=True, capture_output=True)
    assert _model(folder) == first
    (folder / "model.json").unlink()
    for name in ("look", "identify", "validate"):
        for line in project.commands(step, name).splitlines():
            command = line.replace("sewfast", f"{sys.executable} -m sewfast", 1)
            subprocess.run(
                command, shell=True, cwd=folder, env=environment(), check=True, capture_output=True
            )
    assert _model(folder) == first


def test_a_copy_quotes_names(folder: Path) -> None:
    name = "it's $(touch hit) 'a'.csv"
    shutil.copy(folder / "run.csv", folder / name)
    project, step = Project(folder), Step(name, ("u",), EVIL)
    for line in project.commands(step, "look").splitlines():
        command = line.replace("sewfast", f"{sys.executable} -m sewfast", 1)
        subprocess.run(command, shell=True, cwd=folder, check=True, capture_output=True)
    script = project.python(step, "look")
    subprocess.run([sys.executable, "-c", script], cwd=folder, check=True, capture_output=True)
    assert not (folder / "hit").exists()


def test_an_envelope_keeps_every_extreme() -> None:
    y = np.random.default_rng(0).normal(size=100_003)
    y[5000:6000] = np.nan
    found = envelope(y, 0.001, columns=400)
    assert len(found["low"]) == 400
    assert min(found["low"]) == np.nanmin(y)
    assert max(found["high"]) == np.nanmax(y)
    short = envelope(y[:100], 0.001, columns=400)
    assert short["low"] == short["high"] == y[:100].tolist()


# --- The command ----------------------------------------------------------------------------------


def test_a_taken_port_is_refused(folder: Path, studio: Studio) -> None:
    with pytest.raises(SettingError, match="--port"):
        Studio(Project(folder), studio.port)


def test_a_missing_extra_is_named(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "websockets.sync.server", None)
    with pytest.raises(SettingError, match=r"sewfast\[studio\]"):
        Studio(Project(folder))


@contextmanager
def started(folder: Path) -> Iterator[tuple[subprocess.Popen[str], Any]]:
    """The command in a process of its own, and a page that has shown its token."""
    command = [*PROGRAM, "studio", str(folder), "--no-browser"]
    with subprocess.Popen(
        command, env=environment(), stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout is not None
        try:
            address, _, token = process.stdout.readline().rstrip().partition("/#")
            place = address.replace("http", "ws") + "/socket"
            with websockets.connect(place, origin=address) as page:
                page.send(token)
                yield process, page
        finally:  # a test that failed would wait for it
            process.kill()


@pytest.mark.skipif(not hasattr(signal, "SIGHUP"), reason="needs the signals of POSIX")
@pytest.mark.parametrize("name", ["SIGTERM", "SIGHUP"])
def test_a_closed_terminal_leaves_as_little_as_ctrl_c(folder: Path, name: str) -> None:
    with started(folder) as (process, page):
        page.send(json.dumps({"do": "upload", "file": "half.csv", "size": 10}))
        until(lambda: list(folder.glob(".*.part")))
        for _ in range(2):  # as a shell does
            process.send_signal(getattr(signal, name))
        _, err = process.communicate(timeout=20)
    assert (process.returncode, err) == (0, "")
    assert not list(folder.glob(".*.part"))


def test_ctrl_c_ends_it_cleanly(folder: Path) -> None:
    with started(folder) as (process, deaf):
        deaf.recv()
        began = time.monotonic()
        process.send_signal(signal.SIGINT)
        _, err = process.communicate(timeout=20)
    assert (process.returncode, err) == (0, "")
    assert time.monotonic() - began < 5.0
