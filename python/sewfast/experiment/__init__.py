"""The paper's experiment on a virtual sewing machine, for `sewfast demo`."""

from .demo import STAGES, run_demo

__all__ = ["STAGES", "run_demo"]
