//! Training of a position by its recent motion first: an integrator that leaks, on outputs that leak alike.
//!
//! The free run of an integrator sums up what its speed is wrong by, and a small error of the friction moves all that
//! follows; the cost has many valleys. Behind `H = (1 - q^-1) / (1 - p q^-1)` an error counts for some `1/(1 - p)`
//! samples, noise is hardly larger than before (a plain difference would double it), and the same parameters run the
//! model: the last state's pole is `p` where it was 1. What is summed up within the output, a small part, is not
//! filtered; the training that follows, with the pole at 1 and the outputs as they are, mends that.

use super::problem::Experiment;
use super::scaling::root_mean_square;
use super::shape::Shape;

/// Time constant of the leak, in samples in which a position moves by a quarter of its standard deviation.
const MEMORY: f64 = 2.0;

/// Recordings behind the filter, and the parameters that go with them.
pub(super) struct Leak {
    pub experiments: Vec<Experiment>,
    pole: f64,
    scale: f64,
}

impl Leak {
    /// The filter for positions of this pace; none where nothing moves.
    pub fn new(experiments: &[Experiment], pace: usize) -> Option<Self> {
        let pole = 1.0 - 1.0 / (MEMORY * pace as f64).max(2.0);
        let mut filtered: Vec<Experiment> = experiments.iter().map(|e| behind(pole, e)).collect();
        let scale = root_mean_square(filtered.iter().flat_map(|e| e.y.iter().copied()));
        if scale <= 0.0 {
            return None;
        }
        for y in filtered.iter_mut().flat_map(|e| &mut e.y) {
            *y /= scale;
        }
        Some(Self {
            experiments: filtered,
            pole,
            scale,
        })
    }

    /// Parameters and states for the filtered outputs: the position begins at 0, as those do.
    pub fn entered(&self, theta: &mut [f64], shape: Shape) {
        self.scaled(theta, shape, 1.0 / self.scale);
        theta[shape.parts().constant].fill(0.0);
        theta[shape.pole()] = self.pole;
        for state in theta[shape.parameters()..].chunks_exact_mut(shape.nx) {
            state[shape.nx - 1] = 0.0;
        }
    }

    /// The same parameters for the outputs as they are; where their positions begin is left to be found.
    pub fn left(&self, theta: &mut [f64], shape: Shape) {
        self.scaled(theta, shape, self.scale);
        theta[shape.pole()] = 1.0;
    }

    fn scaled(&self, theta: &mut [f64], shape: Shape, factor: f64) {
        let parts = shape.parts();
        // C, D, c and G stand side by side
        theta[parts.c.start..parts.g.end]
            .iter_mut()
            .for_each(|t| *t *= factor);
    }
}

/// The outputs behind the filter, from rest; a gap keeps the position that was last known.
fn behind(pole: f64, experiment: &Experiment) -> Experiment {
    let (mut last, mut sum) = (None, 0.0);
    let filtered = experiment.y.iter().map(|y| {
        if y.is_nan() {
            return f64::NAN;
        }
        sum = pole * sum + (y - last.unwrap_or(*y));
        last = Some(*y);
        sum
    });
    Experiment {
        y: filtered.collect(),
        ..experiment.clone()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn forgets_a_step_and_keeps_gaps() {
        let mut y = vec![0.0; 400];
        y[100..].fill(1.0);
        y[50] = f64::NAN;
        let experiment = Experiment {
            v: vec![0.0; 400],
            y,
            weights: Vec::new(),
        };
        let leak = Leak::new(&[experiment], 10).unwrap();
        let y = &leak.experiments[0].y;
        assert_eq!(y[99], 0.0);
        assert!(y[50].is_nan());
        assert!((y[120] / y[100] - (1.0_f64 - 1.0 / 20.0).powi(20)).abs() < 1e-12);
        let power: f64 = y.iter().filter(|y| !y.is_nan()).map(|y| y * y).sum();
        assert!((power / 399.0 - 1.0).abs() < 1e-12);
    }

    #[test]
    fn comes_back_to_the_parameters_it_was_entered_with() {
        let shape = Shape {
            nx: 3,
            nk: 1,
            inputs: 2,
            outputs: 1,
            hidden: 2,
            integrator: true,
        };
        let y: Vec<f64> = (0..300).map(|k| (f64::from(k) * 0.05).sin()).collect();
        let experiment = Experiment {
            v: vec![0.0; 600],
            y,
            weights: Vec::new(),
        };
        let leak = Leak::new(&[experiment], 8).unwrap();
        let before: Vec<f64> = (0..shape.parameters() + 3)
            .map(|i| 0.1 + i as f64)
            .collect();
        let mut theta = before.clone();
        leak.entered(&mut theta, shape);
        assert_eq!(theta[shape.pole()], 1.0 - 1.0 / 16.0);
        leak.left(&mut theta, shape);
        assert_eq!(theta[shape.pole()], 1.0);
        let changed = [
            shape.pole(),
            shape.parts().constant.start,
            shape.parameters() + 2,
        ];
        for i in (0..theta.len()).filter(|i| !changed.contains(i)) {
            assert!((theta[i] / before[i] - 1.0).abs() < 1e-12, "{i}");
        }
    }

    #[test]
    fn is_none_where_nothing_moves() {
        let experiment = Experiment {
            v: vec![0.0; 9],
            y: vec![2.0; 9],
            weights: Vec::new(),
        };
        assert!(Leak::new(&[experiment], 4).is_none());
    }
}
