"""Known moves: references within reach, their tables, learning from repetitions.

Read in this order: `profiles` (what a drive can follow), `planning` (`plan`: the table of a move
from models), `learning` (`learn`: repeat it on a machine). The table itself is
`sewfast.control.move.MoveTable`.
"""

from ..control.files import load_table
from ..control.move import MoveTable, Repetition
from .learning import Learned, learn
from .planning import plan
from .profiles import Profile, Reach, profile

__all__ = [
    "Learned",
    "MoveTable",
    "Profile",
    "Reach",
    "Repetition",
    "learn",
    "load_table",
    "plan",
    "profile",
]
