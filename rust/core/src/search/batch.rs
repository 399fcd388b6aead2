//! A function over a list, by as many threads as there are memories.

use std::sync::atomic::{AtomicUsize, Ordering};
use std::thread;

/// `work` on the items, up to `together` at once and no more than leave something for every memory; the results are in
/// the items' order.
pub(crate) fn several<M: Send, I: Sync, R: Send>(
    memories: &mut [M],
    items: &[I],
    together: usize,
    work: impl Fn(&mut M, &[I]) -> Vec<R> + Sync,
) -> Vec<R> {
    let share = items.len().div_ceil(memories.len().max(1));
    let some: Vec<&[I]> = items.chunks(together.min(share).max(1)).collect();
    let results = each(memories, &some, |memory, some| work(memory, some));
    results.into_iter().flatten().collect()
}

/// `work` on every item; the results are in the items' order, whichever thread computed them.
pub(crate) fn each<M: Send, I: Sync, R: Send>(
    memories: &mut [M],
    items: &[I],
    work: impl Fn(&mut M, &I) -> R + Sync,
) -> Vec<R> {
    if let [memory] = memories {
        return items.iter().map(|item| work(memory, item)).collect();
    }
    let next = AtomicUsize::new(0);
    let own = |memory: &mut M| {
        let mut done = Vec::new();
        loop {
            let index = next.fetch_add(1, Ordering::Relaxed);
            let Some(item) = items.get(index) else {
                return done;
            };
            done.push((index, work(memory, item)));
        }
    };
    let mut results = thread::scope(|scope| {
        let workers: Vec<_> = memories
            .iter_mut()
            .take(items.len())
            .map(|memory| scope.spawn(|| own(memory)))
            .collect();
        let mut all = Vec::with_capacity(items.len());
        for worker in workers {
            let done = worker.join();
            all.extend(done.unwrap_or_else(|panic| std::panic::resume_unwind(panic)));
        }
        all
    });
    results.sort_unstable_by_key(|(index, _)| *index);
    results.into_iter().map(|(_, result)| result).collect()
}
