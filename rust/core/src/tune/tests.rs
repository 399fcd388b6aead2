//! The search on plants with known answers, its determinism, its outcomes.

use super::*;
use crate::closed_loop::{LaggedPlant, Varied};
use crate::linear::LinearModel;
use sewfast_control::{Design, Standard};

const TS: f64 = 1e-3;

/// 490 RPM/V with time constants of 252 and 7.4 ms.
fn drive() -> LinearModel {
    let (p, q) = ((-TS / 0.252_f64).exp(), (-TS / 0.0074_f64).exp());
    let b = 490.0 * (1.0 - p) * (1.0 - q) / 2.0;
    LinearModel::new(vec![-p - q, p * q], vec![b, b], 1, 1, 0.0).unwrap()
}

fn trapezoid() -> Vec<f64> {
    (0..900)
        .map(|k| (f64::from((k - 100).min(700 - k)) / 150.0).clamp(0.0, 1.0) * 3000.0)
        .collect()
}

fn start() -> Settings<f64> {
    let gains = Standard {
        kp: 0.01,
        ti: 0.25,
        td: 0.005,
    };
    Settings {
        alpha: 0.3,
        n: 10.0,
        u_min: -20.0,
        u_max: 20.0,
        ..Settings::new(gains, TS)
    }
}

fn with_task<T>(
    start: Settings<f64>,
    work: impl FnOnce(&Task<'_, Varied<LaggedPlant<'_, LinearModel>>>) -> T,
) -> T {
    let (model, r) = (drive(), trapezoid());
    let plants = [0.8, 1.0, 1.25]
        .map(|gain| Varied::new(LaggedPlant::new(&model, TS).unwrap(), gain, 0).unwrap());
    work(&Task {
        plants: &plants,
        references: &[&r],
        encoder: Some(Encoder::new(26.2, 0.5)),
        start: Design {
            filter_samples: 8,
            ..Design::new(start)
        },
        cost: Cost::default(),
        aggregate: Aggregate::Mean,
    })
}

fn options(evaluations: usize, threads: usize) -> Options {
    Options {
        evaluations,
        seed: 1,
        threads,
    }
}

#[test]
fn finds_much_better_gains_than_its_start() {
    with_task(start(), |task| {
        let tuned = tune(task, options(1000, 2), &Monitor::default()).unwrap();
        assert!(
            tuned.cost < 0.2 * tuned.start_cost && tuned.cost < 80.0,
            "{tuned:?}"
        );
        assert!(tuned.trace.windows(2).all(|pair| pair[1] <= pair[0]) && tuned.evaluations <= 1000);
        assert_eq!(tuned.trace.last(), Some(&tuned.cost));
        let again = Bench::new(task).unwrap().cost(
            task,
            &tuned.settings,
            f64::INFINITY,
            &Monitor::default(),
        );
        assert_eq!(again, tuned.cost);
    });
}

#[test]
fn gives_the_same_bits_at_any_number_of_threads() {
    with_task(start(), |task| {
        let tuned = |threads| tune(task, options(150, threads), &Monitor::default()).unwrap();
        let one = tuned(1);
        assert_eq!(one, tuned(2));
        assert_eq!(one, tuned(5));
        let other = Options {
            seed: 2,
            ..options(150, 2)
        };
        assert_ne!(
            one.settings,
            tune(task, other, &Monitor::default()).unwrap().settings
        );
    });
}

#[test]
fn is_never_worse_than_its_start_and_keeps_it_where_it_has_no_time() {
    with_task(start(), |task| {
        let tuned = tune(task, options(1, 1), &Monitor::default()).unwrap();
        assert_eq!(
            (tuned.settings, tuned.cost),
            (task.start.pid, tuned.start_cost)
        );
        let monitor = Monitor::default();
        monitor.request_stop();
        let stopped = tune(task, options(100, 1), &monitor);
        assert!(stopped.is_err() || stopped.unwrap().termination == Termination::Interrupted);
    });
}

#[test]
fn recovers_from_a_start_that_oscillates() {
    let wild = Settings {
        gains: Standard {
            kp: 0.3,
            ti: 0.004,
            td: 0.05,
        },
        ..start()
    };
    with_task(wild, |task| {
        let tuned = tune(task, options(1200, 2), &Monitor::default()).unwrap();
        assert!(tuned.cost < 80.0 && tuned.start_cost > 100.0, "{tuned:?}");
    });
}

#[test]
fn refuses_tasks_that_make_no_sense() {
    let refused = |start: Settings<f64>, cost: Cost, options: Options| {
        with_task(start, |task| {
            let task = Task {
                cost,
                ..task.clone()
            };
            tune(&task, options, &Monitor::default())
                .unwrap_err()
                .message
        })
    };
    let (good, once) = (Cost::default(), options(1, 1));
    let unlimited = Settings {
        u_max: f64::INFINITY,
        ..start()
    };
    assert!(refused(unlimited, good, once).contains("limits"));
    let gains = Standard {
        kp: 0.0,
        ..start().gains
    };
    assert!(refused(Settings { gains, ..start() }, good, once).contains("Kp"));
    assert!(
        refused(
            start(),
            Cost {
                chatter: Some(-1.0),
                ..good
            },
            once
        )
        .contains("chatter")
    );
    assert!(refused(start(), good, options(0, 1)).contains("evaluation"));
    assert!(refused(start(), good, options(1, 0)).contains("thread"));
    with_task(start(), |task| {
        let none = Task {
            references: &[],
            ..task.clone()
        };
        assert!(tune(&none, once, &Monitor::default()).is_err());
        let empty = Task {
            references: &[&[]],
            ..task.clone()
        };
        assert!(tune(&empty, once, &Monitor::default()).is_err());
    });
}

#[test]
fn the_worst_plant_costs_at_least_the_mean() {
    with_task(start(), |task| {
        let cost = |aggregate| {
            let task = Task {
                aggregate,
                ..task.clone()
            };
            let mut bench = Bench::new(&task).unwrap();
            bench.cost(&task, &task.start.pid, f64::INFINITY, &Monitor::default())
        };
        let (mean, worst) = (cost(Aggregate::Mean), cost(Aggregate::Worst));
        let one = |plant: usize| {
            let task = Task {
                plants: &task.plants[plant..=plant],
                ..task.clone()
            };
            let mut bench = Bench::new(&task).unwrap();
            bench.cost(&task, &task.start.pid, f64::INFINITY, &Monitor::default())
        };
        let all = [one(0), one(1), one(2)];
        assert!((mean - all.iter().sum::<f64>() / 3.0).abs() < 1e-9 * mean);
        assert_eq!(worst, all.iter().fold(0.0, |w, c| f64::max(w, *c)));
    });
}
