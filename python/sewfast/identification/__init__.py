"""`identify`: from a data set to a model.

Read in this order: `entry` (the public function and its checks), `task` (one identification with
its settings, clock and threads), `linear`, `grey_box` and `lagged` (models of a given kind),
`folds` (held-out data, and comparisons on them), `training` (starts of one structure, on any number
of threads), `orders`, `outputs`, `trials` and `search` (the structures that are tried), `finals`
and `choice` (which of them becomes the model), `verdict` (whether it is good enough), `further`
(training a model further). Beside them: `delays` and `order_table` (`delay`, `orders`),
`least_squares`.
"""

from .entry import identify, seeded

__all__ = ["identify", "seeded"]
