//! The mixed blocks: parallel branches whose outputs stand one after the other.

use burn::tensor::Tensor;
use burn::tensor::activation::relu;
use burn::tensor::module::{avg_pool2d, max_pool2d};
use burn::tensor::ops::{AvgPoolOptions, MaxPoolOptions};
use nn::weights::WeightError;

use super::reduce;
use crate::conv::{Conv2d, Padding};
use crate::frozen::Values;

/// Of every batch norm in the network.
const EPSILON: f64 = 1e-3;

/// Convolution, batch norm, ReLU.
#[derive(Debug, Clone)]
pub(super) struct Unit(Conv2d);

impl Unit {
    pub fn read(
        values: &mut Values<'_>,
        name: &str,
        shape: [usize; 4],
        stride: usize,
        padding: [usize; 2],
    ) -> Result<Self, WeightError> {
        let kernel = values.folded(&format!("{name}.conv"), shape, &format!("{name}.bn"), EPSILON)?;
        Ok(Self(Conv2d::folded(kernel, stride, Padding::Zeros(padding))))
    }

    pub fn forward(&self, x: Tensor<4>) -> Tensor<4> {
        relu(self.0.forward(x))
    }
}

/// What a branch does before, between and after its convolutions.
#[derive(Debug, Clone)]
enum Branch {
    /// One convolution after the other.
    Chain(Vec<Unit>),
    /// A chain, then two convolutions side by side (7b and 7c).
    Fork(Vec<Unit>, Box<[Unit; 2]>),
    /// 3×3 average pool, stride 1, padding not counted, then a convolution.
    AveragePool(Box<Unit>),
    /// 3×3 max pool, stride 1, then a convolution.
    MaxPool(Box<Unit>),
    /// 3×3 max pool, stride 2.
    Reduce,
}

impl Branch {
    fn forward(&self, x: Tensor<4>) -> Tensor<4> {
        let chain = |units: &[Unit], x| units.iter().fold(x, |x, unit| unit.forward(x));
        match self {
            Self::Chain(units) => chain(units, x),
            Self::Fork(units, ends) => {
                let (x, [one, other]) = (chain(units, x), ends.as_ref());
                Tensor::cat(vec![one.forward(x.clone()), other.forward(x)], 1)
            }
            Self::AveragePool(unit) => {
                let options = AvgPoolOptions::new([3, 3]).with_stride([1, 1]).with_padding([1, 1]);
                unit.forward(avg_pool2d(x, AvgPoolOptions { count_include_pad: false, ..options }))
            }
            Self::MaxPool(unit) => {
                unit.forward(max_pool2d(x, MaxPoolOptions::new([3, 3]).with_stride([1, 1]).with_padding([1, 1])))
            }
            Self::Reduce => reduce(x),
        }
    }
}

/// Parallel branches.
#[derive(Debug, Clone)]
pub(super) struct Block(Vec<Branch>);

impl Block {
    pub fn forward(&self, x: Tensor<4>) -> Tensor<4> {
        Tensor::cat(self.0.iter().map(|branch| branch.forward(x.clone())).collect(), 1)
    }
}

/// How the pool branch of the last block pools.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum LastPool {
    Maximum,
    Average,
}

/// Reads the units of one block.
struct BlockReader<'v, 'a> {
    values: &'v mut Values<'a>,
    name: &'static str,
    channels: usize,
}

impl BlockReader<'_, '_> {
    /// Convolutions one after the other: name, output channels, kernel. Stride 2 convolutions have no padding, others keep
    /// the size.
    fn chain(&mut self, layers: &[(&str, usize, [usize; 2], usize)]) -> Result<Vec<Unit>, WeightError> {
        let mut channels = self.channels;
        let mut units = Vec::with_capacity(layers.len());
        for &(layer, width, kernel, stride) in layers {
            units.push(self.unit(layer, [width, channels], kernel, stride)?);
            channels = width;
        }
        Ok(units)
    }

    fn unit(
        &mut self,
        layer: &str,
        [out, channels]: [usize; 2],
        [height, width]: [usize; 2],
        stride: usize,
    ) -> Result<Unit, WeightError> {
        let padding = if stride == 1 { [height / 2, width / 2] } else { [0, 0] };
        let name = format!("{}.{layer}", self.name);
        Unit::read(self.values, &name, [out, channels, height, width], stride, padding)
    }

    fn pool_unit(&mut self, width: usize) -> Result<Unit, WeightError> {
        self.unit("branch_pool", [width, self.channels], [1, 1], 1)
    }
}

const ONE: [usize; 2] = [1, 1];
const THREE: [usize; 2] = [3, 3];

/// 5b, 5c, 5d, 6a, 6b, 6c, 6d, 6e, 7a, 7b, 7c.
pub(super) fn read_all(values: &mut Values<'_>, last: LastPool) -> Result<Vec<Block>, WeightError> {
    let mut blocks = Vec::with_capacity(11);
    for (name, channels, pool_width) in [("Mixed_5b", 192, 32), ("Mixed_5c", 256, 64), ("Mixed_5d", 288, 64)] {
        blocks.push(block_5(BlockReader { values, name, channels }, pool_width)?);
    }
    blocks.push(block_6a(BlockReader { values, name: "Mixed_6a", channels: 288 })?);
    for (name, width) in [("Mixed_6b", 128), ("Mixed_6c", 160), ("Mixed_6d", 160), ("Mixed_6e", 192)] {
        blocks.push(block_6(BlockReader { values, name, channels: 768 }, width)?);
    }
    blocks.push(block_7a(BlockReader { values, name: "Mixed_7a", channels: 768 })?);
    blocks.push(block_7(BlockReader { values, name: "Mixed_7b", channels: 1280 }, LastPool::Average)?);
    blocks.push(block_7(BlockReader { values, name: "Mixed_7c", channels: 2048 }, last)?);
    Ok(blocks)
}

fn block_5(mut read: BlockReader<'_, '_>, pool_width: usize) -> Result<Block, WeightError> {
    Ok(Block(vec![
        Branch::Chain(read.chain(&[("branch1x1", 64, ONE, 1)])?),
        Branch::Chain(read.chain(&[("branch5x5_1", 48, ONE, 1), ("branch5x5_2", 64, [5, 5], 1)])?),
        Branch::Chain(read.chain(&[
            ("branch3x3dbl_1", 64, ONE, 1),
            ("branch3x3dbl_2", 96, THREE, 1),
            ("branch3x3dbl_3", 96, THREE, 1),
        ])?),
        Branch::AveragePool(Box::new(read.pool_unit(pool_width)?)),
    ]))
}

fn block_6a(mut read: BlockReader<'_, '_>) -> Result<Block, WeightError> {
    Ok(Block(vec![
        Branch::Chain(read.chain(&[("branch3x3", 384, THREE, 2)])?),
        Branch::Chain(read.chain(&[
            ("branch3x3dbl_1", 64, ONE, 1),
            ("branch3x3dbl_2", 96, THREE, 1),
            ("branch3x3dbl_3", 96, THREE, 2),
        ])?),
        Branch::Reduce,
    ]))
}

fn block_6(mut read: BlockReader<'_, '_>, width: usize) -> Result<Block, WeightError> {
    Ok(Block(vec![
        Branch::Chain(read.chain(&[("branch1x1", 192, ONE, 1)])?),
        Branch::Chain(read.chain(&[
            ("branch7x7_1", width, ONE, 1),
            ("branch7x7_2", width, [1, 7], 1),
            ("branch7x7_3", 192, [7, 1], 1),
        ])?),
        Branch::Chain(read.chain(&[
            ("branch7x7dbl_1", width, ONE, 1),
            ("branch7x7dbl_2", width, [7, 1], 1),
            ("branch7x7dbl_3", width, [1, 7], 1),
            ("branch7x7dbl_4", width, [7, 1], 1),
            ("branch7x7dbl_5", 192, [1, 7], 1),
        ])?),
        Branch::AveragePool(Box::new(read.pool_unit(192)?)),
    ]))
}

fn block_7a(mut read: BlockReader<'_, '_>) -> Result<Block, WeightError> {
    Ok(Block(vec![
        Branch::Chain(read.chain(&[("branch3x3_1", 192, ONE, 1), ("branch3x3_2", 320, THREE, 2)])?),
        Branch::Chain(read.chain(&[
            ("branch7x7x3_1", 192, ONE, 1),
            ("branch7x7x3_2", 192, [1, 7], 1),
            ("branch7x7x3_3", 192, [7, 1], 1),
            ("branch7x7x3_4", 192, THREE, 2),
        ])?),
        Branch::Reduce,
    ]))
}

fn block_7(mut read: BlockReader<'_, '_>, pool: LastPool) -> Result<Block, WeightError> {
    let single = Branch::Chain(read.chain(&[("branch1x1", 320, ONE, 1)])?);
    let short = read.chain(&[("branch3x3_1", 384, ONE, 1)])?;
    let short_fork =
        [read.unit("branch3x3_2a", [384, 384], [1, 3], 1)?, read.unit("branch3x3_2b", [384, 384], [3, 1], 1)?];
    let long = read.chain(&[("branch3x3dbl_1", 448, ONE, 1), ("branch3x3dbl_2", 384, THREE, 1)])?;
    let long_fork =
        [read.unit("branch3x3dbl_3a", [384, 384], [1, 3], 1)?, read.unit("branch3x3dbl_3b", [384, 384], [3, 1], 1)?];
    let unit = Box::new(read.pool_unit(192)?);
    let pooled = match pool {
        LastPool::Maximum => Branch::MaxPool(unit),
        LastPool::Average => Branch::AveragePool(unit),
    };
    Ok(Block(vec![single, Branch::Fork(short, Box::new(short_fork)), Branch::Fork(long, Box::new(long_fork)), pooled]))
}
