//! The most recently used scenes, shared by threads.

use std::sync::{Arc, Mutex, OnceLock, PoisonError};

/// Keeps at most `capacity` values; the one unused for longest goes first.
#[derive(Debug)]
pub(crate) struct SceneCache<T> {
    capacity: usize,
    /// Least recently used first. A few dozen entries: walking them costs nothing beside making one.
    entries: Mutex<Vec<Entry<T>>>,
}

#[derive(Debug)]
struct Entry<T> {
    scene: usize,
    value: Arc<OnceLock<Arc<T>>>,
}

impl<T> SceneCache<T> {
    pub(crate) fn new(capacity: usize) -> Self {
        Self { capacity, entries: Mutex::new(Vec::new()) }
    }

    /// The value of a scene. It is made outside the lock: threads that want other scenes do not wait, threads that want the same one
    /// wait for one of them to make it.
    pub(crate) fn get_or_make(&self, scene: usize, make: impl FnOnce() -> T) -> Arc<T> {
        self.slot(scene).get_or_init(|| Arc::new(make())).clone()
    }

    fn slot(&self, scene: usize) -> Arc<OnceLock<Arc<T>>> {
        // A panic elsewhere cannot leave the list half changed: nothing between here and the end can panic.
        let mut entries = self.entries.lock().unwrap_or_else(PoisonError::into_inner);
        let entry = match entries.iter().position(|e| e.scene == scene) {
            Some(at) => entries.remove(at),
            None => Entry { scene, value: Arc::default() },
        };
        let value = entry.value.clone();
        entries.push(entry);
        if entries.len() > self.capacity {
            entries.remove(0);
        }
        value
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::sync::atomic::{AtomicUsize, Ordering};

    #[test]
    fn the_least_recently_used_goes_first() {
        let cache = SceneCache::new(2);
        let made = AtomicUsize::new(0);
        let get = |scene| {
            *cache.get_or_make(scene, || {
                made.fetch_add(1, Ordering::Relaxed);
                scene * 10
            })
        };
        assert_eq!([get(1), get(2), get(1), get(3), get(1)], [10, 20, 10, 30, 10]);
        assert_eq!(made.load(Ordering::Relaxed), 3, "1 stays because it was used after 2");
        assert_eq!(get(2), 20);
        assert_eq!(made.load(Ordering::Relaxed), 4);
    }

    #[test]
    fn threads_make_a_scene_once() {
        let cache = SceneCache::new(4);
        let made = AtomicUsize::new(0);
        std::thread::scope(|scope| {
            for _ in 0..8 {
                scope.spawn(|| {
                    cache.get_or_make(5, || {
                        std::thread::sleep(std::time::Duration::from_millis(20));
                        made.fetch_add(1, Ordering::Relaxed);
                    })
                });
            }
        });
        assert_eq!(made.load(Ordering::Relaxed), 1);
    }
}
