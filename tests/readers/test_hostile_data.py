"""`identify`, `look` and `check` on data that nobody should give: a model or one named error."""

from __future__ import annotations

import signal
import time
import warnings
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import sewfast
from cli import called as command
from sewfast import Dataset, Model, _core, identify
from sewfast.errors import DataError, Interrupted, SewfastError
from sewfast.identification import entry, table
from sewfast.readers import read_table

Pair = tuple[Any, Any]


def record(n: int = 600, noise: float = 0.02) -> Pair:
    rng = np.random.default_rng(0)
    u = np.repeat(rng.uniform(-1.0, 1.0, n // 8 + 1), 8)[:n]
    y = np.zeros(n)
    for k in range(1, n):
        y[k] = 0.9 * y[k - 1] + 0.3 * u[k - 1]
    return u, y + noise * rng.normal(size=n)


def dataset(u: Any, y: Any, Ts: Any = 0.01) -> Dataset:
    return Dataset.from_arrays(u, y, Ts)


def with_value(column: Any, value: float, at: int = 300) -> Any:
    changed = column.copy()
    changed[at] = value
    return changed


@pytest.fixture(autouse=True)
def no_warnings() -> Iterator[None]:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        yield


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda u, y: (1e300 * u, y), "below 1e\\+60.*change the unit"),
        (lambda u, y: (u, 1e300 * y), "below 1e\\+60.*change the unit"),
        (lambda u, y: (u, with_value(y, 1e300)), "sample 300 .*Dataset.mask"),
        (lambda u, y: (u, with_value(y, np.inf)), "sample 300 .*Dataset.mask"),
        (lambda u, y: (with_value(u, np.nan), y), "sample 300 .*split_at_gaps"),
        (lambda u, y: (1e-300 * u, y), "differ by 1e-60.*change the unit"),
        (lambda u, y: (u, 1e-300 * y), "differ by 1e-60.*change the unit"),
        (lambda u, y: (0.0 * u, y), "constant at 0.*excitation"),
        (lambda u, y: (u, 0.0 * y + 1.0), "constant at 1.*sensor"),
        (lambda u, y: (u, np.nan * y), "every value is NaN"),
        (lambda u, y: (u, u), "y is u times 1, exactly.*column of a sensor"),
        (lambda u, y: (u[:1], y[:1]), "constant"),
        (lambda u, y: (u[:0], y[:0]), "at least 1 sample"),
        (lambda u, y: (u[:20], y[:20]), "more than 22 samples, received 20"),
        (lambda u, y: (u[None], y), "time first"),
        (lambda u, y: (u, np.c_[y, y]), "shape \\(N,\\)"),
        (lambda u, y: (u + 1j, y), "real numbers"),
    ],
)
def test_what_cannot_be_identified_is_named(change: Callable[..., Pair], words: str) -> None:
    with pytest.raises(DataError, match=words):
        identify(dataset(*change(*record())))


@pytest.mark.parametrize("Ts", [0, -1.0, float("nan"), float("inf"), "x", None, True, [0.01]])
def test_a_sample_time_that_is_none_is_refused(Ts: Any) -> None:
    with pytest.raises(DataError, match="Ts: expected a positive sample time"):
        dataset(*record(), Ts=Ts)


@pytest.mark.parametrize(
    "change",
    [
        lambda u, y: (1e55 * u, 1e55 * y),
        lambda u, y: (1e-55 * u, 1e-55 * y),
        lambda u, y: (1e12 * u, 1e-12 * y),
        lambda u, y: (1e6 + 1e-6 * u, 1e6 + 1e-6 * y),
        lambda u, y: ((1e3 * u).astype(np.int32), (1e3 * y).astype(np.int64)),
        lambda u, y: (u.astype("f4"), y.astype("f4")),
        lambda u, y: (u > 0, y),
        lambda u, y: (np.c_[u, u], y),
        lambda u, y: (u, with_value(y, 1e9)),
        lambda u, y: (u, 1.05 ** np.arange(len(u))),
        lambda u, y: (u, np.cumsum(np.cumsum(u))),
        lambda u, y: (np.r_[np.zeros(590), np.ones(10)], np.r_[np.zeros(591), np.arange(9.0)]),
        lambda u, y: (u, np.where(np.arange(len(u)) % 3 == 0, y, np.nan)),
        lambda u, y: (u[:25], y[:25]),
    ],
)
def test_odd_data_give_a_whole_model_and_no_warning(change: Callable[..., Pair]) -> None:
    data = dataset(*change(*record()))
    model = identify(data, time_budget=1.0)
    assert all(np.isfinite(m.theta).all() for m in model.members or (model,))
    assert str(model)
    for used in (model.validate, model.check):
        with suppress(SewfastError):
            assert str(used(data))


def test_one_wild_value_does_not_make_a_model_good() -> None:
    """The error of a constant was taken about a mean that the value had moved far away."""
    u, _ = record()
    noise = np.random.default_rng(3).normal(size=len(u))
    verdict = identify(dataset(u, with_value(noise, 1e9)), time_budget=1.0).training["verdict"]
    assert verdict["grade"] == "useless"


def test_a_short_experiment_does_not_keep_the_others_from_a_search() -> None:
    lengths = (600, 40, 300)
    data = Dataset.concat([dataset(*record(n)) for n in lengths])
    training = identify(data, time_budget=2.0).training
    assert training["verdict"]["grade"] == "good"
    assert len(training["choice"]["candidates"]) > 1
    assert sum(d["samples"] for d in training["choice"]["held_out"]) == sum(lengths)
    few = identify(Dataset.concat([dataset(*record(40)) for _ in range(2)]), time_budget=1.0)
    assert "too short" in few.training["choice"]["reason"]


# --- interruptions --------------------------------------------------------------------------------


def test_an_interruption_between_two_pieces_of_work_keeps_the_best(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def interrupt(*_: Any) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(table.LinearTable, "search", interrupt)
    with pytest.raises(Interrupted) as caught:
        identify(dataset(*record()), time_budget=2.0)
    assert isinstance(caught.value.best, Model)


def test_an_interruption_of_the_evidence_keeps_the_model(monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(entry, "with_training_evidence", interrupt)
    with pytest.raises(Interrupted) as caught:
        identify(dataset(*record()), model="oe")
    assert caught.value.best.kind == "oe"


@pytest.mark.parametrize("after", [0.15, 0.5, 1.2])
def test_an_interruption_is_heard_at_once(after: float) -> None:

    heard: list[float] = []

    def interrupt(*_: object) -> None:
        heard.append(time.perf_counter())
        raise KeyboardInterrupt

    before = signal.signal(signal.SIGALRM, interrupt)
    try:
        signal.setitimer(signal.ITIMER_REAL, after)
        with pytest.raises(KeyboardInterrupt):
            identify(dataset(*record(20_000)))
        # 0.1 s on a machine of its own
        assert time.perf_counter() - heard[0] < 1.0
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, before)


# --- files ----------------------------------------------------------------------------------------


def test_a_header_cannot_steer_the_terminal(tmp_path: Path) -> None:
    u, y = record()
    rows = "\n".join(f"{0.01 * k:.2f},{a},{b}" for k, (a, b) in enumerate(zip(u, y, strict=True)))
    (tmp_path / "odd.csv").write_text(f"t,$\\frac{{1}}{{,y\x1b]0\xa0b [V]\n{rows}\n")
    assert read_table(tmp_path / "odd.csv").names == ("t", r"$\frac{1}{", "y\\x1b]0\xa0b")
    names = ("--input", r"$\frac{1}{", "--output", "y\x1b]0\xa0b")
    for words in (
        ("look", "odd.csv"), ("look", "odd.csv", *names),
        ("identify", "odd.csv", *names, "--model", "oe", "-o", "m.json"),
        ("check", "m.json", "odd.csv"), ("validate", "m.json", "odd.csv"),
    ):  # fmt: skip
        done = command(tmp_path, *words)
        assert "\x1b" not in done.out + done.err
    assert "\x1b" not in command(tmp_path, "look", "odd.csv", "--input", "z", done=2).err


@pytest.mark.parametrize(
    ("scale", "words"),
    [(1e300, "infinite or 1e150 and more"), (1e-300, "too little to be squared")],
)
def test_look_says_what_identify_refuses(scale: float, words: str, tmp_path: Path) -> None:
    columns = dict(zip("uy", record(), strict=True))

    t = 0.01 * np.arange(600)
    sewfast.write_table(tmp_path / "r.csv", {"t": t} | {k: scale * c for k, c in columns.items()})
    names = ("--input", "u", "--output", "y")
    shown = command(tmp_path, "look", "r.csv", *names).out
    assert words in shown
    assert "constant at nan" not in shown
    command(tmp_path, "identify", "r.csv", *names, "-o", "m.json", done=2)


def test_a_short_record_is_no_ground_for_praise() -> None:
    u, y = record()
    model = identify(dataset(u, y), model="oe")
    assert "4 samples are few" in model.validate(dataset(u[:24], y[:24])).verdict
    assert "few" not in model.validate(dataset(u, y)).verdict
    assert isinstance(model.core, _core.LinearModel)
