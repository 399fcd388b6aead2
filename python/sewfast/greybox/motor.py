"""`Motor`: the parameters that a record determines, the others, and what to derive from them."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, ClassVar, TypeAlias

import numpy as np
from numpy.typing import ArrayLike

from .. import _core, storage
from ..arrays import FloatArray, as_column
from ..errors import DataError, SettingError
from ..frequency.shaft import Parameter, sampled_model
from ..machine import VirtualMachine
from ..models import LinearOE
from ..motorfit import WAVES, Estimated, rad_per_second
from ..motorfit.estimation import CONFIDENCE
from ..motorfit.problem import State
from ..motorfit.terms import Values, profiled, slope_of, values_of
from ..plotting import LOOKS, Drawing
from ..tables import Shown
from .exports import Target, Winding, export

if TYPE_CHECKING:
    from matplotlib.axes import Axes

"""Version 1 has `untold` for `undetermined`, version 2 no `orders`; both are read."""
NAMES = tuple(_core.GREYBOX_PARAMETERS)
VAGUE = 1.0
"""Half-width of an interval, relative to the value, above which a parameter is not printed."""
APART = 10.0
"""Half-width, relative to the value, above which other parameters can replace it."""

_SI = ("resistance", "motor_constant", "inertia", "viscous_friction", "coulomb_torque")
_NO_CURRENT = (
    "command and speed alone fix only its ratios to the others, in k_v, k_a and k_s; pass current"
)
_NO_VOLTS = (
    "it scales with the volts on the winding per unit of command; pass volts (1 where the command "
    "is that voltage)"
)


class Findings(storage.Stored, Shown):
    """Parameters with their intervals, and the reasons why the record does not determine others."""

    parameters: Mapping[str, Parameter]
    undetermined: Mapping[str, str]

    def value(self, name: str) -> float:
        """A parameter's value.

        Raises
        ------
        DataError
            If the record does not determine it; the message gives the reason.
        """
        if name in self.parameters:
            return self.parameters[name].value
        if name in self.undetermined:
            raise DataError(f"{name}: {self.undetermined[name]}")
        raise DataError(
            name=name, expected=f"a parameter of {', '.join(self.parameters)}",
            received=repr(name),
        )  # fmt: skip

    def _lines(self) -> list[str]:
        """A line for each parameter, and for each reason the names of those that it concerns."""
        width = max(map(len, self.parameters), default=0)
        found = [f"  {name:<{width}}  {p}" for name, p in self.parameters.items()]
        for why in dict.fromkeys(self.undetermined.values()):
            names = [name for name, reason in self.undetermined.items() if reason == why]
            found.append(f"  not determined: {', '.join(names)}: {why}")
        return found


@dataclass(frozen=True, eq=False, repr=False)
class Motor(Findings):
    """The parameters of a motor, identified from a record.

    Attributes
    ----------
    parameters : mapping of Parameter by name
        Value, 95 % interval and unit. `k_v`, `k_a`, `k_s`: command per speed, per acceleration and
        against dry friction; `time_constant`; of the detectable terms `electrical_lag`,
        `delay` beyond the hold, `offset`, `drop` (dead zone of the inverter), `stribeck` and
        `stribeck_speed`, `load_1`, `load_2`, `load_6` .. (amplitude once, twice, six times per
        turn), `inertia_2`, `torque_ripple` (relative), `limit`, `stribeck_difference`, `sag`,
        `eccentricity`. With a current also `k_e`, `k_b` (back-EMF, viscous) and `resistance` per
        unit of command; with volts R, Ke, J, friction and inductance in SI units.
    undetermined : mapping of str by name
        Parameters that the record does not determine, and why.
    terms : tuple of str
        Terms that the record shows besides back-EMF and inertia.
    fit_percent, rmse : float
        Fit of the free run on the record, after its start; rmse in `speed_unit`.
    converged : bool
        Whether the least-squares minimum was confirmed, or any further gain is within the noise.
    """

    FORMAT: ClassVar[str] = "sewfast-motor"
    VERSION: ClassVar[int] = 3

    parameters: Mapping[str, Parameter]
    undetermined: Mapping[str, str]
    terms: tuple[str, ...]
    fit_percent: float
    rmse: float
    converged: bool
    samples: int
    spikes: int
    Ts: float
    u_unit: str
    speed_unit: str
    u_limit: float
    counts_per_rev: float | None
    volts: float | None
    resistance: float | None
    theta: FloatArray
    orders: tuple[int, ...] = (0,) * len(WAVES)
    """Orders per turn of three cogging terms and of the torque ripple; 0 for none."""
    shown: tuple[FloatArray, FloatArray] | None = field(default=None)
    """Speed, measured and in the free run [rad/s], for plots; not stored in files."""

    def simulate(self, u: ArrayLike, *, Ts: float | None = None, speed: float = 0.0) -> FloatArray:
        """Speed [speed_unit] under commands, (N,), from an initial speed; the angle starts at zero.

        Raises
        ------
        DataError
            If the commands are not finite, one-dimensional numbers, or the speed is not.
        """
        step = self.Ts if Ts is None else float(Ts)
        factor = rad_per_second(self.speed_unit)
        steps = math.ceil(min(max(step / self._fine(), 1.0), 10_000.0))
        y, *_ = _core.greybox_run(
            self.theta, [], as_column(u, "u"), Ts=step, steps=steps, speed=factor * float(speed),
            orders=self.orders,
        )  # fmt: skip
        if not np.isfinite(y).all():
            raise DataError(
                name="simulate", expected="a speed that stays finite", received="one that does not",
                remedy="check the sizes of command and sample time, or identify the motor again",
            )  # fmt: skip
        return np.asarray(y / factor)

    def _fine(self) -> float:
        tau, k_a = self.theta[NAMES.index("tau")], self.theta[NAMES.index("k_a")]
        fast = k_a / max(self.theta[0] + self.theta[1], 1e-12) / 30.0
        return max(float(min(fast, tau / 2.0) if tau > 1e-6 * fast else fast), 1e-300)

    def to_model(self) -> LinearOE:
        """The turning motor as a linear model at the samples, without dry friction and loads."""
        of = self.of
        k_v, tau = of["k_e"] + of["k_b"], max(of["tau"], 1e-3 * self.Ts)
        gain = 1.0 / (k_v * rad_per_second(self.speed_unit))
        lags = (of["k_a"] + tau * of["k_b"]) / k_v, tau * of["k_a"] / k_v
        # an inertia of 0 has no lag, but a logarithm
        theta = np.array([*np.log(np.maximum([gain, *lags], 1e-300)), of["delay"] / self.Ts])
        return sampled_model(theta, self.Ts, self.u_unit, self.speed_unit)

    def machine(self, *, u_limit: float | None = None) -> VirtualMachine:
        """A virtual machine with this behaviour: a twin to tune and rehearse on.

        If R, Ke and J are not known individually, it has values that give the same speed; its
        current then has no unit. It lacks dead time beyond the hold, cogging of orders above 2, sag
        of the supply, eccentricity of the encoder, and Stribeck friction that differs by direction;
        it includes a torque ripple of four times per turn.

        Parameters
        ----------
        u_limit : float, optional
            The command at which the drive clips, which a record does not show; by default so large
            that it hardly ever clips.

        Raises
        ------
        SettingError
            If the parameters lie outside those of virtual machines.
        """
        refused: SettingError | None = None
        known = None if self.volts is None else self.resistance
        scales = [] if known is None else [(self.volts or 1.0, known * (self.volts or 1.0))]
        scales += [(g, r) for g in (15.0, 1.0, 100.0) for r in (10.0, 1.0, 100.0, 1000.0)]
        for volts, ohms in scales:
            try:
                return self._twin(volts, ohms, u_limit)
            except SettingError as e:
                refused = refused or e
        raise SettingError(f"this motor lies outside virtual machines: {refused}")

    def _twin(self, volts: float, ohms: float, u_limit: float | None) -> VirtualMachine:
        of = self.of
        constant = of["k_e"] * volts  # V s/rad, which is N m/A
        torque = constant * volts / ohms  # N m per unit of command
        drop, pwm, bus = of["drop"] * volts, 1e4, 2000.0
        first = _amplitude("load_1")(of)
        second = _amplitude("load_2")(of)
        wave = _amplitude("inertia_2")(of)
        current = of["limit"] * volts / ohms
        values = {
            "amplifier_gain": volts,
            "bus_voltage": bus,
            "pwm_frequency": pwm,
            "dead_time": drop / (pwm * bus),
            "ripple_current": max(of["ripple"] * volts / ohms, 0.02) if drop else 0.08,
            "resistance": ohms,
            "inductance": max(of["tau"] * ohms, 0.01),
            "motor_constant": constant,
            "current_limit": current if math.isfinite(current) else 1000.0,
            "inertia": of["k_a"] * torque,
            "inertia_variation": wave / of["k_a"],
            "inertia_angle": 0.5 * math.atan2(of["inertia_2s"], of["inertia_2c"]),
            "coulomb_torque": of["k_s"] * torque,
            "stribeck_torque": of["k_t"] * torque,
            "stribeck_speed": max(of["w_s"], 1.0),
            "viscous_friction": of["k_b"] * torque,
            "load_first": first * torque,
            "load_first_angle": math.atan2(of["load_1s"], of["load_1c"]),
            "load_second": second * torque,
            "load_second_angle": 0.5 * math.atan2(of["load_2s"], of["load_2c"]),
            "torque_ripple": _amplitude("torque_ripple_")(of),
            "torque_ripple_angle": 0.25 * math.atan2(of["torque_ripple_s"], of["torque_ripple_c"]),
            "encoder_phase": 0.5,
            "counts_per_rev": self.counts_per_rev or 1572.0,
        }
        values["u_limit"] = min(bus / volts, 1000.0) if u_limit is None else u_limit
        if self.orders[WAVES.index("torque_ripple")] != 4:
            values["torque_ripple"] = 0.0
        machine = VirtualMachine(parameters=values)
        machine.set_load(of["offset"] * torque)
        return machine

    def export(self, target: Target, *, winding: Winding | None = None, gear: float = 1.0) -> str:
        """Settings of another tool, as text.

        Parameters
        ----------
        target : "wpilib", "mujoco", "urdf", "odrive", "moteus" or "simplefoc"
            `wpilib`: kS, kV, kA as JSON, kV and kA per rad/s and per rad/s^2, kG for a constant
            load and, for an arm on the shaft, kG_cos and the angle at which it is horizontal.
            `mujoco`: joint and actuator elements; `urdf`: the joint's dynamics. Boards: resistance
            and inductance of a phase, KV or torque constant per amplitude along q, inertia; the
            text lists settings that the record cannot determine. All but `wpilib` use SI units.
        winding : "line" or "q"
            Meaning of the record's volts and amperes: between two terminals, as for a DC motor, or
            amplitudes along the q axis, as boards log them. Required for boards; without it, a
            simulator gets a DC motor. With "q", torques and inertia are 3/2 of those printed.
        gear : float
            Turns of the motor per turn of the joint or mechanism of the settings; the record has
            the motor's speed. Not for boards.

        Raises
        ------
        SettingError
            For another target, a board without `winding` or with a gear, or a gear not above 0.
        DataError
            If the record does not determine what the target needs.
        """
        return export(self, target, winding, gear)

    def turn_load(self, angle: ArrayLike) -> FloatArray:
        """Command that balances the loads which vary over the turn, at angles [rad], (N,).

        Loads once and twice per turn and cogging, without the constant load: as a feed-forward it
        removes their effect on the speed. Angles are those of the record; for a `Recording` those
        of its counts.

        Raises
        ------
        DataError
            If the angles are not finite, one-dimensional numbers.
        """
        at, of = as_column(angle, "angle"), self.of
        waves = [(1, "load_1"), (2, "load_2"), *zip(self.orders, WAVES[:3], strict=False)]
        sums = [of[w + "c"] * np.cos(n * at) + of[w + "s"] * np.sin(n * at) for n, w in waves]
        return np.asarray(np.sum(sums, axis=0))

    @property
    def of(self) -> dict[str, float]:
        """Fitted values by their names in the equations; 0 for a term that is not shown."""
        return dict(zip(NAMES, self.theta.tolist(), strict=True))

    def to_dict(self) -> dict[str, Any]:
        """Everything except the plotted runs, as JSON values."""
        limit = NAMES.index("limit")
        theta = [None if j == limit and math.isinf(v) else v for j, v in enumerate(self.theta)]
        return {
            "parameters": {n: vars(p) for n, p in self.parameters.items()},
            "undetermined": dict(self.undetermined),
            "terms": list(self.terms),
            **{n: getattr(self, n) for n in _NUMBERS},
            "u_unit": self.u_unit,
            "speed_unit": self.speed_unit,
            "theta": dict(zip(NAMES, [v if v is None else float(v) for v in theta], strict=True)),
            "orders": list(self.orders),
        }

    def plot(self, ax: Any = None, *, file: str | os.PathLike[str] | None = None) -> Any:
        """Draw measured speed and free run, the command to hold a speed, and any cogging.

        Arguments and result are those of `Dataset.plot`.
        """
        return self.drawing().plot(ax, file)

    def drawing(self) -> Drawing:
        """The picture."""
        factor = rad_per_second(self.speed_unit)

        def run_panel(ax: Axes) -> None:
            assert self.shown is not None
            n = min(len(self.shown[0]), max(200, round(4.0 / self.Ts)))
            t = self.Ts * np.arange(n)
            for values, look in zip(self.shown, ("measured", "model"), strict=True):
                label = "measured" if look == "measured" else "free run"
                style = {k: v for k, v in LOOKS[look].items() if k != "lw"}
                ax.plot(t, values[:n] / factor, label=label, lw=0.9, **style)
            ax.set_xlabel("time [s]")
            ax.set_ylabel(f"speed [{self.speed_unit}]")
            ax.legend(loc="upper right")

        def friction_panel(ax: Axes) -> None:
            of = self.of
            usual = 100.0 if self.shown is None else float(np.abs(self.shown[0]).max())
            top = min(usual, 15.0 * of["w_s"]) if of["k_t"] else usual
            half = np.linspace(1e-4 * top, top, 400)
            speeds = np.concatenate([-half[::-1], half])
            sign = np.sign(speeds)
            bump = (of["k_t"] + of["k_d"] * sign) / (1.0 + (speeds / of["w_s"]) ** 2)
            dry = sign * (of["k_s"] + of["drop"] + bump) + of["offset"]
            viscous = (of["k_e"] + of["k_b"]) * speeds
            for look, hold, label in (
                ("model", dry + viscous, "to hold the speed"),
                ("measured", dry, "of it dry friction, dead zone, constant load"),
            ):
                ax.plot(speeds / factor, hold, label=label, **LOOKS[look])
            ax.set_xlabel(f"speed [{self.speed_unit}]")
            ax.set_ylabel(f"command [{self.u_unit}]")
            ax.legend(loc="upper left")

        def turn_panel(ax: Axes) -> None:
            angle = np.linspace(0.0, 2.0 * math.pi, 1000)
            ax.plot(np.degrees(angle), self.turn_load(angle), **LOOKS["model"])
            ax.set_xlabel("angle of the shaft [deg]")
            ax.set_ylabel(f"load [{self.u_unit}]")
            ax.set_xlim(0.0, 360.0)

        panels = (friction_panel,) if self.shown is None else (run_panel, friction_panel)
        if any(self.orders[:3]):
            panels = (*panels, turn_panel)
        heights = (2.4,) * len(panels)
        return Drawing(tuple((p,) for p in panels), heights, share_x=False)

    def __str__(self) -> str:
        terms = ", ".join(self.terms) or "no further terms"
        lines = [
            f"motor: free run {self.fit_percent:.2f} %, {self.rmse:.3g} {self.speed_unit} rmse of "
            f"{self.samples:,} samples ({terms}); 95 % intervals"
        ]
        lines += self._lines()
        if not self.converged:
            lines.append("  note: the least squares did not converge; intervals may be wrong")
        if self.spikes:
            lines.append(f"  note: {self.spikes} spikes left out")
        return "\n".join(lines)


_NUMBERS = (
    "fit_percent", "rmse", "converged", "samples", "spikes", "Ts", "u_limit", "counts_per_rev",
    "volts", "resistance",
)  # fmt: skip


def stored_parameters(fields: storage.Fields) -> tuple[dict[str, Parameter], dict[str, str]]:
    """From a file: parameters, reasons for undetermined ones."""
    stored, undetermined = fields.object("parameters"), fields.object("undetermined")
    parameters = {}
    for name in stored.values:
        one = stored.object(name)
        one.require_only(["value", "low", "high", "unit"])
        value, low, high = (one.number(n) for n in ("value", "low", "high"))
        parameters[name] = Parameter(value, low, high, one.text("unit"))
    return parameters, {n: undetermined.text(n) for n in undetermined.values}


def findings(fields: storage.Fields) -> tuple[dict[str, Parameter], dict[str, str], str]:
    """From a file: parameters, reasons for undetermined ones, unit of the speed."""
    parameters, undetermined = stored_parameters(fields)
    unit = fields.text("speed_unit")
    try:
        rad_per_second(unit)
    except SettingError:
        raise fields.refuse("speed_unit", "rpm, rev/s, rad/s or deg/s", unit) from None
    return parameters, undetermined, unit


def load_motor(path: str | os.PathLike[str]) -> Motor:
    """Read a file of `Motor.save`; nothing in it is executed.

    Raises
    ------
    ModelFileError
        For any other file.
    """
    document = storage.read(path, Motor.FORMAT, (1, 2, Motor.VERSION))
    if document["version"] == 1 and "untold" in document:
        document["undetermined"] = document.pop("untold")
    if document["version"] < Motor.VERSION:  # terms added later
        document.setdefault("orders", [0] * len(WAVES))
        if isinstance(document.get("theta"), dict):
            # first of the parameters that files before version 3 lack
            document["theta"] = (
                dict.fromkeys(NAMES[NAMES.index("limit") + 1 :], 0.0) | document["theta"]
            )
    fields = storage.Fields(str(path), document)
    names = ("version", "parameters", "undetermined", "terms", *_NUMBERS)
    fields.require_only([*names, "u_unit", "speed_unit", "theta", "orders"])
    parameters, undetermined, unit = findings(fields)
    theta = fields.object("theta")
    theta.require_only(NAMES)
    values = [math.inf if n == "limit" and theta.any(n) is None else theta.number(n) for n in NAMES]
    for name in ("k_a", "ripple", "w_s"):
        theta.positive(name)
    if theta.number("k_e") + theta.number("k_b") <= 0.0:
        raise theta.refuse("k_e", "a motor that turns faster at a larger command", theta.any("k_e"))
    if not 0.0 <= theta.number("delay") <= 1000.0 * fields.positive("Ts"):
        raise theta.refuse("delay", "0 to 1,000 sample times", theta.any("delay"))
    orders = fields.items("orders")
    if len(orders) != len(WAVES) or not all(type(n) is int and 0 <= n <= 10_000 for n in orders):
        raise fields.refuse("orders", f"{len(WAVES)} whole numbers from 0 to 10,000", orders)
    terms = fields.items("terms")
    if not all(isinstance(t, str) for t in terms):
        raise fields.refuse("terms", "names", terms)
    return Motor(
        parameters, undetermined, tuple(terms), speed_unit=unit, theta=np.array(values),
        orders=tuple(orders), **fields.take(
            number="fit_percent rmse", flag="converged", integer="samples spikes",
            positive="Ts u_limit", text="u_unit", optional_number="counts_per_rev volts resistance",
        ),
    )  # fmt: skip


# --- From the estimate to a motor -----------------------------------------------------------------


def motor_of(found: Estimated, volts: float | None, *, profile: bool) -> Motor:
    """The motor of an estimate: each parameter with its interval, or the reason for having none."""
    estimate, records, reasons = found.state, found.records, found.reasons
    known, names = values_of(estimate), estimate.names()
    spreads = np.sqrt(np.maximum(np.diag(found.covariance), 0.0))
    parameters: dict[str, Parameter] = {}
    undetermined: dict[str, str] = {}
    of_term = _OF_TERM | {
        t: (f"load_{n}",) for t, n in zip(WAVES[:3], estimate.orders, strict=False)
    }
    hidden = {name for term in reasons for name in of_term[term]}
    for name, unit, of in _quantities(estimate, records.u_unit, volts):
        if name in hidden:
            continue
        value = of(known)
        slope = slope_of(known, of, names, spreads)
        half = CONFIDENCE * math.sqrt(max(float(slope @ found.covariance @ slope), 0.0))
        vague = half >= VAGUE * abs(value)
        if name == "delay":  # a delay of zero is a valid result
            vague = half >= APART * max(value, records.Ts)
        if not math.isfinite(half) or vague:
            undetermined[name] = (
                "the record does not part it from the others; add steps to several speeds, in both "
                "directions"
                if not half < APART * abs(value) or name == "delay"
                else f"its interval, {value - half:.3g} to {value + half:.3g} {unit}, is as wide "
                "as its value"
            )
            continue
        low, high = value - half, value + half
        if profile and half > 0.0:
            low, high = profiled(found, of, slope, half)
        if name not in _SIGNED:
            low = max(low, 0.0)
        parameters[name] = Parameter(value, low, high, unit)
    for term, why in reasons.items():
        for name in of_term[term]:
            undetermined.setdefault(name, why)
    missing = _NO_CURRENT if estimate.resistance is None else _NO_VOLTS
    if estimate.resistance is None or volts is None:
        undetermined |= {"resistance_ohm" if n == "resistance" else n: missing for n in _SI}
    if volts is not None and estimate.resistance is not None:
        parameters["volts"] = Parameter(volts, volts, volts, f"V/{records.u_unit}".rstrip("/"))
    y, model = found.problem.outcome(estimate)
    error, factor = y - model, rad_per_second(records.speed_unit)
    spread = float(np.linalg.norm(y - y.mean()))
    return Motor(
        parameters,
        undetermined,
        estimate.terms,
        100.0 * (1.0 - float(np.linalg.norm(error)) / max(spread, 1e-300)),
        float(np.sqrt(np.mean(error**2))) / factor,
        found.problem.converged,
        len(y),
        records.spikes,
        records.Ts,
        records.u_unit,
        records.speed_unit,
        float(max(np.abs(p.u).max() for p in records.pieces)),
        records.counts_per_rev,
        volts,
        estimate.resistance,
        estimate.theta,
        estimate.orders,
        (y, model),
    )


_SIGNED = ("offset", "k_b", "viscous_friction", "stribeck_difference", "sag")

_OF_TERM = {
    "inertia": ("k_a", "time_constant", "inertia"),
    "lag": ("electrical_lag",),
    "delay": ("delay",),
    "coulomb": ("k_s",),
    "offset": ("offset",),
    "drop": ("drop",),
    "stribeck": ("stribeck", "stribeck_speed"),
    "load_1": ("load_1",),
    "load_2": ("load_2",),
    "inertia_2": ("inertia_2",),
    "limit": ("limit",),
    "stribeck_difference": ("stribeck_difference",),
    "sag": ("sag",),
    "eccentricity": ("eccentricity",),
    "cogging": ("cogging",),
    "torque_ripple": ("torque_ripple",),
}

Quantity: TypeAlias = tuple[str, str, Callable[[Values], float]]


def _amplitude(wave: str) -> Callable[[Values], float]:
    """Amplitude of a wave from its cosine and sine."""
    return lambda p: math.hypot(p[wave + "c"], p[wave + "s"])


def _quantities(estimate: State, u: str, volts: float | None) -> list[Quantity]:
    """Name, unit and value of every quantity that can be printed."""
    u = u or "command"
    found: list[Quantity] = [
        ("k_v", f"{u}/(rad/s)", lambda p: p["k_e"] + p["k_b"]),
        ("k_a", f"{u}/(rad/s^2)", lambda p: p["k_a"]),
        ("time_constant", "s", lambda p: (p["k_a"] + p["tau"] * p["k_b"]) / (p["k_e"] + p["k_b"])),
    ]
    of_terms: dict[str, list[Quantity]] = {
        "lag": [("electrical_lag", "s", lambda p: p["tau"])],
        "delay": [("delay", "s", lambda p: p["delay"])],
        "coulomb": [("k_s", u, lambda p: p["k_s"])],
        "offset": [("offset", u, lambda p: p["offset"])],
        "drop": [("drop", u, lambda p: p["drop"])],
        "stribeck": [
            ("stribeck", u, lambda p: p["k_t"]),
            ("stribeck_speed", "rad/s", lambda p: p["w_s"]),
        ],
        "load_1": [("load_1", u, _amplitude("load_1"))],
        "load_2": [("load_2", u, _amplitude("load_2"))],
        "inertia_2": [("inertia_2", "1", lambda p: _amplitude("inertia_2")(p) / p["k_a"])],
        "limit": [("limit", u, lambda p: p["limit"])],
        "stribeck_difference": [("stribeck_difference", u, lambda p: p["k_d"])],
        "sag": [("sag", f"1/{u}^2", lambda p: p["sag"])],
        "eccentricity": [("eccentricity", "1", _amplitude("eccentric_"))],
        "torque_ripple": [("torque_ripple", "1", _amplitude("torque_ripple_"))],
    }
    for term, order in zip(WAVES[:3], estimate.orders, strict=False):
        of_terms[term] = [(f"load_{order}", u, _amplitude(term))]
    for term in estimate.terms:
        found += of_terms[term]
    if estimate.resistance is None:
        return found
    found += [
        ("k_e", f"{u}/(rad/s)", lambda p: p["k_e"]),
        ("k_b", f"{u}/(rad/s)", lambda p: p["k_b"]),
        ("resistance", f"{u}/A", lambda p: p["R"]),
    ]
    if volts is None:
        return found
    G = volts
    found += [
        ("resistance_ohm", "ohm", lambda p: p["R"] * G),
        ("motor_constant", "V s/rad", lambda p: p["k_e"] * G),
        ("inertia", "kg m^2", lambda p: p["k_a"] * p["k_e"] * G / p["R"]),
        ("viscous_friction", "N m s/rad", lambda p: p["k_b"] * p["k_e"] * G / p["R"]),
    ]
    if "coulomb" in estimate.terms:
        found.append(("coulomb_torque", "N m", lambda p: p["k_s"] * p["k_e"] * G / p["R"]))
    if "stribeck" in estimate.terms:
        found.append(("stribeck_torque", "N m", lambda p: p["k_t"] * p["k_e"] * G / p["R"]))
    if "lag" in estimate.terms:
        found.append(("inductance", "H", lambda p: p["tau"] * p["R"] * G))
    if "limit" in estimate.terms:
        found.append(("current_limit", "A", lambda p: p["limit"] / p["R"]))
    return found
