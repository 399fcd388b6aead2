"""The studio's page in a real browser: by clicks, by keys, at every width, on paper."""

from __future__ import annotations

import base64
import contextlib
import os
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from moments import until
from sewfast_studio import Project, Studio
from studio_page import EVIL, FOLDS, NUMBER


@pytest.mark.alone
@pytest.mark.slow("the one way by clicks by day")
def test_the_way_by_clicks(studio: Studio, browser: Any) -> None:
    def at(name: str) -> Any:
        return browser.find_element("id", name)

    browser.get(studio.address)
    until(lambda: "u" in at("inputs").text)
    assert studio.token not in browser.current_url
    assert EVIL in at("output").text  # shown as text, and not run
    browser.execute_script(FOLDS)
    at("resample").send_keys("0.02")
    at("look").click()
    until(lambda: len(browser.find_elements("css selector", "#signals canvas")) == 2)
    at("view-model").click()
    at("kind").send_keys("linear, output")
    at("identify").click()
    until(lambda: "free run explains" in at("headline").text)
    assert at("against").get_attribute("value") == "run2.csv"  # the one that was not trained on
    at("validate").click()
    until(lambda: "Report card" in at("card").text)
    if "STUDIO_PICTURES" in os.environ:
        _take_pictures(browser, Path(os.environ["STUDIO_PICTURES"]))
    for width in (1200, 600):  # 600: what 200 % zoom leaves of a window of 1200
        browser.set_window_size(width, 900)
        assert browser.execute_script(WIDE) <= 0
    painted = "return [...document.querySelectorAll('#fit canvas, #free canvas')]"
    painted += ".every(c => c.getContext('2d')"
    painted += ".getImageData(0, 0, c.width, c.height).data.some(v => v))"
    assert browser.execute_script(painted)
    assert browser.title == "sewfast studio"
    # what was found on one recording does not stand below another
    at("view-data").click()
    at("file").send_keys("run2.csv")
    until(lambda: not browser.find_elements("css selector", "#signals canvas, #free canvas"))
    at("view-model").click()
    assert "free run explains" in at("headline").text
    assert browser.get_log("browser") == []


@pytest.mark.nightly("a browser")
@pytest.mark.alone
def test_a_button_does_what_an_advice_says(tmp_path: Path, browser: Any) -> None:
    random = np.random.default_rng(0)
    u = np.repeat(random.uniform(-5.0, 5.0, 40), 50)
    y = np.convolve(u, np.exp(-np.arange(200) / 40.0))[: len(u)] + random.normal(0.0, 0.5, len(u))
    y[700] = 300.0
    rows = np.column_stack([np.arange(len(u)) * 0.01, u, y])
    head = {"header": "time [s],voltage [V],speed [RPM]", "comments": "", "delimiter": ","}
    np.savetxt(tmp_path / "run.csv", rows, **head)
    np.savetxt(tmp_path / "untimed.csv", rows[:, 1:], **{**head, "header": "u,y"})
    (tmp_path / "wrong.csv").write_text("no table\n")

    def at(name: str) -> Any:
        return browser.find_element("id", name)

    def look(file: str) -> None:
        at("file").send_keys(file)
        until(lambda: len(at("rows").find_elements("tag name", "tr")) > 1)
        at("look").click()

    with Studio(Project(tmp_path)) as studio:
        browser.get(studio.address)
        until(lambda: at("view-data").text)
        look("run.csv")
        until(lambda: "“Leave out” set to outliers" in at("advice").text)
        assert "--" not in at("advice").text
        browser.find_element("css selector", "#advice button").click()
        until(lambda: "stand" not in at("advice").text)
        assert at("mask").get_attribute("value") == "outliers"
        # another recording has no changes yet; what it lacks is asked for at its field
        look("untimed.csv")
        until(lambda: browser.find_elements("class name", "refused"))
        assert at("mask").get_attribute("value") == ""
        assert at("Ts").get_attribute("aria-invalid") == "true"
        # columns of another file would pass for those of one that cannot be read
        at("file").send_keys("wrong.csv")
        until(lambda: at("error").is_displayed())
        assert str(tmp_path) not in at("error").text
        assert not at("inputs").find_elements("tag name", "option")


VIEWS = ("drive", "data", "model", "tune", "commission", "deploy")
WIDE = "return document.documentElement.scrollWidth - innerWidth"
COVERED = """
const header = document.querySelector('#tune .bar');
return [...document.querySelectorAll('#tune button, #tune input, #tune select')].reverse()
  .filter(e => e.checkVisibility() && !e.closest('.bar, .menu > div') && !e.disabled).filter(e => {
    e.focus();
    const below = header.getBoundingClientRect().bottom;
    return e.getBoundingClientRect().top < below - 1;
  }).map(e => e.id);
"""


@pytest.mark.alone
def test_tuning_by_keyboard(tuned: Studio, browser: Any) -> None:
    from selenium.webdriver.common.keys import Keys

    def at(name: str) -> Any:
        return browser.find_element("id", name)

    def number(title: str) -> Any:
        return browser.execute_script(NUMBER, title)

    browser.set_window_size(1600, 1000)
    browser.get(tuned.address)
    until(lambda: number("Ms"))
    until(lambda: "start" in at("cost").text)
    before, first = number("Ms"), at("knob-Kp-value").get_attribute("value")
    at("knob-Kp").send_keys(Keys.ARROW_RIGHT * 10)
    until(lambda: number("Ms") != before)
    until(lambda: "old" not in at("cost").get_attribute("class"))
    moved = {"Kp": float(at("knob-Kp-value").get_attribute("value"))}
    shown, _ = tuned.project.tuning("drive.json").move(moved)
    assert float(number("Ms")) == pytest.approx(shown["Ms"], rel=5e-3)
    assert float(number("overshoot of this step")) == pytest.approx(
        shown["overshoot_percent"], rel=5e-3
    )
    at("pin-A").click()
    at("view-tune").send_keys("z")
    for _ in range(9):
        at("undo").send_keys(Keys.ENTER)
    until(lambda: number("Ms") == before)
    assert at("knob-Kp-value").get_attribute("value") == first
    at("take-A").click()
    until(lambda: float(at("knob-Kp-value").get_attribute("value")) == moved["Kp"])
    browser.execute_script(FOLDS)
    at("evaluations").clear()
    at("evaluations").send_keys("40")
    at("search").click()
    until(lambda: "Found" in at("tune-progress").text)
    at("save").click()
    until(lambda: "Written" in at("saved").text)
    # the blue button leads on
    assert [e.text for e in browser.find_elements("css selector", "#tune .primary")] == [
        "Deploy it"
    ]
    at("copy-python").click()
    until(lambda: "evaluations=40" in at("tune-copy").text)
    script, place = at("tune-copy").text, tuned.project.folder / "controller.json"
    written = place.read_bytes()
    place.unlink()
    subprocess.run([sys.executable, "-c", script], cwd=place.parent, check=True)
    assert place.read_bytes() == written
    if "STUDIO_PICTURES" in os.environ:
        _take_pictures(browser, Path(os.environ["STUDIO_PICTURES"]), "tune", (2200, 1500, 700))
    for width in (1600, 1000, 600):
        browser.set_window_size(width, 900)
        assert browser.execute_script(WIDE) <= 0
    assert browser.get_log("browser") == []


@pytest.mark.alone
def test_no_view_keeps_anybody_out(tuned: Studio, browser: Any) -> None:
    """No violation that axe knows: names, contrast, landmarks."""
    axe = pytest.importorskip("axe_selenium_python").Axe(browser)
    browser.get(tuned.address)
    until(lambda: browser.execute_script(NUMBER, "Ms"))
    opened = "document.querySelectorAll('main details:not(.menu)').forEach(d => { d.open = true })"
    browser.execute_script(opened)
    axe.inject()
    for view in VIEWS:
        browser.find_element("id", f"view-{view}").click()
        assert axe.run()["violations"] == [], view


@pytest.mark.alone
def test_the_page_finds_its_state_again(tuned: Studio, browser: Any) -> None:
    browser.get(tuned.address)
    until(lambda: browser.execute_script(NUMBER, "Ms"))
    fields = "return [...document.querySelectorAll('#tune input')].map(e => e.id + e.value)"
    before = browser.execute_script(fields)
    browser.refresh()
    until(lambda: browser.execute_script(NUMBER, "Ms"))
    assert browser.find_element("id", "control").text == "in control"
    # a browser that keeps what is in fields must not give gains to the limits
    browser.back()
    browser.forward()
    until(lambda: browser.execute_script(NUMBER, "Ms"))
    assert browser.execute_script(fields) == before
    # Back and a reload lead to the step that was shown
    for view in ("model", "deploy"):
        browser.find_element("id", f"view-{view}").click()
    browser.back()
    until(lambda: browser.find_element("id", "model").is_displayed())
    browser.refresh()
    until(lambda: browser.find_element("id", "model").is_displayed())
    browser.back()
    until(lambda: browser.find_element("id", "tune").is_displayed())
    browser.forward()
    until(lambda: browser.find_element("id", "model").is_displayed())


def _take_pictures(
    browser: Any, folder: Path, name: str = "look", widths: tuple[int, ...] = (1200, 600)
) -> None:
    browser.execute_script("scrollTo(0, 0)")
    for width in widths:
        height = 1000 if name == "tune" and width > 800 else 2600
        size = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": False}
        browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)
        time.sleep(0.3)
        found = browser.execute_cdp_cmd("Page.captureScreenshot", {})
        (folder / f"{name}-{width}.png").write_bytes(base64.b64decode(found["data"]))
    browser.execute_cdp_cmd("Emulation.clearDeviceMetricsOverride", {})


class Keys:
    """A person without a mouse: Tab, Enter, arrows and letters."""

    def __init__(self, browser: Any) -> None:
        self.browser = browser

    def send(self, *keys: str) -> None:
        from selenium.webdriver import ActionChains

        # to the page and not to an element: a file field would take them for a path
        ActionChains(self.browser).send_keys(*keys).perform()

    def reach(self, name: str) -> None:
        """By Tab alone, which goes round."""
        from selenium.webdriver.common.keys import Keys as Key

        for _ in range(150):
            if self.browser.switch_to.active_element.get_attribute("id") == name:
                return
            self.send(Key.TAB)
        raise AssertionError(f"{name} is not reached by Tab")

    def press(self, name: str) -> None:
        until(lambda: self.browser.find_element("id", name).is_enabled())
        self.reach(name)
        self.send("\ue007")

    def write(self, name: str, text: str) -> None:
        from selenium.webdriver import ActionChains

        self.reach(name)
        ActionChains(self.browser).key_down("\ue009").send_keys("a").key_up("\ue009").perform()
        self.send(text)


@pytest.mark.nightly("the whole way; by day `test_the_way_by_clicks`")
@pytest.mark.alone
def test_the_whole_way_by_keyboard(studio: Studio, browser: Any) -> None:
    """From a recording to a report; every view is opened and used."""

    def text(name: str) -> str:
        return str(browser.find_element("id", name).text)

    keys = Keys(browser)
    browser.get(studio.address)
    until(lambda: browser.execute_script("return document.querySelector('#inputs').length > 0"))
    keys.press("look")
    until(lambda: browser.find_elements("css selector", "#signals canvas"))
    keys.press("view-model")
    keys.reach("kind")
    keys.send("linear, output")
    keys.press("identify")
    until(lambda: "free run explains" in text("headline"))
    keys.press("validate")
    until(lambda: "Report card" in text("card"))
    keys.press("view-data")
    browser.execute_script("document.getElementById('bode-fold').open = true")
    keys.press("bode-start")
    until(lambda: text("bode-text") or text("bode-error"), 300.0)
    assert text("bode-error") == ""
    keys.press("view-tune")
    until(lambda: browser.execute_script(NUMBER, "Ms"))
    browser.execute_script("document.getElementById('loop-fold').open = true")
    until(lambda: "measured: " in text("loop-text"))
    before = browser.execute_script(NUMBER, "Ms")
    keys.reach("knob-Kp")
    keys.send("\ue014" * 8)
    until(lambda: browser.execute_script(NUMBER, "Ms") != before)
    keys.reach("tune-within")
    keys.send(" ")
    browser.execute_script(FOLDS)
    keys.write("evaluations", "40")
    keys.press("search")
    until(lambda: "Found gains" in text("tune-progress"))
    keys.press("save")
    until(lambda: "Written" in text("saved"))
    keys.press("view-drive")
    keys.press("connect")
    keys.press("limits")
    until(lambda: "are set" in text("limits-set"))
    until(lambda: "in time" in text("prompt"))
    keys.press("arm")
    until(lambda: "ARMED" in text("drive-state"))
    keys.press("record")
    until(lambda: "RPM" in text("speed"))
    keys.send("\ue00c")
    until(lambda: "output off" in text("stopped"))
    keys.press("disconnect")
    keys.press("view-commission")
    browser.execute_script(FOLDS)
    keys.write("machine-seed", "1")
    keys.write("networks", "1")
    keys.write("commission-tries", "100")
    keys.press("commission-start")
    until(lambda: "Verified" in text("commission-verdict"), 300.0)
    assert text("stages").startswith("starting\nfirst motion")
    assert "verification" in text("stages")
    assert len(browser.find_elements("css selector", "#loops canvas")) == 4
    if "STUDIO_PICTURES" in os.environ:
        _take_pictures(browser, Path(os.environ["STUDIO_PICTURES"]), "commission", (1200,))
    browser.set_window_size(600, 900)
    assert browser.execute_script(WIDE) <= 0
    browser.set_window_size(1200, 900)
    keys.press("view-deploy")
    keys.press("report")
    until(lambda: browser.find_element("id", "report-link").is_displayed(), 300.0)
    keys.press("report-link")
    until(lambda: len(browser.window_handles) == 2)
    browser.switch_to.window(browser.window_handles[1])
    until(lambda: "commissioning of" in browser.title)
    assert [e for e in browser.get_log("browser") if e["level"] == "SEVERE"] == []


@pytest.mark.alone
def test_a_recording_is_added_by_a_file_picker_and_by_a_drop(studio: Studio, browser: Any) -> None:
    place = studio.project.folder
    other = place.parent / "other.csv"
    other.write_bytes((place / "run.csv").read_bytes())
    browser.get(studio.address)
    until(lambda: browser.find_element("id", "upload").is_enabled())
    browser.find_element("id", "upload").send_keys(str(other))
    until(lambda: "other.csv is in" in browser.find_element("id", "uploaded").text)
    assert (place / "other.csv").read_bytes() == other.read_bytes()
    until(lambda: browser.find_element("id", "file").get_attribute("value") == "other.csv")
    browser.execute_script(DROP, EVIL.replace("/", "") + ".csv", "t,u,y\n0,1,2\n")
    until(lambda: browser.find_elements("class name", "refused"))
    assert "expected a plain name" in browser.find_element("class name", "refused").text
    browser.execute_script(DROP, "small.csv", "t,u,y\n0,1,2\n0.1,1,2\n0.2,1,2\n")
    until(lambda: "small.csv is in" in browser.find_element("id", "uploaded").text)
    # of several, what is refused is said beside what is taken
    browser.execute_script(
        DROP.replace("new File", "new File(['x'], 'no.exe')); data.items.add(new File", 1),
        "more.csv",
        "t,u,y\n0,1,2\n0.1,1,2\n0.2,1,2\n",
    )
    until(lambda: "more.csv is in" in browser.find_element("id", "uploaded").text)
    until(lambda: "no.exe" in browser.find_element("class name", "refused").text)
    # each by its name, and below the field that files are added by
    browser.execute_script(
        DROP.replace("new File", "new File([], 'empty.csv')); data.items.add(new File", 1),
        "more.csv",
        "t,u,y\n0,1,2\n",
    )
    until(lambda: any("empty" in e.text for e in browser.find_elements("class name", "refused")))
    said = browser.find_element("class name", "refused").text
    assert "empty.csv: expected 1 byte to 512 MB, received an empty file. more.csv: " in said
    assert browser.find_element("id", "upload").get_attribute("aria-invalid") == "true"
    # of two drops the second waits for the first; a drop without files adds none
    second = DROP.replace("const ", "var ").replace("[1]", "[3]").replace("[0]", "[2]")
    rows = "0,1,2\n0.1,1,2\n0.2,1,2\n"
    browser.execute_script(
        DROP.replace("const ", "var ") + second,
        *("third.csv", "t,u,y\n" + "0,1,2\n" * 30_000, "fourth.csv", f"t,u,y\n{rows}"),
    )
    until(lambda: "third.csv, fourth.csv are in" in browser.find_element("id", "uploaded").text)
    # where nothing says which column is which, the page asks
    browser.execute_script(DROP, "odd.csv", f"a,b,c\n{rows}")
    until(lambda: "Choose the input" in browser.find_element("id", "what-to-look-at").text)
    browser.find_element("id", "look").click()
    until(lambda: browser.find_element("id", "inputs").get_attribute("aria-invalid") == "true")
    browser.find_element("id", "view-tune").click()
    browser.execute_script(
        DROP.replace("data.items.add(new File([arguments[1]], arguments[0]));", "")
    )
    assert browser.find_element("id", "tune").is_displayed()
    assert browser.title == "sewfast studio"


DROP = """
const data = new DataTransfer(); data.items.add(new File([arguments[1]], arguments[0]));
const how = { dataTransfer: data, bubbles: true, cancelable: true };
document.querySelector("main").dispatchEvent(new DragEvent("drop", how));
"""


@pytest.mark.alone
def test_what_was_found_on_a_file_before_is_not_shown_for_another(
    studio: Studio, browser: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    from selenium.webdriver.support.ui import Select

    go, look = threading.Event(), studio.project.look

    def slowly(step: Any) -> dict[str, Any]:
        assert go.wait(60.0)
        return look(step)

    monkeypatch.setattr(studio.project, "look", slowly)
    browser.get(studio.address)
    until(lambda: browser.find_element("id", "look").is_enabled())
    until(lambda: browser.find_elements("css selector", "#inputs option"))
    Select(browser.find_element("id", "inputs")).select_by_value("u")
    Select(browser.find_element("id", "output")).select_by_value("y")
    browser.find_element("id", "look").click()
    Select(browser.find_element("id", "file")).select_by_value("run2.csv")
    go.set()
    until(lambda: browser.find_elements("css selector", "#inputs option"))
    assert not browser.find_elements("css selector", "#signals canvas")
    assert "not looked at" in browser.find_element("id", "view-data").text
    until(lambda: browser.find_element("id", "look").is_enabled())
    Select(browser.find_element("id", "inputs")).select_by_value("u")
    Select(browser.find_element("id", "output")).select_by_value("y")
    browser.find_element("id", "look").click()
    until(lambda: len(browser.find_elements("css selector", "#signals canvas")) == 2)


@pytest.mark.alone
def test_three_clicks_lead_from_a_dropped_file_to_a_controller(
    studio: Studio, browser: Any
) -> None:
    def press(name: str) -> None:
        button = browser.find_element("id", name)
        until(lambda: button.is_displayed() and button.is_enabled())
        assert [button] == [
            b for b in browser.find_elements("css selector", ".primary") if b.is_displayed()
        ]
        button.click()

    browser.get(studio.address)
    until(lambda: browser.find_element("id", "upload").is_enabled())
    table = (studio.project.folder / "run.csv").read_text(encoding="utf-8")
    browser.execute_script("document.getElementById('view-deploy').click()")
    browser.execute_script(DROP, "dropped.csv", table.replace(EVIL, "z"))
    until(lambda: len(browser.find_elements("css selector", "#signals canvas")) == 2)
    # a linear model and a short search, which take seconds
    browser.execute_script(
        "document.getElementById('kind').value = 'oe';"
        "document.getElementById('evaluations').value = 20;"
    )
    press("to-model")
    press("to-tune")
    press("search")
    until(lambda: "Found gains" in browser.find_element("id", "tune-progress").text)


SEEN = """
const plots = [...document.querySelectorAll("#tune .charts .plot")];
return plots.map(p => [p.querySelector(".read").hidden, p.querySelector(".read").textContent]);
"""
FILES = """
const [done] = arguments;
import("/curves.js").then(async ({ Chart }) => {
  const place = document.querySelector("#step-plot"), chart = new Chart(place, { y: "y <&> [1]" });
  chart.draw([{ name: "measured", x: [0, 1, 2], y: [0, 2, 1] }], "a test");
  await new Promise(drawn => setTimeout(drawn, 200));
  const svg = await (await chart.file("svg")).text(), png = await chart.file("png");
  const parsed = new DOMParser().parseFromString(svg, "image/svg+xml");
  chart.window(0.5, 1.5);
  const part = chart.view; chart.window(-9, 9);
  done([parsed.querySelector("parsererror") === null, parsed.querySelectorAll("text").length,
        png.type, part, chart.view]);
});
"""


@pytest.mark.alone
def test_pictures_share_a_cursor_and_become_files(tuned: Studio, browser: Any) -> None:
    from selenium.webdriver import ActionChains

    browser.set_window_size(1600, 1000)
    browser.get(tuned.address)
    until(lambda: browser.execute_script(NUMBER, "Ms"))
    canvas = browser.find_element("css selector", "#command-plot canvas")
    ActionChains(browser).move_to_element(canvas).perform()
    shown = [text for hidden, text in browser.execute_script(SEEN) if not hidden]
    assert len(shown) == 4  # those over time, and none over frequency
    # beside others a curve has a name of its own, alone that of its picture
    named = ("now ", "step: command ", "disturbance", "disturbance: command ")
    assert all(t.startswith("time ") and n in t for t, n in zip(shown, named, strict=True)), shown
    canvas = browser.find_element("css selector", "#nichols-plot canvas")
    ActionChains(browser).move_to_element(canvas).perform()
    shown = [text for hidden, text in browser.execute_script(SEEN) if not hidden]
    assert len(shown) == 4  # Nichols and the three over frequency
    assert all(text.startswith("frequency ") for text in shown)
    intact, texts, kind, part, whole = browser.execute_async_script(FILES)
    assert intact
    assert texts > 10
    assert kind == "image/png"
    assert part == [0.5, 1.5]
    assert whole is None
    assert browser.get_log("browser") == []


COLOURS = """
const { width, height } = document.querySelector("#step-plot canvas");
const context = document.querySelector("#step-plot canvas").getContext("2d");
const { data } = context.getImageData(0, 0, width, height), found = new Set();
for (let k = 0; k < data.length; k += 4) {
  if (data[k + 3] > 200) found.add(Math.max(data[k], data[k + 1], data[k + 2]));
}
return [...found];
"""


@pytest.mark.alone
def test_on_paper_curves_are_black_on_white(tuned: Studio, browser: Any) -> None:
    dark = [{"name": "prefers-color-scheme", "value": "dark"}]
    browser.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": dark})
    browser.get(tuned.address)
    until(lambda: browser.execute_script(NUMBER, "Ms"))
    assert max(browser.execute_script(COLOURS)) > 150
    browser.execute_script("dispatchEvent(new Event('beforeprint'))")
    assert max(browser.execute_script(COLOURS)) < 60
    browser.execute_cdp_cmd("Emulation.setEmulatedMedia", {"media": "print", "features": dark})
    style = "const s = getComputedStyle(document.body); return [s.backgroundColor, s.color]"
    assert browser.execute_script(style) == ["rgb(255, 255, 255)", "rgb(0, 0, 0)"]
    assert not browser.find_element("id", "stop").is_displayed()
    shown = [v for v in VIEWS if browser.find_element("id", v).is_displayed()]
    assert shown == ["tune"]  # and no pages of the other views, which are empty
    browser.execute_cdp_cmd("Emulation.setEmulatedMedia", {"media": "", "features": dark})
    browser.execute_script("dispatchEvent(new Event('afterprint'))")
    assert max(browser.execute_script(COLOURS)) > 150
    page = base64.b64decode(browser.execute_cdp_cmd("Page.printToPDF", {})["data"])
    assert page.startswith(b"%PDF")


@pytest.mark.nightly("a browser")
@pytest.mark.alone
def test_the_first_rows_of_a_file_are_shown(studio: Studio, browser: Any) -> None:
    browser.set_window_size(1280, 900)
    browser.get(studio.address)
    until(lambda: browser.find_element("id", "rows").is_displayed())
    assert len(browser.find_elements("css selector", "#rows tr")) == 6
    if "STUDIO_PICTURES" in os.environ:
        browser.save_screenshot(str(Path(os.environ["STUDIO_PICTURES"]) / "rows.png"))


@pytest.mark.alone
def test_a_question_that_is_cut_off_is_said_to_be(studio: Studio, browser: Any) -> None:
    browser.get(studio.address)
    until(lambda: browser.execute_script("return document.querySelector('#inputs').length > 0"))
    browser.find_element("id", "look").click()
    studio.close()
    until(lambda: "Reload" in browser.find_element("id", "notice-text").text)
    until(lambda: browser.find_element("id", "look").is_enabled())


@pytest.mark.alone
def test_no_view_is_wider_than_the_window(tuned: Studio, browser: Any) -> None:
    browser.get(tuned.address)
    until(lambda: browser.execute_script(NUMBER, "Ms"))
    for width in (1600, 1000, 600):  # 600: what 200 % zoom leaves of a window of 1200
        browser.set_window_size(width, 900)
        for view in VIEWS:
            browser.find_element("id", f"view-{view}").click()
            assert browser.execute_script(WIDE) <= 0, (width, view)
    browser.set_window_size(640, 500)
    browser.find_element("id", "view-tune").click()
    until(lambda: browser.execute_script(COVERED) == [])


@pytest.mark.alone
def test_a_page_without_the_token_is_told(studio: Studio, browser: Any) -> None:
    browser.get(studio.address.split("#")[0])
    with contextlib.suppress(AssertionError):
        until(lambda: "not connected" in browser.find_element("id", "control").text, 10)
    assert "not connected" in browser.find_element("id", "control").text
