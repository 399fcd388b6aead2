"""The link's frames against an implementation that shares no code with ours."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

GOLDEN = Path(__file__).parent / "golden"
sys.path.insert(0, str(GOLDEN))

import link_frames as golden  # noqa: E402

FRAMES = st.tuples(
    st.integers(0, 2**8 - 1),
    st.integers(0, 2**16 - 1),
    st.integers(0, 2**32 - 1),
    st.integers(0, 2**64 - 1),
    st.binary(max_size=golden.MAX_BODY),
)


@pytest.fixture(scope="module")
def vectors() -> dict[str, Any]:
    return json.loads((GOLDEN / "link_frames.json").read_text())


def test_the_files_are_what_the_generator_writes(vectors):
    assert vectors == json.loads(json.dumps(golden.document()))
    assert (GOLDEN / "link_frames.txt").read_text() == golden.lines()


def test_the_vectors_keep_to_the_layout(vectors):
    for row in vectors["frames"]:
        body, frame, wire = (bytes.fromhex(row[name]) for name in ("body", "frame", "wire"))
        assert len(frame) == 19 + len(body) <= 250
        assert len(wire) == len(frame) + 2
        assert wire.find(0) == len(wire) - 1
        fields = (row["kind"], row["tag"], row["sequence"], int(row["time"]), body)
        assert list(golden.frames(wire)) == [fields]


@given(FRAMES)
def test_the_reference_reads_what_it_writes(fields):
    assert list(golden.frames(golden.wire(*fields))) == [fields]
