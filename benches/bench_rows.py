"""Every row of `make bench` that runs on one core, contender by contender, for pytest-benchmark.

Here all share one process and one thread; `performance.py` gives each a process of its own, lets
them take turns and compares what they reach.
"""

from __future__ import annotations

from importlib import import_module
from typing import Any

import pytest

from rows import Row, all_rows
from turns import Contender

PAIRS = [
    pytest.param(row, contender, id=f"{row.key}-{contender.name}")
    for row in all_rows()
    for contender in row.contenders
    if row.quick and row.clock == "cpu" and not contender.environment
]


@pytest.mark.parametrize(("row", "contender"), PAIRS)
def test_row(benchmark: Any, row: Row, contender: Contender) -> None:
    benchmark.group = row.title
    try:
        module = import_module(contender.module)
    except ImportError as missing:
        pytest.skip(f"needs {missing.name}")
    work = getattr(module, contender.work)(**contender.arguments)
    reached = benchmark.pedantic(work, rounds=3, warmup_rounds=1)
    assert set(row.agree) <= set(reached)
