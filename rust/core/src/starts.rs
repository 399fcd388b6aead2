//! Many starts of one fit, over threads: drawn until they can learn, trained until they have, and ranked.

use std::thread;

use crate::search::each;
use crate::{Error, Monitor, Result};

/// Draws of a start before it is given up.
const MOST_DRAWS: usize = 50;
/// Trainings of a start before it is given up: only trainings that ended dead are repeated.
pub(crate) const MOST_TRAININGS: usize = 3;
/// A training that ends above this share of a constant output's J has learnt nothing.
const DEAD_COST: f64 = 0.9;

/// Refuses impossible numbers of iterations and starts.
///
/// # Errors
/// `ErrorKind::Setting` outside 1 to 1,000,000.
pub(crate) fn check(max_iterations: usize, starts: usize) -> Result<()> {
    for (name, value) in [("max_iterations", max_iterations), ("starts", starts)] {
        if value == 0 || value > 1_000_000 {
            return Err(Error::setting(format!(
                "expected {name} from 1 to 1,000,000, got {value}; 100 iterations and 8 starts are usual"
            )));
        }
    }
    Ok(())
}

/// The first draw from which a training can begin, and how many draws could not.
pub(crate) fn drawn<T>(
    monitor: &Monitor,
    mut draw: impl FnMut() -> Option<T>,
) -> Option<(T, usize)> {
    for dead in 0..MOST_DRAWS {
        if let Some(theta) = draw() {
            return Some((theta, dead));
        }
        if monitor.stopped() {
            return None;
        }
    }
    None
}

/// Whether a training has learnt anything, by its J relative to that of the best constant output.
pub(crate) fn has_learnt(cost: f64, constant_cost: f64) -> bool {
    cost < DEAD_COST * constant_cost
}

/// The first of `trainings` that has learnt, or else the last one, and how many draws and trainings were dead.
///
/// `train` returns its result and the number of dead draws before it.
pub(crate) fn learnt<T>(
    trainings: usize,
    monitor: &Monitor,
    mut train: impl FnMut() -> Option<(T, usize)>,
    is_alive: impl Fn(&T) -> bool,
) -> Option<(T, usize)> {
    let mut discarded = 0;
    for training in 1..=trainings {
        let (trained, dead) = train()?;
        discarded += dead;
        if is_alive(&trained) || training == trainings || monitor.stopped() {
            return Some((trained, discarded));
        }
        discarded += 1;
    }
    None
}

/// The score of a start: J on the validation data, else on the training data; infinite if not finite.
pub(crate) fn score(validation_cost: Option<f64>, cost: f64) -> f64 {
    let score = validation_cost.unwrap_or(cost);
    if score.is_nan() { f64::INFINITY } else { score }
}

/// The error if all starts have failed.
pub(crate) fn none_left() -> Error {
    Error::fit(
        "expected a start with a finite free run on training and validation data, found none; give more starts, a linear model to start from, or a smaller network",
    )
}

/// Results of `run(0) .. run(starts - 1)` in order, for any number of threads (0: as many as the machine has).
///
/// A start that has not begun when a stop is requested has no result.
pub(crate) fn run_all<T: Send>(
    starts: usize,
    threads: usize,
    monitor: &Monitor,
    run: impl Fn(usize) -> Option<T> + Sync,
) -> Vec<Option<T>> {
    let available = || thread::available_parallelism().map_or(1, usize::from);
    let threads = match threads {
        0 => available(),
        threads => threads,
    };
    let (mut memories, starts) = (vec![(); threads], Vec::from_iter(0..starts));
    let begun = |(): &mut (), &start: &usize| (!monitor.stopped()).then(|| run(start));
    let results = each(&mut memories, &starts, begun);
    results.into_iter().flatten().collect()
}

/// Starts with a finite score: sound ones first, each group best first.
pub(crate) fn ranked(scores: &[f64], is_sound: impl Fn(usize) -> bool) -> Vec<usize> {
    let mut order: Vec<usize> = (0..scores.len())
        .filter(|&i| scores[i].is_finite())
        .collect();
    order.sort_by(|&i, &j| {
        is_sound(j)
            .cmp(&is_sound(i))
            .then(scores[i].total_cmp(&scores[j]))
    });
    order
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn keeps_the_order_of_the_starts_at_any_number_of_threads() {
        for threads in [1, 3, 20] {
            let results = run_all(9, threads, &Monitor::default(), |i| {
                (i % 3 > 0).then_some(i)
            });
            let expected: Vec<_> = (0..9).map(|i| (i % 3 > 0).then_some(i)).collect();
            assert_eq!(results, expected);
        }
    }

    #[test]
    fn begins_nothing_after_a_stop() {
        let monitor = Monitor::default();
        monitor.request_stop();
        assert!(run_all(5, 2, &monitor, Some).is_empty());
    }

    #[test]
    fn counts_the_draws_that_were_dead() {
        let monitor = Monitor::default();
        let mut draws = [None, None, Some('a')].into_iter();
        assert_eq!(drawn(&monitor, || draws.next().flatten()), Some(('a', 2)));
        let mut asked = 0;
        let none = drawn(&monitor, || {
            asked += 1;
            None::<()>
        });
        assert_eq!((none, asked), (None, MOST_DRAWS));
    }

    #[test]
    fn trains_again_until_it_learns_and_keeps_the_last() {
        let monitor = Monitor::default();
        let alive = |&cost: &f64| has_learnt(cost, 1.0);
        let mut costs = [5.0, 4.0, 0.1].into_iter();
        let found = learnt(MOST_TRAININGS, &monitor, || Some((costs.next()?, 2)), alive);
        assert_eq!(found, Some((0.1, 8)));
        assert_eq!(
            learnt(2, &monitor, || Some((7.0, 0)), alive),
            Some((7.0, 1))
        );
        assert_eq!(learnt(2, &monitor, || None, alive), None);
        monitor.request_stop();
        assert_eq!(
            learnt(2, &monitor, || Some((7.0, 0)), alive),
            Some((7.0, 0))
        );
    }

    #[test]
    fn a_score_that_is_no_number_is_the_worst() {
        assert_eq!(score(None, 2.0), 2.0);
        assert_eq!(score(Some(3.0), 2.0), 3.0);
        assert_eq!(score(Some(f64::NAN), 2.0), f64::INFINITY);
    }

    #[test]
    fn ranks_sound_starts_before_better_ones() {
        let scores = [3.0, 1.0, f64::INFINITY, 2.0];
        assert_eq!(ranked(&scores, |i| i != 1), [3, 0, 1]);
    }
}
