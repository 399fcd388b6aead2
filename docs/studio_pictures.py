"""Draws assets/studio/*.png, the steps of the studio, for README and studio.md, in Chromium.

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
WIDE, HIGH = 1280, 800
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
                drawn = {
                    "tune": _tune, "look": _look, "bode": _bode, "model": _model,
                    "commission": _commission, "drive": _drive,
                }  # fmt: skip
                return [draw(page, place / f"{name}.png") for name, draw in drawn.items()]
            finally:
                page.quit()


def _tune(page: Any, file: Path) -> Path:
    _until(lambda: _text(page, "cost").startswith("cost"))
    _write(page, "evaluations", SEARCHED)
    _press(page, "search")
    _until(lambda: "Found" in _text(page, "tune-progress"))
    _until(lambda: "below" in _text(page, "cost"))
    _until(lambda: "being judged" not in _text(page, "lights"))
    return _taken(page, file)


def _look(page: Any, file: Path) -> Path:
    _press(page, "view-data")
    _press(page, "look")
    _until(lambda: page.find_element("id", "to-model").is_displayed())
    return _taken(page, file)


def _bode(page: Any, file: Path) -> Path:
    page.execute_script("document.getElementById('bode-fold').open = true")
    _press(page, "bode-start")
    _until(lambda: page.find_element("id", "bode-text").is_displayed())
    _press(page, "view-tune")
    page.execute_script("document.getElementById('loop-fold').open = true")
    _until(lambda: "measured: " in _text(page, "loop-text"))
    return _taken(page, file, "loop-fold", 1100)


def _model(page: Any, file: Path) -> Path:
    _press(page, "view-model")
    _press(page, "identify")
    _until(lambda: page.find_element("id", "to-tune").is_displayed())
    _press(page, "validate")
    _until(lambda: page.find_element("id", "validated").is_displayed())
    return _taken(page, file, high=1200)


def _commission(page: Any, file: Path) -> Path:
    _press(page, "view-commission")
    _write(page, "networks", 2)
    _write(page, "commission-tries", SEARCHED)
    _press(page, "commission-start")
    _until(lambda: page.find_element("id", "commission-fold").is_displayed())
    return _taken(page, file)


def _drive(page: Any, file: Path) -> Path:
    _press(page, "view-drive")
    _press(page, "connect")
    _press(page, "limits")
    _until(lambda: "in time" in _text(page, "prompt"))
    _press(page, "arm")
    page.find_element("css selector", "#signal option[value=random]").click()
    _press(page, "record")
    _until(lambda: "RPM" in _text(page, "speed"))
    time.sleep(4.0)
    drawn = _taken(page, file)
    _press(page, "stop")
    return drawn


def _press(page: Any, name: str) -> None:
    button = page.find_element("id", name)
    _until(lambda: button.is_displayed() and button.is_enabled())
    button.click()


def _write(page: Any, name: str, value: int) -> None:
    script = "document.getElementById(arguments[0]).value = arguments[1]"
    page.execute_script(script, name, value)


def _taken(page: Any, file: Path, top: str = "", high: int = HIGH) -> Path:
    """The window, or what stands from an element on below the header."""
    size = {"width": WIDE, "height": high, "deviceScaleFactor": 1, "mobile": False}
    page.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)
    page.execute_cdp_cmd("Emulation.setScrollbarsHidden", {"hidden": True})
    page.execute_script("scrollTo(0, 0); document.activeElement.blur()")
    if top:
        page.execute_script("document.getElementById(arguments[0]).scrollIntoView()", top)
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
