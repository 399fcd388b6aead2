"""Boards of other makers, polled over lines of text: an axis of an ODrive, a SimpleFOC sketch.

Read `polled` first (`PolledBoard`: what all of them share), then `makers` (the commands of each
board). A board is a `sewfast.Machine`: `record`, `run`, `commission` and `bode` accept it.
"""

from .makers import ODrive, SimpleFOC
from .polled import PolledBoard

__all__ = ["ODrive", "PolledBoard", "SimpleFOC"]
