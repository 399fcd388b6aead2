"""The page of the experiment: goals, tables, figures and text in one HTML document."""

from __future__ import annotations

import base64
import hashlib
from collections.abc import Mapping
from dataclasses import dataclass
from importlib import resources
from typing import Any

from ..errors import ModelFileError
from ..plotting import style
from ..tables import Table, milliseconds, percent, rpm, significant
from . import artefacts as labels
from . import commissioned, pictures
from .artefacts import MODELS, PLANTS, REFERENCES, SCORED, Artefacts

# --- The goals of the experiment, with the values reached and verdicts from the numbers -----------


_TESTS = ("chirp_hi_lo", "random")


@dataclass(frozen=True)
class Goal:
    """One goal: requirement and measured value in words; `met` is None if that is undefined."""

    demand: str
    reached: str
    met: bool | None

    @property
    def verdict(self) -> str:
        return {True: "reached", False: "not reached", None: "undefined"}[self.met]


def goals(artefacts: Artefacts) -> tuple[Goal, ...]:
    """Every goal, judged."""
    return (
        _speed(artefacts),
        _ideal(artefacts),
        _cost(artefacts),
        _linear(artefacts),
        _no_worse(artefacts),
        _saturated(artefacts),
        _paper_gains(artefacts),
        _rise(artefacts),
        _overshoot(artefacts),
        _alike(artefacts),
        _duration(artefacts),
    )


def verdict(a: Artefacts) -> str:
    """One sentence on whether the machine behaved as predicted."""
    path = "control.trapezoid"
    met = all(goal.met for goal in (_rise(a), _overshoot(a), _alike(a)))
    return (
        f"{'Verified' if met else 'Not verified'}: on the trapezoid the speed of the machine is "
        f"within {rpm(a.number(f'{path}.model_vs_machine_rmse_rpm'))} rms of its prediction. It "
        f"rises in {milliseconds(a.number(f'{path}.machine.rise_time_ms'))}, the reference in "
        f"{milliseconds(a.number(f'{path}.reference_rise_time_ms'))}, and overshoots by "
        f"{percent(a.number(f'{path}.machine.overshoot_percent'), 1)}."
    )


def _at_most(value: float | None, limit: float) -> bool | None:
    return None if value is None else value <= limit


def _rmse(a: Artefacts, model: str, record: str) -> float:
    value = a.number(f"identification.{model}.{record}.simulation.rmse_rpm")
    return float("inf") if value is None else value


def _speed(a: Artefacts) -> Goal:
    error = a.number("speed.kalman.rmse_rpm")
    return Goal(
        "Speed estimated from encoder counts within 1 RPM rms of the truth on the Lo-Hi chirp",
        rpm(error),
        _at_most(error, 1.0),
    )


def _ideal(a: Artefacts) -> Goal:
    cost = a.number("identification.paper.cost_ideal")
    return Goal(
        "The paper's network on a machine without encoder steps and without dependence on the "
        "crank angle: free-run cost J of 1e-4 at most",
        f"J = {significant(cost)}",
        _at_most(cost, 1e-4),
    )


def _cost(a: Artefacts) -> Goal:
    cost, floor = (a.number(f"identification.paper.{n}") for n in ("cost", "cost_floor"))
    ratio = cost / floor if cost is not None and floor else None
    return Goal(
        "The paper's network, trained on raw differences: free-run cost J at most 1.8 times the "
        "encoder's floor",
        f"J = {significant(cost)}, floor {significant(floor)}: {significant(ratio)} times",
        _at_most(ratio, 1.8),
    )


def _linear(a: Artefacts) -> Goal:
    records = ("chirp_lo_hi", *_TESTS)
    fits = [a.number(f"identification.oe.{r}.simulation.fit_percent") for r in records]
    known = [f for f in fits if f is not None]
    met = min(known) >= 95.0 if len(known) == len(records) else None
    return Goal(
        "Linear output error: free-run fit of 95 % or more on Lo-Hi, Hi-Lo and random",
        ", ".join(percent(f) for f in fits),
        met,
    )


def _no_worse(a: Artefacts) -> Goal:
    shown = []
    met = True
    for record in _TESTS:
        network = _rmse(a, "neural_oe", record)
        linear = min(_rmse(a, "oe", record), _rmse(a, "oe_all", record))
        met = met and network <= linear
        shown.append(f"{labels.RECORD[record]} {rpm(network)} against {rpm(linear)}")
    return Goal(
        "The default network is no worse than the better linear output-error model on Hi-Lo and "
        "random",
        ", ".join(shown),
        met,
    )


def _saturated(a: Artefacts) -> Goal:
    network = _rmse(a, "neural_oe", "saturating")
    linear = min(_rmse(a, "oe", "saturating"), _rmse(a, "oe_all", "saturating"))
    return Goal(
        "Where the drive saturates, the default network has at most half the error of the better "
        "linear model",
        f"{rpm(network)} against {rpm(linear)}",
        network <= 0.5 * linear,
    )


def _paper_gains(a: Artefacts) -> Goal:
    rise = a.number("paper_gains.eq8.rise_time_ms")
    overshoot = a.number("paper_gains.eq8.overshoot_percent")
    known = rise is not None and overshoot is not None
    return Goal(
        "The paper's gains, read as per-sample gains, track the trapezoid on the plant of its "
        "Eq. 8: rise of 200 ms at most, where ±10 V allow 186 ms, and 5 % overshoot at most",
        f"{milliseconds(rise)}, overshoot {percent(overshoot)}",
        (rise or 0.0) <= 200.0 and (overshoot or 0.0) <= 5.0 if known else None,
    )


def _rise(a: Artefacts) -> Goal:
    rise = a.number("control.trapezoid.machine.rise_time_ms")
    own = a.number("control.trapezoid.reference_rise_time_ms")
    apart = abs(rise - own) if rise is not None and own is not None else None
    return Goal(
        "Trapezoid on the machine: 10–90 % rise within 15 ms of the reference's own",
        f"{milliseconds(rise)} against {milliseconds(own)}",
        _at_most(apart, 15.0),
    )


def _overshoot(a: Artefacts) -> Goal:
    overshoot = a.number("control.trapezoid.machine.overshoot_percent")
    return Goal(
        "Trapezoid on the machine: overshoot of 3 % at most",
        percent(overshoot),
        _at_most(overshoot, 3.0),
    )


def _alike(a: Artefacts) -> Goal:
    references = ("chirp_hi_lo", "chirp_lo_hi", "random")
    apart = [a.number(f"control.{r}.model_vs_machine_rmse_rpm") for r in references]
    known = [x for x in apart if x is not None]
    return Goal(
        "The predicted closed loop is within 15 RPM rms of the machine's on both chirps and random",
        ", ".join(rpm(x) for x in apart),
        max(known) <= 15.0 if len(known) == len(references) else None,
    )


def _duration(a: Artefacts) -> Goal:
    seconds = a.number("seconds")
    return Goal(
        "The whole experiment within a minute",
        f"{significant(seconds)} s",
        _at_most(seconds, 60.0),
    )


# --- The tables of the report ---------------------------------------------------------------------


def identification_tables(artefacts: Artefacts) -> list[Table]:
    """Error and fit of free run and one step, per model and record."""
    return [
        _scores(
            artefacts, "simulation",
            "Free run: the model sees the command alone. Rms error [RPM] and fit [%] against the "
            "true speed, from rest, every sample scored; bold: the smallest error of the record.",
        ),
        _scores(
            artefacts, "one_step",
            "One step ahead: the model also sees the measured speed up to 1 ms ago. A small number "
            "here says little about a model.",
        ),
    ]  # fmt: skip


def _scores(artefacts: Artefacts, kind: str, caption: str) -> Table:
    found = {
        (m, r): artefacts.number(f"identification.{m}.{r}.{kind}.rmse_rpm")
        for m in MODELS
        for r in SCORED
    }
    with_records = kind == "simulation"
    rows = []
    best = set()
    for i, m in enumerate(MODELS):
        cells = [labels.MODEL[m], *([_trained_on(artefacts, m)] if with_records else [])]
        for j, r in enumerate(SCORED):
            fit = artefacts.number(f"identification.{m}.{r}.{kind}.fit_percent")
            cells.append(f"{significant(found[m, r])}\N{NO-BREAK SPACE}({percent(fit, 1)})")
            known = [x for n in MODELS if (x := found[n, r]) is not None]
            if found[m, r] is not None and found[m, r] == min(known):
                best.add((i, j + 1 + with_records))
        rows.append(tuple(cells))
    header = (
        "model",
        *(["trained on"] if with_records else []),
        *(labels.RECORD[r] for r in SCORED),
    )
    return Table(caption, header, tuple(rows), frozenset(best))


def _trained_on(artefacts: Artefacts, model: str) -> str:
    names = {"chirp_lo_hi": "Lo-Hi", "saturating": "saturating", "closed_loop": "closed loop"}
    path = f"identification.{model}.trained_on"
    records = artefacts.value(path)
    if not isinstance(records, list):
        raise ModelFileError(f"results.json: expected a list at {path!r}, received {records!r}")
    return ", ".join(names.get(r, str(r)) for r in records)


def speed_table(artefacts: Artefacts) -> Table:
    """Error and floor of J of each method of computing the speed from counts."""
    methods = {
        "difference": "difference of counts over 1 ms",
        "savgol": "Savitzky-Golay",
        "kalman": "Kalman and RTS smoother",
    }
    rows = tuple(
        (
            label,
            significant(artefacts.number(f"speed.{m}.rmse_rpm")),
            significant(artefacts.number(f"speed.{m}.cost_floor")),
        )
        for m, label in methods.items()
    )
    return Table(
        "Speed from the encoder's counts on the Lo-Hi chirp, against the true speed. The floor is "
        "the J that a perfect model would still have when scored against that estimate.",
        ("method", "rms error [RPM]", "floor of J [scaled, (RPM/1000)²]"),
        rows,
    )


def control_table(artefacts: Artefacts) -> Table:
    """Figures of the tuned controller's loops per reference and plant."""
    rows = []
    for r in REFERENCES:
        for p in PLANTS:
            path = f"control.{r}.{p}"
            step = r == "trapezoid"
            rows.append(
                (
                    f"{labels.REFERENCE[r]}, {p}",
                    significant(artefacts.number(f"{path}.rmse_rpm")),
                    milliseconds(artefacts.number(f"{path}.rise_time_ms")) if step else "–",
                    percent(artefacts.number(f"{path}.overshoot_percent")) if step else "–",
                    significant(artefacts.number(f"{path}.effort_v")),
                    significant(artefacts.number(f"{path}.chatter_v")),
                    significant(artefacts.number(f"control.{r}.model_vs_machine_rmse_rpm"))
                    if p == "machine"
                    else "",
                )
            )
    return Table(
        "The controller on the identified models and on the machine. Rise and overshoot are "
        "those of the true speed, smoothed over 5 ms.",
        (
            "reference, plant", "tracking error [RPM rms]", "10–90 % rise", "overshoot",
            "command [V rms]", "its change per sample [V rms]", "model against machine [RPM rms]",
        ),
        tuple(rows),
    )  # fmt: skip


def gains_table(artefacts: Artefacts) -> Table:
    """The three controllers in standard form."""
    names = {"paper": "the paper's, as per-sample gains", "coarse": "from Table 1",
             "tuned": "commissioned"}  # fmt: skip
    rows = []
    for key, label in names.items():
        kp, ti, td, alpha, beta = (
            artefacts.number(f"gains.{key}.{n}") for n in ("Kp", "Ti", "Td", "alpha", "beta")
        )
        rows.append(
            (
                label,
                significant(kp),
                "no integral action" if ti is None else significant(1e3 * ti),
                significant(1e3 * td if td is not None else None),
                significant(alpha),
                significant(beta),
            )
        )
    return Table(
        "Gains of the controllers, standard form.",
        ("controller", "Kp [V/RPM]", "Ti [ms]", "Td [ms]", "α", "β"),
        tuple(rows),
    )


def readings_table(artefacts: Artefacts) -> Table:
    """The loops of the paper's gains on the plant of Eq. 8, for each reading of the gains."""
    names = {
        "per_sample_rpm": "per sample, error in RPM",
        "continuous_rpm": "continuous time, error in RPM",
        "per_sample_cps": "per sample, error in counts per sample",
        "continuous_cps": "continuous time, error in counts per sample",
        "per_sample_krpm": "per sample, error in 1,000 RPM",
    }
    rows = []
    for key, label in names.items():
        path = f"paper_gains.readings.{key}"
        rows.append(
            (
                label,
                significant(artefacts.number(f"{path}.rmse_rpm")),
                milliseconds(artefacts.number(f"{path}.rise_time_ms")),
                percent(artefacts.number(f"{path}.overshoot_percent")),
            )
        )
    return Table(
        "The paper's gains on the plant of Eq. 8, trapezoid to 3,000 RPM; a dash: the speed does "
        "not get that far, or the loop runs away.",
        ("reading", "tracking error [RPM rms]", "10–90 % rise", "overshoot"),
        tuple(rows),
    )


# --- The page -------------------------------------------------------------------------------------


def render(artefacts: Artefacts) -> str:
    """The report as one self-contained HTML document."""
    return fill("page.html", _context(artefacts))


def fill(template: str, context: Mapping[str, Any]) -> str:
    """A template filled with values and with the page's one script, which zooms into pictures.
    The page's policy allows that script by its hash: no other script on the page runs, and nothing
    is loaded from anywhere.
    """
    from jinja2 import Environment, FunctionLoader, StrictUndefined
    from markupsafe import Markup

    environment = Environment(
        loader=FunctionLoader(_source),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters.update(
        significant=significant, rpm=rpm, percent=percent, milliseconds=milliseconds,
        capitalize_first=lambda text: text[:1].upper() + text[1:],
    )  # fmt: skip
    zoom = _source("zoom.js")
    digest = base64.b64encode(hashlib.sha256(zoom.encode()).digest()).decode()
    policy = f"default-src 'none'; style-src 'unsafe-inline'; script-src 'sha256-{digest}'"
    sheet = (resources.files("sewfast") / "design.css").read_text(encoding="utf-8")
    environment.globals.update(zoom=Markup(zoom), sheet=Markup(sheet), policy=policy)
    return environment.get_template(template).render(context)


def _source(name: str) -> str:
    return (resources.files(__package__) / "templates" / name).read_text(encoding="utf-8")


def _context(artefacts: Artefacts) -> dict[str, Any]:
    numbers = {
        "goals": goals(artefacts),
        "verdict": verdict(artefacts),
        "speed": speed_table(artefacts),
        "scores": identification_tables(artefacts),
        "gains": gains_table(artefacts),
        "control": control_table(artefacts),
        "readings": readings_table(artefacts),
        "number": artefacts.number,
        "value": artefacts.value,
        # older results lack link, check and commissioning
        "link": artefacts.results.get("link"),
        "check": artefacts.results.get("check"),
        "analysed": commissioned.section(artefacts.folder)
        or commissioned.section(artefacts.folder / "commissioning"),
        "motor": commissioned.motor_section(artefacts.folder),
        "commissioning": artefacts.results.get("commissioning"),
    }
    # draw last, as a missing number raises before
    with style():
        return numbers | {
            "opening": pictures.opening_picture(artefacts),
            "recorded": pictures.recorded_pictures(artefacts),
            "scaled": pictures.scaled_pictures(artefacts),
            "predicted": pictures.prediction_pictures(artefacts),
            "trust": pictures.trust_pictures(artefacts),
            "arx": pictures.arx_picture(artefacts),
            "loops": pictures.loop_pictures(artefacts),
            "paper_gains": pictures.paper_gain_pictures(artefacts),
        }
