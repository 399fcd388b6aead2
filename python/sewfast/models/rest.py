"""`Rest`: the operating point at which a plant stands still, and from which loops begin."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class Rest:
    """Where a plant stands still: its constant inputs `u`, each in its own unit, and the output `y`
    under them. `source` is ``standing samples`` of the record before its first move,
    ``equilibrium`` of the model, or empty for zero, which stands for an unknown rest.
    """

    u: tuple[float, ...]
    y: float
    source: str = ""

    @property
    def is_zero(self) -> bool:
        """Whether input and output are zero at rest."""
        return self.y == 0.0 and not any(self.u)

    def to_json(self) -> dict[str, Any]:
        """As JSON values, for a model's `training`."""
        return {"u": list(self.u), "y": self.y, "source": self.source}
