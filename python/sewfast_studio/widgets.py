"""Two views of the studio in a notebook: the sliders of a controller, and a look at a data set.

Both use the page's own modules; the kernel's messages replace the page's socket, and the same steps
answer them.
"""

from __future__ import annotations

import re
import tempfile
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from sewfast.errors import SettingError, not_installed

from .jobs import Jobs, Steps
from .project import Project
from .requests import MODEL
from .session import checked, finite
from .words import error_text

if TYPE_CHECKING:
    from sewfast.control.controller import Controller
    from sewfast.dataset import Dataset
    from sewfast.models import Model

START = "start.json"
ALLOWED = (
    "tune_open",
    "tune_move",
    "tune_judge",
    "tune_verdict",
    "tune_search",
    "tune_front",
    "tune_save",
    "tune_copy",
    "cancel",
)
"""Messages allowed in a notebook."""

_TUNE = """
export default { render({ model, el }) {
  const { root, ask, on } = connect(model, el, HTML, CSS);
  root.getElementById("tune").hidden = false;
  mount(root, { ask, on });
  ask("state");
} };
"""
_LOOK = """
export default { render({ model, el }) {
  const { root, on, ask } = connect(model, el, HTML, CSS);
  on("look", m => showLook(root, m.found));
  ask("look");
} };
"""


def tune_view(model: Model | str | Path, start: Controller | None = None) -> Any:
    """The studio's step Tune below a notebook's cell.

    Parameters
    ----------
    model : Model or path
        With a path, controllers are saved next to it and the copies name it; otherwise both are in
        a temporary folder that is deleted with the kernel.
    start : Controller, optional
        By default the first controller of `sewfast.tune`.

    Returns
    -------
    anywidget.AnyWidget
        Its method `controller()` returns the controller at the present sliders.

    Raises
    ------
    SettingError
        If anywidget is not installed, or for a model or controller that cannot be tuned.

    Examples
    --------
    >>> view = tune_view(model)  # doctest: +SKIP
    >>> view  # doctest: +SKIP
    >>> view.controller().save("controller.json")  # doctest: +SKIP
    """
    folder: tempfile.TemporaryDirectory[str] | None = None
    if isinstance(model, (str, Path)):
        place = Path(model).resolve()
    else:
        folder = tempfile.TemporaryDirectory(prefix="sewfast-")
        place = Path(folder.name).resolve() / MODEL
        model.save(place)
    project = Project(place)
    if start is not None:
        start.save(place.parent / START)
    first = START if start is not None else None
    project.tuning(place.name, first)  # refuses before anything is drawn

    view = _widget(_source(("curves", "tell", "tune", "widget"), _TUNE, _fragment("tune")))
    latest: dict[str, Any] = {"model": place.name, "controller": first}

    def tell(event: dict[str, Any]) -> None:
        view.send(finite(event))

    steps = Steps(project, Jobs(project.folder, tell))

    def answer(asked: dict[str, Any]) -> Any:
        if asked.get("do") == "state":
            state = project.state()
            named = [START] if first else []
            others = [name for name in state["controllers"] if name not in named]
            tell({
                "event": "state", **state, "writes": True, "pages": 1, "first": place.name,
                "controllers": [*named, *others], "start": first,
            })  # fmt: skip
            return None
        fields = checked(asked)
        if asked["do"] not in ALLOWED:
            raise SettingError(f"expected a step of the view, received {asked['do']!r}")
        if asked["do"] == "tune_move":
            latest.update(fields)
        return steps.do(asked["do"], fields)

    def controller() -> Controller:
        tuning = project.tuning(
            latest["model"], latest["controller"],
            tuple(tuple(row) for row in latest.get("notches", ())),
        )  # fmt: skip
        return tuning.controller(latest.get("values", {}))

    view.on_msg(lambda _, asked, __: _reply(view, asked, answer))
    view.controller = controller
    view.folder = folder  # kept for as long as the view
    return view


def look_view(data: Dataset) -> Any:
    """The signals of a data set with advice, as in the studio's step Look.

    Parameters
    ----------
    data : Dataset

    Returns
    -------
    anywidget.AnyWidget

    Raises
    ------
    SettingError
        If anywidget is not installed.
    """
    from .project import looked_at

    html = '<div class="results"><div id="signals" class="linked"></div><ul id="advice"></ul>'
    html += '<details id="summary-fold" open hidden><summary>All figures</summary>'
    html += '<pre id="summary"></pre></details></div>'
    view = _widget(_source(("curves", "tell", "look", "widget"), _LOOK, html))
    found = looked_at(data)

    def answer(_: dict[str, Any]) -> None:
        view.send(finite({"event": "look", "found": found}))

    view.on_msg(lambda _, asked, __: _reply(view, asked, answer))
    return view


def _reply(view: Any, asked: Any, answer: Any) -> None:
    number = asked.get("id") if isinstance(asked, dict) else None
    try:
        if not isinstance(asked, dict):
            raise SettingError("expected an object")
        found = answer(asked)
    except Exception as e:
        view.send({"id": number, "error": error_text(e)})
        return
    if not isinstance(found, tuple):
        view.send(finite({"id": number, "found": found}))
        return
    head, curves = found
    rows = [np.asarray(values, dtype="<f4") for values in curves.values()]
    names = [[name, len(row)] for name, row in zip(curves, rows, strict=True)]
    message = finite({"id": number, "found": head, "curves": names})
    view.send(message, [np.concatenate(rows).tobytes()])


def _widget(source: str) -> Any:
    try:
        import anywidget
    except ImportError as e:
        raise not_installed("anywidget", "a view in a notebook", "sewfast[notebook]") from e
    return anywidget.AnyWidget(_esm=source)


def _page(name: str) -> str:
    return (files(__package__) / "page" / name).read_text(encoding="utf-8")


def _fragment(view: str) -> str:
    """The elements of a view, from the page."""
    page = _page("index.html")
    start = page.index(f'<div id="{view}" class="view"')
    return page[start : page.index('\n<div id="', start + 1)]


def _source(modules: tuple[str, ...], render: str, html: str) -> str:
    """Several modules as one for a notebook: without imports, with the elements as text."""
    import json

    sheet = (files("sewfast") / "design.css").read_text(encoding="utf-8")
    css = (sheet + _page("studio.css")).replace(":root", ":host")
    parts = [re.sub(r"(?m)^import .*\n", "", _page(f"{name}.js")) for name in modules]
    parts = [re.sub(r"(?m)^export ", "", part) for part in parts]
    constants = f"const HTML = {json.dumps(html)}, CSS = {json.dumps(css)};"
    return "\n".join([constants, *parts, render])
