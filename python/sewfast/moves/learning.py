"""`learn`: repeat a known move on a machine and improve its table from repetition to repetition."""

from __future__ import annotations

import math
import os
import threading
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from .. import _core
from ..arrays import FloatArray, bridged
from ..control.benches import guarded, machine_of
from ..control.loop import Plants, common_rest, cores_about
from ..control.machine import Machine, RecordedRun, cancelled_by, is_streaming
from ..control.move import MoveTable, Repetition, repetition_lines, table_of
from ..errors import DataError, Interrupted, SettingError
from ..gains import whole
from ..machine import VirtualMachine
from ..recording import Recording
from ..speed import speed_from_counts
from ..tables import Shown
from ..threads import available
from .planning import plants_of

VARIATIONS = ((1.0, 0), (0.8, 0), (1.25, 0), (1.0, 1))
"""Gain and further delay [samples] of each model for which learning must converge, too."""


@dataclass(frozen=True, eq=False)
class Learned(Shown):
    """What repetitions on a machine have brought.

    Attributes
    ----------
    table : MoveTable
        The best so far, with all `repetitions`.
    first, best : RecordedRun or None
        The first run of this call and the best one.
    cutoff : float
        Swings up to this frequency are learned; above it the models part [Hz].
    contraction : float
        By what the change of the table shrinks from repetition to repetition, the worst over the
        models and their variations; below 1.
    reason : str
        Why it ended: ``repetitions``, ``noise`` (what is left does not repeat) or ``converged``
        (no further gain is expected).
    """

    table: MoveTable
    first: RecordedRun | None
    best: RecordedRun | None
    cutoff: float
    contraction: float
    reason: str

    @property
    def repetitions(self) -> tuple[Repetition, ...]:
        """All repetitions of the table."""
        return self.table.repetitions

    def to_json(self) -> dict[str, Any]:
        return {
            "name": self.table.name, "unit": self.table.units["y"], "reason": self.reason,
            "cutoff": self.cutoff, "contraction": self.contraction,
            "repetitions": [one.to_dict() for one in self.repetitions],
        }  # fmt: skip

    def plot(self, ax: Any = None, *, file: str | os.PathLike[str] | None = None) -> Any:
        """Draw the best run over the first one: output, error and command in three panels."""
        if self.first is None or self.best is None:
            raise DataError(
                name="plot", expected="at least one whole repetition", received="none",
                remedy="repeat the move first",
            )  # fmt: skip
        return self.best.plot(ax, others=[self.first], file=file)

    def __str__(self) -> str:
        unit = self.table.units["y"] or "y"
        lines = [f"{self.table.name}, learned up to {self.cutoff:.3g} Hz; ended by: {self.reason}"]
        lines += [f"  {line}" for line in repetition_lines(self.repetitions, unit)]
        return "\n".join(lines)


@dataclass(frozen=True, eq=False)
class _Played:
    """A correction, the run with it, and its error."""

    correction: FloatArray
    run: RecordedRun
    error: FloatArray

    @property
    def rms(self) -> float:
        return _rms(self.error)


def learn(
    table: MoveTable,
    models: Plants,
    on: VirtualMachine | Machine,
    *,
    repetitions: int = 8,
    file: str | os.PathLike[str] | None = None,
    threads: int | None = None,
    progress: Callable[[int, int, str], object] | None = None,
    cancel: threading.Event | None = None,
) -> Learned:
    """Repeat a known move on a machine and improve its table.

    Before the machine moves, learning is rehearsed on every model, also with gains of .8 and 1.25
    and one more sample of delay, and must converge monotonously there. A repetition that is worse
    than the best is undone: the best is played again, which shows whether the table or the machine
    has changed.

    Parameters
    ----------
    table : MoveTable
        From `plan`, or one that was learned on before.
    models : Model or sequence of them
        Those of the plan.
    on : VirtualMachine, Drive or another Machine
        It begins each repetition at rest. What is measured counts, not the true speed of a virtual
        machine.
    repetitions : int
        In this call, at most.
    file : path, optional
        Where the best table so far is written after every repetition.
    threads : int, optional
        By default all that are available; the result does not depend on it.
    progress : callable, optional
        Called with repetitions done, repetitions in all and a text.
    cancel : threading.Event, optional
        Set it in another thread to end as Ctrl-C does.

    Returns
    -------
    Learned

    Raises
    ------
    SettingError
        If the models or the machine do not fit the table.
    FitError
        If learning would not converge on the models.
    LinkError
        If the port or the drive failed or tripped; the motor is stopped, and `file` has the best
        table so far.
    Interrupted
        On Ctrl-C or `cancel`; the motor is stopped, `best` is the `Learned` so far.

    References
    ----------
    D. A. Bristow, M. Tharayil, A. G. Alleyne, A survey of iterative learning control, IEEE Control
    Systems Magazine 26 (2006) 96-114.
    """
    controller = table_of(table).controller
    plants = plants_of(controller, models)
    total = whole("repetitions", repetitions)
    if total < 1:
        raise SettingError(
            name="repetitions", expected="1 or more", received=f"{repetitions}",
            remedy="sewfast run --table plays a table once without learning",
        )  # fmt: skip
    machine = guarded(machine_of(on))
    if not math.isclose(machine.Ts, table.Ts, rel_tol=0.01):
        raise SettingError(
            name="on", expected=f"a machine at the table's sample time of {table.Ts} s",
            received=f"{machine.Ts} s", remedy="plan the move again with a controller for it",
        )  # fmt: skip
    rest = common_rest(plants)
    learner = _core.MoveLearner(
        cores_about(rest, plants), controller.about(rest).core(), table.reference - rest.y,
        table.planned - rest.y, variations=list(VARIATIONS),
        counted=controller.counts_per_unit > 0.0,
        threads=whole("threads", available() if threads is None else threads),
    )  # fmt: skip
    learning = _Learning(table, learner, machine, file, cancel)
    if file is not None:
        table.save(file)  # the first repetition may trip
    for done in range(total):
        try:
            if progress is not None:
                progress(done, total, learning.status)
            is_over = learning.repeat()
        except KeyboardInterrupt as stop:  # of which an `Interrupted` run is one
            raise Interrupted(learning.result("interrupted")) from stop
        if is_over:
            break
    return learning.result(learning.reason or "repetitions")


class _Learning:
    """The state between repetitions: the best so far and what is played next."""

    def __init__(
        self, table: MoveTable, learner: _core.MoveLearner, machine: Machine, file: Any,
        cancel: threading.Event | None,
    ) -> None:  # fmt: skip
        self.table, self.learner, self.machine = table, learner, machine
        self.file, self.cancel = file, cancel
        known = table.correction
        if len(known) not in (0, learner.size):
            raise DataError(
                name="table", expected=f"a correction of {learner.size} numbers, or none",
                received=f"{len(known)}", remedy="plan the move again",
            )  # fmt: skip
        self.next = known if len(known) else np.zeros(learner.size)
        self.predicted: float | None = None
        self.first: _Played | None = None
        self.best: _Played | None = None
        self.gain, self.reason = 1.0, ""
        bends = [np.var(np.diff(x, 2)) for x in (table.reference, table.y) if len(x) > 2]
        self.jerk = float(max(bends, default=0.0)) / table.Ts**3
        self.undone: _Played | None = None
        """The last repetition, if it was worse than the best, which is then played again."""
        self.noise: FloatArray | None = None
        """Difference of two repetitions with one table: what does not repeat, times root 2."""

    @property
    def status(self) -> str:
        unit = self.table.units["y"]
        return "first repetition" if self.best is None else f"error {self.best.rms:.4g} {unit}"

    def result(self, reason: str) -> Learned:
        best = self.best
        cutoff = 1.0 / (self.learner.period * self.table.Ts)
        first, last = (None if p is None else p.run for p in (self.first, best))
        return Learned(self.table, first, last, cutoff, self.learner.contraction, reason)

    def repeat(self) -> bool:
        """Play the next table, and decide on the one after it; True if there is none."""
        played = self._play(self.next)
        outcome, best = self._verdict(played), self.best
        assert best is not None
        number = len(self.table.repetitions) + 1
        largest = float(np.max(np.abs(played.error)))
        found = Repetition(number, played.rms, largest, self.predicted, outcome)
        setpoint = self.table.planned + self.learner.signal(best.correction)
        done = (*self.table.repetitions, found)
        self.table = replace(
            self.table, setpoint=setpoint, correction=best.correction, repetitions=done
        )
        if self.file is not None:
            self.table.save(self.file)
        if self.undone is not None:
            self.next, self.predicted = best.correction, best.rms
            return False
        return self._decide(best)

    def _play(self, correction: FloatArray) -> _Played:
        table = self.table
        setpoint = table.planned + self.learner.signal(correction)
        options = cancelled_by(self.cancel) if is_streaming(self.machine) else {}
        if self.cancel is not None and self.cancel.is_set():
            raise KeyboardInterrupt
        run = self.machine.follow(table.controller, setpoint, table.name, **options)
        y = self._measured(run.recording)
        if len(y) != len(setpoint) or not np.isfinite(y).any():
            raise DataError(
                name=self.machine.name, expected=f"a run of {len(setpoint)} samples",
                received=f"{np.isfinite(y).sum()}", remedy="repeat the move",
            )  # fmt: skip
        # samples that a link lost have the error of those beside them
        error = bridged(table.reference - y)
        return _Played(correction, replace(run, r=table.reference.copy()), error)

    def _measured(self, recording: Recording) -> FloatArray:
        """The speed from the counts [RPM], by a smoother that is the same for all repetitions: it
        expects the jerk of the move, where that of a recording estimates it, and ripple, anew.
        """
        if not (self.jerk > 0.0 and np.isfinite(recording.counts).any()):
            return recording.y
        return speed_from_counts(
            bridged(recording.counts), self.table.Ts, recording.counts_per_rev,
            process_noise=self.jerk, ripple_orders=(),
        )  # fmt: skip

    def _verdict(self, played: _Played) -> str:
        """What a repetition was: the best so far, undone, or the best played again."""
        undone, self.undone = self.undone, None
        if self.best is None:
            self.first = self.best = played
            return "first"
        if undone is not None:
            apart = played.error - self.best.error
            # if the best is farther from what it was than from the undone one, the machine has
            # changed; otherwise the table was at fault, or noise
            if _rms(apart) < _rms(played.error - undone.error):
                self.gain, self.noise = self.gain / 2.0, apart
            self.best = played
            return "repeated"
        if played.rms < self.best.rms:
            self.best = played
            return "better"
        self.undone = played
        return "undone"

    def _decide(self, best: _Played) -> bool:
        """Work out the next table; True if nothing more is to be gained."""
        self.next, left = self.learner.next(best.correction, best.error, self.gain)
        self.predicted = _rms(left)
        learnable = _rms(best.error - left)
        if self.noise is not None:
            _, rest = self.learner.next(best.correction * 0.0, self.noise, self.gain)
            if learnable <= _rms(self.noise - rest) / math.sqrt(2.0):
                self.reason = "noise"
        if self.predicted >= 0.99 * best.rms:
            self.reason = self.reason or "converged"
        return bool(self.reason)


def _rms(x: FloatArray) -> float:
    return float(np.sqrt(np.mean(np.square(x))))
