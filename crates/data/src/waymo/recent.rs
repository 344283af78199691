//! The tables of the segments that were asked for last: a whole split's do not fit into memory.

use std::collections::VecDeque;
use std::sync::{Arc, Mutex, PoisonError};

use crate::DataError;

/// Segments kept at a time; neighbouring frames of a clip come from one or two, and a loader has a thread per processor.
const KEPT: usize = 32;

#[derive(Debug)]
pub(super) struct Recent<T>(Mutex<VecDeque<(usize, Arc<T>)>>);

impl<T> Default for Recent<T> {
    fn default() -> Self {
        Self(Mutex::new(VecDeque::new()))
    }
}

impl<T> Recent<T> {
    /// The value of a segment. Two threads may load the same one at a time; neither waits for the other.
    pub fn get(&self, segment: usize, load: impl FnOnce() -> Result<T, DataError>) -> Result<Arc<T>, DataError> {
        if let Some(found) = self.find(segment) {
            return Ok(found);
        }
        let loaded = Arc::new(load()?);
        let mut kept = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        kept.push_front((segment, loaded.clone()));
        kept.truncate(KEPT);
        Ok(loaded)
    }

    fn find(&self, segment: usize) -> Option<Arc<T>> {
        let mut kept = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        let at = kept.iter().position(|entry| entry.0 == segment)?;
        let entry = kept.remove(at)?;
        let found = entry.1.clone();
        kept.push_front(entry);
        Some(found)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_longest_unused_goes_first() {
        let recent = Recent::default();
        let loads = |segment: usize| {
            let mut loaded = false;
            let value = recent.get(segment, || {
                loaded = true;
                Ok(segment * 10)
            });
            assert_eq!(*value.unwrap(), segment * 10);
            loaded
        };
        assert!((0..KEPT).all(loads));
        assert!(!loads(0) && loads(KEPT), "0 was used, 1 makes room");
        assert!(!loads(0) && loads(1));
        assert!(recent.get(999, || Err(DataError::Config("no".to_owned()))).is_err());
        assert!(loads(999), "a failure is not kept");
    }
}
