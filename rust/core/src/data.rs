//! Records as the core sees them: borrowed slices with their shape.

use crate::simd::{self, Eight, Kernel, LANES};
use crate::{Error, Result};

/// One experiment of which only the shape has been checked.
#[derive(Clone, Copy, Debug)]
pub struct Samples<'a> {
    u: &'a [f64],
    channels: usize,
    y: &'a [f64],
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
        Ok(Self { u, channels, y })
    }

    /// The record, once its values have been found usable; outputs may be NaN where not measured.
    ///
    /// # Errors
    /// As [`Record::with_gaps`], but for lengths.
    pub fn record(&self) -> Result<Record<'a>> {
        let Self { u, channels, y } = *self;
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

    /// The record as it is where all values are finite.
    pub(crate) fn unseen(&self) -> Record<'a> {
        Record {
            u: self.u,
            channels: self.channels,
            y: self.y,
            unmeasured: 0,
        }
    }
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

/// Where the first value stands that is NaN or infinite.
fn first_not_finite(values: &[f64]) -> Option<usize> {
    let not_finite = |v: &f64| !v.is_finite();
    match simd::run(Finite(values)) {
        true => None,
        false => values.iter().position(not_finite),
    }
}

/// Whether all values are finite: only then `0 v` is 0 for each of them.
struct Finite<'a>(&'a [f64]);

impl Kernel for Finite<'_> {
    type Output = bool;

    #[inline(always)]
    fn run<V: Eight>(self) -> bool {
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

/// One experiment: inputs row by row (time first, `channels` values per sample) and the measured output, NaN where it was
/// not measured.
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
}

impl<'a> Record<'a> {
    /// A record whose shape has been checked and whose values are finite.
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

    /// A record whose output may be NaN: such a sample has no weight, a simulation runs through it.
    ///
    /// # Errors
    /// `ErrorKind::Data` for lengths that do not match, inputs that are not finite, infinite outputs, or outputs of which
    /// none was measured.
    pub fn with_gaps(u: &'a [f64], channels: usize, y: &'a [f64]) -> Result<Self> {
        Samples::new(u, channels, y)?.record()
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

    /// Inputs of sample `k`; before the first sample they are held at their first value.
    pub fn input(&self, k: isize) -> &'a [f64] {
        let k = k.max(0) as usize;
        &self.u[k * self.channels..(k + 1) * self.channels]
    }
}

/// Number of leading samples that hold `count` measured outputs; none where there are not as many.
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
    fn holds_the_first_input_before_the_start() {
        let record = Record::new(&[5.0, 6.0], 1, &[0.0, 0.0]).unwrap();
        assert_eq!(
            (record.input(-3), record.input(1)),
            (&[5.0][..], &[6.0][..])
        );
    }
}
