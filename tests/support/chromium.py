"""A browser without a window, for tests of pages, their screens and benchmarks."""

from __future__ import annotations

import shutil
from typing import Any


def is_here() -> bool:
    """Whether there is a browser and its driver."""
    return shutil.which("chromium") is not None and shutil.which("chromedriver") is not None


def open_browser(width: int, height: int) -> Any:
    """A new browser that keeps the messages of its pages."""
    from selenium import webdriver

    options = webdriver.ChromeOptions()
    options.binary_location = str(shutil.which("chromium"))
    size = f"--window-size={width},{height}"
    for argument in ("--headless=new", "--no-sandbox", "--disable-gpu", size):
        options.add_argument(argument)
    options.set_capability("goog:loggingPrefs", {"browser": "ALL"})
    service = webdriver.ChromeService(executable_path=shutil.which("chromedriver"))
    return webdriver.Chrome(options=options, service=service)
