//! The step loop: pull batches, call the task, log, validate, preview, checkpoint, stop when asked.

use std::collections::BTreeMap;
use std::time::Instant;

use serde::{Deserialize, Serialize};

use crate::TrainError;
use crate::checkpoint::{Best, CheckpointState};
use crate::checkpoint_store::CheckpointStore;
use crate::files::sha256;
use crate::interrupt::Interrupt;
use crate::metrics::{MetricsLog, MetricsRow};
use crate::progress::{Pace, Progress};
use crate::run_dir::RunDir;
use crate::task::{BatchSource, Scalars, StepContext, Task};
use crate::tensorboard::EventWriter;

/// Length and rhythm of a run. An interval of 0 means never; validation, preview and checkpoint are also made at the
/// end unless their interval is 0.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct TrainConfig {
    /// Steps of the whole run.
    pub steps: u64,
    /// Micro batches per step, whose gradients are averaged.
    pub accumulate: usize,
    /// Steps between logged steps.
    pub log_every: u64,
    /// Steps between validations.
    pub validate_every: u64,
    /// Steps between previews.
    pub preview_every: u64,
    /// Steps between checkpoints.
    pub checkpoint_every: u64,
    /// Checkpoints that are kept beside the best.
    pub keep_last: usize,
    /// Which validation scalar marks the best checkpoint; none when absent.
    pub best: Option<BestRule>,
    /// Skipped updates in a row (NaN or infinite gradients) that end the run; 0 is without limit.
    pub stop_after_nonfinite: u32,
}

impl Default for TrainConfig {
    fn default() -> Self {
        Self {
            steps: 1000,
            accumulate: 1,
            log_every: 10,
            validate_every: 500,
            preview_every: 500,
            checkpoint_every: 500,
            keep_last: 3,
            best: None,
            stop_after_nonfinite: 20,
        }
    }
}

/// How the best checkpoint is told.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct BestRule {
    /// Name of the validation scalar.
    pub scalar: String,
    /// Whether small or large is good.
    pub goal: Goal,
}

/// Direction in which a scalar improves.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Goal {
    /// Smaller is better.
    Min,
    /// Larger is better.
    Max,
}

/// What the caller decides about one run.
#[derive(Debug)]
pub struct RunSetup<'a> {
    /// Length and rhythm.
    pub config: &'a TrainConfig,
    /// The run's folder.
    pub run_dir: &'a RunDir,
    /// Seed of everything random.
    pub seed: u64,
    /// The experiment's resolved config, kept in every checkpoint.
    pub config_text: &'a str,
    /// Whether to go on from the newest checkpoint; without one the run starts at step 0.
    pub resume: bool,
    /// Whether the run has been asked to end.
    pub interrupt: Interrupt,
    /// Ends after this many steps of the whole run as Ctrl-C would: saved and ready to be continued.
    pub pause_after: Option<u64>,
}

/// How a run ended.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Outcome {
    /// Steps done, those before a resume included.
    pub steps: u64,
    /// Wall time of this process's part, in seconds.
    pub seconds: f64,
    /// Share of the steps' time spent waiting for data, in [0, 1].
    pub data_wait_fraction: f64,
    /// Images per second over all steps of this part, without validation and checkpoints.
    pub images_per_second: f64,
    /// Largest resident memory of the process, in bytes; unknown outside Linux.
    pub peak_rss_bytes: Option<u64>,
    /// Whether the run ended before its last step.
    pub interrupted: bool,
    /// Values of the last validation.
    pub validation: Scalars,
    /// The best checkpoint, if one was asked for.
    pub best: Option<Best>,
}

/// Runs a task to its end or until it is interrupted. `open_source` starts the data at a position (batches already
/// taken), which is known only after the checkpoint has been read.
///
/// # Errors
/// Whatever the task, its data, the run folder or the non-finite guard reports; the checkpoints stay usable.
pub fn train<T: Task, S: BatchSource<Batch = T::Batch>>(
    task: &mut T,
    open_source: impl FnOnce(u64) -> Result<S, TrainError>,
    setup: &RunSetup,
) -> Result<Outcome, TrainError> {
    let begun = Instant::now();
    let mut run = Run::open(task, setup)?;
    let mut source = open_source(run.state.position)?;
    let mut total = Pace::default();
    let last = setup.pause_after.map_or(setup.config.steps, |pause| pause.min(setup.config.steps));
    while run.state.step < last && !setup.interrupt.requested() {
        let pace = run.step(task, &mut source)?;
        total.add(pace);
    }
    run.close(task)?;
    let interrupted = run.state.step < setup.config.steps;
    if interrupted {
        let step = run.state.step;
        run.progress.say(&format!("stopped and saved after step {step}; add --resume to the same command to go on"));
    }
    run.progress.finish();
    Ok(Outcome {
        steps: run.state.step,
        seconds: begun.elapsed().as_secs_f64(),
        data_wait_fraction: total.data_wait_fraction(),
        images_per_second: total.images_per_second(),
        peak_rss_bytes: peak_rss_bytes(),
        interrupted,
        validation: run.validation,
        best: run.state.best,
    })
}

/// A run between two steps.
struct Run<'a> {
    setup: &'a RunSetup<'a>,
    store: CheckpointStore,
    metrics: MetricsLog,
    events: EventWriter,
    progress: Progress,
    state: CheckpointState,
    /// Time and work since the last logged step.
    window: Pace,
    validation: Scalars,
    validated_at: Option<u64>,
    previewed_at: Option<u64>,
    saved_at: Option<u64>,
}

impl<'a> Run<'a> {
    fn open<T: Task>(task: &mut T, setup: &'a RunSetup<'a>) -> Result<Self, TrainError> {
        let config_sha256 = sha256(setup.config_text.as_bytes());
        let store = CheckpointStore::open(setup.run_dir.path(), setup.config.keep_last)?;
        let mut state = CheckpointState { seed: setup.seed, config_sha256, ..CheckpointState::default() };
        let mut saved_at = None;
        let found = if setup.resume { store.latest()? } else { None };
        if let Some(reader) = found {
            let stored = reader.state();
            if stored.seed != setup.seed {
                let (old, new) = (stored.seed, setup.seed);
                return Err(TrainError::Config(format!("the run has seed {old}, it cannot go on with seed {new}")));
            }
            if stored.config_sha256 != state.config_sha256 {
                tracing::warn!("the config differs from the one that the checkpoint was made with");
            }
            task.load(&reader)?;
            state = CheckpointState { config_sha256: state.config_sha256, ..stored.clone() };
            saved_at = Some(state.step);
            tracing::info!(step = state.step, checkpoint = %reader.folder().display(), "going on");
        } else if setup.resume {
            tracing::warn!("there is no checkpoint to go on from, starting at step 0");
        }
        store.restore_best(state.best.as_ref())?;
        Ok(Self {
            setup,
            store,
            metrics: MetricsLog::open(setup.run_dir.path(), state.step)?,
            events: EventWriter::create(setup.run_dir.path(), state.step)?,
            progress: Progress::new(state.step, setup.config.steps),
            validation: stored_scalars(&state),
            window: Pace::default(),
            validated_at: saved_at,
            previewed_at: saved_at,
            saved_at,
            state,
        })
    }

    fn step<T: Task, S: BatchSource<Batch = T::Batch>>(
        &mut self,
        task: &mut T,
        source: &mut S,
    ) -> Result<Pace, TrainError> {
        let config = self.setup.config;
        let begun = Instant::now();
        let batches = tracing::debug_span!("data_wait")
            .in_scope(|| (0..config.accumulate.max(1)).map(|_| source.next()).collect::<Result<Vec<_>, _>>())?;
        let wait = begun.elapsed();
        let done = self.state.step + 1;
        let log = due(config.log_every, done) || done == config.steps;
        let ctx = self.context(self.state.step, log);
        let output = tracing::debug_span!("step").in_scope(|| task.train_step(batches, &ctx))?;
        let images = output.images;
        let scalars = if log { output.read() } else { Scalars::new() };
        self.state.step = done;
        self.state.position = source.position();
        let pace = Pace { wait, total: begun.elapsed(), images };
        self.window.add(pace);
        self.progress.tick(done);
        if log {
            self.log(scalars)?;
        }
        let improved = due(config.validate_every, done) && self.validate(task)?;
        if due(config.preview_every, done) {
            self.preview(task)?;
        }
        if due(config.checkpoint_every, done) || improved {
            self.save(task)?;
        }
        Ok(pace)
    }

    /// Validation, preview and checkpoint at the end. A run that stops early only saves, for speed after Ctrl-C.
    fn close<T: Task>(&mut self, task: &mut T) -> Result<(), TrainError> {
        let config = self.setup.config;
        if self.state.step >= config.steps {
            if config.validate_every > 0 {
                self.validate(task)?;
            }
            if config.preview_every > 0 {
                self.preview(task)?;
            }
        }
        if config.checkpoint_every > 0 || self.state.step < config.steps { self.save(task) } else { Ok(()) }
    }

    fn log(&mut self, mut scalars: Scalars) -> Result<(), TrainError> {
        let step = self.state.step;
        self.progress.report(step, &scalars, &self.window);
        scalars.push(("images_per_second".into(), self.window.images_per_second()));
        scalars.push(("data_wait_fraction".into(), self.window.data_wait_fraction()));
        self.window = Pace::default();
        self.metrics.append(MetricsRow { step, split: "train", values: &scalars })?;
        self.events.scalars(step, "train", &scalars)
    }

    /// Returns whether this is the best result so far.
    fn validate<T: Task>(&mut self, task: &mut T) -> Result<bool, TrainError> {
        let step = self.state.step;
        if self.validated_at.replace(step) == Some(step) {
            return Ok(false);
        }
        let ctx = self.context(step, true);
        self.validation = tracing::debug_span!("validate").in_scope(|| task.validate(&ctx))?;
        let shown: Vec<String> = self.validation.iter().map(|(name, value)| format!("{name} {value:.4}")).collect();
        self.progress.say(&format!("validation after step {step}: {}", shown.join("  ")));
        self.metrics.append(MetricsRow { step, split: "validation", values: &self.validation })?;
        self.events.scalars(step, "validation", &self.validation)?;
        let finite = |value: f64| value.is_finite().then_some(value);
        self.state.scalars = self.validation.iter().map(|(name, value)| (name.clone(), finite(*value))).collect();
        self.judge_best(step)
    }

    fn judge_best(&mut self, step: u64) -> Result<bool, TrainError> {
        let Some(rule) = &self.setup.config.best else { return Ok(false) };
        let value = self.state.scalars.get(&rule.scalar).ok_or_else(|| {
            let known: Vec<&str> = self.validation.iter().map(|(name, _)| name.as_str()).collect();
            TrainError::Config(format!("best.scalar {:?} is no validation value; there are {known:?}", rule.scalar))
        })?;
        let Some(value) = *value else { return Ok(false) };
        let better = |old: f64| match rule.goal {
            Goal::Min => value < old,
            Goal::Max => value > old,
        };
        let improved = self.state.best.as_ref().is_none_or(|best| better(best.value));
        if improved {
            self.state.best = Some(Best { step, scalar: rule.scalar.clone(), value });
        }
        Ok(improved)
    }

    fn preview<T: Task>(&mut self, task: &mut T) -> Result<(), TrainError> {
        let step = self.state.step;
        if self.previewed_at.replace(step) == Some(step) {
            return Ok(());
        }
        let folder = self.setup.run_dir.preview_folder(step)?;
        let ctx = self.context(step, true);
        tracing::debug_span!("preview").in_scope(|| task.preview(&folder, &ctx))
    }

    fn save<T: Task>(&mut self, task: &T) -> Result<(), TrainError> {
        let step = self.state.step;
        if self.saved_at == Some(step) {
            return Ok(());
        }
        let write = |writer: &mut crate::CheckpointWriter| task.save(writer);
        tracing::debug_span!("checkpoint")
            .in_scope(|| self.store.save(self.state.clone(), self.setup.config_text, write))?;
        self.store.restore_best(self.state.best.as_ref())?;
        self.saved_at = Some(step);
        Ok(())
    }

    fn context(&self, step: u64, log: bool) -> StepContext {
        StepContext {
            step,
            total_steps: self.setup.config.steps,
            seed: self.setup.seed,
            log,
            stop_after_nonfinite: self.setup.config.stop_after_nonfinite,
        }
    }
}

fn due(interval: u64, done: u64) -> bool {
    interval > 0 && done.is_multiple_of(interval)
}

fn stored_scalars(state: &CheckpointState) -> Scalars {
    let scalars: &BTreeMap<String, Option<f64>> = &state.scalars;
    scalars.iter().map(|(name, value)| (name.clone(), value.unwrap_or(f64::NAN))).collect()
}

/// Largest resident set of this process from Linux's `/proc`, which counts in KiB.
fn peak_rss_bytes() -> Option<u64> {
    let status = std::fs::read_to_string("/proc/self/status").ok()?;
    let line = status.lines().find_map(|line| line.strip_prefix("VmHWM:"))?;
    line.split_whitespace().next()?.parse::<u64>().ok().map(|kib| kib * 1024)
}
