"""docs/PERFORMANCE.md: writes the tables between its markers from docs/performance.json."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

DOCS = Path(__file__).resolve().parents[1] / "docs"
PAGE, RESULTS = DOCS / "PERFORMANCE.md", DOCS / "performance.json"
COUNTS = Path(__file__).with_name("counts.json")
FIGURES = ("free_run", "training", "neural_ss", "closed_loop", "arx", "machine_speed", "threads")

Results = dict[str, Any]


def ratios(row: Results) -> dict[str, float]:
    """How many times as long as the first contender the others take."""
    clock = f"{row['clock']}_least"
    names = list(row["contenders"])
    first = row["contenders"][names[0]][clock] if names else 1.0
    return {name: row["contenders"][name][clock] / first for name in names[1:]}


def number(value: float) -> str:
    """Three digits."""
    if value >= 1000:
        return f"{value:,.0f}"
    return f"{value:.3g}" if value >= 1 else f"{value:.2g}"


def table(head: list[str], lines: list[list[str]]) -> str:
    """A table of Markdown."""
    rule = ["---"] * len(head)
    return "\n".join("| " + " | ".join(cells) + " |" for cells in (head, rule, *lines))


def machine(results: Results) -> str:
    told = results["machine"]
    versions = ", ".join(f"{name} {v}" for name, v in told["versions"].items())
    return (
        f"Measured on {told['cores']} cores of an {told['processor']} ({told['system']}, "
        f"kernels on {told['level']}; load average {told['load']} at the end), with {versions}."
    )


def _bar(row: Results, name: str) -> str:
    bar = row["bars"].get(name)
    if bar is None:
        return ""
    return f"at most {-bar:g} x" if bar < 0 else f"{bar:,g} x"


def figures(results: Results) -> str:
    """One line per rival."""
    lines = []
    for section in (*FIGURES, "levels"):
        for row in _of(results, section):
            lines += _lines(row)
    head = ["what", "sewfast", "rival", "takes", "times as long", "to reach", "counted limit"]
    return table(head, lines)


def _lines(row: Results) -> list[list[str]]:
    clock, unit = f"{row['clock']}_least", row["unit"]
    names = list(row["contenders"])
    if not names or not names[0].startswith("sewfast"):
        return []
    own = f"**{number(row['contenders'][names[0]][clock])}** {unit}"
    if len(names) == 1:
        return [[row["title"], own, "", "", "", row["wanted"], row["limit"]]]
    lines = []
    for name, ratio in ratios(row).items():
        taken = f"{number(row['contenders'][name][clock])} {unit}"
        wanted = ", ".join(filter(None, (row["wanted"], _bar(row, name))))
        lines.append([row["title"], own, name, taken, f"**{number(ratio)}**", wanted, row["limit"]])
    return lines


def _of(results: Results, section: str) -> list[Results]:
    return [row for row in results["rows"].values() if row["section"] == section]


def details(results: Results, section: str) -> str:
    """Least and median of everybody, and what they reached."""
    lines = []
    for row in _of(results, section):
        for name, found in row["contenders"].items():
            clock = row["clock"]
            reached = ", ".join(_reached(*item) for item in found["reached"].items())
            lines.append(
                [
                    row["title"],
                    name,
                    number(found[f"{clock}_least"]),
                    number(found[f"{clock}_median"]),
                    f"{row['unit']}, {'clock' if clock == 'wall' else 'processor'}",
                    reached,
                ]
            )
    if not lines:
        return ""
    return table(["what", "who", "least", "median", "unit", "reached"], lines)


def _reached(name: str, value: Any) -> str:
    if isinstance(value, list):
        return f"{name} {value[0]:.6g} to {value[-1]:.6g}"
    return f"{name} {value}" if isinstance(value, int) else f"{name} {value:.6g}"


def machine_speed(results: Results) -> str:
    lines = []
    for row in _of(results, "machine_speed"):
        spent = row["contenders"]["sewfast"]["cpu_least"]
        lines.append(
            [row["title"], f"{number(spent)} ms", f"{number(50_000.0 / spent)} x real time"]
        )
    return table(["what", "takes", "speed"], lines) if lines else ""


def seam(results: Results) -> str:
    parts = [details(results, "seam")]
    rows = results["rows"]
    calls = {"core": "`_core.NeuralOE.simulate`", "public": "`model.simulate(data, init=0)`"}
    for call, name in calls.items():
        keys = [f"seam_{call}_{samples}" for samples in (100, 1100)]
        if set(keys) <= rows.keys():
            short, long = (rows[key]["contenders"]["sewfast"]["cpu_least"] for key in keys)
            over = short - 0.1 * (long - short)
            parts.append(
                f"Of a call of {name} on 100 samples, {number(over)} us are not arithmetic (by the "
                "slope to the longer run)."
            )
    if results.get("seam"):
        took = [[f"`{statement}`", number(ms)] for statement, ms in results["seam"].items()]
        parts.append(table(["an interpreter that runs", "from start to exit [ms]"], took))
    if results.get("memory"):
        took = [[name, number(size)] for name, size in results["memory"].items()]
        parts.append(table(["a training with", "memory beyond its data [bytes/sample]"], took))
    return "\n\n".join(filter(None, parts))


def counts() -> str:
    if not COUNTS.exists():
        return ""
    kept = json.loads(COUNTS.read_text())
    lines = [
        [
            kernel,
            *(f"{levels[level]:,.1f}" if level in levels else "" for level in ("avx2", "baseline")),
        ]
        for kernel, levels in kept["kernels"].items()
    ]
    head = ["kernel", "avx2", "baseline"]
    return f"Instructions per sample, rustc {kept['versions']['rustc']}.\n\n{table(head, lines)}"


def write(results: Results) -> None:
    """Puts every table in its place."""
    sections = (
        "free_run",
        "training",
        "neural_ss",
        "closed_loop",
        "arx",
        "threads",
        "growth",
        "levels",
    )
    texts = {section: details(results, section) for section in sections}
    texts |= {"machine": machine(results), "figures": figures(results), "seam": seam(results)}
    texts |= {"machine_speed": machine_speed(results), "counts": counts()}
    page = PAGE.read_text()
    for name, text in texts.items():
        page = placed(page, name, text)
    PAGE.write_text(page)


def placed(page: str, name: str, text: str) -> str:
    """The page with the text between the markers of that name."""
    pattern = re.compile(rf"(<!-- bench: {name} -->\n).*?(<!-- /bench -->)", re.DOTALL)
    if not pattern.search(page):
        raise ValueError(f"expected a marker {name!r} in {PAGE.name}, found none; put it back")
    body = f"\n{text}\n\n" if text else ""
    return pattern.sub(lambda m: m[1] + body + m[2], page)


if __name__ == "__main__":
    write(json.loads(RESULTS.read_text()))
