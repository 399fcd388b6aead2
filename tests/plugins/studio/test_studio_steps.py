"""Steps of the studio: searches, Bode plots, uploads, long steps in a process, a report."""

from __future__ import annotations

import json
import math
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import sewfast
from cli import environment
from commissioned import SMALL, short
from moments import until
from sewfast.errors import ModelFileError
from sewfast.frequency import load_response
from sewfast_studio import Commission, Project, Step, Studio
from sewfast_studio.loops import shown_loop, shown_response
from sewfast_studio.project import Upload
from sewfast_studio.requests import carry_out
from studio_page import Page

MOVE = {"model": "drive.json", "values": {"Kp": 0.03, "Ti": 0.07}}
NOTCH = [60.0, 0.1, 0.5]


def _run(folder: Path, python: str, commands: str, file: str) -> list[bytes]:
    """The file that each copy writes."""
    place, found = folder / file, []
    shell = f'sewfast() {{ "{sys.executable}" -m sewfast "$@"; }}\nset -e\n{commands}'
    for command in ([sys.executable, "-c", python], ["sh", "-c", shell]):
        place.unlink(missing_ok=True)
        subprocess.run(command, cwd=folder, env=environment(), check=True, capture_output=True)
        found.append(place.read_bytes())
    return found


# --- Searches -------------------------------------------------------------------------------------


@pytest.mark.nightly("a long search, made twice")
def test_a_search_with_weights_limits_and_a_notch_is_copied(tuned: Studio) -> None:
    folder = tuned.project.folder
    asked = {**MOVE, "notches": [NOTCH]}
    more = {"weights": {"chatter": 40.0}, "constraints": {"Ms": 1.6, "overshoot": 5.0}}
    with Page(tuned) as page:
        page.ask("tune_search", evaluations=40, seed=3, **asked, **more)
        found = page.event("searched")["found"]
        assert "notch_frequency[0]" in found["values"]
        asked["values"] = found["values"]
        said = page.ask("tune_save", file="controller.json", **asked)["found"]
        shown = page.ask("tune_move", **asked)["found"]
    assert shown["Ms"] <= 1.6
    written = (folder / "controller.json").read_bytes()
    assert json.loads(written)["biquads"][0]["kind"] == "notch"
    assert _run(folder, said["python"], said["commands"], "controller.json") == [written] * 2


@pytest.mark.nightly("trains a network")
def test_ms_of_a_network_is_that_about_the_level(tmp_path: Path) -> None:
    data = sewfast.record(
        sewfast.VirtualMachine(seed=1), sewfast.signals.excitation("saturating")[:4000]
    ).dataset()
    network = sewfast.identify(data, model="neural_oe", seed=0, time_budget=2.0)
    network.save(tmp_path / "net.json")
    with Studio(Project(tmp_path)) as studio, Page(studio) as page:
        asked: dict[str, Any] = {"model": "net.json", "values": {}}
        page.ask("tune_search", evaluations=30, seed=1, constraints={"Ms": 1.8}, **asked)
        asked["values"] = page.event("searched")["found"]["values"]
        said = page.ask("tune_save", file="controller.json", **asked)["found"]
    assert "--constraint Ms=1.8" in said["commands"]
    written = (tmp_path / "controller.json").read_bytes()
    assert _run(tmp_path, said["python"], said["commands"], "controller.json") == [written] * 2


@pytest.mark.nightly("another search")
def test_a_search_that_ran_out_of_time_is_copied_as_what_it_found(tuned: Studio) -> None:
    folder = tuned.project.folder
    with Page(tuned) as page:
        page.ask("tune_search", evaluations=20_000, seed=0, seconds=0.5, **MOVE)
        found = page.event("searched")["found"]
        assert found["ended"] == "time"
        asked = {**MOVE, "values": found["values"]}
        said = page.ask("tune_save", file="controller.json", **asked)["found"]
    assert "sewfast.tune(" not in said["python"]
    written = (folder / "controller.json").read_bytes()
    assert _run(folder, said["python"], said["commands"], "controller.json") == [written] * 2


def test_the_trade_off_is_a_front_from_calm_to_quick(tuned: Studio) -> None:
    with Page(tuned) as page:
        page.ask("tune_front", evaluations=80, seed=3, **MOVE)
        found = page.event("traded")["found"]
        front = found["front"]
        assert len(front) > 2
        errors, peaks = ([f[name] for f in front] for name in ("cost", "Ms"))
        assert errors == sorted(errors, reverse=True)
        assert peaks == sorted(peaks)
        for point in front[:: len(front) - 1]:
            judged = page.ask("tune_judge", **{**MOVE, "values": point["values"]})["found"]
            assert judged["cost"] == point["cost"]
            assert judged["Ms"] == pytest.approx(point["Ms"], rel=1e-3)
        shown = page.ask("tune_move", **{**MOVE, "values": front[0]["values"]})["found"]
        assert shown["stable"]


def test_weights_change_the_cost(tuned: Studio) -> None:
    with Page(tuned) as page:
        usual = page.ask("tune_judge", **MOVE)["found"]
        heavy = page.ask("tune_judge", weights={"chatter": 1e4}, **MOVE)["found"]
    assert heavy["cost"] > usual["cost"]


@pytest.mark.parametrize(
    ("do", "wrong"),
    [
        ("tune_judge", {"weights": {"chatter": -1.0}}),
        ("tune_judge", {"weights": {"chatter": math.nan}}),
        ("tune_judge", {"weights": {"unknown": 1.0}}),
        ("tune_move", {"notches": [[60.0, 0.1]]}),
        ("tune_move", {"notches": [NOTCH] * 5}),
        ("tune_move", {"notches": [[600.0, 0.1, 0.5]]}),
        ("tune_move", {"notches": [[math.nan, 0.1, 0.5]]}),
        ("tune_move", {"values": {"Kp": math.nan}}),
        ("tune_move", {"values": {"Kp": math.inf}}),
        ("tune_search", {"constraints": {"Ms": 0.5}}),
        ("tune_search", {"constraints": {"phase": 30.0}}),
        ("tune_search", {"seconds": 0.0}),
        ("tune_search", {"evaluations": 5}),
    ],
)
def test_a_wrong_wish_is_refused(tuned: Studio, do: str, wrong: dict[str, Any]) -> None:
    effort = {"evaluations": 20, "seed": 0} if do == "tune_search" else {}
    with Page(tuned) as page:
        answer = page.ask(do, **{**MOVE, **effort, **wrong})
        assert "fault" not in answer["error"]
        assert "found" in page.ask("tune_move", **MOVE)


# --- Bode plots -----------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def shaken(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A record of a machine whose shaft swings."""
    place = tmp_path_factory.mktemp("shaken")
    machine = sewfast.VirtualMachine(load_inertia=1e-3, stiffness=150.0, seed=1)
    u = 9.0 + np.random.default_rng(0).normal(scale=2.0, size=20_000)
    found = sewfast.record(machine, np.clip(u, 2.0, 16.0))
    t = np.arange(len(found)) * found.Ts
    y = found.speed("difference")
    sewfast.write_table(place / "run.csv", {"t": t, "u": found.u, "y": y, "counts": found.counts})
    return place


@pytest.mark.nightly("a response measured three times")
def test_a_response_is_that_of_the_library_and_its_copies(shaken: Path) -> None:
    step = Step("run.csv", ("u",), "y")
    project = Project(shaken)
    with Studio(project) as studio, Page(studio) as page:
        page.ask("bode", file="run.csv", inputs=["u"], output="y")
        assert page.event("progress")["of"] == "responded"
        found = page.hear(lambda m: m.get("event") == "responded", 300)["found"]
    response = sewfast.bode(sewfast.read(shaken / "run.csv", inputs="u", output="y"))
    np.testing.assert_array_equal(found["curves"]["hertz"], response.hertz)
    seen = response.coherence >= 0.5
    shown = np.array(found["curves"]["P_db"], dtype=float)
    np.testing.assert_array_equal(shown[seen], response.magnitude_db[seen])
    assert np.isnan(shown[~seen]).all()
    fit = sewfast.fit_shaft(response)
    assert found["notch"] == list(fit.notch().numbers)
    assert project.bode(step).to_dict() == response.to_dict()
    written = _run(shaken, found["python"], found["commands"], "response.json")
    assert written[0] == written[1]
    np.testing.assert_array_equal(load_response(shaken / "response.json").value, response.value)


@pytest.mark.nightly("another response")
def test_a_response_from_counts_does_not_look_ahead(shaken: Path) -> None:
    step = Step("run.csv", ("u",), None, counts="counts", counts_per_rev=1572.0)
    project = Project(shaken)
    assert project.bode(step).from_counts
    copies = project.python(step, "bode"), project.commands(step, "bode")
    written = _run(shaken, *copies, "response.json")
    assert written[0] == written[1]


def test_margins_are_marked_where_the_library_has_them(tuned: Studio) -> None:
    tuning = tuned.project.tuning("drive.json")
    found, curves = shown_loop(tuning, {}, None)
    marks = {m["label"].split(" ")[0]: m for m in found["marks"]}
    all_margins = [
        sewfast.margins(tuning.start, m, speed=found["level"]) for m in tuning.members
    ]  # fmt: skip
    worst = max(all_margins, key=lambda m: m.Ms)
    assert marks["Ms"]["x"] == pytest.approx(worst.Ms_omega / (2 * math.pi))
    assert marks["Ms"]["y"] == pytest.approx(20 * math.log10(worst.Ms))
    assert marks["crossover"]["x"] == pytest.approx(worst.gain_crossovers[0] / (2 * math.pi))
    at = np.interp(marks["phase"]["x"], curves["hertz"], curves["L_deg"])
    assert marks["phase"]["y"] == pytest.approx(at, abs=3.0)
    # L of one member is plant times controller, so that the plant's curve is that of its model
    member = tuning.members[0]
    num, den = member.to_tf()
    q = np.exp(-2j * np.pi * curves["hertz"] * member.Ts)
    P = np.polyval(np.ravel(num)[::-1], q) / np.polyval(np.ravel(den)[::-1], q)
    low, high = curves["P_db_low"], curves["P_db_high"]
    size = 20 * np.log10(np.abs(P))
    assert np.all((size > low - 1e-6) & (size < high + 1e-6))


def test_an_unstable_loop_has_no_marks(tuned: Studio) -> None:
    found, _ = shown_loop(tuned.project.tuning("drive.json"), {"Kp": 5.0, "Td": 0.0}, None)
    assert not found["stable"]
    assert found["marks"] == []


def test_a_measured_response_lies_over_the_loop(shaken: Path, tuned: Studio) -> None:
    response = Project(shaken).bode(Step("run.csv", ("u",), "y"))
    tuning = tuned.project.tuning("drive.json")
    found, curves = shown_loop(tuning, {}, response)
    L = response.loop(tuning.start, speed=found["level"])
    seen = response.coherence >= 0.5
    db = 20 * np.log10(np.abs(L))
    np.testing.assert_allclose(curves["measured_L_db"][seen], db[seen])
    assert found["measured"].startswith("Ms ")
    numbers, _ = shown_response(response)
    assert "shaft" in numbers["shaft"]


# --- Long steps in a process ----------------------------------------------------------------------

IDENTIFY = {"file": "run.csv", "inputs": ["u"], "output": "y", "resample": 0.02}


def _pid(studio: Studio) -> int:
    program = studio._jobs._program
    assert program is not None
    return program.pid


def test_a_step_whose_process_is_killed_leaves_the_server_alone(folder: Path) -> None:
    with Studio(Project(folder)) as studio, Page(studio) as page:
        page.ask("identify", **IDENTIFY)
        page.event("progress")
        os.kill(_pid(studio), 9)
        assert "ended without a result" in page.event("identified")["error"]
        assert "found" in page.ask("look", **IDENTIFY)
        page.ask("identify", **{**IDENTIFY, "model": "oe"})
        assert page.event("identified")["found"]["fit"] > 50


def test_a_step_that_hears_nothing_is_ended(folder: Path) -> None:
    with Studio(Project(folder)) as studio, Page(studio) as page:
        page.ask("identify", **IDENTIFY)
        page.event("progress")
        os.kill(_pid(studio), 19)  # stopped: it can do nothing any more
        page.ask("cancel")
        assert "cancelled" in page.event("identified")["error"]
    assert not (folder / "model.json").exists()


def test_steps_end_with_the_server(folder: Path) -> None:
    with Studio(Project(folder)) as studio, Page(studio) as page:
        page.ask("identify", **IDENTIFY)
        page.event("progress")
        number = _pid(studio)
    until(lambda: not Path(f"/proc/{number}").exists())


# --- Files that come in ---------------------------------------------------------------------------


def _upload(page: Page, file: str, content: bytes, piece: int = 40_000) -> dict[str, Any]:
    answer = page.ask("upload", file=file, size=max(len(content), 1))
    if "error" in answer:
        return answer
    for at in range(0, len(content), piece):
        page.socket.send(content[at : at + piece])
        answer = page.event("received")
        if "error" in answer:
            return answer
    return page.ask("upload_end")


def test_a_recording_is_uploaded(folder: Path) -> None:
    content = (folder / "run.csv").read_bytes()
    with Studio(Project(folder)) as studio, Page(studio) as page:
        assert _upload(page, "neu ü 3.csv", content)["found"] == {"file": "neu ü 3.csv"}
        assert (folder / "neu ü 3.csv").read_bytes() == content
        assert "found" in page.ask("columns", file="neu ü 3.csv")
    assert [p for p in folder.iterdir() if p.suffix == ".part"] == []


@pytest.mark.parametrize(
    "file",
    ["../a.csv", "/tmp/a.csv", "a/b.csv", ".a.csv", "a.exe", "a.csv\0", "a\n.csv", "a:b.csv", "",
     "x" * 200 + ".csv", "..\\a.csv", "a.toml"],
)  # fmt: skip
def test_a_file_comes_in_nowhere_else(folder: Path, file: str) -> None:
    before = sorted(folder.parent.rglob("*"))
    with Studio(Project(folder)) as studio, Page(studio) as page:
        assert "error" in _upload(page, file, b"t,u,y\n0,1,2\n")
    assert sorted(folder.parent.rglob("*")) == before


def test_json_comes_in_as_a_log_and_not_as_a_model(folder: Path) -> None:
    before = sorted(folder.parent.rglob("*"))
    with Studio(Project(folder)) as studio, Page(studio) as page:
        refused = _upload(page, "a.json", b'{"format": "sewfast.model", "version": 4}')
        assert "received a file of the format sewfast.model" in refused["error"]
        assert sorted(folder.parent.rglob("*")) == before
        log = b'[{"t": 0, "u": 1, "y": 2}, {"t": 1, "u": 2, "y": 3}]'
        assert _upload(page, "a.json", log)["found"] == {"file": "a.json"}
        assert page.ask("columns", file="a.json")["found"]["names"] == ["t", "u", "y"]


def test_no_file_is_replaced(folder: Path) -> None:
    content = (folder / "run.csv").read_bytes()
    (folder / "link.csv").symlink_to(folder.parent / "outside.csv")
    with Studio(Project(folder)) as studio, Page(studio) as page:
        for name in ("run.csv", "link.csv"):
            assert "is not replaced" in _upload(page, name, b"t,u,y\n0,1,2\n")["error"]
    assert (folder / "run.csv").read_bytes() == content
    assert not (folder.parent / "outside.csv").exists()
    late = Upload(folder, "late.csv", 3)
    late.add(b"abc")
    (folder / "late.csv").write_bytes(b"first")
    with pytest.raises(sewfast.SettingError, match="is not replaced"):
        late.finish()
    assert (folder / "late.csv").read_bytes() == b"first"


def test_a_file_of_another_size_is_not_kept(folder: Path) -> None:
    with Studio(Project(folder)) as studio, Page(studio) as page:
        assert "to 512 MB" in page.ask("upload", file="a.csv", size=2**40)["error"]
        page.ask("upload", file="a.csv", size=10)
        page.socket.send(b"x" * 11)
        assert "received more" in page.event("received")["error"]
        page.ask("upload", file="a.csv", size=10)
        assert "received 0" in page.ask("upload_end")["error"]
        page.socket.send(b"nothing is under way")
        assert "no bytes" in page.event("received")["error"]
    assert not list(folder.glob("a.csv"))
    assert not list(folder.glob(".*.part"))


def test_a_file_of_a_page_that_goes_is_not_kept(folder: Path) -> None:
    with Studio(Project(folder)) as studio:
        with Page(studio) as page:
            page.ask("upload", file="a.csv", size=100)
            page.socket.send(b"t,u")
            page.event("received")
        until(lambda: not list(folder.glob(".*.part")))
        with Page(studio) as writer, Page(studio) as reader:
            # the page that went may still have been in control when this one came
            writer.ask("take")
            assert "looks on" in reader.ask("upload", file="a.csv", size=3)["error"]


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs a device that is always full")
def test_a_full_disk_is_said_so(folder: Path) -> None:
    upload = Upload(folder, "a.csv", 10**6)
    upload._out.close()
    with Path("/dev/full").open("wb", buffering=0) as full:
        upload._out = full
        with pytest.raises(sewfast.SettingError, match="make room"):
            upload.add(b"x" * 1000)
    assert not list(folder.glob(".*.part"))


# --- The rest -------------------------------------------------------------------------------------


def test_files_of_pages_that_go_at_once_are_not_kept(folder: Path) -> None:
    with Studio(Project(folder)) as studio:
        for k in range(12):
            with Page(studio) as page:
                page.socket.send(json.dumps({"do": "take"}))
                page.socket.send(json.dumps({"do": "upload", "file": f"{k}.csv", "size": 10}))
        until(lambda: not studio._pages and not list(folder.glob(".*.part")))
        assert not studio._uploads


def test_a_folder_without_rights_is_said_so_before_anything_takes_long(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # root may write everywhere, so that rights alone do not show it
    monkeypatch.setattr(os, "access", lambda *_: False)
    step = Step("run.csv", ("u",), "y")
    with pytest.raises(sewfast.SettingError, match="can be written to"):
        Project(folder).identify(step)
    with pytest.raises(sewfast.SettingError, match="can be written to"):
        carry_out(Commission(), sewfast.VirtualMachine(), folder, lambda *_: None)


def test_a_link_to_a_closed_place_hides_nothing_else(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    usual = Path.is_file

    def refuse(path: Path) -> bool:
        if path.name == "closed.csv":
            raise PermissionError(13, "Permission denied")
        return usual(path)

    (folder / "closed.csv").symlink_to(folder / "elsewhere" / "closed.csv")
    monkeypatch.setattr(Path, "is_file", refuse)
    assert Project(folder).recordings() == ["run.csv", "run2.csv"]
    assert Project(folder).documents("sewfast.model") == []


def test_the_model_that_a_page_shows_first_is_opened_ahead(tuned: Studio) -> None:
    project = Project(tuned.project.folder / "drive.json")
    project.open_ahead()
    assert list(project._tunings.values()) == [project.tuning("drive.json")]
    (project.folder / "drive.json").write_text('{"format": "sewfast.model", "version": 1}')
    project.open_ahead()  # says nothing: the page does
    with pytest.raises(ModelFileError):
        project.tuning("drive.json")


def test_pages_with_different_starts_keep_their_searches(tuned: Studio) -> None:
    project = tuned.project
    first = project.tuning("drive.json")
    first.controller({}).save(project.folder / "c.json")
    other = project.tuning("drive.json", "c.json")
    assert project.tuning("drive.json") is first
    assert project.tuning("drive.json", "c.json") is other
    first.controller({"Kp": 0.02}).save(project.folder / "c.json")
    later = project.tuning("drive.json", "c.json")
    assert later.start.gains.Kp == 0.02
    assert later.move({})[0]["stamp"] == later.opened()["stamp"] != other.stamp


def test_no_gain_at_all_is_shown_without_a_warning(tuned: Studio) -> None:
    with np.errstate(all="raise", under="ignore"):
        numbers, curves = tuned.project.tuning("drive.json").move({"Kp": 0.0})
    assert numbers["stable"]
    assert np.isnan(curves["L_deg"]).all()


def test_a_folder_that_is_gone_is_said_so(folder: Path) -> None:
    with Studio(Project(folder)) as studio, Page(studio) as page:
        assert not page.event("state")["gone"]
        folder.rename(folder.with_name("away"))
        assert "error" in page.ask("look", **IDENTIFY)
        assert "error" in page.ask("upload", file="a.csv", size=3)
        with Page(studio) as other:
            state = other.event("state")
        assert state["gone"]
        assert state["recordings"] == []
        folder.with_name("away").rename(folder)
        assert "found" in page.ask("look", **IDENTIFY)


def test_two_pages_that_fight_leave_one_in_control(folder: Path) -> None:
    with Studio(Project(folder)) as studio, Page(studio) as one, Page(studio) as two:
        for _ in range(20):
            one.ask("take")
            two.ask("take")
        assert "looks on" in one.ask("identify", **IDENTIFY)["error"]
        assert "error" not in two.ask("cancel")


def test_a_page_that_floods_is_closed_and_no_other(folder: Path) -> None:
    from websockets.exceptions import ConnectionClosed

    def flood(page: Page) -> None:
        for _ in range(100_000):
            page.socket.send(json.dumps({"id": 1, "do": "look", **IDENTIFY}))

    with Studio(Project(folder)) as studio, Page(studio) as calm:
        with Page(studio) as wild, pytest.raises(ConnectionClosed):
            flood(wild)
        assert "found" in calm.ask("columns", **IDENTIFY)


def test_a_csv_without_times_is_read_with_its_sample_time(folder: Path) -> None:
    table = sewfast.read_table(folder / "run.csv")
    text = "u,y\n" + "\n".join(f"{u},{y}" for u, y in zip(table["u"], table["y"], strict=True))
    (folder / "bare.csv").write_text(text, encoding="utf-8")
    asked = {"file": "bare.csv", "inputs": ["u"], "output": "y"}
    with Studio(Project(folder)) as studio, Page(studio) as page:
        assert "sample time" in page.ask("look", **asked)["error"]
        found = page.ask("look", Ts=0.001, **asked)["found"]
    assert "Ts=0.001" in found["python"]
    assert "--ts=0.001" in found["commands"]


@pytest.mark.nightly("a whole report; `test_report` makes one in `make test`")
def test_a_report_is_made_and_served_in_a_sandbox(tuned: Studio) -> None:
    import http.client

    pytest.importorskip("matplotlib")
    place = tuned.project.folder / "commissioned" / "report.html"
    with Page(tuned) as page:
        assert "commission a machine first" in page.ask("report")["error"]
        with short():
            sewfast.commission(sewfast.VirtualMachine(1), **SMALL).save(place.parent)
        place.unlink()
        page.ask("report")
        found = page.hear(lambda m: m.get("event") == "reported", 300)["found"]

    def get(path: str) -> tuple[int, str, bytes]:
        connection = http.client.HTTPConnection("127.0.0.1", tuned.port, timeout=10)
        connection.request("GET", path)
        answer = connection.getresponse()
        return answer.status, answer.getheader("Content-Security-Policy") or "", answer.read()

    status, policy, body = get(found["address"])
    assert (status, body) == (200, place.read_bytes())
    assert "sandbox allow-scripts" in policy
    assert "allow-same-origin" not in policy
    script = policy.split("script-src ")[1].split(";")[0]
    digest = script.removeprefix("'sha256-").removesuffix("'")
    assert digest.encode() in body  # the report's own policy names the same script
    assert get("/report/guessed")[0] == 404
    assert get("/commissioned/report.html")[0] == 404
    place.unlink()
    place.symlink_to("/etc/passwd")
    assert get(found["address"])[0] == 404
