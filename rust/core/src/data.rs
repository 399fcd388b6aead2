//! Records as the core sees them: borrowed slices with their shape.

use crate::{Error, Result};

/// One experiment: inputs row by row (time first, `channels` values per sample) and the measured output.
#[derive(Clone, Copy, Debug)]
pub struct Record<'a> {
    /// Inputs, `y.len() * channels` values.
    pub u: &'a [f64],
    /// Number of input channels.
    pub channels: usize,
    /// Measured output, one value per sample.
    pub y: &'a [f64],
}

impl<'a> Record<'a> {
    /// A record whose shape has been checked and whose values are finite.
    ///
    /// # Errors
    /// `ErrorKind::Data` for lengths that do not match or values that are not finite.
    pub fn new(u: &'a [f64], channels: usize, y: &'a [f64]) -> Result<Self> {
        if channels == 0 || u.len() != y.len() * channels {
            return Err(Error::data(format!(
                "expected {} x {channels} inputs for {} outputs, got {} values; give u and y the same number of samples",
                y.len(),
                y.len(),
                u.len()
            )));
        }
        for (name, values) in [("u", u), ("y", y)] {
            if let Some(k) = values.iter().position(|v| !v.is_finite()) {
                return Err(Error::data(format!(
                    "expected finite values in {name}, got {} at sample {}; cut or repair that part of the recording",
                    values[k],
                    if name == "u" { k / channels } else { k }
                )));
            }
        }
        Ok(Self { u, channels, y })
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
    fn holds_the_first_input_before_the_start() {
        let record = Record::new(&[5.0, 6.0], 1, &[0.0, 0.0]).unwrap();
        assert_eq!(
            (record.input(-3), record.input(1)),
            (&[5.0][..], &[6.0][..])
        );
    }
}
