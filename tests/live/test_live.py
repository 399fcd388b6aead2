"""The live view's pure parts: the feed between two threads, speed, what the status line says."""

from __future__ import annotations

import argparse
import threading
import tracemalloc

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sewfast.cli.arguments import add_view
from sewfast.errors import DataError, SettingError
from sewfast.live import Feed, ViewKind
from sewfast.live.feed import _MOST, speed_over_window
from sewfast.live.view import fitted, status


def feed(n: int | None = 5000, **settings: float) -> Feed:
    return Feed({"u": "V", "counts": ""}, 0.001, n, "record step on virtual", **settings)


def ramp(first: int, count: int) -> dict[str, np.ndarray]:
    k = np.arange(first, first + count)
    return {"u": k / 100, "counts": 10 * k}


# the feed


def test_feed_gives_back_what_was_put() -> None:
    f = feed()
    for first in range(0, 1000, 10):
        f.put(first, ramp(first, 10))
    found = f.read(200, 1000)
    np.testing.assert_array_equal(found["u"], np.arange(200, 1000) / 100)
    assert (f.end, f.received, f.gaps, f.missing) == (1000, 1000, 0, 0)


def test_feed_copies_a_batch() -> None:
    f, batch = feed(), ramp(0, 10)
    f.put(0, batch)
    batch["u"][:] = -1
    np.testing.assert_array_equal(f.read(0, 10)["u"], np.arange(10) / 100)


def test_gap_is_nan_and_counted() -> None:
    f = feed()
    f.put(0, ramp(0, 10))
    f.put(30, ramp(30, 10))
    u = f.read(0, 40)["u"]
    assert np.isnan(u[10:30]).all()
    assert not np.isnan(np.r_[u[:10], u[30:]]).any()
    assert (f.end, f.received, f.gaps, f.missing) == (40, 20, 1, 20)


def test_first_sample_late_is_a_gap() -> None:
    f = feed()
    f.put(5, ramp(5, 10))
    assert (f.gaps, f.missing) == (1, 5)


def test_late_batch_fills_its_place() -> None:
    f = feed()
    f.put(0, ramp(0, 10))
    f.put(20, ramp(20, 10))
    f.put(10, ramp(10, 10))
    assert not np.isnan(f.read(0, 30)["u"]).any()
    assert (f.end, f.missing) == (30, 0)


def test_column_that_is_left_out_is_nan_and_unknown_one_ignored() -> None:
    f = feed()
    f.put(0, {"u": np.ones(3), "torque": np.ones(3)})
    found = f.read(0, 3)
    assert set(found) == {"u", "counts"}
    assert np.isnan(found["counts"]).all()


def test_batch_larger_than_the_ring_keeps_the_newest() -> None:
    f, count = feed(), 3 * _MOST
    f.put(7, ramp(7, count))
    newest = f.read(f.end - 100, f.end)["u"]
    np.testing.assert_array_equal(newest, np.arange(f.end - 100, f.end) / 100)
    assert np.isnan(f.read(0, 100)["u"]).all()
    assert f.received == count


def test_columns_of_different_length_are_refused() -> None:
    with pytest.raises(DataError, match="10 samples, received 9 of counts; put whole batches"):
        feed().put(0, {"u": np.zeros(10), "counts": np.zeros(9)})


def test_nothing_is_taken_after_close() -> None:
    f = feed()
    f.close()
    f.put(0, ramp(0, 10))
    assert f.end == 0


@given(
    batches=st.lists(
        st.tuples(st.integers(0, 5000), st.integers(0, 9000)), min_size=1, max_size=20
    ),
    reach=st.integers(1, 3000),
)
@settings(max_examples=50, deadline=None)
def test_feed_equals_a_table(batches: list[tuple[int, int]], reach: int) -> None:
    """Any gaps and batch sizes: the newest samples are those of a table of unbounded size."""
    f, table, first = feed(None), np.full(300_000, np.nan), 0
    for gap, count in batches:
        first += gap
        f.put(first, ramp(first, count))
        table[first : first + count] = np.arange(first, first + count) / 100
        first += count
    start = max(f.end - reach, f.oldest)
    np.testing.assert_array_equal(f.read(start, f.end)["u"], table[start : f.end])
    assert f.missing == np.isnan(table[: f.end]).sum()


def test_memory_does_not_grow() -> None:
    f = feed(None, counts_per_rev=1572)
    batch = ramp(0, 10)

    def fill(first: int, batches: int) -> None:
        for k in range(batches):
            f.put(first + 20 * k, batch)
            f.say("gap of 10 samples")

    fill(0, 200)
    tracemalloc.start()
    try:
        fill(4000, 20_000)
        grown, _ = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert grown < 32_000
    assert len(f.notes()) == 64


def test_reader_never_sees_a_torn_sample() -> None:
    """While one thread puts as fast as it can, every sample read is whole or NaN."""
    f = Feed({"a": "", "b": ""}, 0.01, None, "torn")
    done = threading.Event()

    def put() -> None:
        for first in range(0, 400_000, 500):
            k = np.arange(first, first + 500, dtype=float)
            f.put(first, {"a": k, "b": -k})
        done.set()

    writer = threading.Thread(target=put)
    writer.start()
    looks = 0
    while not done.is_set() or looks == 0:
        end = f.end
        # further back than the ring reaches, so that it is overtaken
        start = max(end - 6000, 0)
        found = f.read(start, end)
        known = ~np.isnan(found["a"])
        np.testing.assert_array_equal(found["a"][known], np.arange(start, end)[known])
        np.testing.assert_array_equal(found["a"], -found["b"])
        looks += end > 6000
    writer.join()


@pytest.mark.parametrize(
    ("settings", "expected"),
    [
        ({"columns": {}}, "at least one column"),
        ({"Ts": 0.0}, "Ts finite and above 0"),
        ({"Ts": float("nan")}, "Ts finite and above 0"),
        ({"n": 0}, "n finite and above 0"),
        ({"counts_per_rev": -1.0}, "counts_per_rev finite and above 0"),
        ({"speed_window": 0.0}, "speed_window finite and above 0"),
    ],
)
def test_settings_out_of_range_are_refused(settings: dict[str, object], expected: str) -> None:
    usual = {"columns": {"u": "V"}, "Ts": 0.001, "n": None, "title": ""}
    with pytest.raises(SettingError, match=expected):
        Feed(**{**usual, **settings})  # type: ignore[arg-type]


# the speed


def test_speed_of_even_counts_is_exact() -> None:
    # 10 counts a millisecond at 1,572 counts/rev
    speed = speed_over_window(np.arange(0.0, 1000.0, 10.0), 20, 0.001, 1572)
    np.testing.assert_allclose(speed, 10 / 1572 / 0.001 * 60, rtol=1e-12)
    assert len(speed) == 80


def test_feed_derives_a_speed_over_batches() -> None:
    f = feed(counts_per_rev=1572)
    for first in range(0, 100, 10):
        f.put(first, ramp(first, 10))
    speed = f.read(50, 100)["speed"]
    np.testing.assert_allclose(speed, 381.679, atol=1e-3)
    assert f.columns["speed"] == "RPM"
    assert np.isnan(f.read(0, 20)["speed"]).all()


def test_no_speed_across_a_gap() -> None:
    """A device that was reset in the gap counts from 0 again: no spike, but nothing."""
    f = feed(counts_per_rev=1572)
    f.put(0, ramp(0, 100))
    f.put(110, ramp(0, 100))
    speed = f.read(50, 210)["speed"]
    assert np.isnan(speed[50 : 60 + 20]).all()
    np.testing.assert_allclose(speed[80:], 381.679, atol=1e-3)


def test_streamed_speed_is_taken_as_it_is() -> None:
    f = Feed({"counts": "", "speed": "RPM"}, 0.001, None, "", counts_per_rev=1572)
    f.put(0, {"counts": np.arange(50), "speed": np.full(50, 7.0)})
    np.testing.assert_array_equal(f.read(0, 50)["speed"], 7.0)


# the status line


def full(n: int | None = 5000) -> Feed:
    f = Feed(
        {"u": "V", "counts": "", "r": "RPM"}, 0.001, n, "run trapezoid", counts_per_rev=1572
    )  # fmt: skip
    t = 0.001 * np.arange(3000)
    counts = np.floor(np.cumsum(20 * np.sin(t) ** 2))
    f.put(0, {"u": np.sin(t), "counts": counts, "r": np.where(t > 1, 500.0, 0.0)})
    f.put(3100, {"u": np.sin(t[:400]), "counts": counts[:400], "r": t[:400]})
    return f


def test_status_says_what_a_user_needs() -> None:
    line = status(full(), 100)
    assert line.startswith("3.50 of 5.00 s   97.14 % received (100 missing, 1 gap)   speed ")
    assert line.endswith("RPM   u 0.39 V")


def test_missing_samples_never_read_as_all() -> None:
    f = feed(None)
    f.put(1, ramp(1, 99_999))
    assert "99.99 % received" in status(f, 80)


@given(
    width=st.integers(0, 250),
    values=st.lists(st.floats(width=32), min_size=1, max_size=60),
    said=st.text(max_size=300),
)
@settings(max_examples=150, deadline=None)
def test_a_line_fits_whatever_is_in_it(width: int, values: list[float], said: str) -> None:
    """Any width, any values, any text of others: never too long, and nothing that moves."""
    f = Feed({"u": "V", "r": "RPM"}, 0.5, 30, said, counts_per_rev=None)
    before = status(f, width)
    f.put(3, {"u": np.array(values), "r": -np.array(values)})
    for line in (before, status(f, width), fitted(said, width)):
        assert len(line) <= max(width, 1)
        assert all(c.isprintable() for c in line)


def test_status_before_the_first_sample() -> None:
    assert status(feed(), 79) == "record step on virtual: waiting for the first sample"


# its name on the command line


@pytest.mark.parametrize(
    ("text", "kind"),
    [
        ("auto", ViewKind("auto")),
        ("none", ViewKind("none")),
        ("terminal", ViewKind("terminal")),
        ("plotjuggler", ViewKind("plotjuggler", "127.0.0.1", 9870)),
        ("plotjuggler:desk:1234", ViewKind("plotjuggler", "desk", 1234)),
        ("plotjuggler:[::1]:1234", ViewKind("plotjuggler", "::1", 1234)),
        ("foxglove", ViewKind("foxglove", "127.0.0.1", 8765)),
        ("foxglove:0", ViewKind("foxglove", "127.0.0.1", 0)),
    ],
)
def test_kind(text: str, kind: ViewKind) -> None:
    assert ViewKind.parse(text) == kind


@pytest.mark.parametrize(
    "text",
    ["", "tty", "auto:1", "plotjuggler:1234", "plotjuggler:desk:0", "plotjuggler:desk:x",
     "plotjuggler::1", "foxglove:65536", "foxglove:desk:1", "foxglove:²"],
)  # fmt: skip
def test_other_kinds_are_refused(text: str) -> None:
    with pytest.raises(SettingError, match="expected a live view out of auto, terminal"):
        ViewKind.parse(text)


def test_argument_of_the_command_line(capsys: pytest.CaptureFixture[str]) -> None:
    parser = argparse.ArgumentParser()
    add_view(parser)
    assert parser.parse_args([]).live == ViewKind("auto")
    assert parser.parse_args(["--live", "foxglove:7000"]).live == ViewKind(
        "foxglove", "127.0.0.1", 7000
    )
    with pytest.raises(SystemExit):
        parser.parse_args(["--live", "screen"])
    assert "received 'screen'" in capsys.readouterr().err
