"""Named signals: excitations in volt for recordings, references in RPM for closed loops."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from . import _core
from .arrays import FloatArray, is_whole
from .errors import SettingError

#: Sample time of every named signal [s].
TS = 0.001
#: Steady gain of the drive's middle range [RPM/V] (paper Eq. 8), used to plan jumps.
GAIN = 490.0
#: Acceleration at the drive's current limit [RPM/s].
ACCELERATION = 25_000.0


@dataclass(frozen=True)
class Signal:
    """A named signal.

    Attributes
    ----------
    name
        Name on the command line.
    unit
        ``V`` for an excitation, ``RPM`` for a reference.
    duration_s
        Length [s].
    description
        Description and purpose.
    low, high
        Limits of the amplitude [unit].
    rate
        Limit of the rate of change [unit/s]; infinity for none.
    shape
        Function of the seed that generates the signal before the limits.
    """

    name: str
    unit: str
    duration_s: float
    description: str
    low: float
    high: float
    rate: float
    shape: Callable[[int], FloatArray]

    def generate(self, seed: int = 0) -> FloatArray:
        """The samples at ``TS``, within the limits: float64 (N,).

        Raises
        ------
        SettingError
            For a seed that is not a whole number of 0 to 2^64 - 1.
        """
        return _core.limit(
            self.shape(_checked(seed)),
            Ts=TS,
            low=self.low,
            high=self.high,
            rate=self.rate,
            slew=math.inf,
        )


def _named_signal(
    unit: str,
    name: str,
    description: str,
    make: Callable[..., FloatArray],
    *,
    is_random: bool = False,
    **settings: Any,
) -> Signal:
    """An excitation or a reference within its limits: `make` with the settings and, if it is
    random, the seed.
    """

    def shape(seed: int) -> FloatArray:
        return make(Ts=TS, **settings, **({"seed": seed} if is_random else {}))

    limits = {"V": (-20.0, 20.0, math.inf), "RPM": (0.0, 3500.0, 20_000.0)}[unit]
    return Signal(name, unit, settings["duration"], description, *limits, shape)


_excitation, _reference = partial(_named_signal, "V"), partial(_named_signal, "RPM")


def _other_jumps(*, seed: int, **settings: Any) -> FloatArray:
    # a stream other than that of `saturating` for the same seed
    return _core.jumps(seed=seed ^ 0x5EED_2, **settings)


#: Height [RPM], rise, hold, fall and pause after it [s] of the reference `trapezoids`.
TRAPEZOIDS = (
    (1500.0, 0.25, 0.40, 0.25, 0.3),
    (3000.0, 0.20, 0.50, 0.30, 0.3),
    (700.0, 0.15, 0.30, 0.15, 0.2),
    (3500.0, 0.40, 0.40, 0.25, 0.3),
    (2200.0, 0.15, 0.35, 0.20, 0.2),
    (1000.0, 0.35, 0.50, 0.15, 0.3),
    (2800.0, 0.30, 0.60, 0.40, 0.4),
)


START = 0.1
"""Time before a trapezoid [s]."""


def _trapezoids(*, duration: float, Ts: float) -> FloatArray:
    # Down to a low speed, not to rest: a crank held by friction shows nothing about the drive.
    slow_rpm = 400.0
    parts = [np.linspace(0.0, slow_rpm, round(START / Ts))]
    for height, rise, hold, fall, after in TRAPEZOIDS:
        parts.append(
            _core.trapezoid(
                duration=START + rise + hold + fall + after, Ts=Ts, start=START, rise=rise,
                hold=hold, fall=fall, low=slow_rpm, high=height,
            )
        )  # fmt: skip
    return np.concatenate(parts)


def _table(*signals: Signal) -> Mapping[str, Signal]:
    return MappingProxyType({signal.name: signal for signal in signals})


_CHIRP: dict[str, Any] = {"duration": 20.0, "f_start": 0.1, "f_end": 3.0}
_LEVELS = np.array([0.0, 0.5, 1, 2, 3, 4, 6, 5, 3.5, 2.5, 1.5, 0])

EXCITATIONS = _table(
    _excitation(
        "step", "0 to 5 V at 0.5 s; for the first-order fit", _core.step,
        duration=3.0, at=0.5, low=0.0, high=5.0,
    ),
    _excitation(
        "staircase", "0 to 6 V and back in steps of 1 to 2 V, 1 s each; for the steady gain",
        lambda *, duration, Ts, hold: _core.staircase(Ts=Ts, levels=_LEVELS, hold=hold),
        duration=12.0, hold=1.0,
    ),
    _excitation(
        "chirp_lo_hi",
        "0.1 to 3 Hz, amplitude 0.5 growing to 4.6 V; the training record of the paper",
        _core.chirp, **_CHIRP,
        amplitude_start=0.5, amplitude_end=4.6, offset_start=1.0, offset_end=5.2,
    ),
    _excitation(
        "chirp_hi_lo", "0.1 to 3 Hz, amplitude 3.4 shrinking to 0.5 V; for validation",
        _core.chirp, **_CHIRP,
        amplitude_start=3.4, amplitude_end=0.5, offset_start=3.65, offset_end=1.5,
    ),
    _excitation(
        "random", "random levels 0.3 to 6 V, held 0.1 to 0.8 s, changes of 40 ms; for validation",
        _core.random_steps, is_random=True,
        duration=20.0, low=0.3, high=6.0, hold_min=0.1, hold_max=0.8, smoothing=0.04,
    ),
    _excitation(
        "prbs", "maximum length sequence between 1 and 5 V, 50 ms a bit", _core.prbs,
        is_random=True, duration=20.0, low=1.0, high=5.0, hold=0.05,
    ),
    _excitation(
        "multisine",
        "random phases, every 0.05 Hz from 0.1 to 5 Hz, 0.5 to 5.9 V, crest factor 3 to 4",
        _core.multisine, is_random=True,
        duration=20.0, f_low=0.1, f_high=5.0, amplitude=2.7, offset=3.2,
    ),
    _excitation(
        "saturating",
        "pulses of 16 to 20 V between speeds of 200 to 4,300 RPM; drives the current limit",
        _core.jumps, is_random=True,
        duration=20.0, speed_low=200.0, speed_high=4300.0, change_min=700.0, level_min=16.0,
        level_max=20.0, hold_min=0.08, hold_max=0.5, ramp=0.0, gain=GAIN, acceleration=ACCELERATION,
    ),
    _excitation(
        "saturating_2",
        "slanted pulses of 18 to 20 V, larger changes, longer holds; for tests, never trained on",
        _other_jumps, is_random=True,
        duration=15.0, speed_low=500.0, speed_high=4000.0, change_min=1200.0, level_min=18.0,
        level_max=20.0, hold_min=0.2, hold_max=0.9, ramp=0.02, gain=GAIN, acceleration=ACCELERATION,
    ),
)  # fmt: skip

REFERENCES = _table(
    _reference(
        "trapezoid", "0 to 3,000 RPM in 150 ms, held 0.6 s, down in 150 ms", _core.trapezoid,
        duration=1.5, start=START, rise=0.15, hold=0.6, fall=0.15, low=0.0, high=3000.0,
    ),
    _reference(
        "chirp_hi_lo", "0.1 to 3 Hz, to 2,000 RPM, amplitude shrinking", _core.chirp, **_CHIRP,
        amplitude_start=1080.0, amplitude_end=150.0, offset_start=1080.0, offset_end=400.0,
    ),
    _reference(
        "chirp_lo_hi", "0.1 to 3 Hz, to 600 RPM, amplitude growing", _core.chirp, **_CHIRP,
        amplitude_start=50.0, amplitude_end=250.0, offset_start=50.0, offset_end=350.0,
    ),
    _reference(
        "random", "from rest, random levels 200 to 2,000 RPM, changes of 200 ms",
        _core.random_steps, is_random=True,
        duration=10.0, low=200.0, high=2000.0, hold_min=0.25, hold_max=0.9, smoothing=0.2,
        start=0.0,
    ),
    _reference(
        "trapezoids",
        "seven trapezoids from 400 to 700-3,500 RPM, rises of 150 to 400 ms; to train on",
        _trapezoids, duration=START + sum(START + sum(shape[1:]) for shape in TRAPEZOIDS),
    ),
)  # fmt: skip


def excitation(name: str, seed: int = 0) -> FloatArray:
    """A named excitation [V] at 1 ms, shape (N,).

    Parameters
    ----------
    name
        One of `EXCITATIONS`; ``-`` and ``_`` are the same.
    seed
        Chooses the random signals; the others are the same for every seed.

    Raises
    ------
    SettingError
        For an unknown name, with the known ones, or a seed that is not a whole number from 0.

    Examples
    --------
    >>> excitation("step").shape
    (3000,)
    """
    return _named(EXCITATIONS, "excitation", name).generate(seed)


def reference(name: str, seed: int = 0) -> FloatArray:
    """A named reference [RPM] at 1 ms, shape (N,), with at most 20,000 RPM/s.

    Parameters
    ----------
    name
        One of `REFERENCES`; ``-`` and ``_`` are the same.
    seed
        Chooses the random reference; the others are the same for every seed.

    Raises
    ------
    SettingError
        For an unknown name, with the known ones, or a seed that is not a whole number from 0.
    """
    return _named(REFERENCES, "reference", name).generate(seed)


def available() -> tuple[Signal, ...]:
    """Every named signal, excitations first."""
    return (*EXCITATIONS.values(), *REFERENCES.values())


def crest_factor(signal: NDArray[np.floating]) -> float:
    """Largest deviation from the mean over the root mean square of the deviations, shape (N,).

    It is 1.414 for a sine and 1 for a binary signal; lower means more power at the same amplitude.

    Raises
    ------
    DataError
        For a signal without samples or with values that are not finite.
    """
    return _core.crest_factor(np.ascontiguousarray(signal, dtype=np.float64))


def _named(table: Mapping[str, Signal], kind: str, name: str) -> Signal:
    signal = table.get(str(name).replace("-", "_").lower())
    if signal is None:
        raise SettingError(
            f"expected the name of {'an' if kind == 'excitation' else 'a'} {kind}, got {name!r}; "
            f"the known ones are {', '.join(table)}"
        )
    return signal


def _checked(seed: int) -> int:
    if not is_whole(seed) or not 0 <= seed < 2**64:
        raise SettingError(f"expected a seed of 0 to 2^64 - 1, got {seed!r}; give a whole number")
    return int(seed)
