"""Renders every step of the studio in its states, a report and the page of the design at four
widths, light and dark, and measures them.

    python tests/support/screens.py [FOLDER] [--only WORD]

Pictures go to the folder (target/screens), a table of what is wrong to standard output; exit code 1
if anything is. Measured by boxes and colours, not by pixels:

- clipped: text that its box cuts off, a value wider than its field, an element out of the window;
- overlap: two controls or texts, neither within the other, that share a place;
- contrast: text under 4.5:1 (3:1 if large) against the first background behind it;
- target: a control under 24 px in width or height;
- grid: a control whose height is no multiple of 4 px;
- primary: not exactly one visible main action in a step, or one that needs scrolling;
- STOP: anywhere but at its place;
- console: a message of the browser.
"""

from __future__ import annotations

import argparse
import base64
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from chromium import open_browser
from sewfast_studio import Project, Studio, make_demo

WIDTHS = (360, 768, 1280, 1920)
HEIGHT = 800
STEPS = ("drive", "data", "model", "tune", "commission", "deploy")
PATIENCE = 180.0
UNFOLD = "document.querySelectorAll('main details:not(.menu)').forEach(d => { d.open = true })"

MEASURE = (Path(__file__).parent / "screens.js").read_text(encoding="utf-8")


class Screens:
    """Pictures and faults of a browser's page."""

    def __init__(self, browser: Any, folder: Path) -> None:
        self.browser, self.folder = browser, folder
        self.faults: list[tuple[str, str, str]] = []
        self.stops: set[tuple[float, ...]] = set()
        self.count = 0

    def take(self, name: str) -> None:
        """Every width and scheme of what the page shows."""
        for width in WIDTHS:
            self.size(width)
            self.browser.execute_script("scrollTo(0, 0)")
            for scheme in ("light", "dark"):
                self.scheme(scheme)
                place = f"{name}-{width}-{scheme}"
                found = self.browser.execute_script(MEASURE)
                self.faults += [(place, kind, what) for kind, what in found["faults"]]
                if found["stop"]:
                    self.stops.add(tuple(found["stop"]))
                self.picture(place)
                self.count += 1
        self.size(1280)
        self.scheme("light")
        for entry in self.browser.get_log("browser"):
            self.faults.append((name, "console", entry["message"][:120]))

    def size(self, width: int, height: int = HEIGHT) -> None:
        size = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": False}
        self.browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)
        time.sleep(0.25)  # curves follow the size of the window

    def scheme(self, scheme: str) -> None:
        feature = {"name": "prefers-color-scheme", "value": scheme}
        self.browser.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": [feature]})
        time.sleep(0.1)

    def picture(self, place: str) -> None:
        width, height = self.browser.execute_script(
            "const e = document.documentElement; return [innerWidth, e.scrollHeight]"
        )
        clip = {"x": 0, "y": 0, "width": width, "height": min(height, 6000), "scale": 1}
        found = self.browser.execute_cdp_cmd(
            "Page.captureScreenshot", {"captureBeyondViewport": True, "clip": clip}
        )
        (self.folder / f"{place}.png").write_bytes(base64.b64decode(found["data"]))


def states(browser: Any, folder: Path) -> Iterator[str]:
    """Bring the page into one state after the other; the name of each."""

    def at(name: str) -> Any:
        return browser.find_element("id", name)

    def step(name: str) -> None:
        at(f"view-{name}").click()

    def press(name: str) -> None:
        until(lambda: at(name).is_displayed() and at(name).is_enabled(), name)
        at(name).click()

    nothing = folder / "nothing"
    nothing.mkdir()
    with Studio(Project(nothing)) as studio:
        browser.get(studio.address)
        until(lambda: at("control").text == "in control", "the empty folder")
        for name in STEPS:
            step(name)
            yield f"empty-{name}"
    demo = folder / "drive"
    demo.mkdir()
    make_demo(demo)
    with Studio(Project(demo, demo=True)) as studio:
        browser.get(studio.address)
        until(lambda: at("cost").text.startswith("cost"), "the cost")
        yield "tune"
        browser.execute_script(UNFOLD)
        at("notch-hz").send_keys("60000")
        press("add-notch")
        until(lambda: at("tune-error").text, "a refusal")
        yield "tune-refused"
        browser.refresh()
        until(lambda: at("cost").text.startswith("cost"), "the cost again")
        press("search")
        until(lambda: at("tune-progress").text.startswith("found"), "a search")
        press("save")
        until(lambda: "(-" in at("cost").text, "the cost of what was found")
        yield "tune-searched"
        step("data")
        yield "data"
        press("look")
        until(lambda: at("to-model").is_displayed(), "a look")
        yield "data-looked"
        browser.execute_script("document.getElementById('bode-fold').open = true")
        press("bode-start")
        until(lambda: at("bode-text").is_displayed(), "a response")
        yield "data-response"
        step("model")
        at("kind").send_keys("linear, output")
        press("identify")
        yield "model-working"
        until(lambda: at("to-tune").is_displayed(), "a model")
        press("validate")
        until(lambda: at("validated").is_displayed(), "a validation")
        yield "model-done"
        step("drive")
        yield "drive"
        press("connect")
        until(lambda: at("limits").is_displayed() and "in time" in at("prompt").text, "a drive")
        yield "drive-connected"
        press("limits")
        press("arm")
        until(lambda: at("record").is_displayed(), "an armed drive")
        press("record")
        until(lambda: "RPM" in at("speed").text, "samples")
        time.sleep(3.0)
        yield "drive-armed"
        press("stop")
        until(lambda: "output off" in at("stopped").text, "the stop")
        yield "drive-stopped"
        press("disconnect")
        step("commission")
        at("machine-seed")
        browser.execute_script(
            "document.querySelectorAll('#commission details').forEach(d => { d.open = true });"
            "document.getElementById('networks').value = 1;"
            "document.getElementById('commission-tries').value = 100;"
        )
        press("commission-start")
        until(lambda: len(at("stages").text.split("\n")) > 2, "stages")
        yield "verify-working"
        until(lambda: at("commission-fold").is_displayed() or at("commission-error").text, "it")
        yield "verify-done"
        step("deploy")
        press("report")
        until(lambda: at("report-link").is_displayed(), "a report")
        yield "deploy-done"
        page = browser.current_url
        browser.get((demo / "commissioned" / "report.html").as_uri())
        yield "report"
        browser.execute_script(
            "document.querySelectorAll('details').forEach(d => { d.open = true })"
        )
        yield "report-open"
        browser.get((Path(__file__).parents[2] / "docs" / "design.html").as_uri())
        yield "design"
        browser.get(page)
        until(lambda: at("control").text == "in control", "the studio again")
        first = browser.current_window_handle
        browser.switch_to.new_window("tab")
        browser.get(studio.address)
        until(lambda: at("control").text == "looking on", "a second page")
        yield "second-page"
        browser.close()
        browser.switch_to.window(first)
    until(lambda: "not connected" in at("control").text, "the end")
    yield "not-connected"


def until(true: Callable[[], object], what: str) -> None:
    end = time.monotonic() + PATIENCE
    while not true():
        if time.monotonic() > end:
            raise SystemExit(f"the page did not get to {what}")
        time.sleep(0.1)


def main() -> None:
    parser = argparse.ArgumentParser(description="Renders and measures the pages.")
    parser.add_argument("folder", nargs="?", type=Path, default=Path("target/screens"))
    parser.add_argument("--only", default="", help="states with this word in their name")
    given = parser.parse_args()
    given.folder.mkdir(parents=True, exist_ok=True)
    browser = open_browser(1280, 800)
    screens = Screens(browser, given.folder)
    screens.size(1280)
    try:
        with tempfile.TemporaryDirectory() as place:
            for name in states(browser, Path(place)):
                if given.only in name:
                    screens.take(name)
                    print(f"{name}: {len(screens.faults)} faults so far", flush=True)
    except SystemExit as e:
        screens.faults.append(("all", "console", str(e)))
        screens.picture("last")
    finally:
        browser.quit()
    if len(screens.stops) > 1:
        screens.faults.append(("all", "STOP", f"{len(screens.stops)} places: {screens.stops}"))
    for place, kind, what in screens.faults:
        print(f"{place:32} {kind:9} {what}")
    kinds = Counter(kind for _, kind, _ in screens.faults)
    summed = ", ".join(f"{n} {kind}" for kind, n in kinds.items())
    print(f"\n{screens.count} screens; {summed or '0 faults'}")
    print(f"STOP at {sorted(screens.stops)} (right, top, width, height)")
    sys.exit(bool(screens.faults))


if __name__ == "__main__":
    main()
