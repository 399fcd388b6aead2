"""Whether a source archive has every file that the extension was compiled from, as it stands here.

python packaging/archive.py ARCHIVE DEPENDENCIES

DEPENDENCIES is the file with the ending .d that cargo writes beside a library: all sources of the
crate and of those it takes from this folder.
"""

from __future__ import annotations

import re
import sys
import tarfile
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
ALSO = ("pyproject.toml", "Cargo.toml", "Cargo.lock", "README.md", *Path(ROOT).glob("LICENSE*"))


def sources(dependencies: Path) -> set[Path]:
    """Files of this folder that are named behind the colon, relative to it."""
    _, _, listed = dependencies.read_text().partition(":")
    found = (Path(name.replace("\\ ", " ")) for name in re.split(r"(?<!\\)\s+", listed.strip()))
    return {path.relative_to(ROOT) for path in found if path.is_relative_to(ROOT)}


def package() -> set[Path]:
    folder = ROOT / "python"
    made = {"__pycache__", "_core.abi3.so"}
    return {p.relative_to(ROOT) for p in folder.rglob("*") if p.is_file() and not made & {*p.parts}}


def main(archive: str, dependencies: str) -> int:
    compiled = sources(Path(dependencies))
    manifests = {Path(*path.parts[:2], "Cargo.toml") for path in compiled}
    also = {(ROOT / name).relative_to(ROOT) for name in ALSO}
    if not compiled:
        raise SystemExit(f"expected sources in {dependencies}, got none: compile the core first")
    with tarfile.open(archive) as files:
        inside = {Path(*Path(m.name).parts[1:]): m for m in files.getmembers() if m.isfile()}
        wrong = []
        for path in sorted(compiled | manifests | package() | also):
            member = inside.get(path)
            content = files.extractfile(member).read() if member else None  # type: ignore[union-attr]
            changed = path.suffix != ".toml" and content != (ROOT / path).read_bytes()
            if content is None or changed:
                wrong.append(f"{path}: {'missing' if content is None else 'another content'}")
    print("\n".join(wrong) or f"{archive}: whole, {len(compiled)} sources of the core")
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
