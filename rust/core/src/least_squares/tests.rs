//! The engine on problems with known answers, and on problems without one.

use super::*;

/// Residuals and Jacobian as functions.
struct Case<R, J> {
    n: usize,
    m: usize,
    r: R,
    j: J,
}

impl<R: Fn(&[f64]) -> Vec<f64>, J: Fn(&[f64]) -> Vec<f64>> Residuals for Case<R, J> {
    fn parameters(&self) -> usize {
        self.n
    }

    fn len(&self) -> usize {
        self.m
    }

    fn residuals(&mut self, theta: &[f64], r: &mut [f64]) -> bool {
        r.copy_from_slice(&(self.r)(theta));
        true
    }

    fn jacobian(&mut self, theta: &[f64], _: &[f64], j: &mut [f64]) -> bool {
        j.copy_from_slice(&(self.j)(theta));
        true
    }
}

fn run(problem: &mut impl Residuals, start: &[f64], settings: &Settings) -> Solution {
    solve(problem, start.to_vec(), settings, &Monitor::default()).unwrap()
}

/// Rosenbrock's valley (More, Garbow and Hillstrom 1981, problem 1).
fn valley() -> impl Residuals {
    Case {
        n: 2,
        m: 2,
        r: |t: &[f64]| vec![10.0 * (t[1] - t[0] * t[0]), 1.0 - t[0]],
        j: |t: &[f64]| vec![-20.0 * t[0], 10.0, -1.0, 0.0],
    }
}

/// Growth `b1 (1 - exp(-b2 x))`; `offset` changes the data.
fn growth(offset: f64) -> impl Residuals {
    let x = [1.0, 2.0, 3.0, 5.0, 7.0, 10.0];
    let y = [109.0, 149.0, 149.0, 191.0, 213.0, 224.0];
    Case {
        n: 2,
        m: 6,
        r: move |t: &[f64]| {
            let model = |x: f64| t[0] * (1.0 - (-t[1] * x).exp()) + offset;
            x.iter().zip(y).map(|(&x, y)| model(x) - y).collect()
        },
        j: move |t: &[f64]| {
            let row = |&x: &f64| [1.0 - (-t[1] * x).exp(), t[0] * x * (-t[1] * x).exp()];
            x.iter().flat_map(row).collect()
        },
    }
}

#[test]
fn descends_a_valley_to_its_end() {
    let fit = run(&mut valley(), &[-1.2, 1.0], &Settings::default());
    assert!(fit.termination.is_converged());
    assert!(
        fit.cost < 1e-28 && (fit.theta[0] - 1.0).abs() < 1e-13,
        "{fit:?}"
    );
    assert!(fit.trace.windows(2).all(|w| w[1] < w[0]));
    assert!(fit.covariance.iter().all(|v| v.is_nan()));
}

#[test]
fn finds_what_the_data_certify() {
    // NIST's BoxBOD; from the first start Gauss-Newton steps diverge.
    for start in [[1.0, 1.0], [100.0, 0.75]] {
        let fit = run(&mut growth(0.0), &start, &Settings::default());
        assert!(fit.termination.is_converged());
        assert!((fit.theta[0] / 2.1380940889e2 - 1.0).abs() < 1e-9);
        assert!((fit.theta[1] / 5.4723748542e-1 - 1.0).abs() < 1e-8);
        let deviation = fit.covariance[0].sqrt();
        assert!((deviation / 1.2354515176e1 - 1.0).abs() < 1e-8);
    }
}

#[test]
fn does_not_believe_a_parameter_on_its_way_to_infinity() {
    let mut runaway = Case {
        n: 1,
        m: 2,
        r: |t: &[f64]| vec![(-t[0]).exp() + 1.0, (-2.0 * t[0]).exp() + 1.0],
        j: |t: &[f64]| vec![-(-t[0]).exp(), -2.0 * (-2.0 * t[0]).exp()],
    };
    let fit = run(&mut runaway, &[0.0], &Settings::default());
    assert!(!fit.termination.is_converged(), "{fit:?}");
}

#[test]
fn does_not_believe_a_stationary_point_that_is_no_minimum() {
    let mut ridge = Case {
        n: 1,
        m: 2,
        r: |t: &[f64]| vec![t[0] * t[0] - 1.0, 0.1 * t[0]],
        j: |t: &[f64]| vec![2.0 * t[0], 0.1],
    };
    let fit = run(&mut ridge, &[0.0], &Settings::default());
    assert_eq!(fit.termination, Termination::Saddle);
    assert_eq!(fit.theta, [0.0]);
    let beside = run(&mut ridge, &[1e-3], &Settings::default());
    assert!(beside.termination.is_converged() && beside.theta[0] > 0.9);
}

#[test]
fn stays_at_a_minimum_whose_jacobian_is_singular() {
    // Freudenstein and Roth: the rank is not full, so the local minimum, with its large residual, cannot be confirmed.
    let mut case = Case {
        n: 2,
        m: 2,
        r: |t: &[f64]| {
            let (x, y) = (t[0], t[1]);
            vec![
                -13.0 + x + ((5.0 - y) * y - 2.0) * y,
                -29.0 + x + ((1.0 + y) * y - 14.0) * y,
            ]
        },
        j: |t: &[f64]| {
            let y = t[1];
            vec![
                1.0,
                10.0 * y - 3.0 * y * y - 2.0,
                1.0,
                3.0 * y * y + 2.0 * y - 14.0,
            ]
        },
    };
    let fit = run(&mut case, &[0.5, -2.0], &Settings::default());
    assert!((2.0 * fit.cost - 48.98425368).abs() < 1e-7);
    assert!((fit.theta[1] + 0.8968052532744766).abs() < 1e-4, "{fit:?}");
}

#[test]
fn holds_parameters_on_their_bounds() {
    let settings = Settings {
        upper: Some(vec![200.0, 10.0]),
        lower: Some(vec![0.0, 0.0]),
        ..Settings::default()
    };
    let fit = run(&mut growth(0.0), &[100.0, 0.75], &settings);
    assert!(fit.termination.is_converged());
    assert_eq!(
        (fit.theta[0], fit.active.as_slice(), fit.rank),
        (200.0, &[1, 0][..], 1)
    );
    assert_eq!(fit.covariance[..3], [0.0; 3]);
    let g = |b: f64| {
        let mut r = [0.0; 6];
        growth(0.0).residuals(&[200.0, b], &mut r);
        r.iter().map(|r| r * r).sum::<f64>()
    };
    assert!(g(fit.theta[1]) < g(fit.theta[1] * 1.001).min(g(fit.theta[1] * 0.999)));
}

#[test]
fn names_what_is_not_finite_and_a_stop() {
    let mut nowhere = Case {
        n: 1,
        m: 2,
        r: |_: &[f64]| vec![f64::NAN; 2],
        j: |_: &[f64]| vec![1.0; 2],
    };
    let fit = run(&mut nowhere, &[1.0], &Settings::default());
    assert_eq!((fit.termination, fit.rank), (Termination::NotFinite, 0));
    let monitor = Monitor::default();
    monitor.request_stop();
    let stopped = solve(&mut valley(), vec![0.0; 2], &Settings::default(), &monitor).unwrap();
    assert_eq!(stopped.termination, Termination::Interrupted);
    assert_eq!(stopped.theta, [0.0; 2]);
}

#[test]
fn refuses_settings_that_make_no_sense() {
    let refused = |start: Vec<f64>, settings: &Settings, words: &str| {
        let error = solve(&mut valley(), start, settings, &Monitor::default()).unwrap_err();
        assert!(error.message.contains(words), "{}", error.message);
    };
    let plain = Settings::default();
    refused(vec![0.0; 3], &plain, "one per parameter");
    refused(vec![f64::NAN, 0.0], &plain, "finite x0");
    let crossed = Settings {
        lower: Some(vec![1.0; 2]),
        upper: Some(vec![f64::NAN; 2]),
        ..plain.clone()
    };
    refused(vec![1.0; 2], &crossed, "below the upper");
    let scaled = Settings {
        scale: Some(vec![1.0, -1.0]),
        ..plain.clone()
    };
    refused(vec![0.0; 2], &scaled, "x_scale");
    refused(
        vec![0.0; 2],
        &Settings {
            ftol: f64::NAN,
            ..plain
        },
        "ftol",
    );
}
