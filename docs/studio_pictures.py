"""Draws assets/studio/tune.png, bode.png and look.png for README and studio.md, in Chromium.

    python docs/studio_pictures.py [FOLDER]

Without chromium, chromedriver or selenium nothing is drawn, and the pictures that are checked in
remain.
"""

from __future__ import annotations

import base64
import shutil
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from PIL import Image

PATIENCE = 180.0
"""Seconds for a part of the page."""
WIDE, HIGH = 1500, 990
"""Pixels of the window."""
SEARCHED = 400
"""Controllers."""
COLOURS = 64
"""That a picture is stored with: lines on white need no more."""


def can_draw() -> bool:
    """Whether there is a browser with its driver."""
    try:
        import selenium  # noqa: F401
        import websockets  # noqa: F401
    except ImportError:
        return False
    return all(shutil.which(name) for name in ("chromium", "chromedriver"))


def draw_studio(place: Path) -> list[Path]:
    """Draw the pictures into a folder; the files."""
    from selenium import webdriver

    from sewfast_studio import Project, Studio, make_demo

    options = webdriver.ChromeOptions()
    options.binary_location = str(shutil.which("chromium"))
    for argument in ("--headless=new", "--no-sandbox", "--disable-gpu"):
        options.add_argument(argument)
    with tempfile.TemporaryDirectory() as parent:
        folder = Path(parent) / "drive"
        folder.mkdir()
        make_demo(folder)
        with Studio(Project(folder, demo=True)) as studio:
            service = webdriver.ChromeService(executable_path=shutil.which("chromedriver"))
            page = webdriver.Chrome(options=options, service=service)
            try:
                page.get(studio.address)
                return [
                    _tune(page, place / "tune.png"), _bode(page, place / "bode.png"),
                    _look(page, place / "look.png"),
                ]  # fmt: skip
            finally:
                page.quit()


def _tune(page: Any, file: Path) -> Path:
    _until(lambda: _text(page, "cost").startswith("cost"))
    page.find_element("id", "evaluations").clear()
    page.find_element("id", "evaluations").send_keys(str(SEARCHED))
    page.find_element("id", "search").click()
    _until(lambda: _text(page, "tune-progress").startswith("found"))
    _until(lambda: "(-" in _text(page, "cost"))
    return _taken(page, file, WIDE, HIGH)


def _bode(page: Any, file: Path) -> Path:
    page.find_element("id", "view-bode").click()
    _until(lambda: page.find_element("id", "bode-start").is_enabled())
    page.find_element("id", "bode-start").click()
    _until(lambda: "measured: " in _text(page, "loop-text"))
    return _taken(page, file, 1200, 2130)


def _look(page: Any, file: Path) -> Path:
    page.find_element("id", "view-data").click()
    page.find_element("id", "look").click()
    _until(lambda: len(page.find_elements("css selector", "#signals canvas")) == 2)
    page.find_element("css selector", "#model option:nth-child(2)").click()
    page.find_element("id", "identify").click()
    _until(lambda: page.find_element("id", "modeltext").is_displayed())
    return _taken(page, file, 1200, 1900)


def _taken(page: Any, file: Path, width: int, height: int) -> Path:
    size = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": False}
    page.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)
    page.execute_cdp_cmd("Emulation.setScrollbarsHidden", {"hidden": True})
    page.execute_script("scrollTo(0, 0); document.activeElement.blur()")
    time.sleep(1.0)  # the curves follow the window's size
    found = page.execute_cdp_cmd("Page.captureScreenshot", {})
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_bytes(base64.b64decode(found["data"]))
    shrink(file)
    return file


def shrink(file: Path) -> None:
    """Store a PNG with a palette: a page has to load it."""
    Image.open(file).convert("RGB").quantize(COLOURS).save(file, optimize=True)


def _text(page: Any, name: str) -> str:
    return str(page.find_element("id", name).text)


def _until(true: Callable[[], object]) -> None:
    end = time.monotonic() + PATIENCE
    while not true():
        if time.monotonic() > end:
            raise SystemExit("the page did not get there")
        time.sleep(0.1)


if __name__ == "__main__":
    if not can_draw():
        raise SystemExit("expected chromium, chromedriver, selenium and websockets; install them")
    assets = Path(__file__).parent / "assets" / "studio"
    for drawn in draw_studio(Path(sys.argv[1]) if len(sys.argv) > 1 else assets):
        print(drawn)
