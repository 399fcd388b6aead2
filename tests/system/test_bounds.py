"""What no file, name or argument does: abort the process, fill the memory, take for ever."""

from __future__ import annotations

import io
import time
import tracemalloc
import zipfile
import zlib
from pathlib import Path

import numpy as np
import pytest

from cli import call_refused as refused
from cli import called as command
from refusals import refuses
from sewfast import _core
from sewfast.errors import DataError
from sewfast.readers import read_table
from sewfast.recordfile import read_recording
from sewfast.recordfile.format import (
    CHUNK,
    CHUNK_HEAD,
    MAGIC,
    MESSAGE,
    MESSAGE_HEAD,
    PACKED_HEAD,
    RECORD,
    ZSTD,
)


def test_a_horizon_beyond_the_record_is_the_free_run() -> None:
    u = np.sin(np.arange(400) * 0.3)[:, None]
    y = np.convolve(u[:, 0], [0.0, 0.3, 0.2])[:400]
    fit = _core.fit_neural_ss(
        [(u, y)], [], nx=1, nk=1, hidden=2, linear=None, output="linear",
        output_parameters=np.zeros(0), integrator=False, weight_decay=1e-8, hidden_scale=1.0,
        max_iterations=5, starts=1, first_start=0, seed=0, threads=1,
    )  # fmt: skip
    model, state = fit.model, np.zeros(1)
    free = model.simulate(u, state)
    for horizon in (400, 2**31 - 1, 10**12):
        np.testing.assert_array_equal(model.predict(u, y, state, horizon), free)


def heads_alone(size: int) -> bytes:
    """A file of heads of chunks, each of which states a chunk as large as one may be."""
    body = 1 << 20
    head = CHUNK_HEAD.pack(
        CHUNK, CHUNK_HEAD.size - RECORD.size + body, 0, 1, body, 0x12345678, 0, body
    )
    return MAGIC + head * (size // len(head))


def test_a_file_of_heads_alone_is_refused_in_time_that_grows_with_its_size(tmp_path: Path) -> None:
    path = tmp_path / "heads.mcap"
    path.write_bytes(heads_alone(8 << 20))
    began = time.process_time()
    with pytest.raises(DataError, match="heads alone"):
        read_recording(path)
    # its checksums alone took minutes
    assert time.process_time() - began < 5.0


def test_a_recording_that_unpacks_to_gigabytes_is_refused_before_it_does(tmp_path: Path) -> None:
    """Chunks of one message of 4 MB of spaces; their checksums hold."""
    zstandard = pytest.importorskip("zstandard", reason="needs the extra zstd")
    message = MESSAGE_HEAD.pack(2, 0, 0, 0) + b" " * (4_000_000 - MESSAGE_HEAD.size)
    records = RECORD.pack(MESSAGE, len(message)) + message
    stored = zstandard.ZstdCompressor().compress(records)
    head = PACKED_HEAD.pack(
        CHUNK, PACKED_HEAD.size - RECORD.size + len(stored), 0, 1, len(records),
        zlib.crc32(records), len(ZSTD), ZSTD, len(stored),
    )  # fmt: skip
    path = tmp_path / "bomb.mcap"
    path.write_bytes(MAGIC + (head + stored) * 2000)
    assert path.stat().st_size < 2_000_000
    tracemalloc.start()
    with pytest.raises(DataError, match="at most 200 times the file"):
        read_recording(path)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 300 * path.stat().st_size


def test_an_archive_that_unpacks_to_gigabytes_is_refused_before_it_does(tmp_path: Path) -> None:
    path = tmp_path / "bomb.npz"
    header = io.BytesIO()
    np.lib.format.write_array_header_1_0(
        header, {"descr": "<f8", "fortran_order": False, "shape": (150_000_000,)}
    )
    with (
        zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive,
        archive.open("u.npy", "w", force_zip64=True) as member,
    ):
        member.write(header.getvalue())
        for _ in range(1200):
            member.write(bytes(1_000_000))
    assert path.stat().st_size < 10_000_000
    began = time.process_time()
    with pytest.raises(DataError, match=r"at most 1024 MB in all, received 1144 MB"):
        read_table(path)
    assert time.process_time() - began < 1.0


FORMULA, STEERING = r"$\frac{1}{", "y\x1b[31m"


def test_a_column_s_name_is_no_formula_and_steers_no_terminal(tmp_path: Path) -> None:
    random = np.random.default_rng(1)
    u = np.repeat(random.uniform(-1, 1, 60), 20)
    y = np.zeros(len(u))
    for k in range(1, len(u)):
        y[k] = 0.95 * y[k - 1] + 0.05 * u[k - 1]
    rows = "\n".join(f"{0.001 * k:.3f},{a},{b}" for k, (a, b) in enumerate(zip(u, y, strict=True)))
    (tmp_path / "names.csv").write_text(f"t,{FORMULA},{STEERING}\n{rows}\n")
    names = ("--input", FORMULA, "--output", STEERING)
    for said in (
        command(tmp_path, "look", "names.csv"),
        command(tmp_path, "look", "names.csv", *names, "--plot", "names.png"),
        command(tmp_path, "identify", "names.csv", *names, "--model", "oe", "-o", "m.json"),
        command(tmp_path, "check", "m.json", "names.csv", "--plot", "plots"),
    ):
        assert "\x1b" not in said.out + said.err
    assert (tmp_path / "names.png").stat().st_size > 1000
    assert list((tmp_path / "plots").glob("*.png"))
    assert "\x1b" not in refused(tmp_path, "look", "names.csv", "--input", "\x1b[2J")
    table = read_table(tmp_path / "names.csv")
    assert table.names == ("t", FORMULA, r"y\x1b[31m")
    np.testing.assert_array_equal(table[STEERING], table[r"y\x1b[31m"])
    # the same names out of a file of arrays
    np.savez(tmp_path / "names.npz", **{"y\x1b": y})
    assert read_table(tmp_path / "names.npz").names == (r"y\x1b",)


def test_a_full_disk_keeps_the_controllers(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from types import SimpleNamespace

    from sewfast.commissioning import result

    written = []

    class Artefact:
        def save(self, path: Path) -> None:
            written.append(path.relative_to(tmp_path).as_posix())

    class Table:
        def __init__(self, fits: bool) -> None:
            self.fits = fits

        def save(self, path: Path) -> None:
            if not self.fits:
                raise OSError(28, "No space left on device", str(path))
            written.append(path.relative_to(tmp_path).as_posix())

    found = SimpleNamespace(
        recordings={"pulses": Table(fits=False), "motion": Table(fits=True)},
        models=Artefact(), first=Artefact(), controller=Artefact(), comparisons=[],
        position=SimpleNamespace(controller=Artefact()), stops=(),
    )  # fmt: skip
    with refuses(
        DataError, expected="room for 2 tables", remedy="the controllers and models are there"
    ):
        result._artefacts(found, tmp_path)  # type: ignore[arg-type]
    assert written == [
        "controllers/tuned.json", "controllers/first.json", "controllers/position.json",
        "models/ensemble.json", "recordings/motion.csv",
    ]  # fmt: skip
