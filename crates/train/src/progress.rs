//! What a person sees while the run goes on: a bar on a terminal, plain lines in a log.

use std::io::IsTerminal;
use std::time::{Duration, Instant};

use indicatif::{ProgressBar, ProgressStyle};

use crate::task::Scalars;

/// Time and work of a stretch of steps.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct Pace {
    pub(crate) wait: Duration,
    pub(crate) total: Duration,
    pub(crate) images: usize,
}

impl Pace {
    pub(crate) fn add(&mut self, other: Self) {
        self.wait += other.wait;
        self.total += other.total;
        self.images += other.images;
    }

    /// Share of the time spent waiting for data, in [0, 1].
    pub(crate) fn data_wait_fraction(&self) -> f64 {
        if self.total.is_zero() { 0.0 } else { self.wait.as_secs_f64() / self.total.as_secs_f64() }
    }

    pub(crate) fn images_per_second(&self) -> f64 {
        if self.total.is_zero() { 0.0 } else { self.images as f64 / self.total.as_secs_f64() }
    }
}

/// Shows the run's progress.
pub(crate) struct Progress {
    bar: Option<ProgressBar>,
    started: Instant,
    first_step: u64,
    total_steps: u64,
}

impl Progress {
    pub(crate) fn new(first_step: u64, total_steps: u64) -> Self {
        let bar = std::io::stderr().is_terminal().then(|| {
            let style = ProgressStyle::with_template("{wide_bar} {pos}/{len} {msg} ETA {eta}");
            // The template is a constant; a bad one only costs the layout.
            let style = style.unwrap_or_else(|_| ProgressStyle::default_bar());
            let bar = ProgressBar::new(total_steps).with_style(style).with_position(first_step);
            bar.reset_eta();
            bar
        });
        Self { bar, started: Instant::now(), first_step, total_steps }
    }

    /// Counts a finished step.
    pub(crate) fn tick(&self, step: u64) {
        if let Some(bar) = &self.bar {
            bar.set_position(step);
        }
    }

    /// Shows the values of a logged step.
    pub(crate) fn report(&self, step: u64, scalars: &Scalars, pace: &Pace) {
        let loss = scalars.iter().find(|(name, _)| name == "loss").map_or(f64::NAN, |(_, value)| *value);
        let (speed, wait) = (pace.images_per_second(), 100.0 * pace.data_wait_fraction());
        match &self.bar {
            Some(bar) => bar.set_message(format!("loss {loss:.4}  {speed:.1} img/s  data wait {wait:.1} %")),
            None => {
                let eta_secs = self.eta_secs(step);
                tracing::info!(
                    "step {step}/{}  loss {loss:.4}  {speed:.1} img/s  data wait {wait:.1} %  ETA {eta_secs} s",
                    self.total_steps
                );
            }
        }
    }

    /// Says something in between.
    pub(crate) fn say(&self, text: &str) {
        match &self.bar {
            Some(bar) => bar.println(text),
            None => tracing::info!("{text}"),
        }
    }

    /// Leaves the bar where it is.
    pub(crate) fn finish(&self) {
        if let Some(bar) = &self.bar {
            bar.abandon();
        }
    }

    fn eta_secs(&self, step: u64) -> u64 {
        let done = step.saturating_sub(self.first_step).max(1);
        let left = self.total_steps.saturating_sub(step);
        (self.started.elapsed().as_secs_f64() / done as f64 * left as f64) as u64
    }
}
