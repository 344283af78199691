//! Low-rank adapters (LoRA): small trained matrices beside frozen weights.
//!
//! Paper: Hu et al., "LoRA: Low-Rank Adaptation of Large Language Models", section 4.1. `y = W x + alpha / rank · B (A
//! x)`, two thin products per step; the dense `B A` is made only by [`merge`]. burn's own adapters make the dense
//! product at every use, know rank-2 weights only, and cannot be taken off or joined by others, so the layers of this
//! crate carry [`Adapters`] of their own.
//!
//! A model opts in with one line of [`lora_sites!`](crate::lora_sites) per struct. Parity: `tests/it/lora_golden.rs`.

mod adapters;
mod error;
mod file;
mod keys;
mod pattern;
mod settings;
mod sites;

use std::collections::BTreeSet;

use burn::module::{Module, ModuleMapper, Param, ParamId};
use burn::tensor::Tensor;
use serde::{Deserialize, Serialize};

use crate::Init;

pub use adapters::{Adapters, LowRank};
pub use error::LoraError;
pub use file::{LoraLayout, load, save};
pub use pattern::names_layer;
pub use sites::{LoraSites, Site, SiteWeight, joined_path};

/// Size and place of a new adapter.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct LoraConfig {
    /// Inner width, at least 1.
    pub rank: usize,
    /// The adapter's output is multiplied by alpha / rank. Files of some tools carry no alpha; readers then take alpha
    /// = rank.
    pub alpha: f64,
    /// Patterns of the layers to adapt, as [`names_layer`] reads them.
    pub targets: Vec<String>,
}

impl Default for LoraConfig {
    /// All attention projections, rank 8, scale 1.
    fn default() -> Self {
        let targets = ["to_q", "to_k", "to_v", "to_out.0"].map(str::to_owned).to_vec();
        Self { rank: 8, alpha: 8.0, targets }
    }
}

/// Adds a new adapter: A ~ N(0, 1 / rank²), B zero, so that the model computes as before. Everything else is frozen;
/// [`train_only`] chooses otherwise.
///
/// On GPU backends keep an input of the model that requires a gradient: some do not pass gradients rightly through a
/// network in which only adapters are trained.
///
/// # Errors
/// [`LoraError::Config`], [`LoraError::Taken`], or [`LoraError::NoTarget`] for a pattern without a layer.
pub fn attach<M: Module + LoraSites>(mut model: M, name: &str, config: &LoraConfig, seed: u64) -> Result<M, LoraError> {
    check_new(&mut model, name)?;
    check_config(&mut model, name, config)?;
    let mut model = model.no_grad();
    let mut init: Option<Init> = None;
    for_each_site(&mut model, |site| {
        if !config.targets.iter().any(|pattern| names_layer(pattern, site.path)) {
            return;
        }
        let init = init.get_or_insert_with(|| Init::new(seed, &site.weight.device()));
        let shape = site.weight.shape();
        let down = init.normal([config.rank, shape[1..].iter().product()], 1.0 / config.rank as f64);
        let up = init.constant([shape[0], config.rank], 0.0);
        push(site, LowRank::new(name, down, up, config.alpha));
    });
    Ok(model)
}

/// Whether a parameter path, such as `blocks.0.to_q.lora.stack.0.up`, leads to a factor of an adapter.
#[must_use]
pub fn is_factor(path: &str) -> bool {
    path.contains(".lora.stack.")
}

/// Takes an adapter off.
///
/// # Errors
/// [`LoraError::Unknown`]
pub fn detach<M: LoraSites>(model: &mut M, name: &str) -> Result<(), LoraError> {
    check_known(model, &[name])?;
    for_each_site(model, |site| {
        site.lora.stack.retain(|adapter| adapter.name() != name);
        remerge(site);
    });
    Ok(())
}

/// Multiplies an adapter's part by `weight`, on top of alpha / rank. 1 as trained; 0 gives the model without it to the
/// bit, and no gradients for it.
///
/// # Errors
/// [`LoraError::Unknown`], or [`LoraError::Config`] for a weight that is not finite.
pub fn set_weight<M: LoraSites>(model: &mut M, name: &str, weight: f64) -> Result<(), LoraError> {
    check_known(model, &[name])?;
    if !weight.is_finite() {
        return Err(LoraError::Config { name: name.to_owned(), reason: format!("weight {weight} is not finite") });
    }
    for_each_site(model, |site| {
        for adapter in site.lora.stack.iter_mut().filter(|adapter| adapter.name() == name) {
            adapter.set_weight(weight);
        }
        remerge(site);
    });
    Ok(())
}

/// Makes one matrix of each base weight and its adapters, for inference without extra products: twice the memory of the
/// adapted weights, and no gradients for the adapters. The base stays; later changes of adapters' values need another
/// merge.
pub fn merge<M: LoraSites>(model: &mut M) {
    for_each_site(model, |site| site.lora.merge(site.weight.matrix()));
}

/// Undoes [`merge`]: the base weights are what they were, bit for bit.
pub fn unmerge<M: LoraSites>(model: &mut M) {
    for_each_site(model, |site| site.lora.unmerge());
}

/// Trains the adapters of these names and freezes everything else.
///
/// # Errors
/// [`LoraError::Unknown`]
pub fn train_only<M: Module + LoraSites>(mut model: M, names: &[&str]) -> Result<M, LoraError> {
    check_known(&mut model, names)?;
    let mut trained = BTreeSet::new();
    for_each_site(&mut model, |site| {
        for adapter in site.lora.stack.iter().filter(|adapter| names.contains(&adapter.name())) {
            trained.extend([adapter.down.id, adapter.up.id]);
        }
    });
    Ok(model.map(&mut TrainOnly { trained }))
}

/// Names of the adapters a model carries, sorted.
pub fn names<M: LoraSites>(model: &mut M) -> Vec<String> {
    let mut names = BTreeSet::new();
    for_each_site(model, |site| names.extend(site.lora.stack.iter().map(|adapter| adapter.name().to_owned())));
    names.into_iter().collect()
}

struct TrainOnly {
    trained: BTreeSet<ParamId>,
}

impl ModuleMapper for TrainOnly {
    fn map_float<const D: usize>(&mut self, param: Param<Tensor<D>>) -> Param<Tensor<D>> {
        let trained = self.trained.contains(&param.id);
        param.set_require_grad(trained)
    }
}

fn for_each_site<M: LoraSites>(model: &mut M, mut visit: impl FnMut(Site<'_>)) {
    model.visit_sites("", &mut |site| visit(site));
}

fn push(site: Site<'_>, adapter: LowRank) {
    site.lora.stack.push(adapter);
    remerge(site);
}

/// Keeps a merged site true after its adapters changed.
fn remerge(site: Site<'_>) {
    if site.lora.is_merged() {
        site.lora.merge(site.weight.matrix());
    }
}

fn check_new<M: LoraSites>(model: &mut M, name: &str) -> Result<(), LoraError> {
    if names(model).iter().any(|known| known == name) {
        return Err(LoraError::Taken { name: name.to_owned() });
    }
    Ok(())
}

fn check_known<M: LoraSites>(model: &mut M, wanted: &[&str]) -> Result<(), LoraError> {
    let known = names(model);
    match wanted.iter().find(|name| !known.iter().any(|other| other == *name)) {
        Some(name) => Err(LoraError::Unknown { name: (*name).to_owned(), known }),
        None => Ok(()),
    }
}

fn check_config<M: LoraSites>(model: &mut M, name: &str, config: &LoraConfig) -> Result<(), LoraError> {
    let refuse = |reason: &str| Err(LoraError::Config { name: name.to_owned(), reason: reason.to_owned() });
    if config.rank == 0 {
        return refuse("rank must be at least 1");
    }
    if !config.alpha.is_finite() {
        return refuse("alpha must be finite");
    }
    if config.targets.is_empty() {
        return refuse("no targets");
    }
    let mut paths = Vec::new();
    for_each_site(model, |site| paths.push(site.path.to_owned()));
    for pattern in &config.targets {
        if !paths.iter().any(|path| names_layer(pattern, path)) {
            paths.truncate(5);
            return Err(LoraError::NoTarget { name: name.to_owned(), pattern: pattern.clone(), examples: paths });
        }
    }
    Ok(())
}
