//! The cost of a step of each kind of controller on this machine, in single precision.
//!
//! `cargo run --release --package sewfast-control --example controller_step`

use std::hint::black_box;
use std::time::Instant;

use sewfast_control::{
    AnyController, AnyDesign, Controller, Design, STATES, Settings, Standard, StateDesign, Weights,
    lqg,
};

const SAMPLES: u32 = 4_000_000;

fn pid() -> AnyDesign<f32> {
    let gains = Standard {
        kp: 0.02,
        ti: 0.25,
        td: 0.004,
    };
    let pid = Settings {
        n: 10.0,
        u_min: -20.0,
        u_max: 20.0,
        ..Settings::new(gains, 1e-3)
    };
    Design {
        observer_time: 4e-3,
        r_rate: 5e4,
        ..Design::new(pid)
    }
    .into()
}

fn states() -> AnyDesign<f32> {
    let none = [0.0; STATES];
    let weights = Weights {
        rho: 2e5,
        integral: 20.0,
        noise: 2e5,
        reference: 0.9,
    };
    let plant = StateDesign {
        a: [-1.869_64, 0.870_14, 0.0, 0.0],
        b: [0.12265, 0.12265, 0.0, 0.0],
        k: none,
        l: none,
        rest: none,
        kr: 0.0,
        ki: 0.0,
        lead: 2e-3,
        r_rate: 5e4,
        u_min: -20.0,
        u_max: 20.0,
        slew: f32::INFINITY.into(),
        ts: 1e-3,
        weights,
    };
    lqg(plant, weights)
        .expect("gains of a stable plant")
        .single()
        .into()
}

fn cost(mut controller: AnyController<f32>) -> f64 {
    let began = Instant::now();
    for k in 0..SAMPLES {
        let y = (k & 1023) as f32;
        black_box(controller.step(black_box(500.0), black_box(y)));
    }
    began.elapsed().as_secs_f64() / f64::from(SAMPLES) * 1e9
}

fn main() {
    for (name, design) in [("PID", pid()), ("state feedback", states())] {
        let controller = design.controller().expect("settings within their ranges");
        let best = (0..5).map(|_| cost(controller.clone()));
        println!("{name:15} {:5.1} ns", best.fold(f64::INFINITY, f64::min));
    }
}
