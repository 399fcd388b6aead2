"""The step Tune of the studio's page in a real browser."""

from __future__ import annotations

import contextlib
import os
import shutil
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

import sewfast
from moments import until
from sewfast.errors import FitError
from sewfast_studio import Studio
from studio_page import FOLDS, NUMBER


@pytest.mark.alone
def test_a_loop_that_diverges_leaves_no_old_curve(
    tuned: Studio, browser: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    def diverges(*_: object) -> None:
        raise FitError("runs away")

    painted = "return document.querySelector('#step-plot canvas').getContext('2d')"
    painted += ".getImageData(0, 0, 900, 200).data.some(v => v)"
    browser.get(tuned.address)
    until(lambda: browser.execute_script(NUMBER, "Ms"))
    assert browser.execute_script(painted)
    # a command with limits keeps the loop around a stable model finite
    monkeypatch.setattr("sewfast.analysis.responses.responses", diverges)
    browser.find_element("id", "knob-Kp").send_keys("\ue014")  # arrow right
    until(lambda: "unstable" in browser.find_element("id", "lights").text)
    assert "diverges" in browser.execute_script(
        "return document.querySelector('#step-plot canvas').getAttribute('aria-label')"
    )
    assert not browser.execute_script(painted)


@pytest.mark.alone
def test_a_notch_is_put_in_and_taken_out(tuned: Studio, browser: Any) -> None:
    def at(name: str) -> Any:
        return browser.find_element("id", name)

    browser.set_window_size(1600, 1000)
    browser.get(tuned.address)
    until(lambda: browser.execute_script(NUMBER, "Ms"))
    before = browser.execute_script(NUMBER, "noise gain")
    browser.execute_script(FOLDS)
    at("notch-hz").send_keys("60")
    at("add-notch").click()
    until(lambda: browser.find_elements("id", "knob-notch_frequency[0]"))
    until(lambda: browser.execute_script(NUMBER, "noise gain") not in (None, before))
    at("notch-hz").clear()
    at("notch-hz").send_keys("6000")
    at("add-notch").click()
    until(lambda: browser.find_elements("css selector", "label + .refused"))
    assert len(browser.find_elements("css selector", "#notches li")) == 1
    browser.find_element("css selector", "#notches button").click()
    until(lambda: browser.execute_script(NUMBER, "noise gain") == before)


def _searching(browser: Any, tuned: Studio, evaluations: str, button: str) -> Callable[[str], Any]:
    """Opens the step Tune and begins a search; finds its elements by their ids."""

    def at(name: str) -> Any:
        return browser.find_element("id", name)

    browser.set_window_size(1280, 900)
    browser.get(tuned.address)
    until(lambda: browser.execute_script(NUMBER, "Ms"))
    browser.execute_script(FOLDS)
    _search(at, evaluations, button)
    return at


def _search(at: Callable[[str], Any], evaluations: str, button: str) -> None:
    from selenium.webdriver.common.keys import Keys

    at("evaluations").clear()
    at("evaluations").send_keys(evaluations)
    at(button).send_keys(Keys.ENTER)


@pytest.mark.nightly("a browser")
@pytest.mark.alone
def test_a_refusal_stands_at_its_field(tuned: Studio, browser: Any) -> None:
    at = _searching(browser, tuned, "5", "search")
    until(lambda: browser.find_elements("css selector", ".refused"))
    assert not at("tune-error").is_displayed()
    assert at("evaluations").get_attribute("aria-invalid") == "true"
    assert at(at("evaluations").get_attribute("aria-describedby")).text.startswith("Expected")
    if "STUDIO_PICTURES" in os.environ:
        browser.execute_script("arguments[0].scrollIntoView({block: 'center'})", at("evaluations"))
        browser.save_screenshot(str(Path(os.environ["STUDIO_PICTURES"]) / "refused.png"))
    _search(at, "20", "search")
    until(lambda: not browser.find_elements("css selector", ".refused"))


TITLES = "return [...document.querySelectorAll('#numbers th[scope=col]')].map(e => e.textContent)"


PICTURE = "return document.querySelector('#command-plot canvas').toDataURL()"


@pytest.mark.nightly("a browser")
@pytest.mark.alone
def test_before_and_after_feedforward_noise_and_reasons(tuned: Studio, browser: Any) -> None:
    from selenium.webdriver.common.keys import Keys

    def at(name: str) -> Any:
        return browser.find_element("id", name)

    browser.get(tuned.address)
    until(lambda: "gains fair" in at("lights").text)
    assert at("reasons").text == "The model is graded fair."
    at("knob-feedforward-value").click()
    until(lambda: "start" in browser.execute_script(TITLES))
    first = at("knob-alpha-value").get_attribute("value")
    assert float(first) == 0.0  # its work is done
    at("knob-Kp").send_keys(Keys.ARROW_RIGHT)
    until(lambda: "before" in browser.execute_script(TITLES))
    at("compare").send_keys("the start")
    until(lambda: "start" in browser.execute_script(TITLES))
    calm = browser.execute_script(PICTURE)
    at("noise").click()
    until(lambda: browser.execute_script(PICTURE) != calm)
    at("knob-feedforward-value").click()
    until(lambda: float(at("knob-alpha-value").get_attribute("value")) > 0.0)
    at("undo").click()
    until(lambda: at("knob-feedforward-value").is_selected())
    assert browser.get_log("browser") == []


@pytest.mark.nightly("searches from a browser")
@pytest.mark.alone
def test_two_sliders_move_along_the_trade_off(tuned: Studio, browser: Any) -> None:
    from selenium.webdriver.common.keys import Keys

    at = _searching(browser, tuned, "80", "trade")
    until(lambda: at("front").is_displayed())
    assert not at("knobs").is_displayed()  # gains are the second layer
    at("front-response").send_keys(Keys.HOME)
    robust = at("front-robust")
    until(lambda: robust.get_attribute("value") == robust.get_attribute("max"))
    peak = at("front-Ms").text
    until(lambda: f"Ms {browser.execute_script(NUMBER, 'Ms')}" == peak)
    at("front-robust").send_keys(Keys.HOME)
    until(lambda: at("front-Ms").text != peak)
    assert float(at("front-Ms").text.split()[1]) > float(peak.split()[1])
    if "STUDIO_PICTURES" in os.environ:
        browser.save_screenshot(str(Path(os.environ["STUDIO_PICTURES"]) / "trade.png"))


@pytest.mark.nightly("searches from a browser")
@pytest.mark.alone
def test_a_search_has_the_limits_weights_and_seconds_of_the_page(
    tuned: Studio, browser: Any
) -> None:
    def at(name: str) -> Any:
        return browser.find_element("id", name)

    def write(name: str, value: str) -> None:
        at(name).clear()
        at(name).send_keys(value)

    browser.get(tuned.address)
    until(lambda: browser.execute_script(NUMBER, "Ms"))
    at("tune-within").click()
    browser.execute_script(FOLDS)
    write("limit-Ms", "1.9")
    write("limit-overshoot", "70")
    write("weight-chatter", "3.5")
    write("evaluations", "20")
    at("search").click()
    until(lambda: "Found gains" in at("tune-progress").text)
    at("copy-python").click()
    until(lambda: "tune(" in at("tune-copy").text)
    limits = "constraints=sewfast.Constraints(Ms=1.9, overshoot=70)"
    for part in (limits, "cost=sewfast.Cost(chatter=3.5)", "evaluations=20"):
        assert part in at("tune-copy").text
    write("evaluations", "20000")
    write("tune-seconds", "0.5")
    at("search").click()
    until(lambda: "Time is up" in at("tune-progress").text)


@pytest.mark.alone
def test_what_is_shown_follows_its_files(tuned: Studio, browser: Any) -> None:
    """A start that is saved over keeps its notch once; another model of the name is noticed."""
    from selenium.common.exceptions import WebDriverException
    from selenium.webdriver.support.expected_conditions import staleness_of

    def at(name: str) -> Any:
        return browser.find_element("id", name)

    def notches() -> list[Any]:
        return list(browser.find_elements("css selector", "input[type=range][id^=knob-notch_f]"))

    folder = tuned.project.folder
    browser.set_window_size(1600, 1000)
    browser.get(tuned.address)
    until(lambda: browser.execute_script(NUMBER, "Ms"))
    at("save").click()
    until(lambda: len(at("tune-start").find_elements("tag name", "option")) == 2)
    at("tune-start").send_keys("controller.json")
    until(lambda: "start" in at("cost").text and not at("cost").get_attribute("class").count("old"))
    browser.execute_script(FOLDS)
    assert at("save-name").get_attribute("value") == "controller-2.json"
    at("save-name").clear()
    at("save-name").send_keys("controller.json")  # only what a person has named is replaced
    at("notch-hz").send_keys("60")
    at("add-notch").click()
    until(lambda: len(notches()) == 1)
    for _ in range(2):  # the second would add the notch of the file to that of the page
        browser.execute_script("document.getElementById('saved').textContent = ''")
        opened_anew = staleness_of(at("knob-Kp"))
        at("save").click()
        until(lambda: "Written" in at("saved").text)
        # else it may open the model that is written below, and need not notice another one
        until(lambda anew=opened_anew: anew(browser))
        until(lambda: not browser.find_elements("css selector", "#notches li"))
        assert len(sewfast.load_controller(folder / "controller.json").biquads) == 1
        assert len(notches()) == 1
    assert at("tune-error").text == ""
    first = browser.execute_script(NUMBER, "Ms")
    model = sewfast.load_model(folder / "drive.json").members[0]
    model.save(folder / "drive.json")

    def pressed() -> bool:
        # a page that opens a start anew has no sliders for a moment
        with contextlib.suppress(WebDriverException):
            at("knob-Kp").send_keys("\ue014")
            return True
        return False

    until(pressed)
    until(lambda: "has changed" in at("tune-error").text)
    until(lambda: at("tune-members").text == "")
    until(lambda: browser.execute_script(NUMBER, "Ms") != first)


@pytest.mark.nightly("a search from a browser")
@pytest.mark.alone
def test_gains_of_another_model_are_not_taken(tuned: Studio, browser: Any) -> None:
    """A search ends on every page, and on some another model is shown by then: they wait for it."""
    from selenium.webdriver.support.ui import Select

    drive = tuned.project.folder / "drive.json"
    shutil.copy(drive, drive.with_name("other.json"))
    at = _searching(browser, tuned, "60", "search")
    Select(at("tune-model")).select_by_value("other.json")
    until(lambda: "A search for drive.json has ended" in at("tune-progress").text)
    assert at("tune-model").get_attribute("value") == "other.json"
    assert "that of the start" in at("cost").text
    Select(at("tune-model")).select_by_value("drive.json")
    until(lambda: "Found gains" in at("tune-progress").text)
    until(lambda: "below the start" in at("cost").text)


@pytest.mark.nightly("a search from a browser")
@pytest.mark.alone
def test_gains_follow_a_model_that_is_renamed(tuned: Studio, browser: Any) -> None:
    drive = tuned.project.folder / "drive.json"
    other = sewfast.load_model(drive).members[0]
    at = _searching(browser, tuned, "300", "search")
    until(lambda: " of 300" in at("tune-progress").text)
    drive.rename(drive.with_name("renamed.json"))
    other.save(drive.with_name("an other.json"))
    until(lambda: "A search for renamed.json has ended" in at("tune-progress").text)
    assert at("tune-model").get_attribute("value") == "an other.json"
    drive.with_name("renamed.json").rename(drive)
    tuned._tell_all()
    until(lambda: "renamed.json is no longer in the folder" in at("tune-progress").text)
    drive.rename(drive.with_name("renamed.json"))
    tuned._tell_all()
    until(lambda: "Choose this model" in at("tune-progress").text)
    at("tune-model").send_keys("renamed")
    until(lambda: "Found gains" in at("tune-progress").text)
    until(lambda: "below the start" in at("cost").text)
    assert browser.get_log("browser") == []


def _found(model: str, start: str | None, values: dict[str, Any], cost: float) -> dict[str, Any]:
    """The end of a search, as the server tells it to every page."""
    ended = {"interrupted": False, "ended": "evaluations", "cost": cost, "start_cost": 2.0}
    return {
        "event": "searched",
        "found": {"model": model, "start": start, "values": values, **ended},
    }


@pytest.mark.alone
def test_gains_wait_until_their_model_and_start_are_open(
    tuned: Studio, browser: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also while another one is open still, and behind those of another search."""
    from selenium.webdriver.support.ui import Select

    from sewfast_studio.tuning import Tuning

    def at(name: str) -> Any:
        return browser.find_element("id", name)

    def gain() -> float:
        return float(at("knob-Kp-value").get_attribute("value"))

    folder = tuned.project.folder
    shutil.copy(folder / "drive.json", folder / "other.json")
    tuning = tuned.project.tuning("drive.json")
    tuned.project.save_controller(tuning, {}, "saved.json")
    values = {knob.name: knob.value for knob in tuning.knobs}
    begin = values["Kp"]
    found = {name: {**values, "Kp": k * begin} for k, name in enumerate(("one", "two", "three"), 2)}
    browser.get(tuned.address)
    until(lambda: browser.execute_script(NUMBER, "Ms"))
    tuned._tell(_found("other.json", None, found["one"], 1.0))
    until(lambda: "A search for other.json has ended" in at("tune-progress").text)
    tuned._tell(_found("drive.json", "saved.json", found["two"], 1.0))
    until(lambda: "Choose the start “saved.json”" in at("tune-progress").text)
    tuned._tell(_found("drive.json", None, found["three"], 1.5))
    until(lambda: "Found gains with cost 1.5" in at("tune-progress").text)
    assert gain() == pytest.approx(4 * begin, rel=1e-4)

    # a state comes, and a search ends, while its model is being opened
    go, opened = threading.Event(), Tuning.opened

    def slowly(tuning: Tuning) -> dict[str, Any]:
        assert go.wait(60.0)
        return opened(tuning)

    monkeypatch.setattr(Tuning, "opened", slowly)
    Select(at("tune-model")).select_by_value("other.json")
    assert "Found gains" not in at("tune-progress").text
    tuned._tell(_found("other.json", None, found["two"], 0.5))
    tuned._tell_all()
    assert not at("search").is_enabled()
    go.set()
    until(lambda: "Found gains with cost 0.5" in at("tune-progress").text)
    until(lambda: "above" in at("cost").text or "below" in at("cost").text)
    assert gain() == pytest.approx(3 * begin, rel=1e-4)
    assert not at("tune-error").is_displayed()
    # another start waits still
    Select(at("tune-model")).select_by_value("drive.json")
    until(lambda: "Choose the start “saved.json”" in at("tune-progress").text)
    Select(at("tune-start")).select_by_value("saved.json")
    until(lambda: "Found gains with cost 1" in at("tune-progress").text)
    assert gain() == pytest.approx(3 * begin, rel=1e-4)
    assert browser.get_log("browser") == []


@pytest.mark.alone
def test_a_model_that_is_gone_is_said_and_leaves_nothing(tuned: Studio, browser: Any) -> None:
    def at(name: str) -> Any:
        return browser.find_element("id", name)

    drive = tuned.project.folder / "drive.json"
    browser.get(tuned.address)
    until(lambda: browser.execute_script(NUMBER, "Ms"))
    at("knob-Kp").send_keys("\ue014")  # arrow right
    until(lambda: "start" in browser.execute_script(TITLES))
    drive.rename(drive.with_name("renamed.json"))
    tuned._tell_all()
    until(lambda: "drive.json is no longer in the folder" in at("tune-error").text)
    until(lambda: "that of the start" in at("cost").text)
    assert at("tune-model").get_attribute("value") == "renamed.json"
    # a model that cannot be opened shows nothing of the one before
    drive.write_text('{"format": "sewfast.model", "version": 1}')
    tuned._tell_all()
    until(lambda: len(at("tune-model").find_elements("tag name", "option")) == 2)
    at("tune-model").send_keys("drive")
    until(lambda: at("tune-error").text and "no longer" not in at("tune-error").text)
    assert not at("lights").text
    assert not at("step-plot").is_displayed()
    drive.unlink()
    tuned._tell_all()
    until(lambda: "that of the start" in at("cost").text)
    assert at("step-plot").is_displayed()
    drive.with_name("renamed.json").unlink()
    tuned._tell_all()
    until(lambda: at("no-model").is_displayed())
    assert not at("search").is_enabled()
    assert not at("lights").text
    assert browser.get_log("browser") == []


@pytest.mark.alone
def test_a_model_without_loops_to_limit_shows_the_sensitivity_of_the_table(
    tuned: Studio, browser: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The judgement of some networks has an Ms of 0, which is none and no good one."""
    from sewfast_studio.tuning import Tuning

    judged = Tuning.judged
    monkeypatch.setattr(Tuning, "judged", lambda *given: {**judged(*given), "Ms": 0.0})
    browser.get(tuned.address)
    until(lambda: "at most 10 %" in browser.find_element("id", "lights").text)
    until(lambda: browser.find_element("id", "cost").text.startswith("cost"))
    Ms = browser.execute_script(NUMBER, "Ms")
    assert f"Ms {Ms}, at most 1.8" in browser.find_element("id", "lights").text
