"""Rows that are missing, doubled, out of order or cut off are counted and named everywhere."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

import sewfast as api
from cli import call, called
from deceivers import held, lag
from sewfast.readers import read, roles
from sewfast_studio.project import Project, Step

Rows = list[str]
N = 1000


def columns(seed: int, n: int = N) -> tuple[np.ndarray, np.ndarray]:
    random = np.random.default_rng(seed)
    u = held(random, n, 41, 20)
    return u, lag(u, 0.9) + random.normal(size=n)


def timed(seed: int = 0) -> Rows:
    return [
        f"{0.01 * k:.2f},{u:.3f},{y:.3f}"
        for k, (u, y) in enumerate(zip(*columns(seed), strict=True))
    ]


def numbered(turn: int = 2**16, seed: int = 0) -> Rows:
    """A counter that wraps beside even times, as a host that stamps what arrives would write."""
    return [
        f"{k % turn},{u:.3f},{y:.3f}" for k, (u, y) in enumerate(zip(*columns(seed), strict=True))
    ]


def write(path: Path, rows: Rows, head: str = "t,u,y", end: str = "\n") -> Path:
    path.parent.mkdir(exist_ok=True)
    path.write_text(head + "\n" + "\n".join(rows) + end)
    return path


def corrupt(rows: Rows) -> Rows:
    """A hundredth, of which some have too few cells and some are no numbers."""
    return [
        r if k % 100 != 7 else r[:6] if k % 200 == 7 else r.replace(".", "#", 1)
        for k, r in enumerate(rows)
    ]


TIMED: dict[str, tuple[Callable[[Rows], Rows], str]] = {
    "lost": (lambda r: r[:400] + r[402:], "2 rows are missing in the even time stamps of 0.01 s"),
    "doubled": (
        lambda r: [x for k, x in enumerate(r) for _ in range(1 + (k % 50 == 7))],
        "20 rows are left out, as the next one has the same time stamp (first before line 10)",
    ),
    "corrupt": (corrupt, "10 of 1000 lines skipped"),
    "cut": (lambda r: [*r[:800], r[800][:-2]], "the last line is cut off and left out: '8.00,"),
}


@pytest.mark.parametrize("kind", TIMED)
def test_every_part_that_reads_a_record_names_lost_rows(tmp_path: Path, kind: str) -> None:
    spoil, words = TIMED[kind]
    path = write(tmp_path / "runs" / "x.csv", spoil(timed()), end="" if kind == "cut" else "\n")
    look = called(tmp_path, "look", path).out
    assert f"note: warning: x.csv: {words}" in look
    assert "nothing stands in the way" not in look
    assert words in str(called(tmp_path, "look", path, "--json").json()["notes"])
    found = called(
        tmp_path, "identify", path, "--model", "oe", "--na", 1, "-o", "x.json", "--json"
    ).json()
    assert words in str(found["training"]["preparation"])
    # the studio prints what these do, and the model
    step = Step("x.csv", ("u",), "y", model="oe")
    assert words in Project(path.parent).look(step)["text"]
    assert words in Project(path.parent).identify(step)["text"]
    (path.parent / "model.json").unlink()
    (row,) = api.fleet(path.parent, model="oe", workers=0).rows
    assert words in row.message


NUMBERED: dict[str, tuple[Callable[[Rows], Rows], str]] = {
    "lost": (
        lambda r: r[:400] + r[460:],
        "60 rows are missing by the numbers in column 'seq', at 1 place, first 460 after 399 at "
        "line 402",
    ),
    "doubled": (lambda r: r[:400] + r[399:], "1 row is doubled by the numbers in column 'seq'"),
    "order": (
        lambda r: [*r[:400], r[401], r[400], *r[402:]],
        "1 row is out of order by the numbers in column 'seq', at 1 place, first 400 after 401",
    ),
    "started anew": (lambda r: r[:600] + r[:300], "1 row is out of order"),
}


@pytest.mark.parametrize("kind", NUMBERED)
def test_numbers_of_rows_show_what_even_times_hide(tmp_path: Path, kind: str) -> None:
    spoil, words = NUMBERED[kind]
    path = write(tmp_path / "x.csv", spoil(numbered()), "seq [-],u,y")
    (note,) = read(path, Ts=0.01).notes
    assert words in note
    assert words in called(tmp_path, "look", path, "--ts", "0.01").out
    # the times of a host that stamps what arrives
    rows = [f"{0.01 * k:.2f},{row}" for k, row in enumerate(spoil(numbered()))]
    assert words in read(write(path, rows, "t,seq,u,y")).notes[0]


def test_numbers_of_eight_bits_show_lost_rows(tmp_path: Path) -> None:
    rows = numbered(256)
    path = write(tmp_path / "x.csv", rows[:400] + rows[460:], "seq,u,y")
    (note,) = read(path, Ts=0.01).notes
    assert "60 rows are missing" in note
    assert "first 204 after 143" in note


@pytest.mark.parametrize("turn", [2**16, 256, 100, 7])
def test_numbers_that_wrap_are_no_fault_and_no_input(tmp_path: Path, turn: int) -> None:
    table = api.read_table(write(tmp_path / "x.csv", numbered(turn), "seq,u,speed"))
    assert read(table, Ts=0.01).notes == ()
    found = roles(table)
    assert found is not None
    assert (found.input, found.output) == ("u", "speed")


@pytest.mark.parametrize("head", ["n,u,y", "packet,u,y", "n [rpm],u,y"])
def test_columns_that_count_no_rows_are_left_alone(tmp_path: Path, head: str) -> None:
    """A speed n, packets of ten rows, and a ramp with a unit."""
    first = [k // 10 for k in range(N)] if "packet" in head else np.rint(columns(1)[1]).tolist()
    first = [min(k, 950) for k in range(N)] if "rpm" in head else first
    rows = [f"{x:g},{row.partition(',')[2]}" for x, row in zip(first, numbered(), strict=True)]
    assert read(write(tmp_path / "x.csv", rows, head), inputs="u", output="y", Ts=0.01).notes == ()


@pytest.mark.parametrize(
    ("rows", "words"),
    [
        (lambda r: [*r[:400], r[401], r[400], *r[402:]], "at line 403 (1 of 999 steps go back)"),
        (
            lambda r: [x for x in r for _ in (0, 1)],
            "(so are 1000 of 1999 steps: rows written twice)",
        ),
    ],
)
def test_time_that_goes_back_is_counted(
    tmp_path: Path, rows: Callable[[Rows], Rows], words: str
) -> None:
    path = write(tmp_path / "x.csv", rows(timed()))
    for command in "look", "identify":
        assert words in call(tmp_path, command, str(path)).err


def test_a_time_that_wraps_is_named(tmp_path: Path) -> None:
    rows = numbered()
    micros = [(10_000 * k + 2**32 - 5_000_000) % 2**32 for k in range(N)]
    rows = [f"{t},{row.partition(',')[2]}" for t, row in zip(micros, rows, strict=True)]
    path = write(tmp_path / "x.csv", rows, "micros,u,y")
    with pytest.raises(api.DataError, match=r"1 of 999 steps go back: an integer of 32 bits"):
        read(path)


@pytest.mark.parametrize("digits", [".3f", ".6g", ".17g", ".0f"])
@pytest.mark.parametrize("end", ["", "\n"])
def test_a_whole_last_line_stays(tmp_path: Path, digits: str, end: str) -> None:
    u, y = columns(2)
    rows = [f"{a:{digits}},{b:{digits}}" for a, b in zip(u, y, strict=True)]
    data = read(write(tmp_path / "x.csv", rows, "u,y", end), Ts=0.01)
    assert len(data) == N
    assert data.notes == ()


@pytest.mark.parametrize("cut", [1, 2, 3, 4, 6, 9])
def test_a_last_line_that_was_cut_off_is_left_out(tmp_path: Path, cut: int) -> None:
    path = write(tmp_path / "x.csv", [*timed()[:-1], timed()[-1][:-cut]], end="")
    data = read(path)
    assert len(data) == N - 1
    assert "the last line is cut off" in data.notes[0]


@pytest.mark.parametrize("last", ["nan", "-inf", "NA"])
def test_a_last_cell_without_a_number_is_whole(tmp_path: Path, last: str) -> None:
    data = read(write(tmp_path / "x.csv", [*timed(), f"10.00,0.123,{last}"], end=""))
    assert len(data) == N + 1
    assert data.notes == ()


def test_a_last_cell_longer_than_any_is_refused(tmp_path: Path) -> None:
    with pytest.raises(api.DataError, match="line 1002: field larger"):
        read(write(tmp_path / "x.csv", [*timed(), "9" * 200_000], end=""))


def test_a_short_table_is_whole(tmp_path: Path) -> None:
    path = write(tmp_path / "x.csv", ["0,1.5,2.25", "1,2.5,3.25", "2,3.5,4"], end="")
    assert len(read(path)) == 3


def test_more_corrupt_lines_are_counted_of_every_kind(tmp_path: Path) -> None:
    rows = corrupt(timed())
    for k in range(20, 60, 20):
        rows[k] = rows[k].replace(".", "#", 1)
    with pytest.raises(
        api.DataError, match=r"7 cells .* and 5 lines have .* of 1000 lines up to 1%"
    ):
        read(write(tmp_path / "x.csv", rows), inputs="u", output="y")
