"""The tables of the report."""

from __future__ import annotations

from ..errors import ModelFileError
from . import labels
from .artefacts import MODELS, PLANTS, REFERENCES, SCORED, Artefacts
from .numbers import milliseconds, percent, significant
from .table import Table


def identification_tables(artefacts: Artefacts) -> list[Table]:
    """Free run and one step: error and fit per model and record."""
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
    told = kind == "simulation"
    rows = []
    best = set()
    for i, m in enumerate(MODELS):
        cells = [labels.MODEL[m], *([_trained_on(artefacts, m)] if told else [])]
        for j, r in enumerate(SCORED):
            fit = artefacts.number(f"identification.{m}.{r}.{kind}.fit_percent")
            cells.append(f"{significant(found[m, r])}\N{NO-BREAK SPACE}({percent(fit, 1)})")
            known = [x for n in MODELS if (x := found[n, r]) is not None]
            if found[m, r] is not None and found[m, r] == min(known):
                best.add((i, j + 1 + told))
        rows.append(tuple(cells))
    header = ("model", *(["trained on"] if told else []), *(labels.RECORD[r] for r in SCORED))
    return Table(caption, header, tuple(rows), frozenset(best))


def _trained_on(artefacts: Artefacts, model: str) -> str:
    names = {"chirp_lo_hi": "Lo-Hi", "saturating": "saturating", "closed_loop": "closed loop"}
    path = f"identification.{model}.trained_on"
    records = artefacts.value(path)
    if not isinstance(records, list):
        raise ModelFileError(f"results.json: expected a list at {path!r}, received {records!r}")
    return ", ".join(names.get(r, str(r)) for r in records)


def speed_table(artefacts: Artefacts) -> Table:
    """Speed from counts: error and floor of J per method."""
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
    """Closed loops of the tuned controller: numbers per reference and plant."""
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
    """What the paper's gains do on the plant of Eq. 8, by how they are read."""
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
