"""Local polynomials: systems of known response, Welch's method beside them, hostile records."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import sewfast
from refusals import refuses
from sewfast import bode, load_response
from sewfast.commissioning import unsmoothed
from sewfast.errors import DataError, SettingError
from sewfast.frequency import FrequencyResponse, local_polynomial, spectral

TS = 1e-3
# a lag of 20 ms, an antiresonance at 60 Hz and a resonance at 80 Hz, damping .03, two samples late


def _pair(hertz: float, damping: float) -> Any:
    w = 2.0 * math.pi * hertz * TS
    p = np.exp(-damping * w + 1j * w * math.sqrt(1.0 - damping**2))
    return np.array([1.0, -2.0 * p.real, abs(p) ** 2])


B = np.concatenate([[0.0, 0.0], 2.0 * _pair(60.0, 0.03)])
A = np.convolve(_pair(80.0, 0.03), [1.0, -math.exp(-TS / 0.02)])


def truth(hertz: Any) -> Any:
    step = np.exp(-2j * math.pi * np.asarray(hertz) * TS)
    return np.polyval(B[::-1], step) / np.polyval(A[::-1], step)


def filtered(b: Any, a: Any, u: Any) -> Any:
    """y(k) = sum b u - sum a y, from rest."""
    signal = pytest.importorskip("scipy.signal")
    return signal.lfilter(b, a, u)


def chirp(n: int) -> Any:
    t = np.arange(n) * TS
    return np.sin(2.0 * math.pi * (0.5 * t + 0.5 * 399.5 / (n * TS) * t * t))


def errors(found: FrequencyResponse, low: float = 10.0, high: float = 350.0) -> Any:
    seen = (found.hertz > low) & (found.hertz < high)
    assert seen.sum() > 20
    return np.abs(found.value / truth(found.hertz) - 1.0)[seen]


@pytest.mark.parametrize("seed", [0, 1, 2])
@pytest.mark.parametrize("kind", ["chirp", "random"])
def test_a_record_that_begins_in_motion_shows_the_response_without_leakage(
    kind: str, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    n = 8000
    u = np.concatenate([rng.normal(size=2000), chirp(n) if kind == "chirp" else rng.normal(size=n)])
    y = filtered(B, A, u)[2000:]
    found, averaged = local_polynomial(u[2000:], y, Ts=TS), spectral(u[2000:], y, Ts=TS)
    assert np.percentile(errors(found), 90) < 0.005
    # leakage of the segments is what is left of the other
    assert np.percentile(errors(found), 90) < 0.1 * np.percentile(errors(averaged), 90)


@pytest.mark.nightly("counts coverage over many records")
def test_bands_hold_the_truth_as_often_as_they_say() -> None:
    inside = []
    for seed in range(40):
        rng = np.random.default_rng([seed, 7])
        u = rng.normal(size=9000)
        y = filtered(B, A, u)
        y = y + 0.1 * y.std() * rng.normal(size=len(y))
        found = local_polynomial(u[1000:], y[1000:], Ts=TS)
        inside.append(np.abs(found.value - truth(found.hertz)) < found.radius())
    share = np.mean(np.concatenate(inside))
    assert 0.92 < share < 0.97


def test_intervals_are_narrow_where_the_response_bends() -> None:
    rng = np.random.default_rng(3)
    u = rng.normal(size=20_000)
    y = filtered(B, A, u) + 0.02 * rng.normal(size=len(u))
    found = local_polynomial(u, y, Ts=TS)
    step = np.diff(found.hertz) / found.hertz[1:]
    near = (found.hertz[1:] > 50.0) & (found.hertz[1:] < 95.0)
    far = (found.hertz[1:] > 150.0) & (found.hertz[1:] < 400.0)
    assert np.median(step[near]) < 0.3 * np.median(step[far])
    assert len(found.hertz) == len(np.atleast_1d(found.blocks))


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_feedback_does_not_bias_the_response(seed: int) -> None:
    """u = r - .3 y under noise that outweighs it: the plain quotient is off by more than 3 dB."""
    rng = np.random.default_rng([seed, 8])
    n, gain = 40_000, 0.3
    r, v = rng.normal(size=n), 3.0 * rng.normal(size=n)
    size = max(len(A), len(B))
    closed = np.pad(A, (0, size - len(A))) + gain * np.pad(B, (0, size - len(B)))
    assert np.abs(np.roots(closed)).max() < 1.0
    u = filtered(A, closed, r - gain * v)
    y = filtered(B, closed, r) + filtered(A, closed, v)
    plain, joint = local_polynomial(u, y, Ts=TS), local_polynomial(u, y, Ts=TS, r=r)
    off, error = (
        20.0 * np.log10(np.abs(f.value / truth(f.hertz)))[(f.hertz > 2.0) & (f.hertz < 400.0)]
        for f in (plain, joint)
    )
    assert np.median(np.abs(off)) > 3.0
    assert abs(np.median(error)) < 0.3
    held = np.abs(joint.value - truth(joint.hertz)) < joint.radius()
    assert np.mean(held) > 0.88


def test_a_reference_that_has_nothing_to_do_with_it_is_refused() -> None:
    for seed in range(5):
        rng = np.random.default_rng([seed, 9])
        u, r = rng.normal(size=(2, 5000))
        with pytest.raises(DataError, match="nothing to do with it"):
            local_polynomial(u, u, Ts=1.0, r=r)
        # one that moves a tenth of it is seen
        assert local_polynomial(u + 0.3 * r, u, Ts=1.0, r=r).hertz.size


def test_a_sparse_multisine_has_intervals_that_hold_its_lines() -> None:
    rng = np.random.default_rng(4)
    t = np.arange(10_000) * TS
    # every 1.7 Hz, 17 lines of the record apart
    u = sum(np.cos(2.0 * math.pi * 1.7 * k * t + rng.uniform(0.0, 6.0)) for k in range(1, 200))
    found = local_polynomial(u, filtered(B, A, np.asarray(u)), Ts=TS)
    smooth = (found.hertz > 150.0) & (found.hertz < 330.0)
    assert np.max(np.abs(found.value / truth(found.hertz) - 1.0)[smooth]) < 0.02


@pytest.mark.parametrize(
    ("u", "said"),
    [
        (np.zeros(500), "constant"),
        (np.full(500, np.nan), "finite"),
        (np.zeros((50, 2)), "shape"),
        (np.arange(20.0), "at least 52"),
        (np.full(500, 1e200), "squares"),
        (np.arange(500) % 7 * 1e-300, "differ by 1e-60"),
        (np.cos(2.0 * np.pi * 0.1 * np.arange(500)), "power at three frequencies"),
    ],
)
def test_records_without_a_response_are_refused(u: Any, said: str) -> None:
    y = np.random.default_rng(0).normal(size=len(u))
    with pytest.raises(DataError, match=said):
        local_polynomial(u, y, Ts=TS)


@settings(max_examples=40, deadline=None)
@given(
    st.lists(st.floats(allow_nan=True, allow_infinity=True), min_size=0, max_size=200),
    st.booleans(),
)
def test_any_record_gives_a_response_or_a_refusal(values: list[float], has_r: bool) -> None:
    u = np.array(values)
    try:
        found = local_polynomial(u, u[::-1], Ts=TS, r=np.roll(u, 1) if has_r else None)
    except DataError:
        return
    for array in (found.value, found.variance, found.coherence, found.radius()):
        assert np.isfinite(array).all()
    assert np.all(np.diff(found.hertz) > 0.0)


# --- `bode` of a record ---------------------------------------------------------------------------


def test_a_record_is_taken_by_either_method(tmp_path: Any) -> None:
    rng = np.random.default_rng(5)
    u = rng.normal(size=4000)
    data = sewfast.Dataset.from_arrays(u, filtered(B, A, u), TS)
    found = bode(data, method="local")
    np.testing.assert_array_equal(
        found.value, local_polynomial(u, data.experiments[0].y, Ts=TS).value
    )
    segments = bode(data, method="segments")
    np.testing.assert_array_equal(segments.value, bode(data).value)
    assert np.ndim(segments.blocks) == 0
    # overlapping segments are worth a fraction of a block each; a count is printed whole
    assert segments.blocks % 1.0
    assert f" {segments.blocks:.0f} blocks" in str(segments)
    found.save(tmp_path / "response.json")
    again = load_response(tmp_path / "response.json")
    np.testing.assert_array_equal(again.radius(), found.radius())
    with refuses(SettingError, name="method", expected="segments or local"):
        bode(data, method="welch")  # type: ignore[call-overload]
    with refuses(SettingError, name="segment"):
        bode(data, method="local", segment=100)
    with refuses(SettingError, name="method", received="local"):
        bode(sewfast.VirtualMachine(), speed=1500.0, method="local")


def test_what_a_linear_response_does_not_describe_is_said() -> None:
    rng = np.random.default_rng(6)
    u = np.cumsum(rng.normal(size=6000))
    u = u - u.mean()
    limit = 0.5 * np.abs(u).max()
    clipped = np.clip(u, -limit, limit)
    data = sewfast.Dataset.from_arrays(clipped, filtered(B, A, clipped), TS, output_unit="RPM")
    cautions = bode(data).provenance["cautions"]
    at = np.flatnonzero(np.abs(clipped) == limit)
    count = int(cautions[0].split(" samples")[0].split()[-1])
    # single samples that touch the limit are none at it
    assert 0.95 * len(at) < count <= len(at)
    assert "the first at 0 s" in cautions[0]
    assert "changes its sign" in cautions[1]
    assert "caution    u rests" in str(bode(data))
    # two levels are no limit, and a speed of one sign is no reversal
    binary = np.sign(rng.normal(size=6000))
    y = 1e3 + filtered(B, A, binary)
    y[:3000] += 1e3 * np.exp(-np.arange(3000) * TS / 0.2)
    late = bode(sewfast.Dataset.from_arrays(binary, y, TS, output_unit="mm"))
    assert "begins away from where it works later" in late.provenance["cautions"][0]
    y = 1e3 + filtered(B, A, binary)
    plain = bode(sewfast.Dataset.from_arrays(binary, y, TS, output_unit="RPM"))
    assert "cautions" not in plain.provenance


@pytest.mark.parametrize("unit", ["RPM", "rad/s"])
def test_a_recording_of_the_package_is_taken_by_its_counts(tmp_path: Path, unit: str) -> None:
    """Its y is smoothed on both sides, which hides the delay."""
    u = sewfast.signals.excitation("chirp_lo_hi", 0)[:8000]
    recorded = sewfast.record(sewfast.VirtualMachine(seed=1), u)
    factor = 1.0 if unit == "RPM" else math.pi / 30.0
    columns = recorded.columns() | {"y": factor * recorded.y}
    sewfast.write_table(tmp_path / "r.csv", columns, units={"u": "V", "y": unit})
    data = sewfast.read(tmp_path / "r.csv", inputs="u", output="y")
    with refuses(DataError, name="data", expected="an output as it was measured"):
        bode(data)
    by_y = unsmoothed(tmp_path / "r.csv", data)
    counted = sewfast.read(
        tmp_path / "r.csv", inputs="u", counts="counts", counts_per_rev=recorded.counts_per_rev
    )
    by_counts = unsmoothed(tmp_path / "r.csv", counted)
    assert not by_y.looks_ahead
    y, difference = by_y.experiments[0].y, by_counts.experiments[0].y
    np.testing.assert_allclose(y[1:], factor * difference[1:], rtol=1e-3)
    assert bode(by_y).coherence.max() > 0.9
    # an output that was measured stays as it is, also beside counts
    assert unsmoothed(tmp_path / "r.csv", by_y) is by_y
    for slow in (1, 4):
        late = np.convolve(recorded.speed("difference"), np.full(slow, 1.0 / slow))[: len(u)]
        sewfast.write_table(tmp_path / "d.csv", columns | {"y": factor * late})
        assert not sewfast.read(tmp_path / "d.csv", inputs="u", output="y").looks_ahead
