"""Pages of the built site that are wider than their column at 1,280 pixels, and its search without
a network, in a real browser.

make docs && python benches/site.py
python benches/site.py --shots target/shots      pictures of every page as well
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from selenium import webdriver
from selenium.webdriver.support.ui import WebDriverWait

ROOT = Path(__file__).resolve().parents[1]
SITE = ROOT / "site"
WIDE = """
return [...document.querySelectorAll('pre code, pre, table, .formula, img, p, math')]
  .filter(e => e.clientWidth > 0 && e.scrollWidth > e.clientWidth + 1)
  .map(e => e.tagName + ' ' + (e.scrollWidth - e.clientWidth) + ' '
    + e.textContent.trim().split('\\n').reduce((a, b) => a.length > b.length ? a : b, ''))
"""
PAGE = "return document.documentElement.scrollWidth - document.documentElement.clientWidth"


SOUGHT = {"notch": "bode.html", "time_ms": "data-preparation.html", "watchdog": "first-run.html"}
"""Words, and a page that must be among those that the search finds for each."""
FOUND = "return [...document.querySelectorAll('.md-search-result__link')].map(e => e.href)"


def searched(driver: webdriver.Chrome, word: str) -> list[str]:
    """Names of the pages that the site's own search finds."""
    driver.get((SITE / "index.html").as_uri())
    field = driver.find_element("css selector", ".md-search__input")
    field.click()
    field.send_keys(word)
    WebDriverWait(driver, 60).until(lambda d: d.execute_script(FOUND))
    links = driver.execute_script(FOUND)
    return sorted({link.rpartition("/")[2].partition("?")[0].partition("#")[0] for link in links})


def browser(width: int) -> webdriver.Chrome:
    options = webdriver.ChromeOptions()
    for option in ("--headless=new", "--no-sandbox", f"--window-size={width},1000"):
        options.add_argument(option)
    return webdriver.Chrome(options=options)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--width", type=int, default=1280)
    parser.add_argument("--shots", type=Path, help="folder for pictures")
    parser.add_argument("pages", nargs="*", help="names without .html; default: all")
    args = parser.parse_args()
    driver = browser(args.width)
    wide = 0
    try:
        for page in sorted(SITE.glob("*.html")):
            if page.stem == "404" or (args.pages and page.stem not in args.pages):
                continue
            driver.get(page.as_uri())
            found, beyond = driver.execute_script(WIDE), driver.execute_script(PAGE)
            wide += bool(found or beyond > 0)
            print(f"{page.stem}: {len(found)} wide, page {beyond} px beyond its window")
            for text in found[:8]:
                print(f"    {text[:100]}")
            if args.shots is not None:
                args.shots.mkdir(parents=True, exist_ok=True)
                driver.save_screenshot(str(args.shots / f"{page.stem}.png"))
        lost = 0
        for word, page_of_it in SOUGHT.items():
            pages = searched(driver, word)
            lost += page_of_it not in pages
            print(f"search for {word!r}: {', '.join(pages)}")
    finally:
        driver.quit()
    print(f"{wide} pages with something wider than its column; {lost} words not found")
    return min(wide + lost, 1)


if __name__ == "__main__":
    sys.exit(main())
