"""Ctrl-C at random times in every command that runs longer than a second.

python benches/interrupts.py                                 20 times each (make interrupts)
python benches/interrupts.py --only tune,fleet --count 5     some of them
python benches/interrupts.py --only tune --trial 7           one trial again, with its messages

A command runs in a process group of its own, which gets SIGINT as from a terminal, at times drawn
over its whole run, its start included; every fourth trial presses again .1 s later. It has to end
within a second with its workers, exit code 130 and no traceback, leave no temporary file, leave
every file whole (the old one or the new one), and say truly what it wrote.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

import sewfast
from sewfast.link import VirtualDevice
from sewfast.recordfile import read_recording

LIMIT = 1.0
"""A command has to end within this time [s]."""
LONGEST = 60.0
"""One that has not ended by then is killed [s]."""
SERVERS = 6.0
"""Time over which a server, which ends only by Ctrl-C, is interrupted [s]."""
EARLY: list[str] = []
"""No fault: Ctrl-C came while Python itself started, which then ends with a traceback."""
PROGRAM = (sys.executable, "-c", "import sys; from sewfast.__main__ import main; sys.exit(main())")
"""As the installed script."""
LIMITS = "--limits volt=10,speed=3500,acceleration=30000,current=15"

TABLE = """
demo                         demo --out out
commission                   commission --on virtual --out out --members 1 --evaluations 600
record                       record --on virtual --signal {in}/minutes.npz -o out.csv
record on a drive            record --on DRIVE --signal random -o out.mcap
identify                     identify {in}/pulses.csv {in}/chirp.csv -o out.json
identify oe                  identify {in}/long.npz --model oe --na 4 --nb 4 --nk 2 -o out.json
identify arx                 identify {in}/long.npz --model arx --na 20 --nb 20 --nk 1 -o out.json
identify iv                  identify {in}/long.npz --model iv --na 6 --nb 6 --nk 1 -o out.json
identify hammerstein-wiener  identify {in}/pulses.csv --model hammerstein-wiener -o out.json
identify grey-box            identify {in}/pulses.csv --model grey-box -o out.json
identify neural-oe           identify {in}/pulses.csv --model neural-oe --starts 20 -o out.json
identify neural-ss           identify {in}/pulses.csv --model neural-ss --starts 4 -o out.json
physics                      physics {in}/pulses.csv --speed-unit rpm -o out.json --plot out.png
orders                       orders {in}/pulses.csv {in}/chirp.csv
check                        check {in}/oe.json {in}/pulses.csv --plot out
check of networks            check {in}/net.json {in}/random.csv --training {in}/pulses.csv
validate                     validate {in}/net.json {in}/large.npz --plot out.png
compare                      compare {in}/net.json {in}/oe.json {in}/large.npz --plot out.png
look                         look {in}/large.csv --plot out.png
show                         show {in}/large.mcap
export                       export {in}/large.mcap -o out.csv
gains                        gains {in}/step.npz -o out.json
tune                         tune {in}/net.json -o out.json --plot out.png
tune a front                 tune {in}/net.json --pareto tracking,effort -o out.json --front f.csv
tune with a rival            tune {in}/net.json --rival {in}/oe.json -o out.json
run                          run {in}/pid.json {in}/net.json --reference {in}/minutes.npz -o out.csv
run on a drive               run {in}/pid.json --on DRIVE --reference random -o out.mcap
analyse                      analyse {in}/pid.json {in}/net.json {in}/oe.json --out out
bode                         bode --on virtual --speed 1500 -o out.json --plot out.png
bode of a record             bode {in}/long.npz --method local -o out.json --plot out.png
report                       report demo
fleet                        fleet {in}/fleet --workers 2 -o out.csv
fleet in one process         fleet {in}/fleet --workers 0 -o out.csv
deploy                       deploy {in}/net.json out --to fmi
studio                       studio --demo --no-browser
device                       device --tcp 127.0.0.1:0
"""
"""Names and commands; {in} is the folder of what they read, DRIVE the port of a virtual drive."""
SERVE = ("studio", "device")
"""Commands that end only by Ctrl-C, which is then no failure."""
OUTPUTS = ("-o", "--out", "--plot", "--front")
KEPT = (".out.csv.journal", "dask-scratch-space")
"""What a `fleet` that is interrupted leaves: its journal to continue from, and the folder that
Dask itself keeps and cleans."""


@dataclass(frozen=True)
class Row:
    """A command of the table."""

    name: str
    words: tuple[str, ...]

    @property
    def made(self) -> tuple[str, ...]:
        """Files and folders that it writes."""
        given = tuple(b for a, b in pairwise(self.words) if a in OUTPUTS)
        return given or (self.words[1:2] if self.has_folder else self.words[2:3] * self.deploys)

    @property
    def serves(self) -> bool:
        return self.words[0] in SERVE

    @property
    def has_folder(self) -> bool:
        """Whether it writes into the folder of a `demo`, which each trial gets as a copy."""
        return self.words[0] == "report"

    @property
    def deploys(self) -> bool:
        return self.words[0] == "deploy"

    @property
    def has_drive(self) -> bool:
        return "DRIVE" in self.words


ROWS = [
    Row(name, tuple(words.split()))
    for name, words in (re.split(r"\s{2,}", line) for line in TABLE.strip().splitlines())
]


# --- What the commands read -----------------------------------------------------------------------


def prepare(place: Path, rows: Sequence[Row]) -> None:
    """The recordings, models and controllers that the commands read."""
    wanted = " ".join(word for row in rows for word in row.words)
    names = {"chirp": "chirp_lo_hi", "pulses": "saturating", "random": "random"}
    for name, excitation in names.items():
        run("record", "--on", "virtual", "--signal", excitation, "-o", f"{name}.csv", cwd=place)
    if ".json" in wanted.replace("out.json", ""):
        run("identify", "chirp.csv", "--model", "oe", "-o", "oe.json", cwd=place)
        network = ("--model", "neural-oe", "--hidden", "6", "--starts", "2")
        run("identify", "pulses.csv", *network, "-o", "net.json", cwd=place)
        run("tune", "net.json", "--evaluations", "300", "--force", "-o", "pid.json", cwd=place)
    for name, count in (("long", 60_000), ("large", 600_000), ("minutes", 600_000)):
        if f"{name}.npz" in wanted or (name == "minutes" and "large.mcap" in wanted):
            sewfast.write_table(place / f"{name}.npz", noisy(count))
    if "large.csv" in wanted:
        sewfast.write_table(place / "large.csv", noisy(600_000), units={"u": "V", "y": "RPM"})
    if "large.mcap" in wanted:
        given = ("--signal", "minutes.npz", "-o", "large.mcap")
        run("record", "--on", "virtual", *given, cwd=place)
    k = np.arange(200_000)
    y = -3.0 * np.expm1(-np.clip(k - 2000, 0, None) / 20_000)
    y += 0.01 * np.random.default_rng(1).normal(size=len(k))
    sewfast.write_table(place / "step.npz", {"t": 0.001 * k, "u": (k >= 1000) * 1.0, "y": y})
    (place / "fleet").mkdir()
    for i in range(120):
        shutil.copy(place / ("pulses.csv", "random.csv")[i % 2], place / "fleet" / f"{i:03}.csv")
    if any(row.has_folder for row in rows):
        run("demo", "--out", "demo", cwd=place)


def noisy(count: int) -> dict[str, Any]:
    """A first-order drive under steps, and a reference of the same shape."""
    rng = np.random.default_rng(0)
    u = np.repeat(rng.uniform(1.0, 9.0, count // 100), 100)
    y = np.zeros(count)
    for k in range(1, count):
        y[k] = 0.98 * y[k - 1] + 4.0 * u[k - 1]
    y += rng.normal(size=count)
    return {"t": 0.001 * np.arange(count), "u": u, "y": y, "r": 200.0 * u}


def run(*words: str, cwd: Path) -> None:
    done = subprocess.run([*PROGRAM, *words], cwd=cwd, capture_output=True, text=True)
    if done.returncode:
        raise SystemExit(f"sewfast {' '.join(words)}: {done.stderr}")


# --- One trial ------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Outcome:
    """Whether the command was interrupted at all, the time to its end [s], what was wrong."""

    pressed: bool
    seconds: float
    faults: tuple[str, ...]
    text: str


def words_of(row: Row, place: Path, device: VirtualDevice | None) -> list[str]:
    port = "" if device is None else device.port
    text = " ".join((*row.words, LIMITS) if row.has_drive else row.words)
    return [*PROGRAM, *text.replace("{in}", str(place)).replace("DRIVE", port).split()]


def trial(
    row: Row, place: Path, at: float, *, twice: bool, old: Path | None, usual: int
) -> Outcome:
    """The command in a folder of its own, interrupted after `at` seconds; `old` holds the files of
    an earlier run, which lie there before, and `usual` is its exit code if nobody interrupts it.
    """
    with tempfile.TemporaryDirectory() as name, ExitStack() as stack:
        folder, scratch, log = (Path(name) / part for part in ("work", "scratch", "stderr"))
        scratch.mkdir()
        prepared(row, place, folder)
        for file in row.made:
            if old is not None and (old / file).is_file() and not file.endswith(".mcap"):
                shutil.copy(old / file, folder / file)
        before = contents(folder)
        device = stack.enter_context(VirtualDevice()) if row.has_drive else None
        with log.open("w") as err:
            process = subprocess.Popen(
                words_of(row, place, device), cwd=folder, stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL, stderr=err, start_new_session=True,
                env={**os.environ, "TMPDIR": str(scratch)},
            )  # fmt: skip
            pressed, seconds = interrupted(process, at, twice=twice)
        text = log.read_text()
        left = [path for path in contents(scratch) if path.split("/")[0] not in KEPT]
        codes = {130, -signal.SIGINT} if pressed else {usual}
        if row.serves or all((folder / name).exists() for name in row.made):
            codes.add(0)  # a server, or a command that was done before it heard
        faults = judged(row, folder, before, text, is_interrupted=process.returncode == 130)
        if process.returncode not in codes and faults is not EARLY:
            faults.append(f"exit code {process.returncode}")
        if left:
            faults.append(f"{len(left)} temporary files: {', '.join(left[:3])}")
        if seconds > LIMIT:
            faults.append(f"ended after {seconds:.1f} s")
        outputs = [e["event"] for e in device.trace()] if device is not None else []
        if "on" in outputs and "off" not in outputs[len(outputs) - outputs[::-1].index("on") :]:
            faults.append("the drive's output is on")
        return Outcome(pressed, seconds, tuple(faults), text)


def prepared(row: Row, place: Path, folder: Path) -> None:
    """The folder in which a command runs."""
    if row.has_folder:
        shutil.copytree(place / "demo", folder / "demo")
    else:
        folder.mkdir(exist_ok=True)


def interrupted(process: subprocess.Popen[bytes], at: float, *, twice: bool) -> tuple[bool, float]:
    """Press Ctrl-C; whether the command still ran, and the time until its last process ended."""
    try:
        process.wait(at)
        return False, 0.0
    except subprocess.TimeoutExpired:
        pass
    os.killpg(process.pid, signal.SIGINT)
    began = time.monotonic()
    again = twice
    while (process.poll() is None or group(process.pid)) and time.monotonic() - began < LONGEST:
        if again and time.monotonic() - began > 0.1:
            again = False
            press(process.pid)
        time.sleep(0.005)
    seconds = time.monotonic() - began
    press(process.pid, signal.SIGKILL)
    process.wait()
    return True, seconds


def press(number: int, what: signal.Signals = signal.SIGINT) -> None:
    with suppress(ProcessLookupError):
        os.killpg(number, what)


def group(number: int) -> bool:
    """Whether a process of the group is left that has not ended."""
    try:
        os.killpg(number, 0)
    except ProcessLookupError:
        return False
    for stat in Path("/proc").glob("[0-9]*/stat"):
        try:
            state, _, its = stat.read_text().rpartition(") ")[2].split()[:3]
        except OSError:
            continue
        if int(its) == number and state != "Z":
            return True
    return False


def contents(folder: Path) -> dict[str, tuple[bytes, int]]:
    """Content and inode of every file: one that is written again can have the same content."""
    files = [path for path in folder.rglob("*") if path.is_file()]
    return {str(p.relative_to(folder)): (p.read_bytes(), p.stat().st_ino) for p in files}


def judged(
    row: Row,
    folder: Path,
    before: Mapping[str, tuple[bytes, int]],
    text: str,
    *,
    is_interrupted: bool,
) -> list[str]:
    """What is wrong with the files and messages that a command left."""
    faults = []
    if "Traceback" in text and not re.search(r'File "[^"]*sewfast', text):
        return EARLY  # Python had not begun to run the program
    if any(word in text for word in ("Traceback", "Exception ignored", "a fault in sewfast")):
        faults.append("a traceback or a fault: " + text.strip().splitlines()[-1][:160])
    after = contents(folder)
    for name in after:
        if name.split("/")[0] not in (*row.made, *KEPT) or name.endswith(".tmp"):
            faults.append(f"left {name}")
        elif (problem := damage(folder / name)) is not None:
            faults.append(f"{name}: {problem}")
    faults.extend(f"{name} is gone" for name in before if name not in after)
    if is_interrupted and not row.serves:
        faults.extend(untrue(row, before, after, text))
    return faults


def untrue(
    row: Row,
    before: Mapping[str, tuple[bytes, int]],
    after: Mapping[str, tuple[bytes, int]],
    text: str,
) -> list[str]:
    """What the message of an interrupted command says wrongly."""
    if "interrupted" not in text:
        return ["says nothing of an interruption"]
    told = text[text.rindex("interrupted") :]
    new = [name for name, data in after.items() if before.get(name) != data and name not in KEPT]
    faults = []
    for name in row.made:
        is_new = any(n == name or n.startswith(f"{name}/") for n in new)
        if bool(re.search(rf"(?<![\w.]){re.escape(name)}(?![\w.])", told)) != is_new:
            faults.append(
                f"{name} {'was' if is_new else 'was not'} written; said: {told.strip()[:200]}"
            )
    return faults


def damage(path: Path) -> str | None:
    """Why a file is not whole; None if it is."""
    try:
        check = CHECKS.get(path.suffix)
        if path.stat().st_size == 0:
            return "empty"
        if check is not None:
            check(path)
    except Exception as error:
        return f"{type(error).__name__}: {error}"
    return None


def _json(path: Path) -> None:
    form = json.loads(path.read_text()).get("format", "")
    if form == "sewfast.model":
        sewfast.load_model(path)
    elif form == "sewfast.controller":
        sewfast.load_controller(path)


def _csv(path: Path) -> None:
    lines = path.read_text().splitlines()
    if len(
        {line.count(",") for line in lines if '"' not in line}
    ) > 1 or not path.read_text().endswith("\n"):
        raise ValueError("a torn line")


def _ends(text: bytes) -> Callable[[Path], None]:
    def check(path: Path) -> None:
        if not path.read_bytes().rstrip().endswith(text):
            raise ValueError(f"does not end in {text!r}")

    return check


CHECKS: dict[str, Callable[[Path], Any]] = {
    ".json": _json,
    ".csv": _csv,
    ".npz": lambda path: dict(np.load(path)),
    ".mcap": read_recording,
    ".html": _ends(b"</html>"),
    ".svg": _ends(b"</svg>"),
    ".png": _ends(b"IEND\xaeB`\x82"),
    ".fmu": lambda path: shutil.unpack_archive(path, tempfile.mkdtemp(), "zip"),
}


# --- All trials -----------------------------------------------------------------------------------


def whole(row: Row, place: Path, folder: Path, longest: float) -> tuple[float, int]:
    """Duration [s] and exit code if nobody interrupts a command, which leaves its files."""
    if row.serves:
        return min(SERVERS, longest), 0
    prepared(row, place, folder)
    began = time.monotonic()
    with ExitStack() as stack:
        device = stack.enter_context(VirtualDevice()) if row.has_drive else None
        words = words_of(row, place, device)
        try:
            done = subprocess.run(
                words, cwd=folder, capture_output=True, text=True, timeout=longest
            )
        except subprocess.TimeoutExpired:
            return longest, 0
    if done.returncode:
        print(f"{row.name}: exit code {done.returncode}: {done.stderr[-300:]}", file=sys.stderr)
    return time.monotonic() - began, done.returncode


def examine(
    row: Row, place: Path, seed: int, trials: Sequence[int], *, show: bool, span: float
) -> int:
    """The trials of one command, and a line of the table; the number of those that failed."""
    with ExitStack() as stack:
        old = Path(stack.enter_context(tempfile.TemporaryDirectory())) / "old"
        duration, usual = whole(row, place, old, span)
        worst, pressed, failed = 0.0, 0, []
        for i in trials:
            at = random.Random(f"{seed} {row.name} {i}").uniform(0.0, duration)
            found = trial(row, place, at, twice=i % 4 == 3, old=old if i % 2 else None, usual=usual)
            pressed += found.pressed
            worst = max(worst, found.seconds)
            if found.faults:
                failed.append((i, at, found.faults))
            if show:
                print(f"pressed after {at:.3f} s, ended after {found.seconds:.2f} s\n{found.text}")
    print(f"{row.name:28} {duration:7.1f} {pressed:8} {worst:8.2f} {len(failed):7}", flush=True)
    for i, at, faults in failed:
        print(
            f"  --only '{row.name}' --seed {seed} --trial {i} ({at:.3f} s): {'; '.join(faults)}",
            flush=True,
        )
    return len(failed)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--only", help="names of commands, with commas between")
    parser.add_argument("--count", type=int, default=20, help="trials of each (20)")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--trial", type=int, help="this one alone, with its messages")
    parser.add_argument("--span", type=float, default=3600.0, help="longest time until Ctrl-C [s]")
    parser.add_argument("--place", type=Path, help="folder of what the commands read, kept")
    args = parser.parse_args()
    # a shell starts jobs in the background with SIGINT ignored, which commands would inherit
    signal.signal(signal.SIGINT, signal.default_int_handler)
    names = None if args.only is None else args.only.split(",")
    rows = [row for row in ROWS if names is None or row.name in names]
    trials = range(args.count) if args.trial is None else [args.trial]
    with tempfile.TemporaryDirectory() as name:
        place = Path(name) if args.place is None else args.place
        if args.place is None or not place.exists():
            place.mkdir(exist_ok=True)
            prepare(place, rows)
        print(f"{'command':28} {'runs [s]':>8} {'pressed':>7} {'worst [s]':>8} {'failed':>7}")
        failed = sum(
            examine(row, place, args.seed, trials, show=args.trial is not None, span=args.span)
            for row in rows
        )
    print(f"{failed} of {len(rows) * len(trials)} failed; seed {args.seed}")
    sys.exit(1 if failed else 0)


if __name__ == "__main__":
    main()
