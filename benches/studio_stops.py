"""From Esc in a real browser to the end of a drive's output: STOP of the studio, end to end.

The virtual device's own account says when its output went off; the browser says when the key was
pressed. Needs the extra `studio`, selenium, chromium and chromedriver.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from collections.abc import Callable
from typing import Any

from selenium.webdriver.common.keys import Keys

from sewfast.link import VirtualDevice
from sewfast_studio import Project, Studio
from studio import browser, spread

LISTEN = """
window.pressed = [];
addEventListener("keydown", e => {
  if (e.key === "Escape") window.pressed.push(performance.timeOrigin + e.timeStamp);
}, { capture: true });
"""
WATCHDOG_MS = "2000"
"""What ends the output here is the key, also on a busy computer."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--trials", type=int, default=50)
    trials = parser.parse_args().trials
    with tempfile.TemporaryDirectory() as folder, VirtualDevice() as device:
        # the device's clock began a little earlier, so that no time is told too short
        began = 1e3 * time.time()
        with Studio(Project(folder)) as studio:
            page = browser()
            try:
                arm(page, studio, device)
                taken = [stop(page, device, began) for _ in range(trials)]
            finally:
                page.quit()
    print(json.dumps({"esc_to_output_off": spread(taken)}, indent=1))


def arm(page: Any, studio: Studio, device: VirtualDevice) -> None:
    """Connected, with limits, by clicks."""
    page.get(studio.address)
    port = page.find_element("id", "port")

    def shown() -> bool:
        page.find_element("id", "view-drive").click()
        return bool(port.is_displayed())

    until(shown)
    port.clear()
    port.send_keys(device.port)
    page.execute_script("document.querySelector('#drive details').open = true")
    page.find_element("id", "watchdog").send_keys(WATCHDOG_MS)
    press(page, "connect")
    press(page, "limits")
    until(lambda: "in time" in page.find_element("id", "prompt").text)
    page.find_element("css selector", "#signal option[value=random]").click()
    page.execute_script(LISTEN)


def stop(page: Any, device: VirtualDevice, began: float) -> float:
    """Milliseconds from the key to the end of the output, in one run."""
    before = len(device.trace())

    def events() -> list[str]:
        return [entry["event"] for entry in device.trace()[before:]]

    press(page, "arm")
    press(page, "record")
    until(lambda: "on" in events())
    time.sleep(0.3)
    page.find_element("id", "record-file").send_keys(Keys.ESCAPE)
    until(lambda: "off" in events())
    off = next(e["seconds"] for e in device.trace()[before:] if e["event"] == "off")
    pressed: float = page.execute_script("return window.pressed")[-1]
    until(lambda: "output off" in page.find_element("id", "stopped").text)
    return began + 1e3 * float(off) - pressed


def press(page: Any, name: str) -> None:
    until(lambda: page.find_element("id", name).is_enabled())
    page.find_element("id", name).click()


def until(true: Callable[[], object], seconds: float = 30.0) -> None:
    end = time.monotonic() + seconds
    while not true():
        if time.monotonic() > end:
            raise SystemExit("the page did not get there")
        time.sleep(0.02)


if __name__ == "__main__":
    main()
