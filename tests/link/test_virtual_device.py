"""The virtual device over real ports, by a host that shares no code with ours."""

from __future__ import annotations

import json
import os
import random
import struct
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import raw_host as raw
from cli import environment
from moments import until
from raw_host import RawHost, counts_and_u, golden
from refusals import refuses
from sewfast import LinkError, SettingError, VirtualMachine
from sewfast.link import VirtualDevice

PERIOD = 1000
LONG = 10_000_000
"""The longest watchdog time [us]: for hosts that are not what is tested."""

pytestmark = pytest.mark.skipif(os.name != "posix", reason="needs pseudo-terminals")


@pytest.fixture(params=["pty", "tcp"])
def device(request: pytest.FixtureRequest) -> Iterator[VirtualDevice]:
    with VirtualDevice(endpoint=request.param) as served:
        yield served


def event(device: VirtualDevice, name: str) -> dict[str, Any]:
    """The last entry of the trace by this name, as soon as there is one."""
    found = until(lambda: [entry for entry in device.trace() if entry["event"] == name])
    return found[-1]


def ready(host: RawHost) -> RawHost:
    host.hello()
    host.settle()
    host.arm(watchdog=LONG)
    return host


class TestRun:
    def test_a_profile_is_played_from_hello_to_its_end(self, device):
        with RawHost(device.port) as host:
            reply = host.hello()
            name = reply[28 : 28 + reply[27]].decode()
            assert (reply[0], reply[10], name) == (3, 6, "virtual")
            capabilities, capacity = struct.unpack_from("<II", reply, 15)
            assert (capabilities, capacity) == (0b111_1111_0111, 8192)
            names = [host.command(raw.DESCRIBE, bytes([k])) for k in range(6)]
            names = [row[7 : 7 + row[6]].decode() for row in names]
            assert names == ["counts", "u", "current", "r", "feedback", "speed_true"]
            host.settle()
            host.arm(watchdog=LONG)
            assert host.upload([3000] * 100) == (100, 8092)
            host.keep(watchdog=LONG)
            assert host.upload([3000] * 100, 100) == (200, 7992)
            start = host.start(200, watchdog=LONG)
            ended = []
            while not ended:
                host.keep(watchdog=LONG)
                ended = [f for f in host.read(0.005) if f[0] == raw.EVENT and f[4][0] in (4, 6)]
            assert ended[0][4][:3] == bytes([raw.FINISHED, raw.IDLE, 0])
            rows = counts_and_u(host.frames)
            assert [at for at, _, _ in rows] == [start + PERIOD * k for k in range(200)]
            assert {u for _, _, u in rows} == {3000}
            assert rows[-1][1] > 1000
            assert host.state() == raw.IDLE

    def test_stop_ends_a_run(self, device):
        with ready(RawHost(device.port)) as host:
            host.upload([1000] * 100)
            host.start(100_000, mode=2, watchdog=LONG)
            host.running()
            assert host.command(raw.STOP) == bytes([raw.IDLE])
            assert event(device, "off")["state"] == raw.IDLE

    def test_the_next_host_reads_nothing_of_the_last(self, device):
        with ready(RawHost(device.port)) as host:
            host.start(1000, mode=2, watchdog=LONG, batch=1)
            host.wait_for(raw.SAMPLES)
        event(device, "gone")
        with RawHost(device.port, session=78) as host:
            host.hello()
            assert not [f for f in host.frames if f[0] == raw.SAMPLES and f[1] == 0]
            # the device trips, as the session is another while it runs
            assert host.state() == raw.TRIPPED
            first = host.frames[0]
            assert first[2] > 0

    def test_garbage_between_frames_is_no_frame(self, device):
        with RawHost(device.port) as host:
            # before its first frame a network's connection would be closed for it
            host.hello()
            host.write(random.Random(1).randbytes(5000) + b"\0")
            host.settle()
            host.hello_again()


class TestCredit:
    def test_time_advances_as_far_as_granted_and_no_further(self):
        with VirtualDevice(fast=True) as device, RawHost(device.port) as host:
            host.hello()
            now = host.frames[-1][3]
            for grant in (1_000, 12_345, 400_000):
                now += grant
                host.credit(now)
                while host.frames[-1][3] < now:
                    host.command(raw.ECHO)
                host.command(raw.ECHO)
                assert host.frames[-1][3] == now

    @pytest.mark.parametrize("machine", ["virtual", "virtual:4"])
    def test_a_run_is_that_of_the_machine_itself(self, machine):
        levels = np.repeat(np.random.default_rng(3).integers(0, 12, 30) * 500, 100)
        with VirtualDevice(machine, fast=True) as device, RawHost(device.port) as host:
            run = [played(host, levels.tolist()) for _ in range(2)]
        assert run[0] == run[1]
        counts, u = np.array(run[0]).T
        np.testing.assert_array_equal(u, levels)
        expected = VirtualMachine.from_name(machine).run(levels / 1000).counts
        np.testing.assert_array_equal(counts, expected)

    def test_a_profile_longer_than_the_memory_is_fed_while_it_runs(self):
        levels = (np.arange(20_000) // 50 % 7 * 500).tolist()
        with VirtualDevice(fast=True) as device, RawHost(device.port) as host:
            assert [u for _, u in played(host, levels)] == levels

    def test_the_watchdog_counts_the_time_of_the_device(self):
        with VirtualDevice(fast=True) as device, RawHost(device.port) as host:
            start = begun(host, 100_000, mode=2, watchdog=50_000)
            host.credit(start, watchdog=50_000)
            host.running()
            time.sleep(0.2)
            assert host.state() == raw.RUNNING
            host.credit(start + 1_000_000, watchdog=30_000)
            tripped = host.wait_for(raw.EVENT, raw.TRIP_EVENT)
            assert tripped[4][1:3] == bytes([raw.TRIPPED, 1])
            off = event(device, "off")
            assert 30_000 <= off["device_us"] - off["heartbeat_us"] <= 30_000 + PERIOD


def armed(host: RawHost, watchdog: int) -> None:
    """Open a session and arm on credit; a motor that runs out is given the time."""
    host.session += 1
    host.hello()
    host.credit(host.frames[-1][3] + 300_000, watchdog=LONG)
    host.settle()
    host.command(raw.LIMITS, struct.pack("<4f", 20.0, 6000.0, 1e6, 50.0))
    while host.ask(raw.ARM, host.arming(watchdog))[0]:
        host.credit(host.frames[-1][3] + 300_000, watchdog=LONG)


def begun(host: RawHost, length: int, *, mode: int = 0, watchdog: int = LONG) -> int:
    """Arm and start on credit; when the run starts."""
    armed(host, watchdog)
    return host.start(length, mode=mode, watchdog=watchdog)


def played(host: RawHost, levels: list[int]) -> list[tuple[int, int]]:
    """Counts from the start, and u in steps, of a run of commands on credit."""
    armed(host, LONG)
    end = 0
    while end < min(len(levels), 8000):
        end, _ = host.upload(levels[end : end + 100], end)
    host.frames.clear()
    start = host.start(len(levels), watchdog=LONG)
    granted = start
    while not any(f[0] == raw.EVENT and f[4][0] in (4, 6) for f in host.frames):
        now = host.frames[-1][3]
        covered = start + PERIOD * (end - 1 if end < len(levels) else 2 * end)
        if granted - now <= 200_000 and granted < covered:
            granted = min(max(granted, now) + 400_000, covered)
            host.credit(granted, watchdog=LONG)
        if end < len(levels):
            _, reply = host.ask(raw.UPLOAD, fed(levels, end))
            end = struct.unpack_from("<I", reply)[0] if len(reply) == 8 else end
        else:
            host.read(0.5)
    rows = counts_and_u(host.frames)
    assert [at for at, _, _ in rows] == [start + PERIOD * k for k in range(len(levels))]
    return [(counts - rows[0][1], u) for _, counts, u in rows]


def fed(levels: list[int], end: int) -> bytes:
    values = levels[end : end + 100]
    return struct.pack(f"<BI{len(values)}h", 0, end, *values)


class TestLostHosts:
    def test_the_output_is_safe_after_a_hangup(self, device):
        with ready(RawHost(device.port)) as host:
            host.start(0, mode=2, watchdog=40_000)
            host.wait_for(raw.SAMPLES)
        off = event(device, "off")
        assert off["state"] == raw.TRIPPED
        assert 40_000 <= off["device_us"] - off["heartbeat_us"] <= 40_000 + PERIOD

    def test_time_on_credit_runs_by_itself_after_a_hangup(self):
        with VirtualDevice(fast=True) as device:
            with RawHost(device.port) as host:
                begun(host, 100_000, mode=2, watchdog=40_000)
                host.credit(host.frames[-1][3] + 2000, watchdog=40_000)
                host.running()
            off = event(device, "off")
            assert 40_000 <= off["device_us"] - off["heartbeat_us"] <= 40_000 + PERIOD

    def test_one_host_at_a_time_has_the_tcp_port(self):
        with VirtualDevice(endpoint="tcp") as device, RawHost(device.port) as host:
            host.hello()
            with RawHost(device.port) as second, pytest.raises(raw.Silent):
                second.hello()
            host.settle()
            assert device.statistics["refused"] == 1
            host.close()
            event(device, "gone")
            with RawHost(device.port) as third:
                third.hello()

    def test_a_host_that_reads_nothing_costs_frames_and_is_told(self):
        with VirtualDevice(baud=38_400) as device, RawHost(device.port) as host:
            ready(host).start(1000, mode=2, mask=0x3F, batch=8, watchdog=LONG)
            seen: list[int] = []
            while not any(f[0] == raw.EVENT and f[4][0] == raw.FINISHED for f in host.frames):
                host.read(1.0)
            seen = [sequence for _, _, sequence, _, _ in host.frames]
            assert seen == sorted(set(seen))
            dropped = struct.unpack_from("<I", host.command(raw.STATUS), 45)[0]
            missing = host.frames[-1][2] + 1 - len(host.frames)
            assert 0 < dropped <= missing


class TestFaults:
    def test_every_frame_that_is_missing_was_logged(self, tmp_path):
        faults = {"drop": 0.02, "flip": 0.02, "duplicate": 0.02, "reorder": 0.02, "delay": 0.02}
        log = tmp_path / "faults.jsonl"
        device = VirtualDevice(fast=True, faults=faults, seed=5, fault_log=log)
        with device, RawHost(device.port) as host:
            host.repeat = 0.03
            host.hello()
            first = host.frames[0][2]
            for k in range(600):
                host.command(raw.ECHO, struct.pack("<I", k))
            counted = device.faults
        entries = [json.loads(line) for line in log.read_text().splitlines()]
        seen = {f[2] for f in host.frames}
        lost = {
            e["sequence"]
            for e in entries
            if e["direction"] == "to_host" and e["fault"] in ("drop", "flip")
        }
        span = set(range(first, max(seen)))
        assert span - seen == {k for k in lost if k in span} - seen
        assert len(span - seen) > 10
        # a flip destroys, save where the frame came twice
        assert len((lost & span) & seen) <= 3
        for kind in faults:
            assert counted[kind] == sum(e["fault"] == kind for e in entries) > 5
        assert {e["direction"] for e in entries} == {"to_host", "to_device"}

    def test_a_reset_is_another_boot_with_the_motor_off(self, device):
        with ready(RawHost(device.port)) as host:
            host.start(0, mode=2, watchdog=LONG)
            host.running()
            boot, tag = host.boot, host.tag
            device.cause("reset")
            event(device, "reset")
            assert event(device, "off")["device_us"] > 0
            # before a HELLO there is no session, and nothing but HELLO is heard
            host.send(raw.STATUS)
            host.frames.clear()
            host.hello()
            assert raw.STATUS | 0x80 not in {f[0] for f in host.frames if f[1] != tag}
            assert host.boot & 0xFFFF != boot & 0xFFFF
            host.settle()
            # limits are not set since this boot
            assert host.ask(raw.ARM, host.arming(LONG))[0] in (11, 12)

    def test_an_unplugged_port_comes_back_with_the_session_in_force(self, device):
        with ready(RawHost(device.port)) as host:
            host.start(0, mode=2, watchdog=LONG)
            host.running()
            port, boot = device.port, host.boot
            device.cause("unplug", 0.1)
            with pytest.raises(raw.Silent):
                host.wait_for(0)
            event(device, "plugged")
            assert device.port == port
            host.reopen(port)
            assert (host.state(), host.frames[-1][1]) == (raw.RUNNING, boot & 0xFFFF)

    def test_a_stall_ends_and_what_was_under_way_comes(self, device):
        with ready(RawHost(device.port)) as host:
            host.start(500, mode=2, watchdog=LONG)
            host.running()
            device.cause("stall", 0.15)
            host.wait_for(raw.EVENT, raw.FINISHED)
            assert len(counts_and_u(host.frames)) == 500
            assert event(device, "stalled")["state"] == raw.RUNNING

    def test_refuses_what_it_cannot_mean(self):
        for faults in ("drip=1", "drop=2", "drop", {"drop": -1}, {"stall": (0.1, 99)}):
            with pytest.raises(SettingError, match="expected"):
                VirtualDevice(faults=faults)
        with VirtualDevice() as device:
            with pytest.raises(SettingError, match="expected a fault"):
                device.cause("drip")
            with pytest.raises(SettingError, match="seconds: expected"):
                device.cause("stall", 0.0)


def test_a_paced_port_carries_no_more_than_its_rate():
    baud, size, rounds = 19_200, 200, 12
    with VirtualDevice(baud=baud) as device, RawHost(device.port) as host:
        host.hello()
        host.command(raw.ECHO, bytes(size))
        # the host's clock, as the port's: the device's own stands still while a busy computer holds
        # it up. All bytes of the rounds pass between the two readings, so that load only adds time
        began = time.monotonic()
        for _ in range(rounds):
            host.command(raw.ECHO, bytes(size))
        passed = time.monotonic() - began
    # a command waits for the reply before it; each way may have saved a burst of 16 bytes meanwhile
    wire = (21 + size) + (21 + 5 + size) - 2 * 16
    assert passed >= rounds * wire / (baud / 10)


def test_115200_baud_carry_1_khz_with_40_percent_to_spare():
    samples = 1500
    with VirtualDevice(baud=round(115_200 / 1.4)) as device, RawHost(device.port) as host:
        ready(host).start(samples, mode=2, watchdog=LONG)
        host.frames.clear()
        host.wait_for(raw.EVENT, raw.FINISHED)
        if device.statistics["latest_us"] > 150_000:
            # what falls due at once then fills the memory for frames, which holds .32 s of them
            pytest.skip("the computer held the device up for longer than it can make up for")
        batches = [f for f in host.frames if f[0] == raw.SAMPLES]
        assert len(counts_and_u(host.frames)) == samples
        assert len(batches) == samples // 10
        assert max(len(golden.wire(*batch)) for batch in batches) <= 64
        dropped = struct.unpack_from("<I", host.command(raw.STATUS), 45)[0]
        assert dropped == 0


@pytest.mark.parametrize("fast", [False, True])
def test_hostile_bytes_leave_it_as_it_was(fast):
    dice = random.Random(3)
    with VirtualDevice(fast=fast, faults="flip=.1,drop=.1") as device:
        with RawHost(device.port) as host:
            host.hello()
            for _ in range(200):
                host.write(hostile(dice, host.tag))
                host.read(0.0)
        with RawHost(device.port, session=78) as host:
            host.repeat = 0.02
            host.write(b"\0")
            host.hello()
            assert host.state() in (raw.BOOT, raw.IDLE)
            assert not [entry for entry in device.trace() if entry["event"] == "on"]


def hostile(dice: random.Random, tag: int) -> bytes:
    """Random bytes, whole frames of random content, and frames of which something is missing."""
    frame = golden.wire(
        dice.randrange(256), dice.choice((tag, dice.randrange(65536))), dice.randrange(2**32),
        dice.randrange(2**64), dice.randbytes(dice.randrange(232)),
    )  # fmt: skip
    cut = dice.randrange(len(frame))
    return dice.choice((frame, frame[:cut], frame[cut:], dice.randbytes(1000)))


class TestLife:
    def test_nothing_is_left_behind(self, tmp_path):
        link = tmp_path / "drive"
        link.symlink_to("/nowhere")
        device = VirtualDevice(link=link)
        assert device.port == str(link)
        assert link.resolve().exists()
        device.stop()
        device.stop()
        assert not link.is_symlink()
        assert not device.running
        assert not list(tmp_path.iterdir())

    def test_a_link_that_leads_somewhere_is_left_alone(self, tmp_path):
        link = tmp_path / "drive"
        with VirtualDevice(link=link):
            target = link.readlink()
            with refuses(LinkError, expected="a free name"):
                VirtualDevice(link=link)
            assert link.readlink() == target
        mine = tmp_path / "mine"
        mine.symlink_to(tmp_path)
        with pytest.raises(LinkError, match="choose another name"):
            VirtualDevice(link=mine)
        assert mine.is_symlink()

    def test_an_exception_ends_it(self):
        with pytest.raises(ZeroDivisionError), VirtualDevice() as device:
            raise ZeroDivisionError
        assert not Path(device.port).parent.exists()

    def test_the_interpreter_ends_it(self):
        code = "from sewfast.link import VirtualDevice as D; device = D(); print(device.port)"
        done = subprocess.run(
            [sys.executable, "-c", code], capture_output=True, text=True, check=True,
            env=environment(),
        )  # fmt: skip
        assert not Path(done.stdout.strip()).parent.exists()

    def test_ends_by_itself(self):
        with VirtualDevice(duration=0.05) as device:
            assert device.wait(raw.PATIENCE)
        with VirtualDevice(once=True) as device:
            assert not device.wait(0.05)
            with ready(RawHost(device.port)) as host:
                host.start(0, mode=2, watchdog=30_000)
                host.wait_for(raw.SAMPLES)
            assert device.wait(raw.PATIENCE)
            # not before the output was safe
            assert event(device, "off")["state"] == raw.TRIPPED

    def test_ending_with_the_first_host_waits_for_one_that_was_unplugged(self):
        with VirtualDevice(once=True) as device, RawHost(device.port) as host:
            host.hello()
            device.cause("unplug", 0.05)
            event(device, "plugged")
            assert not device.wait(0.2)
            host.reopen(device.port)
            host.close()
            assert device.wait(raw.PATIENCE)

    def test_refuses_ports_that_cannot_be_had(self, tmp_path):
        with VirtualDevice(endpoint="tcp") as device:
            address = device.port.removeprefix("socket://")
            with pytest.raises(LinkError, match="choose another port"):
                VirtualDevice(endpoint="tcp", address=address)
        for address in ("nothing", "127.0.0.1:99999"):
            with pytest.raises(LinkError, match="expected HOST:PORT"):
                VirtualDevice(endpoint="tcp", address=address)
        taken = tmp_path / "file"
        taken.write_text("mine")
        with pytest.raises(LinkError, match="symbolic link"):
            VirtualDevice(link=taken)
        assert taken.read_text() == "mine"
        with pytest.raises(LinkError, match="nowhere"):
            VirtualDevice(trace=tmp_path / "nowhere" / "trace")

    @pytest.mark.parametrize(
        "settings",
        [{"baud": 0}, {"baud": 9600.0}, {"seed": -1}, {"duration": 0.0}, {"endpoint": "usb"},
         {"endpoint": "tcp", "link": "a"}, {"machine": "real"}],
    )  # fmt: skip
    def test_refuses_settings(self, settings):
        with pytest.raises(SettingError, match="expected"):
            VirtualDevice(**settings)
