"""The paper's experiment on a virtual sewing machine: what `sewfast demo` does."""

from .demo import STAGES, run_demo

__all__ = ["STAGES", "run_demo"]
