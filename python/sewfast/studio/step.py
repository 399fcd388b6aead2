"""`Step`: a step on a recording, and its copies for a script and for a shell."""

from __future__ import annotations

import shlex
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from ..errors import DataError, SettingError
from ..kinds import KINDS, Kind
from .commissioning import require

if TYPE_CHECKING:
    from ..readers import Table

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

    @classmethod
    def parse(cls, asked: dict[str, Any]) -> Step:
        """A step from a message.

        Raises
        ------
        SettingError
            For a value of the wrong type.
        """
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
        seed = 0 if seed is None else seed
        whole = isinstance(seed, int) and not isinstance(seed, bool) and 0 <= seed < 2**32
        require(whole, "seed", "a whole number from 0", seed)
        return cls(
            asked["file"], tuple(inputs), output or None, resample, model, seed, counts or None,
            asked.get("counts_per_rev"), asked.get("Ts"),
        )  # fmt: skip

    def columns(self, table: Table, reference: str | None = None) -> dict[str, Any]:
        """Arguments of `sewfast.read`, with the references, as on the command line.

        Raises
        ------
        SettingError, DataError
            If input or output are missing.
        """
        from ..dataset import is_reference

        if not self.inputs:
            raise SettingError(f"{self.file}: expected an input, received none; choose a column")
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
            raise DataError(f"{self.file}: expected an output, received none; choose a column")
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

    Parameters
    ----------
    step : Step
    name : str
        ``look``, ``identify``, ``validate`` or ``bode``.
    columns : dict
        Arguments of `sewfast.read`.
    reference, segment
        For ``bode``.
    """
    read = ", ".join([repr(step.file), *(f"{k}={v!r}" for k, v in columns.items())])
    lines = ["import sewfast", "", f"data = sewfast.read({read})"]
    if name == "bode" and step.output is None:
        lines.insert(1, "from sewfast.commissioning import unsmoothed")
        lines.append(f"data = unsmoothed({step.file!r}, data)")
    if step.resample is not None:
        lines.append(f"data = data.resample({step.resample!r})")
    if name == "look":
        lines.append("print(data.summary())")
    elif name == "bode":
        call = f"sewfast.bode(data, reference={reference!r}, segment={segment!r})"
        lines += [f"response = {call}", f"response.save({RESPONSE!r})", "print(response)"]
    elif name == "identify":
        call = f"sewfast.identify(data, model={step.model!r}, seed={step.seed})"
        lines += [f"model = {call}", f"model.save({MODEL!r})", "print(model)"]
    else:
        lines.append(f"model = sewfast.load_model({MODEL!r})")
        lines += ["print(sewfast.validate(model, data))", "print(sewfast.check(model, data))"]
    return "\n".join(lines) + "\n"


def commands(
    step: Step, name: str, columns: dict[str, Any], reference: str | None, segment: int | None
) -> str:
    """The same for a shell in the project folder."""
    file = f"./{step.file}" if step.file.startswith("-") else step.file
    options = [f"--input={c}" for c in columns["inputs"]]
    if "counts" in columns:
        options.append(f"--counts={columns['counts']}")
        options.append(f"--counts-per-rev={columns['counts_per_rev']!r}")
    else:
        options.append(f"--output={columns['output']}")
    if step.Ts is not None:
        options.append(f"--ts={step.Ts!r}")
    if step.resample is not None:
        options.append(f"--resample={step.resample!r}")
    kind = [f"--model={step.model.replace('_', '-')}", f"--seed={step.seed}", "-o", MODEL]
    more = [] if reference is None else [f"--reference={reference}"]
    more += [] if segment is None else [f"--segment={segment}"]
    rows = {
        "bode": [["bode", file, *options, *more, "-o", RESPONSE]],
        "look": [["look", file, *options]],
        "identify": [["identify", file, *options, *kind]],
        "validate": [[c, MODEL, file, *options] for c in ("validate", "check")],
    }[name]
    return "".join(shlex.join(["sewfast", *row]) + "\n" for row in rows)
