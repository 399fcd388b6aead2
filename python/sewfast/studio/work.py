"""The long steps as their process does them; each is a call of the public API."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from .commissioning import COMMISSIONED, Commission, carry_out
from .project import Project
from .step import Step

if TYPE_CHECKING:
    from ..frequency import FrequencyResponse
    from .jobs import Report
    from .search import Found, Search


def identify(folder: Path, report: Report, step: Step) -> dict[str, Any]:
    """A model from a recording, written to `model.json`."""
    return Project(folder).identify(step, report, report.writing)


def bode(
    folder: Path, report: Report, step: Step, reference: str | None, segment: int | None
) -> tuple[FrequencyResponse, dict[str, Any], Any]:
    """A measured response, and what is shown of it; the fit of a shaft takes seconds."""
    from .loops import shown_response

    report(0, 2, "response")
    response = Project(folder).bode(step, reference, segment)
    report(1, 2, "shaft")
    return response, *shown_response(response)


def tune(
    folder: Path, report: Report, model: str, controller: str | None, notches: Any,
    values: dict[str, Any], search: Search,
) -> Found:  # fmt: skip
    """A search from the present values on."""
    return Project(folder).tuning(model, controller, notches).search(values, search, report)


def commission(folder: Path, report: Report, asked: Commission) -> dict[str, Any]:
    """A virtual machine from rest to a verified controller, in the folder `commissioned`."""
    from ..machine import VirtualMachine

    machine = VirtualMachine.from_name(asked.machine)
    return carry_out(asked, machine, folder, report, writing=report.writing)


def write_report(folder: Path, report: Report) -> dict[str, Any]:
    """The HTML report of a commissioning."""
    from ..report import report as write

    report(0, 1, "report")
    with report.writing():
        written = write(folder / COMMISSIONED)
    return {
        "file": written.relative_to(folder).as_posix(),
        "python": f"from sewfast.report import report\n\nprint(report({COMMISSIONED!r}))\n",
        "commands": f"sewfast report {COMMISSIONED}\n",
    }
