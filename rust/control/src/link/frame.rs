//! Frames: header, body and CRC-32, stuffed by COBS and closed by a zero.
//!
//! The guarantees of CRC-32 hold for a frame's bits: errors of one to four bits and bursts of up to 32 bits are always detected. Damage
//! that moves a zero of the stuffed bytes (a damaged code byte, bytes lost or added, two frames joined) changes more bits. Of that, less
//! than 1 in 2^32 would pass, because the code bytes must also lead to the end.

use super::cobs;
use super::crc::Crc;

/// The longest body.
pub const MAX_BODY: usize = 231;
/// The length of the header.
pub const HEADER: usize = 15;
/// The longest frame: header, body, CRC.
pub const MAX_FRAME: usize = HEADER + MAX_BODY + CHECK;
/// The longest frame on the wire: code byte, stuffed frame, zero.
pub const MAX_WIRE: usize = MAX_FRAME + 2;

const CHECK: usize = 4;

/// The start of every frame.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Header {
    /// The kind of frame; bit 7 is set in a device's frames.
    pub kind: u8,
    /// The low 16 bits of the device's boot id.
    pub tag: u16,
    /// The sender's frame counter.
    pub sequence: u32,
    /// The device's time in microseconds; in a host's frames [`host_time`](Self::host_time).
    pub time: u64,
}

impl Header {
    /// The time field of a host's frames: its own clock in microseconds, which wraps, and above it its session.
    ///
    /// ```
    /// use sewfast_control::link::Header;
    ///
    /// let time = Header::host_time(7, 0x5_0000_0003);
    /// assert_eq!(time, 0x7_0000_0003);
    /// assert_eq!(Header { time, ..Header::default() }.session(), 7);
    /// ```
    #[must_use]
    #[inline]
    pub const fn host_time(session: u32, clock: u64) -> u64 {
        (session as u64) << 32 | clock & 0xFFFF_FFFF
    }

    /// The session in a host's frame.
    #[must_use]
    #[inline]
    pub const fn session(&self) -> u32 {
        (self.time >> 32) as u32
    }

    #[inline]
    fn bytes(&self) -> [u8; HEADER] {
        let mut bytes = [self.kind; HEADER];
        bytes[1..3].copy_from_slice(&self.tag.to_le_bytes());
        bytes[3..7].copy_from_slice(&self.sequence.to_le_bytes());
        bytes[7..].copy_from_slice(&self.time.to_le_bytes());
        bytes
    }

    #[inline]
    fn of(bytes: &[u8; HEADER]) -> Self {
        let [kind, a, b, c, d, e, f, time @ ..] = *bytes;
        Self {
            kind,
            tag: u16::from_le_bytes([a, b]),
            sequence: u32::from_le_bytes([c, d, e, f]),
            time: u64::from_le_bytes(time),
        }
    }
}

/// A frame that arrived whole.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Frame<'a> {
    /// The start of every frame.
    pub header: Header,
    /// 0 to [`MAX_BODY`] bytes.
    pub body: &'a [u8],
}

impl<'a> Frame<'a> {
    /// The frame in unstuffed bytes.
    ///
    /// # Errors
    /// [`Rejected::Short`], [`Rejected::Overlong`] or [`Rejected::Checksum`].
    #[inline]
    pub fn of(bytes: &'a [u8]) -> Result<Self, Rejected> {
        let (content, check) = bytes.split_last_chunk().ok_or(Rejected::Short)?;
        let (header, body) = content.split_first_chunk().ok_or(Rejected::Short)?;
        if body.len() > MAX_BODY {
            return Err(Rejected::Overlong);
        }
        if Crc::new().update(content).value() != u32::from_le_bytes(*check) {
            return Err(Rejected::Checksum);
        }
        Ok(Self {
            header: Header::of(header),
            body,
        })
    }
}

/// Why bytes were not a frame.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Rejected {
    /// More bytes without a zero than a frame can have.
    Overlong,
    /// The code bytes do not lead to the end.
    Stuffing,
    /// Fewer bytes than header and CRC.
    Short,
    /// The CRC does not match the bytes.
    Checksum,
}

/// Writes a frame with its closing zero to `out`; returns its length, always `HEADER + body.len() + 6`.
///
/// `None` if the body is longer than [`MAX_BODY`] or `out` is too short.
#[must_use]
pub fn encode(header: &Header, body: &[u8], out: &mut [u8]) -> Option<usize> {
    if body.len() > MAX_BODY {
        return None;
    }
    let length = 1 + HEADER + body.len() + CHECK;
    let (block, rest) = out.split_at_mut_checked(length)?;
    let delimiter = rest.first_mut()?;
    let (_, content) = block.split_first_mut()?;
    let (content, check) = content.split_last_chunk_mut()?;
    let (start, place) = content.split_first_chunk_mut()?;
    *start = header.bytes();
    place.copy_from_slice(body);
    *check = Crc::new().update(content).value().to_le_bytes();
    cobs::stuff(block)?;
    *delimiter = 0;
    Some(length + 1)
}

/// Finds the frames in a stream of arbitrary bytes.
///
/// Damage has no effect beyond the next zero: every whole frame after a zero is found.
#[derive(Clone, Debug)]
pub struct Deframer {
    block: [u8; MAX_FRAME + 1],
    length: usize,
    skipping: bool,
}

impl Deframer {
    /// At the start of a block.
    pub const fn new() -> Self {
        Self {
            block: [0; MAX_FRAME + 1],
            length: 0,
            skipping: false,
        }
    }

    /// Takes one byte; returns what it completed. An overlong run of bytes is reported as soon as it is too long, then
    /// skipped up to the next zero.
    #[inline]
    pub fn push(&mut self, byte: u8) -> Option<Result<Frame<'_>, Rejected>> {
        self.next(&mut &[byte][..])
    }

    /// Takes bytes from the front of `input` up to the end of the first block; returns what that was. `None` when `input` is used up.
    #[inline]
    pub fn next<'a>(&'a mut self, input: &mut &[u8]) -> Option<Result<Frame<'a>, Rejected>> {
        match self.block(input)? {
            Ok(block) => Some(
                cobs::unstuff(block)
                    .ok_or(Rejected::Stuffing)
                    .and_then(Frame::of),
            ),
            Err(rejected) => Some(Err(rejected)),
        }
    }

    /// The next complete block that is not empty.
    fn block(&mut self, input: &mut &[u8]) -> Option<Result<&mut [u8], Rejected>> {
        let mut length = 0;
        while length == 0 {
            if input.is_empty() {
                return None;
            }
            let (piece, closed) = split(input);
            let fits = self.append(piece);
            length = if closed { self.close() } else { 0 };
            if !fits {
                return Some(Err(Rejected::Overlong));
            }
        }
        self.block.get_mut(..length).map(Ok)
    }

    /// False if `piece` makes the block too long.
    fn append(&mut self, piece: &[u8]) -> bool {
        if self.skipping {
            return true;
        }
        let room = self.block.get_mut(self.length..);
        match room.and_then(|room| room.get_mut(..piece.len())) {
            Some(place) => {
                place.copy_from_slice(piece);
                self.length += piece.len();
            }
            None => {
                self.length = 0;
                self.skipping = true;
            }
        }
        !self.skipping
    }

    /// Ends the block; returns its length, 0 if it was skipped.
    fn close(&mut self) -> usize {
        self.skipping = false;
        core::mem::take(&mut self.length)
    }
}

impl Default for Deframer {
    fn default() -> Self {
        Self::new()
    }
}

/// The bytes before the first zero, and whether there was a zero; both are taken from `input`.
fn split<'a>(input: &mut &'a [u8]) -> (&'a [u8], bool) {
    let parts = zero(input).and_then(|at| input.split_at_checked(at));
    match parts.and_then(|(piece, rest)| rest.split_first().map(|(_, rest)| (piece, rest))) {
        Some((piece, rest)) => {
            *input = rest;
            (piece, true)
        }
        None => (core::mem::take(input), false),
    }
}

/// Index of the first zero, eight bytes at a time.
///
/// `(w - 01..01) & !w & 80..80` has the top bit of the lowest zero byte as its lowest bit (Warren, Hacker's Delight, 6-1).
fn zero(bytes: &[u8]) -> Option<usize> {
    const ONES: u64 = u64::MAX / 0xFF;
    let (words, tail) = bytes.as_chunks();
    for (k, word) in words.iter().enumerate() {
        let word = u64::from_le_bytes(*word);
        let zeros = word.wrapping_sub(ONES) & !word & (ONES << 7);
        if zeros != 0 {
            return Some(8 * k + zeros.trailing_zeros() as usize / 8);
        }
    }
    let found = tail.iter().position(|&byte| byte == 0);
    found.map(|at| 8 * words.len() + at)
}

#[cfg(test)]
pub(crate) mod tests;
