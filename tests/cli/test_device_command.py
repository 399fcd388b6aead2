"""`sewfast device`: the virtual device as a process."""

from __future__ import annotations

import json
import os
import signal
import subprocess

import pytest

import raw_host as raw
from cli import PROGRAM, environment, refused, sewfast
from raw_host import RawHost

pytestmark = pytest.mark.skipif(os.name != "posix", reason="needs pseudo-terminals")


class TestCommand:
    def started(self, *arguments: str) -> tuple[subprocess.Popen[str], str]:
        process = subprocess.Popen(
            [*PROGRAM, "device", *arguments], env=environment(), text=True,
            stdout=subprocess.PIPE, stderr=subprocess.PIPE,
        )  # fmt: skip
        assert process.stdout is not None
        word, _, port = process.stdout.readline().strip().partition(" ")
        assert word == "port"
        return process, port

    @pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
    def test_a_signal_ends_it_cleanly(self, tmp_path, number):
        link = tmp_path / "drive"
        process, port = self.started("--link", str(link), "--trace", str(tmp_path / "trace"))
        with RawHost(port) as host:
            host.hello()
            process.send_signal(number)
            out, err = process.communicate(timeout=raw.PATIENCE)
        assert (process.returncode, err) == (0, "")
        assert "faults: none" in out
        assert not link.is_symlink()
        events = [
            json.loads(line)["event"] for line in (tmp_path / "trace").read_text().splitlines()
        ]
        assert events[0] == "connected"

    def test_it_outlives_its_listener(self):
        process, port = self.started("--tcp")
        assert process.stdout is not None
        process.stdout.close()
        with RawHost(port) as host:
            host.hello()
        process.send_signal(signal.SIGTERM)
        assert process.wait(raw.PATIENCE) == 0
        assert process.stderr is not None
        assert process.stderr.read() == ""
        process.stderr.close()

    def test_prints_json(self, tmp_path):
        done = sewfast(tmp_path, "device", "--tcp", "--for", 0.1, "--json")
        port, result = map(json.loads, done.out.splitlines())
        assert port["port"].startswith("socket://127.0.0.1:")
        assert result["samples"] > 0
        assert result["faults"]["drop"] == 0

    def test_refuses(self, tmp_path):
        assert "drip" in refused(tmp_path, "device", "--faults", "drip=1")
        assert "HOST:PORT" in refused(tmp_path, "device", "--tcp", "nothing")
