"""`Tracker`: a motor's parameters while it runs, and an alarm if one of them drifts."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .. import _core
from ..arrays import FloatArray, as_column
from ..errors import SettingError

NAMES = ("k_v", "k_a", "k_s", "offset")
TOLERANCE = {"k_v": 0.05, "k_a": 0.02, "k_s": 0.4}
"""Parts of the reference by which a parameter can move without an alarm."""
SURE = 0.6
"""Standard deviation, relative to the tolerance, below which an estimate can be a reference. After
5 s the k_a of one machine was still off by 3.7 %, and raised eight alarms in two minutes."""


@dataclass(frozen=True, eq=False)
class Track:
    """History of a tracker.

    Attributes
    ----------
    estimates : mapping of array, shape (N,)
        Estimates by name after each sample, in the tracker's units.
    moved : mapping of array of bool, shape (N,)
        By name, whether the estimate is clearly outside its tolerance.
    """

    estimates: Mapping[str, FloatArray]
    moved: Mapping[str, NDArray[np.bool_]]


class Tracker:
    """`u = k_v w + k_a dw/dt + k_s sign(w) + offset` by recursive least squares with forgetting.

    The same arithmetic is in the `no_std` crate for firmware (`sewfast_control::Tracker`). Signals
    pass two lags before they are compared; the covariance is stored as `U D U'` [1]_.

    Parameters
    ----------
    Ts : float
        Sample time [s].
    speed : float
        The largest speed, in the unit of the speeds: a scale, not a limit.
    lag : float
        Electrical lag [s], as given by `Motor`; 0 for an unknown lag biases `k_a`.
    smoothing : float
        Time constant of each lag [s]: some 20 samples, well below the motor's time constant.
    memory : float
        Time constant of forgetting [s].

    Raises
    ------
    SettingError
        For numbers out of range.

    References
    ----------
    .. [1] G. J. Bierman, Factorization Methods for Discrete Sequential Estimation, 1977, chapter V.

    Examples
    --------
    >>> import numpy as np
    >>> from sewfast.greybox import Tracker
    >>> u = np.repeat([5.0, -3.0, 8.0, -6.0, 2.0], 400)
    >>> w = np.zeros(len(u))
    >>> for k in range(1, len(u)):
    ...     w[k] = w[k - 1] + 0.001 * (u[k - 1] - 0.02 * w[k - 1]) / 0.006
    >>> tracker = Tracker(Ts=0.001, speed=300.0)
    >>> track = tracker.run(u, w)
    >>> round(tracker.estimate["k_a"], 4)
    0.006
    """

    def __init__(
        self,
        *,
        Ts: float,
        speed: float,
        lag: float = 0.0,
        smoothing: float = 0.02,
        memory: float = 0.65,
    ) -> None:
        self._core = _core.Tracker(
            Ts=float(Ts), smoothing=float(smoothing), lag=float(lag), memory=float(memory),
            speed=float(speed),
        )  # fmt: skip
        self._shares: dict[str, float] | None = None
        # the estimate is updated once in so many samples
        self._every = max(1, int(smoothing / Ts))

    def reset(self) -> None:
        """Forget the past, but keep the watched references."""
        self._core.reset()

    @property
    def waits(self) -> bool:
        """Whether `watch` is still waiting for a sufficiently certain estimate."""
        return self._shares is not None

    def step(self, u: float, y: float) -> None:
        """Update with the mean speed over the previous sample and the command from now on.

        A sample that is not finite is skipped.
        """
        self._core.step(u, y)
        self._watch_if_sure()

    def run(self, u: ArrayLike, y: ArrayLike) -> Track:
        """Update with many samples, shape (N,).

        Raises
        ------
        DataError
            If the two differ in length or are not columns of numbers.
        """
        command = as_column(u, "u")
        speed, parts, k = as_column(y, "y", len(command)), [], 0
        while self.waits and k < len(command):
            parts.append(self._core.run(command[k : k + self._every], speed[k : k + self._every]))
            self._watch_if_sure()
            k += self._every
        parts.append(self._core.run(command[k:], speed[k:]))
        estimates, moved = (np.concatenate(column) for column in zip(*parts, strict=True))
        return Track(
            {n: estimates[:, j] for j, n in enumerate(NAMES)},
            {n: moved[:, j] for j, n in enumerate(NAMES)},
        )

    @property
    def estimate(self) -> dict[str, float]:
        """`k_v`, `k_a`, `k_s`, `offset`: command per speed, per acceleration, and commands."""
        return dict(zip(NAMES, self._core.estimate, strict=True))

    @property
    def deviation(self) -> dict[str, float]:
        """Standard deviations of the estimates; inf before there is any information."""
        return {n: math.sqrt(v) for n, v in zip(NAMES, self._core.variance, strict=True)}

    @property
    def moved(self) -> tuple[str, ...]:
        """Parameters beyond tolerance by three standard deviations, ten updates in a row."""
        return tuple(n for n, moved in zip(NAMES, self._core.moved, strict=True) if moved)

    def watch(
        self,
        reference: Mapping[str, float] | None = None,
        *,
        tolerance: Mapping[str, float] | None = None,
    ) -> None:
        """From now on, raise an alarm (`moved`) if a parameter leaves its reference.

        Parameters
        ----------
        reference : mapping of float by name, optional
            Reference values. None: the present estimate, which has the same small biases as later
            ones, or the first sufficiently certain one: until its standard deviations are below .6
            of the tolerances, `waits` is true and nothing is watched.
        tolerance : mapping of float by name, optional
            Parts of the reference, `{"k_v": .05, "k_a": .02, "k_s": .4}` by default; a parameter
            without tolerance is not watched.

        Raises
        ------
        SettingError
            For an unknown name, or numbers out of range.
        """
        shares = dict(TOLERANCE if tolerance is None else tolerance)
        for name in (*(reference or ()), *shares):
            if name not in NAMES:
                raise SettingError(f"expected parameters of {', '.join(NAMES)}, received {name!r}")
        if reference is not None:
            self._watch(dict(reference), shares)
            return
        for name, share in shares.items():
            if not share > 0.0:
                raise SettingError(
                    name=name, expected="a tolerance above 0", received=repr(share),
                    remedy="leave a parameter out that is not to be watched",
                )  # fmt: skip
        self._shares = shares
        self._watch_if_sure()

    def _watch(self, at: Mapping[str, float], shares: Mapping[str, float]) -> None:
        allowed = [abs(shares[n] * at[n]) if n in shares and n in at else math.inf for n in NAMES]
        self._core.watch([at.get(n, 0.0) for n in NAMES], allowed)
        self._shares = None

    def _watch_if_sure(self) -> None:
        if self._shares is None:
            return
        at, deviation = self.estimate, self.deviation
        if all(deviation[n] <= SURE * abs(share * at[n]) for n, share in self._shares.items()):
            self._watch(at, self._shares)
