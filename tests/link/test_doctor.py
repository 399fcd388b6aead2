"""The doctor: it finds what is wrong, says so, and finds nothing where nothing is."""

from __future__ import annotations

import json
import os
import socket
import subprocess
import sys
import threading
import tty
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import pytest

from link_device import TRIPPED, ScriptedDevice
from refusals import refuses
from sewfast.cli import main
from sewfast.errors import SettingError
from sewfast.link import Diagnosis, Finding, VirtualDevice, doctor, examine, wire
from sewfast.link.doctor import Access, _counters, _round_trip, _state, _throughput, _unopened

pytest.importorskip("serial", reason="opens pseudo-terminals as serial ports")
ECHOES = 40


def test_nothing_is_wrong_with_a_device_that_works() -> None:
    with VirtualDevice() as device:
        found = examine(device.port, echoes=ECHOES)
        assert "on" not in [entry["event"] for entry in device.trace()], "nothing moves"
    assert [f.name for f in found.findings] == [
        "port", "device", "state", "limits", "round trip", "throughput", "loss", "clock",
        "counters",
    ]  # fmt: skip
    assert all(f.verdict == "ok" for f in found.findings if f.name != "round trip")
    assert found["device"].values["period_us"] == 1000
    assert found["state"].measured == "idle"
    assert "none set" in found["limits"].measured
    assert found["loss"].values["lost_to_device"] == 0
    assert (
        found["clock"].values["drift_ppm_least"] <= 0.0 <= found["clock"].values["drift_ppm_most"]
    )


def test_works_on_a_socket_and_on_credit() -> None:
    with VirtualDevice(endpoint="tcp", fast=True) as device:
        found = examine(device.port, echoes=ECHOES)
    assert found.verdict != "fail"
    assert "what the host grants" in found["clock"].measured


def test_counts_every_frame_that_was_lost_or_damaged(tmp_path: Path) -> None:
    log = tmp_path / "faults.jsonl"
    with VirtualDevice(faults="drop=.03,flip=.02", seed=2, fault_log=log) as device:
        found = examine(device.port, echoes=150)
    loss = found["loss"].values
    assert found["loss"].verdict == "fail"
    assert "cable" in found["loss"].remedy
    # The log names each lost frame once: dropped, flipped, or joined to one whose closing zero was
    # flipped. All echoes lie within what the doctor counts; the greeting before it and the STATUS
    # at its ends do so in part, as many as a busy computer has repeated.
    entries = [json.loads(line) for line in log.read_text().splitlines()]
    for way, echo in (("to_device", 0x0B), ("to_host", 0x8B)):
        lost = [e["kind"] for e in entries if e["direction"] == way and "kind" in e]
        assert 0 < lost.count(echo) <= loss[f"lost_{way}"] <= len(lost)
    assert loss["damaged_to_device"] + loss["damaged_to_host"] > 0


def test_a_command_sent_again_is_no_loss() -> None:
    """A host that is kept waiting repeats commands that have all arrived."""
    with VirtualDevice(faults={"delay": (0.5, 0.08)}, seed=0) as device:
        found = examine(device.port, echoes=10)
        assert device.faults["delay"] > 0
    assert found["loss"].values["lost_to_device"] == found["loss"].values["lost_to_host"] == 0
    assert found["loss"].verdict == "ok"


def test_measures_what_the_link_carries() -> None:
    with VirtualDevice(baud=57_600) as device:
        found = examine(device.port, echoes=20)["throughput"]
    # 5,760 B/s against the 6,400 that a record at 1 kHz needs; 40 % to spare would be 10,667, for
    # which the quickest of all short echoes would have to be late by 32 ms
    assert found.values["needed_bytes_per_s"] == 6400.0
    assert found.verdict != "ok"
    assert "baud" in found.remedy


@pytest.mark.parametrize(
    ("rate", "verdict"), [(5_760, "fail"), (6_500, "warn"), (10_600, "warn"), (10_700, "ok")]
)
def test_throughput_is_judged_by_what_more_bytes_cost(rate: int, verdict: str) -> None:
    class Known:
        identity = wire.Identity("d", "1", 1, 1, 0, "idle", 2, 1000, 7, 10, 1572.0)
        channels = (
            wire.Channel(0, 0, 1, "counts", ""),
            wire.Channel(1, 1, 1000, "u", "V"),
        )

    class Line:
        baud = rate * 10

    short, long = (21 + 5 / 2) * 2 / rate, (221 + 5 / 2) * 2 / rate
    times = {0: [9.0, short, 0.5], 200: [long, 7.0, 0.9]}
    found = _throughput(times, Known(), Line())  # type: ignore[arg-type]
    assert found.values["bytes_per_s"] == pytest.approx(rate)
    assert found.verdict == verdict


def _dead(tmp_path: Path, answer: Callable[[bytes], bytes]) -> Iterator[str]:
    """A pseudo-terminal behind which something answers that is no device."""
    device, host = os.openpty()
    tty.setraw(host)
    done = threading.Event()

    def serve() -> None:
        while not done.is_set():
            try:
                reply = answer(os.read(device, 4096))
                if reply:
                    os.write(device, reply)
            except OSError:
                return

    thread = threading.Thread(target=serve, daemon=True)
    thread.start()
    yield os.ttyname(host)
    done.set()
    os.close(host)
    os.close(device)
    thread.join(5.0)


@pytest.fixture
def silent(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    monkeypatch.setattr(doctor, "PATIENCE", 0.3)
    yield from _dead(tmp_path, lambda data: b"")


@pytest.fixture
def garbling(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    monkeypatch.setattr(doctor, "PATIENCE", 0.3)
    yield from _dead(tmp_path, lambda data: b"\x55\x00ready>\r\n\x00" + bytes(len(data)))


def test_a_silent_port_fails_at_the_device(silent: str) -> None:
    found = examine(silent, echoes=10)
    assert [f.name for f in found.findings] == ["port", "device"]
    assert found["device"].verdict == "fail"
    assert "received nothing" in found["device"].measured
    assert "supply" in found["device"].remedy


def test_a_port_that_answers_garbage_says_so(garbling: str) -> None:
    found = examine(garbling, echoes=10)["device"]
    assert found.verdict == "fail"
    assert "not frames" in found.measured
    assert "baud" in found.remedy


def test_a_device_that_goes_meanwhile_keeps_what_was_found(tmp_path: Path) -> None:
    with ScriptedDevice(tmp_path) as device:
        echoes = iter(range(10_000))

        def leave(frame: tuple[int, int, int, int, bytes]) -> bool:
            if frame[0] == 0x0B and next(echoes) == 10:
                device.wire.unplug()
            return False

        device.intercept = leave
        found = examine(device.url, echoes=ECHOES)
    assert [f.name for f in found.findings] == ["port", "device", "state", "limits", "device"]
    assert found.verdict == "fail"
    assert "vanished" in found.findings[-1].measured


def test_a_trip_is_told_with_its_cause(tmp_path: Path) -> None:
    with ScriptedDevice(tmp_path, state=TRIPPED, reason=4) as device:
        found = examine(device.url, echoes=10)["state"]
    assert found.verdict == "warn"
    assert found.measured == "tripped: current"
    assert "jam" in found.remedy
    assert "clear" in found.remedy


def test_what_is_not_there_fails_at_the_port(tmp_path: Path) -> None:
    missing = examine(str(tmp_path / "none"))
    assert [f.verdict for f in missing.findings] == ["fail"]
    assert "ports there are" in missing["port"].remedy
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        refused = examine(f"socket://127.0.0.1:{listener.getsockname()[1]}")
    assert "received nobody" in refused["port"].measured
    file = tmp_path / "file"
    file.touch()
    assert examine(str(file))["port"].verdict == "fail"


def test_refuses_what_cannot_be_asked() -> None:
    with refuses(SettingError, name="echoes", expected="10 or more"):
        examine("/dev/null", echoes=0)


@pytest.mark.parametrize(
    ("mode", "user", "groups", "allowed"),
    [
        (0o660, 4242, {77}, True),
        (0o660, 4242, {78}, False),
        (0o600, 4242, {77}, False),
        (0o666, 4242, {78}, True),
        (0o006, 4242, {77}, False),
        (0o000, 0, {0}, True),
        (0o640, 4242, {77}, False),
    ],
)
def test_permission_is_judged_as_the_kernel_does(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, mode: int, user: int, groups: set[int],
    allowed: bool,
) -> None:  # fmt: skip
    stat = os.stat

    def of_root_and_77(path: str) -> os.stat_result:
        values = list(stat(tmp_path))
        values[0], values[4], values[5] = 0o020000 | mode, 0, 77
        return os.stat_result(values)

    monkeypatch.setattr(doctor.os, "stat", of_root_and_77)
    found = doctor.access("port", user, frozenset(groups))
    assert found.allowed == allowed
    assert found.member == (77 in groups)
    assert found.group == ("77" if mode & 0o060 == 0o060 else None)


def test_permission_remedies_name_the_group_or_the_rule() -> None:
    denied = Access(False, "uucp", "root", "crw-rw----", member=False)
    remedy = doctor.permission_remedy(denied, 0x0403, 0x6001)
    assert "usermod -aG uucp" in remedy
    assert 'ATTRS{idVendor}=="0403", ATTRS{idProduct}=="6001"' in remedy
    assert "udevadm" in remedy
    closed = replace(denied, group=None, mode="crw-------")
    assert 'GROUP="dialout"' in doctor.permission_remedy(closed)
    assert "is in the way" in doctor.permission_remedy(replace(denied, member=True))


def test_a_port_that_is_not_mine_fails_with_its_group(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    port = tmp_path / "port"
    port.touch()
    denied = Access(False, "dialout", "root", "crw-rw----", member=False)
    monkeypatch.setattr(doctor, "access", lambda path: denied)
    from sewfast.errors import LinkError

    found = _unopened(str(port), LinkError("expected this, got that; do so"))
    assert found.verdict == "fail"
    assert "mode crw-rw----" in found.measured
    assert "usermod -aG dialout" in found.remedy


@pytest.mark.skipif(not Path("/proc/self/fd").is_dir(), reason="needs /proc")
def test_names_who_else_has_the_port_open(silent: str) -> None:
    program = f"import sys; f = open({silent!r}); print('open', flush=True); sys.stdin.read()"
    with subprocess.Popen(
        [sys.executable, "-c", program], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    ) as other:
        assert other.stdout is not None
        other.stdout.readline()
        found = examine(silent, echoes=10)["port"]
        other.communicate(b"")
    assert found.verdict == "warn"
    assert str(other.pid) in found.measured
    assert other.pid in [number for number, _ in found.values["holders"]]


def test_names_nobody_who_has_something_else_open() -> None:
    with open(os.devnull, "wb"):
        found = examine(os.devnull, echoes=10)["port"]
    assert found.verdict == "fail"
    assert "something else" in found.measured
    assert "end " not in found.remedy


def test_reads_the_latency_timer_where_there_is_one(tmp_path: Path) -> None:
    timer = tmp_path / "ttyUSB7" / "device" / "latency_timer"
    timer.parent.mkdir(parents=True)
    timer.write_text("16\n")
    assert doctor.latency_timer("/dev/ttyUSB7", tmp_path) == (16, timer)
    timer.write_text("soon")
    assert doctor.latency_timer("/dev/ttyUSB7", tmp_path) is None
    assert doctor.latency_timer("/dev/ttyACM0", tmp_path) is None


def test_a_long_latency_timer_is_a_warning(
    silent: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(doctor, "latency_timer", lambda path: (16, tmp_path / "latency_timer"))
    found = examine(silent, echoes=10)["latency timer"]
    assert found.verdict == "warn"
    assert "16 ms" in found.measured
    assert "echo 1 | sudo tee" in found.remedy


STATUS = wire.Status(
    state="idle", reason="none", mode=0, mask=0, run=0, start=0, taken=0, length=0, end=0,
    speed_rpm=0.0, counts=0, received=9, refused=0, dropped=0, late_us=0, session=1, time_us=5,
)  # fmt: skip


def test_a_late_or_choked_device_is_a_warning(tmp_path: Path) -> None:
    class Known:
        identity = wire.Identity("d", "1", 1, 1, 0, "idle", 2, 1000, 7, 10, 1572.0)

    assert _counters(STATUS, STATUS, Known()).verdict == "ok"  # type: ignore[arg-type]
    late = _counters(replace(STATUS, late_us=500), STATUS, Known())  # type: ignore[arg-type]
    assert late.verdict == "warn"
    assert "shorten" in late.remedy
    choked = _counters(replace(STATUS, dropped=3), STATUS, Known())  # type: ignore[arg-type]
    assert "too slow" in choked.remedy


def test_a_device_that_stays_in_boot_fails() -> None:
    assert _state(replace(STATUS, state="boot")).verdict == "fail"


def test_a_slow_round_trip_is_a_warning() -> None:
    assert _round_trip({0: [0.016] * 9}).verdict == "warn"
    assert _round_trip({0: [0.001, 0.001, 0.5]}).verdict == "ok"


def test_the_worst_finding_is_the_verdict() -> None:
    ok, warn, fail = (Finding(v, v, "it") for v in ("ok", "warn", "fail"))  # type: ignore[arg-type]
    assert Diagnosis("p", (ok,)).verdict == "ok"
    assert Diagnosis("p", (ok, warn)).verdict == "warn"
    assert Diagnosis("p", (fail, ok, warn)).verdict == "fail"
    with pytest.raises(KeyError):
        Diagnosis("p", (ok,))["warn"]


def test_the_command_prints_and_exits_by_the_verdict(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    with VirtualDevice() as device:
        assert main(["doctor", device.port, "--echoes", "20", "--json"]) == 0
        told = json.loads(capsys.readouterr().out)
        assert main(["doctor", device.port, "--echoes", "20"]) == 0
        text = capsys.readouterr().out
    assert told["verdict"] in ("ok", "warn")
    assert {f["name"] for f in told["findings"]} >= {"port", "device", "loss"}
    assert "none of 40 echoes" in text
    assert main(["doctor", str(tmp_path / "none")]) == 2
    assert "-> plug the cable in" in capsys.readouterr().out
