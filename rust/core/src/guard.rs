//! A guard against models that fit their data and run away, or stick to a false equilibrium, on other data.
//!
//! A model is sound where its free run forgets its initial state and answers somewhat larger inputs, and the training
//! inputs in another order, with outputs of like size. Which states and runs those are is the model's own matter; the bounds are the same for all.

/// How far outside the training output's range a run is started, in widths of that range.
const BESIDE: f64 = 0.25;
/// Largest distance, in widths of that range, that may be left at the end between runs from different states.
const FORGOTTEN: f64 = 0.2;
/// Factor by which inputs are enlarged about their means.
const ENLARGED: f64 = 1.25;
/// How far outside the training output's range enlarged inputs may drive the run, in widths of that range.
const ROOM: f64 = 1.0;
/// How far outside it inputs of the training's own size may drive the run when they come in another order.
const ROOM_AT_HOME: f64 = 0.5;
/// Blocks that an input is cut into to come in another order.
const BLOCKS: usize = 16;
/// Steps by which the blocks are gone through, prime to their number.
const STEPS: [usize; 2] = [3, 7];

/// The range of one training output, by which runs are judged.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Guard {
    low: f64,
    high: f64,
}

impl Guard {
    /// A guard for outputs like these; those that are not numbers do not count.
    pub fn of<'a>(outputs: impl Iterator<Item = &'a f64>) -> Self {
        let range = |(low, high): (f64, f64), &y: &f64| (low.min(y), high.max(y));
        let (low, high) = outputs.fold((f64::INFINITY, f64::NEG_INFINITY), range);
        Self { low, high }
    }

    /// Outputs on either side of the range, to start runs from.
    pub fn sides(&self) -> [f64; 2] {
        let beside = BESIDE * (self.high - self.low);
        [self.low - beside, self.high + beside]
    }

    /// True where two runs over the same inputs have come together at their end.
    pub fn meet(&self, a: &[f64], b: &[f64]) -> bool {
        final_gap(a, b) < FORGOTTEN * (self.high - self.low)
    }

    /// True where a run over [`enlarged`] inputs does not run away.
    pub fn holds(&self, run: &[f64]) -> bool {
        self.is_within(run, ROOM)
    }

    /// True where a run over [`rearranged`] inputs stays near the outputs that were seen.
    pub fn holds_at_home(&self, run: &[f64]) -> bool {
        self.is_within(run, ROOM_AT_HOME)
    }

    fn is_within(&self, run: &[f64], room: f64) -> bool {
        let room = room * (self.high - self.low);
        run.iter()
            .all(|y| (self.low - room..=self.high + room).contains(y))
    }
}

/// Mean distance over the last tenth; NaN, which is below no bound, where a run has left the finite numbers.
fn final_gap(a: &[f64], b: &[f64]) -> f64 {
    let last = a.len().div_ceil(10);
    let pairs = a.iter().zip(b).rev().take(last);
    pairs.map(|(a, b)| (a - b).abs()).sum::<f64>() / last as f64
}

/// The inputs, a quarter larger about their means.
pub(crate) fn enlarged(u: &[f64], channels: usize) -> Vec<f64> {
    let samples = (u.len() / channels) as f64;
    let mean = |j: usize| u.iter().skip(j).step_by(channels).sum::<f64>() / samples;
    let means: Vec<f64> = (0..channels).map(mean).collect();
    let enlarge = |(i, u): (usize, &f64)| {
        let mean = means[i % channels];
        mean + ENLARGED * (u - mean)
    };
    u.iter().enumerate().map(enlarge).collect()
}

/// The inputs' blocks in other orders: by the mean of each input, rising and falling, and shuffled.
///
/// A false equilibrium just beside the data is not met by the record as it is; a longer stay at an end of the range
/// leads there. Empty for inputs too short to be cut.
pub(crate) fn rearranged(u: &[f64], channels: usize) -> Vec<Vec<f64>> {
    let length = u.len() / channels / BLOCKS;
    if length == 0 {
        return Vec::new();
    }
    let block = |i: usize| &u[i * length * channels..(i + 1) * length * channels];
    let level = |i: usize, j: usize| -> f64 { block(i).iter().skip(j).step_by(channels).sum() };
    let sorted = |j: usize| {
        let mut order: Vec<usize> = (0..BLOCKS).collect();
        order.sort_by(|&a, &b| level(a, j).total_cmp(&level(b, j)));
        order
    };
    let by_level = (0..channels).flat_map(|j| {
        let rising = sorted(j);
        let falling = rising.iter().rev().copied().collect();
        [rising, falling]
    });
    let shuffled = STEPS.map(|step| (0..BLOCKS).map(|i| (i + 1) * step % BLOCKS).collect());
    let orders: Vec<Vec<usize>> = by_level.chain(shuffled).collect();
    let join = |order: &Vec<usize>| order.iter().flat_map(|&i| block(i)).copied().collect();
    orders.iter().map(join).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn keeps_closer_to_what_was_seen_over_its_own_inputs() {
        let guard = Guard::of([1.0, 3.0].iter());
        assert!(guard.holds_at_home(&[0.0, 4.0]) && !guard.holds_at_home(&[4.1]));
    }

    #[test]
    fn rearranges_whole_samples_and_loses_none() {
        let u: Vec<f64> = (0..2 * 2 * BLOCKS)
            .map(|i| f64::from(i as u32 * 7 % 23))
            .collect();
        let found = rearranged(&u, 2);
        assert_eq!(found.len(), 2 * 2 + STEPS.len());
        let samples = |u: &[f64]| {
            let mut pairs: Vec<(u64, u64)> =
                u.chunks(2).map(|p| (p[0] as u64, p[1] as u64)).collect();
            pairs.sort_unstable();
            pairs
        };
        for other in &found {
            assert_eq!(samples(other), samples(&u));
            assert_ne!(other, &u);
        }
        let sums: Vec<f64> = found[0].chunks(4).map(|b| b[0] + b[2]).collect();
        assert!(sums.windows(2).all(|w| w[0] <= w[1]));
        assert!(rearranged(&u[..10], 2).is_empty());
    }

    #[test]
    fn judges_by_the_range_of_the_outputs_that_are_numbers() {
        let guard = Guard::of([1.0, f64::NAN, 3.0].iter());
        assert_eq!(guard.sides(), [0.5, 3.5]);
        assert!(guard.meet(&[9.0, 1.0], &[0.0, 1.3]) && !guard.meet(&[0.0, 1.0], &[0.0, 1.5]));
        assert!(!guard.meet(&[f64::NAN], &[1.0]));
        assert!(guard.holds(&[-1.0, 5.0]) && !guard.holds(&[5.1]) && !guard.holds(&[f64::NAN]));
    }

    #[test]
    fn enlarges_each_input_about_its_mean() {
        assert_eq!(enlarged(&[0.0, 5.0, 4.0, 5.0], 2), [-0.5, 5.0, 4.5, 5.0]);
    }
}
