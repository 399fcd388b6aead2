//! Pieces of long records, which say as well as the whole where a fit should start.

use crate::Record;

/// Records of more samples than this in all are searched in an excerpt.
const LONG: usize = 40_000;
/// Samples of an excerpt, about.
const EXCERPT: usize = 16_000;
/// Samples of a piece.
const PIECE: usize = 8_000;

/// Pieces of each record, evenly spread and in proportion to its length; none where the records are short.
pub(super) fn excerpt<'a>(records: &[Record<'a>]) -> Option<Vec<Record<'a>>> {
    let samples: usize = records.iter().map(Record::len).sum();
    if samples <= LONG {
        return None;
    }
    let pieces: Vec<_> = records
        .iter()
        .flat_map(|record| {
            let share = (EXCERPT * record.len()).div_ceil(samples);
            pieces_of(record, share.min(record.len()))
        })
        .collect();
    (!pieces.is_empty()).then_some(pieces)
}

/// Pieces of about `share` samples together; those without any measured output of some weight are left out.
fn pieces_of<'a>(record: &Record<'a>, share: usize) -> Vec<Record<'a>> {
    let count = share.div_ceil(PIECE).max(1);
    let length = share / count;
    let room = record.len() - length;
    let piece = |i: usize| {
        // a single one comes from the middle
        let start = if count == 1 {
            room / 2
        } else {
            i * room / (count - 1)
        };
        let (from, to) = (start * record.channels, (start + length) * record.channels);
        let y = &record.y[start..start + length];
        let piece = Record::with_gaps(&record.u[from..to], record.channels, y).ok()?;
        match record.weights {
            None => Some(piece),
            Some(weights) => piece.with_weights(&weights[start..start + length]).ok(),
        }
    };
    (0..count).filter_map(piece).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn leaves_short_records_whole_and_takes_pieces_of_long_ones() {
        let u: Vec<f64> = (0..200_000).map(f64::from).collect();
        let y = &u[..100_000];
        let short = Record::new(&u[..40_000], 1, &y[..40_000]).unwrap();
        assert!(excerpt(&[short]).is_none());
        let long = Record::new(&u, 2, y).unwrap();
        let other = Record::new(&u[..1_000], 1, &y[..1_000]).unwrap();
        let pieces = excerpt(&[long]).unwrap();
        assert_eq!(pieces.len(), 2);
        assert_eq!((pieces[0].y[0], pieces[1].y[7_999]), (0.0, 99_999.0));
        assert_eq!(pieces[1].u[0], 2.0 * pieces[1].y[0]);
        let both = excerpt(&[Record::new(y, 1, y).unwrap(), other]).unwrap();
        assert_eq!(both.len(), 3);
        let samples: usize = both.iter().map(Record::len).sum();
        assert!((15_900..16_100).contains(&samples), "{samples}");
    }
}
