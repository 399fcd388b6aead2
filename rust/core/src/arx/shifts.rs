//! Normal equations from products of shifted signals, without forming rows.
//!
//! Over the rows `k` of a record, with `t = k - i`, `sum_k p(k-i) q(k-j) = sum_t p(t) q(t-(j-i))`: except for a few
//! products at both ends, this depends only on the difference of the lags. One pass over the record sums the common
//! part for all differences; then the ends are added. Nothing is subtracted, so no digits are lost compared with rows.

use nalgebra::DMatrix;

use crate::Record;
use crate::lagged::Lags;
use crate::simd::{self, F64x8, Kernel, LANES};

/// Samples of a block: two signals and the ones then stay in the first-level cache.
const BLOCK: usize = 1024;
const ONES: [f64; BLOCK] = [1.0; BLOCK];

/// A signal, the lags at which it is in a row, and the signals it is multiplied with.
struct Signal {
    first: usize,
    last: usize,
    partners: Vec<Partner>,
}

#[derive(Clone, Copy)]
enum Partner {
    /// A signal whose lag is larger by `difference`.
    Shifted { signal: usize, difference: isize },
    /// The column of ones.
    One,
}

/// The products that make up the normal equations of rows `[y(k-1..), u_0(k-nk..), .., 1]` with the target `y(k)`.
pub(super) struct Shifts {
    lags: Lags,
    columns: usize,
    /// The output from lag 0, the target, to na; then each input.
    signals: Vec<Signal>,
}

impl Shifts {
    /// For rows of `columns` values: the regressors, and 1 if there is an additional column.
    pub fn new(lags: &Lags, columns: usize) -> Self {
        let inputs = (0..lags.channels).map(|_| (lags.nk, lags.nk + lags.nb - 1));
        let spans: Vec<(usize, usize)> = std::iter::once((0, lags.na)).chain(inputs).collect();
        let one = (columns > lags.regressors()).then_some(Partner::One);
        let signals = spans.iter().enumerate().map(|(p, &(first, last))| Signal {
            first,
            last,
            partners: (p..spans.len())
                .flat_map(|q| differences(&spans, p, q))
                .chain(one)
                .collect(),
        });
        Self {
            lags: *lags,
            columns,
            signals: signals.collect(),
        }
    }

    /// Whether a record is measured throughout, has no weights and has samples between its ends.
    pub fn suit(&self, record: &Record) -> bool {
        let plain = record.unmeasured == 0 && record.weights.is_none();
        plain && record.len() > self.lags.first_whole() + self.longest()
    }

    /// The longest range of lags of a signal.
    fn longest(&self) -> usize {
        self.lags.na.max(self.lags.nb)
    }

    /// Adds the record's products to the lower triangle of `system`: the columns, then the target.
    pub fn add(&self, record: &Record, system: &mut DMatrix<f64>) {
        let sums = simd::run(self.middle(record));
        for (p, (signal, sums)) in self.signals.iter().zip(&sums).enumerate() {
            for (partner, middle) in signal.partners.iter().zip(sums) {
                self.spread(record, (p, *partner), *middle, system);
            }
        }
        if self.columns > self.lags.regressors() {
            let one = self.columns - 1;
            system[(one, one)] += (record.len() - self.lags.first_whole()) as f64;
        }
    }

    fn middle<'a>(&'a self, record: &'a Record<'a>) -> Middle<'a> {
        let zeros = |s: &Signal| vec![0.0; s.partners.len()];
        Middle {
            shifts: self,
            record,
            separated: vec![0.0; self.room()],
            sums: self.signals.iter().map(zeros).collect(),
        }
    }

    /// Size of the buffer for a block of each input, if inputs are interleaved.
    fn room(&self) -> usize {
        match self.lags.channels {
            1 => 0,
            channels => channels * self.stride(),
        }
    }

    /// Samples of an input that a block needs.
    fn stride(&self) -> usize {
        self.lags.first_whole() + BLOCK + self.longest()
    }

    /// Adds a sum to all pairs of lags with the same difference, completed by the products at both ends.
    fn spread(
        &self,
        record: &Record,
        (p, partner): (usize, Partner),
        middle: f64,
        system: &mut DMatrix<f64>,
    ) {
        let (begin, end) = (self.lags.first_whole(), record.len());
        let signal = &self.signals[p];
        let other = |t: usize| match partner {
            Partner::Shifted { signal, difference } => {
                value(record, signal, t.wrapping_add_signed(-difference))
            }
            Partner::One => 1.0,
        };
        for lag in signal.first..=signal.last {
            let Some(column) = self.partner_column(partner, lag) else {
                continue;
            };
            let head = begin - lag..begin - signal.first;
            let tail = end - signal.last..end - lag;
            let ends: f64 = head
                .chain(tail)
                .map(|t| value(record, p, t) * other(t))
                .sum();
            let row = self.column(p, lag);
            system[(row.max(column), row.min(column))] += middle + ends;
        }
    }

    /// The column of a signal's lag; the target comes after all columns.
    fn column(&self, signal: usize, lag: usize) -> usize {
        match (signal, lag) {
            (0, 0) => self.columns,
            (0, lag) => lag - 1,
            (input, lag) => self.lags.na + (input - 1) * self.lags.nb + lag - self.lags.nk,
        }
    }

    /// The column of the partner for a signal's lag; `None` if the partner has no such lag.
    fn partner_column(&self, partner: Partner, lag: usize) -> Option<usize> {
        let Partner::Shifted { signal, difference } = partner else {
            return Some(self.columns - 1);
        };
        let lag = lag.checked_add_signed(difference)?;
        let Signal { first, last, .. } = self.signals[signal];
        (first..=last)
            .contains(&lag)
            .then(|| self.column(signal, lag))
    }
}

/// All differences of lags between two signals; for a signal with itself only those from 0 on.
fn differences(
    spans: &[(usize, usize)],
    p: usize,
    q: usize,
) -> impl Iterator<Item = Partner> + use<> {
    let ((first, last), (other_first, other_last)) = (spans[p], spans[q]);
    let least = match p == q {
        true => 0,
        false => other_first as isize - last as isize,
    };
    (least..=other_last as isize - first as isize).map(move |difference| Partner::Shifted {
        signal: q,
        difference,
    })
}

/// A signal's value: the output's, or an input's.
fn value(record: &Record, signal: usize, t: usize) -> f64 {
    match signal {
        0 => record.y[t],
        input => record.u[t * record.channels + input - 1],
    }
}

/// The sums over all samples except those at the ends, block by block.
struct Middle<'a> {
    shifts: &'a Shifts,
    record: &'a Record<'a>,
    /// A block of each input, if they are interleaved in the record.
    separated: Vec<f64>,
    sums: Vec<Vec<f64>>,
}

impl Kernel for Middle<'_> {
    type Output = Vec<Vec<f64>>;

    #[inline(always)]
    fn run<V: F64x8>(mut self) -> Self::Output {
        let end = self.record.len();
        for begin in (self.shifts.lags.first_whole()..end).step_by(BLOCK) {
            self.separate(begin);
            for p in 0..self.shifts.signals.len() {
                self.block::<V>(p, begin, (begin + BLOCK).min(end));
            }
        }
        self.sums
    }
}

impl Middle<'_> {
    /// Copies a block's inputs, with the neighbouring samples that it needs, one input after the other.
    fn separate(&mut self, begin: usize) {
        let (channels, stride) = (self.record.channels, self.shifts.stride());
        if channels == 1 {
            return;
        }
        let first = begin - self.shifts.lags.first_whole();
        let rows = self.record.u[first * channels..].chunks_exact(channels);
        for (i, row) in rows.take(stride).enumerate() {
            for (j, value) in row.iter().enumerate() {
                self.separated[j * stride + i] = *value;
            }
        }
    }

    /// `count` values of a signal from sample `t` on, for the block that begins at `begin`.
    #[inline(always)]
    fn values(&self, signal: usize, t: usize, begin: usize, count: usize) -> &[f64] {
        let (shifts, record) = (self.shifts, self.record);
        match signal {
            0 => &record.y[t..t + count],
            _ if record.channels == 1 => &record.u[t..t + count],
            input => {
                let at = t + shifts.lags.first_whole() - begin;
                &self.separated[(input - 1) * shifts.stride() + at..][..count]
            }
        }
    }

    /// The products of one signal with all its partners, for the rows from `begin` to `end`.
    #[inline(always)]
    fn block<V: F64x8>(&mut self, p: usize, begin: usize, end: usize) {
        let signal = &self.shifts.signals[p];
        let end = end.min(self.record.len() - (signal.last - signal.first));
        if end <= begin {
            return;
        }
        let count = signal.partners.len();
        let size = count.div_ceil(count.div_ceil(V::TILE_ROWS));
        for first in (0..count).step_by(size) {
            let place = (p, first, begin, end);
            match size.min(count - first) {
                1 => self.tile::<V, 1, 4>(place),
                2 => self.tile::<V, 2, 2>(place),
                3 => self.tile::<V, 3, 2>(place),
                4 => self.tile::<V, 4, 1>(place),
                5 => self.tile::<V, 5, 1>(place),
                6 => self.tile::<V, 6, 1>(place),
                7 => self.tile::<V, 7, 1>(place),
                _ => self.tile::<V, 8, 1>(place),
            }
        }
    }

    /// The products with `COUNT` partners. Each has `WAYS` partial sums side by side, because a single sum would wait for itself.
    #[inline(always)]
    fn tile<V: F64x8, const COUNT: usize, const WAYS: usize>(
        &mut self,
        (p, first, begin, end): (usize, usize, usize, usize),
    ) {
        let signal = &self.shifts.signals[p];
        let (t, length) = (begin - signal.first, end - begin);
        let own = self.values(p, t, begin, length);
        let partners = &signal.partners[first..first + COUNT];
        let others: [&[f64]; COUNT] = std::array::from_fn(|m| match partners[m] {
            Partner::Shifted { signal, difference } => {
                self.values(signal, t.wrapping_add_signed(-difference), begin, length)
            }
            Partner::One => &ONES[..length],
        });
        let products = products::<V, COUNT, WAYS>(own, others);
        let sums = &mut self.sums[p][first..first + COUNT];
        sums.iter_mut().zip(products).for_each(|(s, p)| *s += p);
    }
}

/// `sum_t own(t) other(t)` for each of the others.
#[inline(always)]
fn products<V: F64x8, const COUNT: usize, const WAYS: usize>(
    own: &[f64],
    others: [&[f64]; COUNT],
) -> [f64; COUNT] {
    let (groups, rest) = own.as_chunks::<LANES>();
    let others_groups = others.map(|o| &o.as_chunks::<LANES>().0[..groups.len()]);
    let mut sums = [[V::splat(0.0); COUNT]; WAYS];
    let whole = groups.len() - groups.len() % WAYS;
    for g in (0..whole).step_by(WAYS) {
        for (way, sums) in sums.iter_mut().enumerate() {
            add::<V, COUNT>(g + way, groups, &others_groups, sums);
        }
    }
    for g in whole..groups.len() {
        add::<V, COUNT>(g, groups, &others_groups, &mut sums[0]);
    }
    let done = groups.len() * LANES;
    std::array::from_fn(|m| {
        let all = (1..WAYS).fold(sums[0][m], |all, way| all.add(sums[way][m]));
        let rest = rest.iter().zip(&others[m][done..]).map(|(a, b)| a * b);
        all.sum() + rest.sum::<f64>()
    })
}

/// Adds the products of one group of samples.
#[inline(always)]
fn add<V: F64x8, const COUNT: usize>(
    g: usize,
    own: &[[f64; LANES]],
    others: &[&[[f64; LANES]]; COUNT],
    sums: &mut [V; COUNT],
) {
    let own = V::load(&own[g]);
    for (sum, other) in sums.iter_mut().zip(others) {
        *sum = sum.add_product(own, V::load(&other[g]));
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::arx::add_rows;
    use crate::random::Random;
    use crate::simd::run_everywhere;
    use proptest::prelude::*;

    fn signal(samples: usize, offset: f64, scale: f64, seed: u64) -> Vec<f64> {
        let mut random = Random::new(seed);
        (0..samples)
            .map(|_| offset + scale * random.normal())
            .collect()
    }

    /// Compares both ways; each sum may differ by the rounding of its own products.
    fn assert_like_rows(record: &Record, lags: &Lags, offset: bool) {
        let columns = lags.regressors() + usize::from(offset);
        let shifts = Shifts::new(lags, columns);
        assert!(shifts.suit(record));
        let zeros = DMatrix::zeros(columns + 1, columns + 1);
        let (mut fast, mut plain) = (zeros.clone(), zeros);
        shifts.add(record, &mut fast);
        add_rows(record, lags, &mut plain);
        let squares: f64 = record.y.iter().map(|y| y * y).sum();
        plain[(columns, columns)] = squares;
        let rounding = f64::EPSILON * (record.len() + 10) as f64;
        for i in 0..columns + 1 {
            for j in 0..=i.min(columns - 1) {
                let size = plain[(i, i)].sqrt() * plain[(j, j)].sqrt();
                let error = (fast[(i, j)] - plain[(i, j)]).abs();
                assert!(
                    error <= rounding * size,
                    "({i}, {j}) of {lags:?}: {error} beside {size}"
                );
            }
        }
    }

    #[test]
    fn sums_long_records_block_by_block() {
        for channels in 1..4 {
            let samples = 3 * BLOCK + 17;
            let (u, y) = (
                signal(samples * channels, 0.1, 1.0, 1),
                signal(samples, 5.0, 2.0, 2),
            );
            let record = Record::new(&u, channels, &y).unwrap();
            for (na, nb, nk) in [(2, 2, 1), (1, 1, 0), (9, 3, 5), (3, 12, 40)] {
                let lags = Lags::new(na, nb, nk, channels).unwrap();
                assert_like_rows(&record, &lags, true);
                assert_like_rows(&record, &lags, false);
            }
        }
    }

    #[test]
    fn every_processor_sums_alike() {
        let (u, y) = (signal(2 * 1500, -3.0, 1.0, 3), signal(1500, 1e3, 1.0, 4));
        let record = Record::new(&u, 2, &y).unwrap();
        let lags = Lags::new(3, 4, 1, 2).unwrap();
        let shifts = Shifts::new(&lags, lags.regressors() + 1);
        let all = run_everywhere(|| shifts.middle(&record));
        for (level, sums) in &all {
            for (plain, best) in all[0].1.iter().flatten().zip(sums.iter().flatten()) {
                assert!(
                    (plain - best).abs() <= 1e-12 * 1500.0 * 1e6,
                    "{level:?}: {plain} {best}"
                );
            }
        }
    }

    proptest! {
        #[test]
        fn equals_the_sum_over_rows(
            (na, nb, nk, channels) in (1usize..6, 1usize..6, 0usize..6, 1usize..4),
            extra in 1usize..60,
            (offset, exponent) in (-1e6f64..1e6, -100i32..100),
            seed in any::<u64>(),
        ) {
            let lags = Lags::new(na, nb, nk, channels).unwrap();
            let samples = lags.first_whole() + na.max(nb) + extra;
            let scale = 10f64.powi(exponent);
            let u = signal(samples * channels, offset, scale, seed);
            let y = signal(samples, offset * scale, scale, seed ^ 1);
            let record = Record::new(&u, channels, &y).unwrap();
            assert_like_rows(&record, &lags, true);
        }
    }
}
