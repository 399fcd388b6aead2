//! What fixes the length and the order of theta, and where its parts stand.

use std::ops::Range;

use crate::{Error, Result};

/// Sizes of a neural state-space model.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Shape {
    /// Number of states.
    pub nx: usize,
    /// Delay in samples from input to output.
    pub nk: usize,
    /// Number of inputs.
    pub inputs: usize,
    /// Number of outputs.
    pub outputs: usize,
    /// Hidden units.
    pub hidden: usize,
    /// Whether the last state is the sum of a function of the others.
    pub integrator: bool,
}

/// More than this is a slip of the pen.
const MOST: [(&str, usize, usize); 5] = [
    ("nx", 1, 50),
    ("nk", 0, 1_000),
    ("inputs", 1, 100),
    ("outputs", 1, 50),
    ("hidden", 1, 1_000),
];

/// Where each part of theta stands.
#[derive(Clone, Debug)]
pub(crate) struct Parts {
    pub a: Range<usize>,
    pub b: Range<usize>,
    pub e: Range<usize>,
    pub wx: Range<usize>,
    pub wu: Range<usize>,
    pub bh: Range<usize>,
    pub c: Range<usize>,
    pub d: Range<usize>,
    pub constant: Range<usize>,
    pub g: Range<usize>,
}

impl Shape {
    /// The same shape, once its sizes are known to make a model.
    ///
    /// # Errors
    /// `ErrorKind::Setting` for sizes out of range.
    pub fn checked(self) -> Result<Self> {
        let sizes = [self.nx, self.nk, self.inputs, self.outputs, self.hidden];
        for ((name, least, most), value) in MOST.into_iter().zip(sizes) {
            if value < least || value > most {
                return Err(Error::setting(format!(
                    "expected {name} from {least} to {most}, got {value}; 3 states and 8 hidden units are a good beginning"
                )));
            }
        }
        Ok(self)
    }

    /// Length of theta.
    pub fn parameters(&self) -> usize {
        self.parts().g.end
    }

    /// What enters a hidden unit beside its bias: states and inputs.
    pub(super) fn arguments(&self) -> usize {
        self.nx + self.inputs
    }

    /// Where each part stands.
    pub(crate) fn parts(&self) -> Parts {
        let (nx, nu, ny, hidden) = (self.nx, self.inputs, self.outputs, self.hidden);
        let mut next = 0;
        let mut part = |size: usize| {
            next += size;
            next - size..next
        };
        Parts {
            a: part(nx * nx),
            b: part(nx * nu),
            e: part(nx * hidden),
            wx: part(hidden * nx),
            wu: part(hidden * nu),
            bh: part(hidden),
            c: part(ny * nx),
            d: part(ny * nu),
            constant: part(ny),
            g: part(ny * hidden),
        }
    }

    /// Where the last state's own pole stands.
    pub(super) fn pole(&self) -> usize {
        self.parts().a.end - 1
    }

    /// Parameters that an integrator holds, and their values.
    pub(super) fn held(&self) -> Vec<(usize, f64)> {
        if !self.integrator {
            return Vec::new();
        }
        let (nx, last, parts) = (self.nx, self.nx - 1, self.parts());
        let column = (0..last).map(|q| (parts.a.start + q * nx + last, 0.0));
        let units = (0..self.hidden).map(|i| (parts.wx.start + i * nx + last, 0.0));
        column.chain([(self.pole(), 1.0)]).chain(units).collect()
    }

    /// Sets the parameters that an integrator holds.
    pub(super) fn hold(&self, theta: &mut [f64]) {
        for (i, value) in self.held() {
            theta[i] = value;
        }
    }

    /// Share of the weight decay that a parameter bears: the network's weights bear it, its biases a tenth of it.
    pub(super) fn decay(&self, parameter: usize) -> f64 {
        let parts = self.parts();
        if parts.bh.contains(&parameter) {
            return 0.1;
        }
        let weights = [&parts.e, &parts.wx, &parts.wu, &parts.g];
        f64::from(u8::from(
            weights.iter().any(|part| part.contains(&parameter)),
        ))
    }
}
