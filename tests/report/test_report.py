"""The report: one page from a result folder, verdicts from numbers, damage refused by name."""

import base64
import hashlib
import html
import json
import re
import shutil
from collections.abc import Callable
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import result_folder
from fitted import made
from moments import until
from sewfast.errors import DataError, ModelFileError, SewfastError
from sewfast.plotting import thin
from sewfast.report import report
from sewfast.report.artefacts import load
from sewfast.report.page import goals
from sewfast.tables import significant

PAPER_FIGURES = [*range(2, 6), *range(7, 16), *range(19, 23)]
VOID = {"meta", "link", "br", "img", "input", "hr"}


def with_report(folder: Path) -> None:
    report(result_folder.make(folder / "demo"))


@pytest.fixture(scope="module")
def original() -> Path:
    return made(with_report) / "demo"


@pytest.fixture(scope="module")
def page(original: Path) -> str:
    return (original / "report.html").read_text(encoding="utf-8")


@pytest.fixture
def folder(original: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(original, tmp_path / "demo"))


def change(folder: Path, path: str, value: object) -> None:
    """Set one value of `results.json` by its dotted path; a value of None deletes the key."""
    file = folder / "results.json"
    document = json.loads(file.read_text())
    *parents, last = path.split(".")
    inner = document
    for key in parents:
        inner = inner[key]
    if value is None:
        del inner[last]
    else:
        inner[last] = value
    file.write_text(json.dumps(document))


class Structure(HTMLParser):
    """Collects identifiers and references; fails where tags do not nest."""

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.ids: list[str] = []
        self.targets: list[str] = []
        self.loaded: list[str] = []
        self.figures: list[list[str]] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.handle_startendtag(tag, attrs)
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        for name, value in attrs:
            if name == "id":
                self.ids.append(value or "")
            elif name in ("href", "xlink:href") and (value or "").startswith("#"):
                self.targets.append((value or "")[1:])
            elif name in ("src", "href", "xlink:href", "data"):
                self.loaded.append(value or "")
        if tag == "svg":
            self.figures.append([name for name, value in attrs if value])

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag


@pytest.fixture(scope="module")
def structure(page: str) -> Structure:
    parsed = Structure()
    parsed.feed(page)
    return parsed


@pytest.mark.parametrize("number", PAPER_FIGURES)
def test_every_figure_of_the_paper_is_there_under_its_number(number: int, page: str) -> None:
    figure = re.search(rf'<figure id="fig-{number}">.*?</figure>', page, flags=re.DOTALL)
    assert figure is not None
    assert f"<b>Fig. {number}</b>" in figure[0]
    assert figure[0].count("<path") > 5


def test_the_page_is_whole_and_needs_nothing_else(page: str, structure: Structure) -> None:
    assert structure.open == []
    assert structure.loaded == []
    assert page.count("<script") == 1
    assert "url(http" not in page
    assert "@import" not in page
    assert len(page.encode()) < 5_000_000


def test_identifiers_are_unique_and_every_reference_leads_somewhere(structure: Structure) -> None:
    assert len(structure.ids) == len(set(structure.ids))
    assert set(structure.targets) <= set(structure.ids)


def test_the_first_screen_has_the_verdict_and_the_picture_of_the_loop(page: str) -> None:
    verdict, picture = page.index("erified</span> On the trap"), page.index('<figure id="opening">')
    assert page.index("<h1>") < verdict < picture < page.index('id="summary"')


def test_every_figure_says_in_words_what_it_shows(structure: Structure) -> None:
    assert len(structure.figures) > len(PAPER_FIGURES)
    assert all({"role", "aria-label"} <= set(names) for names in structure.figures)


def test_a_page_has_no_section_for_what_is_not_in_its_folder(page: str) -> None:
    for title in ("Can the default network be trusted?", "Physical parameters"):
        assert title not in page


def test_the_assumptions_about_the_paper_are_stated(page: str) -> None:
    for word in ("floor", "per sample", "±20 V", "too coarsely", "L/T", "free run", "rest"):
        assert word in page


@pytest.mark.nightly("two more reports")
def test_the_same_artefacts_give_the_same_page(folder: Path, page: str) -> None:
    assert report(folder).read_text(encoding="utf-8") == page


def test_figures_fit_on_a_printed_page(page: str) -> None:
    assert re.search(r"figure[^{]*\{[^}]*break-inside: avoid", page)
    boxes = re.findall(r'viewBox="0 0 ([\d.]{3,}) ([\d.]+)"', page)
    assert boxes
    # A4 less margins is 182 x 267 mm; a caption and a table need room beside the figure
    assert all(float(height) / float(width) < 1.0 for width, height in boxes)


@pytest.mark.parametrize(
    ("path", "value", "word"),
    [
        ("speed.kalman.rmse_rpm", 1.3, "within 1 RPM"),
        ("identification.paper.cost", 1.6e-4, "encoder's floor"),
        ("identification.paper.cost_ideal", 1.1e-4, "without encoder steps"),
        ("identification.oe.random.simulation.fit_percent", 94.0, "95 %"),
        ("identification.neural_oe.random.simulation.rmse_rpm", 18.5, "no worse"),
        ("identification.oe_all.random.simulation.rmse_rpm", 5.9, "no worse"),
        ("identification.neural_oe.saturating.simulation.rmse_rpm", 9.1, "half"),
        ("paper_gains.eq8.rise_time_ms", 201.0, "per-sample"),
        ("control.trapezoid.machine.rise_time_ms", 136.0, "rise within 15 ms"),
        ("control.trapezoid.machine.overshoot_percent", 3.1, "overshoot of 3 %"),
        ("control.random.model_vs_machine_rmse_rpm", 15.1, "predicted closed loop"),
        ("seconds", 61.0, "within a minute"),
    ],
)
def test_each_verdict_follows_from_its_number(
    folder: Path, path: str, value: float, word: str
) -> None:
    assert all(g.met for g in goals(load(folder)))
    change(folder, path, value)
    missed = [g for g in goals(load(folder)) if not g.met]
    assert len(missed) == 1
    assert word in missed[0].demand
    assert missed[0].verdict == "not reached"


def test_the_summary_shows_the_network_beside_both_linear_models(page: str) -> None:
    summary = page.split('id="summary"')[1].split("</dl>")[0]
    assert all(value in summary for value in (">6.00", ">18.0", ">20.0"))


@pytest.fixture(scope="module")
def changed(original: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Another folder: a number that is not defined, one that is no other's, text that is markup."""
    folder = Path(shutil.copytree(original, tmp_path_factory.mktemp("changed") / "demo"))
    document = json.loads((folder / "results.json").read_text())
    document["control"]["trapezoid"]["machine"]["rise_time_ms"] = None
    document["control"]["chirp_hi_lo"]["model_vs_machine_rmse_rpm"] = 7.77
    document["machine"] = "<script>alert(1)</script>"
    (folder / "results.json").write_text(json.dumps(document))
    report(folder)
    return folder


@pytest.mark.nightly("another report")
def test_an_undefined_number_is_no_success(changed: Path) -> None:
    verdicts = [g.verdict for g in goals(load(changed))]
    assert verdicts.count("undefined") == 1
    page = (changed / "report.html").read_text(encoding="utf-8")
    assert '<span class="chip warn">undefined</span>' in page
    assert page.count('class="chip bad"') == 1  # the verdict on the whole, and no goal


def test_numbers_of_the_results_stand_on_the_page(changed: Path) -> None:
    page = (changed / "report.html").read_text(encoding="utf-8")
    assert "7.77\N{NO-BREAK SPACE}RPM" in page


def test_text_from_the_results_cannot_become_markup(changed: Path) -> None:
    page = (changed / "report.html").read_text(encoding="utf-8")
    assert "alert(1)" in page
    assert page.count("<script") == 1
    assert "<script>alert" not in page


def test_the_policy_lets_the_page_s_own_script_run_and_no_other(page: str) -> None:
    policy = html.unescape(re.search(r'Security-Policy" content="([^"]*)"', page)[1])  # type: ignore[index]
    (script,) = re.findall(r"<script>(.*?)</script>", page, re.DOTALL)
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    assert f"script-src 'sha256-{digest}'" in policy
    assert policy.startswith("default-src 'none'")
    assert "unsafe-eval" not in policy
    assert re.search(r"script-src[^;]*unsafe-inline", policy) is None


def test_a_picture_zooms_and_goes_back(original: Path, page: str) -> None:
    """In a real browser: a drag enlarges what is within, a double click shows the whole again."""
    webdriver = pytest.importorskip("selenium.webdriver", reason="needs the test extra")
    if shutil.which("chromium") is None or shutil.which("chromedriver") is None:
        pytest.skip("needs chromium and its driver")
    options = webdriver.ChromeOptions()
    for option in ("--headless=new", "--no-sandbox", "--window-size=1280,1000"):
        options.add_argument(option)
    driver = webdriver.Chrome(options=options)
    try:
        driver.get((original / "report.html").resolve().as_uri())
        assert not [e for e in driver.get_log("browser") if "Security" in e["message"]]
        height = "return document.documentElement.scrollHeight"
        assert driver.execute_script(height) < 4000
        driver.execute_script("location.hash = 'fig-19'")  # leads into a chapter that is folded
        until(lambda: driver.find_element("id", "fig-19").is_displayed())
        driver.execute_script(
            "document.querySelectorAll('details').forEach(d => { d.open = true })"
        )
        assert driver.execute_script(height) < 12_000
        picture = driver.find_element("css selector", "figure svg")

        def box() -> str:
            found: str = driver.execute_script(
                "return arguments[0].getAttribute('viewBox')", picture
            )
            return found

        driver.execute_script("arguments[0].scrollIntoView({block: 'center'})", picture)
        whole, size = box(), picture.size
        actions = webdriver.ActionChains(driver)
        actions.move_to_element(picture).click_and_hold().move_by_offset(80, 40).release().perform()
        near = [float(x) for x in box().split()]
        far = [float(x) for x in whole.split()]
        assert 0.05 < near[2] / far[2] < 0.5
        assert near[3] / near[2] == pytest.approx(far[3] / far[2])
        assert picture.size == size
        webdriver.ActionChains(driver).double_click(picture).perform()
        assert box() == whole
    finally:
        driver.quit()


def _remove(path: str) -> Callable[[Path], object]:
    return lambda folder: (folder / path).unlink()


def _overwrite(path: str, content: bytes) -> Callable[[Path], object]:
    return lambda folder: (folder / path).write_bytes(content)


def _without_column(folder: Path) -> None:
    with np.load(folder / "runs/random_machine.npz") as columns:
        kept = {n: columns[n] for n in columns.files if n != "r"}
    np.savez(folder / "runs/random_machine.npz", **kept)


def _with_nan(folder: Path) -> None:
    with np.load(folder / "predictions/random.npz") as columns:
        values = {n: columns[n].copy() for n in columns.files}
    values["oe_simulation"][3] = np.nan
    np.savez(folder / "predictions/random.npz", **values)


def _shorter(folder: Path) -> None:
    with np.load(folder / "predictions/random.npz") as columns:
        np.savez(folder / "predictions/random.npz", **{n: columns[n][:-5] for n in columns.files})


@pytest.mark.parametrize(
    ("damage", "named"),
    [
        (_remove("results.json"), "results.json"),
        (_overwrite("results.json", b'{"format": "sewf'), "results.json"),
        (_overwrite("results.json", b'{"format": "sewfast.results", "version": 9}'), "version"),
        (_overwrite("results.json", b'{"format": "sewfast.model", "version": 1}'), "sewfast.model"),
        (_remove("recordings/random.csv"), "random.csv"),
        (_overwrite("recordings/step.csv", b""), "step.csv"),
        (_overwrite("recordings/step.csv", b"t,u\n0,1\n"), "step.csv"),
        (_remove("runs/paper_gains_eq8.npz"), "paper_gains_eq8.npz"),
        (_overwrite("runs/trapezoid_model.npz", b"PK\x03\x04 cut"), "trapezoid_model.npz"),
        (_without_column, "'r'"),
        (_with_nan, "oe_simulation"),
        (_shorter, "random"),
        (lambda f: change(f, "control.random.machine", None), "control.random.machine"),
        (lambda f: change(f, "fopdt.K", "much"), "fopdt.K"),
        (lambda f: change(f, "gains.tuned", 3), "gains.tuned"),
        (lambda f: change(f, "identification.oe.trained_on", 3), "trained_on"),
    ],
)
def test_damage_is_refused_by_name_and_leaves_no_page(
    folder: Path, damage: Callable[[Path], object], named: str
) -> None:
    (folder / "report.html").unlink(missing_ok=True)
    damage(folder)
    with pytest.raises(SewfastError) as caught:
        report(folder)
    assert named in str(caught.value)
    assert not list(folder.glob("*report.html*"))


@pytest.mark.parametrize("name", ["nowhere", "empty", "file"])
def test_a_folder_without_results_is_refused_by_name(tmp_path: Path, name: str) -> None:
    (tmp_path / "empty").mkdir()
    (tmp_path / "file").write_text("no folder")
    with pytest.raises(DataError, match=f"{name}.*sewfast demo"):
        report(tmp_path / name)


def test_a_missing_value_says_how_to_get_it(folder: Path) -> None:
    with pytest.raises(ModelFileError, match="sewfast demo"):
        load(folder).value("identification.none")


@given(
    st.integers(1, 400).flatmap(
        lambda n: st.tuples(st.just(n), st.lists(st.floats(-1e6, 1e6), min_size=n, max_size=n))
    ),
    st.integers(1, 20),
)
def test_thinning_keeps_extremes_ends_and_order(
    series: tuple[int, list[float]], buckets: int
) -> None:
    n, values = series
    x, y = np.arange(n, dtype=float), np.array(values)
    short_x, short_y = thin(x, y, buckets)
    assert len(short_x) <= max(2 * buckets + 2, 1)
    assert short_y.min() == y.min()
    assert short_y.max() == y.max()
    assert short_x[0] == x[0]
    assert short_x[-1] == x[-1]
    assert np.all(np.diff(short_x) > 0)
    np.testing.assert_array_equal(y[short_x.astype(int)], short_y)


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (1.23456, "1.23"),
        (9.996, "10.0"),
        (1234.5, "1,234"),
        (0.0012, "0.00120"),
        (8e-5, "8.00\N{NO-BREAK SPACE}×\N{NO-BREAK SPACE}10⁻⁵"),
        (-3.0, "−3.00"),
        (0.0, "0"),
        (None, "–"),
        (float("nan"), "–"),
    ],
)
def test_numbers_are_short_and_plain(value: float | None, text: str) -> None:
    assert significant(value) == text
