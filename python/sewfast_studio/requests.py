"""A page's requests: `Step` on a recording, copied as a script or for a shell; `Commission`."""

from __future__ import annotations

import os
import re
import shlex
import threading
from collections.abc import Callable, Iterable
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from sewfast.errors import DataError, SettingError, SewfastError
from sewfast.kinds import KINDS, Kind

if TYPE_CHECKING:
    from sewfast.commissioning import Commissioning
    from sewfast.commissioning.verification import Comparison
    from sewfast.dataset import Dataset, FloatArray
    from sewfast.readers import Table

MODEL = "model.json"
RESPONSE = "response.json"


@dataclass(frozen=True)
class Step:
    """A page's request to read and use a recording.

    Parameters
    ----------
    file : str
        Name of a recording in the project folder.
    inputs : tuple of str
    output : str or None
        None for the speed from the recording's encoder counts.
    counts : str or None
        Column of encoder counts, from which the speed is computed without an output.
    counts_per_rev : float or None
        Counts of one turn; a recording of the package contains them.
    Ts : float or None
        Sample time of a recording without a time column [s].
    resample : float or None
        Sample time to work at [s]; None for the recording's own.
    model : str
        Kind of model to identify.
    seed : int
    mask : tuple of str
        Outputs to leave out: ranges of samples ``A:B``, or ``outliers``.
    shift : int
        Samples by which the inputs were logged late.
    hold : bool
        Whether a missing input is the last known one.
    model_file : str
        The file that `identify` writes and `validate` reads.
    replace : bool
        Whether `identify` may replace a model of that name.
    """

    file: str
    inputs: tuple[str, ...] = ()
    output: str | None = None
    resample: float | None = None
    model: Kind = "auto"
    seed: int = 0
    counts: str | None = None
    counts_per_rev: float | None = None
    Ts: float | None = None
    mask: tuple[str, ...] = ()
    shift: int = 0
    hold: bool = False
    model_file: str = MODEL
    replace: bool = False

    @classmethod
    def parse(cls, asked: dict[str, Any]) -> Step:
        """A step from a message. Raises `SettingError` for a value of the wrong type."""
        inputs, output = asked.get("inputs", []), asked.get("output")
        resample, model, seed = asked.get("resample"), asked.get("model", "auto"), asked.get("seed")
        require(isinstance(asked.get("file"), str), "file", "a name", asked.get("file"))
        named = isinstance(inputs, list) and all(isinstance(name, str) for name in inputs)
        require(named, "inputs", "a list of column names", inputs)
        require(output is None or isinstance(output, str), "output", "a column or null", output)
        for name in ("resample", "Ts", "counts_per_rev"):
            value = asked.get(name)
            number = isinstance(value, (int, float)) and not isinstance(value, bool)
            require(value is None or number, name, "a number or null", value)
        counts = asked.get("counts")
        require(counts is None or isinstance(counts, str), "counts", "a column or null", counts)
        require(model in KINDS, "model", f"one of {', '.join(KINDS)}", model)
        mask = asked.get("mask") or ""
        require(isinstance(mask, str), "mask", "ranges such as 100:120, or outliers", mask)
        seed = 0 if seed is None else seed
        whole = isinstance(seed, int) and not isinstance(seed, bool) and 0 <= seed < 2**32
        require(whole, "seed", "a whole number from 0", seed)
        return cls(
            asked["file"], tuple(inputs), output or None, resample, model, seed, counts or None,
            asked.get("counts_per_rev"), asked.get("Ts"), tuple(re.split(r"[\s,;]+", mask.strip()))
            if mask.strip() else (), asked.get("shift") or 0, bool(asked.get("hold")),
            asked.get("model_file") or MODEL, bool(asked.get("replace")),
        )  # fmt: skip

    def changed(self, data: Dataset) -> Dataset:
        """The data as this step uses them; `_changes` are the same calls."""
        data = data.shift_inputs(self.shift) if self.shift else data
        for span in self.mask:
            try:
                data = data.mask(data.mark_outliers() if span == "outliers" else span)
            except SewfastError as error:
                raise SettingError(f"mask: {error}") from None
        data = data.fill_inputs("hold") if self.hold else data
        return data if self.resample is None else data.resample(self.resample)

    def columns(self, table: Table, reference: str | None = None) -> dict[str, Any]:
        """Arguments of `sewfast.read`, with the references, as on the command line. Raises
        `SettingError` or `DataError` if input or output are missing.
        """
        from sewfast.dataset import is_reference

        if not self.inputs:
            raise SettingError("inputs: expected a column, received none; choose one")
        columns: dict[str, Any] = {"inputs": list(self.inputs)}
        per_rev = self.counts_per_rev or table.counts_per_rev
        counts = self.counts or "counts"
        if self.output is not None:
            columns["output"] = self.output
        elif per_rev is not None:
            columns |= {"counts": counts, "counts_per_rev": per_rev}
        elif self.counts is not None:
            raise SettingError(
                f"{self.file}: expected the encoder counts of one turn, received none; give them"
            )
        else:
            raise DataError("output: expected a column, received none; choose one")
        if self.Ts is not None:
            columns["Ts"] = self.Ts
        used = {table.resolve(n) for n in (*self.inputs, self.output or counts)}
        references = [n for n in table.names if is_reference(n) and n not in used]
        lengths = {len(table[n]) for n in used}
        references = [n for n in references if {len(table[n])} == lengths]
        if reference is not None and table.resolve(reference) not in references:
            references.append(table.resolve(reference))
        return columns | ({"channels": references} if references else {})


def script(
    step: Step, name: str, columns: dict[str, Any], reference: str | None, segment: int | None
) -> str:
    """Python that repeats a step, to run in the project folder.
    `name` is ``look``, ``identify``, ``validate`` or ``bode``; `columns` are arguments of
    `sewfast.read`; `reference` and `segment` are for ``bode``.
    """
    read = ", ".join([repr(step.file), *(f"{k}={v!r}" for k, v in columns.items())])
    lines = ["import sewfast", "", f"data = sewfast.read({read})"]
    if name == "bode" and (step.output is None or columns.get("output") == "y"):
        lines.insert(1, "from sewfast.commissioning import unsmoothed")
        lines.append(f"data = unsmoothed({step.file!r}, data)")
    lines += _changes(step)
    if name == "look":
        lines.append("print(data.summary())")
    elif name == "bode":
        call = f"sewfast.bode(data, reference={reference!r}, segment={segment!r})"
        lines += [f"response = {call}", f"response.save({RESPONSE!r})", "print(response)"]
    elif name == "identify":
        call = f"sewfast.identify(data, model={step.model!r}, seed={step.seed})"
        lines += [f"model = {call}", f"model.save({step.model_file!r})", "print(model)"]
    else:
        lines.append(f"model = sewfast.load_model({step.model_file!r})")
        lines += ["print(sewfast.validate(model, data))", "print(sewfast.check(model, data))"]
    return "\n".join(lines) + "\n"


def _changes(step: Step) -> list[str]:
    """`Step.changed` as Python."""
    calls = [f"shift_inputs({step.shift})"] if step.shift else []
    for span in step.mask:
        calls.append(f"mask({'data.mark_outliers()' if span == 'outliers' else repr(span)})")
    calls += ["fill_inputs('hold')"] if step.hold else []
    calls += [] if step.resample is None else [f"resample({step.resample!r})"]
    return [f"data = data.{call}" for call in calls]


def commands(
    step: Step, name: str, columns: dict[str, Any], reference: str | None, segment: int | None
) -> str:
    """The same for a shell in the project folder."""
    file, model = (
        f"./{name}" if name.startswith("-") else name for name in (step.file, step.model_file)
    )
    options = [f"--input={c}" for c in columns["inputs"]]
    if "counts" in columns:
        options.append(f"--counts={columns['counts']}")
        options.append(f"--counts-per-rev={columns['counts_per_rev']!r}")
    else:
        options.append(f"--output={columns['output']}")
    if step.Ts is not None:
        options.append(f"--ts={step.Ts!r}")
    options += [f"--shift-input={step.shift}"] if step.shift else []
    options += [f"--mask={span}" for span in step.mask] + ["--hold-inputs"] * step.hold
    if step.resample is not None:
        options.append(f"--resample={step.resample!r}")
    kind = [f"--model={step.model.replace('_', '-')}", f"--seed={step.seed}", "-o", model]
    more = [] if reference is None else [f"--reference={reference}"]
    more += [] if segment is None else [f"--segment={segment}"]
    rows = {
        "bode": [["bode", file, *options, *more, "-o", RESPONSE]],
        "look": [["look", file, *options]],
        "identify": [["identify", file, *options, *kind]],
        "validate": [[c, model, file, *options] for c in ("validate", "check")],
    }[name]
    return "".join(shlex.join(["sewfast", *row]) + "\n" for row in rows)


# --- Commission: a commissioning, its result for the page, and curves to draw ---------------------


COLUMNS = 1200
"""Pairs of lowest and highest value in a drawn curve: about two a pixel of a wide window."""

COMMISSIONED = "commissioned"
"""The folder of a commissioning."""


@dataclass(frozen=True)
class Commission:
    """The virtual machine to commission, and the effort.

    Parameters
    ----------
    machine : str
        ``virtual`` or ``virtual:SEED``.
    seed, members, evaluations : int
        As for `sewfast.commission`.
    """

    machine: str = "virtual"
    seed: int = 0
    members: int = 4
    evaluations: int = 3000

    @classmethod
    def parse(cls, asked: dict[str, Any]) -> Commission:
        """From a message. Raises `SettingError` for a value out of range."""
        machine = asked.get("machine", "virtual")
        named = isinstance(machine, str) and re.fullmatch(r"virtual(:\d{1,9})?", machine)
        require(bool(named), "machine", "virtual or virtual:SEED", machine)
        numbers = {}
        for name, low, high in (
            ("seed", 0, 2**32 - 1), ("members", 1, 16), ("evaluations", 10, 20_000)
        ):  # fmt: skip
            value = asked.get(name, getattr(cls, name))
            whole = isinstance(value, int) and not isinstance(value, bool) and low <= value <= high
            require(whole, name, f"a whole number from {low} to {high}", value)
            numbers[name] = value
        return cls(str(machine), **numbers)

    def python(self) -> str:
        """A script that repeats it, to run in the project folder."""
        call = f"machine, seed={self.seed}, members={self.members}, evaluations={self.evaluations}"
        return (
            f"import sewfast\n\nmachine = sewfast.VirtualMachine.from_name({self.machine!r})\n"
            f"found = sewfast.commission({call})\nfound.save({COMMISSIONED!r})\nprint(found)\n"
        )

    def commands(self) -> str:
        """The same for a shell in the project folder."""
        effort = f"--members {self.members} --evaluations {self.evaluations} --seed {self.seed}"
        on = shlex.quote(self.machine)
        return f"sewfast commission --on {on} {effort} --out {COMMISSIONED}\n"


def carry_out(
    asked: Commission,
    on: Any,
    folder: Path,
    progress: Callable[[int, int, str], None],
    *,
    cancel: threading.Event | None = None,
    between: Callable[[str, Commissioning], object] | None = None,
    writing: Callable[[], AbstractContextManager[None]] = nullcontext,
) -> dict[str, Any]:
    """Commission a machine or a drive into the folder `commissioned`; return its result.
    Raises `Refusal` if the evidence is not good enough, and `SettingError` for a folder of that
    name with other files.
    """
    from sewfast.commissioning import commission
    from sewfast.commissioning.result import require_own

    place = folder / COMMISSIONED
    if place.is_symlink():
        raise SettingError(f"{COMMISSIONED}: expected a folder, received a link; remove it")
    require_own(place, overwrite=False)
    require_writable(folder)
    found = commission(
        on, seed=asked.seed, members=asked.members, evaluations=asked.evaluations,
        progress=progress, cancel=cancel, between=between,
    )  # fmt: skip
    with writing():
        found.save(place)
    return {
        "verdict": found.verdict,
        "text": str(found),
        "predicted_cost": found.predicted_cost,
        "measured_cost": found.measured_cost,
        "references": drawn(found.comparisons),
        "python": asked.python(),
        "commands": asked.commands(),
    }


def drawn(comparisons: Iterable[Comparison]) -> list[dict[str, Any]]:
    """Tracking errors along each reference, predicted and, if it has run, measured."""
    return [
        {
            "name": c.reference,
            "curves": [
                {"name": title, "unit": run.units["y"], **envelope(run.r - run.y, run.Ts)}
                for title, run in (("measured", c.measured), ("predicted", c.predicted))
                if run is not None
            ],
        }
        for c in comparisons
    ]


def require(ok: bool, name: str, expected: str, received: object) -> None:
    if not ok:
        raise SettingError(f"{name}: expected {expected}, received {str(received)[:80]!r}")


def require_writable(folder: Path) -> None:
    """Raise `SettingError` before work of minutes whose result could not be saved."""
    if not os.access(folder, os.W_OK | os.X_OK):
        raise SettingError(
            name=folder.name, expected="a folder that can be written to", received="a closed one",
            remedy="change its rights, or start sewfast studio in another one",
        )  # fmt: skip


def envelope(values: FloatArray, Ts: float, columns: int = COLUMNS) -> dict[str, Any]:
    """A curve to draw: every sample, or the lowest and the highest of each of `columns` pieces.
    `values` (N,) have NaN for a gap; `Ts` is in seconds. Return ``Ts``, ``n`` and ``low``,
    ``high``: lists of equal length over the whole time.
    """
    n = len(values)
    if n <= 2 * columns:
        low = high = values
    else:
        starts = np.linspace(0, n, columns, endpoint=False).astype(np.intp)
        low, high = np.fmin.reduceat(values, starts), np.fmax.reduceat(values, starts)
    return {"Ts": Ts, "n": n, "low": low.tolist(), "high": high.tolist()}
