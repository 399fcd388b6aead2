"""`fleet`: recordings distributed to workers, and the journal from which a call continues."""

from __future__ import annotations

import json
import logging
import math
import multiprocessing
import os
import signal
import threading
import time
from collections import deque
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from concurrent.futures import CancelledError, Future
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, field
from importlib import import_module
from multiprocessing import resource_tracker
from pathlib import Path
from typing import Any

from sewfast import storage
from sewfast.arrays import is_whole
from sewfast.control.controller import Controller
from sewfast.errors import ModelFileError, SettingError, unreadable, unwritable
from sewfast.kinds import KINDS, Kind
from sewfast.progress import shown_in_notebooks

from .recordings import Job, jobs_of, row_of
from .table import COLUMNS, FORMAT, Fleet, Row, drifts, earlier_rows, require_ending

_IN_FLIGHT = 4
"""Tasks submitted at once per worker, to bound the scheduler's memory."""
_TASK_SECONDS, _TASK_RECORDINGS = 1.0, 16
"""Target duration of a task [s], and its most recordings: submitting one costs 20 ms."""
_RETRIES = 50
"""Deaths of workers over one recording before it counts as the cause."""
_PATIENCE, _LOOK = 120.0, 5.0
"""Longest time without any worker, and interval of checking it [s]."""
_STARTING = 5.0
"""Factor on that time while workers' processes exist but are not ready, as on a busy computer."""


@shown_in_notebooks("fleet", "share failed")
def fleet(
    recordings: str | os.PathLike[str] | Sequence[str | os.PathLike[str]],
    *,
    inputs: str | Sequence[str] | None = None,
    output: str | None = None,
    Ts: float | None = None,
    model: Kind = "oe",
    controller: Controller | None = None,
    before: str | os.PathLike[str] | Fleet | None = None,
    out: str | os.PathLike[str] | None = None,
    client: Any = None,
    scheduler: str | None = None,
    workers: int | None = None,
    memory: str = "500MB",
    seed: int = 0,
    progress: Callable[[int, int, float], object] | None = None,
) -> Fleet:
    """Identify and check many recordings.

    Parameters
    ----------
    recordings : path or sequence of paths
        A folder (with its subfolders), a manifest (CSV with a column `file` and, if they differ,
        `inputs` (several apart by `;`), `output`, `Ts`), or files.
    inputs, output : str, or sequence of str, or None
        Columns, as for `sewfast.read`. None: recognised in each recording by their names and units,
        `u` and `y` first, as on the command line.
    Ts : float, optional
        As for `sewfast.read`.
    model : str
        As for `identify`. Linear output error by default: its gain and residence time can be
        compared from run to run, and it takes a fraction of a second.
    controller : Controller, optional
        Tuned separately for every model, from these settings.
    before : path or Fleet, optional
        An earlier result (`.csv`, `.json`, `.parquet`): `drifts` lists the quantities that have
        moved beyond their bands.
    out : path, optional
        Where to write the table (`.csv`, `.json`, `.parquet`). A journal is kept next to it until
        everything is done; the same call continues from it and processes only what is new or
        changed.
    client : dask.distributed.Client, optional
        Client of your own cluster.
    scheduler : str, optional
        Address of a cluster, such as `tcp://host:8786`.
    workers : int, optional
        Processes on this computer if there is neither; by default as many as cores. 0 works in this
        process, without Dask.
    memory : str
        Limit for each worker on this computer; a worker that uses more is restarted.
    seed : int
        As for `identify`; the same seed gives the same bits on any number of workers.
    progress : callable, optional
        Called with recordings done, recordings in all and the share that failed. If left out, a
        notebook shows a progress bar; None shows nothing.

    Returns
    -------
    Fleet

    Raises
    ------
    SettingError
        For no recordings, an unknown file extension, or if Dask is needed and not installed.
    """
    _require_settings(workers, controller, seed, model)
    _require_cluster(client, scheduler)
    tables = [Path(p) for p in (out, before) if isinstance(p, str | os.PathLike)]
    jobs = jobs_of(recordings, inputs, output, Ts, tables)
    settings: dict[str, Any] = {"model": model, "seed": seed, "controller": None}
    if controller is not None:
        settings["controller"] = controller.to_dict()
    earlier = earlier_rows(before)
    place = None if out is None else Path(out)
    if place is not None:
        require_ending(place)
        storage.require_writable(place)
    journal = Journal(None if place is None else place, settings)
    rows = {job.file: row for job in jobs if (row := journal.known(job)) is not None}
    waiting = [job for job in jobs if job.file not in rows]
    failed = sum(row.status != "ok" for row in rows.values())
    with journal:
        for job, row in _worked(waiting, settings, controller, client, scheduler, workers, memory):
            rows[job.file] = row
            journal.add(job, row)
            failed += row.status != "ok"
            if progress is not None:
                progress(len(rows), len(jobs), failed / len(rows))
    ordered = tuple(rows[file] for file in sorted(rows))
    found = Fleet(ordered, tuple(drifts(earlier, ordered)))
    if place is not None:
        found.save(place)
        journal.remove()
    return found


def _require_settings(workers: Any, controller: Any, seed: Any, model: Any) -> None:
    if not isinstance(model, str) or model.replace("-", "_") not in KINDS:
        raise SettingError(
            name="model", expected=", ".join(KINDS), received=repr(model), remedy="take 'oe'"
        )
    if workers is not None and not (is_whole(workers) and workers >= 0):
        raise SettingError(
            f"workers: expected a whole number of 0 or more, got {workers!r}; 0 works in this "
            "process, None takes every core"
        )
    if controller is not None and not isinstance(controller, Controller):
        raise SettingError(
            f"controller: expected a Controller, got {type(controller).__name__}; load one with "
            "load_controller"
        )
    if not (is_whole(seed) and 0 <= seed < 2**64):
        raise SettingError(
            f"seed: expected a whole number from 0 to 2^64 - 1, got {seed!r}; take 0"
        )


def _require_cluster(client: Any, scheduler: Any) -> None:
    if client is not None and not (hasattr(client, "submit") and hasattr(client, "scheduler_info")):
        raise SettingError(
            name="client", expected="a dask.distributed.Client",
            received=type(client).__name__, remedy="give an address as `scheduler`",
        )  # fmt: skip
    if scheduler is not None and not isinstance(scheduler, str):
        raise SettingError(
            name="scheduler", expected="an address as text", received=repr(scheduler),
            remedy="for example 'tcp://host:8786'; a client goes to `client`",
        )  # fmt: skip


# --- Workers --------------------------------------------------------------------------------------


def _worked(
    recordings: Sequence[Job],
    settings: Mapping[str, Any],
    controller: Controller | None,
    client: Any,
    scheduler: str | None,
    workers: int | None,
    memory: str,
) -> Iterator[tuple[Job, Row]]:
    """Yield rows as they are finished, in any order."""
    if workers == 0 and client is None and scheduler is None:
        for job in recordings:
            yield job, row_of(job, settings, controller)
        return
    if not recordings:
        return
    with _connected(client, scheduler, workers, memory) as connected:
        killed = import_module("distributed.scheduler").KilledWorker

        waiting = deque(recordings)
        submitted: dict[str, list[Job]] = {}
        flying = _IN_FLIGHT * max(1, len(connected.scheduler_info(n_workers=-1)["workers"]))
        done, took = 0, 0.0

        def submit(together: list[Job]) -> Any:
            future = connected.submit(
                _rows_of, together, settings, controller, pure=False, retries=_RETRIES
            )
            submitted[future.key] = together
            return future

        def following() -> list[list[Job]]:
            if not waiting:
                return []
            fit = int(_TASK_SECONDS * done / took) if done else 1
            # smaller portions towards the end, so that all workers finish at about the same time
            count = max(1, min(fit, _TASK_RECORDINGS, math.ceil(len(waiting) / flying)))
            return [[waiting.popleft() for _ in range(count)]]

        running = {submit(jobs) for _ in range(flying) for jobs in following()}
        while running:
            future = _ended(running, connected)
            running.remove(future)
            together = submitted.pop(future.key)
            alone: list[list[Job]] = []
            try:
                rows, seconds = future.result()
                done, took = done + len(rows), took + seconds
            except Exception as error:
                if len(together) > 1:  # separately, so that the cause affects only its own row
                    rows, alone = [], [[job] for job in together]
                else:
                    message = f"{type(error).__name__}: {error}"
                    if isinstance(error, killed):
                        message = (
                            f"expected {memory} to suffice, but the worker died over it again "
                            "and again; give more memory, or a shorter recording"
                        )
                    rows = [Row(together[0].file, "failed", message)]
            future.release()
            for jobs in alone or following():
                running.add(submit(jobs))
            yield from zip(together, rows, strict=False)


def _ended(running: Collection[Any], connected: Any) -> Any:
    """Wait for one of the tasks to end, as long as there are workers."""
    distributed = import_module("distributed")
    without, missed = math.inf, ""
    while not missed:
        try:
            found = distributed.wait(running, _LOOK, return_when="FIRST_COMPLETED")
            return next(iter(found.done))
        except distributed.TimeoutError:
            # start of the time without workers: on a busy computer the check itself is slow
            none = not connected.scheduler_info(n_workers=-1)["workers"]
            without = min(without, time.monotonic()) if none else math.inf
            starting = _replaced(connected) if none else False
            patience = _PATIENCE * (_STARTING if starting else 1.0)
            if time.monotonic() - without >= patience:
                missed = f"workers: expected one at least, got none for {patience:g} s"
                if starting:
                    missed += ", while their processes keep starting (a busy computer, or memory "
                    missed += "that does not suffice to start)"
        except CancelledError:
            missed = "scheduler: expected it to stay, got a connection that is closed"
    raise SettingError(
        f"{missed}; start it again and repeat the call: with `out` it continues where it stopped"
    )


def _replaced(connected: Any) -> bool:
    """Let the client's own cluster start its missing workers; return whether any is starting.
    A LocalCluster gives up a worker that has been away for 15 s (`lost-worker-timeout`), which on a
    busy computer can be merely restarting, and one that failed to start; it replaces missing
    workers only when it is scaled.
    """
    cluster: Any = getattr(connected, "cluster", None)
    if not (hasattr(cluster, "worker_spec") and hasattr(cluster, "scale")):
        return False
    keepers = dict(cluster.workers)
    ended = [name for name, keeper in keepers.items() if keeper.status.name in ("closed", "failed")]

    def scale() -> None:
        for name in ended:
            cluster.workers.pop(name, None)
        cluster.scale(len(cluster.worker_spec))

    cluster.loop.add_callback(scale)
    return any(getattr(keeper, "pid", None) is not None for keeper in keepers.values())


def _rows_of(
    jobs: Sequence[Job], settings: Mapping[str, Any], controller: Controller | None
) -> tuple[list[Row], float]:
    """Rows of a task, and the time that they took [s]."""
    began = time.perf_counter()
    return [row_of(job, settings, controller) for job in jobs], time.perf_counter() - began


@contextmanager
def _connected(
    client: Any, scheduler: str | None, workers: int | None, memory: str
) -> Iterator[Any]:
    if client is not None:
        yield client
        return
    try:
        dask, distributed = import_module("dask"), import_module("distributed")
    except ImportError as error:
        raise SettingError(
            "expected Dask to work on several recordings at once, got none; pip install "
            "'sewfast[fleet]', or give workers=0 (--workers 0)"
        ) from error
    if scheduler is not None:
        try:
            made = distributed.Client(scheduler)
        except (OSError, ValueError) as error:
            raise SettingError(
                f"scheduler: expected the address of a Dask scheduler, {scheduler!r} cannot be "
                f"reached ({type(error).__name__}); start it, or check the address"
            ) from error
        with made:
            yield made
        return
    try:
        dask.utils.parse_bytes(memory)
    except (ValueError, TypeError, AttributeError) as error:
        raise SettingError(
            f"memory: expected a size such as '500MB', got {memory!r}; state its unit"
        ) from error
    kept = {
        # a killed worker is not the fault of its recording
        "distributed.scheduler.allowed-failures": _RETRIES,
        # and is restarted, however long that takes on a busy computer
        "distributed.deploy.lost-worker-timeout": "1 day",
    }
    with dask.config.set(kept):
        options = {
            "n_workers": workers or os.cpu_count() or 1,
            "threads_per_worker": 1,
            "memory_limit": memory,
            # no dashboard: its server starts nevertheless, and on its usual port would warn of
            # another cluster of the user's
            "dashboard_address": None,
            "scheduler_kwargs": {"dashboard_address": "127.0.0.1:0"},
            # messages of its processes about each other while they end are irrelevant
            "silence_logs": logging.CRITICAL,
        }
        others = set(multiprocessing.active_children())  # of the program that calls this
        cluster = _without_ctrl_c(lambda: distributed.LocalCluster(**options))
        with cluster, distributed.Client(cluster) as made:
            try:
                yield made
            except KeyboardInterrupt:
                # nothing that they still compute is wanted, and to ask them to end takes seconds
                for process in set(multiprocessing.active_children()) - others:
                    process.kill()
                # the cluster's own silence ends before its last messages
                logging.getLogger("distributed").setLevel(logging.CRITICAL)
                raise


def _without_ctrl_c(start: Callable[[], Any]) -> Any:
    """Start processes that ignore Ctrl-C, while this process hears it and ends them.
    They inherit the signals that the thread blocks in which they are started.
    """
    started: Future[Any] = Future()

    def run() -> None:
        if hasattr(signal, "pthread_sigmask"):
            # one that started later would unblock the signals of this thread
            resource_tracker.ensure_running()
            signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
        try:
            started.set_result(start())
        except BaseException as error:
            started.set_exception(error)

    threading.Thread(target=run, daemon=True).start()
    try:
        return started.result()
    except KeyboardInterrupt:
        started.add_done_callback(_closed)
        raise


def _closed(made: Future[Any]) -> None:
    """Close a cluster that nobody wants any more, unless the end of this process did so."""
    with suppress(Exception):
        made.result().close()


# --- Journal --------------------------------------------------------------------------------------


@dataclass
class Journal:
    """A line for each finished row, next to the table to be written. The first line has the
    settings; a journal with other settings is started afresh. A truncated last line is ignored.
    """

    out: Path | None
    settings: Mapping[str, Any]
    _rows: dict[str, tuple[list[Any], Row]] = field(default_factory=dict)
    _file: Any = None

    def __post_init__(self) -> None:
        place = self.place
        if place is None or not place.exists():
            return
        try:
            lines = place.read_text(encoding="utf-8", errors="replace").splitlines()
        except OSError as error:
            raise unreadable(SettingError, place, error) from error
        entries = [entry for line in lines if (entry := _parsed(line)) is not None]
        if not entries or entries[0] != self._head():
            return
        for entry in entries[1:]:
            row = _row(entry)
            if row is not None:
                self._rows[row.file] = (entry["of"], row)

    @property
    def place(self) -> Path | None:
        return None if self.out is None else self.out.with_name(f".{self.out.name}.journal")

    def _head(self) -> dict[str, Any]:
        return {"format": FORMAT, "version": 1, "settings": json.loads(json.dumps(self.settings))}

    def known(self, job: Job) -> Row | None:
        """The stored row of a recording, if that has not changed since."""
        fingerprint, row = self._rows.get(job.file, (None, None))
        return row if fingerprint == job.fingerprint() else None

    def __enter__(self) -> Journal:
        if self.place is not None:
            lines = [self._head(), *({"of": f, "row": asdict(r)} for f, r in self._rows.values())]
            storage.replace(self.place, "".join(json.dumps(line) + "\n" for line in lines))
            self._file = self.place.open("ab", buffering=0)
        return self

    def add(self, job: Job, row: Row) -> None:
        if self._file is not None:
            line = {"of": job.fingerprint(), "row": asdict(row)}
            try:
                self._file.write((json.dumps(line) + "\n").encode())
            except OSError as error:
                remedy = "make room; the same call continues where it stopped"
                raise unwritable(ModelFileError, self.place, error, remedy) from error

    def __exit__(self, *_: object) -> None:
        if self._file is not None:
            self._file.close()

    def remove(self) -> None:
        if self.place is not None:
            self.place.unlink(missing_ok=True)


def _parsed(line: str) -> dict[str, Any] | None:
    try:
        found = json.loads(line)
    except (json.JSONDecodeError, RecursionError):
        return None
    return found if isinstance(found, dict) else None


def _row(entry: Mapping[str, Any]) -> Row | None:
    """The row of a journal's line; None if it is damaged or of another version."""
    values = entry.get("row")
    if not isinstance(values, dict) or set(values) != set(COLUMNS) or "of" not in entry:
        return None
    return Row(**values) if isinstance(values["file"], str) else None
