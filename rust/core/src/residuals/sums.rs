//! A set of correlations under one verdict.
//!
//! The statistic is `r' (Z'RZ)^+ r` with `r = Z'e`, one column of `Z` per lag, `R` the covariance matrix of `e`. The directions in which a
//! change of the parameters moves `e` are first projected out of `Z`: the statistic is then chi-square whether the parameters were
//! estimated on these data or on others (Ljung 1999, sections 16.5 and 16.6; Breusch and Godfrey 1978). `R` is Bartlett's, from an
//! autoregression of the coloured residual. For a strongly coloured residual `R` is too uncertain for 25 sums at once, and the test accepts
//! too often. Whitened by the same autoregression the test is exact, but rejects for the curvature of the model, which is large compared
//! with the innovation. The statistic of a test is the mean of both.

use nalgebra::{DMatrix, DVector};

use super::columns::{Columns, determined, joint};
use super::{Noise, Test, chi_square};

/// Share of good models for which a statistic exceeds its threshold.
const LEVEL: f64 = 0.01;
/// Standard deviations within which 99 % of a normal variable lie.
const NORMAL_99: f64 = 2.575_829_303_548_900_4;
/// Least eigenvalue, relative to the largest, for a combination of the sums to count.
const INDEPENDENT: f64 = 1e-7;

/// Sums over all samples with their covariance.
pub(super) struct Sums {
    values: DVector<f64>,
    pub covariance: DMatrix<f64>,
    /// Values divided by these are correlations.
    scales: Vec<f64>,
    /// Variances of the values without any correction.
    reference: Vec<f64>,
    explained: f64,
    /// Number of samples minus that of the parameters estimated on them.
    room: f64,
}

impl Sums {
    /// `Z'e`, where the directions, orthonormal over all experiments, are projected out of `Z`. The noise is that of `e`.
    pub fn new(
        mut instruments: Vec<Columns>,
        target: &[Vec<f64>],
        noise: &Noise,
        directions: &[Columns],
    ) -> Self {
        let (m, p) = (instruments[0].width(), directions[0].width());
        let sums = joint(&instruments, directions);
        let squares: Vec<f64> = (0..m).map(|i| sums[(i, i)]).collect();
        let overlap = sums.view((m, 0), (p, m)).into_owned();
        for (z, d) in instruments.iter_mut().zip(directions) {
            z.subtract(d, &overlap);
        }
        let errors: Vec<_> = target.iter().map(|e| Columns::of(e, |e| *e)).collect();
        let sums = joint(&instruments, &errors);
        let power = sums[(m, m)];
        let values = sums.view((0, m), (m, 1)).column(0).into_owned();
        let own = sums.view((0, 0), (m, m)).into_owned();
        let covariance = noise.power_of(instruments);
        let samples = target.iter().flatten().filter(|e| **e != 0.0).count();
        Self {
            explained: explained(&values, &own, &covariance, &squares, power),
            scales: squares
                .iter()
                .map(|s| (s * power).max(1e-300).sqrt())
                .collect(),
            reference: squares.iter().map(|s| s * noise.variance).collect(),
            values,
            covariance,
            room: samples as f64 - p as f64,
        }
    }

    /// The verdict on the sums, which are ordered by series, then by lag. With `white`, the same sums of the whitened series, the
    /// statistic is the mean of both.
    pub fn test(self, lags: Vec<usize>, series: Vec<Vec<usize>>, white: Option<&Self>) -> Test {
        let (mut statistic, freedom) = self.statistic();
        if let Some((other, its_freedom)) = white.map(Self::statistic).filter(|(_, f)| *f > 0) {
            let both = statistic + other + freedom as f64 - its_freedom as f64;
            statistic = (0.5 * both).max(0.0);
        }
        let tested = |value: f64| if freedom > 0 { value } else { f64::NAN };
        let spread = self.covariance.diagonal();
        let limit = |(v, s): (&f64, &f64)| NORMAL_99 * v.max(0.0).sqrt() / s;
        Test {
            lags,
            series,
            correlations: self
                .values
                .iter()
                .zip(&self.scales)
                .map(|(v, s)| v / s)
                .collect(),
            limits: spread.iter().zip(&self.scales).map(limit).collect(),
            statistic: tested(statistic),
            p_value: tested(chi_square::tail(statistic, freedom.max(1))),
            freedom,
            threshold: tested(chi_square::quantile(LEVEL, freedom.max(1))),
            explained: self.explained,
        }
    }

    /// The quadratic form with Bartlett's factor, and its degrees of freedom.
    ///
    /// `-(n - (m + 2)/2) ln(1 - S/n)`, Bartlett's correction for a regression with `m` regressors, is closer to chi-square than the form
    /// `S`, whose variance includes the tested effect.
    fn statistic(&self) -> (f64, usize) {
        let (found, freedom) = quadratic(&self.values, &self.covariance, &self.reference);
        let share = found / self.room.max(1.0);
        if share >= 1.0 {
            return (f64::INFINITY, freedom);
        }
        let factor = (self.room - 0.5 * freedom as f64 - 1.0).max(1.0);
        (-factor * (-share).ln_1p(), freedom)
    }
}

/// `r' C^+ r` over the combinations determined by `C`, and their number.
fn quadratic(values: &DVector<f64>, covariance: &DMatrix<f64>, reference: &[f64]) -> (f64, usize) {
    let scale: Vec<f64> = reference.iter().map(|r| r.sqrt()).collect();
    let (used, unit) = unit(covariance, &scale);
    if !values.iter().all(|v| v.is_finite()) {
        return (f64::NAN, 0);
    }
    let (sizes, vectors) = determined(unit, INDEPENDENT, INDEPENDENT);
    if sizes.is_empty() {
        return (f64::NAN, 0);
    }
    let parts = turned(&vectors, values, &used, &scale);
    let sum = parts.iter().zip(&sizes).map(|(x, s)| x * x / s).sum();
    (sum, sizes.len())
}

/// Share of the power of `e` that a regression on `Z` explains, minus the share by chance.
fn explained(
    values: &DVector<f64>,
    own: &DMatrix<f64>,
    covariance: &DMatrix<f64>,
    squares: &[f64],
    power: f64,
) -> f64 {
    let scale: Vec<f64> = squares.iter().map(|s| s.sqrt()).collect();
    let (used, gram) = unit(own, &scale);
    let (sizes, vectors) = determined(gram, INDEPENDENT, INDEPENDENT);
    if power <= 0.0 || sizes.is_empty() {
        return 0.0;
    }
    let parts = turned(&vectors, values, &used, &scale);
    let taken: f64 = parts.iter().zip(&sizes).map(|(x, s)| x * x / s).sum();
    let (_, noise) = unit(covariance, &scale);
    let moved = noise * &vectors;
    let chance: f64 = (0..sizes.len())
        .map(|j| vectors.column(j).dot(&moved.column(j)) / sizes[j])
        .sum();
    let share = (taken - chance) / power;
    if share.is_nan() {
        0.0
    } else {
        share.clamp(0.0, 1.0)
    }
}

/// The matrix in units of the scales, over the columns that have one.
fn unit(matrix: &DMatrix<f64>, scale: &[f64]) -> (Vec<usize>, DMatrix<f64>) {
    let used: Vec<usize> = (0..scale.len()).filter(|&i| scale[i] > 0.0).collect();
    let found = DMatrix::from_fn(used.len(), used.len(), |i, j| {
        matrix[(used[i], used[j])] / (scale[used[i]] * scale[used[j]])
    });
    (used, found)
}

fn turned(
    vectors: &DMatrix<f64>,
    values: &DVector<f64>,
    used: &[usize],
    scale: &[f64],
) -> DVector<f64> {
    let unit = DVector::from_iterator(used.len(), used.iter().map(|&i| values[i] / scale[i]));
    vectors.tr_mul(&unit)
}
