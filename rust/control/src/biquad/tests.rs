//! Sections against their transfer functions, their rest, their limits.

use super::*;
use proptest::prelude::*;
use std::f64::consts::TAU;
use std::vec::Vec;

const TS: f64 = 1e-3;

/// `re + j im`, as far as the tests need it.
type Complex = (f64, f64);

fn times((a, b): Complex, (c, d): Complex) -> Complex {
    (a * c - b * d, a * d + b * c)
}

fn over(x: Complex, (c, d): Complex) -> Complex {
    let size = c * c + d * d;
    let (re, im) = times(x, (c, -d));
    (re / size, im / size)
}

/// The section's response at `frequency` by its difference equation.
fn response(section: &Biquad<f64>, frequency: f64) -> Complex {
    let theta = TAU * frequency * TS;
    let (q, q2) = (
        (theta.cos(), -theta.sin()),
        ((2.0 * theta).cos(), -(2.0 * theta).sin()),
    );
    let Biquad { c0, c1, a1, a2 } = *section;
    let change = times((1.0 - q.0, -q.1), (c0 + c1 * q.0, c1 * q.1));
    let poles = (1.0 + a1 * q.0 + a2 * q2.0, a1 * q.1 + a2 * q2.1);
    let (re, im) = over(change, poles);
    (1.0 + re, im)
}

/// `1 + n1 s + n2 s^2` with `s = j v`.
fn polynomial(n1: f64, n2: f64, v: f64) -> Complex {
    (1.0 - n2 * v * v, n1 * v)
}

/// The frequency to which the bilinear transform maps `frequency` if it keeps `kept`, relative to `kept`.
fn warped(frequency: f64, kept: f64) -> f64 {
    (0.5 * TAU * frequency * TS).tan() / (0.5 * TAU * kept * TS).tan()
}

fn close(a: Complex, b: Complex) -> bool {
    (a.0 - b.0).hypot(a.1 - b.1) <= 1e-9 * (1.0 + b.0.hypot(b.1))
}

fn frequency() -> impl Strategy<Value = f64> {
    prop_oneof![0.5..499.0, 5.0..300.0]
}

fn damping() -> impl Strategy<Value = f64> {
    0.005..2.0
}

/// Any section of any kind.
pub(crate) fn any_section() -> impl Strategy<Value = (f64, f64, f64, f64, u8)> {
    (frequency(), damping(), frequency(), damping(), 0..4_u8)
}

pub(crate) fn section<T: Real>((f, d, g, e, kind): (f64, f64, f64, f64, u8)) -> Biquad<T> {
    let made = match kind {
        0 => Biquad::notch(f, d / 2.0, e, TS),
        1 => Biquad::low_pass(f, d, TS),
        2 => Biquad::lead_lag(f, g, TS),
        _ => Biquad::resonance(f, d, g, e, TS),
    };
    made.unwrap()
}

/// Samples in which the memory of all sections fades by `exp(-fade)`, one after the other: a notch at 20 Hz with a
/// width of a hundredth of it takes a hundred times longer than the filters before it.
pub(crate) fn settling<T: Real>(cascade: &Cascade<T>, fade: f64) -> u32 {
    let slowest = |section: &Biquad<T>| {
        let (a1, a2) = (section.a1.to_f64(), section.a2.to_f64());
        let root = a1 * a1 / 4.0 - a2;
        if root < 0.0 {
            a2.sqrt()
        } else {
            a1.abs() / 2.0 + root.sqrt()
        }
    };
    let times = cascade
        .sections()
        .iter()
        .map(|s| fade / -slowest(s).max(1e-9).ln());
    times.sum::<f64>().ceil() as u32
}

proptest! {
    #[test]
    fn sections_are_their_transfer_functions(
        f in frequency(), g in frequency(), d in damping(), e in damping(), depth in 0.0..1.0, at in 0.1..499.9,
    ) {
        let pair = |kept: f64, d: f64| polynomial(2.0 * d, 1.0, warped(at, kept));
        let notch = over(pair(f, depth * e / 2.0), pair(f, e / 2.0));
        prop_assert!(close(response(&Biquad::notch(f, depth, e, TS).unwrap(), at), notch));
        let low_pass = over((1.0, 0.0), pair(f, d));
        prop_assert!(close(response(&Biquad::low_pass(f, d, TS).unwrap(), at), low_pass));
        let one = |kept: f64| polynomial(1.0, 0.0, warped(at, kept));
        prop_assert!(close(response(&Biquad::lead_lag(f, g, TS).unwrap(), at), over(one(f), one(g))));
        let resonance = over(pair(f, d), pair(g, e));
        prop_assert!(close(response(&Biquad::resonance(f, d, g, e, TS).unwrap(), at), resonance));
    }

    #[test]
    fn steps_are_the_difference_equation(
        given in prop::collection::vec(any_section(), 1..=4), x in prop::collection::vec(-9.0..9.0, 60), from in -9.0..9.0,
    ) {
        let sections: Vec<Biquad<f64>> = given.into_iter().map(section).collect();
        let mut memory = Memory::new();
        memory.rest_at(from);
        let found: Vec<f64> = x.iter().map(|&x| memory.step(&sections, x)).collect();
        // each section in direct form I on the deviation from its resting level
        let mut signal: Vec<f64> = x.iter().map(|x| x - from).collect();
        for Biquad { c0, c1, a1, a2 } in sections {
            let b = [1.0 + c0, a1 + c1 - c0, a2 - c1];
            let mut y: Vec<f64> = Vec::new();
            for k in 0..signal.len() {
                let past = |v: &[f64], n: usize| if k >= n { v[k - n] } else { 0.0 };
                let moving = b[0] * signal[k] + b[1] * past(&signal, 1) + b[2] * past(&signal, 2);
                y.push(moving - a1 * past(&y, 1) - a2 * past(&y, 2));
            }
            signal = y;
        }
        let largest = signal.iter().fold(1.0, |most, y| f64::max(most, y.abs()));
        for (found, exact) in found.iter().zip(&signal) {
            prop_assert!((found - from - exact).abs() <= 1e-7 * largest, "{found} {from} {exact}");
        }
    }

    #[test]
    fn what_stands_still_passes_to_the_bit(given in prop::collection::vec(any_section(), 0..=4), x in -1e4..1e4_f32) {
        // coefficients that single precision cannot hold with stable poles are refused
        let sections: Vec<Biquad<f32>> = given.into_iter().map(section).collect();
        let mut memory = Memory::new();
        memory.rest_at(x);
        prop_assert!((0..50).all(|_| memory.step(&sections, x).to_bits() == x.to_bits()));
    }

    #[test]
    fn a_tangent_is_that(share in 1e-9..0.499_999_f64) {
        let found = tangent("frequency", share / TS, TS).unwrap();
        let exact = (0.5 * TAU * (share / TS) * TS).tan();
        prop_assert!((found / exact - 1.0).abs() <= 4e-16 * (8.0 + exact), "{found} {exact}");
    }
}

#[test]
fn a_notch_takes_out_its_frequency() {
    let (re, im) = response(&Biquad::notch(60.0, 0.1, 0.5, TS).unwrap(), 60.0);
    assert!((re - 0.1).abs() < 1e-12 && im.abs() < 1e-12);
    // a deep notch has its 3 dB at its width, apart from the warping
    let deep = Biquad::notch(10.0, 0.0, 0.4, TS).unwrap();
    let gain = |f: f64| {
        let (re, im) = response(&deep, f);
        re.hypot(im)
    };
    let edge = 10.0 * ((1.0_f64 + 0.04).sqrt() + 0.2);
    assert!((gain(edge) - 0.5_f64.sqrt()).abs() < 1e-3 && gain(10.0) < 1e-12);
}

#[test]
fn refuses_what_is_no_section() {
    let name = |made: Result<Biquad<f64>, Refused>| made.unwrap_err().name;
    for f in [0.0, -3.0, 500.0, 1e9, f64::NAN, f64::INFINITY, 1e-320] {
        assert_eq!(name(Biquad::notch(f, 0.1, 0.5, TS)), "frequency");
        assert_eq!(name(Biquad::low_pass(f, 0.7, TS)), "frequency");
        assert_eq!(name(Biquad::lead_lag(f, 5.0, TS)), "zero");
        assert_eq!(name(Biquad::lead_lag(5.0, f, TS)), "pole");
        assert_eq!(
            name(Biquad::resonance(f, 0.1, 9.0, 0.1, TS)),
            "zero_frequency"
        );
        assert_eq!(
            name(Biquad::resonance(9.0, 0.1, f, 0.1, TS)),
            "pole_frequency"
        );
    }
    for bad in [-0.1, f64::NAN, f64::INFINITY] {
        assert_eq!(name(Biquad::notch(9.0, bad, 0.5, TS)), "depth");
        assert_eq!(name(Biquad::notch(9.0, 0.5, bad, TS)), "width");
        assert_eq!(name(Biquad::low_pass(9.0, bad, TS)), "damping");
        assert_eq!(
            name(Biquad::resonance(9.0, bad, 9.0, 0.1, TS)),
            "zero_damping"
        );
        assert_eq!(
            name(Biquad::resonance(9.0, 0.1, 9.0, bad, TS)),
            "pole_damping"
        );
    }
    assert_eq!(name(Biquad::notch(9.0, 1.1, 0.5, TS)), "depth");
    let good = Biquad::<f32>::notch(9.0, 0.1, 0.5, TS).unwrap();
    assert!(Cascade::new(&[good; 4]).is_ok());
    let refused = |sections: &[Biquad<f32>]| {
        let refused = Cascade::new(sections).unwrap_err();
        assert_eq!(refused.name, "biquads");
        refused.expected
    };
    assert_eq!(refused(&[good; 5]), "at most 4 sections");
    let a2 = 1.0;
    assert_eq!(
        refused(&[good, Biquad { a2, ..good }]),
        "poles inside the unit circle"
    );
    let (a1, c0, c1) = (2.0, f32::INFINITY, f32::NAN);
    assert_eq!(
        refused(&[Biquad { a1, ..good }]),
        "poles inside the unit circle"
    );
    assert_eq!(refused(&[Biquad { c0, ..good }]), "finite coefficients");
    assert_eq!(refused(&[Biquad { c1, ..good }]), "finite coefficients");
}
