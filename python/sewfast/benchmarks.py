"""Public benchmark records of nonlinearbenchmark.org as data sets."""

from __future__ import annotations

import importlib
import importlib.metadata
import os
from collections.abc import Callable, Iterable
from typing import Any, NamedTuple

import numpy as np

from .dataset import Dataset, Experiment
from .errors import DataError, SettingError, not_installed

PACKAGE = "nonlinear_benchmarks"

_NAMES = {
    "coupled_drives": "CED",
    "cascaded_tanks": "Cascaded_Tanks",
    "emps": "EMPS",
    "silverbox": "Silverbox",
    "wiener_hammerstein": "WienerHammerBenchMark",
    "parallel_wiener_hammerstein": "ParWH",
    "f16": "F16",
}


class Benchmark(NamedTuple):
    """Records with their official windows. `train` must also provide any data for selection; the
    experiments of `test` are the official test records, in the package's order. The first `n`
    samples of each test record determine the initial state and are not scored. `version` is that of
    the package that defines the windows.
    """

    train: Dataset
    test: Dataset
    n: int
    name: str
    version: str


def names() -> tuple[str, ...]:
    return tuple(_NAMES)


def load(name: str, folder: str | os.PathLike[str] | None = None) -> Benchmark:
    """Read a benchmark with the windows of the package `nonlinear_benchmarks`. The package
    downloads a record the first time, from its authors' page, and keeps it in `folder`, by default
    its own cache. Source: M. Schoukens and others, https://www.nonlinearbenchmark.org; windows as
    in Champneys et al. 2024, arXiv 2405.10779.
    """
    if name not in _NAMES:
        raise SettingError(f"benchmark: expected one of {', '.join(_NAMES)}, received {name!r}")
    read = _reader(_NAMES[name])
    place = None if folder is None else os.fspath(folder)
    try:
        train, test = read(dir_placement=place)
    except Exception as error:
        raise DataError(
            name=f"benchmark {name}", expected="a record that can be read", received=str(error),
            remedy="it is fetched from its authors' page: check the connection, or put the files "
            "into folder=",
        ) from error  # fmt: skip
    train, test = _each(train), _each(test)
    return Benchmark(_dataset(train), _dataset(test), _window(test), name, _version())


def _reader(function: str) -> Callable[..., Any]:
    try:
        module = importlib.import_module(PACKAGE)
    except ImportError as error:
        raise not_installed(PACKAGE, "benchmarks", "sewfast[benchmarks]") from error
    found: Callable[..., Any] = getattr(module, function)
    return found


def _version() -> str:
    try:
        return importlib.metadata.version(PACKAGE)
    except importlib.metadata.PackageNotFoundError:
        return "unknown"


def _each(found: Any) -> list[Any]:
    """A list of the package's records: it returns one, or a tuple."""
    one = not isinstance(found, Iterable) or hasattr(found, "sampling_time")
    return [found] if one else list(found)


def _dataset(records: list[Any]) -> Dataset:
    widths = {np.ndim(r.y) for r in records}
    if widths != {1}:
        raise DataError(
            f"expected records with one output, received {sorted(widths)} dimensions of y; read "
            "them with the package itself and pick one column"
        )
    experiments = tuple(
        Experiment(np.asarray(r.u), np.asarray(r.y), name=str(r.name)) for r in records
    )
    inputs = experiments[0].u.shape[1]
    named = ("u",) if inputs == 1 else tuple(f"u{i + 1}" for i in range(inputs))
    Ts = float(records[0].sampling_time)
    return Dataset(experiments, Ts, input_names=named, input_units=("",) * inputs)


def _window(records: list[Any]) -> int:
    found = [r.state_initialization_window_length for r in records]
    return max((int(n) for n in found if n is not None), default=50)
