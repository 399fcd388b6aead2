"""The paper's experiment on a virtual sewing machine, for `sewfast demo`.

Read `demo` (the stages), then `loops` (what they do); `command` adds `sewfast demo`.
"""

from typing import TYPE_CHECKING

from sewfast.plugins import on_first_use as _on_first_use

if TYPE_CHECKING:
    from .demo import STAGES, run_demo

__all__ = ["STAGES", "run_demo"]

if not TYPE_CHECKING:  # a misspelt name is an error for type checkers
    __getattr__, __dir__ = _on_first_use(__name__, {"demo": "STAGES run_demo"})
