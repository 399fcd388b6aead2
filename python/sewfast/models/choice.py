"""Why `identify` chose a model, as a table for `print`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

_COLUMNS = 5
_MOST_ROWS = 40


def choice_lines(training: Mapping[str, Any], unit: str) -> list[str]:
    """The candidates with their free-run errors on data not trained on, and the reason."""
    choice = training.get("choice")
    if not isinstance(choice, Mapping):
        return []
    listed = choice.get("candidates")
    listed = listed if isinstance(listed, Sequence) else ()
    candidates = [c for c in listed if isinstance(c, Mapping)][:_MOST_ROWS]
    lines = _table(candidates, choice, unit) if candidates else []
    return [*lines, f"chosen: {choice.get('chosen')}; {choice.get('reason')}"]


def verdict_lines(training: Mapping[str, Any]) -> list[str]:
    """The closing words: good enough to tune on or not, because of what, what to do next."""
    verdict = training.get("verdict")
    if not isinstance(verdict, Mapping):
        return []
    return [f"verdict: {verdict.get('text')}", *(f"  {n}" for n in verdict.get("next", ()))]


def _table(
    candidates: Sequence[Mapping[str, Any]], choice: Mapping[str, Any], unit: str
) -> list[str]:
    heading = f"free-run rmse{f' [{unit}]' if unit else ''} on data not trained on:"
    rows = [_row(c, choice.get("chosen_structure")) for c in candidates]
    widths = [max(len(r[i]) for r in rows) for i in range(_COLUMNS)]
    padded = (["  ", *(t.ljust(w + 2) for t, w in zip(r, widths, strict=True))] for r in rows)
    return [heading, *("".join(p).rstrip() for p in padded)]


def _row(c: Mapping[str, Any], chosen: Any) -> tuple[str, ...]:
    """Model, output function, weight decay, error, mark."""
    error = _number(c.get("free_run_rmse"), "runs away")
    if c.get("kind") == "oe":
        return f"oe, na = {c.get('na')}, nb = {c.get('nb')}, nk = {c.get('nk')}", "", "", error, ""
    orders = ", ".join(f"{k} = {c[k]}" for k in ("nx", "na", "nb") if k in c)
    size = f"{c.get('kind')}, {orders}, {c.get('hidden')} tanh, nk = {c.get('nk')}"
    size += ", integrator" if c.get("integrator") else ""
    decay = f"decay {_number(c.get('weight_decay'), '?')}"
    is_chosen = isinstance(chosen, Mapping) and all(c.get(k) == v for k, v in chosen.items())
    return size, str(c.get("output")), decay, error, "chosen" if is_chosen else ""


def _number(value: Any, otherwise: str) -> str:
    return f"{value:.4g}" if isinstance(value, (int, float)) else otherwise
