//! Seeded random numbers, the same on every platform: xoshiro256++ seeded by SplitMix64 (Blackman and Vigna 2021).

/// A small generator that gives the same sequence for a seed on every platform and at any number of threads.
#[derive(Clone, Debug)]
pub struct Random {
    state: [u64; 4],
}

impl Random {
    /// A generator for `seed`.
    pub fn new(seed: u64) -> Self {
        let mut x = seed;
        let mut next = || {
            x = x.wrapping_add(0x9e37_79b9_7f4a_7c15);
            let mut z = x;
            z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
            z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
            z ^ (z >> 31)
        };
        Self {
            state: [next(), next(), next(), next()],
        }
    }

    /// A generator for stream `stream` of `seed`: independent work gets independent numbers.
    pub fn stream(seed: u64, stream: u64) -> Self {
        let mut mixed = Self::new(seed ^ stream.wrapping_mul(0xd134_2543_de82_ef95));
        Self::new(mixed.next_u64() ^ stream)
    }

    /// The next 64 random bits.
    pub fn next_u64(&mut self) -> u64 {
        let s = &mut self.state;
        let result = s[0].wrapping_add(s[3]).rotate_left(23).wrapping_add(s[0]);
        let t = s[1] << 17;
        s[2] ^= s[0];
        s[3] ^= s[1];
        s[1] ^= s[2];
        s[0] ^= s[3];
        s[2] ^= t;
        s[3] = s[3].rotate_left(45);
        result
    }

    /// Uniform in `[0, 1)`, with 53 random bits.
    pub fn uniform(&mut self) -> f64 {
        (self.next_u64() >> 11) as f64 * (1.0 / (1u64 << 53) as f64)
    }

    /// Uniform in `[low, high)`.
    pub fn between(&mut self, low: f64, high: f64) -> f64 {
        low + (high - low) * self.uniform()
    }

    /// Standard normal (Box and Muller 1958).
    pub fn normal(&mut self) -> f64 {
        let radius = (-2.0 * (1.0 - self.uniform()).ln()).sqrt();
        radius * (std::f64::consts::TAU * self.uniform()).cos()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand_xoshiro::Xoshiro256PlusPlus;
    use rand_xoshiro::rand_core::{Rng, SeedableRng};

    #[test]
    fn draws_the_bits_of_another_implementation() {
        for seed in [0, 1, 42, 0x9e37_79b9_7f4a_7c15, u64::MAX] {
            let mut known = Xoshiro256PlusPlus::seed_from_u64(seed);
            let mut own = Random::new(seed);
            for draw in 0..10_000 {
                assert_eq!(own.next_u64(), known.next_u64(), "{seed} {draw}");
            }
        }
    }

    /// Saved models and records of experiments name seeds, so the numbers of a seed must never change.
    #[test]
    fn draws_what_it_always_drew() {
        let mut random = Random::new(0);
        let first: [u64; 3] = std::array::from_fn(|_| random.next_u64());
        assert_eq!(
            first,
            [
                0x5317_5d61_490b_23df,
                0x61da_6f3d_c380_d507,
                0x5c0f_df91_ec9a_7bfc
            ]
        );
        let mut stream = Random::stream(7, 3);
        assert_eq!(stream.next_u64(), 0x9e27_13e0_3027_7d44);
        assert!(
            (0..1_000)
                .map(|_| stream.uniform())
                .all(|x| (0.0..1.0).contains(&x))
        );
    }

    #[test]
    fn repeats_for_a_seed_and_differs_between_streams() {
        let draw = |mut r: Random| (0..5).map(|_| r.next_u64()).collect::<Vec<_>>();
        assert_eq!(draw(Random::new(7)), draw(Random::new(7)));
        assert_ne!(draw(Random::new(7)), draw(Random::new(8)));
        assert_ne!(draw(Random::stream(7, 0)), draw(Random::stream(7, 1)));
    }

    #[test]
    fn has_the_moments_of_its_distributions() {
        let (mut r, n) = (Random::new(1), 100_000);
        let uniform = (0..n).map(|_| r.uniform()).sum::<f64>() / n as f64;
        let square = (0..n).map(|_| r.normal().powi(2)).sum::<f64>() / n as f64;
        assert!((uniform - 0.5).abs() < 5e-3 && (square - 1.0).abs() < 2e-2);
    }
}
