//! Random numbers for tests that need very many: SplitMix64 (Steele, Lea and Flood 2014).

use std::vec::Vec;

pub struct Dice(pub u64);

impl Dice {
    pub fn next(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9E37_79B9_7F4A_7C15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
        z ^ (z >> 31)
    }

    /// Below `n`.
    pub fn below(&mut self, n: usize) -> usize {
        ((u128::from(self.next()) * n as u128) >> 64) as usize
    }

    pub fn byte(&mut self) -> u8 {
        self.next() as u8
    }

    /// Adds `count` bytes, of which about `zeros` in 8 are zero.
    pub fn bytes(&mut self, out: &mut Vec<u8>, count: usize, zeros: usize) {
        for _ in 0..count {
            let byte = if self.below(8) < zeros {
                0
            } else {
                self.byte()
            };
            out.push(byte);
        }
    }
}

/// `short` in every run of the tests, `soak` where SEWFAST_SOAK is set.
pub fn trials(short: u64, soak: u64) -> u64 {
    if std::env::var_os("SEWFAST_SOAK").is_some() {
        soak
    } else {
        short
    }
}
