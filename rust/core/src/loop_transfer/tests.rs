use super::*;
use proptest::prelude::*;
use sewfast_control::{AnyController, Biquad, Cascade, Design, PidController, Settings, Standard};

use crate::Monitor;
use crate::closed_loop::{LaggedPlant, Run};
use crate::linear::LinearModel;
use crate::speed::Encoder;

const TS: f64 = 1e-3;

fn path(kp: f64, ti: f64, td: f64) -> Path {
    Path::new(Standard { kp, ti, td }, TS)
}

/// The paper's drive with a first-order time constant, and a dead time between two samples.
fn drive() -> Plant {
    Plant::fopdt(490.0, 0.25, 0.0083, TS).unwrap()
}

fn notches() -> Cascade<f64> {
    let notch = Biquad::notch(35.0, 0.1, 0.6, TS).unwrap();
    let lead = Biquad::lead_lag(20.0, 60.0, TS).unwrap();
    Cascade::new(&[notch, lead]).unwrap()
}

fn margins_of(path: &Path, plant: &Plant) -> Margins {
    margins(&Loop::new(path, plant).unwrap())
}

/// The crate's own controller with the path's settings.
fn controller(path: &Path) -> PidController<f64> {
    let settings = Settings {
        n: path.n,
        ..Settings::new(path.gains, path.ts)
    };
    let design = Design {
        filter_samples: path.filter_samples,
        filter_time: path.filter_time,
        observer_time: path.observer_time,
        biquads: path.biquads,
        ..Design::new(settings)
    };
    PidController::new(design).unwrap()
}

/// Amplitude and phase of `x` at `omega` over whole periods at its end.
fn phasor(x: &[f64], theta: f64) -> Complex<f64> {
    let sum = |f: fn(f64) -> f64| -> f64 {
        x.iter()
            .enumerate()
            .map(|(k, x)| x * f(theta * k as f64))
            .sum()
    };
    Complex::new(sum(f64::cos), -sum(f64::sin)) * (2.0 / x.len() as f64)
}

#[test]
fn the_path_is_the_controllers() {
    let mut path = path(0.02, 0.1, 0.02);
    (path.n, path.filter_samples, path.filter_time) = (6.0, 8, 0.004);
    path.observer_time = 0.003;
    path.biquads = notches();
    for period in [10_usize, 40, 200] {
        let theta = std::f64::consts::TAU / period as f64;
        let mut controller = controller(&path);
        let warm = 4_000 / period * period;
        let input = |k: usize| {
            if k == 0 {
                0.0
            } else {
                (theta * k as f64).cos()
            }
        };
        let u: Vec<f64> = (0..2 * warm)
            .map(|k| controller.step(0.0, input(k)))
            .collect();
        let found = -phasor(&u[warm..], theta);
        let exact = path.response(&Place::at(theta));
        assert!(
            (found - exact).norm() < 1e-9 * exact.norm(),
            "{found} {exact}"
        );
    }
}

#[test]
fn a_sine_through_the_closed_loop_comes_out_as_the_formula_says() {
    let mut path = path(0.01, 0.08, 0.0);
    path.encoder = true;
    let plant = Plant::fopdt(490.0, 0.25, 0.0083, TS).unwrap();
    let model =
        LinearModel::new(plant.den[1..].to_vec(), plant.num[9..].to_vec(), 1, 9, 0.0).unwrap();
    let theta = std::f64::consts::TAU / 250.0;
    let reference: Vec<f64> = (0..20_000).map(|k| (theta * k as f64).cos()).collect();
    let mut run = Run::default();
    let mut plant_of_loop = LaggedPlant::new(&model, TS).unwrap();
    let (controller, encoder) = (controller(&path), Encoder::ideal(26.2));
    run.record(
        &mut plant_of_loop,
        &mut AnyController::from(controller.clone()),
        &reference,
        Some(&encoder),
        &Monitor::default(),
    );
    let found = phasor(&run.y[10_000..], theta);
    let closed = Loop::new(&path, &plant).unwrap();
    let (l, e) = (
        closed.response(theta / TS),
        path.encoder_response(&Place::at(theta)),
    );
    let exact = l / (e * (l + 1.0));
    assert!(
        (found - exact).norm() < 1e-9 * exact.norm(),
        "{found} {exact}"
    );
}

#[test]
fn noise_gain_is_that_of_the_impulse_response() {
    let mut path = path(0.01, 0.08, 0.012);
    (path.n, path.filter_samples, path.filter_time) = (8.0, 5, 0.002);
    path.observer_time = 0.004;
    path.biquads = notches();
    let plant = drive();
    let mut controller = controller(&path);
    let mut past = vec![0.0; plant.num.len()];
    let (mut y, mut energy) = (0.0, 0.0);
    for k in 0..20_000 {
        let u = controller.step(0.0, y + f64::from(u8::from(k == 3)));
        energy += u * u;
        past.rotate_right(1);
        past[0] = u;
        y = -plant.den[1] * y
            + plant.num[1..]
                .iter()
                .zip(&past)
                .map(|(b, u)| b * u)
                .sum::<f64>();
    }
    let found = margins_of(&path, &plant);
    assert!(found.stable);
    assert!(
        (found.noise_gain / energy.sqrt() - 1.0).abs() < 1e-9,
        "{found:?} {energy}"
    );
}

#[test]
fn a_long_dead_time_has_its_noise_gain_from_the_locus() {
    let (short, long) = (drive(), Plant::fopdt(100.0, 0.25, 0.3, TS).unwrap());
    let mut path = path(0.004, 0.5, 0.004);
    assert!(margins_of(&path, &long).largest_pole.is_nan());
    assert!(margins_of(&path, &long).stable && margins_of(&path, &long).noise_gain.is_finite());
    path.filter_samples = 6;
    let closed = Loop::new(&path, &short).unwrap();
    let found = margins::noise_on(&closed, &margins::Curve::of(&closed).points);
    let exact = margins_of(&path, &short).noise_gain;
    assert!((found / exact - 1.0).abs() < 1e-5, "{found} {exact}");
}

#[test]
fn a_dead_time_between_samples_is_a_blend_of_its_neighbours() {
    let at = |l: f64| Plant::fopdt(2.0, 0.05, l, TS).unwrap();
    let whole = at(0.003);
    let expected = [0.0, 0.0, 0.0, 0.0, 2.0 * (1.0 - (-0.02_f64).exp()), 0.0];
    for (b, exact) in whole.num.iter().zip(expected) {
        assert!((b - exact).abs() < 1e-15);
    }
    // the step response at the samples is that of the differential equation
    let plant = at(0.00333);
    let mut y = 0.0;
    for k in 1..200_usize {
        let b: f64 = plant.num.iter().take(k + 1).sum();
        y = -plant.den[1] * y + b;
        let since = (k as f64 * TS - 0.00333).max(0.0);
        assert!((y - 2.0 * (1.0 - (-since / 0.05).exp())).abs() < 1e-12);
    }
}

/// A proportional controller on `1/(z - a)`: every margin by hand.
#[test]
fn margins_of_a_first_order_loop_by_hand() {
    let (a, k) = (0.5, 0.9);
    let plant = Plant::new(&[0.0, 1.0], &[1.0, -a]).unwrap();
    let found = margins_of(&path(k, f64::INFINITY, 0.0), &plant);
    assert!(found.stable && (found.largest_pole - (k - a)).abs() < 1e-12);
    // L(-1) = -k/(1 + a) is the only negative real point apart from z = 1, where there is none
    assert!(
        (found.gain_margin - (1.0 + a) / k).abs() < 1e-9,
        "{found:?}"
    );
    assert_eq!(found.gain_reduction, 0.0);
    assert!(
        (found.ms.0 - 1.0 / (1.0 - k / (1.0 + a))).abs() < 1e-9,
        "{found:?}"
    );
    // |z - a| = k: 1 - 2 a cos w + a^2 = k^2
    let crossover = ((1.0 + a * a - k * k) / (2.0 * a)).acos();
    assert!((found.gain_crossovers[0] * TS - crossover).abs() < 1e-9);
    // |S| = |z - a| / |z - a + k| = 1/sqrt(2)
    let p: f64 = a - k;
    let reached = ((1.0 + 2.0 * a * a - p * p) / (4.0 * a - 2.0 * p)).acos();
    assert!((found.bandwidth * TS - reached).abs() < 1e-9);
    // u = -k n - k y: the noise gain's square is k^2 (1 + k^2/(1 - p^2)), p = a - k
    let exact = k * (1.0 + k * k / (1.0 - p * p)).sqrt();
    assert!(
        (found.noise_gain - exact).abs() < 1e-12,
        "{found:?} {exact}"
    );
}

/// A slow integral and a fast lead leave a peak of `|S|` below the bandwidth, which is passed one level later.
#[test]
fn levels_are_passed_one_after_the_other() {
    let mut path = path(0.05, 0.5, 0.0);
    path.biquads = Cascade::new(&[Biquad::notch(5.0, 0.4, 1.0, TS).unwrap()]).unwrap();
    let plant = drive();
    let closed = Loop::new(&path, &plant).unwrap();
    let size = |omega: f64| 1.0 / (closed.response(omega) + 1.0).norm();
    let below = |omega: f64| {
        (1..4_000)
            .map(|i| size(omega * f64::from(i) / 4_000.0))
            .fold(0.0, f64::max)
    };
    let (found, weak) = (margins(&closed), weakening(&closed, 0.5, true).unwrap());
    assert_eq!(
        (weak.ms, weak.noise_gain),
        (found.ms.0, Some(found.noise_gain))
    );
    let levels = weak.levels;
    assert_eq!(levels[0].0, 0.5);
    assert!(levels.len() > 1, "{levels:?}");
    for pair in levels.windows(2) {
        assert!(pair[0].0 < pair[1].0 && pair[0].1 < pair[1].1);
    }
    for (level, omega) in levels {
        assert!((size(omega) / level - 1.0).abs() < 1e-6, "{level} {omega}");
        assert!(below(omega) < level * (1.0 + 1e-6), "{level} {omega}");
    }
    assert!((size(found.bandwidth) - 0.5_f64.sqrt()).abs() < 1e-9);
}

/// A filter so narrow that it lies between the points of the grid.
#[test]
fn a_narrow_filter_is_seen_wherever_it_lies() {
    let plant = Plant::fopdt(100.0, 0.1, 0.002, TS).unwrap();
    for i in 0..60 {
        let hertz = 0.3 * 1.04_f64.powi(i);
        for filter in [
            Biquad::notch(hertz, 0.005, 0.02, TS).unwrap(),
            Biquad::resonance(hertz, 0.001, hertz, 0.01, TS).unwrap(),
        ] {
            let mut path = path(0.05, 0.2, 0.0);
            path.biquads = Cascade::new(&[filter]).unwrap();
            let closed = Loop::new(&path, &plant).unwrap();
            let size = |omega: f64| 1.0 / (closed.response(omega) + 1.0).norm();
            let beside = |k: i32| std::f64::consts::TAU * hertz * (1.0 + 2e-4 * f64::from(k));
            let top = (-200..=200).map(beside).map(size).fold(0.0, f64::max);
            let found = margins_of(&path, &plant);
            assert!(found.ms.0 > top * (1.0 - 1e-6), "{hertz} {top} {found:?}");
            let first = (-200..=200).map(beside).find(|w| size(*w) > 0.5_f64.sqrt());
            if let Some(first) = first {
                assert!(
                    found.bandwidth <= first * (1.0 + 1e-6),
                    "{hertz} {first} {found:?}"
                );
            }
        }
    }
}

#[test]
fn the_delay_and_the_gain_that_the_margins_state_are_the_last_that_the_loop_bears() {
    let (path, plant) = (path(0.012, 0.06, 0.004), drive());
    let found = margins_of(&path, &plant);
    assert!(found.stable && found.phase_margin > 0.0, "{found:?}");
    let delayed = |n: usize| {
        let mut num = vec![0.0; n];
        num.extend(&plant.num);
        margins_of(&path, &Plant::new(&num, &plant.den).unwrap()).stable
    };
    let samples = found.delay_margin / TS;
    assert!(
        delayed(samples.floor() as usize) && !delayed(samples.ceil() as usize),
        "{found:?}"
    );
    let scaled = |factor: f64| {
        let mut path = path;
        path.gains.kp *= factor;
        margins_of(&path, &plant).stable
    };
    assert!(scaled(found.gain_margin * 0.999) && !scaled(found.gain_margin * 1.001));
}

#[test]
fn an_unstable_plant_has_margins_both_ways() {
    let plant = Plant::new(&[0.0, 0.02], &[1.0, -1.02]).unwrap();
    let found = margins_of(&path(5.0, 0.1, 0.0), &plant);
    assert!(
        found.stable && found.gain_reduction > 0.0 && found.gain_reduction < 1.0,
        "{found:?}"
    );
    assert!(!margins_of(&path(5.0 * found.gain_reduction * 0.99, 0.1, 0.0), &plant).stable);
    assert!(margins_of(&path(5.0 * found.gain_reduction * 1.01, 0.1, 0.0), &plant).stable);
}

#[test]
fn an_unstable_loop_has_no_margins() {
    let found = margins_of(&path(1.0, 0.01, 0.0), &drive());
    assert!(!found.stable && found.largest_pole > 1.0);
    assert!(
        found.ms.0.is_infinite() && found.gain_margin.is_nan() && found.noise_gain.is_infinite()
    );
    let (backwards, drive) = (path(-0.01, 0.1, 0.0), drive());
    let closed = Loop::new(&backwards, &drive).unwrap();
    assert!(peak_sensitivity(&closed).is_infinite());
}

#[test]
fn refuses_what_is_no_loop() {
    let good = path(1.0, 1.0, 0.0);
    let says = |path: Path, plant: &Plant| Loop::new(&path, plant).unwrap_err().message;
    let direct = Plant::new(&[1.0, 1.0], &[1.0]).unwrap();
    assert!(says(good, &direct).contains("nk = 1"));
    let plant = drive();
    for (bad, name) in [
        (Path { ts: 0.0, ..good }, "Ts"),
        (Path { n: 0.0, ..good }, "N"),
        (
            Path {
                slope: f64::NAN,
                ..good
            },
            "slope",
        ),
        (
            Path {
                filter_samples: 0,
                ..good
            },
            "filter_samples",
        ),
        (
            Path {
                filter_time: -1.0,
                ..good
            },
            "filter_time",
        ),
        (
            Path {
                observer_time: f64::INFINITY,
                ..good
            },
            "observer_time",
        ),
        (path(1.0, 0.0, 0.0), "Ti"),
    ] {
        assert!(says(bad, &plant).contains(name));
    }
    assert!(Plant::new(&[0.0], &[1.0]).is_err() && Plant::new(&[1.0], &[0.0, 1.0]).is_err());
    assert!(Plant::new(&[f64::NAN], &[1.0]).is_err() && Plant::new(&[], &[1.0]).is_err());
    assert!(Plant::fopdt(1.0, 0.0, 0.0, TS).is_err() && Plant::fopdt(1.0, 1.0, 1e9, TS).is_err());
}

proptest! {
    #![proptest_config(crate::laws::cases(200))]
    /// The argument principle on the locus and the eigenvalues of the state space count the same.
    #[test]
    fn the_locus_and_the_poles_agree(
        kp in prop_oneof![0.02..8.0_f64, -0.5..-0.02], ti in prop_oneof![0.003..2.0, Just(f64::INFINITY)], td in 0.0..0.05_f64,
        n in prop_oneof![2.0..20.0, Just(f64::INFINITY)], filter_samples in 1_usize..12, filter_time in 0.0..0.01_f64,
        observer_time in prop_oneof![Just(0.0), 0.002..0.02], encoder: bool, slow in 0.9..1.03_f64, fast in -0.9..0.95_f64,
        delay in 1_usize..12,
    ) {
        let gains = Standard { kp, ti, td };
        let path = Path { n, filter_samples, filter_time, observer_time, encoder, ..Path::new(gains, TS) };
        let mut num = vec![0.0; delay];
        num.extend([0.06 * (1.0 - fast), 0.04 * (1.0 - fast)]);
        let plant = Plant::new(&num, &[1.0, -slow - fast, slow * fast]).unwrap();
        let closed = Loop::new(&path, &plant).unwrap();
        let pole = States::of(&closed).unwrap().largest_pole();
        prop_assume!((pole - 1.0).abs() > 1e-6);
        let found = margins(&closed);
        prop_assert_eq!(found.stable, pole < 1.0);
        prop_assert_eq!(peak_sensitivity(&closed).is_finite(), pole < 1.0);
        if found.stable {
            prop_assert!(found.ms.0 >= 1.0 - 1e-9);
            prop_assert!(found.ms.0 >= 1.0 / (1.0 - 1.0 / found.gain_margin) - 1e-6, "{:?}", found);
            let least = 2.0 * (0.5 / found.ms.0).asin();
            prop_assert!(found.phase_margin.to_radians() >= least - 1e-6, "{:?}", found);
            for i in 1..2000 {
                let l = closed.response(f64::from(i) / 2000.0 * std::f64::consts::PI / TS);
                prop_assert!(1.0 / (l + 1.0).norm() <= found.ms.0 * (1.0 + 1e-6));
            }
        }
    }
}

#[test]
fn a_position_loop_is_in_the_path_and_its_poles_are_those_of_the_locus() {
    let speed = Path {
        filter_samples: 8,
        encoder: true,
        ..path(0.004, 0.1, 0.0)
    };
    let mut last = 0.0;
    for gain in [2.0, 5.0, 10.0, 20.0] {
        let path = Path {
            position: gain,
            ..speed
        };
        let found = margins_of(&path, &drive());
        assert!(found.stable && found.largest_pole < 1.0, "{gain}");
        let plant = drive();
        let closed = Loop::new(&path, &plant).unwrap();
        let own = position_sensitivity(&closed);
        assert!(
            found.ms.0 > last && own > 1.0 && own.is_finite(),
            "{gain} {own}"
        );
        last = found.ms.0;
        // R at one frequency by hand
        let place = Place::at(0.1);
        let filter = speed.response(&place);
        let pid = Path {
            filter_samples: 1,
            ..speed
        };
        let by_hand = filter + pid.response(&place) * (gain * TS) / place.difference;
        assert!((path.response(&place) - by_hand).norm() < 1e-12 * by_hand.norm());
    }
    let wild = Path {
        position: 500.0,
        ..speed
    };
    assert!(!margins_of(&wild, &drive()).stable);
    let plant = drive();
    assert!(position_sensitivity(&Loop::new(&wild, &plant).unwrap()).is_infinite());
}
