"""`benchmarks.load`: the package's windows become data sets, whatever is missing is named."""

import sys
from dataclasses import dataclass
from types import ModuleType
from typing import Any

import numpy as np
import pytest

from sewfast import benchmarks
from sewfast.errors import DataError, SettingError


@dataclass
class Record:
    """As the package has them."""

    u: Any
    y: Any
    sampling_time: float
    name: str
    state_initialization_window_length: int | None = None

    def __iter__(self) -> Any:
        return iter((self.u, self.y))


def record(n: int, name: str, window: int | None = None) -> Record:
    return Record(np.arange(float(n)), np.ones(n), 0.5, name, window)


@pytest.fixture
def package(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    module = ModuleType(benchmarks.PACKAGE)
    monkeypatch.setitem(sys.modules, benchmarks.PACKAGE, module)
    return module


def test_one_record_each(package: Any) -> None:
    package.Cascaded_Tanks = lambda dir_placement: (record(8, "a"), record(6, "b", 4))
    train, test, n, name, _ = benchmarks.load("cascaded_tanks")
    assert (len(train), len(test), n, name) == (8, 6, 4, "cascaded_tanks")
    assert train.Ts == 0.5
    assert [e.name for e in (*train.experiments, *test.experiments)] == ["a", "b"]


def test_several_records(package: Any) -> None:
    train, test = (record(8, "a"), record(9, "b")), (record(6, "c", 3), record(7, "d", 5))
    package.CED = lambda dir_placement: (train, test)
    found = benchmarks.load("coupled_drives")
    assert [len(e) for e in found.train.experiments] == [8, 9]
    assert [len(e) for e in found.test.experiments] == [6, 7]
    assert found.n == 5


def test_the_folder_is_handed_on(package: Any) -> None:
    seen = []
    pair = (record(8, "a"), record(6, "b"))
    package.EMPS = lambda dir_placement: (seen.append(dir_placement), pair)[1]
    benchmarks.load("emps", "there")
    assert seen == ["there"]


def test_what_cannot_be_read_is_named(package: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(SettingError, match="expected one of coupled_drives, cascaded_tanks"):
        benchmarks.load("tank")

    def fail(dir_placement: str | None) -> None:
        raise OSError("no route")

    package.F16 = fail
    with pytest.raises(DataError, match=r"f16.*no route.*connection"):
        benchmarks.load("f16")
    monkeypatch.setitem(sys.modules, benchmarks.PACKAGE, None)
    with pytest.raises(SettingError, match=r'pip install "sewfast\[benchmarks\]"'):
        benchmarks.load("f16")
