"""Whether a test takes all its cases, seeds and seconds (`make soak`), or a part (`make test`)."""

from __future__ import annotations

import os

FULL = os.environ.get("SEWFAST_SOAK") == "1"
