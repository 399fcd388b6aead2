//! Quadratic models of the cost and of the excess over the limits around the centre of a search, fitted to the nearest judged points.
//! The least cost mostly lies on a limit, which a model of the cost alone would lead beyond.
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
/// Doublings until the pull to the centre is strong enough.
const DOUBLINGS: usize = 200;
/// Halvings to find the strength needed.
const HALVINGS: usize = 40;

/// Coefficients of a quadratic function.
fn coefficients(dimensions: usize) -> usize {
    (dimensions + 1) * (dimensions + 2) / 2
}

/// Points that were judged, the latest last.
#[derive(Clone, Debug, Default)]
pub(super) struct Archive {
    /// Those whose cost is known.
    costs: Vec<(DVector<f64>, f64)>,
    /// Those whose excess is known.
    excesses: Vec<(DVector<f64>, f64)>,
}

impl Archive {
    /// Keeps what is known: a candidate that could not beat `to_beat` has only a bound of its cost.
    pub(super) fn keep(&mut self, candidates: &[Candidate], judgements: &[Judgement]) {
        let dimensions = candidates.first().map_or(0, |c| c.point.len());
        for (candidate, judged) in candidates.iter().zip(judgements) {
            let point = DVector::from_column_slice(&candidate.point);
            if judged.excess.is_finite() {
                self.excesses.push((point.clone(), judged.excess));
            }
            if judged.cost.is_finite() && judged.beats(&candidate.to_beat) {
                self.costs.push((point, judged.cost));
            }
        }
        for points in [&mut self.costs, &mut self.excesses] {
            if points.len() > KEPT * coefficients(dimensions) {
                points.drain(..points.len() / 2);
            }
        }
    }
}

/// The points nearest to the centre, in the distribution's coordinates; `None` if there are not enough.
fn nearest(points: &[(DVector<f64>, f64)], about: Ellipsoid<'_>) -> Option<Vec<Near>> {
    let count = POINTS * coefficients(about.centre.len());
    if points.len() < count {
        return None;
    }
    let near = |(point, value): &(DVector<f64>, f64)| {
        let place = about.place(point);
        Near {
            far: place.norm_squared(),
            place,
            value: *value,
        }
    };
    let mut all: Vec<Near> = points.iter().map(near).collect();
    all.select_nth_unstable_by(count - 1, |a, b| a.far.total_cmp(&b.far));
    all.truncate(count);
    Some(all)
}

/// A judged point in the distribution's coordinates.
struct Near {
    place: DVector<f64>,
    /// Squared distance from the centre.
    far: f64,
    value: f64,
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

/// `c + g' d + d' H d / 2` of a distance `d` from the centre.
#[derive(Clone, Debug)]
struct Quadratic {
    level: f64,
    slope: DVector<f64>,
    curvature: DMatrix<f64>,
}

impl Quadratic {
    /// Fitted to the nearest points; those whose value is far from `base` count less, much dearer points say little about a valley.
    /// With the standard deviation of its residuals.
    fn fit(near: &[Near], about: Ellipsoid<'_>, base: f64) -> Option<(Self, f64)> {
        let n = about.centre.len();
        let (found, scatter) = regression(near, n, base)?;
        let mut curvature = DMatrix::zeros(n, n);
        for ((i, j), c) in pairs(n).zip(found.iter().skip(1 + n)) {
            curvature[(i, j)] += c;
            curvature[(j, i)] += c;
        }
        let whitening = about.whitening();
        let quadratic = Self {
            level: base + found[0],
            slope: whitening.tr_mul(&found.rows(1, n)),
            curvature: whitening.tr_mul(&curvature) * &whitening,
        };
        Some((quadratic, scatter))
    }

    fn at(&self, step: &DVector<f64>) -> f64 {
        self.level + step.dot(&self.slope) + 0.5 * step.dot(&(&self.curvature * step))
    }

    /// Its sum with a multiple of another one.
    fn plus(&self, factor: f64, other: &Self) -> Self {
        Self {
            level: self.level + factor * other.level,
            slope: &self.slope + factor * &other.slope,
            curvature: &self.curvature + factor * &other.curvature,
        }
    }
}

/// The cost, the excess over the limits if there are any, and the metric of the distribution.
#[derive(Clone, Debug)]
pub(super) struct Model {
    centre: DVector<f64>,
    cost: Quadratic,
    /// With its residuals' standard deviation above it, so that what is below 0 is within the limits.
    excess: Option<Quadratic>,
    /// The inverse of the distribution's covariance.
    metric: DMatrix<f64>,
}

impl Model {
    /// `None` with too few points or too many dimensions.
    pub(super) fn fit(archive: &Archive, about: Ellipsoid<'_>) -> Option<Self> {
        if about.centre.len() > DIMENSIONS {
            return None;
        }
        let near = nearest(&archive.costs, about)?;
        let cheapest = near.iter().map(|p| p.value).fold(f64::INFINITY, f64::min);
        let limit = |near: Vec<Near>| {
            let (excess, scatter) = Quadratic::fit(&near, about, 0.0)?;
            let level = excess.level + scatter;
            Some(Quadratic { level, ..excess })
        };
        let whitening = about.whitening();
        Some(Self {
            centre: about.centre.clone(),
            cost: Quadratic::fit(&near, about, cheapest)?.0,
            excess: nearest(&archive.excesses, about).and_then(limit),
            metric: whitening.tr_mul(&whitening),
        })
    }

    /// The least cost within the box, the limits and `radius` standard deviations from the centre. The weight of the excess beside the cost
    /// is the least that keeps the point within the limits, or that comes nearest to them.
    pub(super) fn least(&self, radius: f64) -> Option<DVector<f64>> {
        let free = self.boxed(&self.cost, radius)?;
        let Some(excess) = self.excess.as_ref().filter(|e| e.at(&free) > 0.0) else {
            return Some(self.place(&free));
        };
        let within = |weight: f64| {
            let step = self.boxed(&self.cost.plus(weight, excess), radius)?;
            (excess.at(&step) <= 0.0).then_some(step)
        };
        let start = self.cost.slope.norm() / excess.slope.norm();
        let found = weakest(start, HALVINGS, within).or_else(|| self.boxed(excess, radius))?;
        Some(self.place(&found))
    }

    fn place(&self, step: &DVector<f64>) -> DVector<f64> {
        (&self.centre + step).map(|x| x.clamp(0.0, 1.0))
    }

    /// The step to the minimum within the box and the radius. A coordinate that leaves the box is fixed at its edge, and the others are
    /// solved again.
    fn boxed(&self, of: &Quadratic, radius: f64) -> Option<DVector<f64>> {
        let n = self.centre.len();
        let mut fixed = vec![None; n];
        loop {
            let step = self.step(of, &fixed, radius)?;
            let point = &self.centre + &step;
            let leaves = |i: &usize| fixed[*i].is_none() && !(0.0..=1.0).contains(&point[*i]);
            let leaving: Vec<usize> = (0..n).filter(leaves).collect();
            if leaving.is_empty() {
                return Some(step);
            }
            for i in leaving {
                fixed[i] = Some(point[i].clamp(0.0, 1.0) - self.centre[i]);
            }
        }
    }

    /// The best step within a radius with some coordinates fixed. Halving finds the least pull to the centre that keeps
    /// the step inside (Nocedal and Wright 2006, section 4.3).
    fn step(&self, of: &Quadratic, fixed: &[Option<f64>], radius: f64) -> Option<DVector<f64>> {
        let inside = |pull: f64| {
            let step = self.pulled(of, fixed, pull)?;
            (step.dot(&(&self.metric * &step)) <= radius * radius).then_some(step)
        };
        if let Some(step) = inside(0.0) {
            return Some(step);
        }
        let start = of.curvature.norm() / self.metric.norm();
        let strongest = start * 2.0_f64.powi(DOUBLINGS as i32);
        // Coordinates fixed at the edge may already lie beyond the radius.
        weakest(start, DOUBLINGS, inside).or_else(|| self.pulled(of, fixed, strongest))
    }

    /// Solves `(H + pull M) d = -g` for the free coordinates; `None` if that is no minimum.
    fn pulled(&self, of: &Quadratic, fixed: &[Option<f64>], pull: f64) -> Option<DVector<f64>> {
        let free: Vec<usize> = (0..fixed.len()).filter(|&i| fixed[i].is_none()).collect();
        let mut step = DVector::from_iterator(fixed.len(), fixed.iter().map(|f| f.unwrap_or(0.0)));
        let matrix = &of.curvature + pull * &self.metric;
        let slope = &of.slope + &matrix * &step;
        let own = matrix.select_rows(&free).select_columns(&free);
        let found = own.cholesky()?.solve(&slope.select_rows(&free));
        for (i, x) in free.iter().zip(found.iter()) {
            step[*i] = -x;
        }
        step.iter().all(|x| x.is_finite()).then_some(step)
    }
}

/// The result of the least strength that has one, by doubling from `start` and then halving; `None` after so many doublings
/// without a result.
fn weakest<T>(start: f64, doublings: usize, of: impl Fn(f64) -> Option<T>) -> Option<T> {
    let (mut low, mut high) = (0.0, start);
    let mut best = (0..doublings).find_map(|_| {
        high *= 2.0;
        of(high)
    })?;
    for _ in 0..HALVINGS {
        let middle = 0.5 * (low + high);
        match of(middle) {
            Some(found) => (best, high) = (found, middle),
            None => low = middle,
        }
    }
    Some(best)
}

/// Coefficients of `1, z, z_i z_j` fitted to values less `base`, and the standard deviation of the residuals; near points, and those with
/// values near to the base, weigh more.
fn regression(near: &[Near], n: usize, base: f64) -> Option<(DVector<f64>, f64)> {
    let mut beyond: Vec<f64> = near.iter().map(|p| (p.value - base).abs()).collect();
    beyond.sort_by(f64::total_cmp);
    let cheap = beyond[(CHEAP * beyond.len() as f64) as usize];
    let reach = REACH * near.iter().map(|p| p.far).fold(0.0, f64::max);
    let size = coefficients(n);
    let (mut normal, mut right) = (DMatrix::zeros(size, size), DVector::zeros(size));
    let mut rows = Vec::with_capacity(near.len());
    for Near { place, far, value } in near {
        let dear = ((value - base) / cheap.max(f64::MIN_POSITIVE)).powi(2);
        let weight = (1.0 - far / reach).powi(2) / (1.0 + dear);
        let products = pairs(n).map(|(i, j)| place[i] * place[j]);
        let terms = std::iter::once(1.0).chain(place.iter().copied());
        let row = DVector::from_iterator(size, terms.chain(products));
        normal.ger(weight, &row, &row, 1.0);
        right.axpy(weight * (value - base), &row, 1.0);
        rows.push((weight, row, value - base));
    }
    let ridge = RIDGE * normal.trace() / size as f64;
    for i in 0..size {
        normal[(i, i)] += ridge;
    }
    let found = normal.cholesky()?.solve(&right);
    let square = |(w, row, value): &(f64, DVector<f64>, f64)| w * (row.dot(&found) - value).powi(2);
    let squares: f64 = rows.iter().map(square).sum();
    let weights: f64 = rows.iter().map(|(weight, ..)| weight).sum();
    Some((found, (squares / weights).sqrt()))
}

/// Indices of a matrix on and below its diagonal.
fn pairs(n: usize) -> impl Iterator<Item = (usize, usize)> {
    (0..n).flat_map(|i| (0..=i).map(move |j| (i, j)))
}
