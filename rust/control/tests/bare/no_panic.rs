//! A library that links only while no path through the link's frames can panic.
//!
//! The optimiser drops the panic handler where nothing calls it; the symbol that it asks for does not exist.

#![no_std]

use core::panic::PanicInfo;
use sewfast_control::link::{Body, Deframer, Fields, Header, MAX_WIRE, encode};

#[panic_handler]
fn halt(_: &PanicInfo<'_>) -> ! {
    unsafe extern "C" {
        fn there_is_a_path_that_panics() -> !;
    }
    // SAFETY: never linked
    unsafe { there_is_a_path_that_panics() }
}

/// Any header and body.
#[unsafe(no_mangle)]
pub fn send(header: &Header, body: &[u8], out: &mut [u8; MAX_WIRE]) -> Option<usize> {
    encode(header, body, out)
}

/// Any bytes at all, in a body of any shape.
#[unsafe(no_mangle)]
pub fn receive(deframer: &mut Deframer, mut input: &[u8]) -> Option<f32> {
    let mut last = None;
    while let Some(found) = deframer.next(&mut input) {
        let mut fields = Fields::new(found.ok()?.body);
        let sum = u64::from(fields.u8()?) + u64::from(fields.u16()?) + (fields.u64()? >> 1);
        let text = fields.text(24)?;
        last = Some((sum as f32) + (text.len() as f32) + fields.f32()?);
    }
    last
}

/// More fields than a body holds.
#[unsafe(no_mangle)]
pub fn write(body: &mut Body, text: &str, rest: &[u8]) -> Option<usize> {
    body.u8(1).u32(2).f32(3.0).text(text, 24).add(rest).add(rest);
    body.bytes().map(<[u8]>::len)
}
