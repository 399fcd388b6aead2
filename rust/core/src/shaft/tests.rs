use proptest::prelude::*;

use super::*;

const TS: f64 = 1e-3;

fn motor(delay: f64) -> Vec<f64> {
    vec![20.0_f64.ln(), 0.05_f64.ln(), 1e-4_f64.ln(), delay]
}

fn shaft(resonance: f64, antiresonance: f64) -> [f64; 4] {
    let w = std::f64::consts::TAU;
    [w * resonance, 0.03, w * antiresonance, 0.02].map(f64::ln)
}

/// Two masses and a shaft.
fn two_masses(delay: f64) -> Vec<f64> {
    [motor(delay), shaft(60.0, 45.0).to_vec()].concat()
}

fn hertz() -> Vec<f64> {
    (1..=100).map(|k| 0.5 * 1.068_f64.powi(k)).collect()
}

/// The sampled response of `G`: the command held, and the output at the samples or as its mean over the last one. In
/// continuous time, `sum_k G(j w_k) H(j w_k)/Ts` over the aliases of the frequency.
fn aliases(theta: &[f64], f: f64, counted: bool) -> Complex<f64> {
    let w = |k: i32| std::f64::consts::TAU * (f + f64::from(k) / TS);
    let of = |k: i32| {
        let s = Complex::new(0.0, w(k));
        let (a1, a2) = (theta[1].exp(), theta[2].exp());
        let mut g = (s * -theta[3] * TS).exp() * theta[0].exp() / (s * s * a2 + s * a1 + 1.0);
        for x in theta[4..].chunks_exact(4) {
            let [wr, zr, wa, za] = [0, 1, 2, 3].map(|i| x[i].exp());
            g *= (wr / wa).powi(2) * (s * s + s * (2.0 * za * wa) + wa * wa)
                / (s * s + s * (2.0 * zr * wr) + wr * wr);
        }
        let hold = (1.0 - (-s * TS).exp()) / (s * TS);
        if counted { g * hold * hold } else { g * hold }
    };
    let zero = of(0);
    (1..=4_000).fold(zero, |sum, k| sum + of(k) + of(-k))
}

#[test]
fn the_response_is_the_sum_over_its_aliases() {
    for delay in [0.0, 0.3, 2.0, 4.7] {
        for theta in [motor(delay), two_masses(delay)] {
            for counted in [false, true] {
                let found = response(&theta, &[1.0, 30.0, 59.0, 200.0], TS, counted).unwrap();
                for (f, found) in [1.0, 30.0, 59.0, 200.0].into_iter().zip(found) {
                    let exact = aliases(&theta, f, counted);
                    assert!(
                        (found - exact).norm() < 2e-6 * exact.norm(),
                        "{f} {found} {exact}"
                    );
                }
            }
        }
    }
}

#[test]
fn the_fraction_is_the_same_machine() {
    for delay in [0.0, 0.4, 3.0] {
        let theta = [two_masses(delay), shaft(150.0, 120.0).to_vec()].concat();
        let (num, den) = fraction(&theta, TS).unwrap();
        for (f, wanted) in hertz()
            .iter()
            .zip(response(&theta, &hertz(), TS, false).unwrap())
        {
            let q = back(*f, TS);
            let at = |c: &[f64]| {
                c.iter()
                    .rev()
                    .fold(Complex::new(0.0, 0.0), |s, &c| s * q + c)
            };
            let found = at(&num) / at(&den);
            assert!(
                (found - wanted).norm() < 1e-8 * wanted.norm(),
                "{f} {found} {wanted}"
            );
        }
    }
}

#[test]
fn what_is_no_machine_is_refused() {
    assert!(response(&[0.0; 5], &[1.0], TS, false).is_err());
    assert!(response(&motor(f64::NAN), &[1.0], TS, false).is_err());
    assert!(fraction(&motor(0.0), 0.0).is_err());
    let value = [Complex::new(1.0, 0.0)];
    let lines = |hertz, sigma| Lines {
        hertz,
        value: &value,
        sigma,
        ts: TS,
        counted: false,
    };
    for (hertz, sigma) in [
        (&[1.0, 2.0][..], &[1.0][..]),
        (&[], &[]),
        (&[-1.0], &[1.0]),
        (&[1.0], &[0.0]),
    ] {
        assert!(search(lines(hertz, sigma), None, &Monitor::default()).is_err());
    }
    // one line determines no machine, but must not panic
    let (machine, beyond) = search(lines(&[1.0], &[1.0]), None, &Monitor::default()).unwrap();
    assert_eq!((machine.theta.len(), beyond), (4, None));
    let stopped = Monitor::default();
    stopped.request_stop();
    assert!(search(lines(&[1.0], &[1.0]), None, &stopped).is_err());
}

/// The result of a search in an exact response whose lines are known to .5 %.
fn found(theta: &[f64], resonance: Option<bool>) -> (Fitted, Option<f64>) {
    let hertz: Vec<f64> = (1..=150).map(|k| 2.0 * f64::from(k)).collect();
    let value = response(theta, &hertz, TS, true).unwrap();
    let sigma: Vec<f64> = value.iter().map(|v| 0.005 * v.norm()).collect();
    let lines = Lines {
        hertz: &hertz,
        value: &value,
        sigma: &sigma,
        ts: TS,
        counted: true,
    };
    search(lines, resonance, &Monitor::default()).unwrap()
}

#[test]
fn the_search_finds_as_many_shafts_as_there_are() {
    let rigid = motor(1.3);
    let one = [motor(1.3), shaft(60.0, 45.0).to_vec()].concat();
    let two = [one.clone(), shaft(150.0, 110.0).to_vec()].concat();
    for theta in [rigid, one.clone(), two] {
        let (machine, beyond) = found(&theta, None);
        assert_eq!((machine.theta.len(), beyond), (theta.len(), None));
        for (x, exact) in machine.theta.iter().zip(&theta) {
            assert!((x - exact).abs() < 1e-3, "{:?} {theta:?}", machine.theta);
        }
    }
    // in any order of the shafts, and without any if none is requested
    let swapped = [motor(1.3), shaft(150.0, 110.0).to_vec(), one[4..].to_vec()].concat();
    let machine = found(&swapped, None).0;
    assert!((machine.theta[4] - one[4]).abs() < 1e-3);
    assert_eq!(found(&one, Some(false)).0.theta.len(), 4);
}

#[test]
fn a_resonance_above_the_lines_is_seen_by_its_flank() {
    let theta = [motor(1.3), shaft(380.0, 260.0).to_vec()].concat();
    let (machine, beyond) = found(&theta, None);
    assert_eq!(machine.theta.len(), 4);
    assert!((beyond.unwrap() / 380.0 - 1.0).abs() < 0.1, "{beyond:?}");
}

proptest! {
    #[test]
    fn derivatives_are_those_of_differences(
        delay in 0.05..0.9_f64, whole in 0..4_usize, counted: bool, move_by in prop::array::uniform8(-0.3..0.3_f64),
    ) {
        let mut theta = two_masses(delay + whole as f64);
        for j in (0..8).filter(|&j| j != 3) {
            theta[j] += move_by[j];
        }
        let (hertz, ones) = (hertz(), vec![1.0; 100]);
        let value = vec![Complex::new(0.0, 0.0); 100];
        let lines = Lines { hertz: &hertz, value: &value, sigma: &ones, ts: TS, counted };
        let mut problem = Fit { lines, back: hertz.iter().map(|&f| back(f, TS)).collect(), parameters: 8 };
        let mut jacobian = vec![0.0; 200 * 8];
        prop_assert!(problem.jacobian(&theta, &[], &mut jacobian));
        for j in 0..8 {
            let mut at = |step: f64| {
                let mut beside = theta.clone();
                beside[j] += step;
                let mut r = vec![0.0; 200];
                problem.residuals(&beside, &mut r);
                r
            };
            let (above, below) = (at(1e-5), at(-1e-5));
            let largest = (0..200).map(|k| jacobian[8 * k + j].abs()).fold(0.0, f64::max);
            for k in 0..200 {
                let difference = (above[k] - below[k]) / 2e-5;
                prop_assert!((jacobian[8 * k + j] - difference).abs() < 1e-6 * largest.max(1e-3), "{j} {k}");
            }
        }
    }

    #[test]
    fn a_machine_is_found_again(
        delay in 0.0..4.0_f64, counted: bool, move_by in prop::array::uniform8(-0.05..0.05_f64),
    ) {
        let theta = two_masses(delay);
        let hertz = hertz();
        let value = response(&theta, &hertz, TS, counted).unwrap();
        let sigma: Vec<f64> = value.iter().map(|v| 1e-3 * v.norm()).collect();
        let start: Vec<f64> = theta.iter().zip(move_by).map(|(t, m)| t + m).collect();
        let lines = Lines { hertz: &hertz, value: &value, sigma: &sigma, ts: TS, counted };
        let found = fit(lines, &start, 200, &Monitor::default()).unwrap();
        prop_assert!(found.cost < 1e-6, "{}", found.cost);
        for (x, exact) in found.theta.iter().zip(&theta) {
            prop_assert!((x - exact).abs() < 1e-3, "{:?} {theta:?}", found.theta);
        }
    }
}
