//! Many starts of one fit: over threads, in their order, ranked.

use std::sync::Mutex;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::thread;

use crate::Monitor;

/// Results of `run(0) .. run(starts - 1)` in their order, whatever the number of threads (0: as many as there are).
///
/// A start that is not begun before a stop is requested has no result.
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
    let (next, results) = (AtomicUsize::new(0), Mutex::new(Vec::with_capacity(starts)));
    let work = || {
        loop {
            let start = next.fetch_add(1, Ordering::Relaxed);
            if start >= starts || monitor.stopped() {
                return;
            }
            let result = run(start);
            let mut results = results.lock().unwrap_or_else(|e| e.into_inner());
            results.push((start, result));
        }
    };
    thread::scope(|scope| {
        for _ in 1..threads.min(starts) {
            scope.spawn(work);
        }
        work();
    });
    let mut results = results.into_inner().unwrap_or_else(|e| e.into_inner());
    results.sort_by_key(|(start, _)| *start);
    results.into_iter().map(|(_, result)| result).collect()
}

/// Starts with a finite score: sound ones first, each part best first.
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
    fn ranks_sound_starts_before_better_ones() {
        let scores = [3.0, 1.0, f64::INFINITY, 2.0];
        assert_eq!(ranked(&scores, |i| i != 1), [3, 0, 1]);
    }
}
