//! What a run of `train-vae` will take, before it starts: memory and time from the sizes alone.
//!
//! Counted are the numbers that the tape keeps, stage by stage, and the products of matrices; constants were fitted to measured runs
//! (`benches/RESULTS.md`). Good to about a third, which is enough to tell a run that fits from one that does not.
//!
//! Letters: T tokens of all views, E image channels, Q voxels, C scene channels, S sample points, N BEV tokens, D their width.

use std::fmt::{self, Display};

use burn::module::Module;
use burn::tensor::Device;
use nn::Init;
use vae::{BevVae, BevVaeConfig, Discriminator};

use super::{Adversarial, Experiment};

/// Levels of both pyramids.
const LEVELS: f64 = 3.0;
/// Numbers per token and channel that a transformer block leaves on the tape.
const KEPT_PER_CHANNEL: f64 = 18.0;
/// The same of a deformable block.
const KEPT_PER_POINT: f64 = 16.0;
/// Numbers per pixel that VGG-16 leaves on the tape, and its operations per pixel.
const VGG_KEPT: f64 = 540.0;
const VGG_OPERATIONS: f64 = 616e3;
/// Program, worlds of procedural data, buffers of the allocator.
const BASE_BYTES: f64 = 150e6;

/// A stage of equal blocks.
#[derive(Debug, Clone, Copy)]
struct Stage {
    blocks: f64,
    /// Numbers that one block leaves on the tape.
    kept: f64,
    /// Numbers that enter it.
    input: f64,
    /// Operations of one block, forward.
    operations: f64,
}

/// How a run walks over its data.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Walk {
    /// Samples of a micro batch.
    pub batch: usize,
    /// Views of the largest sample.
    pub views: usize,
    /// Micro batches of a step.
    pub accumulate: usize,
    /// Micro batches side by side.
    pub lanes: usize,
    /// Whether blocks are computed again instead of being kept.
    pub checkpointing: bool,
    /// Steps of the run.
    pub steps: u64,
    /// Batches that wait in memory.
    pub prefetch: usize,
}

/// Bytes and operations of a run.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Budget {
    /// Weights, gradients, optimizer, averages.
    pub weights: f64,
    /// What all lanes keep for the way back.
    pub activations: f64,
    /// Prepared batches.
    pub data: f64,
    /// Floating-point operations of the whole run.
    pub operations: f64,
}

impl Walk {
    /// Of an experiment whose largest rig has so many cameras.
    pub fn of(experiment: &Experiment, views: usize) -> Self {
        let loader = &experiment.data.loader;
        let views = match loader.pad_views {
            data::PadViews::Largest => views,
            data::PadViews::To(views) => views,
        };
        let accumulate = experiment.train.accumulate.max(1);
        Self {
            batch: loader.batch_size,
            views,
            accumulate,
            lanes: experiment.device.lanes().min(accumulate),
            checkpointing: experiment.checkpointing,
            steps: experiment.train.steps,
            prefetch: loader.prefetch,
        }
    }
}

impl Budget {
    /// Of an experiment that walks so.
    pub fn of(experiment: &Experiment, walk: Walk) -> Self {
        let config = &experiment.model.config;
        let samples = (walk.batch * walk.views) as f64;
        let pixels = (config.image.height * config.image.width) as f64;
        let stages = stages(config, walk.batch as f64, samples);
        let kept: f64 = if walk.checkpointing {
            let inputs: f64 = stages.iter().map(|stage| stage.blocks * stage.input).sum();
            inputs + stages.iter().map(|stage| stage.kept).fold(0.0, f64::max)
        } else {
            stages.iter().map(|stage| stage.blocks * stage.kept).sum()
        };
        let losses = LossCost::of(experiment, samples, pixels);
        let per_lane = kept + losses.kept + 6.0 * 3.0 * samples * pixels;
        let forward: f64 = stages.iter().map(|stage| stage.blocks * stage.operations).sum();
        let passes = if walk.checkpointing { 4.0 } else { 3.0 };
        let micro_batches = walk.steps as f64 * walk.accumulate as f64;
        let lanes = walk.lanes as f64;
        let generator = parameters(config) as f64;
        Self {
            // Weights, averages, two moments, the step's sum of gradients, one more set per lane.
            weights: 4.0 * (generator * (5.0 + lanes) + losses.parameters * (4.0 + lanes)),
            activations: 4.0 * lanes * per_lane,
            data: 4.0 * 2.0 * 3.0 * samples * pixels * (walk.prefetch + walk.accumulate) as f64,
            operations: micro_batches * (passes * forward + losses.operations),
        }
    }

    /// All bytes.
    pub fn bytes(&self) -> f64 {
        BASE_BYTES + self.weights + self.activations + self.data
    }
}

impl Display for Budget {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(
            f,
            "about {} of memory (weights and optimizers {}, kept for the way back {}, batches {})",
            gigabytes(self.bytes()),
            gigabytes(self.weights),
            gigabytes(self.activations),
            gigabytes(self.data)
        )
    }
}

fn gigabytes(bytes: f64) -> String {
    if bytes < 1e8 { format!("{:.0} MB", bytes / 1e6) } else { format!("{:.1} GB", bytes / 1e9) }
}

/// Numbers of the network's parameters; they are not drawn.
fn parameters(config: &BevVaeConfig) -> usize {
    BevVae::new(config, &mut Init::lazy(0, &Device::flex())).num_params()
}

/// `batch` samples with `views` views in all.
fn stages(config: &BevVaeConfig, batch: f64, views: f64) -> Vec<Stage> {
    let (image, scene) = (&config.image, &config.scene);
    let [rows, columns] = config.image_tokens().map(|side| side as f64);
    let (pixels, e, c) = (rows * columns, image.channels as f64, scene.channels as f64);
    let tokens = views * pixels;
    let rotary = |tokens: f64, length: f64, width: f64, blocks: usize| Stage {
        blocks: blocks as f64,
        kept: KEPT_PER_CHANNEL * width * tokens,
        input: width * tokens,
        operations: tokens * (24.0 * width * width + 4.0 * length * width),
    };
    let deformable = |points: f64, samples: f64, axes: f64, values: f64, blocks: usize| Stage {
        blocks: blocks as f64,
        kept: points * (KEPT_PER_POINT * c + (axes + 2.0) * samples) + values * c,
        input: points * c,
        operations: points * (2.0 * c * ((axes + 1.0) * samples + c) + 16.0 * c * c),
    };
    let head = |pixels: f64, width: f64, taps: f64| pixels * 2.0 * (width * c + taps * c * c);
    let image_pyramid = Stage {
        blocks: 1.0,
        kept: tokens * (4.0 * e + 8.0 * e + 64.0 * c + 4.0 * e + 16.0 * c + 2.0 * e + 4.0 * c),
        input: tokens * e,
        operations: tokens * (4.0 * e * e + 4.0 * e * e + 4.0 * e * e)
            + head(16.0 * tokens, e / 4.0, 9.0)
            + head(4.0 * tokens, e / 2.0, 9.0)
            + head(tokens, e, 9.0),
    };
    let cells = batch * config.grid.cells.iter().map(|cells| *cells as f64).product::<f64>();
    let scene_pyramid =
        Stage { blocks: 1.0, kept: 8.0 * cells * c, input: cells * c, operations: cells * 2.0 * c * c * 36.0 };
    let [state_rows, state_columns] = config.state_tokens().map(|side| side as f64);
    let length = state_rows * state_columns;
    let state = rotary(batch * length, length, config.state_channels() as f64, 2 * config.state.blocks);
    let samples = |points: usize| scene.heads as f64 * LEVELS * points as f64;
    let rays = views * pixels * config.frustum.depths as f64;
    vec![
        rotary(tokens, pixels, e, image.encoder_blocks + image.decoder_blocks),
        image_pyramid,
        deformable(cells, samples(scene.encoder_points), 2.0, 21.0 * tokens, scene.encoder_blocks),
        state,
        scene_pyramid,
        deformable(rays, samples(scene.decoder_points), 3.0, 1.2 * cells, scene.decoder_blocks),
    ]
}

/// What the losses add to each micro batch.
#[derive(Debug, Clone, Copy, Default)]
struct LossCost {
    kept: f64,
    operations: f64,
    /// Of the discriminator.
    parameters: f64,
}

impl LossCost {
    fn of(experiment: &Experiment, views: f64, pixels: f64) -> Self {
        let looked_at =
            |views_per_step: usize| if views_per_step == 0 { views } else { views.min(views_per_step as f64) };
        let mut cost = Self::default();
        let perceptual = &experiment.loss.perceptual;
        if perceptual.weights.is_some() {
            let numbers = looked_at(perceptual.views) * pixels;
            cost.kept += VGG_KEPT * numbers;
            // The target forward, the painted pictures forward and to their gradient.
            cost.operations += 3.0 * VGG_OPERATIONS * numbers;
        }
        if let Adversarial::Hinge(hinge) = &experiment.loss.adversarial {
            let channels =
                if hinge.channels == 0 { experiment.model.preset.discriminator_channels() } else { hinge.channels };
            let numbers = 2.0 * looked_at(hinge.views) * pixels * channels as f64;
            cost.kept += 10.0 * numbers;
            cost.operations += 3.0 * 2.0 * 18.0 * 4.0 * numbers * channels as f64;
            let image = &experiment.model.config.image;
            let network = Discriminator::new(image.height, image.width, channels, &mut Init::lazy(0, &Device::flex()));
            cost.parameters = network.map_or(0.0, |network| network.num_params() as f64);
        }
        cost
    }
}

/// Why a run cannot fit, and what would.
pub fn refusal(experiment: &Experiment, walk: Walk, free: f64) -> Option<String> {
    let budget = Budget::of(experiment, walk);
    if budget.bytes() <= free {
        return None;
    }
    let mut lines = vec![format!("the run needs {budget}, but {} are free", gigabytes(free))];
    let one = Walk { batch: 1, ..walk };
    let again = Walk { checkpointing: true, ..walk };
    let changes = [
        ("--set checkpointing=true", again),
        ("--set data.loader.batch_size=1 (and as much more train.accumulate)", one),
        ("both of them", Walk { checkpointing: true, ..one }),
        ("both, and train.accumulate=1", Walk { checkpointing: true, accumulate: 1, lanes: 1, ..one }),
    ];
    for (what, changed) in changes.into_iter().filter(|(_, changed)| *changed != walk) {
        let bytes = Budget::of(experiment, changed).bytes();
        let verdict = if bytes <= free { "fits" } else { "still too much" };
        lines.push(format!("  {what}: {}, {verdict}", gigabytes(bytes)));
    }
    lines.push("  a smaller model.preset (`rigscape info` lists them); --ignore-memory starts all the same".to_owned());
    Some(lines.join("\n"))
}

#[cfg(test)]
mod tests {
    use super::super::machine::duration;
    use super::*;
    use crate::config_file;

    fn experiment(model: &str, rest: &str) -> Experiment {
        let data = "[data]\ntrain = []\nvalidation = []\n";
        config_file::parse(&format!("seed = 1\n{rest}\n[run]\nname = \"r\"\n[model]\n{model}\n{data}"), &[]).unwrap()
    }

    #[test]
    fn the_toy_run_is_estimated_near_what_was_measured() {
        let text = include_str!("../../../../configs/toy/vae.toml");
        let toy: Experiment = config_file::parse(text, &[]).unwrap();
        let walk = Walk { lanes: 2, ..Walk::of(&toy, 7) };
        // 0.55 GB were measured (benches/RESULTS.md).
        let bytes = Budget::of(&toy, walk).bytes();
        assert!((0.35e9..0.85e9).contains(&bytes), "{bytes:e}");
    }

    #[test]
    fn checkpointing_and_smaller_batches_take_less() {
        let paper = experiment("preset = \"paper\"", "");
        let walk = Walk { batch: 2, ..Walk::of(&paper, 6) };
        let bytes = |walk| Budget::of(&paper, walk).bytes();
        let (whole, again) = (bytes(walk), bytes(Walk { checkpointing: true, ..walk }));
        assert!(again < 0.5 * whole, "{again:e} of {whole:e}");
        assert!(bytes(Walk { batch: 1, ..walk }) < whole);
        // Weights, gradients, moments and averages of 262.8 M parameters alone.
        assert!(bytes(Walk { batch: 1, checkpointing: true, ..walk }) > 6.0 * 4.0 * 262.8e6);
        let (one, two) = (Budget::of(&paper, walk), Budget::of(&paper, Walk { steps: 2 * walk.steps, ..walk }));
        assert!((two.operations / one.operations - 2.0).abs() < 1e-9);
        assert!(duration(one.operations, 1e11).ends_with("days"));
    }

    #[test]
    fn a_refusal_says_what_would_fit() {
        let paper = experiment("preset = \"paper\"", "");
        let walk = Walk::of(&paper, 6);
        assert_eq!(refusal(&paper, walk, 1e15), None);
        let text = refusal(&paper, walk, 20e9).unwrap();
        assert!(text.contains("20.0 GB are free") && text.contains("checkpointing=true"), "{text}");
        let hopeless = refusal(&paper, walk, 1e9).unwrap();
        assert!(!hopeless.contains("fits") && hopeless.contains("--ignore-memory"), "{hopeless}");
    }
}
