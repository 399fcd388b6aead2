//! How far a loop around a resonance tolerates changes. Gain and delay margins move the whole plant; a resonance also
//! moves by itself, with load, wear and temperature, and away from the notch designed for it.

use nalgebra::Complex;

use super::{Loop, Path, Plant, peak_sensitivity};
use crate::linear::{poles, polynomial};

/// Pairs of poles or zeros with less damping than this are moved.
const SWINGS: f64 = 0.3;
const PITCHES: [f64; 5] = [0.9, 0.95, 1.0, 1.05, 1.1];
/// These also stand for inertias: where a motor's loop crosses 1, its gain is the inverse of its inertia.
const GAINS: [f64; 3] = [0.8, 1.0, 1.25];
const DELAYS: [usize; 2] = [0, 2];
/// The part of a loop's distance from instability that must be left after a change.
const LEFT: f64 = 0.5;

/// A change of a plant: factors on its gain and on the frequencies of its resonances, and an additional delay \[samples\].
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Change {
    /// Factor on the gain.
    pub gain: f64,
    /// Additional delay \[samples\].
    pub delay: usize,
    /// Factor on the frequencies of lightly damped pairs of poles and zeros.
    pub pitch: f64,
}

/// A plant and, if it has a resonance, its changed versions: all combinations of -20 to +25 % of its gain, two samples
/// of delay, and 10 % of its resonances' frequencies.
#[derive(Clone, Debug)]
pub struct Changing {
    plant: Plant,
    changed: Vec<(Change, Plant)>,
}

impl Changing {
    /// The plant with its changes, if it has a resonance; other plants have none.
    pub fn new(plant: Plant) -> Self {
        let mut changed = Vec::new();
        if plant.poles.iter().any(|&p| swings(p)) {
            for pitch in PITCHES {
                for (gain, delay) in GAINS.iter().flat_map(|&g| DELAYS.map(|d| (g, d))) {
                    let change = Change { gain, delay, pitch };
                    changed.extend(plant.changed(change).map(|plant| (change, plant)));
                }
            }
        }
        Self { plant, changed }
    }

    /// The largest `|S|` to compare with a limit: the plant's, or [`LEFT`] times that after the worst change. Also that
    /// of the worst change with the change itself; infinite for an unstable loop, `None` without a resonance.
    pub fn sensitivity(&self, path: &Path) -> (f64, Option<(f64, Change)>) {
        let of = |(change, plant): &(Change, Plant)| (peak(path, plant), *change);
        let all = self.changed.iter().map(of);
        let worst = all.reduce(|most, next| if next.0 > most.0 { next } else { most });
        let left = LEFT * worst.map_or(0.0, |(most, _)| most);
        (peak(path, &self.plant).max(left), worst)
    }
}

fn peak(path: &Path, plant: &Plant) -> f64 {
    Loop::new(path, plant).map_or(f64::INFINITY, |closed| peak_sensitivity(&closed))
}

fn swings(root: Complex<f64>) -> bool {
    let s = root.ln();
    root.im != 0.0 && root.re.is_finite() && s.norm() > 0.0 && -s.re < SWINGS * s.norm()
}

impl Plant {
    /// The plant after a change; `None` if it cannot be computed.
    fn changed(&self, change: Change) -> Option<Self> {
        let first = self.num.iter().position(|&b| b != 0.0)?;
        let lead = self.num[first];
        let zeros = poles(
            &self.num[first + 1..]
                .iter()
                .map(|b| b / lead)
                .collect::<Vec<_>>(),
        );
        let (num, up) = pitched(&zeros, change.pitch);
        let (den, down) = pitched(&self.poles, change.pitch);
        let factor = lead * change.gain * down / up;
        let delayed = vec![0.0; first + change.delay].into_iter();
        let num: Vec<f64> = delayed.chain(num.iter().map(|b| b * factor)).collect();
        Self::new(&num, &den).ok()
    }
}

/// The polynomial of `roots` with the lightly damped ones moved, and the factor by which that changed it at frequency 0.
fn pitched(roots: &[Complex<f64>], pitch: f64) -> (Vec<f64>, f64) {
    let mut factor = 1.0;
    let moved = roots.iter().map(|&root| {
        let s = root.ln() * pitch;
        if pitch == 1.0 || !swings(root) || s.im.abs() >= std::f64::consts::PI {
            return root;
        }
        factor *= (1.0 - s.exp()).norm() / (1.0 - root).norm();
        s.exp()
    });
    let moved: Vec<_> = moved.collect();
    let polynomial = std::iter::once(1.0).chain(polynomial(&moved));
    (polynomial.collect(), factor)
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;
    use sewfast_control::{Biquad, Cascade, Standard};

    use super::*;

    const TS: f64 = 1e-3;

    /// A first-order lag with a pair of zeros and one of poles at these frequencies [Hz].
    fn shaft(zeros: f64, poles: f64, damping: f64) -> Plant {
        let pair = |hertz: f64| {
            let w = std::f64::consts::TAU * hertz * TS;
            let s = Complex::new(-damping, (1.0 - damping * damping).sqrt()) * w;
            [s.exp(), s.conj().exp()]
        };
        let coefficients = |roots: &[Complex<f64>]| {
            std::iter::once(1.0)
                .chain(polynomial(roots))
                .collect::<Vec<_>>()
        };
        let (num, mut roots) = (coefficients(&pair(zeros)), pair(poles).to_vec());
        roots.push(Complex::new(0.99, 0.0));
        let num: Vec<f64> = std::iter::once(0.0)
            .chain(num.iter().map(|b| 5.0 * b))
            .collect();
        Plant::new(&num, &coefficients(&roots)).unwrap()
    }

    fn gain_at_rest(plant: &Plant) -> f64 {
        plant.num.iter().sum::<f64>() / plant.den.iter().sum::<f64>()
    }

    #[test]
    fn a_notch_that_fits_one_frequency_only_bears_little() {
        let plant = shaft(40.0, 60.0, 0.02);
        let path = |depth, width| {
            let mut path = Path::new(
                Standard {
                    kp: 0.02,
                    ti: 0.1,
                    td: 0.0,
                },
                TS,
            );
            path.biquads = Cascade::new(&[Biquad::notch(60.0, depth, width, TS).unwrap()]).unwrap();
            path
        };
        let changing = Changing::new(plant.clone());
        let (narrow, wide) = (path(0.016, 0.25), path(0.1, 1.0));
        assert!(peak(&narrow, &plant) < 2.0);
        let (robust, worst) = changing.sensitivity(&narrow);
        let (most, change) = worst.unwrap();
        assert!(most > 10.0, "{most}");
        assert!(change.pitch != 1.0);
        assert!(changing.sensitivity(&wide).1.unwrap().0 < most);
        assert!(robust >= LEFT * most);
    }

    #[test]
    fn a_plant_without_a_resonance_has_no_changes() {
        let plant = Plant::fopdt(490.0, 0.25, 0.0083, TS).unwrap();
        let changing = Changing::new(plant.clone());
        let path = Path::new(
            Standard {
                kp: 0.01,
                ti: 0.1,
                td: 0.0,
            },
            TS,
        );
        assert_eq!(changing.sensitivity(&path), (peak(&path, &plant), None));
    }

    proptest! {
        #[test]
        fn a_change_keeps_the_gain_at_rest(
            zeros in 10.0..200.0_f64, apart in 1.05..2.0_f64, damping in 0.005..0.25_f64,
            pitch in 0.9..1.1_f64, gain in 0.8..1.25_f64, delay in 0..4_usize,
        ) {
            let plant = shaft(zeros, zeros * apart, damping);
            let changed = plant.changed(Change { gain, delay, pitch }).unwrap();
            prop_assert!((gain_at_rest(&changed) / gain_at_rest(&plant) / gain - 1.0).abs() < 1e-6);
            let exact = shaft(zeros * pitch, zeros * apart * pitch, damping);
            let same = plant.changed(Change { gain: 1.0, delay: 0, pitch }).unwrap();
            for (a, b) in same.den.iter().zip(&exact.den) {
                prop_assert!((a - b).abs() < 1e-9, "{:?} {:?}", same.den, exact.den);
            }
        }
    }
}
