//! ARX models by linear least squares.
