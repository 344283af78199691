//! Times whole training steps on the CPU backend: forward, gradients and AdamW of network parts made of the operations of `ops`.
//!
//! `cargo bench -p rigscape -p ops --bench steps -- [NAME]`; `benches/peer/steps.py` runs it beside the same networks in PyTorch.

use burn::module::{Module, Param};
use burn::optim::{AdamWConfig, GradientsParams};
use burn::tensor::{Device, Distribution, Tensor};
use divan::Bencher;

fn main() {
    // As every program of this workspace that computes on a CPU.
    ops::keep_freed_memory();
    divan::main();
}

fn normal<const D: usize>(shape: [usize; D], std: f64, device: &Device) -> Tensor<D> {
    Tensor::random(shape, Distribution::Normal(0.0, std), device)
}

/// Weight `[out, in]`, or `[out, in, 3, 3]`, and bias.
#[derive(Module, Debug)]
struct Affine<const D: usize> {
    weight: Param<Tensor<D>>,
    bias: Param<Tensor<1>>,
}

impl<const D: usize> Affine<D> {
    fn new(shape: [usize; D], device: &Device) -> Self {
        let fan_in: usize = shape[1..].iter().product();
        Self {
            weight: Param::from_tensor(normal(shape, 1.0 / (fan_in as f64).sqrt(), device)),
            bias: Param::from_tensor(Tensor::zeros([shape[0]], device)),
        }
    }
}

impl Affine<2> {
    fn forward<const R: usize>(&self, x: Tensor<R>) -> Tensor<R> {
        ops::linear(x, self.weight.val(), Some(self.bias.val()))
    }
}

impl Affine<4> {
    fn forward(&self, x: Tensor<4>) -> Tensor<4> {
        ops::conv2d(x, self.weight.val(), Some(self.bias.val()), [1; 2], [1; 2])
    }
}

/// `[B, N, H·D]` to `[B, H, N, D]`.
fn split(x: Tensor<3>, heads: usize) -> Tensor<4> {
    let [b, n, width] = x.dims();
    x.reshape([b, n, heads, width / heads]).swap_dims(1, 2)
}

fn attend(q: Tensor<3>, k: Tensor<3>, v: Tensor<3>, heads: usize) -> Tensor<3> {
    let [b, n, width] = q.dims();
    ops::attention(split(q, heads), split(k, heads), split(v, heads), None).swap_dims(1, 2).reshape([b, n, width])
}

/// adaLN-Zero block; `specs/dit.md`, Peebles & Xie, section 3.2.
#[derive(Module, Debug)]
struct DitBlock {
    modulation: Affine<2>,
    qkv: Affine<2>,
    out: Affine<2>,
    expand: Affine<2>,
    contract: Affine<2>,
}

const DIT_WIDTH: usize = 384;
const DIT_HEADS: usize = 6;

impl DitBlock {
    fn new(device: &Device) -> Self {
        let layer = |d_in: usize, d_out: usize| Affine::new([d_out * DIT_WIDTH, d_in * DIT_WIDTH], device);
        Self { modulation: layer(1, 6), qkv: layer(1, 3), out: layer(1, 1), expand: layer(1, 4), contract: layer(4, 1) }
    }

    fn forward(&self, x: Tensor<3>, c: Tensor<2>) -> Tensor<3> {
        let b = c.dims()[0];
        let all = self.modulation.forward(ops::silu(c)).reshape([b, 6, DIT_WIDTH]);
        let part = |i: usize| all.clone().narrow(1, i, 1);
        let normed = ops::modulated_layer_norm(x.clone(), part(0), part(1), 1e-6);
        let [q, k, v] = self.qkv.forward(normed).chunk(3, 2).try_into().expect("three parts");
        let x = x + self.out.forward(attend(q, k, v, DIT_HEADS)) * part(2);
        let normed = ops::modulated_layer_norm(x.clone(), part(3), part(4), 1e-6);
        x + self.contract.forward(ops::gelu_tanh(self.expand.forward(normed))) * part(5)
    }
}

/// Four blocks of DiT-S/2: 256 tokens of a 32x32 latent.
#[derive(Module, Debug)]
struct DitStack {
    blocks: Vec<DitBlock>,
}

/// Affine-norm parameters.
#[derive(Module, Debug)]
struct Gain {
    gain: Param<Tensor<1>>,
    bias: Param<Tensor<1>>,
}

impl Gain {
    fn new(width: usize, device: &Device) -> Self {
        let [gain, bias] = [Tensor::ones([width], device), Tensor::zeros([width], device)];
        Self { gain: Param::from_tensor(gain), bias: Param::from_tensor(bias) }
    }

    fn group_silu(&self, x: Tensor<4>) -> Tensor<4> {
        ops::group_norm_silu(x, 32, self.gain.val(), self.bias.val(), 1e-5)
    }

    fn layer(&self, x: Tensor<3>) -> Tensor<3> {
        ops::layer_norm(x, Some(self.gain.val()), Some(self.bias.val()), 1e-5)
    }
}

/// The first level of Stable Diffusion's UNet, one residual block and one transformer; `specs/stable_diffusion.md`.
#[derive(Module, Debug)]
struct UnetLevel {
    norms: Vec<Gain>,
    conv_1: Affine<4>,
    time: Affine<2>,
    conv_2: Affine<4>,
    proj_in: Affine<2>,
    /// q, k, v, out of self-attention, then of attention to text.
    attention: Vec<Affine<2>>,
    expand: Affine<2>,
    contract: Affine<2>,
    proj_out: Affine<2>,
}

const LEVEL_WIDTH: usize = 320;
const LEVEL_HEADS: usize = 8;
const TEXT_WIDTH: usize = 768;

impl UnetLevel {
    fn new(device: &Device) -> Self {
        let w = LEVEL_WIDTH;
        let conv = || Affine::new([w, w, 3, 3], device);
        let layer = |d_out: usize, d_in: usize| Affine::new([d_out, d_in], device);
        let inputs = [w, w, w, w, w, TEXT_WIDTH, TEXT_WIDTH, w];
        Self {
            norms: (0..6).map(|_| Gain::new(w, device)).collect(),
            conv_1: conv(),
            time: layer(w, 4 * w),
            conv_2: conv(),
            proj_in: layer(w, w),
            attention: inputs.into_iter().map(|d_in| layer(w, d_in)).collect(),
            expand: layer(8 * w, w),
            contract: layer(w, 4 * w),
            proj_out: layer(w, w),
        }
    }

    fn forward(&self, x: Tensor<4>, time: Tensor<2>, text: Tensor<3>) -> Tensor<4> {
        let [n, c, h, w] = x.dims();
        let hidden = self.conv_1.forward(self.norms[0].group_silu(x.clone()));
        let hidden = hidden + self.time.forward(ops::silu(time)).reshape([n, c, 1, 1]);
        let x = x + self.conv_2.forward(self.norms[1].group_silu(hidden));
        let (gain, bias) = (self.norms[2].gain.val(), self.norms[2].bias.val());
        let normed = ops::group_norm(x.clone(), 32, gain, bias, 1e-6);
        let tokens = self.proj_in.forward(normed.reshape([n, c, h * w]).swap_dims(1, 2));
        let normed = self.norms[3].layer(tokens.clone());
        let tokens = tokens + self.attend(0, normed.clone(), normed);
        let tokens = tokens.clone() + self.attend(4, self.norms[4].layer(tokens), text);
        let [values, gates] =
            self.expand.forward(self.norms[5].layer(tokens.clone())).chunk(2, 2).try_into().expect("two halves");
        let tokens = tokens + self.contract.forward(values * ops::gelu(gates));
        x + self.proj_out.forward(tokens).swap_dims(1, 2).reshape([n, c, h, w])
    }

    fn attend(&self, first: usize, x: Tensor<3>, context: Tensor<3>) -> Tensor<3> {
        let layers = &self.attention[first..first + 4];
        let (k, v) = (layers[1].forward(context.clone()), layers[2].forward(context));
        layers[3].forward(attend(layers[0].forward(x), k, v, LEVEL_HEADS))
    }
}

/// Times `forward`, its gradients and one step of AdamW.
fn train<M: Module>(bencher: Bencher, module: M, device: &Device, forward: impl Fn(&M) -> Tensor<1>) {
    assert!(device.is_autodiff(), "a step needs a tape");
    let mut optimizer = AdamWConfig::new().with_weight_decay(0.01).init();
    let mut module = Some(module);
    bencher.bench_local(|| {
        let current = module.take().expect("the module of the last step");
        let gradients = forward(&current).backward();
        let gradients = GradientsParams::from_grads(gradients, &current);
        module = Some(optimizer.step(1e-4, current, gradients));
    });
}

#[divan::bench(min_time = 2, max_time = 6)]
fn dit_stack(bencher: Bencher) {
    let device = Device::flex().autodiff();
    let stack = DitStack { blocks: (0..4).map(|_| DitBlock::new(&device)).collect() };
    let (x, c) = (normal([4, 256, DIT_WIDTH], 1.0, &device), normal([4, DIT_WIDTH], 1.0, &device));
    train(bencher, stack, &device, |stack| {
        let y = stack.blocks.iter().fold(x.clone(), |x, block| block.forward(x, c.clone()));
        y.square().mean()
    });
}

#[divan::bench(min_time = 2, max_time = 6)]
fn unet_level(bencher: Bencher) {
    let device = Device::flex().autodiff();
    let level = UnetLevel::new(&device);
    let x = normal([2, LEVEL_WIDTH, 28, 50], 1.0, &device);
    let (time, text) = (normal([2, 4 * LEVEL_WIDTH], 1.0, &device), normal([2, 77, TEXT_WIDTH], 1.0, &device));
    train(bencher, level, &device, |level| level.forward(x.clone(), time.clone(), text.clone()).square().mean());
}
