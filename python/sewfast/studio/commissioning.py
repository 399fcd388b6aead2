"""A page's request for a commissioning, its result for the page, and curves to draw."""

from __future__ import annotations

import os
import re
import threading
from collections.abc import Callable, Iterable
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ..errors import SettingError

if TYPE_CHECKING:
    from ..commissioning import Commissioning
    from ..commissioning.verification import Comparison
    from ..dataset import FloatArray

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
        """From a message.

        Raises
        ------
        SettingError
            For a value out of range.
        """
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
        return f"sewfast commission --on {self.machine} {effort} --out {COMMISSIONED}\n"


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

    Raises
    ------
    Refusal
        If the evidence is not good enough.
    SettingError
        For a folder of that name with other files.
    """
    from ..commissioning import commission
    from ..commissioning.result import require_own

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

    Parameters
    ----------
    values : (N,) array
        NaN is a gap.
    Ts : float
        Sample time [s].
    columns : int

    Returns
    -------
    dict
        ``Ts``, ``n`` and ``low``, ``high``: lists of equal length over the whole time.
    """
    n = len(values)
    if n <= 2 * columns:
        low = high = values
    else:
        starts = np.linspace(0, n, columns, endpoint=False).astype(np.intp)
        low, high = np.fmin.reduceat(values, starts), np.fmax.reduceat(values, starts)
    return {"Ts": Ts, "n": n, "low": low.tolist(), "high": high.tolist()}
