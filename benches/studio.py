"""The studio in a real browser: from a slider's event to painted plots, first picture, page bytes,
zoom and pan of long curves, from the command to the page's numbers.

Four members, 4,000 samples a loop; four linked pictures of 100,000 samples. Needs the extra
`studio`, selenium, chromium and chromedriver.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from selenium.webdriver.common.keys import Keys

from sewfast_studio import Project, Studio, make_demo
from sewfast_studio.server import PAGE

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests" / "support"))
from chromium import open_browser

PRESSES = 150
DRAG_EVENTS = 300
BETWEEN_PRESSES = 0.06
"""Seconds."""
SAMPLES = 1000
"""After the step; four times as many are simulated."""

DRAG = """
const slider = document.getElementById("knob-Kp"), done = arguments[0];
let k = 0;
const next = () => {
  slider.value = .5 + .3 * Math.sin(k / 20);
  slider.dispatchEvent(new Event("input"));
  if (++k < %d) requestAnimationFrame(next); else setTimeout(done, 500);
};
requestAnimationFrame(next);
"""
ZOOM = """
const done = arguments[0], pictures = %d, n = 100000, all = n / 1000;
import("/curves.js").then(async ({ Chart }) => {
  document.body.innerHTML = '<main class="linked" style="grid-column: 1 / -1"></main>';
  const x = Float64Array.from({ length: n }, (_, k) => k / 1000);
  const charts = [1, 2, 3, 4].map(c => {
    const y = x.map(t => Math.sin(c * t) + .3 * Math.sin(37 * c * t) + Math.random() - .5);
    const chart = new Chart(document.querySelector("main"), { y: `channel ${c} [RPM]` });
    chart.draw([{ name: "", x, y, style: c - 1 }], "");
    return chart;
  });
  await new Promise(drawn => setTimeout(drawn, 500));
  let k = 0, began = performance.now(), last = began;
  const work = [], gaps = [];
  const next = () => {
    const now = performance.now();
    gaps.push(now - last); last = now;
    // a zoom in and out, and a pan, at once
    const wide = all * (.55 + .44 * Math.cos(k / 10));
    const from = (all - wide) * (.5 + .5 * Math.sin(k / 17));
    charts[0].window(from, from + wide);
    // a pixel that is read is painted by then
    for (const c of charts) c.canvas.getContext("2d").getImageData(0, 0, 1, 1);
    work.push(performance.now() - now);
    if (++k < pictures) return requestAnimationFrame(next);
    done({ rate: pictures * 1e3 / (performance.now() - began), work, gaps: gaps.slice(1) });
  };
  requestAnimationFrame(next);
});
"""
PICTURES = 300
LISTEN = "window.taken = []; document.addEventListener('drawn', e => window.taken.push(e.detail));"
FIRST = "return performance.getEntriesByName('first-contentful-paint')[0].startTime"
BYTES = """
return performance.getEntriesByType('resource').reduce((n, e) => n + e.decodedBodySize, 0)
  + performance.getEntriesByType('navigation')[0].decodedBodySize;
"""


def browser() -> Any:
    return open_browser(1600, 1000)


def spread(values: Any) -> dict[str, float]:
    found = np.asarray(values)
    return {
        "n": len(found),
        "median_ms": round(float(np.median(found)), 1),
        "p95_ms": round(float(np.quantile(found, 0.95)), 1),
        "max_ms": round(float(found.max()), 1),
    }


def main() -> None:
    with tempfile.TemporaryDirectory() as folder:
        make_demo(folder)
        project = Project(folder, demo=True)
        tuning = project.tuning("drive.json")
        tuning.steps = replace(tuning.steps, samples=SAMPLES)
        moves = []
        for k in range(PRESSES):
            began = time.perf_counter()
            tuning.move({"Kp": tuning.start.gains.Kp * (1.0 + 0.002 * k)})
            moves.append(1e3 * (time.perf_counter() - began))
        with Studio(project) as studio:
            page = browser()
            try:
                found = {"server": spread(moves), **measured(page, studio)}
                found["zoom"] = zoomed(page)
                found["start_s"] = [started(page) for _ in range(5)]
            finally:
                page.quit()
    print(json.dumps(found, indent=1))


def measured(page: Any, studio: Studio) -> dict[str, Any]:
    began = time.perf_counter()
    page.get(studio.address)
    while not page.execute_script("return document.querySelectorAll('#numbers td').length"):
        time.sleep(0.01)
    numbers = time.perf_counter() - began
    time.sleep(2.0)
    page.execute_script(LISTEN)
    slider = page.find_element("id", "knob-Kp")
    for k in range(PRESSES):
        slider.send_keys(Keys.ARROW_RIGHT if k // 25 % 2 == 0 else Keys.ARROW_LEFT)
        time.sleep(BETWEEN_PRESSES)
    time.sleep(1.0)
    keys = page.execute_script("return window.taken.splice(0)")
    page.set_script_timeout(60)
    page.execute_async_script(DRAG % DRAG_EVENTS)
    drag = page.execute_script("return window.taken.splice(0)")
    return {
        "key": spread(keys),
        "drag": spread(drag),
        "first_paint_ms": page.execute_script(FIRST),
        "numbers_after_s": round(numbers, 2),
        "page_bytes": page.execute_script(BYTES),
        "files": len(PAGE),
    }


def zoomed(page: Any) -> dict[str, Any]:
    """Zoom and pan of four linked pictures, each with 100,000 samples."""
    found = page.execute_async_script(ZOOM % PICTURES)
    return {
        "pictures_a_second": round(found["rate"], 1),
        "painted": spread(found["work"]),
        "between": spread(found["gaps"]),
    }


def started(page: Any) -> float:
    """From the command to the numbers of a controller, in a browser that is open [s]."""
    with tempfile.TemporaryDirectory() as folder:
        make_demo(folder)
        command = [sys.executable, "-m", "sewfast", "studio", "drive.json", "--no-browser"]
        began = time.perf_counter()
        with subprocess.Popen(command, cwd=folder, stdout=subprocess.PIPE, text=True) as studio:
            assert studio.stdout is not None
            page.get(studio.stdout.readline().strip())
            while not page.execute_script("return document.querySelectorAll('#numbers td').length"):
                time.sleep(0.01)
            took = time.perf_counter() - began
            studio.terminate()
    return round(took, 2)


if __name__ == "__main__":
    main()
