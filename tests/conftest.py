"""What every test may ask for, and which tests run: in `make test`, alone, or at night."""

from __future__ import annotations

import collections
import contextlib
import json
import os
import re
import signal
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import hypothesis
import pytest

import chromium

ROOT = Path(__file__).resolve().parents[1]
_BESIDE = ROOT.parent / "shared" / "data"

if "SEWFAST_DATA" not in os.environ and _BESIDE.is_dir():
    os.environ["SEWFAST_DATA"] = str(_BESIDE)

# A product of small matrices on every processor waits in a loop for those that other tests
# use: ten to sixty times as long. NumPy reads this at its import; workers and commands inherit it.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

# Where Python may not keep what it compiled, every worker and every command that a test starts
# compiles the package, the tests and their libraries anew: seconds each. Here it leaves no trace.
if sys.dont_write_bytecode:
    sys.dont_write_bytecode, sys.pycache_prefix = False, str(ROOT / "target" / "bytecode")
    os.environ["PYTHONPYCACHEPREFIX"] = sys.pycache_prefix
    os.environ.pop("PYTHONDONTWRITEBYTECODE", None)

# a shell starts background jobs with SIGINT ignored, nohup with SIGHUP, and so would the tests of
# Ctrl-C and of a closed terminal
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)
if hasattr(signal, "SIGHUP") and signal.getsignal(signal.SIGHUP) is signal.SIG_IGN:
    signal.signal(signal.SIGHUP, signal.SIG_DFL)


# how long an example takes says something about the computer, nothing about the program
hypothesis.settings.register_profile("untimed", deadline=None)
hypothesis.settings.load_profile("untimed")


ALONE = re.compile(
    r"test_(link|live|device|virtual_device|doctor|drive_runs|host_loop|keeping|locks|soak|two_hosts"
    r"|watchdog|deaf_host|recordfile_kill|studio_drive|firmware|emulated)"
)
"""Files whose tests wait for processes and ports: marked `alone`."""


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    """Leave a file unread where `-m` can choose nothing in it: every worker reads them all."""
    if not collection_path.name.startswith("test_") or collection_path.suffix != ".py":
        return None
    waits = ALONE.match(collection_path.name) is not None
    chosen = config.option.markexpr
    if chosen == PARTS[0]:
        return waits or None
    if chosen in PARTS:
        marked = f"mark.{chosen}" in collection_path.read_text(encoding="utf-8")
        return None if marked or (waits and chosen == "alone") else True
    return None


SLOW = 10.0
"""Seconds from which a test of `make test` needs `@pytest.mark.slow("reason")`."""
LEFT = pytest.StashKey[list[str]]()
LISTED = (ROOT / "tests" / "night.txt").read_text(encoding="utf-8").splitlines()
ALL_DAY = "SEWFAST_ALL_DAY" in os.environ
NIGHT = frozenset(line for line in LISTED if not line.startswith("#") and not ALL_DAY)
"""What is left to the night because its lines are reached by day as well (`make parting`)."""


def pytest_addoption(parser: pytest.Parser) -> None:
    text = "run the tests marked `nightly`, and only those"
    parser.addoption("--nightly", action="store_true", help=text)


def pytest_configure(config: pytest.Config) -> None:
    config.stash[LEFT] = []


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    for item in items:
        if ALONE.match(item.path.name):
            item.add_marker("alone")
        for mark in item.iter_markers():
            if mark.name in ("nightly", "slow") and not mark.args:
                raise pytest.UsageError(f"{item.nodeid}: expected the reason of its {mark.name}")
    _expect_cases(config, items)
    at_night = [_is_for_the_night(item) for item in items]
    wanted = config.getoption("--nightly")
    left = [item for item, night in zip(items, at_night, strict=True) if night != wanted]
    items[:] = [item for item, night in zip(items, at_night, strict=True) if night == wanted]
    config.hook.pytest_deselected(items=left)
    if not wanted:
        config.stash[LEFT] = [item.nodeid for item in left]


def _case(item: pytest.Item) -> str:
    return item.name.partition("[")[2].removesuffix("]")


def _is_for_the_night(item: pytest.Item) -> bool:
    """Marked, but for the cases of a family that `by_day` names, or listed and not `slow`."""
    mark = item.get_closest_marker("nightly")
    if mark is not None:
        return _case(item) not in mark.kwargs.get("by_day", ())
    return item.nodeid in NIGHT and item.get_closest_marker("slow") is None


def _expect_cases(config: pytest.Config, items: list[pytest.Item]) -> None:
    """A case that was renamed would leave `make test` without a word."""
    if any("::" in argument for argument in config.args) or config.getoption("lf", False):
        return  # pytest has not read all cases
    missing: dict[str, set[str]] = {}
    for item in items:
        mark = item.get_closest_marker("nightly")
        for case in mark.kwargs.get("by_day", ()) if mark is not None else ():
            missing.setdefault(item.nodeid.partition("[")[0], set()).add(case)
    for item in items:
        missing.get(item.nodeid.partition("[")[0], set()).discard(_case(item))
    lost = [f"{name}[{case}]" for name, cases in missing.items() for case in sorted(cases)]
    if lost:
        raise pytest.UsageError(f"by_day names cases that are not there: {', '.join(lost)}")
    read = {item.nodeid.partition("::")[0] for item in items}
    listed = {name for name in NIGHT if name.partition("::")[0] in read}
    listed |= {name for name in NIGHT if not (ROOT / name.partition("::")[0]).exists()}
    if gone := sorted(listed - {item.nodeid for item in items}):
        raise pytest.UsageError(f"tests/night.txt names tests that are not there: {gone}")


def pytest_sessionfinish(session: pytest.Session) -> None:
    if hasattr(session.config, "workeroutput"):  # only this process knows what it left
        session.config.workeroutput["left"] = session.config.stash[LEFT]


@pytest.hookimpl(optionalhook=True)
def pytest_testnodedown(node: Any) -> None:
    """Every worker of pytest-xdist has collected all tests."""
    node.config.stash[LEFT] = getattr(node, "workeroutput", {}).get("left", [])


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item: pytest.Item) -> Iterator[None]:
    report = yield
    report.is_slow = item.get_closest_marker("slow") is not None
    report.may_go = not report.is_slow and item.get_closest_marker("nightly") is None
    return report


def pytest_terminal_summary(terminalreporter: Any, config: pytest.Config) -> None:
    """Name the tests that need a mark, and what is left to `make nightly`."""
    seconds: dict[str, float] = collections.defaultdict(float)
    can_go: dict[str, float] = collections.defaultdict(float)
    for reports in terminalreporter.stats.values():
        for report in reports:
            if not getattr(report, "is_slow", True):
                seconds[report.nodeid] += report.duration
            if getattr(report, "may_go", False):
                can_go[report.nodeid] += report.duration
    if ALL_DAY and config.option.markexpr in PARTS:  # what `make parting` reads
        kept = ROOT / "target" / "seconds" / f"{config.option.markexpr}.json"
        kept.parent.mkdir(parents=True, exist_ok=True)
        kept.write_text(json.dumps(can_go), encoding="utf-8")
    long = sorted((s, name) for name, s in seconds.items() if s > SLOW)
    if long and not config.getoption("--nightly"):
        terminalreporter.section(
            f"over {SLOW:g} s without a mark: slow (with its reason) or nightly"
        )
        for taken, name in reversed(long):
            terminalreporter.line(f"{taken:6.1f} s  {name}")
    left = collections.Counter(name.partition("[")[0] for name in _left(config))
    if left:
        terminalreporter.section(f"left to `make nightly`: {left.total()} tests, and {OTHERS}")
        for name, count in sorted(left.items()):
            terminalreporter.line(f"{name}{f' ({count} cases)' if count > 1 else ''}")


PARTS = ("not alone and not budget", "alone", "budget")
"""What `-m` of the three parts of `make test` chooses; the last one names what all have left."""
OTHERS = "counts, bits of the release, a wheel from source, laws, bits, damaged logs"


def _left(config: pytest.Config) -> list[str]:
    """Names of what is left to the night; nothing before the last part of `make test`."""
    own, chosen = config.stash[LEFT], config.option.markexpr
    if config.getoption("--nightly") or chosen not in PARTS:
        return own
    folder = ROOT / "target" / "left"
    folder.mkdir(parents=True, exist_ok=True)
    (folder / f"{chosen}.txt").write_text("\n".join(own), encoding="utf-8")
    if chosen != PARTS[-1]:
        return []
    kept = [folder / f"{part}.txt" for part in PARTS]
    return [n for p in kept if p.exists() for n in p.read_text(encoding="utf-8").split("\n") if n]


@pytest.fixture
def recordings() -> Path:
    """Folder of the public recordings; the test skips where there is none."""
    folder = os.environ.get("SEWFAST_DATA")
    if folder is None:
        pytest.skip("needs public recordings: set SEWFAST_DATA to their folder (docs/real-data.md)")
    return Path(folder)


@pytest.fixture
def browser() -> Iterator[Any]:
    if not chromium.is_here():
        pytest.skip("no chromium and chromedriver here: the page is not looked at in a browser")
    pytest.importorskip("selenium.webdriver")
    found = chromium.open_browser(1200, 900)
    yield found
    with contextlib.suppress(Exception):  # a test may have killed it
        found.quit()
