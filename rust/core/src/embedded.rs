//! Models in a microcontroller's form: named coefficients and the step of `sewfast_control::model`.

use sewfast_control::Real;
use sewfast_control::model::{
    Equation, Linear, Model, Network, Orders, Output, Scaling as Around, StateSpace,
};

use crate::lagged::Lagged;
use crate::linear::LinearModel;
use crate::neural::NeuralOE;
use crate::neural_ss::{NeuralSS, OutputFunction};
use crate::{Error, Result};

/// The numbers of a model, as its step takes them.
#[derive(Clone, Debug, PartialEq)]
pub struct Embedded {
    /// `linear`, `network` or `states`.
    pub kind: &'static str,
    /// Sizes.
    pub orders: Orders,
    /// Coefficients by name, matrices row by row, as `sewfast_control::model` has them.
    pub parts: Vec<(&'static str, Vec<f64>)>,
    /// Means and scales around the equation: `u_mean`, `u_scale`, `y_mean`, `y_scale`.
    pub scaling: Option<(Vec<f64>, Vec<f64>, f64, f64)>,
    /// The output function of state equations.
    pub output: OutputFunction,
}

/// A number type of a step.
pub trait Precision: Real {
    /// The nearest number.
    fn nearest(value: f64) -> Self;
}

impl Precision for f64 {
    fn nearest(value: f64) -> Self {
        value
    }
}

impl Precision for f32 {
    fn nearest(value: f64) -> Self {
        value as f32
    }
}

impl Embedded {
    /// The free run over `u` (time first) in precision `T`, from `state`, with inputs of `held` before the first sample.
    ///
    /// # Errors
    /// `ErrorKind::Data` for inputs or a state of another length.
    pub fn run<T: Precision>(&self, u: &[f64], state: &[f64], held: &[f64]) -> Result<Vec<f64>> {
        let Orders { na, inputs, .. } = self.orders;
        if state.len() != na || held.len() != inputs || !u.len().is_multiple_of(inputs) {
            return Err(Error::data(format!(
                "expected {inputs} inputs and a state of {na} numbers, got {} inputs and {}; give u of shape (N, {inputs})",
                held.len(),
                state.len()
            )));
        }
        let rounded = |values: &[f64]| values.iter().map(|v| T::nearest(*v)).collect::<Vec<T>>();
        let parts: Vec<_> = self
            .parts
            .iter()
            .map(|(name, values)| (*name, rounded(values)))
            .collect();
        let part = |name: &str| {
            let found = parts.iter().find(|(known, _)| *known == name);
            found.map_or(&[][..], |(_, values)| &values[..])
        };
        let one = |name: &str| part(name).first().copied().unwrap_or(T::ZERO);
        let equation = match self.kind {
            "linear" => Equation::Linear(Linear {
                a: part("a"),
                b: part("b"),
                offset: one("offset"),
            }),
            "network" => Equation::Network(Network {
                w1: part("w1"),
                b1: part("b1"),
                w2: part("w2"),
                b2: one("b2"),
                direct: part("direct"),
                limits: (one("low"), one("high")),
            }),
            _ => Equation::States(StateSpace {
                a: part("a"),
                b: part("b"),
                e: part("e"),
                wx: part("wx"),
                wu: part("wu"),
                bh: part("bh"),
                c: part("c"),
                d: part("d"),
                constant: one("constant"),
                g: part("g"),
                output: output(self.output),
            }),
        };
        let scales = self
            .scaling
            .as_ref()
            .map(|(m, s, _, _)| (rounded(m), rounded(s)));
        let scaling = self.scaling.as_ref().zip(scales.as_ref());
        let scaling = scaling.map(|((_, _, y_mean, y_scale), (u_mean, u_scale))| Around {
            u_mean,
            u_scale,
            y_mean: T::nearest(*y_mean),
            y_scale: T::nearest(*y_scale),
        });
        let mut memory = vec![T::ZERO; Model::room(self.orders, &equation)];
        let mut model = Model::new(self.orders, equation, scaling, &mut memory)?;
        model.begin(&rounded(state), &rounded(held));
        let rows = u.chunks_exact(inputs);
        Ok(rows.map(|row| model.step(&rounded(row)).to_f64()).collect())
    }
}

fn output<T: Precision>(function: OutputFunction) -> Output<T> {
    let near = T::nearest;
    match function {
        OutputFunction::Linear => Output::Linear,
        OutputFunction::Saturation { low, high, width } => Output::Saturation {
            low: near(low),
            high: near(high),
            width: near(width),
        },
        OutputFunction::Abs { width } => Output::Abs { width: near(width) },
    }
}

fn lagged(model: &impl Lagged) -> Orders {
    let lags = model.lags();
    Orders {
        na: lags.na,
        nb: lags.nb,
        nk: lags.nk,
        inputs: lags.channels,
    }
}

impl LinearModel {
    /// The microcontroller's form.
    pub fn embedded(&self) -> Embedded {
        Embedded {
            kind: "linear",
            orders: lagged(self),
            parts: vec![
                ("a", self.a().to_vec()),
                ("b", self.b().to_vec()),
                ("offset", vec![self.offset()]),
            ],
            scaling: None,
            output: OutputFunction::Linear,
        }
    }
}

impl NeuralOE {
    /// The microcontroller's form in the data's units, as in a free run, or `scaled`, which keeps more digits in single
    /// precision.
    pub fn embedded(&self, scaled: bool) -> Embedded {
        let shape = self.shape();
        let own = scaled || !self.scaling().is_moderate();
        let (theta, (low, high)) = if own {
            (self.theta().to_vec(), self.limits())
        } else {
            self.theta_in_data_units()
        };
        let [bias, second, constant, linear] = shape.offsets();
        let direct = if shape.bypass {
            theta[linear..].to_vec()
        } else {
            vec![0.0; shape.lags.regressors()]
        };
        let scaling = self.scaling();
        let around = || {
            let (mean, scale) = (scaling.u_mean.clone(), scaling.u_scale.clone());
            (mean, scale, scaling.y_mean, scaling.y_scale)
        };
        Embedded {
            kind: "network",
            orders: lagged(self),
            parts: vec![
                ("w1", theta[..bias].to_vec()),
                ("b1", theta[bias..second].to_vec()),
                ("w2", theta[second..constant].to_vec()),
                ("b2", vec![theta[constant]]),
                ("direct", direct),
                ("low", vec![low]),
                ("high", vec![high]),
            ],
            scaling: own.then(around),
            output: OutputFunction::Linear,
        }
    }
}

impl NeuralSS {
    /// The microcontroller's form.
    pub fn embedded(&self) -> Embedded {
        let (shape, theta, p) = (self.shape(), self.theta(), self.shape().parts());
        let scaling = self.scaling();
        let names = ["a", "b", "e", "wx", "wu", "bh", "c", "d", "constant", "g"];
        let ranges = [p.a, p.b, p.e, p.wx, p.wu, p.bh, p.c, p.d, p.constant, p.g];
        Embedded {
            kind: "states",
            orders: Orders {
                na: shape.nx,
                nb: 1,
                nk: shape.nk,
                inputs: shape.inputs,
            },
            parts: names
                .into_iter()
                .zip(ranges.map(|range| theta[range].to_vec()))
                .collect(),
            scaling: Some((
                scaling.u_mean.clone(),
                scaling.u_scale.clone(),
                scaling.y_mean,
                scaling.y_scale,
            )),
            output: self.output(),
        }
    }
}
