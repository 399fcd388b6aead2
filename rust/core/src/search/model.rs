//! A quadratic model of the cost around the centre of a search, fitted to the nearest judged points.
//!
//! Nearness is measured by the search's own distribution, whose axes and lengths define the model's coordinates; near points count more
//! (Kern, Hansen and Koumoutsakos 2006, "Local meta-models for optimization using evolution strategies").

use nalgebra::{DMatrix, DVector};

use super::{Candidate, Judgement};

/// Points that a model is fitted to, per coefficient.
const POINTS: usize = 2;
/// Judged points that are kept, per coefficient of a model.
const KEPT: usize = 120;
/// Dimensions up to which a model costs little compared with what it saves.
const DIMENSIONS: usize = 12;
/// Squared distance at which a point's weight is 0, relative to the farthest point's.
const REACH: f64 = 1.05;
/// Quantile of the costs at which a point's weight is halved: much dearer points say little about the valley.
const CHEAP: f64 = 0.25;
/// Added to the diagonal of the normal equations, relative to its mean.
const RIDGE: f64 = 1e-8;
/// Doublings until the pull to the centre is strong enough, and halvings to find the strength needed.
const PULLS: (usize, usize) = (200, 40);

/// Coefficients of a quadratic function.
fn coefficients(dimensions: usize) -> usize {
    (dimensions + 1) * (dimensions + 2) / 2
}

/// Feasible points that were fully judged, the latest last.
#[derive(Clone, Debug, Default)]
pub(super) struct Archive {
    points: Vec<(DVector<f64>, f64)>,
}

impl Archive {
    /// Keeps the points whose cost is known: a candidate that could not beat `to_beat` has only a bound.
    pub(super) fn keep(&mut self, candidates: &[Candidate], judgements: &[Judgement]) {
        for (candidate, judged) in candidates.iter().zip(judgements) {
            let feasible = judged.violation == 0.0 && judged.cost.is_finite();
            if feasible && judged.beats(&candidate.to_beat) {
                let point = DVector::from_column_slice(&candidate.point);
                self.points.push((point, judged.cost));
            }
        }
        let dimensions = candidates.first().map_or(0, |c| c.point.len());
        if self.points.len() > KEPT * coefficients(dimensions) {
            self.points.drain(..self.points.len() / 2);
        }
    }

    /// The points nearest to the centre, in the distribution's coordinates.
    fn nearest(&self, about: Ellipsoid<'_>, count: usize) -> Option<Vec<Near>> {
        let beyond = count
            .checked_sub(1)
            .filter(|last| *last < self.points.len())?;
        let near = |(point, cost): &(DVector<f64>, f64)| {
            let place = about.place(point);
            Near {
                far: place.norm_squared(),
                place,
                cost: *cost,
            }
        };
        let mut all: Vec<Near> = self.points.iter().map(near).collect();
        all.select_nth_unstable_by(beyond, |a, b| a.far.total_cmp(&b.far));
        all.truncate(count);
        Some(all)
    }
}

/// A judged point in the distribution's coordinates.
struct Near {
    place: DVector<f64>,
    /// Squared distance from the centre.
    far: f64,
    cost: f64,
}

/// The distribution of a search: `centre + axes (lengths z)` with standard normal `z`.
#[derive(Clone, Copy, Debug)]
pub(super) struct Ellipsoid<'a> {
    pub(super) centre: &'a DVector<f64>,
    pub(super) axes: &'a DMatrix<f64>,
    pub(super) lengths: &'a DVector<f64>,
}

impl Ellipsoid<'_> {
    /// `z` of a point.
    fn place(&self, point: &DVector<f64>) -> DVector<f64> {
        let along = self.axes.tr_mul(&(point - self.centre));
        along.component_div(self.lengths)
    }

    /// The matrix that maps a distance from the centre to `z`.
    fn whitening(&self) -> DMatrix<f64> {
        let mut whitening = self.axes.transpose();
        for (mut row, length) in whitening.row_iter_mut().zip(self.lengths) {
            row /= *length;
        }
        whitening
    }
}

/// `g' d + d' H d / 2` of a distance `d` from the centre, and the metric of the distribution.
#[derive(Clone, Debug)]
pub(super) struct Model {
    centre: DVector<f64>,
    slope: DVector<f64>,
    curvature: DMatrix<f64>,
    /// The inverse of the distribution's covariance.
    metric: DMatrix<f64>,
}

impl Model {
    /// `None` with too few points or too many dimensions.
    pub(super) fn fit(archive: &Archive, about: Ellipsoid<'_>) -> Option<Self> {
        let n = about.centre.len();
        if n > DIMENSIONS {
            return None;
        }
        let near = archive.nearest(about, POINTS * coefficients(n))?;
        let found = regression(&near, n)?;
        let mut curvature = DMatrix::zeros(n, n);
        for ((i, j), c) in pairs(n).zip(found.iter().skip(1 + n)) {
            curvature[(i, j)] += c;
            curvature[(j, i)] += c;
        }
        let whitening = about.whitening();
        Some(Self {
            centre: about.centre.clone(),
            slope: whitening.tr_mul(&found.rows(1, n)),
            curvature: whitening.tr_mul(&curvature) * &whitening,
            metric: whitening.tr_mul(&whitening),
        })
    }

    /// The minimum within the box and within `radius` standard deviations from the centre. A coordinate that leaves the
    /// box is fixed at its edge, and the others are solved again.
    pub(super) fn least(&self, radius: f64) -> Option<DVector<f64>> {
        let n = self.centre.len();
        let mut fixed = vec![None; n];
        loop {
            let point = &self.centre + self.step(&fixed, radius)?;
            let leaves = |i: &usize| fixed[*i].is_none() && !(0.0..=1.0).contains(&point[*i]);
            let leaving: Vec<usize> = (0..n).filter(leaves).collect();
            if leaving.is_empty() {
                return Some(point.map(|x| x.clamp(0.0, 1.0)));
            }
            for i in leaving {
                fixed[i] = Some(point[i].clamp(0.0, 1.0) - self.centre[i]);
            }
        }
    }

    /// The best step within a radius with some coordinates fixed. Halving finds the least pull to the centre that keeps
    /// the step inside (Nocedal and Wright 2006, section 4.3).
    fn step(&self, fixed: &[Option<f64>], radius: f64) -> Option<DVector<f64>> {
        let inside = |pull: f64| {
            let step = self.pulled(fixed, pull)?;
            (step.dot(&(&self.metric * &step)) <= radius * radius).then_some(step)
        };
        if let Some(step) = inside(0.0) {
            return Some(step);
        }
        let (mut low, mut high) = (0.0, self.curvature.norm() / self.metric.norm());
        let doubled = (0..PULLS.0).find_map(|_| {
            high *= 2.0;
            inside(high)
        });
        // Coordinates fixed at the edge may already lie beyond the radius.
        let mut best = doubled.or_else(|| self.pulled(fixed, high))?;
        for _ in 0..PULLS.1 {
            let middle = 0.5 * (low + high);
            match inside(middle) {
                Some(step) => (best, high) = (step, middle),
                None => low = middle,
            }
        }
        Some(best)
    }

    /// Solves `(H + pull M) d = -g` for the free coordinates; `None` if that is no minimum.
    fn pulled(&self, fixed: &[Option<f64>], pull: f64) -> Option<DVector<f64>> {
        let free: Vec<usize> = (0..fixed.len()).filter(|&i| fixed[i].is_none()).collect();
        let mut step = DVector::from_iterator(fixed.len(), fixed.iter().map(|f| f.unwrap_or(0.0)));
        let matrix = &self.curvature + pull * &self.metric;
        let slope = &self.slope + &matrix * &step;
        let own = matrix.select_rows(&free).select_columns(&free);
        let found = own.cholesky()?.solve(&slope.select_rows(&free));
        for (i, x) in free.iter().zip(found.iter()) {
            step[*i] = -x;
        }
        step.iter().all(|x| x.is_finite()).then_some(step)
    }
}

/// Coefficients of `1, z, z_i z_j` fitted to the costs; near and cheap points weigh more.
fn regression(near: &[Near], n: usize) -> Option<DVector<f64>> {
    let mut costs: Vec<f64> = near.iter().map(|p| p.cost).collect();
    costs.sort_by(f64::total_cmp);
    let base = costs[0];
    let cheap = costs[(CHEAP * costs.len() as f64) as usize] - base;
    let reach = REACH * near.iter().map(|p| p.far).fold(0.0, f64::max);
    let size = coefficients(n);
    let (mut normal, mut right) = (DMatrix::zeros(size, size), DVector::zeros(size));
    for Near { place, far, cost } in near {
        let dear = ((cost - base) / cheap.max(f64::MIN_POSITIVE)).powi(2);
        let weight = (1.0 - far / reach).powi(2) / (1.0 + dear);
        let products = pairs(n).map(|(i, j)| place[i] * place[j]);
        let terms = std::iter::once(1.0).chain(place.iter().copied());
        let row = DVector::from_iterator(size, terms.chain(products));
        normal.ger(weight, &row, &row, 1.0);
        right.axpy(weight * (cost - base), &row, 1.0);
    }
    let ridge = RIDGE * normal.trace() / size as f64;
    for i in 0..size {
        normal[(i, i)] += ridge;
    }
    Some(normal.cholesky()?.solve(&right))
}

/// Indices of a matrix on and below its diagonal.
fn pairs(n: usize) -> impl Iterator<Item = (usize, usize)> {
    (0..n).flat_map(|i| (0..=i).map(move |j| (i, j)))
}
