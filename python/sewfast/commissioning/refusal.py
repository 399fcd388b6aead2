"""`Refusal`: commissioning stopped because the evidence is not good enough."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ..errors import FitError

if TYPE_CHECKING:
    from .result import Commissioning


class Refusal(FitError):
    """What was expected, what was seen, what to do; the machine is at rest.

    Attributes
    ----------
    stage : str
        Where it stopped.
    so_far : Commissioning or None
        What had been recorded, identified and tuned until then.
    """

    stage: str = ""
    so_far: Commissioning | None = None


def require(met: bool, message: str) -> None:
    """Stop with a reason.

    Raises
    ------
    Refusal
    """
    if not met:
        raise Refusal(message)
