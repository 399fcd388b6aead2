//! Stops at an angle: how early they begin.

use super::*;

/// A law whose shaft follows exactly at these speeds and then stops within a count: the samples after which its place is behind
/// that of the last speed, and the largest change of the command until then.
fn begins(speeds: impl Iterator<Item = f64>) -> (usize, f64) {
    let taps = [0.02; 16];
    let levels = [-5000.0, 5000.0].map(|y| Level { y, u: y / 490.0 });
    let ahead = Design {
        feedforward: Feedforward::new(20, 0.5, &levels, &taps).unwrap(),
        ..*speed_loop().design()
    };
    let speed = PidController::new(ahead).unwrap();
    let mut law = PositionLoop::new(design(rates(&[(0.0, 2e4, 2e4)]), 6), speed).unwrap();
    let mut u = 0.0;
    for speed in speeds {
        let moved = speed * law.per_sample;
        u = law.step(speed, moved);
    }
    let step = law.rate * law.per_sample;
    law.stop(0.0, 1.0, true).unwrap();
    let (mut place, mut steepest) = (law.place(), 0.0_f64);
    assert!((place - law.counts()).abs() < 0.5);
    for k in 0.. {
        let last = std::mem::replace(&mut u, law.step(0.0, step));
        steepest = steepest.max((u - last).abs());
        let before = std::mem::replace(&mut place, law.place());
        if place - before < 0.97 * step {
            return (k, steepest);
        }
    }
    unreachable!()
}

#[test]
fn a_stop_from_a_steady_speed_begins_before_the_preview_is_over() {
    let steady = |k: usize| 2000.0 + 1e-4 * (k % 2) as f64;
    let (constant, steepest) = begins(std::iter::repeat_n(2000.0, 60));
    // half a count over the preview, which nobody sees
    let (rounded, _) = begins((0..60).map(steady));
    let (changing, without) = begins((0..60).map(|k| if k < 50 { 1990.0 } else { 2000.0 }));
    // seven of sixteen taps are less than half of them, and the mean is three samples late; they are told in half of that time
    assert_eq!((constant, rounded), (changing - 5, constant));
    assert!((20..=27).contains(&changing), "{changing}");
    // two samples of the profile at once, where one is told else
    assert!(steepest <= 2.1 * without, "{steepest} {without}");
}
