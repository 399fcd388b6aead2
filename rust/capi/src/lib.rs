//! The device and the controller for firmware in C: `include/sewfast.h` is the documentation.
//!
//! As a library for firmware it is built by
//! `cargo rustc --package sewfast-capi --profile firmware --crate-type staticlib --target TARGET`.
#![no_std]

#[cfg(test)]
extern crate std;

pub mod device;
pub mod pid;

/// Firmware has nowhere to unwind to. Nothing above panics; where something did, the hardware watchdog would end it.
#[cfg(all(panic = "abort", not(test)))]
#[panic_handler]
fn halt(_: &core::panic::PanicInfo<'_>) -> ! {
    loop {}
}

/// Memory of the caller as a `T` that is yet to be written; `None` where it is too small or lies askew.
pub(crate) fn place<T>(storage: *mut core::ffi::c_void, size: usize) -> Option<*mut T> {
    let place = storage.cast::<T>();
    let fits = !place.is_null() && place.is_aligned() && size >= size_of::<T>();
    fits.then_some(place)
}

/// Writes a code where the caller has room for one.
///
/// # Safety
/// `code` is null or can be written to.
pub(crate) unsafe fn tell(code: *mut i32, value: i32) {
    if !code.is_null() {
        // SAFETY: not null, and by contract writable.
        unsafe { code.write(value) };
    }
}
