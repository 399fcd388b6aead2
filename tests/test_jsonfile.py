"""JSON files: round trip, strict reading, nothing half-written."""

from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from refusals import refuses
from sewfast import storage
from sewfast.errors import ModelFileError

FINITE = st.floats(allow_nan=False, allow_infinity=False)
TEXT = st.text(st.characters(exclude_categories=("C", "Zl", "Zp")))
VALUES = st.recursive(
    st.none() | st.booleans() | st.integers(-(10**15), 10**15) | FINITE | TEXT,
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(TEXT, inner, max_size=4),
    max_leaves=20,
)


@given(VALUES)
def test_what_was_written_is_read(tmp_path_factory: Any, value: Any) -> None:
    path = tmp_path_factory.mktemp("json") / "a.json"
    storage.write(path, "sewfast.test", 3, {"value": value})
    assert storage.read(path, "sewfast.test", (1, 3)) == {"version": 3, "value": value}


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("", "damaged"),
        ('{"format": "sewfast.test", "version": 1', "damaged"),
        ("[1, 2]", "expected a JSON object"),
        ("[" * 100_000, "damaged"),
        ('{"format": "sewfast.test", "version": 1, "a": 1e999}', "beyond the range"),
        ('{"format": "sewfast.test", "version": 1, "a": 1%s}' % ("0" * 400), "beyond the range"),
        ('{"format": "sewfast.test", "version": 1, "a": NaN}', "not a finite number"),
        ('{"format": "sewfast.test", "version": 1, "a": -Infinity}', "not a finite number"),
        ('{"format": "sewfast.test", "version": 1, "a": 1, "a": 2}', "'a' occurs twice"),
        ('{"version": 1}', "got None"),
        ('{"format": "other", "version": 1}', "got 'other'"),
        ('{"format": "sewfast.test", "version": 2}', "expected version 1 of 'sewfast.test', got 2"),
        ('{"format": "sewfast.test", "version": true}', "got True"),
        ('{"format": "sewfast.test", "version": 1.0}', "got 1.0"),
        ('{"format": "sewfast.test"}', "got None"),
    ],
)
def test_refuses_what_it_cannot_trust(tmp_path: Path, text: str, says: str) -> None:
    path = tmp_path / "bad.json"
    path.write_text(text)
    with pytest.raises(ModelFileError, match=r"bad\.json") as caught:
        storage.read(path, "sewfast.test", (1,))
    assert says in str(caught.value)


def test_texts_can_be_printed(tmp_path: Path) -> None:
    """They came with their control characters, and halves of surrogate pairs could not be saved."""
    path = tmp_path / "a.json"
    values = '{"a": ["\\u001b[31mred", "two\\nlines", "\\ud800", "\u202eback", "\\ud83d\\ude00"]}'
    path.write_text(f'{{"format": "sewfast.test", "version": 1, "\\u0000": {values}}}', "utf-8")
    found = storage.read(path, "sewfast.test", (1,))
    shown = ["\\x1b[31mred", "two\nlines", "\\ud800", "\\u202eback", "\U0001f600"]
    assert found["\\x00"] == {"a": shown}
    storage.write(path, "sewfast.test", 1, found)


@given(st.binary(max_size=200))
def test_any_bytes_are_refused_with_the_name_of_the_file(
    tmp_path_factory: Any, data: bytes
) -> None:
    path = tmp_path_factory.mktemp("json") / "noise.json"
    path.write_bytes(data)
    with pytest.raises(ModelFileError, match=r"noise\.json"):
        storage.read(path, "sewfast.test", (1,))


def test_refuses_missing_large_and_folders(tmp_path: Path) -> None:
    large = tmp_path / "large.json"
    with large.open("wb") as file:
        file.truncate(storage.LARGEST_FILE + 1)
    with pytest.raises(ModelFileError, match="16 MB"):
        storage.read(large, "sewfast.test", (1,))
    with refuses(ModelFileError, expected="can be read"):
        storage.read(tmp_path / "absent.json", "sewfast.test", (1,))
    with refuses(ModelFileError, expected="a file", received="a folder"):
        storage.read(tmp_path, "sewfast.test", (1,))


def test_a_failed_write_leaves_the_old_file_and_nothing_else(tmp_path: Path) -> None:
    path = tmp_path / "kept.json"
    storage.write(path, "sewfast.test", 1, {"a": 1})
    with pytest.raises(ModelFileError, match=r"kept\.json"):
        storage.write(path, "sewfast.test", 1, {"a": float("nan")})
    with pytest.raises(ModelFileError, match=r"kept\.json"):
        storage.write(path, "sewfast.test", 1, {"a": object()})
    with refuses(ModelFileError, expected="can be written"):
        storage.write(tmp_path / "absent" / "a.json", "sewfast.test", 1, {})
    assert storage.read(path, "sewfast.test", (1,))["a"] == 1
    assert [entry.name for entry in tmp_path.iterdir()] == ["kept.json"]
