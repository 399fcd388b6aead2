"""`identify`: from a data set to a model.

In the order in which to read it: `entry` (the public function and its refusals), `task` (one
identification with its settings), `linear` and `lagged` (models of given orders), `folds` (what is
held out, and how models are compared on it), `training` (starts of one structure, on any number of
threads), `search` (which structures are tried), `choice` (which of them becomes the model).
Beside them: `delays` and `order_table` (`delay`, `orders`), `least_squares`.
"""

from .entry import identify, seeded

__all__ = ["identify", "seeded"]
