//! Held-out measurements: errors of the network's answers, and what sampled layouts are worth.

use std::path::Path;

use anyhow::Context;
use burn::tensor::Tensor;
use data::layout::Layout;
use data::{PadViews, ViewArrays};
use dit::Dit;
use geometry::CameraRig;
use metrics::{MetricError, Moments, frechet_distance};
use serde::Serialize;

use super::locality::{EditScores, edit_locality};
use super::preview::draw_pages;
use super::sample::LatentSampler;
use super::step::{Frozen, Problem};
use super::{DitExperiment, Guidance, HeldOut, LatentBatch, LatentItem, NoiseKey};

/// Samples that the network takes at once.
const CHUNK: usize = 16;
/// Cells along each side of a picture whose mean colours are its features.
const COLOUR_CELLS: usize = 4;
/// Apart from the seed of training, so that no noise of it is met again.
const HELD_OUT: u64 = 0x6865_6c64;

/// Mean squared error of the network's answer over held-out samples, always at the same instants with the same noise.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct DitScores {
    /// Each sample with its own layout.
    pub loss: f64,
    /// Without a layout.
    pub loss_no_layout: f64,
    /// With the layout of another sample.
    pub loss_other_layout: f64,
    /// Of an answer that is 0 everywhere.
    pub loss_of_zero: f64,
    /// Samples measured.
    pub samples: usize,
}

/// How far sampled scenes are from held-out ones: Fréchet distance of the mean colours of 4x4 cells of the pictures of one rig.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct GeneratedScores {
    /// Guidance 0: no layout.
    pub distance_unconditional: f64,
    /// Guidance 1: the layouts of the held-out samples.
    pub distance_conditional: f64,
    /// The guidance of the config.
    pub distance_guided: f64,
    /// That guidance.
    pub guidance_scale: f64,
    /// Mean absolute difference of two pictures of equal noise under two layouts at guidance 0: 0, since it ignores them.
    pub guidance_zero_difference: f64,
    /// The same at the guidance of the config.
    pub guided_difference: f64,
    /// Layouts sampled.
    pub layouts: usize,
}

/// Held-out samples.
pub struct DitEvaluator {
    data: HeldOut,
    rig: CameraRig,
    seed: u64,
}

impl DitEvaluator {
    /// Pictures are decoded for `rig`.
    pub fn new(data: HeldOut, rig: CameraRig, seed: u64) -> Self {
        Self { data, rig, seed }
    }

    fn items(&self, frozen: &Frozen, count: usize) -> anyhow::Result<Vec<LatentItem>> {
        let items = self.data.items(count, &frozen.vae, &frozen.conditioner.classes);
        items.context("reading held-out samples")
    }

    /// Errors on `count` samples (0 for all).
    ///
    /// # Errors
    /// Whatever a sample reports.
    pub(crate) fn scores(&self, frozen: &Frozen, network: &Dit, count: usize) -> anyhow::Result<DitScores> {
        let items = self.items(frozen, count)?;
        let samples = items.len();
        let mut sums = [0.0; 4];
        for (number, chunk) in items.chunks(CHUNK).enumerate() {
            // Instants are spread evenly over the process, in an order in which neighbours lie far apart.
            let instant = |at: usize| frozen.noising.at(spread_place(number * CHUNK + at));
            let instants = (0..chunk.len()).map(instant).collect();
            let batch = LatentBatch { items: chunk.to_vec(), pictures: None };
            let mut problem = frozen.problem(&batch, self.seed ^ HELD_OUT, instants)?;
            let measured =
                |answer: Tensor<4>, problem: &Problem| frozen.errors(answer, problem).sum().into_scalar::<f32>();
            let zero = Tensor::zeros(problem.wanted.dims(), &frozen.device);
            sums[3] += f64::from(measured(zero, &problem));
            sums[0] += f64::from(measured(frozen.answer(network, &problem), &problem));
            problem.strength = vec![0.0; chunk.len()];
            sums[1] += f64::from(measured(frozen.answer(network, &problem), &problem));
            problem.strength = vec![1.0; chunk.len()];
            let other = |at: usize| &items[(number * CHUNK + at + 1) % samples].layout;
            let others: Vec<&Layout> = (0..chunk.len()).map(other).collect();
            problem.occupancy = frozen.conditioner.occupancy(&others, &frozen.device)?;
            sums[2] += f64::from(measured(frozen.answer(network, &problem), &problem));
        }
        let [loss, loss_no_layout, loss_other_layout, loss_of_zero] = sums.map(|sum| sum / samples as f64);
        Ok(DitScores { loss, loss_no_layout, loss_other_layout, loss_of_zero, samples })
    }

    /// Samples held-out layouts without, with plain and with the config's guidance.
    ///
    /// # Errors
    /// Whatever a sample reports, cameras that cannot be used.
    pub(crate) fn generated(
        &self,
        frozen: &Frozen,
        sampler: &LatentSampler,
        experiment: &DitExperiment,
    ) -> anyhow::Result<GeneratedScores> {
        let items = self.items(frozen, experiment.evaluation.generated)?;
        let best = experiment.sampling.guidance;
        let guidances = [best.with_scale(0.0), best.with_scale(1.0), best];
        let mut truth = Moments::new(3 * COLOUR_CELLS * COLOUR_CELLS);
        let mut made = guidances.map(|_| truth.clone());
        let [mut ignored, mut guided] = [f64::NAN; 2];
        for (number, chunk) in items.chunks(CHUNK).enumerate() {
            let painter = Painter::new(self, (frozen, sampler, experiment), chunk)?;
            add_colours(&mut truth, &painter.truth()?, frozen)?;
            let own: Vec<&Layout> = chunk.iter().map(|item| &item.layout).collect();
            for (guidance, moments) in guidances.iter().zip(&mut made) {
                add_colours(moments, &painter.paint(&own, *guidance)?, frozen)?;
            }
            if number == 0 {
                ignored = painter.change_by_layout(&own, guidances[0])?;
                guided = painter.change_by_layout(&own, guidances[2])?;
            }
        }
        let truth = truth.statistics("decoded held-out latents")?;
        let distance = |moments: Moments| Ok(frechet_distance(&truth, &moments.statistics("samples")?)?.value);
        let [unconditional, conditional, at_best]: [Result<f64, MetricError>; 3] = made.map(distance);
        Ok(GeneratedScores {
            distance_unconditional: unconditional?,
            distance_conditional: conditional?,
            distance_guided: at_best?,
            guidance_scale: best.scale(),
            guidance_zero_difference: ignored,
            guided_difference: guided,
            layouts: items.len(),
        })
    }

    /// Removes one box from each of some held-out layouts.
    ///
    /// # Errors
    /// Whatever a sample reports, cameras that cannot be used.
    pub(crate) fn edits(
        &self,
        frozen: &Frozen,
        sampler: &LatentSampler,
        experiment: &DitExperiment,
    ) -> anyhow::Result<Option<EditScores>> {
        // Not every held-out layout has a box that a camera sees well.
        let items = self.items(frozen, 4 * experiment.evaluation.edits.max(1))?;
        edit_locality((frozen, sampler, experiment), &items, &self.rig, self.seed)
    }

    /// Pages of held-out layouts, decoded for the preview's rig.
    ///
    /// # Errors
    /// Whatever a sample reports, or a file.
    pub(crate) fn pages(
        &self,
        frozen: &Frozen,
        sampler: &LatentSampler,
        experiment: &DitExperiment,
        folder: &Path,
    ) -> anyhow::Result<()> {
        if experiment.preview.frames == 0 {
            return Ok(());
        }
        let items = self.items(frozen, experiment.preview.frames)?;
        draw_pages((frozen, sampler, experiment), &items, (&self.rig, &self.keys(&items)), folder)
    }

    fn keys(&self, items: &[LatentItem]) -> Vec<NoiseKey> {
        let key = |item: &LatentItem| NoiseKey { seed: self.seed ^ HELD_OUT, token: item.token(), draw: 0 };
        items.iter().map(key).collect()
    }
}

/// Some held-out samples, their noise and the cameras that look at them.
struct Painter<'a> {
    frozen: &'a Frozen,
    sampler: &'a LatentSampler<'a>,
    experiment: &'a DitExperiment,
    batch: LatentBatch,
    keys: Vec<NoiseKey>,
    cameras: ViewArrays,
    seed: u64,
}

impl<'a> Painter<'a> {
    fn new(
        evaluator: &DitEvaluator,
        (frozen, sampler, experiment): (&'a Frozen, &'a LatentSampler<'a>, &'a DitExperiment),
        items: &[LatentItem],
    ) -> anyhow::Result<Self> {
        let rigs = vec![evaluator.rig.clone(); items.len()];
        Ok(Self {
            frozen,
            sampler,
            experiment,
            batch: LatentBatch { items: items.to_vec(), pictures: None },
            keys: evaluator.keys(items),
            cameras: ViewArrays::cameras(&rigs, frozen.vae.image_size(), PadViews::Largest)?,
            seed: evaluator.seed ^ HELD_OUT,
        })
    }

    /// Pictures of the samples' own latents.
    fn truth(&self) -> anyhow::Result<Vec<Vec<f32>>> {
        let latents = self.frozen.scaling.unscaled(self.frozen.clean(&self.batch, self.seed)?);
        Ok(self.frozen.vae.decode(latents, &self.cameras))
    }

    /// Pictures of layouts.
    fn paint(&self, layouts: &[&Layout], guidance: Guidance) -> anyhow::Result<Vec<Vec<f32>>> {
        let latents = self.sampler.sample(layouts, &self.keys, &self.experiment.preview_sampler(), guidance)?;
        Ok(self.frozen.vae.decode(latents, &self.cameras))
    }

    /// Mean absolute difference of pictures of equal noise when every sample gets the layout of another.
    fn change_by_layout(&self, own: &[&Layout], guidance: Guidance) -> anyhow::Result<f64> {
        let others: Vec<&Layout> = own.iter().cycle().skip(1).take(own.len()).copied().collect();
        Ok(difference(&self.paint(own, guidance)?, &self.paint(&others, guidance)?))
    }
}

/// Van der Corput's sequence: any first numbers of it lie evenly in 0..1.
fn spread_place(number: usize) -> f64 {
    (number as u64).reverse_bits() as f64 / 2f64.powi(64) + 1.0 / 4096.0
}

fn add_colours(moments: &mut Moments, pictures: &[Vec<f32>], frozen: &Frozen) -> anyhow::Result<()> {
    let size = frozen.vae.image_size();
    let (height, width) = (size.height as usize, size.width as usize);
    let mut rows = Vec::with_capacity(pictures.len() * 3 * COLOUR_CELLS * COLOUR_CELLS);
    for plane in pictures.iter().flat_map(|picture| picture.chunks_exact(height * width)) {
        let mut cells = [0.0; COLOUR_CELLS * COLOUR_CELLS];
        let mut counts = cells;
        for (at, value) in plane.iter().enumerate() {
            let (y, x) = (at / width * COLOUR_CELLS / height, at % width * COLOUR_CELLS / width);
            cells[y * COLOUR_CELLS + x] += value;
            counts[y * COLOUR_CELLS + x] += 1.0;
        }
        rows.extend(cells.iter().zip(counts).map(|(sum, count)| sum / count));
    }
    Ok(moments.update(&rows)?)
}

/// Mean absolute difference of equally many pictures.
fn difference(a: &[Vec<f32>], b: &[Vec<f32>]) -> f64 {
    let pairs = a.iter().flatten().zip(b.iter().flatten());
    let (sum, count) = pairs.fold((0.0, 0u64), |(sum, count), (a, b)| (sum + f64::from((a - b).abs()), count + 1));
    sum / count.max(1) as f64
}
