//! Records for the core: borrowed slices with their shape.

use crate::simd::{self, F64x8, Kernel, LANES};
use crate::{Error, Result};

/// One experiment; only its shape has been checked.
#[derive(Clone, Copy, Debug)]
pub struct Samples<'a> {
    u: &'a [f64],
    channels: usize,
    y: &'a [f64],
    weights: Option<&'a [f64]>,
}

impl<'a> Samples<'a> {
    /// Inputs row by row, and an output for each row.
    ///
    /// # Errors
    /// `ErrorKind::Data` for lengths that do not match.
    pub fn new(u: &'a [f64], channels: usize, y: &'a [f64]) -> Result<Self> {
        if channels == 0 || u.len() != y.len() * channels {
            return Err(Error::data(format!(
                "expected {} x {channels} inputs for {} outputs, got {} values; give u and y the same number of samples",
                y.len(),
                y.len(),
                u.len()
            )));
        }
        Ok(Self {
            u,
            channels,
            y,
            weights: None,
        })
    }

    /// The same samples with a weight for each; see [`Record::with_weights`].
    ///
    /// # Errors
    /// As [`Record::with_weights`].
    pub fn with_weights(self, weights: &'a [f64]) -> Result<Self> {
        check_weights(weights, self.y)?;
        Ok(Self {
            weights: unless_one(weights),
            ..self
        })
    }

    /// The record, if its values can be used; outputs may be NaN if not measured.
    ///
    /// # Errors
    /// As [`Record::with_gaps`], except for lengths.
    pub fn record(&self) -> Result<Record<'a>> {
        let Self { u, channels, y, .. } = *self;
        if let Some(i) = first_not_finite(u) {
            return Err(Error::data(format!(
                "expected finite values in u, got {} at sample {}; a simulation needs every input: cut the recording there, or fill what is missing",
                u[i],
                i / channels
            )));
        }
        let unmeasured = unmeasured(y)?;
        Ok(Record {
            unmeasured,
            ..self.unseen()
        })
    }

    /// The record without a check: valid only if all values are finite.
    pub(crate) fn unseen(&self) -> Record<'a> {
        Record {
            u: self.u,
            channels: self.channels,
            y: self.y,
            unmeasured: 0,
            weights: self.weights,
            rests: false,
        }
    }
}

/// Refuses weights that are not one for each output, finite, 0 or more, and above 0 for a measured one.
pub(crate) fn check_weights(weights: &[f64], y: &[f64]) -> Result<()> {
    if weights.len() != y.len() {
        return Err(Error::data(format!(
            "expected {} weights, one for each sample, got {}; cut both to the same range",
            y.len(),
            weights.len()
        )));
    }
    let sound = |w: &f64| *w >= 0.0 && w.is_finite();
    if let Some(k) = weights.iter().position(|w| !sound(w)) {
        return Err(Error::data(format!(
            "expected finite weights of 0 or more, got {} at sample {k}; 0 leaves a sample out, 1 counts it in full",
            weights[k]
        )));
    }
    let counts = |(w, y): (&f64, &f64)| *w > 0.0 && !y.is_nan();
    if !weights.iter().zip(y).any(counts) {
        return Err(Error::data(
            "expected a weight above 0 where the output was measured, got none; leave that experiment out",
        ));
    }
    Ok(())
}

/// Number of outputs that are NaN, not all and none infinite.
fn unmeasured(y: &[f64]) -> Result<usize> {
    if first_not_finite(y).is_none() {
        return Ok(0);
    }
    if let Some(k) = y.iter().position(|v| v.is_infinite()) {
        return Err(Error::data(format!(
            "expected finite values in y, or NaN where it was not measured, got {} at sample {k}; set it to NaN",
            y[k]
        )));
    }
    let unmeasured = y.iter().filter(|v| v.is_nan()).count();
    if unmeasured == y.len() {
        return Err(Error::data(
            "expected a measured output, got NaN throughout; leave that experiment out",
        ));
    }
    Ok(unmeasured)
}

/// Index of the first value that is NaN or infinite.
fn first_not_finite(values: &[f64]) -> Option<usize> {
    let not_finite = |v: &f64| !v.is_finite();
    match simd::run(Finite(values)) {
        true => None,
        false => values.iter().position(not_finite),
    }
}

/// Whether all values are finite: only then is `0 v` equal to 0 for each of them.
struct Finite<'a>(&'a [f64]);

impl Kernel for Finite<'_> {
    type Output = bool;

    #[inline(always)]
    fn run<V: F64x8>(self) -> bool {
        let (groups, rest) = self.0.as_chunks::<LANES>();
        let (pairs, single) = groups.as_chunks::<2>();
        let zero = V::splat(0.0);
        let mut sums = [zero; 2];
        for pair in pairs {
            for (sum, group) in sums.iter_mut().zip(pair) {
                *sum = sum.add_product(zero, V::load(group));
            }
        }
        for group in single {
            sums[0] = sums[0].add_product(zero, V::load(group));
        }
        sums[0].add(sums[1]).sum() == 0.0 && rest.iter().all(|v| v.is_finite())
    }
}

/// One experiment: inputs row by row (time first, `channels` values per sample) and the measured output, NaN if not
/// measured.
#[derive(Clone, Copy, Debug)]
pub struct Record<'a> {
    /// Inputs, `y.len() * channels` values.
    pub u: &'a [f64],
    /// Number of input channels.
    pub channels: usize,
    /// Measured output, one value per sample.
    pub y: &'a [f64],
    /// Samples whose output was not measured.
    pub unmeasured: usize,
    /// Weights of the samples' squared errors, finite and 0 or more; `None` if all count alike.
    pub weights: Option<&'a [f64]>,
    /// Whether the plant stood still before the first sample: at the equilibrium of the inputs there.
    pub rests: bool,
}

impl<'a> Record<'a> {
    /// A record whose shape is checked and whose values are finite.
    ///
    /// # Errors
    /// `ErrorKind::Data` for lengths that do not match or values that are not finite.
    pub fn new(u: &'a [f64], channels: usize, y: &'a [f64]) -> Result<Self> {
        let record = Self::with_gaps(u, channels, y)?;
        match y.iter().position(|v| v.is_nan()) {
            None => Ok(record),
            Some(k) => Err(Error::data(format!(
                "expected finite values in y, got NaN at sample {k}; cut or repair that part of the recording"
            ))),
        }
    }

    /// A record whose output may be NaN: such a sample has no weight, but a simulation runs through it.
    ///
    /// # Errors
    /// `ErrorKind::Data` for lengths that do not match, inputs that are not finite, infinite outputs, or no measured
    /// output at all.
    pub fn with_gaps(u: &'a [f64], channels: usize, y: &'a [f64]) -> Result<Self> {
        Samples::new(u, channels, y)?.record()
    }

    /// The same record with a weight for each sample: costs are `sum w e^2 / (2 sum w)`. Only sums of squared errors
    /// use the weights; scaling, starts and estimated states ignore them.
    ///
    /// # Errors
    /// `ErrorKind::Data` for another number of weights, weights that are negative or not finite, or 0 at every measured
    /// output.
    pub fn with_weights(self, weights: &'a [f64]) -> Result<Self> {
        check_weights(weights, self.y)?;
        Ok(Self {
            weights: unless_one(weights),
            ..self
        })
    }

    /// The same record of a plant that stood still before its first sample, or not.
    pub fn at_rest(self, rests: bool) -> Self {
        Self { rests, ..self }
    }

    /// Whether the inputs keep their first values for `outputs` measured outputs, and change later.
    pub fn begins_held(&self, outputs: usize) -> bool {
        let rows = self.u.chunks_exact(self.channels);
        let held = rows
            .take_while(|row| *row == &self.u[..self.channels])
            .count();
        held < self.len() && self.y[..held].iter().filter(|y| !y.is_nan()).count() >= outputs
    }

    /// The weight of sample `k`.
    pub fn weight(&self, k: usize) -> f64 {
        self.weights.map_or(1.0, |weights| weights[k])
    }

    /// Sum of the weights of the samples whose output was measured.
    pub fn total_weight(&self) -> f64 {
        match self.weights {
            None => self.measured() as f64,
            Some(weights) => total_weight(weights, self.y),
        }
    }

    /// Number of samples that count: measured, and of a weight above 0.
    pub fn counting(&self) -> usize {
        let counts = |k: &usize| !self.y[*k].is_nan() && self.weight(*k) > 0.0;
        match self.weights {
            None => self.measured(),
            Some(_) => (0..self.len()).filter(counts).count(),
        }
    }

    /// Number of samples whose output was measured.
    pub fn measured(&self) -> usize {
        self.y.len() - self.unmeasured
    }

    /// The first sample whose output was measured; 0 for an empty record.
    pub fn first_measured(&self) -> usize {
        self.y.iter().position(|y| !y.is_nan()).unwrap_or(0)
    }

    /// Number of samples.
    pub fn len(&self) -> usize {
        self.y.len()
    }

    /// True for a record without samples.
    pub fn is_empty(&self) -> bool {
        self.y.is_empty()
    }

    /// Inputs of sample `k`; before the first sample they hold their first value.
    pub fn input(&self, k: isize) -> &'a [f64] {
        let k = k.max(0) as usize;
        &self.u[k * self.channels..(k + 1) * self.channels]
    }
}

/// `None` if all weights are 1: the computation is then exactly the one without weights.
pub(crate) fn unless_one(weights: &[f64]) -> Option<&[f64]> {
    weights.iter().any(|w| *w != 1.0).then_some(weights)
}

/// Sum of the weights of the outputs that were measured.
pub(crate) fn total_weight(weights: &[f64], y: &[f64]) -> f64 {
    let measured = weights.iter().zip(y).filter(|(_, y)| !y.is_nan());
    measured.map(|(w, _)| w).sum()
}

/// Sum of squared errors, each times its weight, over the outputs that were measured.
pub(crate) fn weighted_squares(weights: &[f64], y: &[f64], run: &[f64]) -> f64 {
    let measured = weights.iter().zip(y.iter().zip(run));
    let measured = measured.filter(|(_, (y, _))| !y.is_nan());
    measured
        .map(|(w, (y, run))| w * ((y - run) * (y - run)))
        .sum()
}

/// Number of leading samples that contain `count` measured outputs; `None` if there are not as many.
pub(crate) fn window(y: &[f64], count: usize) -> Option<usize> {
    let mut measured = y.iter().enumerate().filter(|(_, y)| !y.is_nan());
    match count {
        0 => Some(0),
        _ => measured.nth(count - 1).map(|(k, _)| k + 1),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn refuses_shapes_and_values_that_cannot_be_used() {
        assert!(Record::new(&[1.0, 2.0], 1, &[1.0]).is_err());
        assert!(Record::new(&[], 0, &[]).is_err());
        let message = Record::new(&[1.0, 2.0, 3.0, f64::NAN], 2, &[0.0, 0.0])
            .unwrap_err()
            .message;
        assert!(message.contains("sample 1"), "{message}");
    }

    #[test]
    fn takes_gaps_in_the_output_where_they_are_allowed() {
        let (nan, u) = (f64::NAN, [1.0, 2.0, 3.0, 4.0]);
        let y = [nan, 5.0, nan, 6.0];
        assert!(Record::new(&u, 1, &y).is_err());
        let record = Record::with_gaps(&u, 1, &y).unwrap();
        assert_eq!((record.measured(), record.first_measured()), (2, 1));
        assert_eq!(
            [0, 1, 2, 3].map(|count| window(&y, count)),
            [Some(0), Some(2), Some(4), None]
        );
        assert!(Record::with_gaps(&u, 1, &[nan; 4]).is_err());
        assert!(Record::with_gaps(&u, 1, &[1.0, f64::INFINITY, 0.0, 0.0]).is_err());
        assert!(Record::with_gaps(&[1.0, nan, 0.0, 0.0], 1, &y).is_err());
    }

    #[test]
    fn takes_weights_and_refuses_those_that_are_none() {
        let (nan, u) = (f64::NAN, [1.0, 2.0, 3.0, 4.0]);
        let y = [nan, 5.0, 7.0, 6.0];
        let record = Record::with_gaps(&u, 1, &y).unwrap();
        assert_eq!((record.total_weight(), record.counting()), (3.0, 3));
        let weighted = record.with_weights(&[9.0, 0.5, 0.0, 2.0]).unwrap();
        assert_eq!((weighted.total_weight(), weighted.counting()), (2.5, 2));
        assert_eq!((weighted.weight(3), record.weight(3)), (2.0, 1.0));
        let refused = |weights: &[f64]| record.with_weights(weights).unwrap_err().message;
        assert!(refused(&[1.0; 3]).contains("expected 4 weights"));
        assert!(refused(&[1.0, 1.0, -1.0, 1.0]).contains("-1 at sample 2"));
        assert!(refused(&[1.0, nan, 1.0, 1.0]).contains("NaN at sample 1"));
        assert!(refused(&[1.0, 1.0, 1.0, f64::INFINITY]).contains("sample 3"));
        assert!(refused(&[1.0, 0.0, 0.0, 0.0]).contains("above 0"));
        let samples = Samples::new(&u, 1, &y).unwrap();
        assert!(samples.with_weights(&[0.0; 4]).is_err());
        let record = samples.with_weights(&[1.0; 4]).unwrap().record().unwrap();
        assert!(record.weights.is_none());
        // a run that is no longer finite has no finite sum
        assert_eq!(weighted_squares(&[2.0, 3.0], &[1.0, nan], &[3.0, 4.0]), 8.0);
        assert!(weighted_squares(&[2.0, 3.0], &[1.0, 2.0], &[nan, 4.0]).is_nan());
    }

    #[test]
    fn holds_the_first_input_before_the_start() {
        let record = Record::new(&[5.0, 6.0], 1, &[0.0, 0.0]).unwrap();
        assert_eq!(
            (record.input(-3), record.input(1)),
            (&[5.0][..], &[6.0][..])
        );
    }
}
