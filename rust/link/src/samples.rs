//! Batches of samples: from the bodies of SAMPLES frames to columns.

use sewfast_control::link::{Fields, MAX_BODY};
use sewfast_core::{Error, Result};

/// How a channel's samples are encoded.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Encoding {
    /// The first as i32, each further one as its i16 difference from the previous one.
    Counts,
    /// i16, in steps of `1/steps_per_unit`.
    Steps,
    /// f32.
    Number,
}

/// A streamed channel.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Channel {
    /// How its samples are encoded.
    pub encoding: Encoding,
    /// Steps per unit, if the encoding is in steps.
    pub steps_per_unit: u32,
}

impl Channel {
    /// The channel as described by DESCRIBE.
    ///
    /// # Errors
    /// An unknown encoding, or missing steps per unit.
    pub fn described(encoding: u8, steps_per_unit: u32) -> Result<Self> {
        let encoding = match encoding {
            0 => Encoding::Counts,
            1 => Encoding::Steps,
            2 => Encoding::Number,
            _ => {
                return Err(Error::setting(format!(
                    "expected an encoding of 0 to 2, got {encoding}; the device may need a newer sewfast"
                )));
            }
        };
        if encoding == Encoding::Steps && steps_per_unit == 0 {
            return Err(Error::setting(
                "expected at least one step per unit for encoding 1, got 0; correct the device's DESCRIBE",
            ));
        }
        Ok(Self {
            encoding,
            steps_per_unit,
        })
    }

    const fn size(&self) -> usize {
        match self.encoding {
            Encoding::Counts | Encoding::Steps => 2,
            Encoding::Number => 4,
        }
    }
}

/// Counts continued beyond 32 bits.
#[derive(Clone, Copy, Debug, Default)]
struct Unwrapped {
    last: Option<i32>,
    total: i64,
}

impl Unwrapped {
    fn to(&mut self, counts: i32) -> f64 {
        self.total = match self.last {
            Some(last) => self.total + i64::from(counts.wrapping_sub(last)),
            None => counts.into(),
        };
        self.last = Some(counts);
        self.total as f64
    }
}

/// The result of adding a batch.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Batch {
    /// The number of samples added to the columns, and the flags of the batch.
    Taken(usize, u8),
    /// The number of samples without room.
    NoRoom(usize),
    /// The length does not match any number of samples.
    Malformed,
}

/// Device times in microseconds and a column for each channel.
pub type Columns = (Vec<i64>, Vec<Vec<f64>>);

/// The samples of some channels, as columns that grow until they are taken.
#[derive(Clone, Debug)]
pub struct Samples {
    channels: Vec<Channel>,
    counts: Vec<Unwrapped>,
    period: i64,
    columns: Columns,
}

impl Samples {
    /// Most samples kept for a caller that does not take them.
    pub const ROOM: usize = 1 << 17;
    /// Most channels: one for each bit of the mask.
    pub const CHANNELS: usize = 16;

    /// Empty columns of these `channels`, sampled every `period` microseconds.
    ///
    /// # Errors
    /// No or too many channels, a sample that does not fit a frame, a period of zero.
    pub fn new(channels: &[Channel], period: u32) -> Result<Self> {
        if channels.is_empty() || channels.len() > Self::CHANNELS {
            return Err(Error::setting(format!(
                "expected 1 to {} streamed channels, got {}; choose fewer",
                Self::CHANNELS,
                channels.len()
            )));
        }
        if period == 0 {
            return Err(Error::setting(
                "expected a sample period of at least 1 us, got 0; correct what the device states",
            ));
        }
        Ok(Self {
            channels: channels.to_vec(),
            counts: vec![Unwrapped::default(); channels.len()],
            period: period.into(),
            columns: (Vec::new(), vec![Vec::new(); channels.len()]),
        })
    }

    /// Counts restart with the next batch.
    pub fn restart(&mut self) {
        self.counts.fill(Unwrapped::default());
    }

    /// Number of samples in a body of this length.
    fn samples_in(&self, length: usize) -> Option<usize> {
        let counters = self
            .channels
            .iter()
            .filter(|c| c.encoding == Encoding::Counts);
        let values = length.checked_sub(1 + 2 * counters.count())?;
        let size: usize = self.channels.iter().map(Channel::size).sum();
        let whole = values >= size && values.is_multiple_of(size) && length <= MAX_BODY;
        whole.then(|| values / size)
    }

    /// Takes the body of a SAMPLES frame whose first sample was taken at `time`.
    pub fn add(&mut self, time: u64, body: &[u8]) -> Batch {
        let Some(count) = self.samples_in(body.len()) else {
            return Batch::Malformed;
        };
        if self.columns.0.len() + count > Self::ROOM {
            return Batch::NoRoom(count);
        }
        let mut fields = Fields::new(body);
        let flags = fields.u8().unwrap_or(0);
        let columns = self
            .channels
            .iter()
            .zip(&mut self.counts)
            .zip(&mut self.columns.1);
        for ((channel, counts), column) in columns {
            decode(channel, counts, count, &mut fields, column);
        }
        let start = i64::try_from(time).unwrap_or(i64::MAX);
        let times = (0..count as i64).map(|k| start.saturating_add(k * self.period));
        self.columns.0.extend(times);
        Batch::Taken(count, flags)
    }

    /// Moves the samples since the last call to the end of `columns`.
    pub fn append_to(&mut self, columns: &mut Columns) {
        columns.0.append(&mut self.columns.0);
        for (column, more) in columns.1.iter_mut().zip(&mut self.columns.1) {
            column.append(more);
        }
    }

    /// Time of the newest sample that has not been taken \[us\].
    pub fn newest(&self) -> Option<i64> {
        self.columns.0.last().copied()
    }

    /// The samples since the last call.
    pub fn take(&mut self) -> Columns {
        let (times, values) = &mut self.columns;
        (
            std::mem::take(times),
            values.iter_mut().map(std::mem::take).collect(),
        )
    }
}

/// Moves the `count` samples of one channel from the body to its column.
fn decode(
    channel: &Channel,
    counts: &mut Unwrapped,
    count: usize,
    fields: &mut Fields<'_>,
    column: &mut Vec<f64>,
) {
    match channel.encoding {
        Encoding::Counts => {
            let mut at = fields.i32().unwrap_or(0);
            column.push(counts.to(at));
            column.extend(words(fields, count - 1).map(|difference| {
                at = at.wrapping_add(i16::from_le_bytes(difference).into());
                counts.to(at)
            }));
        }
        Encoding::Steps => {
            let steps = f64::from(channel.steps_per_unit);
            column.extend(words(fields, count).map(|w| f64::from(i16::from_le_bytes(w)) / steps));
        }
        Encoding::Number => {
            column.extend(words(fields, count).map(|w| f64::from(f32::from_le_bytes(w))));
        }
    }
}

fn words<'a, const N: usize>(
    fields: &mut Fields<'a>,
    count: usize,
) -> impl Iterator<Item = [u8; N]> + 'a {
    let bytes = fields.take(N * count).unwrap_or(&[]);
    bytes.as_chunks().0.iter().copied()
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;
    use sewfast_control::link::Body;

    const COUNTS: Channel = Channel {
        encoding: Encoding::Counts,
        steps_per_unit: 1,
    };
    const VOLT: Channel = Channel {
        encoding: Encoding::Steps,
        steps_per_unit: 1000,
    };
    const SPEED: Channel = Channel {
        encoding: Encoding::Number,
        steps_per_unit: 1,
    };

    proptest! {
        #[test]
        fn columns_are_what_was_written(
            first in any::<i32>(), time in 0..1u64 << 60, flags in any::<u8>(),
            rows in prop::collection::vec((any::<i16>(), any::<i16>(), -1e6f32..1e6), 1..25),
        ) {
            let mut body = Body::new();
            body.u8(flags).i32(first);
            rows[1..].iter().for_each(|row| { body.i16(row.0); });
            rows.iter().for_each(|row| { body.i16(row.1); });
            rows.iter().for_each(|row| { body.f32(row.2); });
            let mut samples = Samples::new(&[COUNTS, VOLT, SPEED], 250).unwrap();
            let batch = samples.add(time, body.bytes().unwrap());
            prop_assert_eq!(batch, Batch::Taken(rows.len(), flags));
            let (times, columns) = samples.take();
            let mut counts = i64::from(first);
            for (k, row) in rows.iter().enumerate() {
                counts += if k > 0 { i64::from(row.0) } else { 0 };
                prop_assert_eq!(times[k], time as i64 + 250 * k as i64);
                prop_assert_eq!(columns[0][k], counts as f64);
                prop_assert_eq!(columns[1][k], f64::from(row.1) / 1000.0);
                prop_assert_eq!(columns[2][k], f64::from(row.2));
            }
            prop_assert_eq!(samples.take(), (vec![], vec![vec![]; 3]));
        }

        #[test]
        fn any_body_is_whole_or_refused(
            time in any::<u64>(), body in prop::collection::vec(any::<u8>(), 0..300),
        ) {
            let mut samples = Samples::new(&[COUNTS, VOLT, SPEED], u32::MAX).unwrap();
            let batch = samples.add(time, &body);
            let (times, columns) = samples.take();
            prop_assert!(columns.iter().all(|column| column.len() == times.len()));
            match batch {
                Batch::Taken(n, _) => prop_assert_eq!((times.len(), body.len()), (n, 3 + 8 * n)),
                _ => prop_assert!(times.is_empty() && (body.len() < 11 || body.len() % 8 != 3 || body.len() > MAX_BODY)),
            }
        }
    }

    #[test]
    fn counts_go_on_where_their_32_bits_end_until_a_restart() {
        let mut samples = Samples::new(&[COUNTS], 1000).unwrap();
        let batch = |first: i32, difference: i16| {
            let mut body = Body::new();
            body.u8(0).i32(first).i16(difference);
            body.bytes().unwrap().to_vec()
        };
        samples.add(0, &batch(i32::MAX, 1));
        samples.add(9, &batch(i32::MIN + 5, -6));
        samples.restart();
        samples.add(12, &batch(-7, 7));
        let edge = f64::from(i32::MAX);
        let expected = [edge, edge + 1.0, edge + 6.0, edge, -7.0, 0.0];
        assert_eq!(samples.take().1[0], expected);
    }

    #[test]
    fn refuses_channels_that_cannot_be() {
        assert!(Samples::new(&[], 1).is_err());
        assert!(Samples::new(&[VOLT; Samples::CHANNELS + 1], 1).is_err());
        assert!(Samples::new(&[VOLT], 0).is_err());
        assert!(Channel::described(3, 1).is_err());
        assert!(Channel::described(1, 0).is_err());
        assert_eq!(Channel::described(1, 1000), Ok(VOLT));
    }
}
