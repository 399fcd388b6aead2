"""Writes the site's sources into target/docs, complete: what a builder then reads needs no hooks.

    python docs/build.py [FOLDER]

Pages are copied; `<!-- help COMMAND -->` becomes what `sewfast COMMAND --help` prints,
`<!-- file LANGUAGE PATH from "TEXT" to "TEXT" -->` the lines of a file, and every `$$ .. $$`
MathML, which browsers draw without a script and without a network. A formula that ends with
`\\tag{7}` has its number at the right edge. Some executed pages become notebooks as well. Pictures
are those of docs/assets (`make pictures`).
"""

from __future__ import annotations

import argparse
import os
import re
import shutil
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
SHEET = "python/sewfast/design.css"
NOTEBOOKS = ("tutorial", "data-preparation", "physics")
"""Executed pages that one may want to change and run again."""
_FILE = re.compile(r'^<!-- file (\w+) (\S+)(?: from "(.+)" to "(.+)")? -->$', re.MULTILINE)
_HELP = re.compile(r"^<!-- help(?: (\w+))? -->$", re.MULTILINE)
_FENCED = re.compile(r"^```(\w*)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
_DISPLAY = re.compile(r"^\$\$\n(.*?)\n\$\$$", re.MULTILINE | re.DOTALL)
_INLINE = re.compile(r"\$\$.*|(?<!\\)\$(?=[^\s\d$])[^$]{0,200}(?<=\S)\$(?!\w)")
_CODE = re.compile(r"(`+).*?\1")
_TAG = re.compile(r"\s*\\tag\{(\w+)\}")
_LINK = re.compile(r"\]\((?!https?:|#)([^)]+?)\.md(#[^)]*)?\)")


def main(folder: Path) -> None:
    """Write the whole tree anew; what was in the folder before goes."""
    shutil.rmtree(folder, ignore_errors=True)
    shutil.copytree(ROOT / "docs" / "assets", folder / "assets")
    shutil.copy(ROOT / SHEET, folder / "assets")
    design = (ROOT / "docs" / "design.html").read_text(encoding="utf-8")
    shown = design.replace(f"../{SHEET}", f"assets/{Path(SHEET).name}")
    (folder / "design.html").write_text(shown, encoding="utf-8")
    for page in sorted((ROOT / "docs").glob("*.md")):
        text = page.read_text(encoding="utf-8")
        if page.stem in NOTEBOOKS:
            place = folder / "notebooks" / f"{page.stem}.ipynb"
            place.parent.mkdir(exist_ok=True)
            place.write_text(notebook(text), encoding="utf-8")
            text += f"\nThis page as a notebook: [{place.name}](notebooks/{place.name}).\n"
        try:
            whole = complete(text)
        except ValueError as e:
            raise ValueError(f"{page.name}: {e}") from e
        (folder / page.name).write_text(whole, encoding="utf-8")


def complete(text: str) -> str:
    """A page with its help texts, its files and its formulas."""
    text = _FILE.sub(lambda m: f"```{m[1]}\n{lines_of(m[2], m[3], m[4])}```", text)
    text = _HELP.sub(lambda m: f"```text\n{help_of(m[1])}```", text)
    # a formula within a fence is an example
    parts = re.split(r"(^```.*?^```$)", text, flags=re.MULTILINE | re.DOTALL)
    return "".join(p if p.startswith("```") else _with_formulas(p) for p in parts)


def _with_formulas(prose: str) -> str:
    """Prose with MathML; ValueError where a formula would stay as its LaTeX."""
    prose = _DISPLAY.sub(_formula, prose)
    left = _INLINE.search(_CODE.sub("", prose))
    if left:
        raise ValueError(
            f"{left[0]}: expected a formula between lines of $$; write one inside a line as code, "
            "and a dollar as \\$"
        )
    return prose


def _formula(match: re.Match[str]) -> str:
    from latex2mathml.converter import convert

    latex = match[1]
    tag = _TAG.search(latex)
    shown = convert(_TAG.sub("", latex).strip(), display="block")
    number = f'<span class="number">({tag[1]})</span>' if tag else ""
    anchor = f' id="equation-{tag[1]}"' if tag else ""
    return f'<div class="formula"{anchor}>{shown}{number}</div>'


def lines_of(path: str, first: str | None, end: str | None) -> str:
    """A file of the project, or some of its lines; ValueError where a text is not in it."""
    text = (ROOT / path).read_text(encoding="utf-8")
    if first is None or end is None:
        return text
    start = text.rindex("\n", 0, text.index(first)) + 1
    stop = text.rindex("\n", 0, text.index(end, start)) + 1
    return text[start:stop].rstrip() + "\n"


def help_of(command: str | None) -> str:
    """The help text of one command, or of the program, 88 columns wide and without colour."""
    from sewfast.cli.parser import build_parser

    os.environ.update(COLUMNS="90", NO_COLOR="1")
    parser = build_parser()
    if command is None:
        return parser.format_help()
    groups = (a for a in parser._actions if isinstance(a, argparse._SubParsersAction))
    found: str = next(groups).choices[command].format_help()
    return found


def notebook(text: str) -> str:
    """An executed page as a notebook: its prose, its Python, its commands, in their order."""
    import nbformat
    from nbformat import v4

    cells, at = [], 0
    for fence in [*_FENCED.finditer(text), None]:
        prose = text[at : len(text) if fence is None else fence.start()].strip()
        if prose:
            cells.append(v4.new_markdown_cell(_elsewhere(prose)))
        if fence is None:
            break
        at = fence.end()
        language, body = fence[1], fence[2]
        if language == "python":
            cells.append(v4.new_code_cell(body.rstrip()))
        elif language == "console":
            commands = re.findall(r"^\$ ((?:.*\\\n)*.*)$", body, re.MULTILINE)
            cells.append(v4.new_code_cell("\n".join(f"!{command}" for command in commands)))
        else:
            cells.append(v4.new_markdown_cell(fence[0]))
    made = v4.new_notebook(cells=cells, metadata={"language_info": {"name": "python"}})
    for k, cell in enumerate(made.cells):
        cell["id"] = f"cell-{k}"  # the same page gives the same file
    nbformat.validate(made)
    return str(nbformat.writes(made)) + "\n"


def _elsewhere(prose: str) -> str:
    """Links and pictures as a file sees them that lies in the folder `notebooks`."""
    prose = _LINK.sub(lambda m: f"](../{m[1]}.html{m[2] or ''})", prose)
    return prose.replace("](assets/", "](../assets/")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description="Writes the site's sources.")
    parser.add_argument("folder", nargs="?", type=Path, default=ROOT / "target" / "docs")
    given = parser.parse_args()
    main(given.folder)
