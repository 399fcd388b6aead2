"""What every test may ask for: the folder of public recordings."""

from __future__ import annotations

import contextlib
import os
import re
import shutil
import signal
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import hypothesis
import pytest

ROOT = Path(__file__).resolve().parents[1]
_BESIDE = ROOT.parent / "shared" / "data"

if "SEWFAST_DATA" not in os.environ and _BESIDE.is_dir():
    os.environ["SEWFAST_DATA"] = str(_BESIDE)

# A product of small matrices on every processor waits in a loop for those that other tests
# use: ten to sixty times as long. NumPy reads this at its import; workers and commands inherit it.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

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
    if config.option.markexpr == "not alone":
        return waits or None
    if config.option.markexpr == "alone":
        some = waits or "mark.alone" in collection_path.read_text(encoding="utf-8")
        return None if some else True
    return None


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    for item in items:
        if ALONE.match(item.path.name):
            item.add_marker("alone")


@pytest.fixture
def recordings() -> Path:
    """Folder of the public recordings; the test skips where there is none."""
    folder = os.environ.get("SEWFAST_DATA")
    if folder is None:
        pytest.skip("needs public recordings: set SEWFAST_DATA to their folder (docs/real-data.md)")
    return Path(folder)


@pytest.fixture
def browser() -> Iterator[Any]:
    chromium, driver = shutil.which("chromium"), shutil.which("chromedriver")
    if chromium is None or driver is None:
        pytest.skip("no chromium and chromedriver here: the page is not looked at in a browser")
    webdriver = pytest.importorskip("selenium.webdriver")
    options = webdriver.ChromeOptions()
    options.binary_location = chromium
    for argument in ("--headless=new", "--no-sandbox", "--disable-gpu", "--window-size=1200,900"):
        options.add_argument(argument)
    options.set_capability("goog:loggingPrefs", {"browser": "ALL"})
    service = webdriver.ChromeService(executable_path=driver)
    found = webdriver.Chrome(options=options, service=service)
    yield found
    with contextlib.suppress(Exception):  # a test may have killed it
        found.quit()
