"""How many threads work is spread over, and work on threads, processes or a cluster."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Sequence
from typing import Any, Protocol, TypeAlias, TypeVar, cast

from .errors import SettingError

# --- How many threads work is spread over unless a caller says so ---------------------------------


VARIABLE = "SEWFAST_THREADS"
"""Environment variable with the most threads that are taken unasked."""


def available() -> int:
    """The processors that this process may use, at most as many as `SEWFAST_THREADS` allows.

    Raises
    ------
    SettingError
        Where the variable holds something else than a whole number of 1 or more.
    """
    may = getattr(os, "sched_getaffinity", None)
    here = len(may(0)) if may is not None else os.cpu_count() or 1
    most = os.environ.get(VARIABLE, "").strip()
    return min(here, _most(most)) if most else here


def _most(text: str) -> int:
    if not (text.isdecimal() and int(text) >= 1):
        raise SettingError(
            f"{VARIABLE}: expected a whole number of 1 or more, received {text!r}; unset it to use "
            "every processor"
        )
    return int(text)


# --- Work spread over whatever maps a function over a list: threads, processes, a cluster ---------


J = TypeVar("J")
R = TypeVar("R")


class Mapper(Protocol):
    """An executor of `concurrent.futures`, a `multiprocessing` pool, a Dask client, or the like."""

    def map(self, function: Callable[..., Any], jobs: Iterable[Any], /) -> Iterable[Any]: ...


Workers: TypeAlias = Mapper | Callable[..., Iterable[Any]]
"""Something with a method `map`, or a function used as `map(function, jobs)`."""


def require_workers(workers: object) -> None:
    """Something that maps, or a `SettingError`."""
    if workers is None or callable(getattr(workers, "map", None)) or callable(workers):
        return
    raise SettingError(
        "workers: expected an executor, or anything with map(function, jobs), received "
        f"{type(workers).__name__}; pass concurrent.futures.ProcessPoolExecutor() for instance, "
        "threads= for a number of threads"
    )


def spread(workers: Workers, function: Callable[[J], R], jobs: Sequence[J]) -> list[R]:
    """`function` of every job, in the order of the jobs.

    Jobs and results are pickled where the workers are other processes. Futures, as a Dask client's
    `map` returns them, are waited for.
    """
    mapped = cast(Callable[..., Iterable[Any]], getattr(workers, "map", workers))
    return [_result(r) for r in mapped(function, jobs)]


def _result(value: Any) -> Any:
    result = getattr(value, "result", None)
    return result() if callable(result) else value
