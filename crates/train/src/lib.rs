//! Device, run directory, step loop, optimizers, schedules, checkpoints, logs.
//!
//! The crate knows only the [`Task`] trait: what is trained, on which data and with which losses is the caller's. The
//! caller hands [`train`] a task and a function that opens its [`BatchSource`] at a position; the loop owns pacing,
//! logs, validation, checkpoints and interruption. A run that was stopped at any moment continues bit for bit on a
//! deterministic backend, because parameters, optimizer moments, moving averages and the position in the data are in
//! the checkpoint and all randomness is a function of (seed, purpose, step), see [`stream`].

mod accumulate;
mod checkpoint;
mod checkpoint_store;
mod device;
mod ema;
mod error;
mod files;
mod git;
mod guard;
mod interrupt;
mod lanes;
mod metrics;
mod norm;
mod optimizer;
mod params;
mod progress;
mod random;
mod run_dir;
mod schedule;
mod task;
mod tensorboard;
mod train_loop;
mod update;
mod weights;

pub use accumulate::GradientMean;
pub use checkpoint::{Best, CheckpointReader, CheckpointState, CheckpointWriter};
pub use checkpoint_store::{CheckpointStore, find_checkpoint};
pub use device::DeviceConfig;
pub use ema::{Ema, EmaConfig};
pub use error::TrainError;
pub use files::{fingerprint, replace_file};
pub use git::head_commit;
pub use guard::{GuardVerdict, NonFiniteGuard};
pub use interrupt::Interrupt;
pub use lanes::in_lanes;
pub use metrics::{MetricsLog, MetricsRow};
pub use norm::{GradientNorm, clip_global_norm, global_norm, scale_gradients};
pub use optimizer::{AdamW, DecayScope, OptimizerConfig};
pub use params::{
    NamedTensor, NamedTensors, ParamInfo, count_parameters, list_parameters, map_parameters, named_parameters,
};
pub use random::stream;
pub use run_dir::{OnExisting, RunDir};
pub use schedule::{Schedule, ScheduleShape};
pub use task::{BatchSource, ScalarValue, Scalars, StepContext, StepOutput, Task};
pub use tensorboard::EventWriter;
pub use train_loop::{BestRule, Goal, Outcome, RunSetup, TrainConfig, train};
pub use update::{GradientClip, Optimizer, Update};
pub use weights::{Keep, WeightDiff, load_named, read_config_text, save_named};
