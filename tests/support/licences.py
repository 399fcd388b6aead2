"""Licences of the Rust crates that a wheel holds: `make licences` writes `LICENSE-THIRD-PARTY`.

What is linked into the extension on any platform is listed, with the text under which it is used.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
FILE = ROOT / "LICENSE-THIRD-PARTY"
PREFERRED = ("MIT", "BSD", "APACHE")
"""Where a crate offers several, the shortest text."""
HEAD = """\
The compiled part of sewfast holds code of others: the crates below and Rust's standard library
(https://www.rust-lang.org, MIT or Apache-2.0). Each is named with its licence as it states it, and
with the text under which it is used here.
"""


def linked() -> list[dict[str, Any]]:
    """Packages that are compiled into the extension, sewfast's own left out, in order of names."""
    command = ["cargo", "metadata", "--format-version", "1", "--locked", "--quiet"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True)
    graph = json.loads(done.stdout)
    packages = {p["id"]: p for p in graph["packages"]}
    needs = {
        n["id"]: [d["pkg"] for d in n["deps"] if any(k["kind"] is None for k in d["dep_kinds"])]
        for n in graph["resolve"]["nodes"]
    }
    todo = [i for i, p in packages.items() if p["name"] == "sewfast-python"]
    found: set[str] = set()
    while todo:
        at = todo.pop()
        macro = any("proc-macro" in t["kind"] for t in packages[at]["targets"])
        if at not in found and not macro:
            found.add(at)
            todo += needs[at]
    foreign = (packages[i] for i in found if packages[i]["source"] is not None)
    return sorted(foreign, key=lambda p: (p["name"], p["version"]))


def text_of(package: dict[str, Any]) -> str:
    """The licence's text as the crate brings it."""
    folder = Path(package["manifest_path"]).parent
    names = sorted(n for n in os.listdir(folder) if n.upper().startswith(("LICEN", "UNLICEN")))
    if not names:
        raise SystemExit(f"{package['name']}: expected a file LICENSE*, found none; look it up")
    chosen = (n for wanted in PREFERRED for n in names if wanted in n.upper())
    return (folder / next(chosen, names[0])).read_text(encoding="utf-8")


def written() -> str:
    """The whole file: each text once, below the crates that it covers."""
    covered: dict[str, list[str]] = {}
    for package in linked():
        text = "\n".join(line.rstrip() for line in text_of(package).strip().splitlines())
        title = f"{package['name']} {package['version']} ({package['license']})"
        covered.setdefault(text, []).append(title)
    parts = [
        f"{'-' * 80}\n" + "\n".join(names) + f"\n\n{text}\n" for text, names in covered.items()
    ]
    return "\n".join([HEAD, *parts])


if __name__ == "__main__":
    FILE.write_text(written(), encoding="utf-8")
    print(f"{FILE.name}: {len(linked())} crates", file=sys.stderr)
