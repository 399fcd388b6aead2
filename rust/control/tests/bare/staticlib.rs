//! A library without the standard library: it links only if the controller crate does not need it either.
//!
//! If std were used anywhere below, its panic handler would collide with this one.

#![no_std]

use core::panic::PanicInfo;
use sewfast_control::link::{Device, Measurement};
use sewfast_control::{PidController, Design, Settings, Standard};

#[panic_handler]
fn halt(_: &PanicInfo<'_>) -> ! {
    loop {}
}

/// One control step with fixed gains, as firmware would call it; NaN if the settings are refused.
#[unsafe(no_mangle)]
pub extern "C" fn one_step(r: f32, y: f32) -> f32 {
    let gains = Standard { kp: 0.02, ti: 0.25, td: 0.004 };
    match PidController::<f32>::new(Design::new(Settings::new(gains, 1e-3))) {
        Ok(mut controller) => controller.step(r, y),
        Err(_) => f32::NAN,
    }
}

/// A control period of a device, as firmware would call it.
#[unsafe(no_mangle)]
pub extern "C" fn one_period(device: &mut Device<64>, now: u64, counts: i32) -> f32 {
    let measurement = Measurement {
        counts,
        current: f32::NAN,
        further: &[],
    };
    let mut wire = [0; 64];
    device.receive(now, &wire);
    device.transmit(&mut wire);
    device.sample(now, &measurement).u
}
