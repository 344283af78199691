//! Micro batches side by side. Half of a step's operations are too small for all cores, so two small steps at once finish
//! sooner than one after the other, and each result is the same as when computed alone.

use burn::backend::DispatchDevice;
use burn::tensor::Device;
use rayon::prelude::*;

/// Runs `work` on every item, at most `lanes` at a time, and returns the results in order.
///
/// Work that differentiates must not share tracked parameters between items: give each its own
/// [fork](burn::module::Module::fork), else burn joins their graphs under one lock.
pub fn in_lanes<T: Sync, R: Send>(items: &[T], lanes: usize, work: impl Fn(usize, &T) -> R + Sync) -> Vec<R> {
    if lanes <= 1 {
        // A GPU's queue is fed from the caller's thread.
        return items.iter().enumerate().map(|(place, item)| work(place, item)).collect();
    }
    let mut results = Vec::with_capacity(items.len());
    for (wave, part) in items.chunks(lanes).enumerate() {
        let mut slots: Vec<Option<R>> = part.iter().map(|_| None).collect();
        // Inside the pool also for one item: operations then split their work without waking another thread first.
        rayon::scope(|scope| {
            for (place, (item, slot)) in part.iter().zip(&mut slots).enumerate() {
                let work = &work;
                scope.spawn(move |_| *slot = Some(work(wave * lanes + place, item)));
            }
        });
        results.extend(slots.into_iter().flatten());
    }
    results
}

/// Runs `work` on every job, side by side on the CPU backend and one after another elsewhere; the results keep the order of the jobs.
pub(crate) fn for_each_job<T: Send, R: Send>(
    device: &Device,
    jobs: Vec<T>,
    work: impl Fn(T) -> R + Sync + Send,
) -> Vec<R> {
    let on_cpu = matches!(device.clone().inner().as_dispatch(), DispatchDevice::Flex(_));
    if on_cpu { jobs.into_par_iter().map(work).collect() } else { jobs.into_iter().map(work).collect() }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn results_keep_their_order_for_any_number_of_lanes() {
        let items: Vec<usize> = (0..17).collect();
        for lanes in [0, 1, 2, 5, 40] {
            let got = in_lanes(&items, lanes, |place, item| {
                assert_eq!(place, *item);
                item * item
            });
            assert_eq!(got, items.iter().map(|i| i * i).collect::<Vec<_>>());
        }
    }
}
