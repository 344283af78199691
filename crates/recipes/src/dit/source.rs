//! Where training samples and held-out ones come from: stored latents, or pictures that are encoded when asked for.

use std::sync::Arc;

use anyhow::ensure;
use data::latents::{Latent, LatentDataset};
use data::layout::{Layout, LayoutClasses};
use data::{FrameId, LoaderConfig, Mixture, MixtureConfig, Sample, SceneBatch, SceneDataset, SceneFrame, assemble};
use rayon::prelude::*;
use train::{BatchSource, TrainError};

use crate::LoaderSource;
use crate::bev_vae::spread;
use crate::latents::FrozenVae;

/// One sample of a batch.
#[derive(Debug, Clone)]
pub struct LatentItem {
    /// Where it comes from.
    pub id: FrameId,
    /// Number of the draw: in training that of the item in the run. With the id and the seed it gives all random numbers of the sample.
    pub draw: u64,
    /// The posterior; `None` where the batch brings pictures.
    pub latent: Option<Latent>,
    /// What steers it.
    pub layout: Layout,
}

/// What a step learns from.
#[derive(Debug, Clone)]
pub struct LatentBatch {
    /// B samples.
    pub items: Vec<LatentItem>,
    /// Their pictures, where latents are made at every step.
    pub pictures: Option<SceneBatch>,
}

impl LatentItem {
    fn new(frame: &SceneFrame, draw: u64, latent: Option<Latent>, classes: &LayoutClasses) -> anyhow::Result<Self> {
        ensure!(
            frame.boxes.is_some(),
            "frame {} of {} in {} has no annotation; train on an annotated split",
            frame.id.frame,
            frame.id.scene,
            frame.id.dataset
        );
        Ok(Self { id: frame.id.clone(), draw, latent, layout: Layout::of_frame(frame, classes) })
    }

    /// The name of its frame in random streams.
    pub fn token(&self) -> String {
        let FrameId { dataset, scene, frame } = &self.id;
        format!("{dataset}/{scene}/{frame}")
    }
}

/// Training samples of a run, as an endless list that begins anywhere.
pub struct TrainingData {
    mixture: Arc<Mixture>,
    /// The datasets of the mixture where their latents are stored.
    stored: Option<Vec<Arc<dyn LatentDataset>>>,
    datasets: Vec<Arc<dyn SceneDataset>>,
    loader: LoaderConfig,
    classes: LayoutClasses,
}

impl TrainingData {
    /// Samples whose latents are stored.
    ///
    /// # Errors
    /// Datasets that cannot be mixed.
    pub fn stored(
        parts: Vec<Arc<dyn LatentDataset>>,
        (mixture, loader): (&MixtureConfig, LoaderConfig),
        classes: &LayoutClasses,
    ) -> anyhow::Result<Self> {
        let datasets = parts.iter().map(|part| part.clone() as Arc<dyn SceneDataset>).collect();
        Ok(Self { stored: Some(parts), ..Self::pictures(datasets, (mixture, loader), classes)? })
    }

    /// Samples whose pictures are encoded at every step.
    ///
    /// # Errors
    /// Datasets that cannot be mixed.
    pub fn pictures(
        datasets: Vec<Arc<dyn SceneDataset>>,
        (mixture, loader): (&MixtureConfig, LoaderConfig),
        classes: &LayoutClasses,
    ) -> anyhow::Result<Self> {
        let mixture = Arc::new(Mixture::new(datasets.clone(), mixture, loader.batch_size, loader.seed)?);
        Ok(Self { mixture, stored: None, datasets, loader, classes: classes.clone() })
    }

    /// The list from a position on, counted in batches.
    ///
    /// # Errors
    /// A loader that cannot start.
    pub fn open(&self, position: u64) -> Result<OpenedSource<'_>, TrainError> {
        let pictures = match &self.stored {
            Some(_) => None,
            None => Some(LoaderSource::open(self.mixture.clone(), self.loader.clone(), position)?),
        };
        Ok(OpenedSource { data: self, position, pictures })
    }

    /// Item `k` of the run, without pictures.
    fn item(&self, k: u64) -> anyhow::Result<LatentItem> {
        let (number, index) = self.mixture.item(k);
        let none = || anyhow::anyhow!("there is no dataset {number}");
        let frame = self.datasets.get(number).ok_or_else(none)?.frame(index)?;
        let latent = match &self.stored {
            Some(parts) => Some(parts.get(number).ok_or_else(none)?.latent(index)?),
            None => None,
        };
        LatentItem::new(&frame, k, latent, &self.classes)
    }
}

/// Training samples from a position on.
pub struct OpenedSource<'a> {
    data: &'a TrainingData,
    position: u64,
    pictures: Option<LoaderSource>,
}

impl BatchSource for OpenedSource<'_> {
    type Batch = LatentBatch;

    fn next(&mut self) -> Result<LatentBatch, TrainError> {
        let size = self.data.loader.batch_size as u64;
        let first = self.position * size;
        let items: anyhow::Result<Vec<LatentItem>> =
            (first..first + size).into_par_iter().map(|k| self.data.item(k)).collect();
        let items = items.map_err(TrainError::task)?;
        let pictures = self.pictures.as_mut().map(BatchSource::next).transpose()?;
        self.position += 1;
        Ok(LatentBatch { items, pictures })
    }

    fn position(&self) -> u64 {
        self.position
    }
}

/// Held-out samples.
pub enum HeldOut {
    /// With stored latents.
    Stored(Vec<Arc<dyn LatentDataset>>),
    /// With pictures.
    Pictures(Vec<Arc<dyn SceneDataset>>),
}

impl HeldOut {
    fn datasets(&self) -> Vec<Arc<dyn SceneDataset>> {
        match self {
            Self::Stored(parts) => parts.iter().map(|part| part.clone() as Arc<dyn SceneDataset>).collect(),
            Self::Pictures(datasets) => datasets.clone(),
        }
    }

    /// `count` samples with their latents, spread evenly over all datasets; all for 0. The draw is the sample's number.
    ///
    /// # Errors
    /// Whatever a frame reports; frames without annotation.
    pub fn items(&self, count: usize, vae: &FrozenVae, classes: &LayoutClasses) -> anyhow::Result<Vec<LatentItem>> {
        let datasets = self.datasets();
        let total = datasets.iter().map(|dataset| dataset.len()).sum();
        let chosen = spread(total, count);
        ensure!(!chosen.is_empty(), "there is no held-out sample");
        chosen.iter().enumerate().map(|(draw, at)| self.item(&datasets, *at, (draw as u64, vae, classes))).collect()
    }

    fn item(
        &self,
        datasets: &[Arc<dyn SceneDataset>],
        at: usize,
        (draw, vae, classes): (u64, &FrozenVae, &LayoutClasses),
    ) -> anyhow::Result<LatentItem> {
        let mut index = at;
        for (number, dataset) in datasets.iter().enumerate() {
            if index >= dataset.len() {
                index -= dataset.len();
                continue;
            }
            let frame = dataset.frame(index)?;
            let latent = match self {
                Self::Stored(parts) => parts.get(number).map(|part| part.latent(index)).transpose()?,
                Self::Pictures(_) => {
                    let sample = Sample::load(&frame, &vae.sample_options())?;
                    vae.encode(&assemble(vec![sample], data::PadViews::Largest)?).latents().pop()
                }
            };
            return LatentItem::new(&frame, draw, latent, classes);
        }
        anyhow::bail!("there is no held-out sample {at}")
    }
}
