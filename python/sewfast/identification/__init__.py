"""`identify`: from a data set to a model.

Read in this order: `entry` (the public function and its checks), `task` (one identification with
its settings, clock and threads), `folds` (held-out data, comparisons on them, and the verdict),
`linear`, `lagged` and `grey_box` (models of a given kind), `training` and `outputs` (starts of one
network, on any number of threads), `blocks`, `table` and `mixture` (the structures that are tried,
what they are judged by, and the model that they become), `further` (training a model further).
Beside them:
`delays` and `order_table` (`delay`, `orders`), `least_squares`.
"""

from .entry import identify, seeded

__all__ = ["identify", "seeded"]
