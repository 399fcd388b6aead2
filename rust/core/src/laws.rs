//! Number of cases of the tests' laws, and laws that hold for every weighted sum of squares.

use proptest::test_runner::Config;

use crate::lm::Problem;
use crate::random::Random;

/// `few` cases for a law whose cases are slow; `PROPTEST_CASES`, if set, overrides it for every law.
pub(crate) fn cases(few: u32) -> Config {
    match std::env::var_os("PROPTEST_CASES") {
        Some(_) => Config::default(),
        None => Config::with_cases(few),
    }
}

/// Weights of 0 to 3, with whole stretches of one value.
pub(crate) fn weights(samples: usize, seed: u64) -> Vec<f64> {
    let mut random = Random::new(seed);
    let drawn = (0..samples).map(|k| match k % 50 {
        0..10 => 1.0,
        10..15 => 0.0,
        _ => random.between(0.0, 3.0),
    });
    drawn.collect()
}

/// Compares a problem's `J'e` with differences of its cost.
pub(crate) fn check_gradient(problem: &mut impl Problem, theta: &[f64]) {
    let (_, _, gradient) = sums(problem, theta, 1.0);
    let size = gradient.iter().fold(0.0, |size: f64, g| size.max(g.abs()));
    for (i, slope) in gradient.iter().enumerate() {
        let step = 1e-5 * (1.0 + theta[i].abs());
        let mut at = |by: f64| {
            let mut moved = theta.to_vec();
            moved[i] += by;
            problem.cost(&moved).unwrap()
        };
        let difference = (at(step) - at(-step)) / (2.0 * step);
        let error = (difference + slope).abs();
        assert!(error <= 1e-5 * size, "{i}: {difference} {slope}");
    }
}

/// Whether a problem's sums are those of `parts`, each with its own sum of weights, times factors.
pub(crate) fn check_sum<P: Problem>(
    theta: &[f64],
    (whole, total): (&mut P, f64),
    parts: &mut [(P, f64, f64)],
) {
    let (cost, jtj, jte) = sums(whole, theta, total);
    let mut expected = (0.0, vec![0.0; jtj.len()], vec![0.0; jte.len()]);
    for (part, total, factor) in parts {
        let (cost, jtj, jte) = sums(part, theta, *total * *factor);
        expected.0 += cost;
        expected.1.iter_mut().zip(jtj).for_each(|(e, v)| *e += v);
        expected.2.iter_mut().zip(jte).for_each(|(e, v)| *e += v);
    }
    let near = |a: &[f64], b: &[f64]| {
        let size = b.iter().fold(0.0, |size: f64, v| size.max(v.abs()));
        a.iter().zip(b).all(|(a, b)| (a - b).abs() <= 1e-10 * size)
    };
    assert!(near(&[cost], &[expected.0]), "{cost} {}", expected.0);
    assert!(near(&jtj, &expected.1) && near(&jte, &expected.2));
}

/// Cost, lower triangle of `J'J` and `J'e`, all times `factor`.
fn sums(problem: &mut impl Problem, theta: &[f64], factor: f64) -> (f64, Vec<f64>, Vec<f64>) {
    let n = theta.len();
    let cost = factor * problem.cost(theta).unwrap();
    let (mut jtj, mut jte) = (vec![0.0; n * n], vec![0.0; n]);
    problem.normal_equations(theta, &mut jtj, &mut jte);
    let lower = (0..n * n).filter(|at| at % n <= at / n);
    let jtj = lower.map(|at| factor * jtj[at]).collect();
    (cost, jtj, jte.iter().map(|v| factor * v).collect())
}
