//! Levenberg-Marquardt for nonlinear least squares given by normal equations.
