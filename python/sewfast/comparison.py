"""`compare`: several models on the same data, side by side."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from .arrays import labelled
from .dataset import Dataset
from .dynamic_model import INIT, DynamicModel
from .errors import FitError, SettingError
from .plotting import Drawing, Plotted, fit_panels, stacked
from .tables import Table, percent, significant
from .validation import Validation, validate

ORDER = "compare(model, model, ..., data)"


@dataclass(frozen=True, eq=False, repr=False)
class Comparison(Plotted):
    """Models on the same data.

    Attributes
    ----------
    names : tuple of str
        Names of the models, in the given order.
    parameters : tuple of int
        Number of fitted parameters of each model; for an ensemble the sum over its members.
    validations : tuple of Validation or None
        The result of `validate` for each; None if the model diverges on these inputs.
    failures : tuple of str
        The reason if it diverges; otherwise empty.
    unit : str
        Unit of errors and output.
    """

    names: tuple[str, ...]
    parameters: tuple[int, ...]
    validations: tuple[Validation | None, ...]
    failures: tuple[str, ...]
    unit: str

    def __len__(self) -> int:
        return len(self.names)

    def __getitem__(self, name: str) -> Validation:
        """The validation of one model; `KeyError` for another name, or a model that diverges."""
        found = dict(zip(self.names, self.validations, strict=True)).get(name)
        if found is None:
            raise KeyError(f"no scores of {name!r}; there are those of {', '.join(self._scored)}")
        return found

    @property
    def _scored(self) -> list[str]:
        return [n for n, v in zip(self.names, self.validations, strict=True) if v is not None]

    @property
    def best(self) -> str:
        """The model with the smallest free-run error; empty if all diverge."""
        errors = {name: self[name].simulation.rmse for name in self._scored}
        return min(errors, key=errors.__getitem__, default="")

    def to_json(self) -> dict[str, Any]:
        """As JSON values; null for the scores of a model that diverges."""
        return {
            "unit": self.unit,
            "best": self.best or None,
            "models": [
                {
                    "name": name,
                    "parameters": p,
                    "scores": None if v is None else v.to_json(),
                    "failure": why or None,
                }
                for name, p, v, why in zip(
                    self.names, self.parameters, self.validations, self.failures, strict=True
                )
            ],
        }

    def drawing(self) -> Drawing:
        """Draw the measured output, every free run over it, and their errors below."""
        if not self._scored:
            raise SettingError("expected a model that stays bounded on these data; all diverge")
        found = {name: self[name] for name in self._scored}
        first = found[self._scored[0]]
        panels = fit_panels(
            first.Ts,
            [e.y for e in first.experiments],
            {name: [e.simulated for e in v.experiments] for name, v in found.items()},
            {name: [e.error for e in v.experiments] for name, v in found.items()},
            label=labelled(first.against, self.unit),
            unit=self.unit,
        )
        return stacked(panels, (2.6, 1.7))

    def __repr__(self) -> str:
        return f"Comparison({', '.join(self.names)}; best: {self.best or 'none'})"

    def __str__(self) -> str:
        header, rows = self._table()
        wide = [max(map(len, column)) for column in zip(header, *rows, strict=True)]
        lines = []
        for row in (header, *rows):
            cells = [row[0].ljust(wide[0])]
            cells += [c.rjust(w) for c, w in zip(row[1:], wide[1:], strict=True)]
            lines.append("  ".join(cells).rstrip())
        return "\n".join([self._caption(), *lines, *self._notes()])

    def _repr_html_(self) -> str:
        header, rows = self._table()
        return Table(self._caption(), header, rows).to_html(self._notes())

    def _caption(self) -> str:
        scored = next((v for v in self.validations if v is not None), None)
        if scored is None:
            return "every model diverges on these data"
        data = ", ".join(f"{e.name} [{e.range_text}]" for e in scored.experiments)
        several = "model" if len(self) == 1 else "models"
        return f"{len(self)} {several} on {data}, {scored.n} samples scored"

    def _table(self) -> tuple[tuple[str, ...], tuple[tuple[str, ...], ...]]:
        unit = f" [{self.unit}]" if self.unit else ""
        header = (
            "model", "parameters", "fit, free run", f"rms error{unit}", f"largest{unit}",
            "fit, one step", "grade",
        )  # fmt: skip
        rows = []
        for name, p, v in zip(self.names, self.parameters, self.validations, strict=True):
            if v is None:
                rows.append((name, str(p), "runs away", *("–",) * 4))
                continue
            s = v.simulation
            rows.append((
                name, str(p), percent(s.fit_percent), significant(s.rmse, 4),
                significant(s.max_abs, 4), percent(v.one_step.fit_percent), v.grade or "–",
            ))  # fmt: skip
        return header, tuple(rows)

    def _notes(self) -> list[str]:
        """The best model, and objections to others."""
        found = [f"{n}: {why}" for n, why in zip(self.names, self.failures, strict=True) if why]
        for name in self._scored:
            found += [f"{name}: {note}" for note in self[name].notes]
        return [*found, f"smallest free-run error: {self.best}"] if self.best else found


def compare(
    *models: DynamicModel | Mapping[str, DynamicModel] | Dataset,
    data: Dataset | None = None,
    init: int = INIT,
    against: str | None = None,
) -> Comparison:
    """Score several models on the same data.

    Parameters
    ----------
    *models : Model, or one mapping of name to Model
        Without names they are called by their kind. The last argument can be the data.
    data : Dataset
        Preferably data that none of the models was trained on.
    init, against
        As for `sewfast.validate`.

    Returns
    -------
    Comparison

    Raises
    ------
    SettingError
        If there is no model or no data.
    DataError
        If a model does not match the data; the message names the model.
    """
    given: list[Any] = list(models)
    if data is None and given and isinstance(given[-1], Dataset):
        data = given.pop()
    if not isinstance(data, Dataset):
        raise SettingError(f"expected a Dataset after the models, got none; {ORDER}")
    named = _named(given)
    scores: list[Validation | None] = []
    failures = []
    for model in named.values():
        try:
            scores.append(validate(model, data, init=init, against=against))
            failures.append("")
        except FitError as e:
            scores.append(None)
            failures.append(str(e))
    unit = data.output_unit or next(iter(named.values())).output_unit
    sizes = tuple(int(np.size(model.theta)) for model in named.values())
    return Comparison(tuple(named), sizes, tuple(scores), tuple(failures), unit)


def _named(given: list[Any]) -> dict[str, DynamicModel]:
    if len(given) == 1 and isinstance(given[0], Mapping):
        named = {str(name): model for name, model in given[0].items()}
    else:
        kinds = [getattr(model, "kind", "") for model in given]
        places = [kinds[: i + 1].count(kind) for i, kind in enumerate(kinds)]
        named = {
            kind if kinds.count(kind) == 1 else f"{kind} {place}": model
            for kind, place, model in zip(kinds, places, given, strict=True)
        }
    wrong = [type(m).__name__ for m in named.values() if not isinstance(m, DynamicModel)]
    if wrong or not named or len(named) < len(given):
        received = f", got {wrong[0]}" if wrong else ""
        raise SettingError(f"expected one model or more{received}; {ORDER}")
    return named
