//! A library that links only if no path through the link's frames and the controller can panic.
//!
//! The optimiser drops the panic handler if nothing calls it; the symbol that it needs does not exist.

#![no_std]

use core::panic::PanicInfo;
use sewfast_control::link::{Body, Deframer, Fields, Header, MAX_WIRE, encode};
use sewfast_control::model::{Equation, Model, Orders, Scaling};
use sewfast_control::{PidController, Design, Point, Schedule};

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

/// Any points.
#[unsafe(no_mangle)]
pub fn schedule(points: &[Point<f32>]) -> Option<Schedule<f32>> {
    Schedule::new(points).ok()
}

/// Any design.
#[unsafe(no_mangle)]
pub fn make(design: &Design<f32>) -> Option<PidController<f32>> {
    PidController::new(*design).ok()
}

/// Any signals.
#[unsafe(no_mangle)]
pub fn control(controller: &mut PidController<f32>, r: f32, y: f32, feedforward: f32) -> f32 {
    controller.step_with(r, y, feedforward)
}

/// The same in double precision.
#[unsafe(no_mangle)]
pub fn control_double(controller: &mut PidController<f64>, r: f64, y: f64, feedforward: f64) -> f64 {
    controller.step_with(r, y, feedforward)
}

/// Any change while it runs.
#[unsafe(no_mangle)]
pub fn change(controller: &mut PidController<f32>, design: &Design<f32>, u: f32) -> bool {
    let changed = controller.set_design(*design).is_ok();
    let manual = controller.set_manual(u).is_ok();
    controller.set_automatic();
    controller.reset();
    changed && manual && controller.is_manual()
}

/// Any model in any memory.
#[unsafe(no_mangle)]
pub fn simulate(
    orders: Orders,
    equation: Equation<'_, f32>,
    scaling: Option<Scaling<'_, f32>>,
    memory: &mut [f32],
    u: &[f32],
) -> Option<f32> {
    let mut model = Model::new(orders, equation, scaling, memory).ok()?;
    model.begin(u, u);
    Some(model.step(u))
}
