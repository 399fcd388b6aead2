"""The steps of a page on a drive: record, run and commission, with copies for a script."""

from __future__ import annotations

import math
import re
import shlex
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sewfast.errors import SettingError

from .requests import Commission, carry_out, drawn

if TYPE_CHECKING:
    from sewfast.commissioning import Commissioning

    from .bench import Bench, SeenDrive

LIMITS = {
    "volt": "volt",
    "speed_rpm": "speed",
    "acceleration": "acceleration",
    "current": "current",
}
"""Limits by their names in Python and on the command line."""

REFERENCE = "reference.csv"
"""The file of the reference in copied commands."""

SOCKET = "drive.port"
"""Name of a virtual drive's port in copied commands."""


@dataclass(frozen=True)
class Place:
    """The connection of a drive, which a copy opens first.
    `port` is the page's address: a serial port, ``socket://HOST:PORT``, or ``virtual[:SEED]``.
    `watchdog` is in [s]; `limits` go by their names in Python, infinite for no limit.
    """

    port: str
    baud: int = 115_200
    watchdog: float | None = None
    limits: dict[str, float] | None = None

    @property
    def is_virtual(self) -> bool:
        return re.fullmatch(r"virtual(:\d{1,9})?", self.port) is not None

    def python(self, *body: str) -> str:
        """A script that opens the drive, sets its limits and runs the lines of `body`."""
        options = "" if self.baud == 115_200 else f", baud={self.baud}"
        options += "" if self.watchdog is None else f", watchdog={self.watchdog!r}"
        if self.is_virtual:
            opened = (
                f"VirtualDevice({self.port!r}) as device, connect(device.port{options}) as drive"
            )
        else:
            opened = f"connect({self.port!r}{options}) as drive"
        given = {k: v for k, v in (self.limits or {}).items() if v < math.inf}
        limits = ", ".join(f"{k}={v!r}" for k, v in given.items())
        names = "VirtualDevice, connect" if self.is_virtual else "connect"
        lines = [
            "import sewfast", f"from sewfast.link import {names}", "",
            "# this moves the motor", 'if __name__ == "__main__":', f"    with {opened}:",
            f"        drive.set_limits({limits})",
        ]  # fmt: skip
        return "\n".join([*lines, *(f"        {line}" for line in body)]) + "\n"

    def commands(self, *words: str) -> str:
        """The same for a shell: a command that takes ``--on``."""
        port = f"./{SOCKET}" if self.is_virtual else self.port
        limits = ",".join(f"{LIMITS[k]}={v!r}" for k, v in (self.limits or {}).items())
        row = ["sewfast", words[0], f"--on={port}", *words[1:], f"--limits={limits}"]
        if self.baud != 115_200:
            row.append(f"--baud={self.baud}")
        if self.watchdog is not None:
            row.append(f"--watchdog={self.watchdog * 1e3:g}")
        line = shlex.join(row) + "\n"
        if not self.is_virtual:
            return line
        device = shlex.join(["sewfast", "device", "--machine", self.port, "--link", SOCKET])
        return f"{device} &\nuntil [ -e {SOCKET} ]; do sleep .1; done\n{line}kill $!\n"


def record(
    drive: SeenDrive, folder: Path, bench: Bench, signal: str, seed: int, scale: float, file: str
) -> dict[str, Any]:
    """Record a named excitation into a file."""
    from sewfast import signals
    from sewfast.control.record import record

    u = scale * signals.excitation(signal, seed)
    made = record(drive, u, name=signal, file=folder / file, cancel=bench.cancel)
    return {"text": f"{len(made)} samples are in {file}", "file": file}


def run(
    drive: SeenDrive, folder: Path, bench: Bench, controller: str, reference: str, seed: int,
    scale: float, file: str,
) -> dict[str, Any]:  # fmt: skip
    """Run a controller of the folder along a named reference."""
    from sewfast import signals
    from sewfast.control.files import load_pid
    from sewfast.control.loop import run

    found = run(
        load_pid(folder / controller), drive, scale * signals.reference(reference, seed),
        name=reference, file=folder / file, cancel=bench.cancel,
    )  # fmt: skip
    return {"text": f"{found}\n{file}", "file": file}


def commission(
    drive: SeenDrive, folder: Path, bench: Bench, seed: int, members: int, evaluations: int,
    go_on: bool,
) -> dict[str, Any]:  # fmt: skip
    """Commission a drive; with `go_on`, each stage waits for the page."""

    def between(following: str, so_far: Commissioning) -> None:
        event: dict[str, Any] = {"event": "stage", "next": following, "waits": go_on}
        if following == "references":
            event["references"] = drawn(so_far.comparisons)
        bench.send(event)
        if go_on:
            bench.wait_for_go()

    asked = Commission("drive", seed, members, evaluations)
    return carry_out(
        asked, drive, folder, bench.progress, cancel=bench.cancel, between=between
    )  # fmt: skip


def copies(kind: str, place: Place, asked: dict[str, Any]) -> dict[str, str]:
    """The same work as a script and as commands, to run in the project folder."""
    if kind == "record":
        signal, seed, scale, file = (asked[k] for k in ("signal", "seed", "scale", "file"))
        u = f"{scale!r} * sewfast.signals.excitation({signal!r}, {seed})"
        call = f"sewfast.record(drive, {u}, name={signal!r}, file={file!r})"
        words = ["record", f"--signal={signal}", f"--seed={seed}", f"--scale={scale!r}", "-o", file]
        return {"python": place.python(call), "commands": place.commands(*words)}
    if kind == "run":
        reference, seed, scale, file = (asked[k] for k in ("reference", "seed", "scale", "file"))
        r = f"{scale!r} * sewfast.signals.reference({reference!r}, {seed})"
        load = f"controller = sewfast.load_controller({asked['controller']!r})"
        call = f"sewfast.run(controller, drive, {r}, name={reference!r}, file={file!r})"
        words = ["run", asked["controller"], f"--reference={REFERENCE}", "-o", file]
        # the command line does not scale a reference
        made = (
            f"import sewfast; r = {r}; t = [k / 1000 for k in range(len(r))]; "
            f"sewfast.write_table({REFERENCE!r}, {{'t': t, 'r': r}})"
        )
        written = shlex.join(["python", "-c", made]) + "\n"
        return {
            "python": place.python(load, f"print({call})"),
            "commands": written + place.commands(*words),
        }
    effort = {k: asked[k] for k in ("seed", "members", "evaluations")}
    call = ", ".join(f"{k}={v}" for k, v in effort.items())
    words = ["commission", *(f"--{k}={v}" for k, v in effort.items()), "--out=commissioned"]
    body = (f"found = sewfast.commission(drive, {call})", "found.save('commissioned')")
    return {"python": place.python(*body), "commands": place.commands(*words)}


def checked_recording(file: Any) -> str:
    """The plain name of a recording to write, without a folder; others raise `SettingError`."""
    fits = isinstance(file, str) and re.fullmatch(r"[A-Za-z0-9_][A-Za-z0-9_.-]{0,60}\.mcap", file)
    if not fits:
        raise SettingError(
            f"file: expected a name such as step.mcap, received {str(file)[:80]!r}; choose another"
        )
    return str(file)
