"""The documentation does what it says: its snippets run, its site is whole and works offline."""

from __future__ import annotations

import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

from cli import PROGRAM, environment
from documents import Block, blocks

ROOT = Path(__file__).resolve().parents[1]
PAGES = [ROOT / "README.md", *sorted(ROOT.glob("docs/*.md"))]
_URL = r"""=["']?(?:https?:)?//"""
_ELSEWHERE = (
    rf"<(?:script|img|iframe)\b[^>]*\ssrc{_URL}"
    rf"|<link\b(?=[^>]*\srel=[\"']?(?:stylesheet|preconnect|preload))[^>]*\shref{_URL}"
)
"""Tags that would load something from the network."""
RUN = [p for p in PAGES if any(b.language in ("python", "console") for b in blocks(p))]


@pytest.mark.parametrize("page", RUN, ids=lambda p: p.stem)
def test_page_runs(
    page: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, request: pytest.FixtureRequest
) -> None:
    """Every snippet of a page, in order, in one folder and one namespace."""
    if "SEWFAST_DATA" in page.read_text(encoding="utf-8"):
        request.getfixturevalue("recordings")
    monkeypatch.chdir(tmp_path)
    names: dict[str, object] = {"__name__": page.stem}
    for block in blocks(page):
        if block.language == "python":
            _execute(block, page, names)
        for command in block.commands if block.language == "console" else ():
            _run(command, page)


def _execute(block: Block, page: Path, names: dict[str, object]) -> None:
    # the blank lines make a traceback point into the page
    exec(compile("\n" * (block.line - 1) + block.text, str(page), "exec"), names)


def _run(command: str, page: Path) -> None:
    program, *arguments = shlex.split(os.path.expandvars(command))
    assert program == "sewfast", f"{page}: only sewfast is run here, not {command!r}"
    done = subprocess.run([*PROGRAM, *arguments], env=environment(), capture_output=True, text=True)
    assert done.returncode == 0, f"{page}: {command}\n{done.stderr}"


def test_pages_have_snippets() -> None:
    assert {p.stem for p in RUN} >= {"README", "tutorial", "cli", "real-data"}


@pytest.mark.parametrize("page", PAGES, ids=lambda p: p.stem)
def test_links_of_a_page_lead_somewhere(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    for target in re.findall(r"\]\(([^)#]+)[^)]*\)", text):
        if not target.startswith("https://"):
            assert (page.parent / target).exists(), f"{page}: {target}"


def test_site_builds_and_loads_nothing_from_elsewhere(tmp_path: Path) -> None:
    pytest.importorskip("mkdocs", reason="needs the docs extra")
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
