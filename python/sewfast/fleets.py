"""Many machines: one recording, one row, on the cores of this computer or on a Dask cluster.

`fleet` identifies and checks every recording of a folder. A recording that cannot be used costs its
own row and no other; what is done is kept in a journal, from which the same call goes on.
"""

from __future__ import annotations

import csv
import hashlib
import io
import itertools
import json
import math
import os
import signal
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

from . import storage
from .control.controller import Controller
from .dataset import Dataset
from .errors import SettingError, SewfastError
from .evidence import Residuals, estimate
from .identification import identify
from .kinds import Kind
from .models import Model
from .progress import shown_in_notebooks
from .readers import read
from .validation import validate

READABLE = (".csv", ".mat", ".npz", ".parquet", ".mcap")
TRAINED = 0.7
"""Share of a recording that is identified from; the rest is what the figures are of."""
SIGMAS = 4.0
LEAST_CHANGE = 0.02
"""Of a gain or a residence time: less is no drift, however certain it is."""
NOISE_RATIO = 1.5
"""Between the residuals of two recordings, either way, from which on it is drift."""
_IN_FLIGHT = 4
"""Recordings handed out at once for each worker: no more lie in the scheduler's memory."""
_RETRIES = 50
"""Workers that may die over one recording before it is taken for the cause."""
_FORMAT = "sewfast.fleet"


@dataclass(frozen=True)
class Row:
    """What one recording said.

    Attributes
    ----------
    file : str
        Relative to the folder, or as the manifest has it.
    status : str
        `ok`, or `failed` where there is a message instead of a model.
    message : str
    samples : int
    Ts : float
        [s]
    kind : str
        Of the model.
    fit_percent, rmse : float
        In free run on the last 30 % of the recording, from which nothing was learned.
    noise : float
        Standard deviation of the residual there.
    gain, gain_error : float
        Steady gain from the first input and its standard error; NaN for networks.
    residence_time, residence_time_error : float
        Average residence time [s] and its standard error: of a first-order lag its time constant
        and dead time together, of others the area between step response and final value over the
        gain (Astrom and Hagglund 2006, chapter 2); NaN for networks and integrators.
    verdict : str
        Of `identify`, in words.
    parameters : str
        Start of the hash of all parameters: equal for equal bits.
    Kp, Ti, Td : float
        Gains of the controller tuned for it, in standard form; NaN where none was asked for.
    """

    file: str
    status: str = "ok"
    message: str = ""
    samples: int = 0
    Ts: float = math.nan
    kind: str = ""
    fit_percent: float = math.nan
    rmse: float = math.nan
    noise: float = math.nan
    gain: float = math.nan
    gain_error: float = math.nan
    residence_time: float = math.nan
    residence_time_error: float = math.nan
    verdict: str = ""
    parameters: str = ""
    Kp: float = math.nan
    Ti: float = math.nan
    Td: float = math.nan


COLUMNS = tuple(Row.__dataclass_fields__)


@dataclass(frozen=True)
class Drift:
    """A machine that is not what it was.

    Attributes
    ----------
    file : str
    quantity : str
        `gain`, `residence_time` or `noise`.
    before, now : float
    sigmas : float
        The change over its standard error; infinite for `noise`, which is judged by its ratio.
    """

    file: str
    quantity: str
    before: float
    now: float
    sigmas: float

    def __str__(self) -> str:
        certain = "" if math.isinf(self.sigmas) else f" ({self.sigmas:.1f} standard errors)"
        return f"{self.file}: {self.quantity} {self.before:.4g} -> {self.now:.4g}{certain}"


@dataclass(frozen=True)
class Fleet:
    """All rows, by file.

    Attributes
    ----------
    rows : tuple of Row
    drifts : tuple of Drift
        Compared with an earlier run, if one was given.
    """

    rows: tuple[Row, ...]
    drifts: tuple[Drift, ...] = ()

    @property
    def failed(self) -> tuple[Row, ...]:
        """The rows without a model."""
        return tuple(row for row in self.rows if row.status != "ok")

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the rows as `.csv`, `.json` or `.parquet`; the file is either complete or absent.

        Raises
        ------
        SettingError
            For another ending, or `.parquet` without pyarrow.
        ModelFileError
            If the file cannot be written.
        """
        place = Path(path)
        _require_ending(place)
        storage.replace(place, _content(self.rows, place.suffix.lower()))

    def __str__(self) -> str:
        done = [row for row in self.rows if row.status == "ok"]
        lines = [f"{len(self.rows)} recordings: {len(done)} identified, {len(self.failed)} failed"]
        if done:
            fits = sorted(row.fit_percent for row in done)
            middle, worst = fits[len(fits) // 2], min(done, key=lambda row: row.fit_percent)
            lines.append(
                f"fit on the held-back 30 %: median {middle:.1f} %, worst "
                f"{worst.fit_percent:.1f} % ({worst.file})"
            )
        lines += [f"failed  {row.file}: {row.message}" for row in self.failed[:10]]
        if len(self.failed) > 10:
            lines.append(f"  and {len(self.failed) - 10} more; they are in the table")
        lines += [f"drift   {drift}" for drift in self.drifts]
        return "\n".join(lines)


@shown_in_notebooks("fleet", "share failed")
def fleet(
    recordings: str | os.PathLike[str] | Sequence[str | os.PathLike[str]],
    *,
    inputs: str | Sequence[str] = "u",
    output: str = "y",
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
    inputs, output, Ts
        As of `sewfast.read`.
    model : str
        As of `identify`. Linear output error by default: its gain and residence time can be
        compared from run to run, and it takes a fraction of a second.
    controller : Controller, optional
        Tuned anew for every model, from these settings.
    before : path or Fleet, optional
        An earlier result (`.csv`, `.json`, `.parquet`): `drifts` lists what has moved beyond its
        bands.
    out : path, optional
        Where to write the table (`.csv`, `.json`, `.parquet`). A journal is kept next to it until
        everything is done; the same call continues from it and processes only what is new or
        changed.
    client : dask.distributed.Client, optional
        Your own cluster.
    scheduler : str, optional
        Address of one, such as `tcp://host:8786`.
    workers : int, optional
        Processes on this computer if there is neither; by default as many as cores. 0 works in this
        process, without Dask.
    memory : str
        Limit for each worker on this computer; a worker that uses more is restarted.
    seed : int
        As of `identify`; the same seed gives the same bits on any number of workers.
    progress : callable, optional
        Called with recordings done, recordings in all and the share that failed.
        In a notebook a bar is shown where this is left out; None shows none.

    Returns
    -------
    Fleet

    Raises
    ------
    SettingError
        For no recordings, an unknown file extension, or if Dask is needed and not installed.
    """
    _require_settings(workers, controller, seed)
    jobs = _jobs(recordings, inputs, output, Ts)
    settings: dict[str, Any] = {"model": model, "seed": seed, "controller": None}
    if controller is not None:
        settings["controller"] = controller.to_dict()
    earlier = _earlier(before)
    place = None if out is None else Path(out)
    if place is not None:
        _require_ending(place)
        if place.is_dir():
            raise SettingError(f"{place}: expected a file to write to, got a folder; name a file")
    journal = _Journal(None if place is None else place, settings)
    rows = {job.file: row for job in jobs if (row := journal.known(job)) is not None}
    waiting = [job for job in jobs if job.file not in rows]
    with journal:
        for job, row in _worked(waiting, settings, controller, client, scheduler, workers, memory):
            rows[job.file] = row
            journal.add(job, row)
            if progress is not None:
                failed = sum(r.status != "ok" for r in rows.values()) / len(rows)
                progress(len(rows), len(jobs), failed)
    ordered = tuple(rows[file] for file in sorted(rows))
    found = Fleet(ordered, tuple(_drifts(earlier, ordered)))
    if place is not None:
        found.save(place)
        journal.remove()
    return found


def _require_settings(workers: Any, controller: Any, seed: Any) -> None:
    if workers is not None and not (_is_whole(workers) and workers >= 0):
        raise SettingError(
            f"workers: expected a whole number of 0 or more, got {workers!r}; 0 works in this "
            "process, None takes every core"
        )
    if controller is not None and not isinstance(controller, Controller):
        raise SettingError(
            f"controller: expected a Controller, got {type(controller).__name__}; load one with "
            "load_controller"
        )
    if not (_is_whole(seed) and 0 <= seed < 2**64):
        raise SettingError(
            f"seed: expected a whole number from 0 to 2^64 - 1, got {seed!r}; take 0"
        )


def _is_whole(value: Any) -> bool:
    return isinstance(value, (int, np.integer)) and not isinstance(value, bool)


# --- What there is to do --------------------------------------------------------------------------


@dataclass(frozen=True)
class _Job:
    """One recording and how it is read."""

    file: str
    path: str
    inputs: tuple[str, ...]
    output: str
    Ts: float | None = None

    def fingerprint(self) -> list[Any]:
        """What changes where the file does."""
        try:
            stat = os.stat(self.path)
        except OSError:
            return [None, None, *self.inputs, self.output, self.Ts]
        return [stat.st_size, stat.st_mtime_ns, *self.inputs, self.output, self.Ts]


def _jobs(
    recordings: Any, inputs: str | Sequence[str], output: str, Ts: float | None
) -> list[_Job]:
    names = (inputs,) if isinstance(inputs, str) else tuple(inputs)
    if isinstance(recordings, str | os.PathLike):
        root = Path(recordings)
        if root.is_dir():
            files = sorted(p for p in root.rglob("*") if p.suffix.lower() in READABLE)
            jobs = [
                _Job(p.relative_to(root).as_posix(), str(p), names, output, Ts)
                for p in files
                if p.is_file()
            ]
        else:
            jobs = list(_manifest(root, names, output, Ts))
    elif isinstance(recordings, Sequence):
        jobs = [_Job(str(p), os.fspath(p), names, output, Ts) for p in recordings]
    else:
        raise SettingError(
            f"recordings: expected a folder, a manifest or a list of files, got {recordings!r}; "
            "name the folder"
        )
    if not jobs:
        raise SettingError(
            f"expected recordings ({', '.join(READABLE)}), got none in {recordings}; name a folder "
            "that holds some, or a manifest"
        )
    seen: set[str] = set()
    for job in jobs:
        if job.file in seen:
            raise SettingError(
                f"expected every recording once, got {job.file} twice; take one of them out"
            )
        seen.add(job.file)
    return jobs


def _manifest(path: Path, inputs: tuple[str, ...], output: str, Ts: float | None) -> Iterator[_Job]:
    try:
        text = path.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise SettingError(
            f"{path}: expected a folder, or a manifest in CSV, got none that can be read ({error})"
        ) from error
    rows = csv.DictReader(io.StringIO(text))
    known = ("file", "inputs", "output", "Ts")
    if "file" not in (rows.fieldnames or ()) or not set(rows.fieldnames or ()) <= set(known):
        raise SettingError(
            f"{path}: expected a manifest with a column file and any of inputs, output, Ts, got "
            f"{', '.join(rows.fieldnames or ()) or 'nothing'}"
        )
    for number, row in enumerate(rows, start=2):
        try:
            own = float(row["Ts"]) if row.get("Ts") else Ts
        except ValueError:
            raise SettingError(
                f"{path}, line {number}: expected Ts as a number of seconds, got {row['Ts']!r}"
            ) from None
        file = row["file"] or ""
        names = tuple(row["inputs"].split(";")) if row.get("inputs") else inputs
        yield _Job(file, str(path.parent / file), names, row.get("output") or output, own)


# --- One recording --------------------------------------------------------------------------------


def _row(job: _Job, settings: Mapping[str, Any], controller: Controller | None) -> Row:
    """All that is done with one recording; what it cannot do is its message."""
    try:
        return _identified(job, settings, controller)
    except SewfastError as error:
        return Row(job.file, "failed", str(error))
    except (OSError, MemoryError, ArithmeticError, np.linalg.LinAlgError) as error:
        return Row(job.file, "failed", f"{type(error).__name__}: {error}")


def _identified(job: _Job, settings: Mapping[str, Any], controller: Controller | None) -> Row:
    data = read(job.path, inputs=job.inputs, output=job.output, Ts=job.Ts)
    samples = sum(len(e.y) for e in data.experiments)
    cut = int(TRAINED * samples)
    model = identify(
        data.slice(f"0:{cut}"), model=settings["model"], seed=settings["seed"], threads=1
    )
    held = data.slice(f"{cut}:{samples}")
    scores = validate(model, held).simulation
    runs = zip(held.experiments, model.simulate(held), strict=True)
    noise = float(np.nanstd(np.concatenate([e.y - run for e, run in runs])))
    quantities: dict[str, Any] = {}
    if not model.members and model.kind in ("arx", "oe", "iv"):
        quantities = _physical(model, data.slice(f"0:{cut}"))
    gains: dict[str, Any] = {}
    if controller is not None:
        from .tuning import tune

        tuned = tune(model, start=controller, seed=settings["seed"], threads=1).pid
        standard = tuned.gains.to("standard")
        gains = {"Kp": standard.Kp, "Ti": standard.Ti, "Td": standard.Td}
    return Row(
        job.file,
        samples=samples,
        Ts=data.Ts,
        kind=model.kind,
        fit_percent=float(scores.fit_percent),
        rmse=float(scores.rmse),
        noise=noise,
        verdict=str(model.training.get("verdict", "")),
        parameters=hashlib.sha256(model.theta.tobytes()).hexdigest()[:16],
        **quantities,
        **gains,
    )


def _physical(model: Model, data: Dataset) -> dict[str, float]:
    """Gain and average residence time of a linear model, with their standard errors.

    Ts (B'(1)/B(1) - A'(1)/A(1)) for G = B/A in the delay operator; it does not move where a pole
    and a zero nearly cancel. The errors follow from the parameters' covariance by their slopes.
    """
    found = estimate(model, Residuals.of(model, data))
    theta, na, nk = model.theta, model.orders["na"], model.orders["nk"]
    inputs = len(model.input_names)

    def quantities(values: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
        a, b = values[:na], values[na : len(values) - 1].reshape(inputs, -1)
        b, total, final = b[0], 1.0 + float(a.sum()), float(b[0].sum())
        if total == 0.0 or final == 0.0:
            return np.full(2, math.nan)
        later = nk + np.arange(len(b))
        residence = later @ b / final - np.arange(1, na + 1) @ a / total
        return np.array([final / total, model.Ts * residence])

    value = quantities(theta)
    errors = np.full(2, math.nan)
    if found is not None:
        steps = 1e-6 * np.maximum(np.abs(theta), 1e-3)
        slopes = np.array(
            [
                (quantities(theta + step * axis) - quantities(theta - step * axis)) / (2.0 * step)
                for step, axis in zip(steps, np.eye(len(theta)), strict=True)
            ]
        )
        with np.errstate(invalid="ignore"):
            errors = np.sqrt(np.diag(slopes.T @ found.covariance @ slopes))
    return {
        "gain": float(value[0]),
        "gain_error": float(errors[0]),
        "residence_time": float(value[1]),
        "residence_time_error": float(errors[1]),
    }


# --- Where it is done -----------------------------------------------------------------------------


def _worked(
    jobs: Sequence[_Job],
    settings: Mapping[str, Any],
    controller: Controller | None,
    client: Any,
    scheduler: str | None,
    workers: int | None,
    memory: str,
) -> Iterator[tuple[_Job, Row]]:
    """Rows as they are finished, in any order."""
    if workers == 0 and client is None and scheduler is None:
        for job in jobs:
            yield job, _row(job, settings, controller)
        return
    if not jobs:
        return
    with _connected(client, scheduler, workers, memory) as connected:
        as_completed = import_module("distributed").as_completed
        killed = import_module("distributed.scheduler").KilledWorker

        waiting = iter(jobs)
        asked: dict[str, _Job] = {}

        def submit(job: _Job) -> Any:
            future = connected.submit(_row, job, settings, controller, pure=False, retries=_RETRIES)
            asked[future.key] = job
            return future

        count = max(1, len(connected.scheduler_info(n_workers=-1)["workers"]))
        first = [submit(job) for job in itertools.islice(waiting, _IN_FLIGHT * count)]
        running = as_completed(first)
        for future in running:
            job = asked.pop(future.key)
            try:
                row = future.result()
            except killed:
                row = Row(
                    job.file, "failed", f"expected {memory} to suffice, but the worker died over "
                    "it again and again; give more memory, or a shorter recording",
                )  # fmt: skip
            except Exception as error:
                row = Row(job.file, "failed", f"{type(error).__name__}: {error}")
            future.release()
            following = next(waiting, None)
            if following is not None:
                running.add(submit(following))
            yield job, row


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
            "'sewfast[fleet]', or give workers=0"
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
    # a worker that was killed is no fault of the recording it was at
    with dask.config.set({"distributed.scheduler.allowed-failures": _RETRIES}):
        options = {
            "n_workers": workers or os.cpu_count() or 1,
            "threads_per_worker": 1,
            "memory_limit": memory,
            "dashboard_address": None,
        }
        with _workers_without_ctrl_c():
            cluster = distributed.LocalCluster(**options)
        with cluster, distributed.Client(cluster) as made:
            yield made


@contextmanager
def _workers_without_ctrl_c() -> Iterator[None]:
    """Processes that begin here leave Ctrl-C to this one, which ends them."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


# --- What is kept on the way ----------------------------------------------------------------------


@dataclass
class _Journal:
    """A line for each row that is done, beside the table that is to be written.

    The first line says for which settings; a journal of others is begun anew. A last line that was
    cut off is left out.
    """

    out: Path | None
    settings: Mapping[str, Any]
    _rows: dict[str, tuple[list[Any], Row]] = field(default_factory=dict)
    _file: Any = None

    def __post_init__(self) -> None:
        place = self.place
        if place is None or not place.exists():
            return
        lines = place.read_text(encoding="utf-8", errors="replace").splitlines()
        entries = [entry for line in lines if (entry := _parsed(line)) is not None]
        if not entries or entries[0] != self._head():
            return
        for entry in entries[1:]:
            row = Row(**entry["row"])
            self._rows[row.file] = (entry["of"], row)

    @property
    def place(self) -> Path | None:
        return None if self.out is None else self.out.with_name(f".{self.out.name}.journal")

    def _head(self) -> dict[str, Any]:
        return {"format": _FORMAT, "version": 1, "settings": json.loads(json.dumps(self.settings))}

    def known(self, job: _Job) -> Row | None:
        """The row of a recording that has not changed since."""
        fingerprint, row = self._rows.get(job.file, (None, None))
        return row if fingerprint == job.fingerprint() else None

    def __enter__(self) -> _Journal:
        if self.place is not None:
            lines = [self._head(), *({"of": f, "row": _plain(r)} for f, r in self._rows.values())]
            storage.replace(self.place, "".join(json.dumps(line) + "\n" for line in lines))
            self._file = self.place.open("a", encoding="utf-8")
        return self

    def add(self, job: _Job, row: Row) -> None:
        if self._file is not None:
            line = {"of": job.fingerprint(), "row": _plain(row)}
            self._file.write(json.dumps(line) + "\n")
            self._file.flush()

    def __exit__(self, *_: object) -> None:
        if self._file is not None:
            self._file.close()

    def remove(self) -> None:
        if self.place is not None:
            self.place.unlink(missing_ok=True)


def _plain(row: Row) -> dict[str, Any]:
    return asdict(row)


def _parsed(line: str) -> dict[str, Any] | None:
    try:
        found = json.loads(line)
    except json.JSONDecodeError:
        return None
    return found if isinstance(found, dict) else None


# --- Tables ---------------------------------------------------------------------------------------


def _require_ending(place: Path) -> None:
    if place.suffix.lower() not in (".csv", ".json", ".parquet"):
        raise SettingError(
            f"{place}: expected a name that ends in .csv, .json or .parquet, got {place.name}"
        )


def _content(rows: Sequence[Row], ending: str) -> str | bytes:
    if ending == ".parquet":
        arrow, parquet = _arrow()
        columns = {name: [getattr(row, name) for row in rows] for name in COLUMNS}
        place = io.BytesIO()
        parquet.write_table(arrow.table(columns), place)
        return place.getvalue()
    if ending == ".json":
        known = [{k: _or_none(v) for k, v in _plain(row).items()} for row in rows]
        return json.dumps({"format": _FORMAT, "version": 1, "rows": known}, indent=1) + "\n"
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(COLUMNS)
    writer.writerows([_cell(getattr(row, name)) for name in COLUMNS] for row in rows)
    return text.getvalue()


def _or_none(value: Any) -> Any:
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _cell(value: Any) -> str:
    if isinstance(value, float):
        return "" if math.isnan(value) else repr(value)
    return str(value).replace("\n", " ")


def _arrow() -> tuple[Any, Any]:
    try:
        import pyarrow
        import pyarrow.parquet
    except ImportError as error:
        raise SettingError(
            "expected pyarrow for Parquet, got none; pip install 'sewfast[parquet]', or write .csv"
        ) from error
    return pyarrow, pyarrow.parquet


def load_fleet(path: str | os.PathLike[str]) -> Fleet:
    """Read a table that `Fleet.save` wrote.

    Raises
    ------
    SettingError
        Where there is none, or it lacks columns.
    """
    place = Path(path)
    _require_ending(place)
    try:
        if place.suffix.lower() == ".parquet":
            rows = _arrow()[1].read_table(place).to_pylist()
        elif place.suffix.lower() == ".json":
            rows = json.loads(place.read_text(encoding="utf-8"))["rows"]
        else:
            with place.open(encoding="utf-8-sig", newline="") as file:
                rows = list(csv.DictReader(file))
        return Fleet(tuple(_read(row) for row in rows))
    except SettingError:
        raise
    except Exception as error:
        raise SettingError(
            f"{place}: expected a table that `sewfast fleet` wrote, got {type(error).__name__}: "
            f"{error}"
        ) from error


def _read(row: Mapping[str, Any]) -> Row:
    values: dict[str, Any] = {}
    for name, of in Row.__dataclass_fields__.items():
        value = row[name]
        if of.type == "float":
            value = math.nan if value in (None, "") else float(value)
        elif of.type == "int":
            value = int(value)
        else:
            value = str(value or "")
        values[name] = value
    return Row(**values)


# --- Drift ----------------------------------------------------------------------------------------


def _earlier(before: Any) -> dict[str, Row]:
    if before is None:
        return {}
    found = before if isinstance(before, Fleet) else load_fleet(before)
    return {row.file: row for row in found.rows if row.status == "ok"}


def _drifts(earlier: Mapping[str, Row], rows: Sequence[Row]) -> Iterator[Drift]:
    for row in rows:
        old = earlier.get(row.file)
        if old is None or row.status != "ok":
            continue
        for quantity in ("gain", "residence_time"):
            was, now = getattr(old, quantity), getattr(row, quantity)
            error = math.hypot(getattr(old, f"{quantity}_error"), getattr(row, f"{quantity}_error"))
            change = abs(now - was)
            if change > SIGMAS * error and change > LEAST_CHANGE * abs(was):
                yield Drift(row.file, quantity, was, now, change / error if error else math.inf)
        ratio = row.noise / old.noise if old.noise > 0.0 else 1.0
        if ratio > NOISE_RATIO or ratio < 1.0 / NOISE_RATIO:
            yield Drift(row.file, "noise", old.noise, row.noise, math.inf)
