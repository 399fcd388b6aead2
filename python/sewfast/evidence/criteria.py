"""Information criteria with the number of parameters that count."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass


@dataclass(frozen=True)
class Criteria:
    """Criteria of a model on the data that it was fitted to; smaller is better, differences matter.

    Attributes
    ----------
    parameters : float
        Effective number.
    n : int
        Samples.
    aic, aicc, bic : float
        n ln(RSS/n) + 2 p; + 2 p (p + 1)/(n - p - 1); n ln(RSS/n) + p ln n. NaN without a residual.
    fpe : float
        RSS/n (1 + p/n)/(1 - p/n) [output unit squared].

    Notes
    -----
    Akaike (1974), Hurvich and Tsai (1989), Schwarz (1978), Akaike (1969); Ljung 1999, section 16.4.
    They take the residual for white: with a coloured one they are too willing to add parameters.
    """

    parameters: float
    n: int
    aic: float
    aicc: float
    bic: float
    fpe: float

    @classmethod
    def of(cls, squares: float, n: int, parameters: float) -> Criteria:
        """From the sum of squared residuals of n samples."""
        nan = math.nan
        if n < 1 or not squares > 0.0:
            return cls(parameters, n, nan, nan, nan, nan)
        p = parameters
        fit = n * math.log(squares / n)
        aic = fit + 2.0 * p
        room = n - p - 1.0
        aicc = aic + 2.0 * p * (p + 1.0) / room if room > 0.0 else nan
        fpe = squares / n * (1.0 + p / n) / (1.0 - p / n) if p < n else nan
        return cls(p, n, aic, aicc, fit + p * math.log(n), fpe)

    def to_json(self) -> dict[str, float | None]:
        """As JSON values: None where a criterion is undefined."""
        return {k: v if math.isfinite(v) else None for k, v in asdict(self).items()}
