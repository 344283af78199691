//! Attention from each view of a rig to its neighbours.
//!
//! Sources: MagicDrive (Gao et al.), section 4.3, for the sum of one attention per neighbour; Panacea (Wen et al.), equation 5,
//! for one softmax over all neighbours. Shapes: B samples, V views, N positions, D width.

use burn::module::Module;
use burn::tensor::{Bool, Device, Int, Tensor, TensorData};
use nn::{Bias, Init, LayerNorm, Linear};
use serde::{Deserialize, Serialize};

use crate::attention::{Attention, attend};
use crate::config::ConfigError;

/// How what a view sees in its neighbours becomes one.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum NeighbourMerge {
    /// One attention per neighbour, results added.
    Sum,
    /// One attention over the keys of all neighbours.
    Concat,
}

/// Which views are neighbours, per sample. Views may differ in number of neighbours; a view may have none (padding).
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Adjacency {
    /// Views of each sample, padding included.
    views: usize,
    /// Neighbours of item `sample·V + view` as item numbers.
    neighbours: Vec<Vec<usize>>,
}

impl Adjacency {
    /// `samples[b][v]` lists the neighbours of view v in sample b.
    ///
    /// # Errors
    /// [`ConfigError`] when samples differ in number of views, or a neighbour is no view of its sample.
    pub fn new(samples: &[Vec<Vec<usize>>]) -> Result<Self, ConfigError> {
        let views = samples.first().map_or(0, Vec::len);
        let mut neighbours = Vec::new();
        for (b, lists) in samples.iter().enumerate() {
            let range = |reason: String| ConfigError::Range { what: format!("adjacency of sample {b}"), reason };
            if lists.len() != views {
                return Err(range(format!("has {} views, the first sample {views}", lists.len())));
            }
            for list in lists {
                if let Some(bad) = list.iter().find(|u| **u >= views) {
                    return Err(range(format!("neighbour {bad} is none of the {views} views")));
                }
                neighbours.push(list.iter().map(|u| b * views + u).collect());
            }
        }
        Ok(Self { views, neighbours })
    }

    /// `samples` rigs whose first and last view are neighbours.
    #[must_use]
    pub fn ring(samples: usize, views: usize) -> Self {
        let around = |v: usize| match views {
            0 | 1 => vec![],
            2 => vec![1 - v],
            _ => vec![(v + views - 1) % views, (v + 1) % views],
        };
        Self::repeated(samples, (0..views).map(around).collect())
    }

    /// `samples` rigs whose first and last view see nothing in common.
    #[must_use]
    pub fn chain(samples: usize, views: usize) -> Self {
        let beside = |v: usize| {
            let before = v.checked_sub(1);
            before.into_iter().chain((v + 1 < views).then_some(v + 1)).collect()
        };
        Self::repeated(samples, (0..views).map(beside).collect())
    }

    fn repeated(samples: usize, lists: Vec<Vec<usize>>) -> Self {
        let views = lists.len();
        let of = |b: usize| lists.iter().map(move |list| list.iter().map(|u| b * views + u).collect());
        Self { views, neighbours: (0..samples).flat_map(of).collect() }
    }

    /// Views of each sample.
    #[must_use]
    pub fn views(&self) -> usize {
        self.views
    }

    /// Samples times views.
    #[must_use]
    pub fn items(&self) -> usize {
        self.neighbours.len()
    }

    /// Most neighbours that any view has.
    fn most(&self) -> usize {
        self.neighbours.iter().map(Vec::len).max().unwrap_or(0)
    }

    /// The `slot`-th neighbour of each item; an item without one stands in for it and is masked out.
    fn slot(&self, slot: usize, device: &Device) -> Tensor<1, Int> {
        let of = |(item, list): (usize, &Vec<usize>)| list.get(slot).copied().unwrap_or(item) as i64;
        let indices: Vec<i64> = self.neighbours.iter().enumerate().map(of).collect();
        Tensor::from_data(TensorData::new(indices, [self.items()]), device)
    }

    /// 1 for items with more than `slot` neighbours, else 0; `[B·V, 1, 1]`.
    fn present(&self, slot: usize, device: &Device) -> Tensor<3> {
        let values: Vec<f32> = self.neighbours.iter().map(|list| f32::from(list.len() > slot)).collect();
        Tensor::from_data(TensorData::new(values, [self.items(), 1, 1]), device)
    }
}

/// x += connector(merge over neighbours of attention(norm x, norm neighbour)); starts as the identity.
#[derive(Module, Debug)]
pub struct CrossView {
    /// Shared by the view and its neighbours.
    pub norm4: LayerNorm,
    /// Queries of the view, keys and values of a neighbour.
    pub attn4: Attention,
    /// Zero at the start.
    pub connector: Linear,
    #[module(skip)]
    merge: NeighbourMerge,
}

impl CrossView {
    /// Fresh weights; `heads` must divide `width`.
    pub fn new(width: usize, heads: usize, merge: NeighbourMerge, init: &mut Init) -> Self {
        Self {
            norm4: LayerNorm::with_bias(width, 1e-5, init),
            attn4: Attention::new(width, width, heads, Bias::Without, init),
            connector: Linear::zeros(width, width, Bias::With, init),
            merge,
        }
    }

    /// # Shapes
    /// - x and output: `[B·V, N, D]`, views of a sample side by side
    ///
    /// # Panics
    /// When the adjacency has another number of items.
    pub fn forward(&self, x: Tensor<3>, views: &Adjacency) -> Tensor<3> {
        assert_eq!(x.dims()[0], views.items(), "items of the adjacency");
        if views.most() == 0 {
            return x;
        }
        let normed = self.norm4.forward(x.clone());
        let projected = self.attn4.project(normed.clone(), normed);
        let seen = match self.merge {
            NeighbourMerge::Sum => self.sum(projected, views),
            NeighbourMerge::Concat => self.concat(projected, views),
        };
        // A view without neighbours receives nothing, not even the biases.
        let any = views.present(0, &x.device());
        x + self.connector.forward(seen) * any
    }

    fn sum(&self, [q, k, v]: [Tensor<4>; 3], views: &Adjacency) -> Tensor<3> {
        let device = q.device();
        let seen = |slot: usize| {
            let neighbour = views.slot(slot, &device);
            let of = |t: &Tensor<4>| t.clone().select(0, neighbour.clone());
            self.attn4.merge(attend(q.clone(), of(&k), of(&v), None)) * views.present(slot, &device)
        };
        (1..views.most()).fold(seen(0), |total, slot| total + seen(slot))
    }

    fn concat(&self, [q, k, v]: [Tensor<4>; 3], views: &Adjacency) -> Tensor<3> {
        let device = q.device();
        let [items, _, positions, _] = k.dims();
        let slots = 0..views.most();
        let gather = |t: &Tensor<4>| {
            let parts = slots.clone().map(|slot| t.clone().select(0, views.slot(slot, &device)));
            Tensor::cat(parts.collect(), 2)
        };
        let present = slots.clone().map(|slot| views.present(slot, &device).expand([items, 1, positions]));
        let mask: Tensor<3, Bool> = Tensor::cat(present.collect(), 2).greater_elem(0.5);
        let mask = mask.reshape([items, 1, 1, views.most() * positions]);
        self.attn4.merge(attend(q, gather(&k), gather(&v), Some(mask)))
    }
}
