"""Files of sewfast itself, changed by the thousand: each is refused, or loads and can be used.

    python benches/mutations.py --count 1000
    python benches/mutations.py --formats model --replay 17 --seed 3

A whole file of one of nine formats (`whole_files.py`) is changed in one to three places
(`mutators.py`). It is then loaded; where it loads it is printed, saved, read again, simulated,
checked and deployed, and some of the files are given to the command line as well. Good outcomes are
`refused` (a `SewfastError` on load) and `used`. What an error of sewfast ends in use only is listed
as `declined`, with its words: an unstable model loads, prints and is not deployed. Each file is
tried in a fork with bounded memory and processor time. The slowest file of each format is named: a
thousand reports of commissionings take ten minutes of processor, and an hour beside other work.
"""

from __future__ import annotations

import argparse
import contextlib
import functools
import io
import json
import math
import os
import re
import resource
import select
import shutil
import signal
import sys
import tempfile
import time
import traceback
import warnings
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np

import sewfast
from sewfast import cli
from sewfast.cli import project
from sewfast.errors import SewfastError
from sewfast.greybox.equations import load_equations
from sewfast.recordfile import Header, read_recording
from sewfast.recordfile import export as exported
from sewfast.report import report
from sewfast_fleet.table import load_fleet

sys.path.append(str(Path(__file__).parents[1] / "tests" / "support"))
from kinds import levels
from mutators import (
    changed_bytes,
    changed_document,
    changed_json,
    changed_settings,
    changed_table,
)
from whole_files import (
    header_of_example,
    make_commissionings,
    make_controllers,
    make_fleets,
    make_models,
    make_motors,
    make_projects,
    make_recordings,
    make_responses,
    make_tables,
    turning,
    write_recording,
)

PATIENCE = 20
"""Most processor time of one file, with everything that is done with it [s]."""
SILENCE = 60.0
"""A fork that has used no processor for this time waits for what never comes [s]."""
MEMORY = 2 << 30
"""Most address space of one process above what it has at its start [bytes]."""
COMMANDS = 20
"""Of so many files one is given to the command line as well."""
GOOD = ("refused", "used", "declined")


class Useless(Exception):
    """A value that was loaded cannot even be printed, saved or read again."""


def changed_recording(content: bytes, rng: np.random.Generator) -> bytes:
    """Bytes of a record file, or its header with the sums of its chunks as they should be."""
    if rng.random() < 0.5:
        for _ in range(int(rng.integers(1, 4))):
            content = changed_bytes(content, rng)
        return content
    text = changed_document(json.loads(header_of_example().encode()), rng).encode()
    with (
        tempfile.TemporaryDirectory() as folder,
        mock.patch.object(Header, "encode", return_value=text),
    ):
        return write_recording(Path(folder) / "a.mcap").read_bytes()


# --- Use ------------------------------------------------------------------------------------------


@contextlib.contextmanager
def must() -> Iterator[None]:
    """What whatever was loaded has to be able to do."""
    try:
        yield
    except SewfastError as error:
        raise Useless(f"{type(error).__name__}: {error}") from error


@contextlib.contextmanager
def may(what: str, declined: list[str]) -> Iterator[None]:
    """What can be refused, as it depends on the values, but only in words."""
    try:
        yield
    except SewfastError as error:
        declined.append(f"{what}: {error}")


def shown(value: Any) -> None:
    """Print a value in every way, also to a terminal in UTF-8, and without control characters."""
    html = value._repr_html_() if hasattr(value, "_repr_html_") else ""
    for text in (str(value), repr(value), html):
        text.encode()
        if re.search(r"[\x00-\x08\x0b-\x1f\x7f]", text):
            raise AssertionError(f"control characters in {text[:200]!r}")


def kept(value: Any, load: Callable[[Path], Any], folder: Path) -> None:
    """Save it, read it, save it again: the same bytes."""
    with must():
        shown(value)
        first, second = folder / "kept-1.json", folder / "kept-2.json"
        value.save(first)
        load(first).save(second)
    if first.read_bytes() != second.read_bytes():
        raise AssertionError("saved, read and saved again it is another file")


def finite(values: Any) -> None:
    if not np.isfinite(np.asarray(values, dtype=np.float64)).all():
        raise AssertionError("numbers that are not finite, without a word")


def command(declined: list[str], *arguments: object) -> None:
    """One command, in this process: exit code 0 or 2."""
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try:
            code = cli.main([str(a) for a in arguments])
        except SystemExit as error:
            code = error.code
    if code not in (0, 2) or "Traceback" in err.getvalue():
        raise AssertionError(f"{arguments[0]} ended with {code}: {err.getvalue()[-2000:]}")
    (out.getvalue() + err.getvalue()).encode()
    if code == 2:
        declined.append(f"{arguments[0]}: {err.getvalue().strip()[-300:]}")


def use_model(path: Path, folder: Path, declined: list[str], *, commands: bool) -> None:
    model = sewfast.load_model(path)
    kept(model, sewfast.load_model, folder)
    with must():
        _ = model.orders, model.parameters, model.theta, model.state_names, model.noise
        _ = model.parameter_names, model.rest, model.columns, model.signature
    n = 150
    u = levels(n, 2, len(model.input_names))
    with may("simulate", declined):
        y = model.simulate(u)
        finite(y)
    noise = np.random.default_rng(0).normal(size=n)
    y = 3.0 * u[:, 0] + noise
    with may("data", declined):
        data = sewfast.Dataset.from_arrays(
            u, y, model.Ts, input_names=model.input_names, input_units=model.input_units,
            output_name=model.output_name, output_unit=model.output_unit,
        )  # fmt: skip
        with may("validate", declined):
            shown(model.validate(data))
        with may("check", declined):
            shown(model.check(data))
        with may("linearise", declined):
            shown(model.linearise())
    with may("run", declined):
        gains = sewfast.Gains.standard(
            0.01, 0.5, u_unit=model.input_units[0] or "V", y_unit=model.output_unit or "RPM"
        )
        pid = sewfast.Controller(gains, Ts=model.Ts, u_min=-5, u_max=5)
        shown(sewfast.run(pid, model, np.repeat([0.0, 5.0], 30)))
    with may("deploy", declined):
        shown(sewfast.deploy(model, folder / "code"))
    if commands:
        record = folder / "record.csv"
        names = ["c0", "c1", "c2"][: u.shape[1]]
        columns = {"t": 0.01 * np.arange(n), **dict(zip(names, u.T, strict=False)), "y": y}
        sewfast.write_table(record, columns)
        roles = [a for name in names for a in ("--input", name)] + ["--output", "y"]
        for name in ("simulate", "check", "validate"):
            command(declined, name, path, record, *roles)
        command(declined, "deploy", path, folder / "code2")
        command(declined, "check", path, record, "--json", *roles)


def use_controller(path: Path, folder: Path, declined: list[str], *, commands: bool) -> None:
    controller = sewfast.load_controller(path)
    kept(controller, sewfast.load_controller, folder)
    core = controller.core()
    finite([core.step(5.0, 0.1 * k, 0.0) for k in range(30)])
    with may("run", declined):
        u_unit, y_unit = controller.u_unit, controller.y_unit
        plant = sewfast.LinearOE.from_tf(
            [0.0, 1.0], [1.0, -0.9], controller.Ts, input_units=[u_unit], output_unit=y_unit
        )
        shown(sewfast.run(controller, plant, np.repeat([0.0, 5.0], 30)))
        with may("margins", declined):
            shown(sewfast.margins(controller, plant))
    with may("deploy", declined):
        shown(sewfast.deploy(controller, folder / "code"))
    with may("structured text", declined):
        shown(sewfast.deploy(controller, folder / "plc", to="st"))
    if commands:
        command(declined, "run", path, "virtual", "--reference", "step", "-o", folder / "run.csv")
        command(declined, "deploy", path, folder / "code2")
        command(declined, "analyse", path, "virtual", "--seconds", "0.2")


def use_motor(path: Path, folder: Path, declined: list[str], *, commands: bool) -> None:
    if '"sewfast-equations"' in path.read_bytes().decode("utf-8", "replace"):
        fit = load_equations(path)
        kept(fit, load_equations, folder)
        with may("simulate", declined):
            own = fit.with_equations(turning)
            finite(own.simulate(levels(20, 2, 1)[:, 0]))
        return
    motor = sewfast.load_motor(path)
    kept(motor, sewfast.load_motor, folder)
    with may("simulate", declined):
        finite(motor.simulate(levels(60, 2, 1)[:, 0]))
    with may("model", declined):
        kept(motor.to_model(), sewfast.load_model, folder)
    with may("machine", declined):
        shown(motor.machine())
    with may("load", declined):
        finite(motor.turn_load(np.arange(5.0)))
    for target in ("wpilib", "mujoco", "urdf", "odrive", "moteus", "simplefoc"):
        with may(f"export {target}", declined):
            motor.export(target, winding="line").encode()
    with may("plot", declined):
        motor.plot(file=folder / "motor.svg")


def use_response(path: Path, folder: Path, declined: list[str], *, commands: bool) -> None:
    gains = sewfast.Gains.standard(0.01, 0.5)
    if b'"sewfast-frequency-responses"' in path.read_bytes():
        several = sewfast.load_responses(path)
        kept(several, sewfast.load_responses, folder)
        responses = list(several)
        with must():
            _ = several.fits
        if commands:
            with may("plot", declined):
                several.plot(file=folder / "responses.svg")
    else:
        responses = [sewfast.load_response(path)]
        kept(responses[0], sewfast.load_response, folder)
    for one in responses:
        finite(one.radius())
        finite(one.magnitude_db)
        finite(one.phase_deg)
        finite([abs(one.at(float(one.hertz[0])))])
        pid = sewfast.Controller(gains, Ts=one.Ts)
        with may("margins", declined):
            shown(one.margins(pid))
        if commands:
            with may("plot", declined):
                one.plot(file=folder / "response.svg")
    if commands and len(responses) == 1:
        command(declined, "bode", path)


def use_table(path: Path, folder: Path, declined: list[str], *, commands: bool) -> None:
    table = sewfast.read_table(path)
    with must():
        shown(table)
    with may("read", declined):
        data = sewfast.read(path)
        with must():
            shown(data)
        with may("diagnose", declined):
            shown(sewfast.diagnose(data))
        with may("identify", declined):
            model = sewfast.identify(data, model="oe", na=1, nb=1, nk=1)
            kept(model, sewfast.load_model, folder)
    if commands:
        command(declined, "look", path)
        command(declined, "identify", path, "--model", "arx", "-o", folder / "model.json")


def use_recording(path: Path, folder: Path, declined: list[str], *, commands: bool) -> None:
    found = read_recording(path)
    with must():
        shown(found)
        found.summary.encode()
    with may("read", declined):
        shown(sewfast.read(path, inputs="u", output="y"))
    with may("export", declined):
        out = folder / "again.mcap"
        out.unlink(missing_ok=True)
        exported(path, out)
        read_recording(out)
    if commands:
        command(declined, "show", path)
        command(declined, "export", path, "-o", folder / "x.csv", "--overwrite")
        command(declined, "look", path, "--input", "u", "--output", "y")


def use_project(path: Path, folder: Path, declined: list[str], *, commands: bool) -> None:
    project.load(path)
    before = Path.cwd()
    os.chdir(path.parent)
    try:
        if not Path("run.csv").exists():
            shutil.copy(make_tables(Path.cwd())[0], "run.csv")
        command(declined, "look", "run.csv")
        if commands:
            command(declined, "identify", "run.csv", "--model", "arx", "-o", "m.json")
            command(declined, "tune", "m.json", "--evaluations", "4", "-o", "c.json")
            command(declined, "stop")
    finally:
        os.chdir(before)


def use_commissioning(path: Path, folder: Path, declined: list[str], *, commands: bool) -> None:
    report(path.parent)
    if commands:
        command(declined, "report", path.parent)


def use_fleet(path: Path, folder: Path, declined: list[str], *, commands: bool) -> None:
    fleet = load_fleet(path)
    with must():
        shown(fleet)
        first, second = folder / f"kept-1{path.suffix}", folder / f"kept-2{path.suffix}"
        fleet.save(first)
        load_fleet(first).save(second)
    if first.read_bytes() != second.read_bytes():
        raise AssertionError("saved, read and saved again it is another file")
    with may("columns", declined):
        fleet.columns()
    if commands:
        with may("plot", declined):
            fleet.plot(file=folder / "fleet.svg")


# --- The bench ------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Format:
    make: Callable[[Path], list[Path]]
    change: Callable[[bytes, np.random.Generator], bytes]
    use: Callable[..., None]
    beside: bool = False
    """Whether it is read together with the other files of its folder."""


FORMATS = {
    "model": Format(make_models, changed_json, use_model),
    "controller": Format(make_controllers, changed_json, use_controller),
    "motor": Format(make_motors, changed_json, use_motor),
    "response": Format(make_responses, changed_json, use_response),
    "recording": Format(make_recordings, changed_recording, use_recording),
    "table": Format(make_tables, changed_table, use_table),
    "project": Format(make_projects, changed_settings, use_project, beside=True),
    "commissioning": Format(make_commissionings, changed_json, use_commissioning, beside=True),
    "fleet": Format(
        make_fleets,
        lambda c, rng: changed_json(c, rng) if c[:1] == b"{" else changed_table(c, rng),
        use_fleet,
    ),
}


@functools.cache
def originals(name: str, folder: Path) -> tuple[tuple[Path, bytes], ...]:
    folder.mkdir(parents=True, exist_ok=True)
    return tuple((path, path.read_bytes()) for path in FORMATS[name].make(folder))


def mutated(name: str, folder: Path, seed: int, k: int) -> Path:
    """File `k` of a seed."""
    rng = np.random.default_rng([seed, sorted(FORMATS).index(name), k])
    found = originals(name, folder)
    path, content = found[k % len(found)]
    changed = FORMATS[name].change(content, rng)
    if FORMATS[name].beside:
        for other, whole in found:
            other.write_bytes(whole)
    else:
        path = path.with_name(f"mutated{path.suffix}")
    path.write_bytes(changed)
    return path


def outcome(name: str, folder: Path, seed: int, k: int) -> tuple[str, str]:
    """What became of one file, and why."""
    path = mutated(name, folder, seed, k)
    declined: list[str] = []
    works = folder / "works"
    works.mkdir(exist_ok=True)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        # a unit in letters that the fonts of this computer have not
        warnings.filterwarnings("ignore", "Glyph")
        try:
            FORMATS[name].use(path, works, declined, commands=k // 15 % COMMANDS == 0)
        except SewfastError as error:
            if not str(error).strip() or "\n" in str(error)[:60]:
                return "WRONG", f"no words: {error!r}"
            return "refused", f"{type(error).__name__}: {error}"
        except Useless as error:
            return "USELESS", "".join(traceback.format_exception(error))
        except Warning:
            return "WARNED", traceback.format_exc()
        except MemoryError:
            return "MEMORY", traceback.format_exc()
        except BaseException:
            return "WRONG", traceback.format_exc()
    return ("declined", "\n".join(declined)) if declined else ("used", "")


def tried(
    name: str, folder: Path, seed: int, indices: Sequence[int]
) -> Iterator[tuple[int, str, str, float]]:
    """Outcomes of files and processor time [s], in forks; one that hangs or dies is replaced."""
    originals(name, folder)
    todo = list(indices)
    while todo:
        read, write = os.pipe()
        child = os.fork()
        if child == 0:
            os.close(read)
            _serve(name, folder, seed, todo, write)
        os.close(write)
        buffer = b""
        while todo:
            used, ready = -1, []
            while not ready and (now := _ticks(child)) > used:
                used = now
                ready, _, _ = select.select([read], [], [], SILENCE)
            part = os.read(read, 1 << 16) if ready else b""
            if not part:
                break
            *lines, buffer = (buffer + part).split(b"\n")
            for line in lines:
                k, result, why, seconds = json.loads(line)
                todo.remove(k)
                yield k, result, why, seconds
        os.close(read)
        if todo:
            os.kill(child, signal.SIGKILL)
        status = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
        if todo:
            hung = not ready or status == -signal.SIGXCPU
            limit = f"{PATIENCE} s of processor" if ready else f"idle for {SILENCE:g} s"
            why = limit if hung else f"the process ended with {status}"
            yield todo.pop(0), "HANG" if hung else "CRASH", why, PATIENCE


def _ticks(child: int) -> int:
    """Processor time that a process has used; 0 where the system does not say."""
    try:
        fields = Path(f"/proc/{child}/stat").read_text().rpartition(")")[2].split()
    except OSError:
        return 0
    return int(fields[11]) + int(fields[12])


def _serve(name: str, folder: Path, seed: int, indices: Sequence[int], write: int) -> None:
    """In the fork; it does not return."""
    with contextlib.suppress(OSError, ValueError):
        size = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
        resource.setrlimit(resource.RLIMIT_AS, (size + MEMORY, size + MEMORY))
    nothing = os.open(os.devnull, os.O_RDWR)
    if not os.environ.get("MUTATIONS_LOUD"):
        os.dup2(nothing, 1)
        os.dup2(nothing, 2)
    try:
        for k in indices:
            before = time.process_time()
            resource.setrlimit(resource.RLIMIT_CPU, (math.ceil(before) + PATIENCE, -1))
            found = outcome(name, folder, seed, k)
            line = json.dumps([k, *found, time.process_time() - before]) + "\n"
            os.write(write, line.encode())
    finally:
        os._exit(0)


def bench(name: str, folder: Path, seed: int, indices: Sequence[int], words: int) -> Counter[str]:
    """Outcomes of one format, and what was wrong, printed."""
    counts: Counter[str] = Counter()
    roots: dict[str, list[int]] = {}
    declined: Counter[str] = Counter()
    slowest = (0.0, 0)
    for k, result, why, seconds in tried(name, folder, seed, indices):
        counts[result] += 1
        slowest = max(slowest, (seconds, k))
        if result == "declined":
            for line in why.split("\n"):
                declined[re.sub(r"[-\d.e+]+", "#", line)[:150]] += 1
        elif result not in GOOD:
            roots.setdefault(f"{result} {_root(why)}", []).append(k)
    longest = f"slowest {slowest[0]:.2g} s of processor [{slowest[1]}]"
    print(f"{name}: {sum(counts.values())} files, {dict(counts)}; {longest}", flush=True)
    for root, ks in sorted(roots.items(), key=lambda r: -len(r[1])):
        print(f"  {len(ks):4d} {root}  [{', '.join(map(str, ks[:6]))}]")
    for text, count in declined.most_common(words):
        print(f"  {count:4d} {text}")
    sys.stdout.flush()
    return counts


def _root(why: str) -> str:
    """The line of sewfast at which it went wrong, with the error."""
    frames = re.findall(r'sewfast/(\S+)", line (\d+)', why)
    last = [line for line in why.strip().splitlines() if line.strip()]
    at = ":".join(frames[-1]) if frames else ""
    return f"{at} {last[-1][:160] if last else ''}"


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--count", type=int, default=1000, help="files of each format (1000)")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--formats", nargs="*", default=list(FORMATS), choices=list(FORMATS))
    parser.add_argument("--declined", type=int, default=0, help="most frequent words to print")
    parser.add_argument("--replay", type=int, help="only this file; it is kept")
    args = parser.parse_args()
    if args.replay is not None:
        folder = Path(tempfile.mkdtemp(prefix="mutated-"))
        print(mutated(args.formats[0], folder, args.seed, args.replay))
        print(*outcome(args.formats[0], folder, args.seed, args.replay))
        return 0
    wrong = 0
    with tempfile.TemporaryDirectory() as place:
        for name in args.formats:
            counts = bench(name, Path(place) / name, args.seed, range(args.count), args.declined)
            wrong += sum(n for result, n in counts.items() if result not in GOOD)
    print(f"traceback, hang, or loads and cannot be used: {wrong} (seed {args.seed})")
    return int(wrong > 0)


if __name__ == "__main__":
    sys.exit(main())
