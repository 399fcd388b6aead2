"""The documentation does what it says: its snippets run, its site is whole and works offline."""

from __future__ import annotations

import itertools
import re
import runpy
import subprocess
import sys
from pathlib import Path

import pytest

from documents import Block, Command, blocks
from sewfast.cli.parser import build_parser
from terminal import Terminal

ROOT = Path(__file__).resolve().parents[2]
BUILD = runpy.run_path(str(ROOT / "docs" / "build.py"))
PAGES = [ROOT / "README.md", *sorted(ROOT.glob("docs/*.md"))]
_URL = r"""=["']?(?:https?:)?//"""
_ELSEWHERE = (
    rf"<(?:script|img|iframe)\b[^>]*\ssrc{_URL}"
    rf"|<link\b(?=[^>]*\srel=[\"']?(?:stylesheet|preconnect|preload))[^>]*\shref{_URL}"
)
"""Tags that would load something from the network."""
RUN = [p for p in PAGES if any(b.language in ("python", "console") for b in blocks(p))]
MINUTES = pytest.mark.nightly("a walk that takes minutes of processor; `examples/` run by day")
LONG = (
    "README", "bode", "choosing-a-model", "cli", "commissioning", "data-preparation", "physics",
    "reading-margins", "real-data", "report-card", "tutorial",
)  # fmt: skip
RUN_WHEN = [pytest.param(p, id=p.stem, marks=MINUTES if p.stem in LONG else ()) for p in RUN]


@pytest.mark.parametrize("page", RUN_WHEN)
def test_page_runs(
    page: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, request: pytest.FixtureRequest
) -> None:
    """Every snippet of a page, in order, in one folder and one namespace."""
    if "SEWFAST_DATA" in page.read_text(encoding="utf-8"):
        request.getfixturevalue("recordings")
    monkeypatch.chdir(tmp_path)
    names: dict[str, object] = {"__name__": page.stem}
    with Terminal(page.name, monkeypatch.setenv) as terminal:
        for block in blocks(page):
            if block.language == "python":
                _execute(block, page, names)
            for command in block.commands if block.language == "console" else ():
                terminal.run(command)


def _execute(block: Block, page: Path, names: dict[str, object]) -> None:
    # the blank lines make a traceback point into the page
    exec(compile("\n" * (block.line - 1) + block.text, str(page), "exec"), names)


@pytest.mark.parametrize(
    ("shown", "printed", "same"),
    [
        ("a b\n", "a  b", True),
        ("a ... d\n", "a b\nc d\n", True),
        ("...\nd\n", "a b\nd\n", True),
        ("a\n", "a b", False),
        ("a.b\n", "axb", False),
        ("a ... d\n", "a b\nc d e\n", False),
    ],
)
def test_what_is_shown_is_compared(shown: str, printed: str, same: bool) -> None:
    assert Command("sewfast", shown).shows(printed) == same


def test_every_command_is_on_its_page() -> None:
    page = (ROOT / "docs" / "cli.md").read_text(encoding="utf-8")
    commands = re.findall(r"<!-- help (\w+) -->", page)
    _, _, listed = build_parser().format_help().partition("COMMAND\n")
    known = re.findall(r"^    (\w+)(?: |$)", listed, re.MULTILINE)
    assert sorted(commands) == sorted(known)


def test_pages_have_snippets() -> None:
    assert {p.stem for p in RUN} >= {"README", "tutorial", "cli", "first-run", "real-data"}


@pytest.mark.parametrize("page", PAGES, ids=lambda p: p.stem)
def test_links_of_a_page_lead_somewhere(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    for target in re.findall(r"\]\(([^)#]+)[^)]*\)", text):
        if not target.startswith("https://"):
            assert (page.parent / target).exists(), f"{page}: {target}"


@pytest.mark.slow("builds the whole site, whose links and anchors are checked so")
def test_site_builds_and_loads_nothing_from_elsewhere(tmp_path: Path) -> None:
    pytest.importorskip("mkdocs", reason="needs the docs extra")
    subprocess.run([sys.executable, ROOT / "docs" / "build.py"], check=True)
    done = subprocess.run(
        [sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet", "-d", str(tmp_path)],
        cwd=ROOT,
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    pages = list(tmp_path.rglob("*.html"))
    assert len(pages) >= 9
    loads = re.compile(_ELSEWHERE)
    for page in pages:
        assert not loads.search(page.read_text(encoding="utf-8")), page
    help_page = (tmp_path / "cli.html").read_text(encoding="utf-8")
    assert "&lt;!-- help" not in help_page
    assert "--counts-per-rev" in help_page
    theory = (tmp_path / "theory.html").read_text(encoding="utf-8")
    assert 'id="equation-2"' in theory
    assert "<mfrac>" in theory
    assert "$$" not in theory
    for name in BUILD["NOTEBOOKS"]:
        assert (tmp_path / "notebooks" / f"{name}.ipynb").is_file()


def test_the_navigation_is_short() -> None:
    """Six groups by task, none with more than twelve entries; every page is in one of them."""
    text = (ROOT / "mkdocs.yml").read_text(encoding="utf-8")
    listed = text[text.index("nav:") : text.index("markdown_extensions:")]
    groups = re.split(r"^  - ", listed, flags=re.MULTILINE)[1:]
    entries = [re.findall(r"(\S+\.md)$", group, re.MULTILINE) for group in groups]
    assert len(groups) <= 12
    assert max(map(len, entries)) <= 12
    assert sorted(itertools.chain(*entries)) == sorted(p.name for p in (ROOT / "docs").glob("*.md"))


@pytest.mark.parametrize("page", PAGES, ids=lambda p: p.stem)
def test_commands_and_code_fit_their_column(page: Path) -> None:
    """A page is 110 characters wide at 1,280 pixels; what is typed is not to be broken there.

    What a command prints goes on below itself (docs/assets/site.css).
    """
    for block in blocks(page):
        typed = "\n".join(_typed(block)) if block.language == "console" else block.text
        for line in typed.splitlines() if block.language in ("console", "python", "sh") else ():
            assert len(line) <= 108, f"{page.name}: {line}"


def test_a_notebook_has_the_code_of_its_page() -> None:
    nbformat = pytest.importorskip("nbformat", reason="needs the docs extra")
    for name in BUILD["NOTEBOOKS"]:
        page = ROOT / "docs" / f"{name}.md"
        made = nbformat.reads(BUILD["notebook"](page.read_text(encoding="utf-8")), 4)
        code = [cell.source for cell in made.cells if cell.cell_type == "code"]
        expected = [
            b.text.rstrip() if b.language == "python" else "\n".join(f"!{c}" for c in _typed(b))
            for b in blocks(page) if b.language in ("python", "console")
        ]  # fmt: skip
        assert code == expected


def _typed(block: Block) -> list[str]:
    return re.findall(r"^\$ ((?:.*\\\n)*.*)$", block.text, re.MULTILINE)


def test_formulas_are_numbered_and_examples_are_left_alone() -> None:
    pytest.importorskip("latex2mathml", reason="needs the docs extra")
    shown = BUILD["complete"]("$$\nx^2 \\tag{7}\n$$\n```text\n$$\ny\n$$\n```\n")
    assert '<div class="formula" id="equation-7"><math' in shown
    assert "(7)</span></div>" in shown
    assert "```text\n$$\ny\n$$\n```" in shown


@pytest.mark.parametrize("left", ["$$x^2$$", "the square $x^2$ of", "the sum $x +\ny$ of"])
def test_a_formula_that_would_stay_latex_is_refused(left: str) -> None:
    with pytest.raises(ValueError, match="formula"):
        BUILD["complete"](f"first\n\n{left}\n")


@pytest.mark.parametrize(
    "other", ["`$$x^2$$` or ``$x$``", "$5 to $9", "\\$x and y\\$", "a $HOME and a $PATH"]
)
def test_other_dollars_stay_as_they_are(other: str) -> None:
    assert BUILD["complete"](f"first {other}\n") == f"first {other}\n"
