//! The device and the controller for firmware in C: `include/sewfast.h` is the documentation.
//!
//! As a library for firmware it is built with
//! `cargo rustc --package sewfast-capi --profile firmware --crate-type staticlib --target TARGET`.
#![no_std]

#[cfg(test)]
extern crate std;

pub mod device;
pub mod pid;

/// Firmware cannot unwind. Nothing above panics; if something did, the hardware watchdog would end it.
#[cfg(all(panic = "abort", not(test)))]
#[panic_handler]
fn halt(_: &core::panic::PanicInfo<'_>) -> ! {
    loop {}
}

/// Memory of the caller as an uninitialised `T`; `None` if it is too small or misaligned.
pub(crate) fn place<T>(storage: *mut core::ffi::c_void, size: usize) -> Option<*mut T> {
    let place = storage.cast::<T>();
    let fits = !place.is_null() && place.is_aligned() && size >= size_of::<T>();
    fits.then_some(place)
}

/// Writes a code if the caller has passed room for one.
///
/// # Safety
/// `code` is null or writable.
pub(crate) unsafe fn tell(code: *mut i32, value: i32) {
    if !code.is_null() {
        // SAFETY: not null, and by contract writable.
        unsafe { code.write(value) };
    }
}
