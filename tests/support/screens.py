"""Renders every step of the studio in its states, a report and the page of the design at four
widths, at 200 % zoom, light and dark, and on paper, and measures them.

    python tests/support/screens.py [FOLDER] [--only WORD] [--axe axe.min.js]

Pictures go to the folder (target/screens), a table of what is wrong to standard output; exit code 1
if anything is. Measured by boxes and colours, not by pixels:

- clipped: text that its box cuts off, a value wider than its field, an element out of the window;
- overlap: two controls or texts, neither within the other, that share a place;
- contrast: text under 4.5:1 (3:1 if large) against the first background behind it;
- target: a control under 24 px in width or height;
- grid: a control whose height is no multiple of 4 px;
- primary: not exactly one visible main action in a step, or one that needs scrolling;
- STOP: anywhere but at its place;
- cut: on paper, a figure that may break over two sheets, or is higher than one;
- console: a message of the browser;
- request: something that the page loads from elsewhere;
- axe: a violation that axe-core finds, if its file is given (the one in axe-playwright-python).
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
ZOOM = 2
"""Of a window of 1280 x 800: what a person who sees little sets."""
SHEET = (718, 1047)
"""CSS pixels of A4 within margins of 1 cm."""
PAPER = ("report", "tune-searched", "data-looked", "model-done", "verify-done")
"""States that are printed as well."""
STEPS = ("drive", "data", "model", "tune", "commission", "deploy")
PATIENCE = 600.0
"""Seconds for a state, on a computer that does other work as well."""
NO_GAINS = """
for (const [id, value] of [["limit-Ms", 1.01], ["limit-u", 0.1], ["evaluations", 20]])
  document.getElementById(id).value = value;
document.getElementById("tune-within").checked = true;
"""
"""Limits that no controller keeps."""
UNFOLD = "document.querySelectorAll('main details:not(.menu)').forEach(d => { d.open = true })"

AXE = """
const done = arguments[0];
axe.run(document, { preload: false, resultTypes: ["violations"] }).then(found => done(
  found.violations.flatMap(v => v.nodes.map(n => `${v.id}: ${n.target.join(" ")}`))));
"""
ELSEWHERE = """
return performance.getEntriesByType("resource").map(e => e.name).filter(
  name => !name.startsWith(location.origin) && !/^(data|blob|file):/.test(name));
"""
CUT = """
const figures = [...document.querySelectorAll("canvas, svg, figure")];
const kept = e => e && (getComputedStyle(e).breakInside === "avoid" || kept(e.parentElement));
// a picture is of one piece, which a browser moves to the next sheet
const holds = e => e.tagName !== "FIGURE" || kept(e);
return figures.filter(e => e.checkVisibility()).filter(
  e => e.getBoundingClientRect().height > arguments[0] || !holds(e)
).map(e => e.outerHTML.slice(0, 60));
"""
MEASURE = (Path(__file__).parent / "screens.js").read_text(encoding="utf-8")


class Screens:
    """Pictures and faults of a browser's page."""

    def __init__(self, browser: Any, folder: Path, axe: str = "") -> None:
        self.browser, self.folder, self.axe = browser, folder, axe
        self.faults: list[tuple[str, str, str]] = []
        self.stops: set[tuple[float, ...]] = set()
        self.count = 0

    def take(self, name: str) -> None:
        """Every width and scheme of what the page shows."""
        for width in (*WIDTHS, 0):
            if width:
                self.size(width)
            else:
                self.size(1280 // ZOOM, HEIGHT // ZOOM, ZOOM)
            self.browser.execute_script("scrollTo(0, 0)")
            for scheme in ("light", "dark"):
                self.scheme(scheme)
                place = f"{name}-{width or 'zoom'}-{scheme}"
                found = self.browser.execute_script(MEASURE)
                self.faults += [(place, kind, what) for kind, what in found["faults"]]
                if found["stop"]:
                    self.stops.add(tuple(found["stop"]))
                self.picture(place)
                self.count += 1
                if width == 1280 and self.axe:
                    self.browser.execute_script(self.axe)
                    found = self.browser.execute_async_script(AXE)
                    self.faults += [(place, "axe", what) for what in found]
        self.faults += [(name, "request", e) for e in self.browser.execute_script(ELSEWHERE)]
        if name in PAPER:
            self.paper(name)
        self.size(1280)
        self.scheme("light")
        for entry in self.browser.get_log("browser"):
            self.faults.append((name, "console", entry["message"][:120]))

    def paper(self, name: str) -> None:
        """The sheets as a PDF, and what is wrong with them."""
        place = f"{name}-paper"
        self.size(*SHEET)
        self.browser.execute_cdp_cmd("Emulation.setEmulatedMedia", {"media": "print"})
        time.sleep(0.3)
        found = self.browser.execute_script(MEASURE)
        on_paper = ("clipped", "overlap", "contrast")
        self.faults += [(place, kind, what) for kind, what in found["faults"] if kind in on_paper]
        self.faults += [(place, "cut", what) for what in self.browser.execute_script(CUT, SHEET[1])]
        self.browser.execute_cdp_cmd("Emulation.setEmulatedMedia", {"media": ""})
        inch = 1 / 2.54
        size = {"paperWidth": 21 * inch, "paperHeight": 29.7 * inch, "preferCSSPageSize": True}
        margins = {f"margin{side}": inch for side in ("Top", "Bottom", "Left", "Right")}
        pdf = self.browser.execute_cdp_cmd("Page.printToPDF", {**size, **margins})
        (self.folder / f"{place}.pdf").write_bytes(base64.b64decode(pdf["data"]))
        self.count += 1

    def size(self, width: int, height: int = HEIGHT, scale: int = 1) -> None:
        size = {"width": width, "height": height, "deviceScaleFactor": scale, "mobile": False}
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

    def not_old() -> bool:
        return not browser.find_elements("css selector", "#cost.old, #reasons.old")

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
        until(lambda: "being" not in at("lights").text, "the verdict")
        yield "tune"
        at("noise").click()
        at("knob-feedforward-value").click()
        until(lambda: "below" in at("cost").text and not_old(), "the feedforward")
        yield "tune-feedforward"
        at("knob-Kp").send_keys("\ue012" * 6)
        browser.execute_script("document.getElementById('evaluations').value = 200")
        press("trade")
        yield "tune-working"
        until(lambda: at("front").is_displayed() and not_old(), "the trade-offs")
        yield "tune-front"
        browser.refresh()
        until(lambda: at("cost").text.startswith("cost"), "the cost once more")
        browser.execute_script(UNFOLD)
        browser.execute_script("document.getElementById('evaluations').value = 5")
        press("search")
        until(lambda: browser.find_elements("class name", "refused"), "a refusal at its field")
        yield "tune-refused-field"
        browser.refresh()
        until(lambda: at("cost").text.startswith("cost"), "the cost then")
        browser.execute_script(NO_GAINS)
        press("search")
        until(lambda: at("tune-error").text, "a refusal")
        yield "tune-refused"
        browser.refresh()
        until(lambda: at("cost").text.startswith("cost"), "the cost again")
        press("search")
        until(lambda: "Found" in at("tune-progress").text, "a search")
        press("save")
        until(lambda: "below" in at("cost").text and not_old(), "the cost of what was found")
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
    parser.add_argument("--axe", type=Path, help="axe.min.js, to count its violations as well")
    given = parser.parse_args()
    given.folder.mkdir(parents=True, exist_ok=True)
    browser = open_browser(1280, 800)
    browser.set_script_timeout(60)
    axe = given.axe.read_text(encoding="utf-8") if given.axe else ""
    screens = Screens(browser, given.folder, axe)
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
