"""Twelve recordings as strangers have them: from file to controller with three commands.

    python benches/strangers.py [--seeds 0 1] [--only counts,iso] [--keep FOLDER]
    make strangers [SEEDS="1 2"] [ONLY=counts,iso]

Each row is another way to write a file down and another drive: simulated here, by equations that
the package does not know. Names, units and parameters are drawn by the seed. For each file it runs

    sewfast identify FILE
    sewfast tune FILE-model.json
    sewfast run FILE-controller.json FILE-model.json

without an option, and holds the controller on the drive itself, noise of its sensor included,
against what the last command predicted. A row passes if no command refuses, the last one has no
warning, and the drive follows the same reference with at most twice the predicted error and twice
the predicted change of the command from sample to sample.
"""

from __future__ import annotations

import argparse
import datetime
import json
import math
import re
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sewfast.control import load_controller

FloatArray = NDArray[np.float64]
Range = tuple[float, float]
COUNTS = "counts"
MOST = 2.0
"""Times the predicted tracking error, and change of the command, that the true drive may have."""


# --- Drives ---------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Drive:
    """A motor as its user sees it: command in, speed or position out.

    Attributes
    ----------
    gain : float
        Speed per command, in the units of the file.
    tau, lag, dead : float
        Mechanical and electrical time constant, dead time [s].
    friction : float
        Command that dry friction takes.
    limit : float
        Largest command to either side.
    noise : float
        Of the measurement, rms in the unit of the output.
    position : bool
        Whether the output is the integral of the speed.
    step : float
        What the output is rounded to; 0: nothing.
    """

    gain: float
    tau: float
    lag: float
    dead: float
    friction: float
    limit: float
    noise: float
    position: bool = False
    step: float = 0.0

    def responds(
        self, Ts: float, n: int, decide: Callable[[int, float], float], seed: int
    ) -> tuple[FloatArray, FloatArray]:
        """Measured and true output in `n` samples; `decide` gives the command of each period."""
        rng = np.random.default_rng(seed)
        noise = (self.noise * rng.normal(size=n)).tolist()
        parts = max(4, math.ceil(8.0 * Ts / min(self.tau, max(self.lag, 0.1 * self.tau))))
        h, late = Ts / parts, round(self.dead / Ts * parts)
        queue = [0.0] * late
        current = speed = place = 0.0
        edge = 1e-3 * self.gain * self.limit
        seen, true = [], []
        for k in range(n):
            true.append(place if self.position else speed)
            y = true[k] + noise[k]
            y = self.step * math.floor(y / self.step) if self.step else y
            seen.append(y)
            u = min(max(decide(k, y), -self.limit), self.limit)
            for _ in range(parts):
                queue.append(u)
                current += h / max(self.lag, h) * (queue.pop(0) - current)
                dry = self.friction * min(max(speed / edge, -1.0), 1.0)
                # implicit in the speed where friction is steep, so that rest is a state of rest
                slope = 1.0 + (self.gain * self.friction / edge if abs(speed) < edge else 0.0)
                speed += h * (self.gain * (current - dry) - speed) / (self.tau + h * slope)
                place += h * speed
        return np.array(seen), np.array(true)


def excitation(kind: str, n: int, hold: int, limit: float, seed: int) -> FloatArray:
    """Commands as somebody at a bench gives them."""
    rng = np.random.default_rng([seed, 7])
    steps = math.ceil(n / hold)
    if kind == "stairs":
        levels = rng.uniform(-0.8, 0.8, steps)
    elif kind == "one way":
        levels = rng.uniform(0.15, 0.8, steps)
    elif kind == "binary":
        levels = 0.6 * rng.choice([-1.0, 1.0], steps)
    elif kind == "ramps":
        corners = rng.uniform(-0.8, 0.8, steps // 4 + 2)
        return limit * np.interp(np.arange(n) / (4 * hold), np.arange(len(corners)), corners)
    elif kind == "there and back":
        # a position that must stay on its axis: as much in one direction as in the other
        size = np.repeat(rng.uniform(0.3, 0.8, steps // 4 + 1), 4)[:steps]
        levels = size * np.tile([1.0, -1.0, -1.0, 1.0], steps // 4 + 1)[:steps]
    else:
        raise ValueError(kind)
    u = limit * np.repeat(levels, hold)[:n]
    u[: hold // 2] = 0.0
    return np.round(u, 4)


# --- Files ----------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Written:
    """What a file is made of, and how the numbers in it come about."""

    t: FloatArray
    u: FloatArray
    y: FloatArray
    rng: np.random.Generator

    def one_of(self, *variants: tuple[str, ...]) -> tuple[str, ...]:
        return variants[self.rng.integers(len(variants))]


Writer = Callable[[Path, Written], None]


def _rows(columns: Sequence[Sequence[str]], delimiter: str) -> str:
    return "".join(delimiter.join(row) + "\n" for row in zip(*columns, strict=True))


def _cells(values: FloatArray, digits: str = ".6g") -> list[str]:
    return [format(v, digits) for v in values.tolist()]


def _plain(path: Path, w: Written, names: tuple[str, ...], t: list[str] | None = None) -> None:
    head = ",".join(names) + "\n"
    path.write_text(head + _rows([t or _cells(w.t, ".9g"), _cells(w.u), _cells(w.y)], ","))


def comma(path: Path, w: Written) -> None:
    """A German spreadsheet: semicolons, decimal commas, Latin-1."""
    names = w.one_of(
        ("Zeit [s]", "Spannung [V]", "Drehzahl [1/min]"),
        ("Zeit in s", "Ankerspannung in V", "Ist-Drehzahl in U/min"),
        ("t [s]", "U_Motor [V]", "n_ist [min^-1]"),
    )
    text = ";".join(names) + "\n" + _rows([_cells(w.t, ".9g"), _cells(w.u), _cells(w.y)], ";")
    path.write_text(text.replace(".", ","), encoding="latin-1")


def header(path: Path, w: Written) -> None:
    """An oscilloscope: lines on itself, names, units."""
    names = w.one_of(
        ("Time", "CH1", "CH2"),
        ("TIME", "Motor voltage", "Tacho"),
        ("Time", "Drive voltage", "Speed"),
    )
    below = w.one_of(("(s)", "(V)", "(rpm)"), ("s", "V", "rpm"))
    text = (
        "Model,DL-2204\nFirmware,1.19.3\nDate,2026-03-14 10:02\n"
        f"Record Length,{len(w.t)},Points\nSample Interval,{w.t[1] - w.t[0]:g},s\n\n"
        f"{','.join(names)}\n{','.join(below)}\n"
    )
    path.write_text(text + _rows([_cells(w.t, ".9g"), _cells(w.u), _cells(w.y)], ","))


def units(path: Path, w: Written) -> None:
    """Units at the end of names."""
    _plain(path, w, w.one_of(
        ("time_s", "motor_voltage_V", "shaft_speed_rad_s"),
        ("t_s", "u_volt", "omega_rad_per_s"),
        ("Time (s)", "Armature Voltage (V)", "Angular Velocity (rad/s)"),
    ))  # fmt: skip


def milliseconds(path: Path, w: Written) -> None:
    """A hobby controller: milliseconds since it was switched on, duty in percent."""
    names = w.one_of(
        ("time_ms", "pwm_percent", "rpm"), ("millis", "duty", "rpm"), ("t_ms", "pwm", "speed_rpm")
    )
    start = int(w.rng.integers(500, 90_000))
    _plain(path, w, names, [f"{start + 1e3 * t:.0f}" for t in w.t])


def uneven(path: Path, w: Written) -> None:
    """A computer that reads when it gets to it."""
    _plain(path, w, w.one_of(
        ("timestamp", "cmd", "velocity"),
        ("timestamp", "command [V]", "measured velocity [m/s]"),
        ("elapsed_s", "cmd_volts", "vel_m_s"),
    ))  # fmt: skip


def unicode(path: Path, w: Written) -> None:
    """Excel's "Unicode text": UTF-16 with a mark, tabs, CR LF."""
    names = w.one_of(
        ("Time (s)", "Motor Voltage (V)", "Motor Speed (RPM)"),
        ("Temps [s]", "Tension [V]", "Vitesse [tr/min]"),
        ("Time", "Command", "Speed (rpm)"),
    )
    text = "\t".join(names) + "\n" + _rows([_cells(w.t, ".9g"), _cells(w.u), _cells(w.y)], "\t")
    path.write_bytes(text.replace("\n", "\r\n").encode("utf-16"))


def twice(path: Path, w: Written) -> None:
    """A logger that has a channel twice, and others that say nothing."""
    names = w.one_of(
        ("t", "voltage", "voltage", "speed", "status"),
        ("Time", "Voltage [V]", "Speed [rpm]", "Speed [rpm]", "Error"),
        ("time", "u", "u", "rpm", "mode"),
    )
    both = [_cells(w.u), _cells(w.u)] if names[1] == names[2] else [_cells(w.u), _cells(w.y)]
    columns = [_cells(w.t, ".9g"), *both, _cells(w.y), ["0"] * len(w.t)]
    path.write_text(",".join(names) + "\n" + _rows(columns, ","), encoding="utf-8-sig")


def iso(path: Path, w: Written) -> None:
    """A data base's export: moments instead of seconds."""
    names = w.one_of(
        ("timestamp", "command", "speed"),
        ("time", "FanCommand_pct", "FanSpeed_rpm"),
        ("datetime", "control_voltage", "actual_rpm"),
    )
    first = datetime.datetime(2026, 3, 14, 23, 59, 50)
    zone = w.one_of(("Z",), ("",), ("+01:00",))[0]
    stamps = (first + datetime.timedelta(seconds=t) for t in w.t.tolist())
    _plain(path, w, names, [s.isoformat(timespec="milliseconds") + zone for s in stamps])


def counts(path: Path, w: Written) -> None:
    """Encoder counts, and how many of them are a turn is on the motor's label only."""
    _plain(path, w, w.one_of(
        ("t", "volt", "counts"),
        ("time_s", "u", "encoder"),
        ("Time [s]", "Voltage [V]", "Encoder ticks"),
    ))  # fmt: skip


def position(path: Path, w: Written) -> None:
    """An axis."""
    _plain(path, w, w.one_of(
        ("t", "u", "position_mm"),
        ("Time [s]", "Drive command [V]", "Axis position [mm]"),
        ("time", "voltage", "pos [mm]"),
    ))  # fmt: skip


def slow(path: Path, w: Written) -> None:
    """A PLC's trace."""
    _plain(path, w, w.one_of(
        ("Time [s]", "Setpoint voltage [V]", "Drum speed [rpm]"),
        ("t", "AO_volts", "speed_rpm"),
        ("time", "output_voltage", "drum_rpm"),
    ))  # fmt: skip


def fast(path: Path, w: Written) -> None:
    """A drive's own trace, in microseconds."""
    names = w.one_of(
        ("time_us", "Uq_V", "speed_rpm"),
        ("t [us]", "voltage [V]", "n [rpm]"),
        ("time [us]", "u", "rpm"),
    )
    _plain(path, w, names, [f"{1e6 * t:.0f}" for t in w.t])


# --- The twelve -----------------------------------------------------------------------------------


@dataclass(frozen=True)
class Stranger:
    """A way to write a file, and what drives of its owner are like.

    Ranges are drawn from evenly in the logarithm. `friction` and `noise` are shares of the largest
    command and of the speed that it gives; `lag` and `dead` are shares of `tau`.
    """

    write: Writer
    Ts: float
    seconds: float
    limit: float
    top: Range
    tau: Range
    excited: str
    hold: float = 2.0
    lag: Range = (0.02, 0.2)
    dead: Range = (0.005, 0.05)
    friction: Range = (0.005, 0.05)
    noise: Range = (0.001, 0.006)
    is_position: bool = False
    step: float = 0.0

    def drive(self, rng: np.random.Generator) -> Drive:
        def drawn(of: Range) -> float:
            return float(np.exp(rng.uniform(*np.log(of))))

        top, tau = drawn(self.top), drawn(self.tau)
        noise = 0.0 if self.step else drawn(self.noise) * top * (tau if self.is_position else 1.0)
        return Drive(
            gain=top / self.limit, tau=tau, lag=drawn(self.lag) * tau, dead=drawn(self.dead) * tau,
            friction=drawn(self.friction) * self.limit, limit=self.limit, noise=noise,
            position=self.is_position, step=self.step,
        )  # fmt: skip


STRANGERS = {
    "comma": Stranger(comma, 5e-3, 30.0, 10.0, (1500, 4000), (0.04, 0.2), "stairs"),
    "header": Stranger(header, 1e-3, 10.0, 24.0, (2000, 6000), (0.02, 0.1), "binary"),
    "units": Stranger(units, 2e-3, 12.0, 12.0, (50, 400), (0.02, 0.1), "stairs"),
    "milliseconds": Stranger(milliseconds, 10e-3, 60.0, 100.0, (200, 8000), (0.1, 0.5), "one way"),
    "uneven": Stranger(uneven, 10e-3, 40.0, 10.0, (0.5, 4.0), (0.1, 0.4), "stairs"),
    "unicode": Stranger(unicode, 4e-3, 20.0, 10.0, (1000, 3000), (0.03, 0.15), "ramps", hold=1.0),
    "twice": Stranger(twice, 1e-3, 8.0, 5.0, (300, 3000), (0.015, 0.06), "stairs"),
    "iso": Stranger(iso, 10e-3, 60.0, 100.0, (800, 3000), (0.2, 0.8), "one way"),
    "counts": Stranger(
        counts, 1e-3, 10.0, 12.0, (2e4, 2e5), (0.02, 0.1), "stairs", is_position=True, step=1.0
    ),
    "position": Stranger(
        position, 2e-3, 20.0, 10.0, (100, 800), (0.02, 0.08), "there and back", is_position=True
    ),
    "slow": Stranger(slow, 20e-3, 120.0, 10.0, (60, 600), (0.5, 2.0), "stairs"),
    "fast": Stranger(fast, 1e-4, 1.5, 48.0, (5e3, 2e4), (2e-3, 8e-3), "stairs"),
}  # fmt: skip


def made(name: str, seed: int, folder: Path) -> tuple[Path, Drive]:
    """The file, and the drive that it was recorded on."""
    stranger = STRANGERS[name]
    rng = np.random.default_rng([seed, *name.encode()])
    drive = stranger.drive(rng)
    n = round(stranger.seconds / stranger.Ts)
    hold = max(2, round(stranger.hold * drive.tau / stranger.Ts))
    u = excitation(stranger.excited, n, hold, stranger.limit, seed)
    y, true = drive.responds(stranger.Ts, n, lambda k, _: float(u[k]), seed)
    t = np.arange(n) * stranger.Ts
    if stranger.write is uneven:
        # rows come late by up to a third of a period, and a few not at all
        late = t + stranger.Ts * rng.uniform(0.0, 0.33, n)
        y, keep = np.interp(late, t, true) + (y - true), rng.uniform(size=n) > 0.005
        t, u, y = late[keep], u[keep], y[keep]
    path = folder / f"{name}.csv"
    stranger.write(path, Written(t, u, y, rng))
    return path, drive


# --- Three commands -------------------------------------------------------------------------------


@dataclass(frozen=True)
class Step:
    """One command: exit code, wall time [s], what it wrote to its two streams."""

    code: int
    seconds: float
    out: str
    err: str


def command(folder: Path, *arguments: str) -> Step:
    """`sewfast` with arguments, in the stranger's folder."""
    began = time.perf_counter()
    done = subprocess.run(
        [sys.executable, "-m", "sewfast", *arguments],
        cwd=folder, capture_output=True, text=True, check=False,
    )  # fmt: skip
    return Step(done.returncode, time.perf_counter() - began, done.stdout, done.stderr)


def on_drive(
    folder: Path, name: str, drive: Drive, r: FloatArray, seed: int
) -> tuple[FloatArray, FloatArray]:
    """Command and output of the drive itself under the controller that was found."""
    controller = load_controller(folder / f"{name}-controller.json")
    core, early = controller.core(), controller.early(r)
    u = np.zeros(len(r))

    def decide(k: int, y: float) -> float:
        u[k] = core.step(float(early[k]), y)
        return float(u[k])

    _, true = drive.responds(controller.Ts, len(r), decide, seed + 1000)
    return u, true


def tried(name: str, seed: int, folder: Path) -> bool:
    """Walk one file through; print a line for each step and the verdict."""
    path, drive = made(name, seed, folder)
    first = path.read_bytes()[:200].replace(b"\0", b"").decode("utf-8", "replace")
    print(f"{name}/{seed}: {first.splitlines()[0]!r}", flush=True)
    steps: list[Step] = []
    for arguments in (
        ("identify", path.name),
        ("tune", f"{name}-model.json"),
        ("run", f"{name}-controller.json", f"{name}-model.json"),
    ):
        step = command(folder, *arguments)
        steps.append(step)
        (folder / f"{arguments[0]}.txt").write_text(step.out + "\n--- stderr\n" + step.err)
        print(f"  {arguments[0]:9} exit {step.code}, {step.seconds:.1f} s", flush=True)
        if step.code:
            print("  " + step.err.strip().splitlines()[-1], flush=True)
            return False
    verdict = json.loads((folder / f"{name}-model.json").read_text())["training"]["verdict"]
    warned = [x.strip() for x in steps[2].err.splitlines() if x.strip().startswith("warning")]
    lines = [x.split(",") for x in steps[2].out.splitlines() if re.match(r"[-\d]", x)]
    table = np.array([[float(cell or "nan") for cell in line] for line in lines])
    r, u, predicted = table[:, 1], table[:, 2], table[:, 3]
    sent, true = on_drive(folder, name, drive, r, seed)
    wide = float(np.ptp(r))
    thought, had = (100.0 * float(np.sqrt(np.mean((y - r) ** 2))) / wide for y in (predicted, true))
    changed, changes = (float(np.sqrt(np.mean(np.diff(x) ** 2))) for x in (u, sent))
    passed = not warned and had <= MOST * max(thought, 0.1) and changes <= MOST * changed
    print(
        f"  model {verdict['grade']}; tracking rms {thought:.2f} % of the range on the model, "
        f"{had:.2f} % on the drive ({had / thought:.2f} x); command changes by {changed:.3g} on "
        f"the model, {changes:.3g} on the drive ({changes / changed:.2f} x); "
        f"{sum(s.seconds for s in steps):.0f} s: "
        f"{'passed' if passed else 'FAILED'}",
        flush=True,
    )
    for line in warned:
        print(f"  {line}", flush=True)
    return passed


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, nargs="+", default=[0])
    parser.add_argument("--only", help=f"of {','.join(STRANGERS)}")
    parser.add_argument("--keep", type=Path, help="where files and what was printed stay")
    args = parser.parse_args()
    names = args.only.split(",") if args.only else list(STRANGERS)
    passed = total = 0
    for seed in args.seeds:
        for name in names:
            with tempfile.TemporaryDirectory() as place:
                folder = Path(place) if args.keep is None else args.keep / f"{name}-{seed}"
                folder.mkdir(parents=True, exist_ok=True)
                passed += tried(name, seed, folder)
                total += 1
    print(f"{passed} of {total} files: three commands, no option")
    return int(passed < total)


if __name__ == "__main__":
    sys.exit(main())
