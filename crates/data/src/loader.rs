//! Batches from worker threads, in an order that does not depend on them.
//!
//! Each sample, a frame of a clip too, is one task. Tasks are handed out a bounded number of batches ahead; results come back in any order and are put in
//! place by their number, so the run is the same for any number of workers. An error stops the run at exactly the batch that holds it.

use std::collections::BTreeMap;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::JoinHandle;

use crossbeam_channel::{Receiver, Sender, unbounded};
use serde::{Deserialize, Serialize};

use crate::sample::in_frame;
use crate::{
    AugmentConfig, DataError, FrameId, ImageSize, Mixture, PadViews, PoseMode, Sample, SampleOptions, SceneBatch,
    SceneDataset, assemble, assemble_clips,
};

/// Settings of a [`Loader`].
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct LoaderConfig {
    /// Samples, or clips, per batch.
    pub batch_size: usize,
    /// Worker threads.
    pub workers: usize,
    /// Batches prepared ahead of the one being handed out.
    pub prefetch: usize,
    /// Number of views.
    pub pad_views: PadViews,
    /// Poses of the cameras.
    pub pose_mode: PoseMode,
    /// Random changes of the samples.
    pub augment: AugmentConfig,
    /// Network picture size; belongs to the model, so files do not repeat it.
    #[serde(skip, default = "default_size")]
    pub size: ImageSize,
    /// Seed of the augmentation; belongs to the run, so files do not repeat it.
    #[serde(skip)]
    pub seed: u64,
}

const fn default_size() -> ImageSize {
    ImageSize::square(64)
}

impl Default for LoaderConfig {
    fn default() -> Self {
        Self {
            batch_size: 2,
            workers: 2,
            prefetch: 2,
            pad_views: PadViews::default(),
            pose_mode: PoseMode::default(),
            augment: AugmentConfig::default(),
            size: default_size(),
            seed: 0,
        }
    }
}

/// Item of the run and number of its frame.
type Place = (u64, usize);
type Loaded = (Place, Result<Sample, DataError>);

/// Hands out the batches of a [`Mixture`] one after another, without end.
pub struct Loader {
    config: LoaderConfig,
    /// `None` once the loader shuts down.
    tasks: Option<Sender<Place>>,
    results: Receiver<Loaded>,
    /// Results that came before their turn.
    early: BTreeMap<Place, Result<Sample, DataError>>,
    /// Next item to hand to the workers.
    next_item: u64,
    mixture: Arc<Mixture>,
    position: u64,
    failed: bool,
    stop: Arc<AtomicBool>,
    workers: Vec<JoinHandle<()>>,
}

impl std::fmt::Debug for Loader {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Loader").field("config", &self.config).field("position", &self.position).finish_non_exhaustive()
    }
}

/// What every worker knows.
struct Work {
    mixture: Arc<Mixture>,
    augment: AugmentConfig,
    options: SampleOptions,
    seed: u64,
}

impl Loader {
    /// Starts the workers. `start` is the number of batches that were handed out before, 0 for a new run.
    ///
    /// # Errors
    /// [`DataError::Config`] for zero sizes, augmentation without a meaning, a homogeneous mixture made for another batch size, and
    /// when a thread cannot be started.
    pub fn new(mixture: Arc<Mixture>, config: LoaderConfig, start: u64) -> Result<Self, DataError> {
        config.validate(&mixture)?;
        let (tasks, task_queue) = unbounded();
        let (outbox, results) = unbounded();
        let stop = Arc::new(AtomicBool::new(false));
        let options = SampleOptions { size: config.size, pose_mode: config.pose_mode };
        let work =
            Arc::new(Work { mixture: mixture.clone(), augment: config.augment.clone(), options, seed: config.seed });
        let next_item = start * config.batch_size as u64;
        let mut loader = Self {
            tasks: Some(tasks),
            results,
            early: BTreeMap::new(),
            next_item,
            mixture,
            position: start,
            failed: false,
            stop,
            workers: Vec::new(),
            config,
        };
        for i in 0..loader.config.workers {
            let (work, stop) = (work.clone(), loader.stop.clone());
            let (task_queue, outbox) = (task_queue.clone(), outbox.clone());
            let worker = std::thread::Builder::new()
                .name(format!("loader-{i}"))
                .spawn(move || work.run(&task_queue, &outbox, &stop))
                .map_err(|e| DataError::Config(format!("cannot start loader thread {i}: {e}")))?;
            loader.workers.push(worker);
        }
        loader.hand_out();
        Ok(loader)
    }

    /// Batches handed out so far, those before the start included: save this number and pass it to [`Loader::new`] to continue.
    pub fn position(&self) -> u64 {
        self.position
    }

    /// The next batch, of clips where the mixture is one of clips; waits until its last sample is ready.
    ///
    /// # Errors
    /// [`DataError::Frame`] for the first sample of this batch that cannot be loaded. The position stays, and every later call fails:
    /// a broken sample is never skipped or replaced.
    pub fn next_batch(&mut self) -> Result<SceneBatch, DataError> {
        if self.failed {
            return Err(DataError::Config(format!(
                "the loader stopped at batch {} because of an error",
                self.position
            )));
        }
        self.hand_out();
        let batch = self.collect().and_then(|samples| match self.mixture.has_clips() {
            true => assemble_clips(samples, self.clip_frames(), self.config.pad_views),
            false => assemble(samples, self.config.pad_views),
        });
        match batch {
            Ok(_) => self.position += 1,
            Err(_) => {
                self.failed = true;
                self.stop.store(true, Ordering::Relaxed);
            }
        }
        batch
    }

    /// Keeps the workers busy up to `prefetch` batches behind the one asked for next.
    fn hand_out(&mut self) {
        let end = (self.position + 1 + self.config.prefetch as u64) * self.config.batch_size as u64;
        if let Some(tasks) = &self.tasks {
            for item in self.next_item..end {
                for at in 0..self.mixture.item_frames(item) {
                    // Workers end only with the loader.
                    let _ = tasks.send((item, at));
                }
            }
        }
        self.next_item = self.next_item.max(end);
    }

    fn first_item(&self) -> u64 {
        self.position * self.config.batch_size as u64
    }

    /// Frames of each clip of the batch at `position`.
    fn clip_frames(&self) -> usize {
        self.mixture.item_frames(self.first_item())
    }

    /// The samples of the batch at `position`, in order.
    fn collect(&mut self) -> Result<Vec<Sample>, DataError> {
        let (first, frames) = (self.first_item(), self.clip_frames());
        let items = first..first + self.config.batch_size as u64;
        let mut samples = Vec::with_capacity(self.config.batch_size * frames);
        for place in items.flat_map(|item| (0..frames).map(move |at| (item, at))) {
            let loaded = loop {
                if let Some(loaded) = self.early.remove(&place) {
                    break loaded;
                }
                match self.results.recv() {
                    Ok((other, loaded)) => self.early.insert(other, loaded),
                    Err(_) => return Err(DataError::Config("all loader threads have ended".into())),
                };
            };
            samples.push(loaded?);
        }
        Ok(samples)
    }
}

impl Drop for Loader {
    fn drop(&mut self) {
        self.stop.store(true, Ordering::Relaxed);
        self.tasks = None;
        for worker in self.workers.drain(..) {
            // A panic was already turned into an error of its sample; there is nothing more to tell here.
            let _ = worker.join();
        }
    }
}

impl LoaderConfig {
    fn validate(&self, mixture: &Mixture) -> Result<(), DataError> {
        self.augment.validate()?;
        for (name, value) in [
            ("batch_size", self.batch_size),
            ("workers", self.workers),
            ("size.height", self.size.height as usize),
            ("size.width", self.size.width as usize),
        ] {
            if value == 0 {
                return Err(DataError::Config(format!("loader.{name} must be at least 1")));
            }
        }
        if mixture.block_len() != 1 && mixture.block_len() != self.batch_size as u64 {
            let (made, asked) = (mixture.block_len(), self.batch_size);
            return Err(DataError::Config(format!("a homogeneous mixture for batches of {made} cannot fill {asked}")));
        }
        if let PadViews::To(views) = self.pad_views
            && views < mixture.max_views()
        {
            let most = mixture.max_views();
            return Err(DataError::Config(format!("loader.pad_views is {views}, but a frame has {most} views")));
        }
        Ok(())
    }
}

impl Work {
    fn run(&self, tasks: &Receiver<Place>, outbox: &Sender<Loaded>, stop: &AtomicBool) {
        for place in tasks {
            if stop.load(Ordering::Relaxed) {
                return;
            }
            // A worker that died would leave its batch waiting for ever, so a panic becomes the error of its sample.
            let loaded = catch_unwind(AssertUnwindSafe(|| self.load(place)));
            let loaded = loaded.unwrap_or_else(|panic| Err(self.panicked(place, panic.as_ref())));
            if outbox.send((place, loaded)).is_err() {
                return;
            }
        }
    }

    /// The frames of a clip are changed alike: the changes follow from the item's number.
    fn load(&self, (item, at): Place) -> Result<Sample, DataError> {
        let (number, dataset, index) = self.mixture.item_frame(item, at)?;
        let mut sample = load_sample(dataset, number, index, &self.options)?;
        self.augment.apply(&mut sample, self.seed, item);
        Ok(sample)
    }

    fn panicked(&self, (item, at): Place, panic: &(dyn std::any::Any + Send)) -> DataError {
        let text = panic.downcast_ref::<String>().map(String::as_str);
        let why = text.or_else(|| panic.downcast_ref::<&str>().copied()).unwrap_or("no message");
        let frame = self.mixture.item_frame(item, at).map(|(number, _, index)| (number, index));
        let (dataset, index) = frame.unwrap_or_else(|_| self.mixture.item(item));
        in_frame(&nameless(dataset, index), DataError::Config(format!("the loader thread panicked: {why}")))
    }
}

/// A name for a frame whose rows could not be read.
fn nameless(dataset: usize, index: usize) -> FrameId {
    FrameId { dataset: format!("dataset {dataset}"), scene: "an unknown scene".into(), frame: format!("index {index}") }
}

/// One frame with its pixels; errors name the frame, or the dataset's number and the index where the frame's rows are broken.
pub(crate) fn load_sample(
    dataset: &dyn SceneDataset,
    number: usize,
    index: usize,
    options: &SampleOptions,
) -> Result<Sample, DataError> {
    let frame = dataset.frame(index).map_err(|e| in_frame(&nameless(number, index), e))?;
    Sample::load(&frame, options)
}
