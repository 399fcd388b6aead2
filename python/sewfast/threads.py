"""The number of threads to use, and work spread over threads, processes or a cluster."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Sequence
from typing import Any, Protocol, TypeAlias, TypeVar, cast

from .errors import SettingError

VARIABLE = "SEWFAST_THREADS"
"""Environment variable that limits the default number of threads."""


def available() -> int:
    """The processors available to this process, at most as many as `SEWFAST_THREADS` allows."""
    affinity = getattr(os, "sched_getaffinity", None)
    processors = len(affinity(0)) if affinity is not None else os.cpu_count() or 1
    limit = os.environ.get(VARIABLE, "").strip()
    if not limit:
        return processors
    if not (limit.isdecimal() and int(limit) >= 1):
        raise SettingError(
            f"{VARIABLE}: expected a whole number of 1 or more, received {limit!r}; unset it to "
            "use every processor"
        )
    return min(processors, int(limit))


# --- Work spread by a `map`: over threads, processes, a cluster -----------------------------------


J = TypeVar("J")
R = TypeVar("R")


class Mapper(Protocol):
    """An executor of `concurrent.futures`, a `multiprocessing` pool, a Dask client, or the like."""

    def map(self, function: Callable[..., Any], jobs: Iterable[Any], /) -> Iterable[Any]: ...


Workers: TypeAlias = Mapper | Callable[..., Iterable[Any]]
"""Something with a method `map`, or a function used as `map(function, jobs)`."""


def require_workers(workers: object) -> None:
    """Raise `SettingError` unless `workers` is None or can map."""
    if workers is None or callable(getattr(workers, "map", None)) or callable(workers):
        return
    raise SettingError(
        "workers: expected an executor, or anything with map(function, jobs), received "
        f"{type(workers).__name__}; pass concurrent.futures.ProcessPoolExecutor() for instance, "
        "threads= for a number of threads"
    )


def spread(workers: Workers, function: Callable[[J], R], jobs: Sequence[J]) -> list[R]:
    """`function` of every job, in the order of the jobs. Other processes receive and return pickled
    objects. Futures, which the `map` of a Dask client returns, are waited for.
    """
    mapped = cast(Callable[..., Iterable[Any]], getattr(workers, "map", workers))
    return [_result(r) for r in mapped(function, jobs)]


def _result(value: Any) -> Any:
    result = getattr(value, "result", None)
    return result() if callable(result) else value
