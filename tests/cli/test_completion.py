"""`sewfast completion`, and what registries ask of the package's metadata."""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from cli import sewfast as command
from sewfast.cli.parser import build_parser

ROOT = Path(__file__).resolve().parents[2]


def completed(script: Path, folder: Path, *words: str) -> set[str]:
    """What bash offers for the last of the words."""
    line = " ".join(words)
    code = f"""
source {script}
COMP_WORDS=({" ".join(repr(w) for w in words)})
COMP_CWORD={len(words) - 1}
COMP_LINE={line!r}
COMP_POINT={len(line)}
_shtab_sewfast
printf '%s\\n' "${{COMPREPLY[@]}}"
"""
    done = subprocess.run(
        ["bash", "-c", code], cwd=folder, capture_output=True, text=True, check=True
    )
    return set(done.stdout.split())


def test_bash_completes_commands_options_choices_and_files(tmp_path: Path) -> None:
    pytest.importorskip("shtab", reason="needs the extra completion")
    if shutil.which("bash") is None:
        pytest.skip("needs bash")
    script = tmp_path / "script"
    script.write_text(command(tmp_path, "completion", "bash").out)
    folder = tmp_path / "work"
    folder.mkdir()
    (folder / "drive.json").touch()
    assert completed(script, folder, "sewfast", "val") == {"validate"}
    assert "--plot" in completed(script, folder, "sewfast", "validate", "--pl")
    assert completed(script, folder, "sewfast", "completion", "z") == {"zsh"}
    assert "drive.json" in completed(script, folder, "sewfast", "validate", "dr")


def test_other_shells_know_every_command(tmp_path: Path) -> None:
    pytest.importorskip("shtab", reason="needs the extra completion")
    _, _, listed = build_parser().format_help().partition("COMMAND\n")
    known = re.findall(r"^    (\w+)(?: |$)", listed, re.MULTILINE)
    assert "completion" in known
    for shell in ("zsh", "tcsh"):
        script = command(tmp_path, "completion", shell, "--json").json()["script"]
        assert [name for name in known if name not in script] == []


def test_without_shtab_it_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    from sewfast.cli.parser import completion_command
    from sewfast.errors import SettingError

    monkeypatch.setitem(sys.modules, "shtab", None)
    args = build_parser().parse_args(["completion", "bash"])
    with pytest.raises(SettingError, match=r"pip install .sewfast\[completion\]"):
        completion_command(args)


def test_keywords_are_short_enough_for_the_registry_of_crates() -> None:
    manifest = (ROOT / "Cargo.toml").read_text(encoding="utf-8")
    (listed,) = re.findall(r"^keywords = \[(.*)\]$", manifest, re.MULTILINE)
    keywords = re.findall(r'"([^"]*)"', listed)
    assert 0 < len(keywords) <= 5
    assert [k for k in keywords if not re.fullmatch(r"[A-Za-z0-9][\w+-]{0,19}", k)] == []


def test_the_citation_is_of_this_version() -> None:
    citation = (ROOT / "CITATION.cff").read_text(encoding="utf-8")
    manifest = (ROOT / "Cargo.toml").read_text(encoding="utf-8")
    (version,) = re.findall(r'^version = "(.*)"$', manifest, re.MULTILINE)
    assert f"\nversion: {version}\n" in citation
