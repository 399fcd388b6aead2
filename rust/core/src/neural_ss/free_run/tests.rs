use super::super::shape::Shape;
use super::*;
use crate::neural_ss::tests::{network_of, noise};

const SAMPLES: usize = 150;

/// Runs of two models with these limits, side by side or one after the other: their costs and trajectories.
fn runs(shape: Shape, limits: [f64; 2], together: bool) -> ([Option<f64>; 2], [Trajectory; 2]) {
    let networks = [1, 2].map(|seed| network_of(seed, shape));
    let v = noise(SAMPLES * shape.inputs, 3);
    let mut y = noise(SAMPLES, 4);
    y[5] = f64::NAN;
    let state = noise(shape.nx, 5);
    let mut left = networks
        .each_ref()
        .map(|network| Trajectory::new(network, SAMPLES));
    let mut scratches = [(); 2].map(|()| Scratch::new(shape));
    let [one, two] = &mut left;
    let [first, second] = &mut scratches;
    let run = |i: usize, run, scratch| Run {
        network: &networks[i],
        state: &state,
        run,
        scratch,
        limit: Some(Limit {
            limit: limits[i],
            samples: 0.5,
            ..Limit::NONE
        }),
    };
    let runs = [run(0, one, first), run(1, two, second)];
    let monitor = Monitor::default();
    let reached = if together {
        let both = FreeRuns {
            weights: &[],
            runs,
            v: &v,
            y: &y,
            bound: 1e3,
            monitor: &monitor,
        };
        both.go()
    } else {
        runs.map(|run| {
            let single = FreeRuns {
                weights: &[],
                runs: [run],
                v: &v,
                y: &y,
                bound: 1e3,
                monitor: &monitor,
            };
            single.go()[0]
        })
    };
    (reached, left)
}

fn shapes() -> impl Iterator<Item = Shape> {
    let sizes = [(1, 3), (2, 8), (3, 15), (4, 20), (5, 8)];
    sizes.into_iter().map(|(nx, hidden)| Shape {
        nx,
        nk: 1,
        inputs: 2,
        hidden,
        integrator: false,
    })
}

#[test]
fn two_runs_side_by_side_have_the_bits_of_each_alone() {
    for shape in shapes() {
        let free = [f64::INFINITY; 2];
        let (reached, left) = runs(shape, free, true);
        let (alone, expected) = runs(shape, free, false);
        assert_eq!(reached, alone, "{shape:?}");
        for (left, expected) in left.iter().zip(&expected) {
            assert_eq!(left.states, expected.states);
            assert_eq!(
                (&left.hidden, &left.sums),
                (&expected.hidden, &expected.sums)
            );
        }
    }
}

#[test]
fn a_run_ends_where_its_cost_reaches_the_limit_and_the_other_goes_on() {
    for shape in shapes() {
        let ([first, second], expected) = runs(shape, [f64::INFINITY; 2], true);
        let (first, second) = (first.unwrap(), second.unwrap());
        let (reached, left) = runs(shape, [0.5 * first, f64::INFINITY], true);
        assert_eq!(reached, [None, Some(second)], "{shape:?}");
        assert_eq!(left[1].sums, expected[1].sums);
        // the first one's later blocks were never run
        assert_eq!(left[0].sums.last(), Some(&0.0));
        // a cost at the limit does not win, one below it does
        assert_eq!(
            runs(shape, [first, second * 1.001], true).0,
            [None, Some(second)]
        );
    }
}
