//! Where the training of a position begins: at its speed or at its recent motion.
//!
//! An integrator's free run sums up the errors of its speed, and a small error of the friction shifts all that follows:
//! the cost has many valleys. Two problems with fewer valleys are trained first:
//!
//! - [`Speed`]: a network of the outputs' differences, followed by the integrator. The free run of the speed does not
//!   drift, and dry friction shows in it. Differences of noisy positions have `sqrt(2)` times the noise in every
//!   sample, but there are many samples.
//! - [`Leak`]: a leaking integrator, on outputs that leak alike. After the filter `H = (1 - q^-1) / (1 - p q^-1)` an
//!   error counts for some `1/(1 - p)` samples, and the noise hardly grows (a plain difference would double it). The
//!   same parameters run the model, with `p` in place of 1 as the last state's pole. The part summed up within the
//!   output, a small one, is not filtered.
//!
//! The training that follows, with the pole at 1 and the unfiltered positions, weighs the noise correctly.

use super::problem::Experiment;
use super::shape::{Shape, root_mean_square};

/// Recordings of the speed, and the shape of a network for it.
pub(super) struct Speed {
    pub experiments: Vec<Experiment>,
    pub shape: Shape,
    /// Root mean square of the speed, in units of the position per sample.
    pub scale: f64,
}

impl Speed {
    /// The speed of these positions. `None` if nothing moves, if the position is the only state, or if fewer than two
    /// hidden units are left beside the one for the constant: with one unit, random starts find no friction.
    pub fn new(experiments: &[Experiment], position: Shape) -> Option<Self> {
        if position.nx < 2 || position.hidden < 3 {
            return None;
        }
        let shape = Shape {
            nx: position.nx - 1,
            hidden: position.hidden - 1,
            integrator: false,
            ..position
        };
        // The network of the speed has its own units: its outputs then have the size for which start weights and decay
        // are made.
        let mut experiments: Vec<Experiment> = experiments.iter().map(differences).collect();
        let scale = root_mean_square(experiments.iter().flat_map(|e| e.y.iter().copied()));
        if scale <= 0.0 {
            return None;
        }
        for y in experiments.iter_mut().flat_map(|e| &mut e.y) {
            *y /= scale;
        }
        Some(Self {
            experiments,
            shape,
            scale,
        })
    }

    /// Parameters and first states of the position, from those of its speed; positions begin at 0.
    ///
    /// With `w` the speed, `p+ = p + w` and `y = p + w`. The last hidden unit becomes the constant part of the speed,
    /// because state equations have none.
    pub fn integrated(&self, speed: &[f64], position: Shape) -> Vec<f64> {
        let (nx, hidden, inputs) = (self.shape.nx, self.shape.hidden, self.shape.inputs);
        let (from, to) = (self.shape.parts(), position.parts());
        let mut theta = vec![0.0; position.parameters()];
        //   speed      w(k)  = C x + D v + c + G h        x+ = A x + B v + E h
        //   position   p+ = p + w,  y = p + w: the last state p, whose row of [A B E] and the output's row of [C D G] are w's
        //   A' = | A 0 |   B' = | B |   E' = | E 0 |   C' = [C 1]   D' = D   G' = [G c/tanh(1)]
        //        | C 1 |        | D |        | G c/tanh(1) |
        // with C, D, G and c times `scale`. The additional last unit has no weights and the bias 1: its output is
        // tanh(1) at every sample.
        let mut copy = |from: usize, to: usize, count: usize, factor: f64| {
            let values = theta[to..][..count].iter_mut().zip(&speed[from..][..count]);
            values.for_each(|(to, from)| *to = factor * from);
        };
        for i in 0..nx {
            copy(from.a.start + i * nx, to.a.start + i * (nx + 1), nx, 1.0);
            copy(
                from.b.start + i * inputs,
                to.b.start + i * inputs,
                inputs,
                1.0,
            );
            let (e, own) = (from.e.start + i * hidden, to.e.start + i * position.hidden);
            copy(e, own, hidden, 1.0);
        }
        // Rows are one number longer: the position is no argument of the hidden units, its weight is zero.
        for i in 0..hidden {
            copy(from.wx.start + i * nx, to.wx.start + i * (nx + 1), nx, 1.0);
        }
        copy(from.wu.start, to.wu.start, hidden * inputs, 1.0);
        copy(from.bh.start, to.bh.start, hidden, 1.0);
        // the speed moves the position and, in the same sample, the output
        let rows = [
            (from.c.start, to.a.start + nx * (nx + 1), to.c.start, nx),
            (from.d.start, to.b.start + nx * inputs, to.d.start, inputs),
            (
                from.g.start,
                to.e.start + nx * position.hidden,
                to.g.start,
                hidden,
            ),
        ];
        for (from, state, output, count) in rows {
            copy(from, state, count, self.scale);
            copy(from, output, count, self.scale);
        }
        theta[to.c.end - 1] = 1.0;
        let constant = self.scale * speed[from.constant.start] / f64::tanh(1.0);
        theta[to.bh.end - 1] = 1.0;
        theta[to.e.end - 1] = constant;
        theta[to.g.end - 1] = constant;
        // Sets the pole to 1, and the weights of the position to zero.
        position.hold(&mut theta);
        // The experiments' initial states come after theta; each gets a position of 0 at its end.
        for state in speed[from.g.end..].chunks_exact(nx) {
            theta.extend(state.iter().chain([&0.0]));
        }
        theta
    }
}

/// Each output minus the previous one; unknown if one of them is.
fn differences(experiment: &Experiment) -> Experiment {
    let y = &experiment.y;
    // NaN minus anything is NaN: a gap removes the difference after it, too.
    let steps = y.iter().zip(y.iter().skip(1)).map(|(y, next)| next - y);
    Experiment {
        y: [f64::NAN].into_iter().take(y.len()).chain(steps).collect(),
        ..experiment.clone()
    }
}

/// Time constant of the leak, in multiples of the samples in which a position moves by a quarter of its standard deviation.
const MEMORY: f64 = 2.0;

/// Filtered recordings, with the conversion of the parameters.
pub(super) struct Leak {
    pub experiments: Vec<Experiment>,
    pole: f64,
    scale: f64,
}

impl Leak {
    /// The filter for positions of this pace; `None` if nothing moves.
    pub fn new(experiments: &[Experiment], pace: usize) -> Option<Self> {
        // The time constant is 1/(1 - p) samples, at least two: p = 1/2.
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

    /// Converts parameters and states for the filtered outputs: the position begins at 0, as they do.
    pub fn entered(&self, theta: &mut [f64], shape: Shape) {
        self.scaled(theta, shape, 1.0 / self.scale);
        // H has zero gain at rest: the constant part of the output vanishes, and c with it.
        theta[shape.parts().constant].fill(0.0);
        theta[shape.pole()] = self.pole;
        for state in theta[shape.parameters()..].chunks_exact_mut(shape.nx) {
            state[shape.nx - 1] = 0.0;
        }
    }

    /// Converts the parameters back for the unfiltered outputs; the initial positions remain to be found.
    pub fn left(&self, theta: &mut [f64], shape: Shape) {
        self.scaled(theta, shape, self.scale);
        theta[shape.pole()] = 1.0;
    }

    fn scaled(&self, theta: &mut [f64], shape: Shape, factor: f64) {
        let parts = shape.parts();
        // C, D, c and G are adjacent
        theta[parts.c.start..parts.g.end]
            .iter_mut()
            .for_each(|t| *t *= factor);
    }
}

/// The filtered outputs, from rest; over a gap the last known position is held.
fn behind(pole: f64, experiment: &Experiment) -> Experiment {
    let (mut last, mut sum) = (None, 0.0);
    let filtered = experiment.y.iter().map(|y| {
        if y.is_nan() {
            return f64::NAN;
        }
        // z(k) = p z(k-1) + y(k) - y(k-1); the difference over a gap is one jump.
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
    use super::super::network::Network;
    use super::super::output::OutputFunction;
    use super::super::problem::{Attempts, Training};
    use super::super::tests::noise;
    use super::*;
    use crate::Monitor;
    use crate::lm::Problem;

    fn position(nx: usize, hidden: usize) -> Shape {
        Shape {
            nx,
            nk: 1,
            inputs: 2,
            hidden,
            integrator: true,
        }
    }

    fn run(shape: Shape, theta: &[f64], experiments: &[Experiment]) -> Vec<f64> {
        let network = Network::new(shape, OutputFunction::Linear, &theta[..shape.parameters()]);
        let attempts = Attempts::new(&network, experiments);
        let monitor = Monitor::default();
        let mut problem = Training::new(experiments, network, 0.0, &attempts, &monitor);
        assert!(problem.cost(theta).is_some());
        attempts.at(theta)[0].sums.clone()
    }

    #[test]
    fn the_position_is_the_sum_of_the_speed() {
        for (nx, hidden) in [(2, 3), (3, 4), (4, 9)] {
            let shape = position(nx, hidden);
            let experiments = [Experiment {
                v: noise(400, 1),
                y: noise(200, 2),
                weights: Vec::new(),
            }];
            let speed = Speed::new(&experiments, shape).unwrap();
            let count = speed.shape.parameters() + speed.shape.nx;
            let theta: Vec<f64> = noise(count, 3).iter().map(|t| 0.2 * t).collect();
            let speeds = run(speed.shape, &theta, &speed.experiments);
            let found = run(shape, &speed.integrated(&theta, shape), &experiments);
            let mut sum = 0.0;
            for (w, y) in speeds.iter().zip(found) {
                sum += speed.scale * w;
                assert!((y - sum).abs() < 1e-9, "{y} {sum}");
            }
        }
    }

    #[test]
    fn keeps_gaps_and_is_none_where_nothing_moves() {
        let experiment = |y: Vec<f64>| Experiment {
            v: vec![0.0; 2 * y.len()],
            y,
            weights: Vec::new(),
        };
        let found = Speed::new(
            &[experiment(vec![0.0, 2.0, f64::NAN, 5.0, 3.0])],
            position(2, 3),
        )
        .unwrap();
        let y = &found.experiments[0].y;
        assert!(y[0].is_nan() && y[2].is_nan() && y[3].is_nan());
        assert_eq!((y[1], y[4], found.scale), (1.0, -1.0, 2.0));
        assert!(Speed::new(&[experiment(vec![2.0; 9])], position(2, 3)).is_none());
        for (nx, hidden) in [(1, 3), (2, 2)] {
            assert!(Speed::new(&[experiment(vec![0.0, 1.0])], position(nx, hidden)).is_none());
        }
    }

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
