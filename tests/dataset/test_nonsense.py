"""Records that deceive are named, in the same words everywhere; good ones are not accused."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import sewfast as api
from cli import called as sewfast
from deceivers import GOOD, HELD, INPUTS, NONSENSE, data, good, held, lag, nonsense
from effort import FULL
from sewfast import diagnose
from sewfast.dataset import Dataset
from sewfast.dataset.faults import faults
from sewfast.report.commissioned import _judged
from sewfast_studio.project import Project, Step

SEEDS = range(HELD, HELD + (12 if FULL else 1))


def test_most_records_that_deceive_are_named() -> None:
    """One sweep shows each frequency once, and noise of 30 % hides small changes."""
    kinds = [kind for kind in NONSENSE if NONSENSE[kind].named]
    missed = [
        (kind, seed)
        for kind in kinds
        for seed in SEEDS
        if not {f.kind for f in faults(data(nonsense(kind, seed)))} & set(NONSENSE[kind].named)
    ]
    assert len(missed) <= 0.25 * len(kinds) * len(SEEDS), missed


@pytest.mark.parametrize("kind", GOOD)
def test_no_good_record_is_accused(kind: str) -> None:
    for seed in SEEDS:
        assert faults(data(good(kind, seed))) == (), seed


# --- a change midway ------------------------------------------------------------------------------


def steps(seed: int, n: int = 4000) -> tuple[np.ndarray, np.ndarray]:
    random = np.random.default_rng(seed)
    u = held(random, n, 41, 30)
    return u, lag(u) + 10.0 * random.normal(size=n)


def change_of(u: np.ndarray, y: np.ndarray) -> dict[str, float | str]:
    finding = diagnose(Dataset.from_arrays(u, y, 0.01)).find("changes")
    assert finding is not None
    return finding.evidence


@pytest.mark.parametrize("gain", [-1.0, 0.1, 4.0, 0.0])
@pytest.mark.parametrize("start", [1100, 2700])
def test_another_scale_is_found(gain: float, start: int) -> None:
    u, y = steps(0)
    y[start:] *= gain
    y[1500:1600] = np.nan
    y += np.random.default_rng(1).normal(size=len(y))
    found = change_of(u, y)
    assert found["first"] == pytest.approx(start, abs=len(u) / 50)
    assert found["gain"] == pytest.approx(gain, rel=0.15, abs=0.05)
    assert found["shift"] == 0.0


@pytest.mark.parametrize("moves", ["prbs", "sweep", "levels"])
def test_an_input_in_other_units_is_found(moves: str) -> None:
    """Of two levels a curve says as much, of a sweep a filter: but the output goes on as before."""
    random = np.random.default_rng(5)
    u = INPUTS[moves](random, 4000)
    y = lag(u) + 2.0 * random.normal(size=4000)
    u[2100:] *= 3.0
    found = change_of(u, y)
    assert found["first"] == pytest.approx(2100, abs=len(u) / 25)
    assert found["gain"] == pytest.approx(1.0 / 3.0, rel=0.1)


def test_a_plant_that_is_driven_harder_has_not_changed() -> None:
    """Its output grows with the input, though less."""
    for seed in range(4):
        random = np.random.default_rng(seed)
        u = INPUTS["prbs"](random, 4000)
        u[2100:] *= 3.0
        y = lag(8.0 * np.tanh(u / 8.0)) + 2.0 * random.normal(size=4000)
        assert diagnose(Dataset.from_arrays(u, y, 0.01)).find("changes") is None


@pytest.mark.parametrize("lost", [60, 300])
def test_lost_rows_are_found(lost: int) -> None:
    u, y = steps(1)
    torn = np.delete(y, slice(1800, 1800 + lost))
    found = change_of(u[: len(torn)], torn)
    assert found["first"] == pytest.approx(1800, abs=len(u) / 50)
    assert found["shift"] == pytest.approx(lost, abs=2)
    torn = np.delete(u, slice(1800, 1800 + lost))
    found = change_of(torn, y[: len(torn)])
    assert found["shift"] == pytest.approx(-lost, abs=2)


def test_a_file_with_another_sign_is_found_among_others() -> None:
    files = []
    for i in range(4):
        u, y = steps(i, 1500)
        files.append(Dataset.from_arrays(u, -y if i == 2 else y, 0.01, name=f"run{i}"))
    finding = diagnose(Dataset.concat(files)).find("changes")
    assert finding is not None
    assert "from about sample 0 of run2 " in finding.text
    assert finding.evidence["gain"] == pytest.approx(-1.0, abs=0.1)


def test_long_records_are_searched_to_their_end() -> None:
    u, y = steps(2, 100_000)
    y[90_000:] *= -1.0
    assert change_of(u, y)["first"] == pytest.approx(90_000, abs=2_000)


# --- the same everywhere --------------------------------------------------------------------------


def test_every_part_that_judges_a_record_says_the_same(tmp_path: Path) -> None:
    u, y = steps(3, 3000)
    sound, torn = tmp_path / "sound.csv", tmp_path / "runs" / "torn.csv"
    torn.parent.mkdir()
    api.write_table(sound, {"t": 0.01 * np.arange(len(u)), "u": u, "y": y})
    y[1500:] *= -1.0
    api.write_table(torn, {"t": 0.01 * np.arange(len(u)), "u": u, "y": y})
    (fault,) = faults(api.read(torn))
    assert "its sign has turned" in fault.text
    assert "--train 0:1" in fault.remedy
    look = sewfast(tmp_path, "look", torn).out
    assert fault.text in look
    assert fault.remedy[1:] in look
    said = sewfast(tmp_path, "identify", torn, "--model", "oe", "-o", "torn.json").out
    assert fault.text in said
    model = api.identify(api.read(sound), model="oe")
    card = model.check(api.read(torn))
    assert [line.meaning for line in card.lines if line.name == "record"] == [
        f"{fault.text}: {fault.remedy}"
    ]
    assert "first mend the record" in card.summary
    # the page of a commissioning prints the card that it stored
    assert f"{fault.text}: {fault.remedy}" in str(_judged("levels", card.to_json()).rows)
    assert [x for x in model.check(api.read(sound)).lines if x.name == "record"] == []
    model.save(torn.parent / "model.json")
    shown = Project(torn.parent).validate(Step("torn.csv", ("u",), "y"))
    assert "first mend the record" in shown["verdict"]
    assert any(fault.text in line["meaning"] for line in shown["lines"])
    assert fault.text in Project(torn.parent).look(Step("torn.csv", ("u",), "y"))["text"]
    (torn.parent / "model.json").unlink()
    table = api.fleet(torn.parent, model="oe", workers=0)
    assert table.rows[0].message == f"{fault.text}: {fault.remedy}"
    assert f"faulty  torn.csv: {fault.text}" in str(table)


def test_a_torn_record_is_no_better_than_poor() -> None:
    u, y = steps(4)
    y[3400:] *= 2.0
    model = api.identify(Dataset.from_arrays(u, y, 0.01), model="oe")
    verdict = model.training["verdict"]
    assert verdict["grade"] in ("poor", "useless")
    assert "times its gain" in verdict["text"]


# --- a column that is computed from another -------------------------------------------------------


def test_curves_and_printed_copies_of_the_input_are_refused() -> None:
    u = steps(5)[0]
    for y, said in (
        (u**2 + 3.0 * u, "is a curve of u in the same sample"),
        (np.roll(np.round(-0.25 * u, 3), 3), "is u of 3 samples before times -0.25"),
    ):
        with pytest.raises(api.DataError, match=said):
            api.identify(Dataset.from_arrays(u[3:], y[3:], 0.001), model="oe")
    late = np.roll(u**2 + 3.0 * u, 1)[3:]
    assert "no_dynamics" not in {f.kind for f in faults(data((u[3:], late)))}


@pytest.mark.parametrize("of", ["mean", "difference", "sum"])
def test_sums_of_the_input_are_refused(of: str) -> None:
    u = steps(5)[0]
    y = {
        "mean": np.convolve(u, np.full(5, 0.2))[: len(u)],
        "difference": np.diff(u, prepend=u[0]),
        "sum": 0.01 * np.cumsum(u),
    }[of]
    with pytest.raises(api.DataError, match="is a sum of u in the same sample"):
        api.identify(Dataset.from_arrays(u, y, 0.01))
    # a simulation without noise answers a sample later
    later = Dataset.from_arrays(u[1:], y[:-1], 0.01)
    assert diagnose(later).find("no_dynamics") is None
