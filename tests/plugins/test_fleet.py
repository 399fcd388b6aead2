"""Many machines: rows that do not depend on where they were made, and none lost or doubled."""

from __future__ import annotations

import json
import math
import os
import shutil
import signal
import socket
import subprocess
import sys
import threading
import time
import warnings
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from sewfast import Controller, Fleet, Gains, fleet
from sewfast.cli import main
from sewfast.errors import SettingError, SewfastError
from sewfast_fleet import Drift, Row, load_fleet
from sewfast_fleet.recordings import jobs_of
from sewfast_fleet.running import Journal

SAMPLES = 1500
MACHINES = 8


def made(folder: Path, count: int = MACHINES, seed: int = 0, **altered: Any) -> Path:
    """Recordings of first-order machines, each with a gain and time constant of its own.

    `altered` maps a machine's number to what its gain, time constant and noise are multiplied by.
    """
    folder.mkdir(parents=True, exist_ok=True)
    for i in range(count):
        own = np.random.default_rng(1000 + i)
        gain, lag, noise = own.uniform(50.0, 150.0), own.uniform(0.02, 0.08), 2.0
        by = altered.get(f"m{i}", (1.0, 1.0, 1.0))
        gain, lag, noise = gain * by[0], lag * by[1], noise * by[2]
        rng = np.random.default_rng(seed + i)
        u = np.repeat(rng.uniform(-5.0, 5.0, SAMPLES // 30), 30)
        y, pole = np.zeros(SAMPLES), np.exp(-1e-3 / lag)
        for k in range(1, SAMPLES):
            y[k] = pole * y[k - 1] + (1.0 - pole) * gain * u[k - 1]
        y += noise * rng.normal(size=SAMPLES)
        np.savez(folder / f"m{i}.npz", t=np.arange(SAMPLES) * 1e-3, u=u, y=y)
    return folder


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return made(tmp_path_factory.mktemp("fleet") / "october")


@pytest.fixture(scope="module")
def alone(folder: Path) -> Fleet:
    """In this process."""
    return fleet(folder, workers=0)


def bits(found: Fleet) -> list[str]:
    """Rows as text: NaN is no number, and equal to itself here."""
    return [repr(row) for row in found.rows]


@pytest.fixture
def quiet() -> Iterator[None]:
    """What a cluster says while it is taken down is not what is tested."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        yield


@pytest.fixture
def another_cluster() -> Iterator[None]:
    """A server on the usual port of Dask's dashboard: this one, or one that is there already."""
    with socket.socket() as dashboard:
        with suppress(OSError):
            dashboard.bind(("127.0.0.1", 8787))
            dashboard.listen()
        yield


def test_every_machine_is_found(alone: Fleet) -> None:
    assert [row.file for row in alone.rows] == [f"m{i}.npz" for i in range(MACHINES)]
    for i, row in enumerate(alone.rows):
        own = np.random.default_rng(1000 + i)
        gain, lag = own.uniform(50.0, 150.0), own.uniform(0.02, 0.08)
        assert row.status == "ok", row.message
        assert abs(row.gain - gain) < 5.0 * row.gain_error + 1e-3 * gain
        # one sample of delay beside the lag, of which the first half is the sample itself
        assert abs(row.residence_time - lag) < 5.0 * row.residence_time_error + 1e-3
        assert row.fit_percent > 90.0


@pytest.mark.nightly("identifies sixteen times")
def test_standard_errors_are_those_of_repetition(tmp_path: Path) -> None:
    runs = [fleet(made(tmp_path / str(s), 1, seed=100 * s), workers=0).rows[0] for s in range(16)]
    for quantity in ("gain", "residence_time"):
        values = np.array([getattr(row, quantity) for row in runs])
        said = np.mean([getattr(row, f"{quantity}_error") for row in runs])
        assert 0.5 < values.std(ddof=1) / said < 1.8


@pytest.mark.slow("starts a cluster, of which this is the only one by day")
@pytest.mark.usefixtures("quiet")
def test_a_cluster_gives_the_same_bits_and_loses_no_row(folder: Path, alone: Fleet) -> None:
    pytest.importorskip("distributed", reason="needs dask")
    assert bits(fleet(folder, workers=2)) == bits(alone)


@pytest.mark.nightly("kills workers until all rows are there")
@pytest.mark.usefixtures("quiet")
def test_workers_that_are_killed_cost_nothing(tmp_path: Path) -> None:
    distributed = pytest.importorskip("distributed", reason="needs dask")
    import dask

    many = made(tmp_path / "many", 60)
    expected = bits(fleet(many, workers=0))
    with (
        dask.config.set({"distributed.scheduler.allowed-failures": 50}),
        distributed.LocalCluster(
            n_workers=2, threads_per_worker=1, dashboard_address=None
        ) as cluster,
        distributed.Client(cluster) as client,
    ):
        pids = list(client.run(os.getpid).values())
        killer = threading.Timer(1.0, lambda: [os.kill(pid, signal.SIGKILL) for pid in pids[:1]])
        killer.start()
        assert bits(fleet(many, client=client)) == expected
        killer.join()
        assert set(client.run(os.getpid).values()) != set(pids)


@pytest.mark.nightly("waits until workers count as lost")
@pytest.mark.usefixtures("quiet")
def test_workers_that_are_gone_for_good_are_missed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    distributed = pytest.importorskip("distributed", reason="needs dask")
    from sewfast_fleet import running

    monkeypatch.setattr(running, "_PATIENCE", 1.0)
    monkeypatch.setattr(running, "_LOOK", 0.2)
    with (
        distributed.LocalCluster(
            n_workers=1, threads_per_worker=1, dashboard_address=None
        ) as cluster,
        distributed.Client(cluster) as client,
    ):
        cluster.scale(0)
        with pytest.raises(SettingError, match="expected one at least") as caught:
            fleet(made(tmp_path / "many", 3), client=client)
    assert caught.value.name == "workers"


@pytest.mark.nightly("waits for slow workers")
@pytest.mark.usefixtures("quiet")
@pytest.mark.parametrize("own", [True, False], ids=["own cluster", "client's cluster"])
def test_a_worker_that_starts_slowly_is_not_given_up(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, own: bool
) -> None:
    """Dask closes for good what is away for longer than its timeout, here at once."""
    distributed = pytest.importorskip("distributed", reason="needs dask")
    import dask

    from sewfast_fleet import running

    many = made(tmp_path / "many", 30)
    expected = bits(fleet(many, workers=0))
    monkeypatch.setattr(running, "_LOOK", 0.5)
    before = set(distributed.Nanny._instances)
    killed: list[int] = []

    def kill(done: int, *_: Any) -> None:
        if done >= 3 and not killed:
            (keeper,) = set(distributed.Nanny._instances) - before
            killed.append(keeper.pid)
            os.kill(keeper.pid, signal.SIGKILL)

    settings = {
        "distributed.deploy.lost-worker-timeout": "10ms",
        "distributed.scheduler.allowed-failures": 50,
    }
    with dask.config.set(settings):
        if own:
            found = fleet(many, workers=1, progress=kill)
        else:
            with (
                distributed.LocalCluster(
                    n_workers=1, threads_per_worker=1, dashboard_address=None
                ) as cluster,
                distributed.Client(cluster) as client,
            ):
                found = fleet(many, client=client, progress=kill)
    assert killed
    assert bits(found) == expected


@pytest.mark.parametrize("starting", [True, False])
def test_workers_that_are_starting_are_waited_for_longer(
    monkeypatch: pytest.MonkeyPatch, starting: bool
) -> None:
    from sewfast_fleet import running

    now = 0.0
    asked: list[int] = []

    class Distributed:
        TimeoutError = TimeoutError

        @staticmethod
        def wait(tasks: set[str], timeout: float, return_when: str) -> SimpleNamespace:
            nonlocal now
            now += timeout
            raise TimeoutError

    keeper = SimpleNamespace(status=SimpleNamespace(name="running"), pid=7 if starting else None)
    gone = SimpleNamespace(status=SimpleNamespace(name="closed"), pid=None)
    cluster = SimpleNamespace(
        worker_spec={0: {}, 1: {}}, workers={0: keeper, 1: gone}, scale=asked.append,
        loop=SimpleNamespace(add_callback=lambda work: work()),
    )  # fmt: skip
    client = SimpleNamespace(cluster=cluster, scheduler_info=lambda n_workers: {"workers": {}})
    monkeypatch.setattr(running, "time", SimpleNamespace(monotonic=lambda: now))
    monkeypatch.setattr(running, "import_module", lambda name: Distributed)
    with pytest.raises(SettingError, match="600 s, while" if starting else "none for 120 s"):
        running._ended({"task"}, client)
    assert set(asked) == {2}
    assert cluster.workers == {0: keeper}


@pytest.mark.parametrize("present", [True, False])
def test_a_look_that_takes_long_is_no_absence(
    monkeypatch: pytest.MonkeyPatch, present: bool
) -> None:
    """A computer so busy that each look takes 200 s, the first while a worker starts anew."""
    from sewfast_fleet import running

    now, looks = 0.0, [{}, {"worker": 1} if present else {}]

    class Distributed:
        TimeoutError = TimeoutError

        @staticmethod
        def wait(tasks: set[str], timeout: float, return_when: str) -> SimpleNamespace:
            nonlocal now
            now += 200.0
            if looks:
                raise TimeoutError
            return SimpleNamespace(done=tasks)

    client = SimpleNamespace(scheduler_info=lambda n_workers: {"workers": looks.pop(0)})
    monkeypatch.setattr(running, "time", SimpleNamespace(monotonic=lambda: now))
    monkeypatch.setattr(running, "import_module", lambda name: Distributed)
    if present:
        assert running._ended({"task"}, client) == "task"
    else:
        with pytest.raises(SettingError, match="none for 120 s"):
            running._ended({"task"}, client)


@pytest.mark.nightly("ends workers with their tasks")
@pytest.mark.usefixtures("quiet")
def test_recordings_that_share_a_task_do_not_share_its_fault(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    distributed = pytest.importorskip("distributed", reason="needs dask")
    from sewfast_fleet import running

    many = made(tmp_path / "many", 40)
    expected = fleet(many, workers=0).rows
    real = running.row_of
    sizes: list[int] = []

    def broken(job: Any, *rest: Any) -> Any:
        if job.file == "m8.npz":  # among the last, which are handed out together
            raise RuntimeError("broken")
        return real(job, *rest)

    monkeypatch.setattr(running, "row_of", broken)
    monkeypatch.setattr(running, "_RETRIES", 0)
    # on a busy machine a recording alone may take a task's time
    monkeypatch.setattr(running, "_TASK_SECONDS", 1e6)
    with (
        distributed.LocalCluster(
            n_workers=1, threads_per_worker=1, processes=False, dashboard_address=None
        ) as cluster,
        distributed.Client(cluster) as client,
    ):
        submit = client.submit

        def seen(work: Any, jobs: Any, *rest: Any, **options: Any) -> Any:
            sizes.append(len(jobs))
            return submit(work, jobs, *rest, **options)

        monkeypatch.setattr(client, "submit", seen)
        found = fleet(many, client=client).rows
    assert max(sizes) > 1
    assert [row.message for row in found if row.status == "failed"] == ["RuntimeError: broken"]
    assert [repr(row) for row in found if row.file != "m8.npz"] == [
        repr(row) for row in expected if row.file != "m8.npz"
    ]


def test_a_bad_recording_costs_its_own_row(tmp_path: Path) -> None:
    place = made(tmp_path / "mixed", 2)
    (place / "empty.csv").write_text("")
    (place / "text.csv").write_text("t,u,y\n0,one,two\n")
    (place / "still.csv").write_text("t,u,y\n" + "".join(f"{k},0,0\n" for k in range(200)))
    (place / "short.csv").write_text("t,u,y\n0,1,2\n1,2,3\n")
    (place / "other.csv").write_text("t,voltage,speed\n0,1,2\n")
    (place / "cut.npz").write_bytes((place / "m0.npz").read_bytes()[:300])
    (place / "notes.txt").write_text("no recording")
    found = fleet(place, workers=0)
    assert len(found.rows) == 8
    assert {row.file for row in found.rows if row.status == "ok"} == {"m0.npz", "m1.npz"}
    assert all(row.message for row in found.failed)
    assert "2 identified, 6 failed" in str(found)
    assert "failed  text.csv: " in str(found)


@pytest.mark.parametrize("ending", ["csv", "json", "parquet"])
def test_a_table_comes_back_as_it_was(ending: str, tmp_path: Path, alone: Fleet) -> None:
    if ending == "parquet":
        pytest.importorskip("pyarrow", reason="needs pyarrow")
    alone.save(tmp_path / f"table.{ending}")
    assert bits(load_fleet(tmp_path / f"table.{ending}")) == bits(alone)


def test_drift_is_seen_and_nothing_else(tmp_path: Path, alone: Fleet) -> None:
    later = made(
        tmp_path / "november", seed=500, m1=(1.1, 1.0, 1.0), m4=(1.0, 1.3, 1.0), m6=(1.0, 1.0, 2.5)
    )
    alone.save(tmp_path / "october.csv")
    found = fleet(later, before=tmp_path / "october.csv", workers=0)
    assert {(d.file, d.quantity) for d in found.drifts} == {
        ("m1.npz", "gain"), ("m4.npz", "residence_time"), ("m6.npz", "noise"),
    }  # fmt: skip
    assert "drift   m1.npz: gain" in str(found)


@pytest.mark.nightly("many recordings")
def test_no_machine_drifts_by_itself(tmp_path: Path, alone: Fleet) -> None:
    """48 comparisons of three quantities, none of which has changed."""
    for seed in range(6):
        later = made(tmp_path / str(seed), seed=10_000 + 100 * seed)
        assert fleet(later, before=alone, workers=0).drifts == ()


def test_what_is_done_is_not_done_again(
    folder: Path, alone: Fleet, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from sewfast_fleet import running

    worked: list[str] = []
    real = running.row_of

    def interrupted(job: Any, *rest: Any) -> Any:
        if len(worked) == 3:
            raise KeyboardInterrupt
        worked.append(job.file)
        return real(job, *rest)

    out = tmp_path / "table.csv"
    monkeypatch.setattr(running, "row_of", interrupted)
    with pytest.raises(KeyboardInterrupt):
        fleet(folder, out=out, workers=0)
    journal = tmp_path / ".table.csv.journal"
    assert not out.exists()
    # and the process was killed in the middle of a line
    journal.write_text(journal.read_text() + '{"of": [1, 2')
    monkeypatch.setattr(
        running, "row_of", lambda job, *rest: worked.append(job.file) or real(job, *rest)
    )
    found = fleet(folder, out=out, workers=0)
    assert sorted(worked) == [f"m{i}.npz" for i in range(MACHINES)]
    assert bits(found) == bits(alone) == bits(load_fleet(out))
    assert not journal.exists()


def test_other_settings_begin_anew(folder: Path, tmp_path: Path) -> None:
    from sewfast_fleet import running

    out = tmp_path / "table.json"
    jobs = running.jobs_of(folder, "u", "y", None)
    kept = running.Journal(out, {"model": "oe", "seed": 0, "controller": None})
    with kept:
        kept.add(jobs[0], running.Row("m0.npz", kind="kept"))
    again = running.Journal(out, {"model": "oe", "seed": 0, "controller": None})
    known = again.known(jobs[0])
    assert known is not None
    assert known.kind == "kept"
    assert running.Journal(out, {"model": "arx", "seed": 0}).known(jobs[0]) is None
    os.utime(jobs[0].path, ns=(time.time_ns(), time.time_ns()))
    assert again.known(jobs[0]) is None


def test_a_manifest_says_how_each_is_read(tmp_path: Path, folder: Path) -> None:
    data = np.load(folder / "m2.npz")
    rows = zip(data["u"], data["y"], strict=True)
    (tmp_path / "own.csv").write_text(
        "volt,rpm\n" + "".join(f"{u!r},{y!r}\n" for u, y in ((float(a), float(b)) for a, b in rows))
    )
    manifest = tmp_path / "machines.csv"
    manifest.write_text("file,inputs,output,Ts\nown.csv,volt,rpm,0.001\n")
    row = fleet(manifest, workers=0).rows[0]
    assert row.status == "ok", row.message
    assert abs(row.gain - fleet([folder / "m2.npz"], workers=0).rows[0].gain) < 1e-6 * abs(row.gain)
    for text, said in (
        ("path\nown.csv\n", "a column file"),
        ("file,Ts\nown.csv,fast\n", "line 2: expected Ts"),
        ("file\nown.csv\nown.csv\n", "twice"),
        ("file,Ts\n,1\n", "line 2: expected the name of a file, .*, got none"),
        ("file,Ts\nown.csv,1,2\n", "got more cells than columns"),
        ("", "a column file"),
    ):
        manifest.write_text(text)
        with pytest.raises(SettingError, match=said):
            fleet(manifest, workers=0)


def test_columns_are_recognised_and_what_is_no_recording_is_left_out(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    u = np.repeat(rng.uniform(0.0, 12.0, 60), 20)
    y = np.convolve(u, 5.0 * 0.9 ** np.arange(100))[: len(u)] + rng.normal(0.0, 1.0, len(u))
    lines = (f"{10 * k};{a:.4f};{b:.3f}" for k, (a, b) in enumerate(zip(u, y, strict=True)))
    (tmp_path / "fan.csv").write_text(
        ("time_ms;voltage_V;speed_rpm\n" + "\n".join(lines)).replace(".", ",")
    )
    (tmp_path / "._fan.csv").write_bytes(b"of another system")
    (tmp_path / "other.csv").write_text("t,a,b\n0,1,2\n1,2,3\n")
    out = tmp_path / "table.csv"
    for _ in range(2):
        assert main(["fleet", str(tmp_path), "-o", str(out), "--workers", "0"]) == 0
        found = load_fleet(out)
        assert [(row.file, row.status) for row in found.rows] == [
            ("fan.csv", "ok"), ("other.csv", "failed"),
        ]  # fmt: skip
    assert found.rows[0].gain == pytest.approx(50.0, rel=0.02)
    assert "which is the input and which the output" in found.rows[1].message
    with pytest.raises(SettingError, match=r"fan\.csv: expected both, or neither"):
        fleet(tmp_path, inputs="voltage_V", workers=0)


def test_a_fleet_is_a_table_and_a_picture(alone: Fleet, tmp_path: Path) -> None:
    assert alone.columns()["gain"] == [row.gain for row in alone.rows]
    assert set(alone.columns()) == set(Row.__dataclass_fields__)
    assert "<td>" in alone._repr_html_()
    assert "m0.npz" in alone._repr_html_()
    pytest.importorskip("matplotlib")
    moved = Drift("m3.npz", "gain", 0.5 * alone.rows[3].gain, alone.rows[3].gain, 9.0)
    axes = Fleet(alone.rows, (moved,)).plot()
    assert [ax.get_ylabel() for ax in axes] == ["gain", "residence time [s]", "noise"]
    assert [t.get_text() for t in axes[0].texts] == ["m3.npz"]
    file = tmp_path / "fleet.png"
    alone.plot(file=file)
    assert file.stat().st_size > 10_000
    failed = Fleet((Row("a.csv", "failed", "damaged"),))
    assert "damaged" in failed._repr_html_()
    with pytest.raises(SettingError, match="all failed"):
        failed.plot()


def test_a_controller_for_each(tmp_path: Path) -> None:
    template = Controller(Gains.standard(0.01, 0.1), u_min=-5.0, u_max=5.0)
    found = fleet(made(tmp_path / "two", 2), controller=template, workers=0)
    gains = [row.Kp for row in found.rows]
    assert all(np.isfinite(gains))
    assert gains[0] != gains[1]


def test_what_makes_no_fleet_is_refused(tmp_path: Path, folder: Path) -> None:
    with pytest.raises(SettingError, match=r"got none in"):
        fleet(tmp_path, workers=0)
    with pytest.raises(SettingError, match="a folder, or a manifest"):
        fleet(tmp_path / "nix", workers=0)
    with pytest.raises(SettingError, match=r"ends in \.csv, \.json or \.parquet"):
        fleet(folder, out=tmp_path / "table.xlsx", workers=0)
    (tmp_path / "other.csv").write_text("a,b\n1,2\n")
    with pytest.raises(SettingError, match="a table that `sewfast fleet` wrote"):
        fleet(folder, before=tmp_path / "other.csv", workers=0)


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"workers": -1}, "workers: expected a whole number of 0 or more"),
        ({"workers": "2"}, "workers: expected a whole number of 0 or more"),
        ({"seed": -1}, "seed: expected a whole number"),
        ({"controller": 3}, "controller: expected a Controller"),
        ({"memory": "lots"}, "memory: expected a size"),
    ],
)
def test_settings_are_looked_at_before_any_work(
    folder: Path, settings: dict[str, Any], words: str
) -> None:
    if "memory" in settings:
        pytest.importorskip("distributed")
    with pytest.raises(SettingError, match=words):
        fleet(folder, **settings)


def test_a_folder_in_place_of_the_table_is_refused(folder: Path, tmp_path: Path) -> None:
    (tmp_path / "table.csv").mkdir()
    with pytest.raises(SettingError, match="received a folder"):
        fleet(folder, out=tmp_path / "table.csv", workers=0)
    with pytest.raises(SettingError, match="a folder that exists"):
        fleet(folder, out=tmp_path / "nix" / "table.csv", workers=0)


def test_a_number_that_nothing_can_be_computed_from_is_refused(tmp_path: Path) -> None:
    table = tmp_path / "table.json"
    Fleet((Row("a.csv", Ti=math.inf),)).save(table.with_suffix(".csv"))
    assert load_fleet(table.with_suffix(".csv")).rows[0].Ti == math.inf
    Fleet((Row("a.csv", gain=1e300),)).save(table)
    with pytest.raises(SettingError, match="gain: a number larger than 1e"):
        load_fleet(table)
    Fleet((Row("a.csv", gain=1.0, gain_error=-1.0),)).save(table)
    with pytest.raises(SettingError, match="gain_error: a standard error below 0"):
        load_fleet(table)


def test_ctrl_c_says_what_is_kept(
    folder: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    from sewfast_fleet import running

    done: list[str] = []
    real = running.row_of

    def interrupted(job: Any, *rest: Any) -> Any:
        if len(done) == 2:
            raise KeyboardInterrupt
        done.append(job.file)
        return real(job, *rest)

    monkeypatch.setattr(running, "row_of", interrupted)
    assert main(["fleet", str(folder), "-o", str(tmp_path / "a.csv"), "--workers", "0"]) == 130
    assert "2 recordings are done and kept" in capsys.readouterr().err


@pytest.mark.nightly("workers of a terminal of its own, started and ended several times")
@pytest.mark.usefixtures("another_cluster")
@pytest.mark.skipif(sys.platform == "win32", reason="no process group to send Ctrl-C to")
def test_ctrl_c_at_a_terminal_ends_the_workers_without_a_word_of_theirs(
    folder: Path, tmp_path: Path
) -> None:
    pytest.importorskip("distributed", reason="needs dask")
    many = made(tmp_path / "many", 100)
    command = [
        sys.executable, "-m", "sewfast", "fleet", str(many), "-o", str(tmp_path / "a.csv"),
        "--workers", "2",
    ]  # fmt: skip
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True
    ) as process:
        journal, deadline = tmp_path / ".a.csv.journal", time.monotonic() + 120.0
        while not journal.exists() or len(journal.read_bytes().splitlines()) < 3:
            assert process.poll() is None
            assert time.monotonic() < deadline
            time.sleep(0.02)
        os.killpg(process.pid, signal.SIGINT)
        out, said = process.communicate(timeout=120.0)
    assert (process.returncode, out) == (130, "")
    # workers that are too busy to end in time are ended, and what was written is said
    assert "recordings are done and kept" in said or f"interrupted; written: {journal}" in said
    assert "Traceback" not in said
    assert "distributed" not in said


def test_an_infinite_column_warns_nobody(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text("no,u,y\n" + "".join(f"inf,{k % 7},inf\n" for k in range(99)))
    (row,) = fleet(tmp_path, workers=0).rows
    assert "which is the input and which the output" in row.message


def test_the_command(
    folder: Path, tmp_path: Path, alone: Fleet, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "table.csv"
    assert main(["fleet", str(folder), "-o", str(out), "--workers", "0"]) == 0
    assert f"{MACHINES} recordings: {MACHINES} identified, 0 failed" in capsys.readouterr().out
    assert bits(load_fleet(out)) == bits(alone)
    again = ["fleet", str(folder), "-o", str(tmp_path / "later.json"), "--workers", "0"]
    assert main([*again, "--before", str(out), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["drifts"] == []
    assert main(["fleet", str(tmp_path / "nix"), "-o", str(out), "--workers", "0"]) == 2


@pytest.mark.nightly("every format", by_day=["csv"])
@pytest.mark.skipif(sys.platform != "linux", reason="other systems have no such file names")
@pytest.mark.parametrize("ending", ["csv", "json", "parquet"])
def test_any_file_name_comes_back(tmp_path: Path, ending: str) -> None:
    place = made(tmp_path / "odd", 1)
    for name in (b"\xff.npz", b"new\nline.npz", b'a; "b", c.npz'):
        shutil.copy(place / "m0.npz", os.fsencode(place) + b"/" + name)
    found = fleet(place, workers=0, out=tmp_path / f"x.{ending}")
    assert len(found.rows) == 4
    assert not found.failed
    assert bits(load_fleet(tmp_path / f"x.{ending}")) == bits(found)


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ("file\n" + "x" * 200_000, "line 1: expected a line of CSV"),
        ("file;output\na.npz;y\n;\n", "line 3: expected the name of a file"),
        ("file;Ts\na.npz;0,x\n", "line 2: expected Ts as a number"),
        ("t;u;y\n", "expected a manifest with a column file"),
    ],
)
def test_a_manifest_with_a_fault_names_the_line(tmp_path: Path, content: str, words: str) -> None:
    (tmp_path / "list.csv").write_text(content)
    with pytest.raises(SettingError, match=words):
        fleet(tmp_path / "list.csv", workers=0)


def test_a_manifest_of_a_spreadsheet_with_semicolons(tmp_path: Path) -> None:
    place = made(tmp_path / "m", 1)
    (place / "list.csv").write_text('file;inputs;output;Ts\nm0.npz;"u";y;0,001\nnot\0there;;;\n')
    found = fleet(place / "list.csv", workers=0)
    assert [row.status for row in found.rows] == ["ok", "failed"]
    assert found.rows[0].Ts == pytest.approx(0.001)


@pytest.mark.parametrize(
    "line",
    [
        b'{"of": [1], "row": {"file": "x", "new": 3}}', b'{"of": 3}', b"{}", b"[1]", b"\xff\xfe",
        b'{"of": [1], "row": {"file": [3]}}', b'{"of": null, "row": null}', b'{"a":' * 100_000,
    ],
)  # fmt: skip
def test_a_damaged_line_of_the_journal_is_left_out(
    folder: Path, tmp_path: Path, line: bytes
) -> None:
    settings = {"model": "oe", "seed": 0, "controller": None}
    with Journal(tmp_path / "x.csv", settings) as journal:
        (job,) = jobs_of([folder / "m0.npz"], None, None, None)
        journal.add(job, Row(job.file, message="kept"))
    assert journal.place is not None
    with journal.place.open("ab") as file:
        file.write(line + b"\n")
    (row,) = fleet([folder / "m0.npz"], workers=0, out=tmp_path / "x.csv").rows
    assert row.message == "kept"


def test_a_journal_that_cannot_be_read_is_refused(folder: Path, tmp_path: Path) -> None:
    (tmp_path / ".x.csv.journal").mkdir()
    with pytest.raises(SettingError, match=r"x\.csv\.journal: expected a file that can be read"):
        fleet([folder / "m0.npz"], workers=0, out=tmp_path / "x.csv")


@pytest.mark.skipif(sys.platform != "linux", reason="no limit of a file's size")
def test_a_full_disk_keeps_what_is_done(folder: Path, tmp_path: Path) -> None:
    import resource

    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    ignored = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1500, hard))
    try:
        with pytest.raises(SewfastError) as caught:
            fleet(folder, workers=0, out=tmp_path / "x.csv")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
        signal.signal(signal.SIGXFSZ, ignored)
    assert "make room" in caught.value.remedy
    assert not (tmp_path / "x.csv").exists()
    lines = (tmp_path / ".x.csv.journal").read_bytes().splitlines()
    assert len(lines) > 2
    seen: list[int] = []
    found = fleet(folder, workers=0, out=tmp_path / "x.csv", progress=lambda n, *_: seen.append(n))
    assert len(found.rows) == MACHINES
    assert not found.failed
    assert 0 < len(seen) < MACHINES


def test_a_fault_in_a_reader_costs_its_own_row(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(path: str) -> Any:
        raise RuntimeError("out of luck")

    monkeypatch.setattr("sewfast_fleet.recordings.read_table", broken)
    (row,) = fleet([folder / "m0.npz"], workers=0).rows
    assert (row.status, row.message) == ("failed", "RuntimeError: out of luck")


def test_columns_that_stand_still_are_named(tmp_path: Path) -> None:
    t = np.arange(100) * 0.01
    np.savez(tmp_path / "a.npz", t=t, u=np.full(100, np.nan), y=np.ones(100))
    (row,) = fleet(tmp_path, workers=0).rows
    assert "no two different numbers in u, y" in row.message


@pytest.mark.parametrize(
    ("wrong", "name"),
    [
        ({"client": "tcp://host:1"}, "client"), ({"scheduler": 3}, "scheduler"),
        ({"model": "nix"}, "model"), ({"model": ["oe"]}, "model"),
    ],
)  # fmt: skip
def test_other_arguments_are_refused_before_any_work(
    folder: Path, wrong: dict[str, Any], name: str
) -> None:
    with pytest.raises(SettingError) as caught:
        fleet(folder, **wrong)
    assert caught.value.name == name
    with pytest.raises(SettingError) as caught:
        fleet([3], workers=0)  # type: ignore[list-item]
    assert caught.value.name == "recordings"
