"""Tuning by hand: the effect of each setting of a controller on the loops with all models.

A move of a slider costs one closed loop per member and step, and the margins about an operating
point that is computed once. Slower computations, the cost of `tune` and a search, are separate
requests.
"""

from __future__ import annotations

import json
import math
import shlex
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from sewfast.errors import FitError, Interrupted, SettingError

from .words import spoken

if TYPE_CHECKING:
    from sewfast.analysis.points import LoopBode
    from sewfast.analysis.responses import Responses
    from sewfast.control.controller import Controller
    from sewfast.control.feedforward import Feedforward
    from sewfast.dataset import FloatArray
    from sewfast.models import Model
    from sewfast.tuning import Constraints, Cost, Judge
    from sewfast.tuning.lead import Lead

MOST_MEMBERS = 16
FRONT = ("cost", "Ms")
"""What the sliders of the trade-off weigh: response with its effort, and robustness."""
READABLE_DB = -60.0
"""Gain below which the phase is left out: it jumps at the zeros of a mean over samples."""


@dataclass(frozen=True)
class Knob:
    """A setting of the controller with its range.
    `log` says that the scale is logarithmic, `whole` that the value is a whole number.
    """

    name: str
    unit: str
    value: float
    low: float
    high: float
    log: bool = False
    whole: bool = False


class Tuning:
    """A model, or all members of an ensemble, and a controller whose settings change.

    Parameters
    ----------
    model : Model
        With one input.
    name : str
        The model's file, for the copies.
    start : Controller, optional
        With constant gains; by default the first controller of `sewfast.tune`.
    notches : sequence of (frequency [Hz], depth, width)
        Added after the biquads of the start; a controller has four at most.
    stamp : str
        Identifies this version of the files.

    Raises
    ------
    SettingError
        For a model with several inputs, a gain schedule, or a controller for another drive.
    FitError
        If the model has no first controller.
    """

    def __init__(
        self,
        model: Model,
        name: str,
        start: Controller | None = None,
        notches: Sequence[Sequence[float]] = (),
        stamp: str = "",
    ) -> None:
        from sewfast.analysis.analysis import slowest_time
        from sewfast.analysis.points import plant_points, recorded_way
        from sewfast.analysis.responses import default_steps
        from sewfast.control.biquad import Biquad
        from sewfast.control.loop import check_fits, each_plant, titles
        from sewfast.tuning import first_controller

        self.model, self.name, self.stamp = model, name, stamp
        start = first_controller(model) if start is None else start
        # the copies are written in standard form
        added = tuple(Biquad.notch(*numbers) for numbers in notches)
        self.start = replace(
            start, gains=start.gains.to("standard"), biquads=(*start.biquads, *added)
        )
        if self.start.schedule:
            raise SettingError(
                "expected a controller with constant gains, received a gain schedule; tune it with "
                "sewfast tune --variables schedule"
            )
        self.members = each_plant([model])[:MOST_MEMBERS]
        for member in self.members:
            check_fits(self.start, member)
        self.titles = titles(self.members)
        rows = plant_points(self.members, self.titles, None)
        self.points = rows[len(rows) // 2]
        self.slowest = slowest_time(self.start, self.points)
        self.steps = default_steps(
            self.start, self.points, self.slowest,
            level=None, step=None, disturbance=None, seconds=None,
            span=recorded_way(self.members),
        )  # fmt: skip
        self._found: list[Found] = []

    @property
    def level(self) -> float:
        """The output about which the loop is linearised [y]."""
        return float(self.points[0].y)

    @property
    def knobs(self) -> list[Knob]:
        """The adjustable settings: gains, weights of the reference, filters."""
        gains, Ts = self.start.gains, self.start.Ts
        per = f"{gains.u_unit}/{gains.y_unit}" if gains.u_unit and gains.y_unit else ""
        knobs = [_factors("Kp", per, gains.Kp)]
        Ti = gains.Ti if math.isfinite(gains.Ti) else 0.0
        if Ti:
            knobs.append(_factors("Ti", "s", Ti))
        knobs.append(
            _factors("Td", "s", gains.Td)
            if gains.Td
            else Knob("Td", "s", 0.0, 0.0, 0.25 * Ti or 50.0 * Ts)
        )
        for name in ("alpha", "beta"):
            value = getattr(self.start, name)
            knobs.append(Knob(name, "", value, min(-0.5, value), max(1.5, value)))
        if math.isfinite(self.start.N):
            N = self.start.N
            knobs.append(Knob("N", "", N, min(1.0, N), max(100.0, N), log=True))
        n, lag = self.start.filter_samples, self.start.filter_time
        knobs.append(Knob("filter_samples", "samples", n, 1, 64, whole=True))
        knobs.append(Knob("filter_time", "s", lag, 0.0, max(20.0 * Ts, lag)))
        leads = float(self.start.feedforward is not None)
        return [*knobs, *self._notch_knobs(), Knob("feedforward", "", leads, 0, 1, whole=True)]

    def _notch_knobs(self) -> list[Knob]:
        knobs = []
        for k, biquad in enumerate(self.start.biquads):
            if biquad.kind != "notch":
                continue
            f, depth, width = biquad.numbers
            most = min(2.0 * f, 0.49 / self.start.Ts)
            knobs += [
                Knob(f"notch_frequency[{k}]", "Hz", f, 0.5 * f, most, log=True),
                Knob(f"notch_depth[{k}]", "", depth, 0.0, 1.0),
                Knob(f"notch_width[{k}]", "", width, 0.25 * width, 4.0 * width, log=True),
            ]
        return knobs

    def opened(self) -> dict[str, Any]:
        """The values for the page before anything is moved."""
        from sewfast.control.loop import noise_in_loop

        gains = self.start.gains
        return {
            "model": self.name,
            "stamp": self.stamp,
            "members": len(self.members),
            "knobs": [vars(knob) for knob in self.knobs],
            "level": self.steps.level,
            "step": self.steps.step,
            "disturbance": self.steps.disturbance,
            "limits": [self.start.u_min, self.start.u_max],
            "u_unit": gains.u_unit,
            "y_unit": gains.y_unit,
            "notes": self.start.notes,
            "noise": max(noise_in_loop(self.start, member) for member in self.members),
            "counts": self.start.counts_per_unit > 0.0,
        }

    def controller(self, values: Mapping[str, Any]) -> Controller:
        """The start with these values; for the values of a search, exactly its controller. Raises
        `SettingError` for an unknown name, or a value that is not a number in its range.
        """
        found = self._search_of(values)
        if found is not None:
            return found.controller
        wanted = self._checked(values)
        unmoved = {knob.name: knob.value for knob in self.knobs}
        if all(wanted.get(name, value) == value for name, value in unmoved.items()):
            return self.start
        start, leads = self.start, wanted.pop("feedforward", None)
        if leads is not None and bool(leads) != (start.feedforward is not None):
            start = replace(start, feedforward=self.lead if leads else None)
        return start.with_values(wanted, "tuned by hand in the studio")

    @cached_property
    def lead(self) -> Feedforward:
        """The feedforward that `sewfast.tune` adds to the start; a `SettingError` if none helps."""
        from sewfast.tuning import led

        controller, worth = led(self.start, self.model)
        if controller.feedforward is None:
            raise SettingError(
                name="feedforward", expected="one that helps on every model",
                received=f"none: {worth.reason}", remedy="go on without",
            )  # fmt: skip
        return controller.feedforward

    def _checked(self, values: Mapping[str, Any]) -> dict[str, float]:
        known = {knob.name: knob for knob in self.knobs}
        wanted = {}
        for name, value in values.items():
            if name not in known:
                raise SettingError(f"{name[:40]}: expected one of {', '.join(known)}")
            number = isinstance(value, (int, float)) and not isinstance(value, bool)
            if not (number and math.isfinite(value)):
                raise SettingError(f"{name}: expected a number, received {str(value)[:40]!r}")
            if known[name].whole and value != int(value):
                raise SettingError(f"{name}: expected a whole number, received {value}")
            if name == "feedforward" and value not in (0, 1):
                raise SettingError(f"{name}: expected 0 for off or 1 for on, received {value}")
            wanted[name] = float(value)
        return wanted

    # --- The loop ---------------------------------------------------------------------------------

    def move(
        self, values: Mapping[str, Any], *, noise: bool = False
    ) -> tuple[dict[str, Any], dict[str, FloatArray]]:
        """Step responses, L, S, T and figures of the loop with these values.

        Parameters
        ----------
        values : dict
        noise : bool
            Whether the steps measure the noise of each member's record.

        Returns
        -------
        numbers : dict
            `stable`, margins of the worst member and metrics of the steps.
        curves : dict of array
            By name: median, lowest and highest of the members.
        """
        from sewfast.analysis.points import loop_bodes
        from sewfast.analysis.responses import responses

        controller = self.controller(values)
        (bode,) = loop_bodes(controller, [self.points], self.slowest)
        numbers, curves = {**_margins(bode), "stamp": self.stamp}, bode_curves(bode)
        try:
            measured = None if noise else 0.0
            tracked, upset = responses(controller, self.members, self.titles, self.steps, measured)
        except FitError:
            return {**numbers, "diverges": True}, curves
        for kind, found in (("reference", tracked), ("disturbance", upset)):
            numbers |= {name: _worst(found, name) for name in found.metrics()[0]}
            curves |= {f"{kind}_t": found.t, f"{kind}_r": found.r}
            for name in "yu":
                curves |= band(f"{kind}_{name}", getattr(found, name))
        inside = tracked.u[:, tracked.t >= 0.0]
        numbers["u_rms"] = float(np.sqrt(np.mean(inside**2, axis=1)).max())
        numbers["u_peak"] = float(np.abs(inside).max())
        numbers["du_rms"] = float(np.sqrt(np.mean(np.diff(inside) ** 2, axis=1)).max())
        return {**numbers, "diverges": False}, curves

    @cached_property
    def judge(self) -> Judge:
        """Judges controllers on the model as a search does."""
        from sewfast.tuning import Judge

        return Judge(self.start, self.model)

    def judged(
        self, values: Mapping[str, Any], weights: Mapping[str, float] | None = None
    ) -> dict[str, Any]:
        """What a search would find of these values, and of the start.

        Parameters
        ----------
        values : dict
        weights : mapping, optional
            Fields of `sewfast.Cost` by name.
        """
        from sewfast.tuning import Cost

        several = [self.controller({}), self.controller(values)]
        start, here = self.judge.of(several, Cost(**(weights or {})))
        return {**vars(here), "start_cost": start.cost}

    def verdict(self, values: Mapping[str, Any]) -> dict[str, str]:
        """Grade and reasons of these gains, as `sewfast.tune` says them."""
        found = self.judge.verdict(self.controller(values))
        return {"grade": found.grade, "text": spoken(str(found))}

    def check(self, search: Search) -> None:
        """Check the settings of a search. Raises `SettingError`."""
        search.cost()
        search.limits()

    def search(
        self,
        values: Mapping[str, Any],
        search: Search,
        progress: Callable[[int, int, float], None],
    ) -> Found:
        """`sewfast.tune` from these values; the best so far if it is interrupted.

        Parameters
        ----------
        values : dict
        search : Search
        progress : callable
            Called with (done, total, lowest cost); a KeyboardInterrupt raised in it ends the
            search.

        Raises
        ------
        SettingError
            For values, weights or constraints out of range.
        FitError
            If every controller diverges or breaks a constraint.
        """
        from sewfast.tuning import tune

        start = self.controller(values)
        if start.feedforward is not None:
            search = replace(search, feedforward="preview")
        try:
            result = tune(
                self.model, start=start, cost=search.cost(),
                constraints=search.limits(), feedforward=search.feedforward,
                evaluations=search.evaluations, time_budget=search.seconds, seed=search.seed,
                progress=progress,
            )  # fmt: skip
        except Interrupted as stopped:
            # an interruption cannot be repeated: treat these as values set by hand
            return Found(self._values_of(stopped.best), stopped.best, start, None)
        return Found(
            self._values_of(result.pid), result.pid, start,
            None if result.termination == "time" else replace(search, seconds=None),
            result.cost, result.start_cost, result.termination, str(result.verdict),
        )  # fmt: skip

    def front(
        self,
        values: Mapping[str, Any],
        search: Search,
        progress: Callable[[int, int, float], None],
    ) -> dict[str, Any]:
        """`sewfast.pareto` from these values, the calmest controller first; as `search`."""
        from sewfast.tuning import pareto
        from sewfast.tuning.front import ParetoFront

        try:
            found = pareto(
                self.model, objectives=FRONT, start=self.controller(values), cost=search.cost(),
                constraints=search.limits(), evaluations=search.evaluations,
                time_budget=search.seconds, seed=search.seed, progress=progress,
            )  # fmt: skip
        except Interrupted as stopped:
            if not isinstance(stopped.best, ParetoFront):
                raise
            found = stopped.best
        # the controllers are sorted by their cost
        front = [
            {"values": self._values_of(controller), "cost": cost, "Ms": Ms}
            for controller, (cost, Ms) in zip(found.controllers, found.values.tolist(), strict=True)
        ]
        return {"front": front[::-1]}

    def keep(self, found: Found) -> dict[str, Any]:
        """Store a search, so that its copy repeats it; return its result for the page."""
        if found.search is not None:
            self._found.append(found)
        return {
            "values": found.values,
            "interrupted": found.ended == "interrupted",
            "ended": found.ended,
            "cost": found.cost,
            "start_cost": found.start_cost,
            "verdict": found.verdict and spoken(found.verdict),
        }

    def _values_of(self, controller: Controller) -> dict[str, float]:
        values = {**vars(controller), **controller.gains.to_dict()}
        values["feedforward"] = controller.feedforward is not None
        for k, biquad in enumerate(controller.biquads):
            if biquad.kind == "notch":
                values |= {f"notch_{name}[{k}]": x for name, x in biquad.named().items()}
        return {knob.name: float(values[knob.name]) for knob in self.knobs}

    def _search_of(self, values: Mapping[str, Any]) -> Found | None:
        given = dict(values)
        return next((found for found in self._found if found.values == given), None)

    # --- Copies -----------------------------------------------------------------------------------

    def python(self, values: Mapping[str, Any], file: str) -> str:
        """A script that writes the same controller file, to run in the project folder."""
        lines = ["import math", "", "import sewfast", ""]
        lines.append(f"model = sewfast.load_model({self.name!r})")
        found = self._search_of(values)
        if found is None:
            lines.append(f"controller = {_call(self.controller(values))}")
        else:
            lines.append(f"start = {_call(found.start)}")
            assert found.search is not None
            options = found.search.python()
            lines.append(f"controller = sewfast.tune(model, start=start, {options}).controller")
        lines += [f"controller.save({file!r})", "print(sewfast.analyse(controller, model))"]
        return "\n".join(lines) + "\n"

    def commands(self, values: Mapping[str, Any], file: str) -> str:
        """The same for a shell in the project folder."""
        found = self._search_of(values)
        model = _word(self.name)
        if found is None:
            written, lines = file, []
        else:
            assert found.search is not None
            written = f"start-{file}"
            options = found.search.command()
            lines = [f"sewfast tune {model} --start {written} {options} -o {file}"]
        first = self.controller(values) if found is None else found.start
        document = [f"cat > {written} <<'END'", _document(first), "END"]
        return "\n".join([*document, *lines, f"sewfast analyse {file} {model}"]) + "\n"


def _factors(name: str, unit: str, value: float) -> Knob:
    """A setting with the range from a quarter to four times its value."""
    return Knob(name, unit, value, 0.25 * value, 4.0 * value, log=True)


def _margins(bode: LoopBode) -> dict[str, Any]:
    """Each figure of the worst member."""
    rows = bode.margins
    stable = all(row.stable for row in rows)
    crossovers = [w for row in rows for w in row.gain_crossovers]
    return {
        "stable": stable,
        "Ms": max(row.Ms for row in rows),
        "Mt": max(row.Mt for row in rows),
        "gain_margin": min(row.gain_margin for row in rows),
        "phase_margin_deg": min(row.phase_margin_deg for row in rows),
        "delay_margin_ms": 1e3 * min(row.delay_margin_s for row in rows),
        "noise_gain": max(row.noise_gain for row in rows),
        "crossover_hz": max(crossovers) / (2.0 * math.pi) if crossovers else math.nan,
    }


def bode_curves(bode: LoopBode) -> dict[str, FloatArray]:
    curves = {"hertz": bode.hertz}
    for name in "LST":
        size = np.maximum(np.abs(getattr(bode, name)), 1e-300)
        curves |= band(f"{name}_db", 20.0 * np.log10(size))
    phase = np.degrees(np.unwrap(np.angle(bode.L), axis=1))
    readable = np.abs(bode.L) > 10.0 ** (READABLE_DB / 20.0)
    curves |= band("L_deg", np.where(readable, phase, np.nan))
    return curves


def band(name: str, rows: FloatArray) -> dict[str, FloatArray]:
    """Median, lowest and highest of the members; for one member its curve alone."""
    if len(rows) == 1:
        return {name: rows[0]}
    found = {name: np.median(rows, axis=0)}
    return found | {f"{name}_low": rows.min(axis=0), f"{name}_high": rows.max(axis=0)}


def _worst(found: Responses, name: str) -> float | None:
    """The largest of all members; None if one has none, such as a rise that does not end."""
    values = [row[name] for row in found.metrics()]
    return None if None in values else max((v for v in values if v is not None), key=abs)


def _call(controller: Controller) -> str:
    """The call that constructs a controller, with every bit of its numbers."""
    gains = controller.gains
    numbers = ", ".join(_number(getattr(gains, name)) for name in ("Kp", "Ti", "Td"))
    units = f"u_unit={gains.u_unit!r}, y_unit={gains.y_unit!r}"
    plain = type(controller)(gains=gains)
    others = {
        name: value
        for name, value in vars(controller).items()
        if name != "gains" and (name == "Ts" or value != getattr(plain, name))
    }
    rows = [f"    gains=sewfast.Gains.standard({numbers}, {units}),"]
    rows += [f"    {name}={_number(value)}," for name, value in others.items()]
    return "\n".join(["sewfast.Controller(", *rows, ")"])


def _number(value: Any) -> str:
    from sewfast.control.feedforward import Feedforward

    if isinstance(value, tuple):  # of biquads
        parts = [f"sewfast.Biquad({b.kind!r}, {b.numbers!r})" for b in value]
        return f"({', '.join(parts)},)"
    if isinstance(value, Feedforward):
        return f"sewfast.{value!r}"
    if isinstance(value, float) and math.isinf(value):
        return "math.inf" if value > 0 else "-math.inf"
    return repr(value)


def _document(controller: Controller) -> str:
    """The text of its file."""
    head = {"format": controller.FORMAT, "version": controller.VERSION}
    return json.dumps({**head, **controller.to_dict()}, indent=1)


def _word(text: str) -> str:
    return shlex.quote(f"./{text}" if text.startswith("-") else text)


# --- Search: its settings, its result, and how both are copied ------------------------------------


@dataclass(frozen=True)
class Search:
    """How to search for a controller, and what is a good one. `evaluations` and `seed` are as for
    `sewfast.tune`, `seconds` is its `time_budget`; when a search ends by time, its copy is the
    controller that it found. `weights` are fields of `sewfast.Cost` by name; `constraints` are
    ``Ms``, ``overshoot`` [%] and ``u`` of `sewfast.Constraints`.
    """

    evaluations: int
    seed: int
    seconds: float | None = None
    weights: Mapping[str, float] = field(default_factory=dict)
    constraints: Mapping[str, float] = field(default_factory=dict)
    feedforward: Lead = "none"

    def cost(self) -> Cost:
        """The weights; those that are not given are the defaults."""
        from sewfast.tuning import Cost

        return Cost(**self.weights)

    def limits(self) -> Constraints:
        """The constraints."""
        from sewfast.tuning import Constraints

        return Constraints(**self.constraints)

    def python(self) -> str:
        """Arguments of `sewfast.tune`."""
        words = [
            f"feedforward={self.feedforward!r}, evaluations={self.evaluations}, seed={self.seed}"
        ]
        if self.weights:
            words.append(f"cost=sewfast.Cost({_named(self.weights)})")
        if self.constraints:
            words.append(f"constraints=sewfast.Constraints({_named(self.constraints)})")
        return ", ".join(words)

    def command(self) -> str:
        """Options of `sewfast tune`."""
        lead = "--no-feedforward" if self.feedforward == "none" else "--feedforward=preview"
        words = [lead, f"--evaluations={self.evaluations}", f"--seed={self.seed}"]
        words += [f"--cost {name}={value!r}" for name, value in self.weights.items()]
        words += [f"--constraint {name}={value!r}" for name, value in self.constraints.items()]
        return " ".join(words)


@dataclass(frozen=True)
class Found:
    """What a search found, with what finds it again; `search` is None where nothing does."""

    values: dict[str, float]
    controller: Controller
    start: Controller
    search: Search | None
    cost: float | None = None
    start_cost: float | None = None
    ended: str = "interrupted"
    verdict: str | None = None


def _named(values: Mapping[str, float]) -> str:
    return ", ".join(f"{name}={value!r}" for name, value in values.items())
