"""The studio's views in a notebook: a real kernel's messages, and the module in a real browser."""

from __future__ import annotations

import base64
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import sewfast
from moments import until
from sewfast_studio.project import looked_at

pytest.importorskip("anywidget")

from sewfast_studio import widgets

MOVE = {"Kp": 0.03, "Ti": 0.07}

CELL = """
import sewfast
from sewfast_studio.widgets import tune_view, look_view
view = tune_view({model!r})
view
"""


class Kernel:
    """A kernel as a notebook's front end sees it."""

    def __init__(self) -> None:
        manager = pytest.importorskip("jupyter_client.manager")
        pytest.importorskip("ipykernel")
        self.manager, self.client = manager.start_new_kernel(kernel_name="python3")

    def __enter__(self) -> Kernel:
        return self

    def __exit__(self, *error: object) -> None:
        self.client.stop_channels()
        self.manager.shutdown_kernel(now=True)

    def execute(self, code: str) -> None:
        self.client.execute(code)

    def hear(self, wanted: Any, seconds: float = 60.0) -> Any:
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            message = self.client.get_iopub_msg(timeout=end - time.monotonic())
            assert message["msg_type"] != "error", message["content"]["traceback"]
            if wanted(message):
                return message
        raise AssertionError("it was not heard")

    def ask(self, comm: str, number: int, do: str, **asked: Any) -> Any:
        content = {"method": "custom", "content": {"id": number, "do": do, **asked}}
        message = self.client.session.msg("comm_msg", {"comm_id": comm, "data": content})
        self.client.shell_channel.send(message)
        return self.hear(
            lambda m: (
                m["msg_type"] == "comm_msg"
                and m["content"]["data"].get("content", {}).get("id") == number
            )
        )


@pytest.mark.nightly("starts a kernel of Jupyter")
def test_sliders_in_a_real_kernel(demo: Path) -> None:
    model = sewfast.load_model(demo / "drive.json")
    with Kernel() as kernel:
        kernel.execute(CELL.format(model=str(demo / "drive.json")))
        opened = kernel.hear(
            lambda m: m["msg_type"] == "comm_open" and "_esm" in m["content"]["data"]["state"]
        )
        comm = opened["content"]["comm_id"]
        esm = opened["content"]["data"]["state"]["_esm"]
        assert "import " not in esm.split("const DASHES")[1].split("\n")[0]
        asked = {"model": "drive.json", "values": MOVE}
        answer = kernel.ask(comm, 1, "tune_move", **asked)
        content = answer["content"]["data"]["content"]
        curves = np.frombuffer(answer["buffers"][0], "<f4")
        assert len(curves) == sum(n for _, n in content["curves"])
        kernel.execute("print(view.controller().gains)")
        printed = kernel.hear(lambda m: m["msg_type"] == "stream")["content"]["text"]
        assert "0.03" in printed
        refused = kernel.ask(comm, 2, "drive_connect", port="virtual")
        assert "step of the view" in refused["content"]["data"]["content"]["error"]
        search = {"evaluations": 20, "seed": 0}
        kernel.ask(comm, 3, "tune_search", **asked, **search)
        found = kernel.hear(
            lambda m: (
                m["msg_type"] == "comm_msg"
                and m["content"]["data"].get("content", {}).get("event") == "searched"
            )
        )["content"]["data"]["content"]["found"]
    start = widgets.tune_view(demo / "drive.json").controller().with_values(MOVE, "by hand")
    direct = sewfast.tune(model, start=start, **search)
    assert found["cost"] == pytest.approx(direct.cost, rel=1e-12)


class Shown:
    """A view in a browser: its messages go to and fro by the driver."""

    def __init__(self, browser: Any, view: Any, place: Path) -> None:
        self.browser, self.view = browser, view
        module = view._esm.replace("export default", "window.view =")
        page = place / "notebook.html"
        page.write_text(
            "<!doctype html><html lang=en><meta charset=utf-8><title>notebook</title><div id=cell>"
            f"</div><script type=module>{module}</script>",
            encoding="utf-8",
        )
        view.send = self.hear
        browser.get(page.as_uri())
        until(lambda: browser.execute_script("return !!window.view"))
        browser.execute_script(
            "window.sent = []; view.render({ el: document.getElementById('cell'), model: {"
            " on: (_, heard) => { window.heard = heard; }, send: m => window.sent.push(m) } })"
        )

    def hear(self, content: dict[str, Any], buffers: list[bytes] | None = None) -> None:
        data = base64.b64encode(b"".join(buffers or [])).decode()
        self.browser.execute_script(
            "heard(arguments[0], [new DataView(Uint8Array.from(atob(arguments[1]), "
            "c => c.charCodeAt(0)).buffer)])",
            content, data,
        )  # fmt: skip

    def passed_on(self) -> bool:
        for message in self.browser.execute_script("return window.sent.splice(0)"):
            self.view._handle_custom_msg(message, [])
        return True

    def at(self, selector: str) -> Any:
        root = "return document.getElementById('cell').shadowRoot.querySelector(arguments[0])"
        return self.browser.execute_script(root, selector)


@pytest.mark.alone
def test_the_sliders_in_a_notebook_s_page(demo: Path, tmp_path: Path, browser: Any) -> None:
    shown = Shown(browser, widgets.tune_view(sewfast.load_model(demo / "drive.json")), tmp_path)
    until(lambda: shown.passed_on() and "Ms" in shown.at("#numbers").text)
    before = shown.at("#numbers").text
    shown.at("[id=knob-Kp]").send_keys("\ue014" * 5)
    until(lambda: shown.passed_on() and shown.at("#numbers").text != before)
    value = float(shown.at("[id=knob-Kp-value]").get_attribute("value"))
    near = pytest.approx(value, rel=1e-4)
    until(lambda: shown.passed_on() and shown.view.controller().gains.Kp == near)
    wide = "return document.documentElement.scrollWidth - innerWidth"
    assert browser.execute_script(wide) <= 0
    assert [e for e in browser.get_log("browser") if e["level"] == "SEVERE"] == []


@pytest.mark.alone
def test_a_look_in_a_notebook_s_page(folder: Path, tmp_path: Path, browser: Any) -> None:
    data = sewfast.read(folder / "run.csv", inputs="u", output="y")
    shown = Shown(browser, widgets.look_view(data), tmp_path)
    until(lambda: shown.passed_on() and shown.at("#summary").text)
    assert shown.at("#summary").text.split() == looked_at(data)["text"].split()
    count = "return document.getElementById('cell').shadowRoot.querySelectorAll('canvas').length"
    assert browser.execute_script(count) == 2


def test_a_missing_package_is_named(demo: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(__import__("sys").modules, "anywidget", None)
    with pytest.raises(sewfast.SettingError, match=r"sewfast\[notebook\]"):
        widgets.tune_view(demo / "drive.json")
