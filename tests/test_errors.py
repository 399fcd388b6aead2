"""Errors have fields: what was expected, what came, what to do."""

from __future__ import annotations

import copy
import pickle
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import sewfast
from sewfast import errors
from sewfast.errors import LinkError, SewfastError

KINDS = [SewfastError, *SewfastError.__subclasses__()]
WORDS = st.text(alphabet="abcdefghij 0123456789()[].<>=+-", min_size=1).filter(
    lambda text: text == text.strip() and text
)


def fields(error: SewfastError) -> tuple[str | None, ...]:
    return error.name, error.expected, error.received, error.remedy


@pytest.mark.parametrize("kind", KINDS)
@given(name=st.none() | WORDS, expected=WORDS, received=st.none() | WORDS, remedy=st.none() | WORDS)
def test_a_message_made_of_fields_gives_them_back(
    kind: type[SewfastError], name: Any, expected: str, received: Any, remedy: Any
) -> None:
    made = kind(name=name, expected=expected, received=received, remedy=remedy)
    assert fields(made) == (name, expected, received, remedy)
    assert fields(kind(str(made))) == fields(made)
    assert "\n" not in str(made)


@pytest.mark.parametrize("kind", KINDS)
def test_it_is_the_same_after_a_copy(kind: type[SewfastError]) -> None:
    made = kind(name="u", expected="one column", received="two", remedy="use u[:, 0]")
    for copied in (copy.copy(made), pickle.loads(pickle.dumps(made))):
        assert (type(copied), str(copied), fields(copied)) == (kind, str(made), fields(made))


@pytest.mark.parametrize(
    ("message", "expected"),
    [
        ("u: expected a, got b; c", ("u", "a", "b", "c")),
        ("f.csv, line 3: expected a, received 'x; y'; c", ("f.csv, line 3", "a", "'x; y'", "c")),
        ("udp://a:5: expected one thread, a second came; c",
         ("udp://a:5", "one thread", "a second came", "c")),
        ("u: expected (5,), or (5, n), time first; received (3,); c",
         ("u", "(5,), or (5, n), time first", "(3,)", "c")),
        ("expected a", (None, "a", None, None)),
        ("expected a; b", (None, "a", None, "b")),
        ("no file 'expected x'; y", (None, None, None, None)),
        ("", (None, None, None, None)),
    ],
)  # fmt: skip
def test_a_message_that_is_given_whole_is_read(message: str, expected: tuple[Any, ...]) -> None:
    error = SewfastError(message)
    assert (str(error), fields(error)) == (message, expected)


def refused(what: Any) -> SewfastError:
    with pytest.raises(SewfastError) as caught:
        what()
    return caught.value


def test_what_users_meet_first_has_its_fields(tmp_path: Path) -> None:
    short = refused(lambda: sewfast.Dataset.from_arrays(np.ones((5, 1, 1)), np.ones(5), 0.001))
    assert (short.name, short.received) == ("u", "(5, 1, 1)")
    assert short.expected is not None
    assert "(5,)" in short.expected
    text = refused(lambda: sewfast.Gains.standard("fast", 1.0))
    assert (text.name, text.expected, text.received) == ("Kp", "a number", "'fast'")
    (tmp_path / "m.json").write_text("[]")
    damaged = refused(lambda: sewfast.load_model(tmp_path / "m.json"))
    assert damaged.name == str(tmp_path / "m.json")
    assert damaged.expected
    # of the compiled core
    core = refused(lambda: sewfast.speed_from_counts([0.0, 1.0, 2.0, 3.0], -1.0, 4096.0))
    assert core.expected
    assert core.remedy


def test_a_link_error_is_an_os_error_with_its_message_only() -> None:
    error = LinkError("a: expected b, got c; d")
    assert isinstance(error, OSError)
    assert (error.errno, error.args, error.recording) == (None, ("a: expected b, got c; d",), None)


def test_every_kind_is_public() -> None:
    assert {kind.__name__ for kind in KINDS} <= set(dir(errors))
