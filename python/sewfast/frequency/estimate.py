"""Frequency responses from signals: periodic ones line by line, others by averaged spectra.

Both are unbiased under feedback if a reference independent of the noise is given: output and input
are each related to it, and their quotient is the plant (joint input-output method; Pintelon and
Schoukens 2012, System Identification, sections 2.6 and 7.3).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from ..arrays import FloatArray, is_whole
from ..errors import DataError, SettingError
from .response import Complex, FrequencyResponse

LEAST = 16
"""Least samples of a segment or period."""


def periodic(
    u: ArrayLike,
    y: ArrayLike,
    *,
    Ts: float,
    lines: ArrayLike,
    r: ArrayLike | None = None,
    **labels: object,
) -> FrequencyResponse:
    """The robust best linear approximation from repeated periods of different random excitations.

    Differences between periods of one realisation are noise; larger differences between
    realisations are nonlinear distortion (robust method; Pintelon and Schoukens 2012, section
    4.3.1). There is no leakage.

    Parameters
    ----------
    u, y : array, shape (M, P, N)
        Input and output: M realisations of P whole periods of N samples, in the steady state.
    Ts : float
        Sample time [s].
    lines : array of int, shape (n,)
        Excited lines in rising order: frequencies k / (N Ts), up to N / 2.
    r : array, shape (M, P, N), optional
        Reference of a closed loop around the plant.
    labels
        `u_unit`, `y_unit`, `from_counts`, `provenance` of the result.

    Raises
    ------
    DataError
        For other shapes, values that are not finite, fewer than two periods in all, invalid lines
        or lines without power in u.
    """
    u, y = _blocks("u", u), _blocks("y", y)
    if u.shape != y.shape:
        raise DataError(
            name="u, y", expected="one shape (M, P, N)", received=f"{u.shape} and {y.shape}"
        )
    realisations, periods, n = u.shape
    if realisations * periods < 2:
        raise DataError(
            name="y", expected="at least two periods or realisations", received="one",
            remedy="record more periods: the uncertainty is estimated from repetitions",
        )  # fmt: skip
    k = _lines(lines, n)
    U, Y = (np.fft.rfft(x, axis=-1)[..., k] / n for x in (u, y))
    if r is not None:
        reference = _blocks("r", r)
        if reference.shape != u.shape:
            raise DataError(
                name="r", expected=f"the shape of u, {u.shape}", received=str(reference.shape)
            )
        R = np.fft.rfft(reference, axis=-1)[..., k] / n
        _require_excited(R, "r")
        turn = np.conj(R) / np.abs(R)
        U, Y = U * turn, Y * turn
    _require_excited(U, "u")
    if r is None and realisations > 1:
        # relative to the reference's phase, so that realisations can be averaged
        turn = np.conj(U) / np.abs(U)
        U, Y = U * turn, Y * turn
    Um, Ym = U.mean(axis=1), Y.mean(axis=1)
    value = Ym.mean(axis=0) / Um.mean(axis=0)
    size = np.abs(Um.mean(axis=0)) ** 2
    within = Y - value * U
    noise = None
    if periods > 1:
        spread = within - within.mean(axis=1, keepdims=True)
        power = (np.abs(spread) ** 2).sum(axis=(0, 1)) / (realisations * (periods - 1))
        noise = power / (realisations * periods) / size
    if realisations > 1:
        between = within.mean(axis=1)
        between = between - between.mean(axis=0)
        power = (np.abs(between) ** 2).sum(axis=0) / (realisations - 1)
        variance, blocks = power / realisations / size, realisations
    else:
        variance, blocks, noise = noise, periods, None
    output = (np.abs(Y) ** 2).mean(axis=(0, 1))
    explained = np.abs(value) ** 2 * (np.abs(U) ** 2).mean(axis=(0, 1))
    residual = (np.abs(within) ** 2).mean(axis=(0, 1))
    coherence = explained / np.maximum(np.maximum(output, explained + residual), 1e-300)
    return FrequencyResponse(
        k / (n * Ts), value, np.maximum(variance, 1e-300), coherence, float(blocks), float(Ts),
        noise, **labels,  # type: ignore[arg-type]
    )  # fmt: skip


def spectral(
    u: ArrayLike,
    y: ArrayLike,
    *,
    Ts: float,
    r: ArrayLike | None = None,
    segment: int | None = None,
    **labels: object,
) -> FrequencyResponse:
    """Response from any record: cross spectra over auto spectra, averaged over segments.

    Welch's method with a Hann window and an overlap of half a segment; means of the segments are
    removed. Without a reference it is `scipy.signal.csd(u, y) / scipy.signal.welch(u)` (H1); its
    variance follows from the coherence (Bendat and Piersol 2010, table 9.6). The window smooths
    narrow features: a resonance has to be several times as wide as 1 / (segment Ts).

    Parameters
    ----------
    u, y : array, shape (N,)
        Input and output.
    Ts : float
        Sample time [s].
    r : array, shape (N,), optional
        Reference of a closed loop around the plant, or any signal that moves u and is independent
        of the noise. Without it, the response under feedback is that of the plant if there is no
        noise, and minus one over the controller if there is only noise.
    segment : int, optional
        Samples of a segment; by default 16 segments, which overlap by half, fill the record.
    labels
        `u_unit`, `y_unit`, `from_counts`, `provenance` of the result.

    Raises
    ------
    DataError
        For other shapes, values that are not finite, fewer than three segments, a constant input,
        or a reference that is unrelated to the input.
    """
    signals = record_of(u, y, r)
    n = len(signals[0])
    size = _segment(segment, n)
    starts = range(0, n - size + 1, size // 2)
    if len(starts) < 3:
        raise DataError(
            name="segment",
            expected=f"at least three segments of {size} samples, which overlap by half",
            received=f"{n} samples", remedy="record longer, or choose a shorter segment",
        )  # fmt: skip
    window = 0.5 - 0.5 * np.cos(2.0 * np.pi * np.arange(size) / size)
    power = np.zeros((len(signals), len(signals), size // 2 + 1), dtype=np.complex128)
    for start in starts:
        part = np.stack([s[start : start + size] for s in signals])
        part = (part - part.mean(axis=1, keepdims=True)) * window
        spectrum = np.fft.rfft(part, axis=1)
        power += spectrum.conj()[:, None] * spectrum[None]
    power = power[:, :, 1:] / len(starts)
    by = len(signals) - 1 if r is not None else 0
    Suu, Syy, Srr = (power[j, j].real for j in (0, 1, by))
    Sru, Sry = power[by, 0], power[by, 1]
    # halves of Hann windows overlap: each segment counts 11/18 of an independent one
    blocks = max(len(starts) * 11.0 / 18.0, 2.0)
    with np.errstate(divide="ignore", invalid="ignore"):
        value = Sry / Sru
        related = np.abs(Sru) ** 2 / (Suu * Srr)
        residual = Syy - 2.0 * (value * power[1, 0]).real + np.abs(value) ** 2 * Suu
        variance = np.maximum(residual, 0.0) * Srr / np.abs(Sru) ** 2 / (blocks - 1.0)
        coherence = np.abs(power[0, 1]) ** 2 / (Suu * Syy) if r is None else _explained(
            value, Suu, residual
        )  # fmt: skip
    if r is not None and np.nanmedian(related) < 2.0 / blocks:
        raise DataError(
            name="r", expected="a reference that moves u",
            received="one that has nothing to do with it",
            remedy="name the column that the controller follows",
        )  # fmt: skip
    known = np.isfinite(value) & np.isfinite(variance)
    hertz = np.arange(1, size // 2 + 1) / (size * Ts)
    return FrequencyResponse(
        hertz[known], value[known], np.maximum(variance[known], 1e-300),
        np.clip(np.nan_to_num(coherence[known]), 0.0, 1.0), blocks, float(Ts),
        **labels,  # type: ignore[arg-type]
    )  # fmt: skip


def _explained(value: Complex, Suu: FloatArray, residual: FloatArray) -> FloatArray:
    explained = np.abs(value) ** 2 * Suu
    share: FloatArray = explained / (explained + np.maximum(residual, 0.0))
    return share


def _segment(segment: int | None, n: int) -> int:
    if segment is None:
        # default number of segments, which overlap by half: gives bands of a fifth of the gain at a
        # coherence of one half
        return max(2 * (n // (16 + 1)), LEAST)
    if not is_whole(segment) or segment < LEAST:
        raise SettingError(
            name="segment", expected=f"at least {LEAST} samples", received=repr(segment)
        )
    return int(segment) // 2 * 2


def record_of(u: ArrayLike, y: ArrayLike, r: ArrayLike | None) -> list[FloatArray]:
    """Input, output and, if there is one, reference of a record, of one length and finite power."""
    # largest magnitude of a signal, so that sums of squares do not overflow, and smallest range of
    # one that moves the plant, so that products of powers do not underflow
    largest, smallest = 1e150, 1e-60
    given = {"u": u, "y": y} if r is None else {"u": u, "y": y, "r": r}
    signals = {name: _signal(name, values) for name, values in given.items()}
    lengths = [len(s) for s in signals.values()]
    if len(set(lengths)) > 1:
        raise DataError(name=", ".join(given), expected="one length", received=str(lengths))
    for name, signal in signals.items():
        if np.abs(signal).max(initial=0.0) > largest:
            raise DataError(
                name=name, expected="values with finite squares", received="larger ones",
                remedy="change their units",
            )  # fmt: skip
    if not (signals["u"] != signals["u"][:1]).any():
        raise DataError(name="u", expected="an input that moves", received="a constant one")
    if r is not None and not (signals["r"] != signals["r"][:1]).any():
        raise DataError(
            name="r", expected="a reference that moves", received="a constant one",
            remedy="name the column that the controller follows",
        )  # fmt: skip
    for name in [n for n in signals if n != "y"]:
        low, high = signals[name].min(), signals[name].max()
        # the product of two spectra would be 0, and their quotient no number, at every line
        if high - low < smallest:
            raise DataError(
                name=name, expected=f"values that differ by {smallest:g} or more",
                received=f"{low:g} to {high:g}", remedy="change their units",
            )  # fmt: skip
    return list(signals.values())


def _signal(name: str, values: ArrayLike) -> FloatArray:
    found = _numbers(name, values)
    if found.ndim != 1:
        raise DataError(name=name, expected="shape (N,)", received=str(found.shape))
    return found


def _blocks(name: str, values: ArrayLike) -> FloatArray:
    found = _numbers(name, values)
    if found.ndim != 3 or found.shape[2] < LEAST or 0 in found.shape:
        raise DataError(
            name=name,
            expected=f"shape (realisations, periods, samples) with at least {LEAST} samples",
            received=str(found.shape),
        )  # fmt: skip
    return found


def _numbers(name: str, values: ArrayLike) -> FloatArray:
    try:
        found = np.asarray(values, dtype=np.float64)
    except (TypeError, ValueError) as e:
        raise DataError(name=name, expected="numbers", received=repr(str(values)[:40])) from e
    bad = np.flatnonzero(~np.isfinite(found.ravel()))
    if len(bad):
        raise DataError(
            name=name, expected="finite values",
            received=f"{found.ravel()[bad[0]]} at sample {bad[0]}", remedy="cut the record there",
        )  # fmt: skip
    return found


def _lines(lines: ArrayLike, n: int) -> np.ndarray:
    k = np.asarray(lines)
    if k.ndim != 1 or not len(k) or not np.issubdtype(k.dtype, np.integer):
        raise DataError(name="lines", expected="whole numbers, shape (n,)", received=repr(lines))
    if k[0] < 1 or k[-1] > n // 2 or np.any(np.diff(k) <= 0):
        raise DataError(
            name="lines", expected=f"rising numbers from 1 to {n // 2}", received=repr(lines)
        )
    return k


def _require_excited(spectrum: Complex, name: str) -> None:
    size = np.abs(spectrum).mean(axis=(0, 1))
    if not np.all(size > 1e-9 * max(float(size.max()), 1e-300)):
        raise DataError(name=name, expected="power at every line", received="none at some of them")
