"""What the checks themselves rest on: portions of a night, and what is made once per build."""

from __future__ import annotations

from pathlib import Path

import pytest

import fitted as kept
from fitted import fitted, made
from portions import portion


def taken(state: Path | None, minutes: float, stop: int | None = None) -> list[str]:
    found = []
    for piece in portion(["a", "b", "c"], state, minutes):
        if len(found) == stop:
            break  # as Ctrl-C does: this piece is not done
        found.append(piece)
    return found


def test_every_piece_has_its_turn_where_time_allows(tmp_path: Path) -> None:
    assert taken(None, 1.0) == ["a", "b", "c"]
    assert taken(tmp_path / "state", 1.0) == ["a", "b", "c"]
    assert taken(tmp_path / "state", 1.0) == ["a", "b", "c"]


def test_a_night_goes_on_where_the_last_one_stopped(tmp_path: Path) -> None:
    nights = [taken(tmp_path / "night" / "state", -1.0) for _ in range(4)]
    assert nights == [["a"], ["b"], ["c"], ["a"]]


def test_a_piece_that_was_interrupted_is_done_again(tmp_path: Path) -> None:
    assert taken(tmp_path / "state", 1.0, stop=1) == ["a"]
    assert taken(tmp_path / "state", 1.0) == ["b", "c", "a"]


def test_a_state_of_other_work_begins_anew(tmp_path: Path) -> None:
    (tmp_path / "state").write_text("gone")
    assert taken(tmp_path / "state", -1.0) == ["a"]


CALLS: list[object] = []


def recipe(value: int) -> list[int]:
    CALLS.append(value)
    return [value]


def recipe_of_a_folder(folder: Path, text: str) -> None:
    CALLS.append(text)
    (folder / "file").write_text(text)


def test_what_is_shared_is_made_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(kept, "FOLDER", tmp_path)
    CALLS.clear()
    assert [fitted(recipe, n) for n in (1, 1, 2)] == [[1], [1], [2]]
    assert fitted(recipe, 1) is not fitted(recipe, 1)  # nobody changes what another one gets
    folders = {made(recipe_of_a_folder, "text") for _ in range(2)}
    assert [(f / "file").read_text() for f in folders] == ["text"]
    assert CALLS == [1, 2, "text"]
    monkeypatch.setattr(kept, "build", lambda: "another build")
    assert fitted(recipe, 1) == [1]
    assert CALLS == [1, 2, "text", 1]


def test_a_recipe_that_fails_leaves_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(kept, "FOLDER", tmp_path)
    with pytest.raises(FileNotFoundError):
        made(failing)
    assert not [p for p in tmp_path.rglob("*") if p.name == "half" and ".part" not in str(p)]
    with pytest.raises(FileNotFoundError):
        made(failing)


def failing(folder: Path) -> None:
    (folder / "half").write_text("")
    raise FileNotFoundError("no such thing")
