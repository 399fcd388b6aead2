//! Counts the instructions of a step of the position loop on the emulated Cortex-M4, in single precision: for each phase of a run
//! a line with mean and most, then the bytes of the position loop beyond its speed loop, and those of the speed loop.

#![no_std]

use core::panic::PanicInfo;

use sewfast_control::{
    Design, Feedforward, Level, PidController, PositionDesign, PositionLoop, Rate, Rates, Settings,
    Standard, Turning,
};

const TS: f32 = 1e-3;
const TURN: f32 = 1572.0;

unsafe extern "C" {
    fn say(text: *const u8);
}

/// A timer of the board that counts down at 25 MHz: every 40th instruction, as an instruction takes a nanosecond (`-icount`).
const TIMER: *mut u32 = 0x4000_0000 as *mut u32;

fn ticks() -> u32 {
    // SAFETY: the timer's value
    unsafe { TIMER.add(1).read_volatile() }
}

#[panic_handler]
fn halt(_: &PanicInfo<'_>) -> ! {
    loop {}
}

/// A speed loop with all that `sewfast tune` gives one: mean of 8 samples, 8 levels, 16 taps, a preview of 10.
fn speed_loop() -> PidController<f32> {
    PidController::new(speed_design()).unwrap_or_else(|_| panic!())
}

fn speed_design() -> Design<f32> {
    let gains = Standard {
        kp: 0.01,
        ti: 0.03,
        td: 0.0,
    };
    let limits = Settings {
        alpha: 0.3,
        beta: -0.5,
        u_min: -20.0,
        u_max: 20.0,
        ..Settings::new(gains, TS)
    };
    let levels = [-5e3, -3e3, -1e3, -10.0, 10.0, 1e3, 3e3, 5e3].map(|y: f32| Level {
        y,
        u: y / 490.0 + 0.3 * (y * 0.1).clamp(-1.0, 1.0),
    });
    let mut taps = [0.0; 16];
    taps[1..8].fill(0.1 / 7.0);
    let feedforward = Feedforward::new(10, 0.5, &levels, &taps).unwrap_or(Feedforward::NONE);
    Design {
        filter_samples: 8,
        feedforward,
        ..Design::new(limits)
    }
}

fn position_loop() -> PositionLoop<f32> {
    let mut rows = [Rate {
        speed: 0.0,
        up: 60e3,
        down: 60e3,
    }; 8];
    for (i, row) in rows.iter_mut().enumerate() {
        (row.speed, row.up, row.down) = (
            i as f32 * 500.0,
            60e3 - i as f32 * 4e3,
            60e3 + i as f32 * 4e3,
        );
    }
    let rates = Rates::new(&rows).unwrap_or_else(|_| panic!());
    let design = PositionDesign {
        gain: 20.0,
        counts_per_unit: TURN / 60.0,
        speed: 4e3,
        rates,
        smoothing: 12,
        landing: 30.0,
        creep: 40.0,
        releases: false,
    };
    PositionLoop::new(design, speed_loop()).unwrap_or_else(|_| panic!())
}

/// A motor with a time constant of 50 ms and dry friction of .3 V, and an encoder.
struct Motor {
    y: f32,
    /// Part of a count.
    rest: f32,
}

impl Motor {
    fn step(&mut self, u: f32) -> i32 {
        let way = if self.y == 0.0 { u } else { self.y };
        let held = self.y == 0.0 && u.abs() <= 0.3;
        let drive = if held { 0.0 } else { u - 0.3_f32.copysign(way) };
        let y = self.y + TS * (490.0 * drive - self.y) / 0.05;
        let y = if y * self.y < 0.0 { 0.0 } else { y };
        self.rest += 0.5 * (self.y + y) * (TS * TURN / 60.0);
        self.y = y;
        let moved = (self.rest + 1e4) as i32 - 10_000;
        self.rest -= moved as f32;
        moved
    }
}

/// Instructions of the steps of a phase; the timer shows every 40th.
struct Phase {
    steps: u32,
    ticks: u32,
    most: u32,
}

impl Phase {
    const NONE: Self = Self {
        steps: 0,
        ticks: 0,
        most: 0,
    };

    fn count(&mut self, step: impl FnOnce() -> f32) -> f32 {
        let before = ticks();
        let u = step();
        let took = before.wrapping_sub(ticks());
        self.steps += 1;
        self.ticks += took;
        self.most = self.most.max(took);
        u
    }

    fn say(&self, name: &str) {
        let mean = (40 * self.ticks + self.steps / 2) / self.steps;
        line(name, &[mean, 40 * self.most]);
    }
}

fn line(name: &str, numbers: &[u32]) {
    let mut text = [b' '; 64];
    for (place, letter) in text.iter_mut().zip(name.bytes()) {
        *place = letter;
    }
    let mut end = 32;
    for number in numbers {
        let mut rest = *number;
        for place in text[end..end + 9].iter_mut().rev() {
            *place = b'0' + (rest % 10) as u8;
            rest /= 10;
        }
        end += 10;
    }
    (text[end], text[end + 1]) = (b'\n', 0);
    // SAFETY: it ends with 0
    unsafe { say(text.as_ptr()) };
}

/// The program.
#[unsafe(no_mangle)]
pub extern "C" fn main() -> i32 {
    // SAFETY: the timer's registers: reload, value, control
    unsafe {
        TIMER.add(2).write_volatile(u32::MAX);
        TIMER.add(1).write_volatile(u32::MAX);
        TIMER.write_volatile(1);
    }
    count();
    0
}

fn count() {
    let without = Design {
        feedforward: Feedforward::NONE,
        ..speed_design()
    };
    for (name, design) in [
        ("PID and its filter", without),
        ("with feedforward", speed_design()),
    ] {
        let mut speed = PidController::new(design).unwrap_or_else(|_| panic!());
        let (mut alone, mut motor, mut u) = (Phase::NONE, Motor { y: 0.0, rest: 0.0 }, 0.0);
        for k in 0..2000_u16 {
            let moved = motor.step(u);
            let r = (f32::from(k) * 5.0).min(3000.0);
            u = alone.count(|| speed.step(r, moved as f32 / (TS * TURN / 60.0)));
        }
        alone.say(name);
    }

    let (mut before, mut stopping, mut standing, mut begins) =
        (Phase::NONE, Phase::NONE, Phase::NONE, Phase::NONE);
    for run in 0..8_u16 {
        let (mut law, mut motor, mut u) = (
            Turning::new(position_loop()),
            Motor { y: 0.0, rest: 0.0 },
            0.0,
        );
        for k in 0..600 {
            let moved = motor.step(u);
            let r = (k as f32 * 10.0).min(700.0 + 400.0 * f32::from(run));
            u = before.count(|| law.step(r, moved));
        }
        for k in 0..1500 {
            let moved = motor.step(u);
            let stands = law.law().stands();
            if k == 0 {
                u = begins.count(|| {
                    let _ = law.stop(200.0 * f32::from(run), TURN, true);
                    law.step(0.0, moved)
                });
                continue;
            }
            let phase = if stands { &mut standing } else { &mut stopping };
            u = phase.count(|| law.step(0.0, moved));
        }
    }
    before.say("position loop before a stop");
    begins.say("a stop begins");
    stopping.say("in a stop");
    standing.say("at rest at the goal");

    let mut goals = Phase::NONE;
    let (mut law, mut motor, mut u) = (
        Turning::new(position_loop()),
        Motor { y: 0.0, rest: 0.0 },
        0.0,
    );
    law.follow();
    for k in 0..4000_u16 {
        let moved = motor.step(u);
        // half of the time a goal that stands, half of it one that moves
        let goal = if k % 1000 < 500 {
            4000.0
        } else {
            4000.0 - 8.0 * f32::from(k % 1000 - 500)
        };
        u = goals.count(|| law.step(goal, moved));
    }
    goals.say("following goals");
    let bytes = size_of::<Turning>() - size_of::<PidController<f32>>();
    line(
        "bytes",
        &[bytes as u32, size_of::<PidController<f32>>() as u32],
    );
}
