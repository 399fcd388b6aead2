"""The page of a commissioning, from the files of its folder alone."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from .. import storage
from ..analysis import analysis as analyses
from ..errors import DataError, ModelFileError
from ..frequency import load_response
from ..greybox import load_motor
from ..plotting import Picture, Trace, loop_drawing, style, svg
from ..readers import read_table
from ..tables import Table, milliseconds, percent, rpm, significant, volt
from ..tuning.verdict import LIVELY
from .artefacts import drawing
from .pictures import hero

FORMAT = "sewfast.commissioning"
VERSION = 1
NUMBERS = "commissioning.json"
RESPONSE = "analysis/response.json"
_RUN = ("t", "r", "u", "y")
WHAT = {
    "first motion": "which command moves the machine, and which way",
    "step response": "gain, time constant and dead time; first gains by rule",
    "small signals": "a small random command: delay, resonances, first gains that suit them",
    "closed loop": "trapezoids and random levels under the first gains",
    "limits": "short pulses of nearly the largest command",
    "training": "networks that differ in their seeds; judged on the random levels",
    "tuning": "gains of least cost on all networks, with encoder, filter, gain spread and delay",
    "verification": "prediction, then the machine",
}
"""Descriptions of the stages."""


def run_file(reference: str, kind: str) -> str:
    """Path in the folder of a closed loop; `kind` is predicted or measured."""
    return f"runs/{file_name(reference)}_{kind}.npz"


def file_name(reference: str) -> str:
    return "".join(c if c.isalnum() or c in "-_." else "_" for c in reference)


def is_commissioning(folder: Path) -> bool:
    return (folder / NUMBERS).is_file()


def context(folder: Path) -> dict[str, Any]:
    """The values for the template."""
    found = storage.read(folder / NUMBERS, FORMAT, {VERSION})
    with style():
        return {
            "found": found,
            "opening": _opening(folder, found),
            "stages": _stages(found),
            "gains": _gains(found),
            "met": _met(found),
            "opinion": _opinion(found),
            "evidence": [_judged(*item) for item in found.get("evidence", {}).items()],
            "verified": _verified(found),
            "analysed": section(folder),
            "margins": _predicted_and_measured(found),
            "stops": _stops(found),
            "response": _response(folder),
            "motor": motor_section(folder),
            "loops": [_picture(folder, name, n) for name, n in found["references"].items()],
        }


def _stages(found: Mapping[str, Any]) -> Table:
    rows = tuple((s, WHAT.get(s, ""), f"{t:.2f}") for s, t in found["seconds"].items())
    return Table(
        "What was done, and how long it took.", ("stage", "what", "seconds"), rows, words=True
    )


def _gains(found: Mapping[str, Any]) -> Table:
    names = {"first": "first gains, by rule", "tuned": "the controller"}
    rows = tuple(
        (
            names[key],
            significant(c["gains"]["Kp"]),
            significant(_ms(c["gains"]["Ti"])),
            significant(_ms(c["gains"]["Td"])),
            significant(c["alpha"]),
            significant(c["beta"]),
            significant(c["N"]),
        )
        for key, c in found["controllers"].items()
    )
    header = ("controller", "Kp [V/RPM]", "Ti [ms]", "Td [ms]", "α", "β", "N")
    return Table("Gains in standard form.", header, rows)


def _met(found: Mapping[str, Any]) -> Table | None:
    """How the gains meet the requirements besides the cost."""
    met = found.get("met")
    if not met or not (met["Ms"] or met["load"]):
        return None
    rows = []
    if met["Ms"]:
        rows.append(
            ("largest sensitivity Ms", significant(max(met["Ms"])),
             significant(met["Ms_limit"])),
        )  # fmt: skip
    rows += [("the same if the machine changes", borne, f"Ms {2.0 * met['Ms_limit']:g}")
             for borne in met.get("tolerance", ())]  # fmt: skip
    if met["load"]:
        volt, level = abs(met["load"]["disturbance"]), met["load"]["level"]
        tuned, rule = (milliseconds(max(met["recovery_ms"][n])) for n in ("tuned", "rule"))
        what = f"slowest recovery from a load of {significant(volt)} V at {significant(level)} RPM"
        rows.append((what, tuned, f"{rule}, under Eq. 12's gains"))
    header = ("what", "found", "allowed")
    return Table("Required besides the cost.", header, tuple(rows), words=True)


def _opinion(found: Mapping[str, Any]) -> Table | None:
    """Costs of the gains of models and linear rival on either; None for older folders."""
    opinion = found.get("second_opinion")
    if not opinion:
        return None
    names = ("tuned on the networks", "tuned on the linear model", "tuned on both")
    rows = tuple(
        (name + (", taken" if i == opinion["taken"] else ""), significant(a), significant(b))
        for i, (name, a, b) in enumerate(
            zip(names, opinion["on_models"], opinion["on_rival"], strict=False)
        )
    )
    header = ("gains", "cost on the networks [RPM]", "cost on the linear model [RPM]")
    return Table("A second opinion.", header, rows)


def _judged(name: str, judged: Mapping[str, Any]) -> Table:
    rows = tuple(
        (x["name"], x["shown"], x["limit"], x["verdict"], x["meaning"]) for x in judged["lines"]
    )
    header = ("question", "found", "limit", "verdict", "what it means")
    return Table(f"{name.capitalize()}: {judged['verdict']}.", header, rows, words=True)


def _predicted_and_measured(found: Mapping[str, Any]) -> Table | None:
    """Measured and predicted margins of the loop; None for a machine without a resonance."""
    margins = found.get("margins")
    if not margins:
        return None
    one, other = margins["predicted"], margins["measured"]
    low, high = (significant(x) for x in other["Ms_band"])

    def decibel(share: float | None) -> str:
        return "∞" if share is None else f"{20.0 * math.log10(share):.1f} dB"

    def degrees(angle: float | None) -> str:
        return "–" if angle is None else f"{angle:.0f}°"

    rows = (
        (
            "largest sensitivity Ms",
            significant(one["Ms"]),
            f"{significant(other['Ms'])} ({low} to {high})",
        ),
        ("phase margin", degrees(one["phase_margin_deg"]), degrees(other["phase_margin_deg"])),
        ("gain margin", decibel(one["gain_margin"]), decibel(other["gain_margin"])),
    )
    caption = f"Margins about {rpm(margins['speed'])}; of Ms the 95 % band."
    return Table(caption, ("margin", "predicted", "measured on the machine"), rows)


def _stops(found: Mapping[str, Any]) -> Table | None:
    """Stops at an angle as predicted and as measured; None without a position loop."""
    position = found.get("position")
    if not position:
        return None

    def shown(value: float | None) -> str:
        return "–" if value is None else significant(value)

    rows = tuple(
        (
            stop["name"],
            shown(stop["predicted"]["off"]),
            *(shown((stop["measured"] or {}).get(name)) for name in ("off", "passed", "turns")),
        )
        for stop in position["stops"]
    )
    caption = (
        f"Position gain {significant(position['gain'])} 1/s, "
        f"{percent(100.0 * position['share'], 0)} of what the models can do; Ms of both loops "
        f"{shown(position['Ms'])} (at most {LIVELY:g})."
    )
    header = ("stop", "off, predicted [deg]", "off [deg]", "passed by [deg]", "turns")
    return Table(caption, header, rows)


def _response(folder: Path) -> Picture | None:
    """The frequency response of the measured margins."""
    if not (folder / RESPONSE).is_file():
        return None
    figure = load_response(folder / RESPONSE).drawing().beside()
    key, alt = "frequency-response", "gain, phase and coherence over frequency, with 95 % bands"
    caption = (
        "From command to speed, measured under the controller with its reference shaken; bands "
        "hold the response at 95 %. Pale: less than half of the speed comes from the command."
    )
    return Picture(
        key, "", "Frequency response of the machine", alt, caption, svg(figure, key, alt)
    )


def _ms(seconds: float | None) -> float | None:
    return None if seconds is None else 1e3 * seconds


def _verified(found: Mapping[str, Any]) -> Table:
    rows = []
    for name, n in found["references"].items():
        for kind in ("predicted", "measured"):
            if n[kind] is None:
                continue
            rows.append((f"{name}, {kind}", *_cells(n[kind]), _apart(n, kind)))
    header = (
        "reference", "tracking error (rms)", "10–90 % rise", "overshoot", "command (rms)",
        "its change per sample (rms)", "measured from predicted (rms)",
    )  # fmt: skip
    return Table("Prediction and machine.", header, tuple(rows))


def _cells(n: Mapping[str, float | None]) -> tuple[str, ...]:
    return (
        rpm(n["rmse_rpm"]),
        milliseconds(n["rise_time_ms"]),
        percent(n["overshoot_percent"]),
        volt(n["effort_v"]),
        volt(n["chatter_v"]),
    )


def _apart(n: Mapping[str, Any], kind: str) -> str:
    return rpm(n["apart_rmse_rpm"]) if kind == "measured" else ""


def _opening(folder: Path, found: Mapping[str, Any]) -> Picture | None:
    """The first reference that was run, as predicted and as measured."""
    for name, n in found["references"].items():
        return hero(_traces(folder, name, n), _in_words(name), "The ensemble's median run.")
    return None


def _traces(folder: Path, name: str, n: Mapping[str, Any]) -> list[Trace]:
    looks = {"predicted": "model", "measured": "machine"}
    kinds = [k for k in looks if n[k] is not None]
    return [Trace.of(_columns(folder / run_file(name, k)), looks[k], k) for k in kinds]


def _in_words(name: str) -> str:
    return name.replace("_", " ")


def _picture(folder: Path, name: str, n: Mapping[str, Any]) -> Picture:
    traces = _traces(folder, name, n)
    figure = loop_drawing(traces, "RPM", "V", heights=(1.9, 1.0, 1.0)).beside()
    key = "run-" + "".join(c if c.isalnum() else "-" for c in name)
    alt = f"{name}: reference, predicted and measured speed, tracking error and command over time"
    caption = "The median of the ensemble's runs, and the machine."
    return Picture(key, "", _in_words(name), alt, caption, svg(figure, key, alt))


def _columns(path: Path) -> Mapping[str, Any]:
    if not path.is_file():
        raise DataError(f"{path}: expected by the report, found none; commission again")
    table = read_table(path)
    return {n: table[n] for n in _RUN}


# --- The section on an analysis in the folder (`Analysis.save`) -----------------------------------


_CAPTIONS = {
    "responses": (
        "Steps of the reference and of a disturbance",
        "What the loop does about one speed, with encoder, filter and limits; the band holds every "
        "plant. The reference step shows F₁ and F₂ together, the disturbance step F₁ alone.",
    ),
    "bode": (
        "L, S and T",
        "With bands over the plants. |S| is the share of a disturbance that is left: its peak is "
        "to stay below 2, better below 1.7. |T| is what comes through of the measurement, with its "
        "noise.",
    ),
    "sensitivity": (
        "What a gain that is a little off costs",
        "Flat curves are gains that need no care; a steep one, or an Ms beyond 2, is where not to "
        "round.",
    ),
    "what_if": (
        "What if the plant is not as identified?",
        "The same controller on changed plants; the thin line marks the plants as they are.",
    ),
}


def section(folder: Path) -> dict[str, Any] | None:
    """The values for the template `analysis.html`; None if the folder has no analysis."""
    path = folder / analyses.NUMBERS
    if not path.is_file():
        return None
    found = storage.read(path, analyses.FORMAT, {analyses.VERSION})
    try:
        return {
            "margins": _margins(found),
            "what_if": _scores(found),
            "judgement": found["judgement"],
            "plants": found["plants"],
            "pictures": [
                _analysis_picture(folder, str(n)) for n in found["figures"] if n in _CAPTIONS
            ],
        }
    except (KeyError, TypeError, AttributeError) as e:
        raise ModelFileError(
            f"{path}: expected the numbers of an analysis, one is missing or of another kind "
            f"({e}); analyse again"
        ) from e


def _analysis_picture(folder: Path, name: str) -> Picture:
    title, caption = _CAPTIONS[name]
    svg = drawing(folder / analyses.FOLDER / f"{name}.svg")
    return Picture(f"analysis-{name}", "", title, analyses.ALT[name], caption, svg)


def _margins(found: Mapping[str, Any]) -> Table:
    unit = found["units"]["y"]
    rows = []
    for loop in found["loops"]:
        worst = max((p["margins"] for p in loop["plants"]), key=_peak)
        rows.append((f"{significant(loop['level'])} {unit}", *_margin_cells(worst)))
    header = ("about", "Ms", "Mt", "gain margin", "phase margin", "delay margin", "noise gain")
    count = len(found["plants"])
    whose = "" if count == 1 else f" The worst of {count} plants."
    return Table(f"Margins of the linear loop.{whose}", header, tuple(rows))


def _peak(margins: Mapping[str, Any]) -> float:
    return float("inf") if margins["Ms"] is None else float(margins["Ms"])


def _margin_cells(m: Mapping[str, Any]) -> tuple[str, ...]:
    if not m["stable"]:
        return ("unstable", *("–",) * 5)
    delay = m["delay_margin_s"]
    phase = m["phase_margin_deg"]
    return (
        significant(m["Ms"]),
        significant(m["Mt"]),
        significant(m["gain_margin"]),
        "–" if phase is None else f"{phase:.0f}°",
        "–" if delay is None else f"{significant(1e3 * delay)} ms",
        significant(m["noise_gain"]),
    )


def _scores(found: Mapping[str, Any]) -> Table:
    unit, volt = found["units"]["y"] or "y", found["units"]["u"] or "u"
    rows = [("as it is", *_score_cells(found["score"]))]
    rows += [(w["change"], *_score_cells(w)) for w in found["what_if"]]
    header = (
        "plant", f"cost [{unit}]", f"worst error [{unit} rms]", "overshoot",
        f"chatter [{volt} rms]", "Ms",
    )  # fmt: skip
    return Table(f"Cost on {', '.join(found['references'])}.", header, tuple(rows))


def _score_cells(s: Mapping[str, Any]) -> tuple[str, ...]:
    return (
        significant(s["cost"]),
        significant(s["tracking"]),
        percent(s["overshoot_percent"]),
        significant(s["chatter"]),
        significant(s["Ms"]),
    )


# --- The section on a motor in the folder (`Motor.save`) ------------------------------------------

MOTOR = "motor.json"


def motor_section(folder: Path) -> dict[str, Any] | None:
    """The values for the template `motor.html`; None if the folder has no motor."""
    path = folder / MOTOR
    if not path.is_file():
        return None
    motor = load_motor(path)
    rows = tuple(
        (name, f"{p.value:.5g}", f"{p.low:.5g} to {p.high:.5g}", p.unit)
        for name, p in motor.parameters.items()
    )
    reasons = dict.fromkeys(motor.undetermined.values())
    missing = {why: [n for n, w in motor.undetermined.items() if w == why] for why in reasons}
    alt = "the command that it takes to hold a speed, with its step at standstill"
    picture = Picture(
        "motor", "", "What it takes to hold a speed",
        alt, "The step at standstill is dry friction and the dead zone of the inverter.",
        svg(motor.drawing().beside(), "motor", alt),
    )  # fmt: skip
    caption = (
        f"Free run on its record: {motor.fit_percent:.2f} %, {motor.rmse:.3g} {motor.speed_unit} "
        f"rms of {motor.samples:,} samples."
    )
    header = ("parameter", "value", "95 % interval", "unit")
    return {
        "parameters": Table(caption, header, rows, words=True),
        "missing": [(", ".join(names), why) for why, names in missing.items()],
        "picture": picture,
    }
