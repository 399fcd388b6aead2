//! The little-endian fields of a body: a cursor to read them, a buffer to write them.

use super::frame::MAX_BODY;

/// Reads the fields of a body from front to back; a field that is not there is `None`, and nothing is consumed.
///
/// ```
/// use sewfast_control::link::{Body, Fields};
///
/// let mut body = Body::new();
/// body.u8(3).u32(70_000).text("volt", 7);
/// let mut fields = Fields::new(body.bytes().unwrap_or(&[]));
/// assert_eq!(fields.u8(), Some(3));
/// assert_eq!(fields.u32(), Some(70_000));
/// assert_eq!(fields.text(7), Some("volt"));
/// assert_eq!(fields.end(), Some(()));
/// ```
#[derive(Clone, Copy, Debug)]
pub struct Fields<'a> {
    left: &'a [u8],
}

macro_rules! read {
    ($($name:ident $text:literal),*) => { $(
        #[doc = concat!("The next field, ", $text, ".")]
        #[inline]
        pub fn $name(&mut self) -> Option<$name> {
            self.array().map($name::from_le_bytes)
        }
    )* };
}

impl<'a> Fields<'a> {
    /// Reads `body` from its start.
    pub const fn new(body: &'a [u8]) -> Self {
        Self { left: body }
    }

    #[inline]
    fn array<const N: usize>(&mut self) -> Option<[u8; N]> {
        let (&field, left) = self.left.split_first_chunk()?;
        self.left = left;
        Some(field)
    }

    read!(u8 "an unsigned byte", u16 "an unsigned number of 2 bytes", u32 "an unsigned number of 4 bytes",
        u64 "an unsigned number of 8 bytes", i16 "a signed number of 2 bytes",
        i32 "a signed number of 4 bytes", f32 "an IEEE 754 number of 4 bytes");

    /// The next `count` bytes.
    pub fn take(&mut self, count: usize) -> Option<&'a [u8]> {
        let (taken, left) = self.left.split_at_checked(count)?;
        self.left = left;
        Some(taken)
    }

    /// The next text (its length in a byte, then UTF-8) of at most `max` bytes.
    pub fn text(&mut self, max: usize) -> Option<&'a str> {
        let mut ahead = *self;
        let length = usize::from(ahead.u8()?);
        let text = core::str::from_utf8(ahead.take(length)?).ok()?;
        if length > max {
            return None;
        }
        *self = ahead;
        Some(text)
    }

    /// All bytes that are left.
    pub fn rest(&mut self) -> &'a [u8] {
        core::mem::take(&mut self.left)
    }

    /// How many bytes are left.
    pub const fn len(&self) -> usize {
        self.left.len()
    }

    /// Whether nothing is left.
    pub const fn is_empty(&self) -> bool {
        self.left.is_empty()
    }

    /// `Some` if nothing is left: a body of the right length has been read.
    pub fn end(&self) -> Option<()> {
        self.is_empty().then_some(())
    }
}

/// A body under construction; it remembers whether something did not fit.
#[derive(Clone, Copy, Debug)]
pub struct Body {
    bytes: [u8; MAX_BODY],
    length: usize,
    overfull: bool,
}

macro_rules! write {
    ($($name:ident $text:literal),*) => { $(
        #[doc = concat!("Add ", $text, ".")]
        #[inline]
        pub fn $name(&mut self, value: $name) -> &mut Self {
            self.add(&value.to_le_bytes())
        }
    )* };
}

impl Body {
    /// An empty body.
    pub const fn new() -> Self {
        Self {
            bytes: [0; MAX_BODY],
            length: 0,
            overfull: false,
        }
    }

    write!(u8 "an unsigned byte", u16 "an unsigned number of 2 bytes", u32 "an unsigned number of 4 bytes",
        u64 "an unsigned number of 8 bytes", i16 "a signed number of 2 bytes",
        i32 "a signed number of 4 bytes", f32 "an IEEE 754 number of 4 bytes");

    /// Adds bytes unchanged.
    #[inline]
    pub fn add(&mut self, bytes: &[u8]) -> &mut Self {
        let room = self.bytes.get_mut(self.length..);
        match room.and_then(|room| room.get_mut(..bytes.len())) {
            Some(place) => {
                place.copy_from_slice(bytes);
                self.length += bytes.len();
            }
            None => self.overfull = true,
        }
        self
    }

    /// Adds a text: its length in a byte, then UTF-8. A text of more than `max` bytes does not fit.
    pub fn text(&mut self, text: &str, max: usize) -> &mut Self {
        match u8::try_from(text.len()) {
            Ok(length) if text.len() <= max && text.len() < self.room() => {
                self.u8(length).add(text.as_bytes())
            }
            _ => {
                self.overfull = true;
                self
            }
        }
    }

    /// How many bytes still fit.
    pub const fn room(&self) -> usize {
        MAX_BODY - self.length
    }

    /// How many bytes have been added.
    pub const fn len(&self) -> usize {
        self.length
    }

    /// Whether nothing has been added.
    pub const fn is_empty(&self) -> bool {
        self.length == 0
    }

    /// Starts again.
    pub const fn clear(&mut self) {
        self.length = 0;
        self.overfull = false;
    }

    /// The bytes added; `None` if something did not fit.
    pub fn bytes(&self) -> Option<&[u8]> {
        let whole = self.bytes.get(..self.length);
        whole.filter(|_| !self.overfull)
    }
}

impl Default for Body {
    fn default() -> Self {
        Self::new()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn fields_come_back(
            a in any::<u8>(), b in any::<u16>(), c in any::<u32>(), d in any::<u64>(), e in any::<i16>(),
            f in any::<i32>(), g in any::<f32>(), text in "[a-zµ²°]{0,12}",
        ) {
            let mut body = Body::new();
            body.u8(a).u16(b).u32(c).u64(d).i16(e).i32(f).f32(g).text(&text, 24).add(b"rest");
            let mut fields = Fields::new(body.bytes().unwrap());
            prop_assert_eq!((fields.u8(), fields.u16(), fields.u32()), (Some(a), Some(b), Some(c)));
            prop_assert_eq!((fields.u64(), fields.i16(), fields.i32()), (Some(d), Some(e), Some(f)));
            prop_assert_eq!(fields.f32().map(f32::to_bits), Some(g.to_bits()));
            prop_assert_eq!(fields.text(24), Some(&text[..]));
            prop_assert_eq!((fields.end(), fields.rest()), (None, &b"rest"[..]));
            prop_assert_eq!(fields.end(), Some(()));
        }

        #[test]
        fn hostile_bodies_read_as_nothing(body in prop::collection::vec(any::<u8>(), 0..20)) {
            let mut fields = Fields::new(&body);
            let whole = fields.u64().and_then(|_| fields.text(24)).and_then(|_| fields.f32());
            prop_assert!(whole.is_none() || body.len() >= 13);
            while fields.u8().is_some() {}
            prop_assert_eq!(fields.end(), Some(()));
        }
    }

    #[test]
    fn a_field_that_is_not_whole_is_not_taken() {
        let mut fields = Fields::new(&[1, 2, 3]);
        assert_eq!((fields.u32(), fields.len()), (None, 3));
        assert_eq!((fields.take(4), fields.take(2)), (None, Some(&[1, 2][..])));
        let mut texts = Fields::new(&[3, b'a', b'b', b'c', 0xFF]);
        assert_eq!((texts.text(2), texts.text(3)), (None, Some("abc")));
        assert_eq!(Fields::new(&[1, 0xFF]).text(7), None);
    }

    #[test]
    fn a_body_that_overflows_is_none_until_cleared() {
        let mut body = Body::new();
        for _ in 0..MAX_BODY {
            body.u8(1);
        }
        assert_eq!(body.bytes().map(<[u8]>::len), Some(MAX_BODY));
        assert_eq!(body.u8(1).bytes(), None);
        body.clear();
        assert_eq!(body.text("volt", 3).bytes(), None);
        assert!(body.is_empty());
    }
}
