//! Tuning rules from a first-order-plus-dead-time model: Table 1 of the paper.
