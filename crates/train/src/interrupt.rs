//! Ctrl-C and SIGTERM: the first one asks the run to finish its step, save and end; the second ends the process.

use std::sync::atomic::{AtomicU32, Ordering};
use std::sync::{Arc, OnceLock};

use crate::TrainError;

/// Exit status of a process ended by Ctrl-C, by the convention of shells: 128 + SIGINT.
const ABORTED: i32 = 130;

/// Whether the run has been asked to end.
#[derive(Clone, Debug, Default)]
pub struct Interrupt {
    requests: Arc<AtomicU32>,
}

impl Interrupt {
    /// Listens to Ctrl-C, SIGTERM and SIGHUP. May be called more than once; all values share one state.
    ///
    /// # Errors
    /// When the operating system or another handler in the process refuses.
    pub fn listen() -> Result<Self, TrainError> {
        static SHARED: OnceLock<Interrupt> = OnceLock::new();
        if let Some(shared) = SHARED.get() {
            return Ok(shared.clone());
        }
        let shared = SHARED.get_or_init(Self::default).clone();
        let requests = shared.requests.clone();
        let handler = move || {
            if requests.fetch_add(1, Ordering::SeqCst) == 0 {
                tracing::warn!("stopping after this step and saving; press Ctrl-C again to quit without saving");
            } else {
                std::process::exit(ABORTED);
            }
        };
        ctrlc::set_handler(handler).map_err(|why| TrainError::Config(format!("cannot listen to Ctrl-C: {why}")))?;
        Ok(shared)
    }

    /// Asks the run to end as the first Ctrl-C does.
    pub fn request(&self) {
        self.requests.fetch_add(1, Ordering::SeqCst);
    }

    /// Whether the run should end.
    pub fn requested(&self) -> bool {
        self.requests.load(Ordering::SeqCst) > 0
    }
}
