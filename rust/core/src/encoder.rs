//! An incremental encoder: position to counts.

use crate::simd::F64x8;

/// An encoder whose counter stands at zero, `phase` of a count past the last edge, where the position is zero.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Encoder {
    counts_per_unit: f64,
    phase: f64,
    quantised: bool,
}

impl Encoder {
    /// An encoder with `counts_per_unit` counts per unit of position and `phase` in `[0, 1)` counts.
    pub fn new(counts_per_unit: f64, phase: f64) -> Self {
        Self {
            counts_per_unit,
            phase,
            quantised: true,
        }
    }

    /// The ideal encoder: the position in counts as a real number.
    pub fn ideal(counts_per_unit: f64) -> Self {
        Self {
            counts_per_unit,
            phase: 0.0,
            quantised: false,
        }
    }

    /// Counts per unit of position.
    pub fn counts_per_unit(&self) -> f64 {
        self.counts_per_unit
    }

    /// The counter at `position`: `floor(position counts_per_unit + phase)`, without the floor where ideal.
    #[inline]
    pub fn count(&self, position: f64) -> f64 {
        let exact = position * self.counts_per_unit + self.phase;
        if self.quantised { exact.floor() } else { exact }
    }

    /// The counters at eight positions.
    #[inline(always)]
    pub(crate) fn counts<V: F64x8>(&self, positions: V) -> V {
        let scaled = positions.mul(V::splat(self.counts_per_unit));
        let exact = scaled.add(V::splat(self.phase));
        if self.quantised { exact.floor() } else { exact }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn counts_whole_edges_in_both_directions() {
        let encoder = Encoder::new(10.0, 0.25);
        let counts = [0.0, 0.07, 0.08, -0.02, -0.03].map(|position| encoder.count(position));
        assert_eq!(counts, [0.0, 0.0, 1.0, 0.0, -1.0]);
    }

    #[test]
    fn is_exact_where_ideal() {
        assert_eq!(Encoder::ideal(4.0).count(0.3), 1.2);
    }
}
