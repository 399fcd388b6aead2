//! Laws of the machine.

use super::*;
use crate::random::Random;

fn nominal() -> Machine {
    Machine::new(Parameters::default()).unwrap()
}

fn machine(changes: &[(&str, f64)]) -> Machine {
    let parameters = Parameters::default().with(changes.iter().copied());
    Machine::new(parameters.unwrap()).unwrap()
}

fn held(levels: impl Iterator<Item = f64>, samples: usize) -> Vec<f64> {
    levels
        .flat_map(|u| std::iter::repeat_n(u, samples))
        .collect()
}

fn random(seed: u64, samples: usize, hold: usize, amplitude: f64) -> Vec<f64> {
    let mut random = Random::new(seed);
    held(
        (0..samples / hold).map(|_| random.between(-amplitude, amplitude)),
        hold,
    )
}

fn chirp(samples: usize, amplitude: f64, offset: f64) -> Vec<f64> {
    let phase = |t: f64| TAU * (0.1 + 0.2 * t) * t;
    let at = |k: usize| offset + amplitude * phase(k as f64 * SAMPLE_TIME).sin();
    (0..samples).map(at).collect()
}

/// Excitations that reach every limit of the drive and many reversals.
fn excitations() -> Vec<(&'static str, Vec<f64>)> {
    vec![
        (
            "steps",
            held(
                [20.0, -20.0, 20.0, 0.0, -20.0, 5.0, -5.0, 0.0].into_iter(),
                700,
            ),
        ),
        (
            "fast steps",
            held((0..60).map(|k| if k % 2 == 0 { 20.0 } else { -20.0 }), 37),
        ),
        ("chirp", chirp(8000, 10.0, 10.0)),
        ("middle chirp", chirp(8000, 2.5, 3.5)),
        ("small chirp", chirp(8000, 0.9, 0.0)),
        ("random", random(1, 8000, 100, 20.0)),
        ("fast random", random(2, 8000, 7, 20.0)),
        ("every sample", random(3, 8000, 1, 20.0)),
        ("small random", random(4, 8000, 50, 1.5)),
        ("middle random", random(5, 8000, 150, 5.0)),
    ]
}

fn largest_error(parameters: Parameters, u: &[f64], coarse: u32, fine: u32) -> f64 {
    let run = |steps| {
        let mut machine = Machine::new(parameters).unwrap();
        machine.steps = steps;
        machine.run(u).unwrap().1
    };
    let pairs = run(coarse).into_iter().zip(run(fine));
    pairs.map(|(a, b)| (a - b).abs()).fold(0.0, f64::max)
}

#[test]
fn agrees_with_a_ten_times_finer_step_wherever_the_drive_is_driven() {
    for (name, u) in excitations() {
        let error = largest_error(Parameters::default(), &u, STEPS, 10 * STEPS);
        assert!(error < 0.1, "{name}: {error} RPM");
    }
}

/// Reversing from thousands of RPM, the crank stops at an angle decided by rounding. Whether it sticks there does not
/// depend on the step size, so the load over the turn is left out.
#[test]
fn agrees_with_a_ten_times_finer_step_through_reversals_from_full_speed() {
    let even = Parameters {
        angle_dependence: 0.0,
        ..Parameters::default()
    };
    let error = largest_error(even, &chirp(8000, 20.0, 0.0), STEPS, 10 * STEPS);
    assert!(error < 0.1, "{error} RPM");
}

#[test]
fn variants_agree_with_a_ten_times_finer_step_in_the_working_range() {
    let working = |name: &str| name.contains("middle") || name.contains("small");
    for (name, u) in excitations().into_iter().filter(|(name, _)| working(name)) {
        for seed in 0..20 {
            let error = largest_error(Parameters::variant(seed), &u, STEPS, 10 * STEPS);
            assert!(error < 0.1, "{name}, machine {seed}: {error} RPM");
        }
    }
}

#[test]
fn has_fourth_order_where_no_event_falls() {
    let u = chirp(1500, 0.5, 4.0);
    let error = |steps| largest_error(Parameters::default(), &u, steps, 64);
    let ratio = error(4) / error(8);
    assert!(
        ratio > 12.0,
        "halving the step divides the error by {ratio}"
    );
}

#[test]
fn conserves_energy_without_friction_and_voltage() {
    let free = Parameters {
        motor_constant: 0.0,
        coulomb_torque: 0.0,
        stribeck_torque: 0.0,
        viscous_friction: 0.0,
        ..Parameters::default()
    };
    let mut machine = nominal();
    machine.dynamics = Dynamics::new(&free);
    machine.state.speed = 60.0;
    machine.regime.motion = 1.0;
    let energy = |x: &State| {
        let p = &free;
        let first = p.load_first * (x.angle - p.load_first_angle).sin();
        let second = 0.5 * p.load_second * (2.0 * (x.angle - p.load_second_angle)).sin();
        0.5 * machine_inertia(p, x.angle) * x.speed * x.speed + first + second
    };
    let start = energy(&machine.state);
    for _ in 0..5000 {
        machine.advance(0.0);
        assert!((energy(&machine.state) / start - 1.0).abs() < 1e-9);
    }
    assert!(machine.position() > 1500.0);
}

fn machine_inertia(p: &Parameters, angle: f64) -> f64 {
    p.inertia * (1.0 + p.inertia_variation * (2.0 * (angle - p.inertia_angle)).cos())
}

#[test]
fn stands_still_exactly_at_zero_volts_in_every_position_of_every_machine() {
    for seed in 0..50 {
        for angle in [-3.0, -1.5, 0.0, 1.0, 2.5] {
            let parameters = Parameters::variant(seed).with([("initial_angle", angle)]);
            let mut machine = Machine::new(parameters.unwrap()).unwrap();
            machine.run(&[0.0; 500]).unwrap();
            assert_eq!((machine.position(), machine.speed_rpm()), (0.0, 0.0));
        }
    }
}

#[test]
fn comes_to_rest_after_a_run_and_breaks_away_above_its_friction() {
    let mut machine = nominal();
    machine.run(&[4.0; 1000]).unwrap();
    machine.run(&[0.0; 2000]).unwrap();
    assert_eq!(machine.speed_rpm(), 0.0);
    machine.run(&[0.35; 1000]).unwrap();
    assert_eq!(machine.speed_rpm(), 0.0);
    machine.run(&[1.0; 1000]).unwrap();
    assert!(machine.speed_rpm() > 100.0);
}

#[test]
fn mirrors_itself_without_angle_dependence() {
    let changes = [("angle_dependence", 0.0), ("quantisation", 0.0)];
    let u = random(11, 4000, 60, 20.0);
    let mirrored: Vec<f64> = u.iter().map(|u| -u).collect();
    let (counts, speed) = machine(&changes).run(&u).unwrap();
    let (counts_back, speed_back) = machine(&changes).run(&mirrored).unwrap();
    assert!(
        speed
            .iter()
            .zip(&speed_back)
            .all(|(a, b)| (a + b).abs() < 1e-6)
    );
    assert!(
        counts
            .iter()
            .zip(&counts_back)
            .all(|(a, b)| (a + b).abs() < 1e-6)
    );
}

#[test]
fn never_exceeds_the_current_limit_and_reaches_it() {
    for (name, u) in excitations() {
        let mut machine = nominal();
        let mut largest: f64 = 0.0;
        for &u in &u {
            machine.advance(u);
            largest = largest.max(machine.current().abs());
        }
        let limit = machine.parameters().current_limit;
        assert!(largest <= limit, "{name}: {largest} A");
        assert!(name != "steps" || largest == limit);
    }
}

#[test]
fn accelerates_as_fast_as_the_trapezoid_needs_with_margin() {
    for wanted in [0.0, 3000.0] {
        let mut machine = machine(&[("angle_dependence", 0.0)]);
        while machine.speed_rpm() < wanted || machine.current() < 19.0 {
            machine.advance(20.0);
        }
        let before = machine.speed_rpm();
        machine.advance(20.0);
        let acceleration = (machine.speed_rpm() - before) / SAMPLE_TIME;
        assert!(
            acceleration > 25_000.0,
            "{acceleration} RPM/s at {before} RPM"
        );
    }
}

#[test]
fn counts_rise_with_a_positive_speed_and_follow_the_position() {
    let (counts, speed) = nominal().run(&[3.0; 3000]).unwrap();
    assert!(speed.iter().all(|&v| v >= 0.0));
    assert!(
        counts
            .windows(2)
            .all(|pair| pair[1] >= pair[0] && pair[1].fract() == 0.0)
    );
    let turns = speed.iter().sum::<f64>() * SAMPLE_TIME / 60.0;
    assert!((counts[2999] / 1572.0 - turns).abs() < 0.02);
}

#[test]
fn gives_the_exact_position_without_quantisation() {
    let u = random(5, 2000, 50, 8.0);
    let (whole, _) = nominal().run(&u).unwrap();
    let (exact, _) = machine(&[("quantisation", 0.0)]).run(&u).unwrap();
    let phase = Parameters::default().encoder_phase;
    assert!(
        whole
            .iter()
            .zip(&exact)
            .all(|(w, e)| *w == (e + phase).floor())
    );
}

#[test]
fn starts_anew_after_a_reset_to_the_last_bit() {
    let u = random(6, 3000, 30, 20.0);
    let mut machine = Machine::new(Parameters::variant(9)).unwrap();
    let first = machine.run(&u).unwrap();
    machine.reset();
    assert_eq!(first, machine.run(&u).unwrap());
}

#[test]
fn clips_the_command_and_refuses_one_that_is_not_finite() {
    let run = |u: f64| machine(&[("u_limit", 10.0)]).run(&[u; 400]).unwrap();
    assert_eq!(run(10.0), run(1e300));
    for bad in [f64::NAN, f64::INFINITY] {
        let error = nominal().run(&[1.0, bad]).unwrap_err();
        assert!(error.message.contains("sample 1"), "{error}");
    }
}

#[test]
fn has_the_gain_and_the_time_constants_of_the_real_machine() {
    for speed in [1000.0, 1500.0, 2000.0] {
        let small = nominal().linearise(speed).unwrap();
        assert_like_the_real_machine(small.gain, small.time_constants);
    }
    assert!(nominal().linearise(0.0).is_err() && nominal().linearise(1e5).is_err());
}

fn assert_like_the_real_machine(gain: f64, [slow, fast]: [f64; 2]) {
    assert!((gain / 490.0 - 1.0).abs() < 0.03, "gain {gain} RPM/V");
    assert!((slow / 0.252 - 1.0).abs() < 0.05, "T1 {slow} s");
    assert!((fast / 0.0074 - 1.0).abs() < 0.10, "T2 {fast} s");
}

#[test]
fn answers_a_small_step_as_linearised() {
    let mut machine = machine(&[("angle_dependence", 0.0)]);
    let command = machine.linearise(1500.0).unwrap().command;
    machine.run(&vec![command; 5000]).unwrap();
    let start = machine.speed_rpm();
    let (_, speed) = machine.run(&vec![command + 0.05; 5000]).unwrap();
    let rise = machine.speed_rpm() - start;
    let missing = |k: usize| (machine.speed_rpm() - speed[k]) / rise;
    let slow = 0.3 / (missing(200) / missing(500)).ln();
    // The area over a second-order step response is the sum of its time constants (trapezoidal rule).
    let area = (1..5000).map(missing).sum::<f64>() + 0.5 * missing(0);
    assert_like_the_real_machine(rise / 0.05, [slow, area * SAMPLE_TIME - slow]);
}

#[test]
fn a_load_slows_by_its_torque_and_turns_back_what_nothing_holds() {
    let smooth = [("angle_dependence", 0.0)];
    let mut free = machine(&smooth);
    let mut loaded = machine(&smooth);
    for _ in 0..3000 {
        free.advance(4.0);
        loaded.advance(4.0);
    }
    assert_eq!(free.speed_rpm(), loaded.speed_rpm());
    loaded.set_load(0.1).unwrap();
    for _ in 0..3000 {
        free.advance(4.0);
        loaded.advance(4.0);
    }
    // the load is carried by current, which takes voltage that the speed then lacks
    let p = Parameters::default();
    let carried = loaded.current() - free.current();
    let lost = (free.speed_rpm() - loaded.speed_rpm()) / RPM;
    let friction = p.viscous_friction * lost;
    assert!((p.motor_constant * carried - 0.1 + friction).abs() < 1e-3);
    assert!((p.resistance * carried - p.motor_constant * lost).abs() < 0.02);
    loaded.reset();
    loaded.set_load(0.5).unwrap();
    (0..200).for_each(|_| loaded.advance(0.0));
    assert!(loaded.speed_rpm() < -100.0);
    assert!(loaded.set_load(f64::NAN).is_err());
}

#[test]
fn no_load_changes_no_bit() {
    let (mut one, mut other) = (nominal(), nominal());
    other.set_load(0.0).unwrap();
    let u = random(5, 4000, 40, 20.0);
    assert_eq!(one.run(&u).unwrap(), other.run(&u).unwrap());
}

#[test]
fn goes_on_from_its_memory_to_the_last_bit() {
    let mut first = nominal();
    first.set_load(0.02).unwrap();
    let u = random(5, 4000, 20, 15.0);
    first.run(&u[..2000]).unwrap();
    let mut second = nominal();
    second.recall(first.memory()).unwrap();
    assert_eq!(first.run(&u[2000..]), second.run(&u[2000..]));
    assert!(second.recall([f64::NAN; 11]).is_err());
}

/// Both masses without loss: after a blow the crank's speed swings at sqrt(c (1/J + 1/J_load)).
#[test]
fn a_shaft_swings_at_its_frequency() {
    for (stiffness, load) in [(40.0, 2e-3), (400.0, 1e-3), (2000.0, 5e-4)] {
        let mut crank = machine(&[
            ("load_inertia", load),
            ("shaft_stiffness", stiffness),
            ("shaft_damping", 0.0),
            ("coulomb_torque", 0.0),
            ("stribeck_torque", 0.0),
            ("viscous_friction", 0.0),
            ("motor_constant", 1e-3),
            ("angle_dependence", 0.0),
        ]);
        let mut memory = crank.memory();
        memory[1] = 100.0;
        memory[4] = 1.0;
        crank.recall(memory).unwrap();
        let mean = 100.0 * 2e-3 / (2e-3 + load) * RPM;
        let mut crossings = Vec::new();
        let mut before = crank.speed_rpm();
        for k in 0..2000 {
            crank.advance(0.0);
            let now = crank.speed_rpm();
            if before < mean && now >= mean {
                crossings.push(k as f64 + (mean - before) / (now - before));
            }
            before = now;
        }
        let (first, last) = (crossings[0], crossings[crossings.len() - 1]);
        let frequency = 1e3 * (crossings.len() - 1) as f64 / (last - first);
        let expected = (stiffness * (1.0 / 2e-3 + 1.0 / load)).sqrt() / TAU;
        assert!(
            (frequency / expected - 1.0).abs() < 2e-3,
            "{frequency} {expected}"
        );
    }
}

#[test]
fn a_second_mass_is_accelerated_with_the_first() {
    let stiff = machine(&[("inertia", 4e-3), ("angle_dependence", 0.0)]);
    let two = machine(&[
        ("load_inertia", 2e-3),
        ("shaft_stiffness", 2000.0),
        ("angle_dependence", 0.0),
    ]);
    let u = held([3.0].into_iter(), 1500);
    let (one, other) = (
        stiff.clone().run(&u).unwrap().1,
        two.clone().run(&u).unwrap().1,
    );
    for k in [200, 500, 1499] {
        assert!(
            (one[k] - other[k]).abs() < 5.0,
            "{k}: {} {}",
            one[k],
            other[k]
        );
    }
}

#[test]
fn play_lets_the_crank_run_free_and_then_hit() {
    let free = machine(&[
        ("load_inertia", 2e-3),
        ("shaft_backlash", 0.5),
        ("angle_dependence", 0.0),
    ]);
    let alone = machine(&[("angle_dependence", 0.0)]);
    let u = held([4.0].into_iter(), 60);
    let (with, without) = (
        free.clone().run(&u).unwrap().1,
        alone.clone().run(&u).unwrap().1,
    );
    let apart = with
        .iter()
        .zip(&without)
        .position(|(a, b)| (a - b).abs() > 1e-6)
        .unwrap();
    // until half of the play, 0.25 rad, is used up
    let turned: f64 = without[..apart].iter().map(|n| n / RPM * SAMPLE_TIME).sum();
    assert!((0.2..0.3).contains(&turned), "{turned}");
    assert!(with[apart + 3] < without[apart + 3]);
}

#[test]
fn a_machine_with_a_shaft_goes_on_where_it_was() {
    let changes = [
        ("load_inertia", 1e-3),
        ("shaft_stiffness", 100.0),
        ("shaft_backlash", 0.01),
    ];
    let (mut first, mut second) = (machine(&changes), machine(&changes));
    let u = random(5, 400, 10, 15.0);
    first.run(&u[..200]).unwrap();
    second.recall(first.memory()).unwrap();
    assert_eq!(
        first.run(&u[200..]).unwrap().1,
        second.run(&u[200..]).unwrap().1
    );
}

#[test]
fn a_shaft_that_is_too_stiff_or_too_damped_is_refused() {
    for bad in [("shaft_stiffness", 1e5), ("shaft_damping", 10.0)] {
        let error = Parameters::default()
            .with([("load_inertia", 1e-3), bad])
            .unwrap_err();
        assert!(error.message.contains(bad.0), "{error}");
    }
}
