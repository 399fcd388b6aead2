//! The trust region: the best step within a radius, and how the radius follows success and failure.
//!
//! The subproblem `min |r + J p|, |D p| <= radius` has the solution of the damped system `[J; sqrt(lambda) D] p = -[r; 0]`
//! for one `lambda >= 0`, which Newton's method finds on `|D p(lambda)| = radius` (More, The Levenberg-Marquardt
//! algorithm, Lecture Notes in Mathematics 630, 1978, 105-116).

use super::triangle::Triangle;

/// Relative accuracy of `|D p| = radius`.
const SLACK: f64 = 0.1;
/// Newton steps for lambda; more are never needed for that accuracy.
const MOST_TRIALS: usize = 30;
/// The first radius in lengths of the scaled start (More recommends 0.1 to 100).
const FIRST: f64 = 1.0;
/// Least share of the promised reduction that a step must bring.
const LEAST_GAIN: f64 = 1e-4;

/// Radius, damping and the step they give, in the free parameters.
pub(super) struct Radius {
    /// None before the first step.
    radius: Option<f64>,
    lambda: f64,
    /// `|D p|` of the last step.
    pub length: f64,
    damped: Triangle,
    work: Vec<f64>,
    first_trial: bool,
}

/// The reduction that the linear model promises, relative to the cost, and its slope at the start.
#[derive(Clone, Copy, Debug)]
pub(super) struct Promise {
    pub reduction: f64,
    pub slope: f64,
}

impl Radius {
    pub fn new(n: usize) -> Self {
        Self {
            radius: None,
            lambda: 0.0,
            length: 0.0,
            damped: Triangle::new(n),
            work: vec![0.0; n],
            first_trial: true,
        }
    }

    /// True where the last step was a full Gauss-Newton step.
    pub fn is_undamped(&self) -> bool {
        self.lambda == 0.0
    }

    /// True where the radius is below `tolerance` times the scaled length of the parameters.
    pub fn is_below(&self, tolerance: f64, size: f64) -> bool {
        self.radius.is_some_and(|radius| radius <= tolerance * size)
    }

    /// Starts from the scaled length of the parameters, once.
    pub fn begin(&mut self, size: f64) {
        self.radius
            .get_or_insert(if size > 0.0 { FIRST * size } else { FIRST });
    }

    /// Fills the step that minimises the linear model within the radius.
    pub fn step(&mut self, triangle: &Triangle, d: &[f64], p: &mut [f64]) {
        let radius = self.radius.unwrap_or(FIRST);
        let regular = triangle.is_solvable();
        // A singular system is damped by what rounding leaves of its null space.
        let mut lower = if regular {
            0.0
        } else {
            (f64::EPSILON * d.len() as f64).powi(2)
        };
        if regular {
            triangle.minimiser(p);
            let length = scaled_length(d, p);
            if length <= (1.0 + SLACK) * radius {
                (self.lambda, self.length) = (0.0, length);
                return;
            }
            let slope = self.slope(triangle, d, p, length);
            lower = (length - radius) / radius * slope;
        }
        triangle.gradient(p);
        let upper = p
            .iter()
            .zip(d)
            .map(|(g, d)| (g / d).powi(2))
            .sum::<f64>()
            .sqrt()
            / radius;
        self.search(triangle, d, p, radius, lower, upper.max(lower));
    }

    fn search(
        &mut self,
        triangle: &Triangle,
        d: &[f64],
        p: &mut [f64],
        radius: f64,
        floor: f64,
        mut upper: f64,
    ) {
        let mut lower = floor;
        let mut lambda = self.lambda.clamp(lower, upper);
        if lambda == 0.0 {
            lambda = 1e-3 * upper;
        }
        for _ in 0..MOST_TRIALS {
            self.damp(triangle, d, lambda);
            self.damped.minimiser(p);
            let length = scaled_length(d, p);
            (self.lambda, self.length) = (lambda, length);
            let excess = length - radius;
            if excess.abs() <= SLACK * radius || (excess < 0.0 && lambda <= floor) || length == 0.0
            {
                return;
            }
            if excess > 0.0 {
                lower = lower.max(lambda);
            } else {
                upper = upper.min(lambda);
            }
            let damped = std::mem::replace(&mut self.damped, Triangle::new(0));
            let slope = self.slope(&damped, d, p, length);
            self.damped = damped;
            lambda = (lambda + excess / radius * slope).max(lower);
            if lambda > upper {
                lambda = (lower * upper).sqrt().max(1e-3 * upper);
            }
        }
        let shorter = (radius / self.length).min(1.0);
        p.iter_mut().for_each(|p| *p *= shorter);
        self.length *= shorter;
    }

    /// `1 / |R^-T D^2 p / |D p||^2`, from the derivative of `|D p(lambda)|`.
    fn slope(&mut self, triangle: &Triangle, d: &[f64], p: &[f64], length: f64) -> f64 {
        let work = &mut self.work[..d.len()];
        for ((w, d), p) in work.iter_mut().zip(d).zip(p) {
            *w = d * (d * p / length);
        }
        triangle.solve_transposed(work);
        1.0 / work.iter().map(|w| w * w).sum::<f64>()
    }

    /// The triangle of `[R; sqrt(lambda) D]`.
    fn damp(&mut self, triangle: &Triangle, d: &[f64], lambda: f64) {
        self.damped.copy_from(triangle);
        let root = lambda.sqrt();
        for (j, d) in d.iter().enumerate() {
            self.damped.push(|row| {
                row.fill(0.0);
                row[j] = root * d;
            });
        }
        self.damped.fold();
    }

    /// What the last step promises, for a residual of length `norm`; `image` is `R p`.
    pub fn promise(&self, image: &[f64], norm: f64) -> Promise {
        let linear = image.iter().map(|v| (v / norm).powi(2)).sum::<f64>();
        let damping = self.lambda * (self.length / norm).powi(2);
        Promise {
            reduction: linear + 2.0 * damping,
            slope: -(linear + damping),
        }
    }

    /// Adapts the radius to the reduction that came, relative to the cost (minus infinity where it rose much or is not finite);
    /// true where the step is good enough.
    pub fn learn(&mut self, promise: Promise, actual: f64) -> bool {
        let radius = self.radius.unwrap_or(FIRST);
        let radius = if std::mem::take(&mut self.first_trial) {
            radius.min(self.length)
        } else {
            radius
        };
        let ratio = if promise.reduction > 0.0 {
            actual / promise.reduction
        } else {
            0.0
        };
        self.radius = Some(radius);
        if ratio <= 0.25 {
            let shrink = shrinkage(promise.slope, actual);
            self.radius = Some(shrink * radius.min(self.length / 0.1));
            self.lambda /= shrink;
        } else if self.lambda == 0.0 || ratio >= 0.75 {
            self.radius = Some(self.length / 0.5);
            self.lambda *= 0.5;
        }
        ratio >= LEAST_GAIN
    }
}

/// Where the parabola through both costs and the slope has its minimum, within 0.1 to 0.5.
fn shrinkage(slope: f64, actual: f64) -> f64 {
    if actual >= 0.0 {
        return 0.5;
    }
    (0.5 * slope / (slope + 0.5 * actual)).clamp(0.1, 0.5)
}

/// `|D p|`.
pub(super) fn scaled_length(d: &[f64], p: &[f64]) -> f64 {
    d.iter()
        .zip(p)
        .map(|(d, p)| (d * p).powi(2))
        .sum::<f64>()
        .sqrt()
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn triangle_of(rows: &[[f64; 4]]) -> Triangle {
        let mut triangle = Triangle::new(3);
        for row in rows {
            triangle.push(|out| out.copy_from_slice(row));
        }
        triangle.fold();
        triangle
    }

    proptest! {
        #[test]
        fn a_step_fills_the_region_and_no_shorter_one_is_better(
            rows in prop::collection::vec(prop::array::uniform4(-5.0..5.0f64), 3..20),
            reach in 1e-3..10.0f64,
            direction in prop::array::uniform3(-1.0..1.0f64),
        ) {
            let (triangle, d) = (triangle_of(&rows), [1.0, 2.0, 0.5]);
            let mut radius = Radius::new(3);
            radius.radius = Some(reach);
            let mut p = [0.0; 3];
            radius.step(&triangle, &d, &mut p);
            let length = scaled_length(&d, &p);
            prop_assert!(length <= 1.11 * reach);
            prop_assert!(radius.is_undamped() || length >= 0.89 * reach || !triangle.seems_regular());
            let model = |p: &[f64]| rows.iter()
                .map(|r| (r[3] + r[0] * p[0] + r[1] * p[1] + r[2] * p[2]).powi(2)).sum::<f64>();
            let scale = length / scaled_length(&d, &direction).max(1e-9);
            let other = direction.map(|v| v * scale * 0.999);
            prop_assert!(model(&p) <= model(&other) * (1.0 + 1e-9) + 1e-9);
        }
    }

    #[test]
    fn follows_success_and_failure() {
        let triangle = triangle_of(&[
            [1.0, 0.0, 0.0, -1.0],
            [0.0, 1.0, 0.0, -1.0],
            [0.0, 0.0, 1.0, -1.0],
        ]);
        let mut radius = Radius::new(3);
        radius.begin(0.5);
        let (mut p, mut image, d) = ([0.0; 3], [0.0; 3], [1.0; 3]);
        radius.step(&triangle, &d, &mut p);
        triangle.times(&p, &mut image);
        let promise = radius.promise(&image, 3f64.sqrt());
        let model = 1.0 - p.iter().map(|p| (1.0 - p).powi(2)).sum::<f64>() / 3.0;
        assert!((promise.reduction - model).abs() < 1e-12);
        assert!(radius.learn(promise, promise.reduction) && !radius.is_below(0.9, 1.0));
        assert!(!radius.learn(promise, f64::NEG_INFINITY) && radius.is_below(0.2, 1.0));
    }
}
