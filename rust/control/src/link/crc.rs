//! CRC-32 of IEEE 802.3, byte by byte.
//!
//! Reflected polynomial EDB88320, initial value and final exclusive or FFFFFFFF. In up to 2,974 bits of data, more than
//! a frame has, it detects every error of up to four bits (Koopman, "32-bit cyclic redundancy codes for internet
//! applications", 2002) and every burst of up to 32 bits.

const POLYNOMIAL: u32 = 0xEDB8_8320;

// 1 KiB, which a microcontroller can spare; the larger tables of hosts gain little on frames this short
static TABLE: [u32; 256] = table();

const fn table() -> [u32; 256] {
    let mut table = [0; 256];
    let mut byte = 0;
    while byte < table.len() {
        let (mut remainder, mut bit) = (byte as u32, 0);
        while bit < 8 {
            let carry = 0u32.wrapping_sub(remainder & 1);
            remainder = (remainder >> 1) ^ (POLYNOMIAL & carry);
            bit += 1;
        }
        table[byte] = remainder;
        byte += 1;
    }
    table
}

/// A CRC-32 in progress.
///
/// ```
/// use sewfast_control::link::crc::Crc;
///
/// let crc = Crc::new().update(b"1234").update(b"56789");
/// assert_eq!(crc.value(), 0xCBF4_3926);
/// ```
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Crc(u32);

impl Crc {
    /// The CRC of no bytes.
    pub const fn new() -> Self {
        Self(u32::MAX)
    }

    /// Adds these bytes.
    #[must_use]
    #[inline]
    pub fn update(self, bytes: &[u8]) -> Self {
        Self(bytes.iter().fold(self.0, |crc, &byte| {
            (crc >> 8) ^ TABLE[usize::from(crc as u8 ^ byte)]
        }))
    }

    /// The CRC of all bytes so far.
    pub const fn value(self) -> u32 {
        !self.0
    }
}

impl Default for Crc {
    fn default() -> Self {
        Self::new()
    }
}

/// The CRC-32 of `bytes`.
pub fn crc32(bytes: &[u8]) -> u32 {
    Crc::new().update(bytes).value()
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;
    use std::vec::Vec;

    /// The definition: long division bit by bit.
    fn divided(bytes: &[u8]) -> u32 {
        let mut remainder = u32::MAX;
        for bit in bytes
            .iter()
            .flat_map(|byte| (0..8).map(move |k| byte >> k & 1))
        {
            let carry = (remainder ^ u32::from(bit)) & 1;
            remainder = (remainder >> 1) ^ if carry == 1 { POLYNOMIAL } else { 0 };
        }
        !remainder
    }

    #[test]
    fn has_the_check_value_of_the_catalogue() {
        assert_eq!(crc32(b"123456789"), 0xCBF4_3926);
        assert_eq!(crc32(b""), 0);
    }

    proptest! {
        #[test]
        fn equals_long_division_however_it_is_cut(
            bytes in prop::collection::vec(any::<u8>(), 0..300), at in any::<prop::sample::Index>(),
        ) {
            let (head, tail): (Vec<u8>, Vec<u8>) = {
                let (a, b) = bytes.split_at(at.index(bytes.len() + 1));
                (a.into(), b.into())
            };
            prop_assert_eq!(Crc::new().update(&head).update(&tail).value(), divided(&bytes));
            prop_assert_eq!(crc32(&bytes), divided(&bytes));
        }
    }
}
