"""The requests of a page or a widget for steps on a project; those on a drive are in `driving`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from ..errors import SettingError
from .commissioning import COMMISSIONED, Commission
from .jobs import Jobs
from .loops import shown_loop
from .project import Project, checked_name
from .search import Search
from .step import Step

if TYPE_CHECKING:
    from ..dataset import FloatArray
    from ..frequency import FrequencyResponse
    from .tuning import Tuning

KEPT = 4
"""Number of measured responses that are kept, to draw over a loop."""

Curves = Mapping[str, "FloatArray"]


class Steps:
    """Carries out the steps on a project.

    Parameters
    ----------
    project : Project
    jobs : Jobs
        Runs the long steps.
    """

    def __init__(self, project: Project, jobs: Jobs) -> None:
        self.project, self.jobs = project, jobs
        self._responses: dict[int, FrequencyResponse] = {}
        self._last = 0

    def do(self, name: str, fields: dict[str, Any]) -> Any:
        """Carry out a checked message; return JSON values, or these and curves.

        Raises
        ------
        SewfastError
            For a refusal.
        """
        if name.startswith("tune") or name == "loop":
            return self._tune(name, fields)
        if name == "cancel":
            return self.jobs.cancel()
        if name == "commission":
            return self.jobs.start("commissioned", "commission", Commission.parse(fields))
        if name == "report":
            if not (self.project.folder / COMMISSIONED).is_dir():
                raise SettingError(
                    f"expected a folder {COMMISSIONED}, there is none; commission a machine first"
                )
            return self.jobs.start("reported", "write_report")
        step = Step.parse(fields)
        if name == "columns":
            return self.project.columns(step)
        if name == "bode":
            return self._bode(step, fields.get("reference") or None, fields.get("segment"))
        if name == "identify":
            copies = self._copies(step, name)  # refuses wrong columns before the work starts
            return self.jobs.start(
                "identified", name, step, finish=lambda found: {**found, **copies}
            )
        return {**getattr(self.project, name)(step), **self._copies(step, name)}

    def _bode(self, step: Step, reference: str | None, segment: int | None) -> None:
        # the filter of resampling looks ahead, which hides the delay
        step = replace(step, resample=None)
        copies = {
            "python": self.project.python(step, "bode", reference, segment),
            "commands": self.project.commands(step, "bode", reference, segment),
        }

        def finish(found: tuple[FrequencyResponse, dict[str, Any], Curves]) -> dict[str, Any]:
            response, shown, curves = found
            self._last += 1
            self._responses[self._last] = response
            self._responses.pop(self._last - KEPT, None)
            drawn = {name: values.tolist() for name, values in curves.items()}
            return {"response": self._last, **shown, "curves": drawn, **copies}

        self.jobs.start("responded", "bode", step, reference, segment, finish=finish)

    def _tune(self, name: str, fields: dict[str, Any]) -> Any:
        tuning = self.project.tuning(
            fields["model"], fields.get("controller"), _notches(fields.get("notches", []))
        )
        values = fields.get("values", {})
        if name == "loop":
            response = self._responses.get(fields.get("response") or 0)
            return shown_loop(tuning, values, response)
        if name == "tune_open":
            return tuning.opened()
        if name == "tune_move":
            return tuning.move(values)
        if name == "tune_costs":
            return {"costs": tuning.costs([{}, values], fields.get("weights"))}
        if name == "tune_search":
            return self._search(tuning, values, fields)
        file = checked_name(fields.get("file"))
        if name == "tune_save":
            self.project.save_controller(tuning, values, file)
        return {"python": tuning.python(values, file), "commands": tuning.commands(values, file)}

    def _search(self, tuning: Tuning, values: dict[str, Any], fields: dict[str, Any]) -> None:
        names = ("evaluations", "seed", "seconds", "weights", "constraints")
        search = Search(**{k: fields[k] for k in names if fields.get(k) is not None})
        tuning.check(search)
        tuning.controller(values)
        self.jobs.start(
            "searched", "tune", fields["model"], fields.get("controller"),
            _notches(fields.get("notches", [])), values, search, finish=tuning.keep,
        )  # fmt: skip

    def _copies(self, step: Step, name: str) -> dict[str, str]:
        return {
            "python": self.project.python(step, name),
            "commands": self.project.commands(step, name),
        }


def _notches(rows: list[list[float]]) -> tuple[tuple[float, float, float], ...]:
    for row in rows:
        if len(row) != 3 or not np.isfinite(row).all():
            raise SettingError(
                f"notches: expected frequency, depth and width of each, received {row!r:.60}"
            )
    return tuple((float(f), float(depth), float(width)) for f, depth, width in rows)
