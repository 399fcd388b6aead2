//! Consistent overhead byte stuffing of blocks of up to 254 bytes, in place.
//!
//! Cheshire and Baker, "Consistent Overhead Byte Stuffing", IEEE/ACM Transactions on Networking 7(2), 1999. A code byte
//! replaces each zero, with an additional one in front, and holds the distance to the next code byte. So in short
//! blocks no byte is moved, and different stuffed blocks have different data.

/// The longest data that a single code byte in front can carry.
pub const MAX_DATA: usize = 254;

/// Stuffs `block[1..]`; the code byte goes to `block[0]`. Returns `None` and does nothing if there is no room for it or
/// more than [`MAX_DATA`] bytes follow.
///
/// ```
/// use sewfast_control::link::cobs::{stuff, unstuff};
///
/// let mut block = [0, 0x11, 0x22, 0x00, 0x33];
/// assert_eq!(stuff(&mut block), Some(()));
/// assert_eq!(block, [0x03, 0x11, 0x22, 0x02, 0x33]);
/// assert_eq!(unstuff(&mut block), Some(&[0x11, 0x22, 0x00, 0x33][..]));
/// ```
#[must_use]
pub fn stuff(block: &mut [u8]) -> Option<()> {
    let (code, data) = block.split_first_mut()?;
    if data.len() > MAX_DATA {
        return None;
    }
    let mut distance = 1;
    for byte in data.iter_mut().rev() {
        if *byte == 0 {
            *byte = distance;
            distance = 1;
        } else {
            distance += 1;
        }
    }
    *code = distance;
    Some(())
}

/// The data of a stuffed `block` without its closing zero; `None` if the code bytes do not lead to its end.
///
/// The block lies between two zeros and so contains none; a zero between code bytes would be passed on as data.
pub fn unstuff(block: &mut [u8]) -> Option<&[u8]> {
    if block.len() > MAX_DATA + 1 {
        return None;
    }
    let mut at = 0;
    while at < block.len() {
        let code = block.get_mut(at)?;
        if *code == 0 {
            return None;
        }
        at += usize::from(*code);
        *code = 0;
    }
    if at > block.len() {
        return None;
    }
    block.get(1..)
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;
    use std::vec::Vec;

    fn stuffed(data: &[u8]) -> Vec<u8> {
        let mut block: Vec<u8> = [0].iter().chain(data).copied().collect();
        stuff(&mut block).unwrap();
        block
    }

    /// The encoder as listed in the paper: blocks of up to 254 bytes, each after its code.
    fn of_the_paper(data: &[u8]) -> Vec<u8> {
        let (mut out, mut start, mut code) = (std::vec![0], 0, 1u8);
        for (k, &byte) in data.iter().enumerate() {
            if byte != 0 {
                out.push(byte);
                code += 1;
            }
            if byte == 0 || code == 0xFF && k + 1 < data.len() {
                out[start] = code;
                (start, code) = (out.len(), 1);
                out.push(0);
            }
        }
        out[start] = code;
        out
    }

    #[test]
    fn gives_the_examples_of_the_paper() {
        // figure 2: the start of an IP packet
        let packet = [
            0x45, 0x00, 0x00, 0x2C, 0x4C, 0x79, 0x00, 0x00, 0x40, 0x06, 0x4F, 0x37,
        ];
        let expected = [
            0x02, 0x45, 0x01, 0x04, 0x2C, 0x4C, 0x79, 0x01, 0x05, 0x40, 0x06, 0x4F, 0x37,
        ];
        assert_eq!(stuffed(&packet), expected);
        assert_eq!(stuffed(&[0]), [1, 1]);
        assert_eq!(stuffed(&[0, 0]), [1, 1, 1]);
        assert_eq!(stuffed(&[0, 0x11, 0]), [1, 2, 0x11, 1]);
        assert_eq!(stuffed(&[0x11, 0, 0, 0]), [2, 0x11, 1, 1, 1]);
        assert_eq!(stuffed(&[]), [1]);
    }

    #[test]
    fn gives_the_longest_block_without_zeros_the_code_ff() {
        let data: Vec<u8> = (1..=254).collect();
        let block = stuffed(&data);
        assert_eq!((block[0], &block[1..]), (0xFF, &data[..]));
        assert_eq!(unstuff(&mut block.clone()), Some(&data[..]));
        let with_zero: Vec<u8> = (0..=253).collect();
        assert_eq!(stuffed(&with_zero)[..2], [1, 0xFE]);
    }

    #[test]
    fn refuses_what_is_too_long_or_leads_nowhere() {
        assert_eq!(stuff(&mut []), None);
        assert_eq!(stuff(&mut [1; MAX_DATA + 2]), None);
        assert_eq!(unstuff(&mut [1; MAX_DATA + 2]), None);
        assert_eq!(unstuff(&mut []), None);
        assert_eq!(unstuff(&mut [3, 1]), None);
        assert_eq!(unstuff(&mut [2, 1, 2]), None);
        assert_eq!(unstuff(&mut [1, 0, 1]), None);
    }

    proptest! {
        #[test]
        fn comes_back_and_equals_the_paper(
            data in prop::collection::vec(prop_oneof![Just(0u8), any::<u8>()], 0..=MAX_DATA),
        ) {
            let mut block = stuffed(&data);
            prop_assert!(!block.contains(&0));
            prop_assert_eq!(&block, &of_the_paper(&data));
            prop_assert_eq!(unstuff(&mut block), Some(&data[..]));
        }

        #[test]
        fn means_one_thing_only(block in prop::collection::vec(1..=255u8, 1..=MAX_DATA + 1)) {
            let mut data = block.clone();
            if let Some(data) = unstuff(&mut data) {
                prop_assert_eq!(stuffed(data), block);
            }
        }
    }
}
