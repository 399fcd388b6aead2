//! Complex numbers with their derivatives with respect to the parameters of a machine.

use std::ops::{Add, Div, Mul, Sub};

use nalgebra::Complex;

use super::MOST;

/// A number and its derivatives.
#[derive(Clone, Copy, Debug)]
pub(super) struct Dual {
    pub value: Complex<f64>,
    pub slopes: [Complex<f64>; MOST],
}

impl Dual {
    /// A constant.
    pub fn real(value: f64) -> Self {
        Self {
            value: Complex::new(value, 0.0),
            slopes: [Complex::new(0.0, 0.0); MOST],
        }
    }

    /// Parameter `j`.
    pub fn variable(value: f64, j: usize) -> Self {
        let mut found = Self::real(value);
        found.slopes[j] = Complex::new(1.0, 0.0);
        found
    }

    pub fn exp(self) -> Self {
        let value = self.value.exp();
        self.of(value, value)
    }

    pub fn sqrt(self) -> Self {
        let value = self.value.sqrt();
        self.of(value, 0.5 / value)
    }

    /// The result of a function of this number with this value and slope.
    fn of(self, value: Complex<f64>, slope: Complex<f64>) -> Self {
        Self {
            value,
            slopes: self.slopes.map(|s| s * slope),
        }
    }

    /// The result of a function of two numbers, from its value and its slopes.
    fn joined(
        self,
        other: Self,
        value: Complex<f64>,
        [by_self, by_other]: [Complex<f64>; 2],
    ) -> Self {
        let slope = |j: usize| self.slopes[j] * by_self + other.slopes[j] * by_other;
        Self {
            value,
            slopes: std::array::from_fn(slope),
        }
    }
}

const ONE: Complex<f64> = Complex::new(1.0, 0.0);

impl Add for Dual {
    type Output = Self;

    fn add(self, other: Self) -> Self {
        self.joined(other, self.value + other.value, [ONE, ONE])
    }
}

impl Sub for Dual {
    type Output = Self;

    fn sub(self, other: Self) -> Self {
        self.joined(other, self.value - other.value, [ONE, -ONE])
    }
}

impl Mul for Dual {
    type Output = Self;

    fn mul(self, other: Self) -> Self {
        self.joined(other, self.value * other.value, [other.value, self.value])
    }
}

impl Mul<f64> for Dual {
    type Output = Self;

    fn mul(self, factor: f64) -> Self {
        self * Self::real(factor)
    }
}

impl Div for Dual {
    type Output = Self;

    fn div(self, other: Self) -> Self {
        let value = self.value / other.value;
        self.joined(other, value, [ONE / other.value, -value / other.value])
    }
}
