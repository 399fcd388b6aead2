//! One iteration of refined instrumental variables: everything filtered by `1/A`, then the linear estimate.

use nalgebra::{DMatrix, DVector};

use super::{Point, Run, best_run, responses};
use crate::lagged::Lags;
use crate::linear::{LinearModel, is_stable, soften, spread, stabilised};
use crate::monitor::look;
use crate::{Monitor, Record};

/// A pivot of the scaled matrix below this part of the largest one has no digits left.
const SMALL_PIVOT: f64 = 1e-14;

/// Which past outputs are in the regressor.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Outputs {
    /// The model's own free run: no noise in it.
    Simulated,
    /// The measured ones.
    Measured,
}

/// The records and what stays the same over the iterations.
pub(super) struct Refiner<'a> {
    records: &'a [Record<'a>],
    lags: Lags,
    monitor: &'a Monitor,
    /// Means subtracted from inputs and output if there is an offset; this keeps the columns well separated.
    centre: Option<Centre>,
}

struct Centre {
    u: Vec<f64>,
    y: f64,
}

/// An estimate and whether poles had to be mirrored into the unit circle.
pub(super) struct Estimate {
    pub model: LinearModel,
    pub reflected: bool,
}

impl<'a> Refiner<'a> {
    pub fn new(records: &'a [Record<'a>], lags: Lags, offset: bool, monitor: &'a Monitor) -> Self {
        let mean = |values: &mut dyn Iterator<Item = f64>| {
            let (n, sum) = values
                .filter(|v| !v.is_nan())
                .fold((0.0, 0.0), |(n, sum), v| (n + 1.0, sum + v));
            sum / f64::max(n, 1.0)
        };
        let input = |j: usize| {
            let mut values = records
                .iter()
                .flat_map(|r| r.u.iter().skip(j).step_by(lags.channels).copied());
            mean(&mut values)
        };
        let centre = offset.then(|| Centre {
            u: (0..lags.channels).map(input).collect(),
            y: mean(&mut records.iter().flat_map(|r| r.y.iter().copied())),
        });
        Self {
            records,
            lags,
            monitor,
            centre,
        }
    }

    /// The model with its free runs; `None` if one is not finite or a stop was requested.
    pub fn point(&self, model: LinearModel) -> Option<Point> {
        let longest = self.records.iter().map(Record::len).max()?;
        let responses = responses(model.a(), longest);
        let run = |r: &Record| {
            let go_on = !self.monitor.stopped();
            go_on.then(|| best_run(&model, r, &responses)).flatten()
        };
        let runs = self.records.iter().map(run).collect::<Option<_>>()?;
        Some(Point { model, runs })
    }

    /// The estimate whose errors, filtered by `1/A` of `model`, are uncorrelated with the instruments.
    pub fn refine(&self, point: &Point, instruments: Outputs) -> Option<Estimate> {
        let (left, right) = self.moments(point, instruments, Outputs::Measured)?;
        let solution = solved(left, right)?;
        let raw: Vec<f64> = solution.iter().take(self.lags.na).map(|a| -a).collect();
        let b = &solution.as_slice()[self.lags.na..self.lags.regressors()];
        if !raw.iter().chain(b).all(|v| v.is_finite()) {
            return None;
        }
        let a = stabilised(&raw);
        let offset = self.offset(&a, b, solution.as_slice().last().copied());
        let (channels, nk) = (self.lags.channels, self.lags.nk);
        let model = LinearModel::new(a, b.to_vec(), channels, nk, offset).ok()?;
        let reflected = !is_stable(&raw, 1e-6);
        Some(Estimate { model, reflected })
    }

    /// The offset in the data's units, from that of the centred data.
    fn offset(&self, a: &[f64], b: &[f64], centred: Option<f64>) -> f64 {
        let (Some(centre), Some(centred)) = (&self.centre, centred) else {
            return 0.0;
        };
        let steady = centre.y * (1.0 + a.iter().sum::<f64>());
        let inputs = b.chunks_exact(self.lags.nb).zip(&centre.u);
        inputs.fold(centred + steady, |sum, (b, u)| {
            sum - u * b.iter().sum::<f64>()
        })
    }

    /// Covariance of [a, b, offset] for white noise of this variance, from the inverse of the noise-free regressors' matrix.
    pub fn covariance(&self, point: &Point, variance: f64) -> Option<DMatrix<f64>> {
        let (simulated, na) = (Outputs::Simulated, self.lags.na);
        let (information, _) = self.moments(point, simulated, simulated)?;
        let centred = spread(&information, variance)?;
        let n = centred.nrows();
        // the regressor holds -a, and the offset is that of centred data
        let mut back = DMatrix::from_fn(n, n, |i, j| match i == j {
            true if i < na => -1.0,
            same => f64::from(u8::from(same)),
        });
        if let Some(centre) = &self.centre {
            for j in 0..n - 1 {
                let is_output = j < na;
                back[(n - 1, j)] = if is_output {
                    -centre.y
                } else {
                    -centre.u[(j - na) / self.lags.nb]
                };
            }
        }
        Some(&back * centred * back.transpose())
    }

    /// Moments of instruments with regressors and with the output, over all records, each without its transient.
    fn moments(
        &self,
        point: &Point,
        instruments: Outputs,
        regressors: Outputs,
    ) -> Option<(DMatrix<f64>, DVector<f64>)> {
        let columns = self.lags.regressors() + usize::from(self.centre.is_some());
        let (mut left, mut right) = (DMatrix::zeros(columns, columns), DVector::zeros(columns));
        let longest = self.records.iter().map(Record::len).max()?;
        let transient = responses(point.model.a(), longest);
        for (record, run) in self.records.iter().zip(&point.runs) {
            let series = self.filtered_series(&point.model, record, run);
            let mut sums = Sums::new(columns, self.lags.na);
            let (mut row, mut z) = (vec![0.0; columns], vec![0.0; columns]);
            let look = look(columns * columns);
            for k in self.lags.first_whole()..record.len() {
                if k & (look - 1) == 0 && self.monitor.stopped() {
                    return None;
                }
                if record.y[k].is_nan() {
                    continue;
                }
                self.write(&series, k, regressors, &mut row);
                self.write(&series, k, instruments, &mut z);
                let at = (k - self.lags.first_whole()) * self.lags.na;
                let past = transient.get(at..at + self.lags.na);
                sums.add(&z, &row, past, series.y[k]);
            }
            sums.fold_into(&mut left, &mut right)?;
        }
        Some((left, right))
    }

    fn write(&self, series: &Series, k: usize, outputs: Outputs, row: &mut [f64]) {
        let values = match outputs {
            Outputs::Simulated => &series.x,
            Outputs::Measured => &series.y,
        };
        for (i, past) in row[..self.lags.na].iter_mut().enumerate() {
            *past = values[k - 1 - i];
        }
        self.lags
            .write_inputs(&series.u, k, &mut row[self.lags.na..self.lags.regressors()]);
        row[self.lags.regressors()..].fill(series.ones[k]);
    }

    fn filtered_series(&self, model: &LinearModel, record: &Record, run: &Run) -> Series {
        let (mean_y, channels) = (self.centre.as_ref().map_or(0.0, |c| c.y), record.channels);
        let mean_u = |i: usize| self.centre.as_ref().map_or(0.0, |c| c.u[i % channels]);
        // a gap is filled with the model's output so that the filter can run through it
        let known = |(y, x): (&f64, &f64)| if y.is_nan() { x - mean_y } else { y - mean_y };
        let y = record.y.iter().zip(&run.output).map(known).collect();
        let x = run.output.iter().map(|x| x - mean_y).collect();
        let u = record.u.iter().enumerate().map(|(i, u)| u - mean_u(i));
        Series {
            y: filtered(model.a(), y, 1),
            x: filtered(model.a(), x, 1),
            u: filtered(model.a(), u.collect(), channels),
            ones: filtered(model.a(), vec![1.0; record.len()], 1),
        }
    }
}

/// Output, free run, inputs and a constant, all divided by `A(q)`.
struct Series {
    y: Vec<f64>,
    x: Vec<f64>,
    u: Vec<f64>,
    ones: Vec<f64>,
}

/// Each channel divided by `A(q)`, from zero.
fn filtered(a: &[f64], mut values: Vec<f64>, channels: usize) -> Vec<f64> {
    for k in channels..values.len() {
        let past: f64 = a
            .iter()
            .enumerate()
            .take(k / channels)
            .map(|(i, a)| a * values[k - (i + 1) * channels])
            .sum();
        values[k] -= past;
    }
    values
}

/// Moments of one record, bordered by its transient.
///
/// Events before the record reach the filtered equation as a free response of `1/A`: `na` unknown numbers per record,
/// which enter linearly. They have their own columns and are eliminated before records are added up.
struct Sums {
    left: DMatrix<f64>,
    right: DVector<f64>,
    from_transient: DMatrix<f64>,
    to_transient: DMatrix<f64>,
    transient: DMatrix<f64>,
    transient_right: DVector<f64>,
}

impl Sums {
    fn new(columns: usize, na: usize) -> Self {
        Self {
            left: DMatrix::zeros(columns, columns),
            right: DVector::zeros(columns),
            from_transient: DMatrix::zeros(columns, na),
            to_transient: DMatrix::zeros(na, columns),
            transient: DMatrix::zeros(na, na),
            transient_right: DVector::zeros(na),
        }
    }

    fn add(&mut self, z: &[f64], row: &[f64], past: Option<&[f64]>, y: f64) {
        for (j, value) in row.iter().enumerate() {
            for (i, z) in z.iter().enumerate() {
                self.left[(i, j)] += z * value;
            }
        }
        for (right, z) in self.right.iter_mut().zip(z) {
            *right += z * y;
        }
        let Some(past) = past else { return };
        for (m, t) in past.iter().enumerate() {
            self.transient_right[m] += t * y;
            for (i, z) in z.iter().enumerate() {
                self.from_transient[(i, m)] += z * t;
            }
            for (j, value) in row.iter().enumerate() {
                self.to_transient[(m, j)] += t * value;
            }
            for (n, other) in past.iter().enumerate() {
                self.transient[(m, n)] += t * other;
            }
        }
    }

    fn fold_into(mut self, left: &mut DMatrix<f64>, right: &mut DVector<f64>) -> Option<()> {
        soften(&mut self.transient);
        let factor = self.transient.cholesky()?;
        *left += self.left - &self.from_transient * factor.solve(&self.to_transient);
        *right += self.right - &self.from_transient * factor.solve(&self.transient_right);
        Some(())
    }
}

/// Solution by LU with rows and columns scaled; `None` if a pivot is small.
fn solved(left: DMatrix<f64>, right: DVector<f64>) -> Option<DVector<f64>> {
    let scale = left
        .diagonal()
        .map(|d| 1.0 / d.abs().sqrt().max(f64::MIN_POSITIVE));
    let scaled = DMatrix::from_fn(left.nrows(), left.ncols(), |i, j| {
        left[(i, j)] * scale[i] * scale[j]
    });
    let factor = scaled.lu();
    let pivots = factor.u().diagonal().map(f64::abs);
    let regular = pivots.min() > SMALL_PIVOT * pivots.max();
    let solution = regular.then(|| factor.solve(&right.component_mul(&scale)))??;
    Some(solution.component_mul(&scale))
}
