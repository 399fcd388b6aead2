"""A drive behind the studio: who may move it, what stops it, what is seen and kept of it.

Every stop is judged by the device's own account of its output.
"""

from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import sewfast
from cli import PROGRAM, environment
from moments import until
from sewfast.commissioning import STAGES
from sewfast.link import VirtualDevice
from sewfast.recordfile import read_recording
from sewfast_studio import Project, Studio
from sewfast_studio.session import SCHEMAS, checked
from studio_page import Page, Watching

TRIPPED = 4
"""State in the account of a device."""

WITHIN = 0.7
"""Seconds from the last answer of a page to the end of the output."""

BEGAN: dict[str, float] = {}
"""When a device's server had begun, on this process's clock."""

LONG = {"signal": "random", "seed": 0, "scale": 0.2, "file": "long.mcap"}


def _press(browser: Any, name: str) -> None:
    until(lambda: browser.find_element("id", name).is_enabled())
    browser.find_element("id", name).click()


def _armed(browser: Any, studio: Studio, device: VirtualDevice) -> None:
    """In the view Drive, by clicks."""
    browser.get(studio.address)
    port = browser.find_element("id", "port")

    def shown() -> bool:  # the page's modules may not be there yet
        browser.find_element("id", "view-drive").click()
        return bool(port.is_displayed())

    until(shown)
    port.clear()
    port.send_keys(device.port)
    browser.execute_script(
        "document.querySelectorAll('#drive details').forEach(d => { d.open = true })"
    )
    browser.find_element("id", "watchdog").send_keys("2000")
    _press(browser, "connect")
    _press(browser, "limits")
    until(lambda: "are set" in browser.find_element("id", "limits-set").text)
    until(lambda: "in time" in browser.find_element("id", "prompt").text)
    _press(browser, "arm")
    until(lambda: "ARMED" in browser.find_element("id", "drive-state").text)


def _recording(browser: Any, device: VirtualDevice) -> None:
    field = browser.find_element("id", "signal")
    field.find_element("css selector", "option[value=random]").click()
    _press(browser, "record")
    until(lambda: _is_on(device))
    time.sleep(0.5)
    assert _is_on(device)


# --- In a browser ---------------------------------------------------------------------------------


def test_a_drive_by_clicks(studio: Studio, device: VirtualDevice, browser: Any) -> None:
    from selenium.webdriver.common.keys import Keys

    def at(name: str) -> Any:
        return browser.find_element("id", name)

    _armed(browser, studio, device)
    browser.execute_script(
        "window.taken = []; document.addEventListener('frame', e => window.taken.push(e.detail))"
    )
    _recording(browser, device)
    until(lambda: "RPM" in at("speed").text)
    assert len(browser.find_elements("css selector", "#live canvas")) == 2
    assert len(set(browser.execute_script("return window.taken"))) > 5
    for view in ("data", "model", "tune", "commission", "deploy", "drive"):
        browser.execute_script("arguments[0].click()", at(f"view-{view}"))
        stop = at("stop")
        assert stop.is_displayed()
        assert stop.is_enabled()
        assert stop.size["height"] >= 44
        assert stop.size["width"] >= 120
        inside = (
            "return arguments[0].contains(document.elementFromPoint(arguments[1], arguments[2]))"
        )
        browser.execute_script("scrollTo(0, 300)")
        box = browser.execute_script(
            "const r = arguments[0].getBoundingClientRect(); return [r.x, r.y]", stop
        )
        assert browser.execute_script(inside, stop, box[0] + 60, box[1] + 22)
    if "STUDIO_PICTURES" in os.environ:
        browser.set_window_size(1400, 1000)
        browser.execute_script("scrollTo(0, 0)")
        browser.save_screenshot(str(Path(os.environ["STUDIO_PICTURES"]) / "drive.png"))
    for width in (1600, 1000, 600):  # 600: what 200 % zoom leaves of a window of 1200
        browser.set_window_size(width, 900)
        wide = "return document.documentElement.scrollWidth - innerWidth"
        assert browser.execute_script(wide) <= 0
    # Esc in a field, as anywhere
    at("record-file").send_keys(Keys.ESCAPE)
    until(lambda: not _is_on(device))
    until(lambda: "output off, confirmed after" in at("stopped").text)
    until(lambda: "not armed" in at("drive-state").text)
    until(lambda: "idle" in at("speed").text)  # and not the last sample of the run
    assert [entry for entry in browser.get_log("browser") if entry["level"] == "SEVERE"] == []


@pytest.mark.nightly("every way of being gone", by_day=["killed"])
@pytest.mark.parametrize("fault", ["hung", "closed", "killed", "frozen"])
def test_a_browser_that_is_gone_stops_it(
    studio: Studio, device: VirtualDevice, browser: Any, fault: str
) -> None:
    _armed(browser, studio, device)
    _recording(browser, device)
    with Watching(studio) as other:
        began = time.monotonic()
        if fault == "hung":
            browser.execute_script(
                "setTimeout(() => { for (const end = Date.now() + 5000; Date.now() < end;); }, 300)"
            )
            began += 0.3
        elif fault == "closed":
            browser.close()
        elif fault == "killed":
            for pid in _family(browser.service.process.pid)[1:]:
                os.kill(pid, signal.SIGKILL)
        else:
            for pid in _family(browser.service.process.pid)[1:]:
                os.kill(pid, signal.SIGSTOP)
        other.event("stopped")
        _require_off_since(device, began)
        for pid in _family(browser.service.process.pid)[1:]:
            os.kill(pid, signal.SIGCONT)


def _family(pid: int) -> list[int]:
    """A process and all that it has started."""
    found = [pid]
    for file in Path(f"/proc/{pid}/task").glob("*/children"):
        for child in file.read_text().split():
            found += _family(int(child))
    return found


@pytest.fixture
def device() -> Iterator[VirtualDevice]:
    with VirtualDevice() as served:
        BEGAN[served.port] = time.monotonic()
        yield served


@pytest.fixture
def studio(tmp_path: Path) -> Iterator[Studio]:
    with Studio(Project(tmp_path)) as running:
        yield running


@contextmanager
def two_pages(studio: Studio) -> Iterator[tuple[Watching, Watching]]:
    """The page that holds the control, and one that is opened after it."""
    with Watching(studio) as page:
        page.event("state", writes=True)
        with Watching(studio) as other:
            yield page, other


def _is_on(device: VirtualDevice) -> bool:
    return _ends(device)[-1:] == ["on"]


def _ends(device: VirtualDevice) -> list[str]:
    return [e["event"] for e in device.trace() if e["event"] in ("on", "off")]


def _running(page: Watching, device: VirtualDevice, **asked: Any) -> None:
    """A record that is under way, the output on."""
    assert "found" in page.ask("drive_record", **{**LONG, **asked})
    until(lambda: _is_on(device))
    time.sleep(0.3)
    assert _is_on(device)


def _require_off_since(device: VirtualDevice, began: float) -> None:
    """The output went off soon after `began`, on the clock of the device's server."""
    until(lambda: not _is_on(device))
    off = [e for e in device.trace() if e["event"] == "off"][-1]
    took = BEGAN[device.port] + off["seconds"] - began
    assert took < WITHIN + 1e-6 * off["late_us"]


# --- Who may move it ------------------------------------------------------------------------------


def test_nothing_moves_before_it_is_armed(studio: Studio, device: VirtualDevice) -> None:
    with Watching(studio) as page:
        assert "connect one first" in page.ask("drive_record", **LONG)["error"]
        assert "found" in page.ask("drive_connect", port=device.port)
        assert "press Arm" in page.ask("drive_record", **LONG)["error"]
        page.frozen = True
        time.sleep(0.5)
        assert "10 answers" in page.ask("drive_arm")["error"]
        page.frozen = False
        until(lambda: "limits" in page.ask("drive_arm").get("error", ""))
    assert "on" not in _ends(device)


def test_only_the_page_in_control_moves_it(studio: Studio, device: VirtualDevice) -> None:
    with two_pages(studio) as (page, other):
        page.armed(device.port)
        for name in ("drive_arm", "drive_connect", "drive_go", "drive_disconnect"):
            assert "looks on" in other.ask(name)["error"]
        assert "looks on" in other.ask("drive_record", **LONG)["error"]
        _running(page, device)
        # a stop is everybody's
        assert other.ask("stop")["found"] is None
        assert page.event("stopped")["why"] == "STOP on the page"
        until(lambda: not _is_on(device))


def test_taking_the_control_takes_two_acts_and_stops_what_runs(
    studio: Studio, device: VirtualDevice
) -> None:
    with two_pages(studio) as (page, other):
        page.armed(device.port)
        _running(page, device)
        # nothing counts as the second act before this page was told who holds the control
        for over in (True, False):
            told = other.ask("take", over=over)["found"]
            assert told["moves"]
            assert told["held_s"] > 0.0
        assert _is_on(device)
        assert "looks on" in other.ask("drive_arm")["error"]
        assert other.ask("take", over=True)["found"] is None
        assert "another page" in page.event("stopped")["why"]
        page.event("lost")
        until(lambda: not _is_on(device))
        again = {**LONG, "file": "again.mcap"}
        assert "press Arm" in other.ask("drive_record", **again)["error"]
        # the page that lost it is asked as well, and what it was told before counts no longer
        assert "held_s" in page.ask("take", over=True)["found"]
        assert page.ask("stop")["found"] is None


def test_taking_over_by_clicks(studio: Studio, device: VirtualDevice, browser: Any) -> None:
    with Watching(studio) as page:
        page.ask("take")
        page.armed(device.port)
        _running(page, device)
        browser.get(studio.address)
        _press(browser, "take")
        until(lambda: browser.find_element("id", "take").text == "Take over")
        assert "stops the motor" in browser.find_element("id", "notice-text").text
        assert _is_on(device)
        _press(browser, "take")
        until(lambda: not _is_on(device))
        until(lambda: browser.find_element("id", "control").text == "in control")


def _both(found: dict[str, Any]) -> list[list[str]]:
    return [[sys.executable, "-c", found["python"]], ["sh", "-c", f"set -e\n{found['commands']}"]]


def _run(command: list[str], folder: Path) -> None:
    """With the programs of this interpreter, for a shell as well."""
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    with subprocess.Popen(
        command, cwd=folder, env={**environment(), "PATH": path}, stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
    ) as process:  # fmt: skip
        assert process.wait(120.0) == 0


# --- What is seen and kept ------------------------------------------------------------------------


STEP = {"signal": "step", "seed": 0, "scale": 0.3, "file": "step.mcap"}


def test_a_recording_is_seen_and_kept(studio: Studio, tmp_path: Path) -> None:
    with Watching(studio) as page:
        page.armed("virtual:1", volt=12.0)
        assert page.ask("drive_record", **STEP)["found"] is None
        assert page.event("driven")["found"]["file"] == "step.mcap"
        seen = page.ask("live", seconds=30, columns=4000)
        assert seen["found"]["end"] == seen["found"]["received"] == 3000
        assert "there is such a file" in page.ask("drive_record", **STEP)["error"]
        page.event("state", recordings=["step.mcap"])
    kept = read_recording(tmp_path / "step.mcap")
    assert kept.outcome == "complete"
    assert kept.header.settings["limits"]["volt"] == 12.0
    np.testing.assert_allclose(seen["curves"]["u_low"], kept.columns["u"], atol=1e-6)


@pytest.mark.nightly("recordings, made twice")
def test_copies_of_a_recording_do_the_same(studio: Studio, tmp_path: Path) -> None:
    with Watching(studio) as page:
        page.armed("virtual:1", volt=12.0)
        assert page.ask("drive_record", **STEP)["found"] is None
        found = page.event("driven")
    kept = read_recording(tmp_path / "step.mcap")
    for command in _both(found):
        (tmp_path / "step.mcap").unlink()
        _run(command, tmp_path)
        again = read_recording(tmp_path / "step.mcap")
        np.testing.assert_array_equal(again.columns["counts"], kept.columns["counts"])


@pytest.mark.nightly("runs, made twice")
def test_a_controller_runs_and_the_copies_do_the_same(studio: Studio, tmp_path: Path) -> None:
    gains = sewfast.Gains.standard(0.02, 0.2, 0.004, u_unit="V", y_unit="RPM")
    sewfast.Controller(gains, u_min=-20.0, u_max=20.0).save(tmp_path / "mine.json")
    asked = {"controller": "mine.json", "reference": "trapezoid", "seed": 0, "scale": 0.5}
    with Watching(studio) as page:
        page.armed("virtual")
        assert (
            "in the project folder"
            in (
                page.ask("drive_run", **{**asked, "controller": "../x.json"}, file="run.mcap")[
                    "error"
                ]
            )
        )
        assert page.ask("drive_run", **asked, file="run.mcap")["found"] is None
        found = page.event("driven")
        assert "found" in found, found
    kept = read_recording(tmp_path / "run.mcap")
    for command in _both(found):
        (tmp_path / "run.mcap").unlink()
        _run(command, tmp_path)
        again = read_recording(tmp_path / "run.mcap")
        np.testing.assert_array_equal(again.columns["counts"], kept.columns["counts"])


def test_a_trip_is_said_with_its_remedy_and_disarms(studio: Studio, device: VirtualDevice) -> None:
    with Watching(studio) as page:
        page.armed(device.port, speed_rpm=200.0)
        page.ask("drive_record", **{**LONG, "signal": "step", "scale": 1.0})
        error = page.event("driven")["error"]
        assert "speed, the limit is 200 RPM" in error
        assert "clear it" in error
        page.event("drive", state="tripped", armed=False)
        until(lambda: "has tripped" in page.ask("drive_arm").get("error", ""))
        assert "found" in page.ask("drive_clear")
        page.arm()


def test_a_port_that_is_not_there_is_said_with_its_remedy(studio: Studio) -> None:
    with Watching(studio) as page:
        assert "no-such-port" in page.ask("drive_connect", port="/dev/no-such-port")["error"]
        assert "found" in page.ask("drive_connect", port="virtual")
        assert "one is connected" in page.ask("drive_connect", port="virtual")["error"]
        assert "found" in page.ask("drive_disconnect")
        assert "found" in page.ask("drive_connect", port="virtual")


# --- What stops it --------------------------------------------------------------------------------


def test_stop_goes_ahead_of_a_long_question(studio: Studio, device: VirtualDevice) -> None:
    with Watching(studio) as page:
        page.armed(device.port)
        _running(page, device)
        page.send("stop")
        told = page.event("stopped")
        assert (told["moving"], told["error"]) == (True, "")
        assert told["off_ms"] <= told["rest_ms"]
        assert page.event("driven")["error"].startswith("Stopped")
    assert _ends(device) == ["on", "off"]
    assert read_recording(studio.project.folder / "long.mcap").outcome == "cancelled"


def test_stop_in_every_state(studio: Studio, device: VirtualDevice, tmp_path: Path) -> None:
    gains = sewfast.Gains.standard(0.02, 0.2, 0.004, u_unit="V", y_unit="RPM")
    sewfast.Controller(gains, u_min=-20.0, u_max=20.0).save(tmp_path / "mine.json")
    run = {"controller": "mine.json", "reference": "trapezoid", "seed": 0, "scale": 1.0}

    def stopped(moving: bool) -> None:
        assert page.ask("stop")["found"] is None
        told = page.event("stopped")
        assert (told["moving"], told["error"]) == (moving, "")
        until(lambda: not _is_on(device))
        # nothing moves again unasked
        assert "press Arm" in page.ask("drive_record", **{**LONG, "file": "no.mcap"})["error"]

    def moves(name: str, **asked: Any) -> None:
        page.arm()
        assert "found" in page.ask(name, **asked)
        until(lambda: _is_on(device))
        time.sleep(0.3)
        stopped(moving=True)
        assert page.event("driven")["error"].startswith("Stopped")

    with Watching(studio) as page:
        assert page.ask("stop")["found"] is None  # no drive
        page.ask("drive_connect", port=device.port, watchdog=2.0)
        stopped(moving=False)  # without limits
        page.ask("drive_limits", volt=None, speed_rpm=None, acceleration=None, current=None)
        page.arm()
        stopped(moving=True)  # armed: it may move
        moves("drive_record", **LONG)
        moves("drive_run", **run, file="run.mcap")
        page.arm()
        page.ask("drive_commission", seed=0, members=1, evaluations=100, go_on=False)
        page.event("stage")
        page.ask("drive_go")
        until(lambda: _is_on(device))
        stopped(moving=True)
        assert page.event("driven")["error"].startswith("Stopped")
        page.ask("drive_limits", volt=None, speed_rpm=200.0, acceleration=None, current=None)
        page.arm()
        page.ask("drive_record", **{**LONG, "signal": "step", "scale": 1.0, "file": "trip.mcap"})
        assert "the limit is 200 RPM" in page.event("driven")["error"]
        page.event("drive", state="tripped")
        assert page.ask("stop")["found"] is None
        assert "has tripped" in page.ask("drive_arm")["error"]  # a stop clears nothing
        assert "found" in page.ask("drive_clear")
        page.arm()


@pytest.mark.nightly("every way of being gone", by_day=["closed"])
@pytest.mark.parametrize("fault", ["frozen", "closed"])
def test_a_page_that_is_gone_stops_it(studio: Studio, device: VirtualDevice, fault: str) -> None:
    with Watching(studio) as other, Watching(studio) as page:
        page.ask("take")
        page.armed(device.port)
        _running(page, device)
        began = time.monotonic()
        if fault == "frozen":
            page.frozen = True
        else:
            page.close()
        told = other.event("stopped")
        assert ("did not answer" if fault == "frozen" else "was closed") in told["why"]
        _require_off_since(device, began)


@pytest.mark.parametrize("victim", ["server", "bench"])
def test_a_process_that_is_killed_stops_it(
    tmp_path: Path, device: VirtualDevice, victim: str
) -> None:
    """The server's end is the end of a pipe, the bench's the device's watchdog."""
    command = [*PROGRAM, "studio", str(tmp_path), "--no-browser"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=environment()) as process:
        try:
            assert process.stdout is not None
            address, _, token = process.stdout.readline().rstrip().partition("/#")
            served = SimpleNamespace(port=int(address.rpartition(":")[2]), token=token)
            page = Watching(served)
            page.armed(device.port, watchdog=0.3)
            _running(page, device)
            bench = _child(process.pid)
            os.kill(process.pid if victim == "server" else bench, signal.SIGKILL)
            until(lambda: not _is_on(device))
            off = next(e for e in device.trace() if e["event"] == "off")
            if victim == "bench":
                silent = 1e-6 * (off["device_us"] - off["heartbeat_us"])
                watchdog = 1e-6 * off["watchdog_us"]
                assert off["state"] == TRIPPED
                assert silent <= watchdog + 0.01 + 1e-6 * off["late_us"]
                page.event("drive", connected=False)
            else:
                assert off["state"] != TRIPPED
                until(lambda: not Path(f"/proc/{bench}").exists())
        finally:
            process.kill()


@pytest.mark.skipif(not hasattr(signal, "SIGHUP"), reason="needs the signals of POSIX")
def test_sigterm_in_a_flood_ends_it_in_time(tmp_path: Path, device: VirtualDevice) -> None:
    command = [*PROGRAM, "studio", str(tmp_path), "--no-browser"]
    with (
        subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=environment()) as process,
        ExitStack() as flood,
    ):
        try:
            assert process.stdout is not None
            address, _, token = process.stdout.readline().rstrip().partition("/#")
            served = SimpleNamespace(port=int(address.rpartition(":")[2]), token=token)
            page = Watching(served)
            page.armed(device.port)
            _running(page, device)
            for i in range(60):  # silent, half a request, and answers that nobody reads
                client = socket.create_connection(("127.0.0.1", served.port))
                flood.enter_context(client)
                client.send(
                    ("", "GET / HTTP/1.1", f"GET / HTTP/1.1\r\nHost: {i}\r\n\r\n")[i % 3].encode()
                )
            for _ in range(10):
                deaf = flood.enter_context(Page(served, close_timeout=0.1))
                for _ in range(90):
                    deaf.socket.send(json.dumps({"do": "ports"}))
            began = time.monotonic()
            process.send_signal(signal.SIGTERM)
            process.wait(20.0)
            assert time.monotonic() - began < 2.0
            _require_off_since(device, began)
        finally:
            process.kill()
    until(lambda: read_recording(tmp_path / "long.mcap").outcome == "cancelled")


def _child(pid: int) -> int:
    """The process at the port."""
    found = Path(f"/proc/{pid}/task").glob("*/children")
    return int(" ".join(f.read_text() for f in found).split()[0])


def test_a_port_that_vanishes_disarms(studio: Studio) -> None:
    with VirtualDevice() as device, Watching(studio) as page:
        page.armed(device.port)
        _running(page, device)
        device.cause("unplug", 10.0)
        assert "expected" in page.event("driven")["error"]
        until(lambda: not _is_on(device))
        until(lambda: not page.event("drive")["armed"])


# --- Commissioning --------------------------------------------------------------------------------


@pytest.mark.nightly("a commissioning")
def test_a_drive_is_commissioned_stage_by_stage(studio: Studio) -> None:
    with VirtualDevice(fast=True) as device, Watching(studio) as page:
        page.armed(device.port)
        asked = {"seed": 0, "members": 1, "evaluations": 100, "go_on": True}
        assert page.ask("drive_commission", **asked)["found"] is None
        for stage in (*STAGES, "references"):
            told = page.hear(lambda m: m.get("event") in ("stage", "driven"), 300.0)
            assert (told.get("next"), told.get("waits")) == (stage, True), told
            before = len(_ends(device))
            time.sleep(0.2)
            assert len(_ends(device)) == before
            page.ask("drive_go")
        names = [c["name"] for r in told["references"] for c in r["curves"]]
        assert set(names) == {"predicted"}
        found = page.event("driven", 300.0)
        assert found["found"]["verdict"].startswith("verified")
        assert "found.save('commissioned')" in found["python"]
    assert (studio.project.folder / "commissioned" / "controllers" / "tuned.json").is_file()


def test_a_commissioning_that_waits_is_stopped(studio: Studio) -> None:
    with VirtualDevice(fast=True) as device, Watching(studio) as page:
        page.armed(device.port)
        page.ask("drive_commission", seed=0, members=1, evaluations=100, go_on=True)
        page.event("stage")
        page.send("stop")
        assert page.event("driven")["error"].startswith("Stopped")
        assert "on" not in _ends(device)


# --- Messages -------------------------------------------------------------------------------------


def test_every_schema_is_one_and_is_kept_to() -> None:
    jsonschema = pytest.importorskip("jsonschema")
    tries: list[Any] = [
        None,
        True,
        -1,
        0,
        0.5,
        10,
        12345.5,
        float("nan"),
        "x",
        "x" * 70_000,
        [],
        [1],
    ]
    tries += [["u"], {}, {"Kp": 1.0}, {"Kp": "1"}]
    for name, schema in SCHEMAS.items():
        jsonschema.Draft202012Validator.check_schema(schema)
        judge = jsonschema.Draft202012Validator(schema)
        good = {f: _fit(rule) for f, rule in schema["properties"].items() if f not in ("do", "id")}
        good["do"] = name
        assert judge.is_valid(good)
        checked(good)
        for field in [*good, "further"]:
            for value in tries:
                asked = {**good, field: value}
                if value is not None and value != value:
                    continue  # JSON has no NaN; refused by the check alone
                assert _passes(asked) == judge.is_valid(asked), asked


def _fit(rule: dict[str, Any]) -> Any:
    kind = rule["type"] if isinstance(rule["type"], str) else rule["type"][0]
    low = rule.get("minimum", 1)
    return {
        "string": "", "integer": low, "number": max(low, 0.5), "boolean": True, "array": [],
        "object": {},
    }[kind]  # fmt: skip


def _passes(asked: dict[str, Any]) -> bool:
    try:
        checked(asked)
    except sewfast.SettingError:
        return False
    return True


@pytest.mark.parametrize(
    "wrong",
    [
        {"do": "drive_connect", "port": 5},
        {"do": "drive_connect", "port": "x" * 300},
        {"do": "drive_connect", "port": "virtual", "baud": 10**12},
        {"do": "drive_limits", "volt": -1},
        {"do": "drive_limits", "volt": True},
        {"do": "drive_record", **LONG, "file": "../up.mcap"},
        {"do": "drive_record", **LONG, "file": "/tmp/up.mcap"},
        {"do": "drive_record", **LONG, "file": "<script>.mcap"},
        {"do": "drive_record", **LONG, "file": "x.csv"},
        {"do": "drive_record", **LONG, "scale": 1e9},
        {"do": "drive_work", "kind": "record"},
        {"do": "drive_close"},
        {"do": "drive__ask"},
        {"do": "live", "seconds": 1e9, "columns": 10},
        {"do": "live", "seconds": 1, "columns": 10**9},
        {"do": "alive", "n": -1},
        {"do": "alive", "n": 10**400},
        {"do": "live", "seconds": 1, "columns": 10**400},
        {"do": "upload", "file": "a.csv", "size": 10**400},
        {"do": "stop", "why": "x"},
    ],
)
def test_nonsense_is_refused(studio: Studio, wrong: dict[str, Any]) -> None:
    with Page(studio) as page:
        page.socket.send(json.dumps({"id": 7, **wrong}))
        error = page.hear(lambda m: m.get("id") == 7)["error"]
        assert "fault" not in error
        assert page.ask("ports")["found"] is not None
    assert list(studio.project.folder.iterdir()) == []
