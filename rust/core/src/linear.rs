//! Linear difference-equation models: one-step prediction and free-running simulation.
