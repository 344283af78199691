//! Gradients of a stack in segments against those of the whole stack on one tape.

use burn::module::Module;
use burn::optim::GradientsParams;
use burn::tensor::{Device, Tensor, TensorData};
use nn::golden::golden_stream;
use nn::segments::Segments;
use nn::{Bias, Init, LayerNorm, Linear};

/// x += out(gelu(expand(norm x) + condition)).
#[derive(Module, Debug)]
struct Block {
    norm: LayerNorm,
    expand: Linear,
    out: Linear,
}

impl Block {
    fn new(width: usize, init: &mut Init) -> Self {
        Self {
            norm: LayerNorm::with_bias(width, 1e-5, init),
            expand: Linear::new(width, 2 * width, Bias::With, init),
            out: Linear::new(2 * width, width, Bias::With, init),
        }
    }

    fn forward(&self, x: Tensor<3>, condition: Tensor<2>) -> Tensor<3> {
        let [b, d] = condition.dims();
        let inner = self.expand.forward(self.norm.forward(x.clone())) + condition.reshape([b, 1, d]);
        x + self.out.forward(ops::gelu(inner))
    }
}

fn noise<const D: usize>(name: &str, shape: [usize; D], device: &Device) -> Tensor<D> {
    let values: Vec<f32> = golden_stream(name, shape.iter().product()).into_iter().map(|v| v as f32).collect();
    Tensor::from_data(TensorData::new(values, shape), device)
}

fn assert_equal<const D: usize>(name: &str, got: Tensor<D>, want: Tensor<D>) {
    let scale = want.clone().abs().max().into_scalar::<f32>().max(1e-3);
    let off = (got - want).abs().max().into_scalar::<f32>();
    assert!(off <= 2e-6 * scale, "{name}: off by {off:e} of {scale:e}");
}

#[test]
fn gradients_equal_those_of_one_tape() {
    let device = Device::flex().autodiff();
    let width = 12;
    let mut init = Init::new(3, &device);
    let blocks: Vec<Block> = (0..7).map(|_| Block::new(width, &mut init)).collect();
    let x = noise("x", [2, 5, width], &device).require_grad();
    let condition = noise("condition", [2, 2 * width], &device).require_grad();
    let target = noise("target", [2, 5, width], &device);
    let end = blocks.iter().fold(x.clone(), |x, block| block.forward(x, condition.clone()));
    let output = end.clone().inner();
    let whole = (end - target.clone()).square().sum().backward();
    let (want_x, want_condition) = (x.grad(&whole).unwrap(), condition.grad(&whole).unwrap());
    let want = GradientsParams::from_grads(whole, &blocks);

    let run = |block: &Block, x, condition| block.forward(x, condition);
    for length in [1, 2, 3, 7, 9] {
        let inputs = (x.clone().inner(), condition.clone().inner());
        let segments = Segments::forward(&blocks, length, inputs, &run);
        assert_eq!(segments.output().into_data(), output.clone().into_data(), "segments of {length}");
        let upstream = (output.clone() - target.clone().inner()) * 2.0;
        let got = segments.backward(&blocks, upstream, &run);
        assert_equal("input", got.input, want_x.clone());
        assert_equal("condition", got.condition.unwrap(), want_condition.clone());
        assert_eq!(got.params.len(), want.len());
        for (i, block) in blocks.iter().enumerate() {
            for (name, weight) in [("expand", &block.expand.weight), ("out", &block.out.weight)] {
                let of = |all: &GradientsParams| all.get::<2>(weight.id).unwrap();
                assert_equal(&format!("block {i} {name}, segments of {length}"), of(&got.params), of(&want));
            }
            let of = |all: &GradientsParams| all.get::<1>(block.norm.weight.id).unwrap();
            assert_equal(&format!("block {i} norm, segments of {length}"), of(&got.params), of(&want));
        }
    }
}

#[test]
fn frozen_blocks_pass_the_gradient_on() {
    let device = Device::flex().autodiff();
    let mut init = Init::new(4, &device);
    let blocks: Vec<Block> = (0..4).map(|_| Block::new(8, &mut init).no_grad()).collect();
    let run = |block: &Block, x: Tensor<3>, _: Tensor<2>| block.forward(x.clone(), Tensor::zeros([1, 16], &x.device()));
    let inner = Device::flex();
    let inputs = (noise("x", [1, 3, 8], &inner), Tensor::zeros([1, 1], &inner));
    let got = Segments::forward(&blocks, 2, inputs, &run).backward(&blocks, Tensor::ones([1, 3, 8], &inner), &run);
    assert!(got.condition.is_none() && got.params.is_empty());
    assert!(got.input.abs().max().into_scalar::<f32>() > 0.1);
}
