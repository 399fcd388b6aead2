"""`commission`: an engineer's procedure for a drive, one stage after the other."""

from __future__ import annotations

import math
import os
import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from ..causes import Cause, Seen, cause_after, cause_among, turns_at_rest
from ..control.controller import Controller, SampledController
from ..control.loop import ClosedLoopRun
from ..control.machine import Machine, RecordedRun
from ..dataset import FloatArray
from ..errors import Interrupted, LinkError, SettingError
from ..machine import VirtualMachine
from ..models import Ensemble, Model
from ..progress import shown_in_notebooks
from ..recording import Recording
from ..rules import Fopdt
from ..threads import available
from ..tuning.objective import LARGEST_MS, Cost
from ..tuning.search import Loop, TuningResult
from . import excitations
from .bench import DriveBench, RecordedBench, bench_of, description_of
from .checkpoint import STAGES, Checkpoint
from .demands import Demands, Refusal, demands
from .excitations import first_motion, lost_motion, step_response
from .gains import (
    Requirements,
    cause,
    cautious,
    cost_of,
    first_gains,
    led,
    ruled,
    scaled,
    search,
    sensible,
    start_of,
)
from .journal import Journal, Progress
from .positions import Unsuited, position_loop, telling, unmet, verified_stops
from .references import References, references_of, samples_of
from .result import UNREACHED, VERIFIED, VERIFIED_POORLY, Commissioning, require_own
from .shaking import margins_at_work
from .slow import Thinning, TurnLoad, turn_load
from .small_signal import SHAKEN_AT, SmallSignal, small_signal
from .training import ORDERS, THINNED, Rival, Trained, linear_rival, train
from .verification import (
    Disagreement,
    agreeing,
    judged,
    measure,
    predict,
    require_unsaturated,
    unreached,
)

__all__ = ["STAGES", "commission"]


Between = Callable[[str, Commissioning], object]


@shown_in_notebooks("commission")
def commission(
    on: VirtualMachine | Machine,
    *,
    u_max: float | None = None,
    speed: float | None = None,
    references: References | None = None,
    practice: References | None = None,
    cost: Cost | None = None,
    members: int = 4,
    evaluations: int = 3000,
    load: float | None = None,
    Ms: float | None = LARGEST_MS,
    time_budget: float | None = None,
    loop: Loop = "speed",
    seed: int = 0,
    threads: int | None = None,
    progress: Progress | None = None,
    folder: str | os.PathLike[str] | None = None,
    overwrite: bool = False,
    resume: bool = False,
    cancel: threading.Event | None = None,
    between: Between | None = None,
) -> Commissioning:
    """Take a machine from rest to a controller that has been verified on it.

    First motion, step response, a small random command that shows delays and resonances, first
    gains by rule, pulses up to the command's limit, a closed loop under the first gains, an
    ensemble of networks from all of these, gains by search on all members with encoder, feedback
    filter, gain spread and delay in the loop, and finally the machine with these gains, compared
    with the prediction. New gains are applied to the machine in steps, and a loop that oscillates
    is ended at once. Every stage begins and ends at rest, and stops with a reason if the evidence
    is not good enough (docs/commissioning.md).

    Parameters
    ----------
    on : VirtualMachine, Drive or another Machine
        The machine; a drive's limits must have been set. It turns forward only, except for what a
        controller does at the end of a reference.
    u_max : float, optional
        Largest command in either direction [V]; the machine's own limit by default.
    speed : float, optional
        Top of the working range [RPM]: by default the largest reference, or 2,000. Plan for a
        quarter more.
    references : mapping of name to array, or sequence of names, optional
        References for the verification [RPM] at the machine's sample time; names are those of
        `sewfast.signals`. By default `sewfast.commissioning.excitations.standard`.
    practice : mapping of name to array, or sequence of names, optional
        References for tuning. By default the references above, or shorter versions of the standard
        ones.
    cost : Cost, optional
        Weights; by default 1 per RPM of tracking error, 5 per volt of chatter and
        3 per percent of overshoot beyond 1 of references with an edge, to the scale of speed and
        u_max.
    members : int
        Networks in the ensemble.
    evaluations : int
        Controllers that the search tries.
    load : float, optional
        A braking load, in volts of command [V]: no member of the ensemble may recover from it later
        under the tuned gains than under Eq. 12's, slowed down to the limit of Ms. By default a
        tenth of `u_max`; 0 for no such requirement.
    Ms : float or None
        Largest sensitivity on the model of the machine's small signals or, without one, on every
        member linearised at three quarters of the top speed. None or inf for no limit.
    time_budget : float, optional
        Time of the search [s], after which the best gains so far are used. Then the same seed no
        longer gives the same gains.
    loop : "speed" or "position"
        With a position loop over the verified speed loop (`Commissioning.position`), verified by
        stops at an angle from three speeds.
    seed : int
        Seed of the random signals, the networks' initial weights and the search.
    threads : int, optional
        All processors by default.
    progress : callable(done, total, stage), optional
        Called as each stage begins, within long ones, and at the end. By default a notebook shows a
        bar; None shows nothing.
    folder : path, optional
        Folder in which every recording is written as soon as it is made, as
        `unfinished/NAME.mcap`, so that a killed process does not lose it; `Commissioning.save` into
        the same folder replaces them by tables. If one cannot be written, there is a warning.
    overwrite : bool
        See `Commissioning.save`.
    resume : bool
        Continue from the recordings that an earlier attempt left in `folder`: those of exactly the
        same commands and references on a machine of this name are not made again. With the same
        settings and recordings, the controller is bit by bit that of an uninterrupted attempt.
    cancel : threading.Event, optional
        Set it in another thread to end the commissioning as Ctrl-C does: a running drive is stopped
        at once, everything else at its next step.
    between : callable(next, so_far), optional
        Called as each stage begins, before it moves the machine, and once more with
        ``"references"`` when the loops of the verification are predicted (`so_far.comparisons`) but
        have not run yet. It can wait for a person; a KeyboardInterrupt raised in it ends the
        commissioning.

    Returns
    -------
    Commissioning
        Its `verdict` is ``verified``, ``verified, prediction poor`` if the measured cost is more
        than twice the predicted one, or ``predicted, target not reached``.

    Raises
    ------
    Refusal
        If the evidence is not good enough; `so_far` holds it.
    SettingError
        Before anything moves, for demands beyond the machine's limits, or a folder with files from
        another source.
    LinkError
        If port or drive failed or tripped; the motor is stopped.
    Interrupted
        On Ctrl-C or `cancel`; the motor is stopped, `best` is the `Commissioning` so far.
    """
    _require_kinds(cost, progress, cancel, between)
    with bench_of(on, u_max, cancel) as machine:
        if loop == "position" and isinstance(machine, DriveBench):
            machine.drive.require_positions()
        asked = demands(
            machine,
            u_max=u_max,
            speed=speed,
            references=samples_of(references, machine, seed),
            practice=samples_of(practice, machine, seed),
            members=members,
            evaluations=evaluations,
            seed=seed,
            threads=available() if threads is None else threads,
            load=load,
            Ms=Ms,
            time_budget=time_budget,
            loop=loop,
        )
        journal = Journal(machine.name, progress, cancel, between)
        if resume and folder is None:
            raise SettingError(
                name="folder", expected="that of the attempt to resume", received="none",
                remedy="give folder='DIR'",
            )  # fmt: skip
        checkpoint = (
            None
            if folder is None
            else _place(folder, machine, asked, overwrite=overwrite, resume=resume)
        )
        if checkpoint is not None:
            journal.keep(recorded_in=checkpoint.folder)

        def note(name: str, key: str, recording: Recording, run: ClosedLoopRun | None) -> None:
            journal.note(name, recording)
            if checkpoint is not None:
                checkpoint.keep(journal.stage, name, key, recording, run)

        def kept(name: str, key: str) -> Recording | None:
            journal.heed()
            return None if checkpoint is None else checkpoint.found(journal.stage, name, key)

        def kept_run(name: str, key: str, controller: SampledController) -> RecordedRun | None:
            journal.heed()
            if checkpoint is None:
                return None
            return checkpoint.found_run(journal.stage, name, key, controller, machine.name)

        # multiple of the largest planned speed at which a machine that states no limit is too fast
        recorded = RecordedBench(machine, note, kept, kept_run, most=2.0 * asked.top)
        try:
            return _carry_out(recorded, asked, cost, journal)
        except (Refusal, LinkError) as stop:
            # a refusal knows why, as does a guard that saw it, and a device that did so between the
            # runs, without a recording; only one that is out of reach does not know what put it
            # there
            knows = isinstance(stop, Refusal) or stop.recording is None
            knows = knows or isinstance(stop.cause, Seen)
            known = stop.cause if knows else None
            if known is not None and known.name == "out of reach":
                known = None
            cause = journal.cause or known
            if not isinstance(stop, Unsuited):
                cause = cause or _cause(recorded) or stop.cause
            if cause is not None:
                stop.explain(cause)
                journal.keep(cause=cause)
            if isinstance(stop, Refusal):
                stop.stage = journal.stage
                stop.so_far = journal.result("refused", str(stop))
            raise
        except KeyboardInterrupt as stop:
            best = getattr(stop, "best", None)
            if isinstance(best, Controller):
                journal.keep(controller=best)
            cancelled = cancel is not None and cancel.is_set()
            reason = "cancelled" if cancelled else "Ctrl-C"
            raise Interrupted(journal.result("interrupted", reason)) from stop


def _cause(machine: RecordedBench) -> Cause | None:
    """What is wrong with the machine, if its runs show it."""
    return cause_among(machine.runs, volt=machine.volt, speed=machine.speed)


def _missed(missed: str, why: Cause | None, journal: Journal) -> Commissioning:
    """The result of a machine that did not reach what was asked, and why, if that is known."""
    if why is not None:
        journal.keep(cause=why)
    return journal.result(UNREACHED, f"{missed}; {why}" if why else missed)


def _require_kinds(cost: Any, progress: Any, cancel: Any, between: Any) -> None:
    """Refuse arguments of the wrong type before anything moves."""
    for name, given, expected, is_one in (
        ("cost", cost, "a Cost", isinstance(cost, Cost)),
        ("progress", progress, "a function", callable(progress)),
        ("cancel", cancel, "a threading.Event", hasattr(cancel, "is_set")),
        ("between", between, "a function", callable(between)),
    ):
        if given is not None and not is_one:
            raise SettingError(
                name=name, expected=f"{expected}, or None", received=type(given).__name__,
                remedy="leave it out",
            )  # fmt: skip


def _place(
    name: str | os.PathLike[str], machine: Machine, asked: Demands, *, overwrite: bool, resume: bool
) -> Checkpoint:
    """The checkpoint for the recordings, created before anything moves."""
    if not isinstance(name, (str, os.PathLike)) or not str(name) or "\0" in str(name):
        raise SettingError(
            name="folder", expected="a folder's name", received=repr(name),
            remedy="as in folder='commissioned', or '.' for the present one",
        )  # fmt: skip
    folder = Path(name)
    require_own(folder, overwrite=overwrite or resume)
    device, conditions = description_of(machine)
    own = {
        "u_max": asked.u_max, "speed": asked.speed, "seed": asked.seed,
        "machine": machine.name, "Ts": machine.Ts, "counts_per_rev": machine.counts_per_rev,
    }  # fmt: skip
    checkpoint = Checkpoint(folder, device, {**own, **conditions}, resume)
    checkpoint.begin()
    return checkpoint


def _carry_out(
    machine: RecordedBench, asked: Demands, cost: Cost | None, journal: Journal
) -> Commissioning:
    journal.enter("first motion")
    motion = first_motion(machine, asked)
    journal.keep(motion=motion)
    moves = turns_at_rest(machine.runs[0])
    if moves is not None:
        journal.keep(cause=moves)
        journal.say(moves.text)

    journal.enter("step response")
    step = step_response(machine, asked, motion)
    journal.keep(fopdt=step)
    odd = lost_motion(step, asked, motion) or excitations.too_strong(step, asked, machine)
    if moves is None and odd is not None:
        journal.keep(cause=odd)
        journal.say(odd.text)

    journal.enter("small signals")
    small = small_signal(machine, asked, motion, step)
    journal.keep(small_signal=small)
    # prefer the small signals: friction and the current limit distort the step response
    fopdt = step if small is None or small.fopdt is None else small.fopdt
    first = first_gains(fopdt, machine, asked, small)
    journal.keep(first=first, controller=first)

    journal.enter("limits")
    fastest, pulses = _pulses(machine, step, asked)
    journal.keep(acceleration=fastest)

    journal.enter("closed loop")
    first, _ = cautious(machine, first, asked, fastest, "hold_first", small)
    journal.keep(first=first, controller=first)
    r = excitations.trapezoids(step, fastest, asked, machine.Ts)
    trapezoids = machine.follow(first, r, "trapezoids")
    require_unsaturated(trapezoids, machine.volt)
    r = excitations.levels(step, fastest, asked, machine.Ts, asked.seed)
    levels = machine.follow(first, r, "levels")

    journal.enter("training")
    thinning = Thinning.of(fopdt, machine.Ts, small)
    journal.keep(sample_time=thinning.k * machine.Ts)
    thin, judge = thinning.recording, thinning.recording(levels.recording)
    learned = [thin(r) for r in (journal.recording("step"), trapezoids.recording, *pulses)]
    gentle = [thin(trapezoids.recording), thin(journal.recording("small_signals"))]
    rival = linear_rival(gentle, judge, step, asked, ORDERS if thinning.k == 1 else THINNED)
    journal.keep(rival=rival)
    try:
        trained = train(learned, judge, asked, journal.within)
    except Refusal as refusal:
        trained = _instead(rival, judge, refusal, journal)
    journal.keep(models=trained.ensemble, rmse=trained.rmse, card=trained.card)
    if thinning.k > 1:
        # a thinned drive has no resonance to avoid
        small = None if rival is None else SmallSignal(rival.model, None, None)
    load = None
    if small is not None:
        load = turn_load(
            trained.ensemble, small.model, [trapezoids.recording], levels.recording, thinning.k
        )
    journal.keep(turn_load=load)

    journal.enter("tuning")
    verify, practice = references_of(fastest, asked, machine)
    weights = cost_of(practice, machine.Ts, asked) if cost is None else cost
    journal.keep(cost=weights)
    pushes = thinning.pushes(load, practice, machine.Ts)
    plan = _Plan(
        thinning.references(practice), pushes, asked, thinning.cost(weights),
        thinning.plant(fopdt, machine.Ts), fastest, small, rival, thinning,
    )  # fmt: skip
    try:
        ensemble, controller = _tuned(trained, plan, journal)
    except Disagreement as refusal:
        if len(trained.ensemble.members) == 1:
            raise
        trained = _instead(rival, judge, refusal, journal)
        journal.keep(card=trained.card)
        ensemble, controller = _tuned(trained, plan, journal)

    journal.enter("verification")
    calm, swing = cautious(
        machine, controller, asked, fastest, "hold_tuned", small, ensemble, thinning
    )
    if swing is not None:
        reason = cause(swing, small, scaled(controller, swing.share))
        note = (
            f"gains lowered, as the machine swung at {swing.frequency:.3g} Hz "
            f"under {100 * swing.share:g} % of them: {reason}"
        )
        calm = _noted(calm, note, journal)
    controller = calm
    controller = _compared(machine, controller, ensemble, verify, load, plan, journal)
    if small is not None and small.resonance is not None:
        speed = SHAKEN_AT * asked.speed
        at_work = margins_at_work(machine, controller, small.model, speed, asked.seed)
        if at_work is not None:
            journal.keep(margins=at_work[0], response=at_work[1])
        else:
            journal.say(f"the margins could not be measured at {speed:g} RPM")
    if missed := unreached(journal.result(VERIFIED).comparisons):
        return _missed(missed, journal.cause or _cause(machine), journal)
    if asked.positions:
        model = None if small is None else small.model
        position = position_loop(controller, ensemble, practice, weights, model, asked.top)
        journal.keep(position=position)
        stops = verified_stops(
            position.controller, machine, ensemble, asked.speed, lambda new: journal.keep(stops=new)
        )
        if missed := unmet(stops):
            *sound, last = telling(machine.runs, stops, position.controller)
            why = cause_after(sound, last, volt=machine.volt, speed=machine.speed)
            return _missed(missed, journal.cause or why, journal)
    journal.finish()
    found = journal.result(VERIFIED)
    return replace(found, verdict=VERIFIED_POORLY) if found.is_predicted_poorly else found


def _noted(controller: Controller, note: str, journal: Journal) -> Controller:
    """The controller with a note on its gains, kept and said."""
    noted = replace(controller, notes=f"{controller.notes}; {note}")
    journal.keep(controller=noted)
    journal.say(note)
    return noted


def _compared(
    machine: RecordedBench,
    controller: Controller,
    ensemble: Ensemble,
    verify: Mapping[str, FloatArray],
    load: TurnLoad | None,
    plan: _Plan,
    journal: Journal,
) -> Controller:
    """Predict and measure every reference with gains lowered until it is calm, or `Refusal`."""
    thinning = plan.thinning
    pushes = thinning.pushes(load, verify, machine.Ts)
    swings = ""
    # shares of Kp under which the references run, one after the other until the loop is calm
    for share in (1.0, 0.7, 0.5):
        tried = scaled(controller, share)
        if share < 1.0:
            note = f"gains lowered to {100 * share:.0f} %, as the machine {swings}"
            tried = _noted(tried, note, journal)
        comparisons = predict(thinning.coarse(tried), ensemble, thinning.references(verify), pushes)
        journal.keep(comparisons=comparisons, judgement=judged(comparisons, ensemble))
        if share == 1.0:
            journal.pause("references")
        swing = measure(
            tried, machine, comparisons, verify, lambda new: journal.keep(comparisons=new),
            plan.cost,
        )  # fmt: skip
        if swing is None:
            return tried
        swings = (
            f"swings at {swing.frequency:.3g} Hz where it should stand or hold a speed "
            f"({swing.command:.3g} V rms): {cause(swing, plan.small, tried)}"
        )
    raise Refusal(f"expected a quiet loop under half of the gains, the machine {swings}")


def _instead(rival: Rival | None, judge: Recording, refusal: Refusal, journal: Journal) -> Trained:
    """The linear rival in place of networks that failed; their `refusal` if it fails, too."""
    if rival is None or not rival.is_fit:
        raise refusal
    journal.say(f"tuned on the linear model alone, as the networks failed: {refusal}")
    return rival.alone(judge)


def _pulses(machine: Machine, fopdt: Fopdt, asked: Demands) -> tuple[float, list[Recording]]:
    """The acceleration at the command's limit [RPM/s], and recordings of pulses.
    The first pulses are planned without a current limit. With one, they fall short of the planned
    speeds; then more are planned with the acceleration just measured.
    """
    fastest = excitations.acceleration(fopdt, asked)
    u = excitations.pulses(fopdt, fastest, asked, machine.Ts, asked.seed)
    found = [machine.excite(u, "pulses")]
    shown = excitations.acceleration_shown(found[0], asked)
    if math.isinf(shown):
        shown = excitations.acceleration_from_rest(machine, fopdt, fastest, asked)
    # share of the planned acceleration; a drive that reaches less limits its current
    if shown > 0.7 * fastest:
        return min(shown, fastest), found
    excitations.require_acceleration(shown, fopdt)
    u = excitations.pulses(fopdt, shown, asked, machine.Ts, asked.seed + 1)
    found.append(machine.excite(u, "pulses_limited"))
    again = excitations.acceleration_shown(found[1], asked)
    return shown if math.isinf(again) else again, found


@dataclass(frozen=True)
class _Plan:
    """The settings of the search, and the knowledge of the machine that it uses."""

    practice: Mapping[str, FloatArray]
    pushes: Sequence[FloatArray] | None
    asked: Demands
    cost: Cost
    fopdt: Fopdt
    fastest: float
    small: SmallSignal | None
    rival: Rival | None
    thinning: Thinning

    @property
    def second(self) -> Model | None:
        """The rival, if it predicts well enough for a second opinion."""
        return self.rival.model if self.rival is not None and self.rival.is_fit else None


def _tuned(trained: Trained, plan: _Plan, journal: Journal) -> tuple[Ensemble, Controller]:
    """The tuned gains, and the members that agree on their loop."""
    asked, practice, cost = plan.asked, plan.practice, plan.cost
    first, small = plan.thinning.coarse(journal.first), plan.small
    # Eq. 12's gains would excite a resonance; the first gains are known to be quiet there
    rival = ruled(plan.fopdt, first) if small is None or small.resonance is None else first
    second = plan.second
    is_alone = plan.rival is not None and plan.rival.model is trained.ensemble.members[0]
    if is_alone:
        second = None

    def of(ensemble: Ensemble) -> tuple[Requirements, TuningResult]:
        # alpha and beta do not affect the response to a load, only the error when it comes on
        start = start_of(rival, ensemble, practice, cost, asked.threads)
        required = Requirements.of(ensemble, plan.fopdt, plan.fastest, start, asked, small)
        # the slowed rule keeps the limit and its own recovery: the search begins at sound gains
        start = required.rival or start_of(first, ensemble, practice, cost, asked.threads)
        return required, search(
            ensemble, practice, start, asked, cost, journal.within, requirements=required,
            disturbances=plan.pushes, rival=second, variations=plan.thinning.variations(),
        )  # fmt: skip

    alike = sensible(rival, agreeing(first, trained.ensemble, practice), small, asked)
    required, tuning = of(alike)
    ensemble = agreeing(tuning.pid, alike, practice)
    if ensemble is not alike:
        # a deviating member has influenced these gains: search again without it
        required, tuning = of(ensemble)
    journal.keep(models=ensemble, rmse=trained.errors_of(ensemble))
    plants = "a linear model" if is_alone else "an ensemble of networks"
    tuning = led(tuning, ensemble, practice, cost, plan.pushes, asked.threads, plan.thinning.k)
    tuned = plan.thinning.fine(tuning.pid)
    controller = replace(tuned, notes=f"commissioned on {plants}")
    if tuning.warning is not None:
        journal.say(tuning.warning)
    journal.keep(tuning=tuning, controller=controller, met=required.met(tuning.pid, ensemble))
    return ensemble, controller
