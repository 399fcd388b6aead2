//! Controllers judged side by side.

use sewfast_control::{Feedforward, Level};

use super::*;
use crate::random::Random;

/// Controllers of all kinds, some of which diverge or sit at their limits.
fn designs(start: &AnyDesign<f64>) -> Vec<AnyDesign<f64>> {
    let mut random = Random::new(5);
    let mut design = || {
        let mut design = pid_of(start);
        design.pid.gains.kp *= random.between(0.2, 8.0);
        design.pid.gains.ti *= random.between(0.1, 2.0);
        design.filter_samples = (random.uniform() * 12.0) as usize + 1;
        design.into()
    };
    (0..21).map(|_| design()).collect()
}

#[test]
fn controllers_side_by_side_are_worth_what_they_are_worth_alone() {
    let falling: Vec<f64> = trapezoid().iter().map(|r| 500.0 - r).collect();
    let pushed: Vec<f64> = (0..900).map(|k| if k < 400 { 0.0 } else { -3.0 }).collect();
    let held = LoadStep {
        reference: &[1000.0; 900],
        disturbance: &pushed,
        band: 50.0,
        mean: 4,
    };
    let weighed = Cost {
        rise: 1.0,
        lag: 2.0,
        effort: 0.5,
        recovery: 0.3,
        ..Cost::default()
    };
    with_task(start(), |task| {
        for (cost, loads) in [(Cost::default(), &[][..]), (weighed, &[held])] {
            let references = [task.references[0], &falling, &[700.0; 40]];
            let constraints = Constraints {
                overshoot: Some(5.0),
                u: Some(15.0),
                ..Constraints::default()
            };
            let task = Task {
                cost,
                loads,
                constraints,
                references: &references,
                disturbances: &[],
                noise: &[],
                ..task.clone()
            };
            compare(&task, &designs(&task.start));
        }
    });
}

fn compare<P: Plant + Clone + Send + Sync>(task: &Task<'_, P>, designs: &[AnyDesign<f64>]) {
    let judged = |designs: &[_], threads| {
        let judged = costs(task, designs, threads, &Monitor::default()).unwrap();
        let bits = |j: &Judged| [j.cost, j.violation, j.overshoot, j.u_max].map(f64::to_bits);
        judged.iter().map(bits).collect::<Vec<_>>()
    };
    let together = judged(designs, 1);
    let alone: Vec<_> = designs.iter().flat_map(|d| judged(&[*d], 1)).collect();
    assert_eq!(together, alone);
    assert_eq!(together, judged(designs, 3));
    let records = |designs: &[_]| {
        let mut bench = Bench::new(task).unwrap().with_all_terms(task);
        bench.records(task, designs, &Monitor::default())
    };
    let alone: Vec<_> = designs.iter().flat_map(|d| records(&[*d])).collect();
    assert_eq!(records(designs), alone);
    for (record, judged) in alone.iter().zip(together) {
        let record = record.map_or(f64::INFINITY, |r| r.cost);
        assert_eq!(record.to_bits(), judged[0]);
    }
}

#[test]
fn a_feedforward_that_all_share_and_others_are_worth_the_same_side_by_side() {
    let levels = [(-2e3, -4.0), (2e3, 4.0)].map(|(y, u)| Level { y, u });
    let feedforward = Feedforward::new(6, 0.5, &levels, &[0.02, 0.01]).unwrap();
    with_task(start(), |task| {
        let lead = |design: &AnyDesign<f64>| Design {
            feedforward,
            ..pid_of(design)
        };
        let all: Vec<AnyDesign<f64>> = designs(&task.start)
            .iter()
            .map(|design| lead(design).into())
            .collect();
        let alike: Vec<AnyDesign<f64>> = all
            .iter()
            .map(|design| {
                Design {
                    filter_samples: 8,
                    ..pid_of(design)
                }
                .into()
            })
            .collect();
        let without = {
            let mut some = alike.clone();
            some[3] = task.start;
            some
        };
        for designs in [all, alike, without] {
            compare(task, &designs);
        }
    });
}

#[test]
fn each_has_its_own_to_beat() {
    with_task(start(), |task| {
        let designs = designs(&task.start);
        let mut bench = Bench::new(task).unwrap();
        let limits = [1.0, 60.0, 200.0, f64::INFINITY].map(Judgement::feasible);
        let trials: Vec<_> = designs
            .into_iter()
            .zip(limits.into_iter().cycle())
            .collect();
        let together = bench.judge(task, Extent::Whole, &trials, &Monitor::default());
        let alone = trials
            .iter()
            .flat_map(|trial| bench.judge(task, Extent::Whole, &[*trial], &Monitor::default()));
        assert_eq!(together, alone.collect::<Vec<_>>());
        let given_up = together
            .iter()
            .zip(&trials)
            .filter(|(j, (_, limit))| limit.beats(j));
        assert!(given_up.count() >= 5);
    });
}
