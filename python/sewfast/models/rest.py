"""`Rest`: the operating point at which a plant stands still, and from which loops begin."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class Rest:
    """Where a plant stands still: its constant inputs `u`, each in its own unit, and the output `y`
    under them. `source` is ``standing samples`` of the record before its first move,
    ``equilibrium`` of the model, or empty for zero, which stands for an unknown rest. `near_zero`
    says that the inputs are zero and noise explains the difference of the output from zero: a drive
    at a standstill. Loops on it begin at its mean as at any other level, so that a constant added
    to the record changes nothing.
    """

    u: tuple[float, ...]
    y: float
    source: str = ""
    near_zero: bool = False

    @property
    def is_zero(self) -> bool:
        """Whether input and output are zero at rest."""
        return self.y == 0.0 and not any(self.u)

    @property
    def is_standstill(self) -> bool:
        """Whether input and output are zero at rest, but for noise."""
        return self.near_zero or self.is_zero

    def to_json(self) -> dict[str, Any]:
        """As JSON values, for a model's `training`."""
        known = {"u": list(self.u), "y": self.y, "source": self.source}
        return known | ({"near_zero": True} if self.near_zero else {})
