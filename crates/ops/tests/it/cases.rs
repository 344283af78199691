//! Every operation once, on inputs that a test lays out, cuts or sizes as it likes.

use std::cell::RefCell;

use burn::tensor::{Bool, Device, Gradients, Tensor, TensorData};
use ops::{Interpolation, PixelCentres};

/// Sizes of all cases.
#[derive(Debug, Clone, Copy)]
pub struct Sizes {
    /// Batch items; may be 0.
    pub items: usize,
    pub tokens: usize,
    /// Channels; a multiple of 8.
    pub width: usize,
    /// Of maps.
    pub height: usize,
    pub columns: usize,
    pub points: usize,
}

/// How inputs lie in memory.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Order {
    /// Row-major.
    Plain,
    /// With the axes in reverse order.
    Turned,
}

type Gradient = Box<dyn Fn(&Gradients) -> Vec<f32>>;

/// Makes the inputs of one case and remembers them.
pub struct Feed {
    pub device: Device,
    pub order: Order,
    pub sizes: Sizes,
    /// The one batch item to be used, where not all are.
    pub only: Option<usize>,
    gradients: RefCell<Vec<Gradient>>,
}

/// Smooth values in [-1, 1], the same on every machine.
fn wave(count: usize, phase: f64) -> Vec<f32> {
    (0..count).map(|i| ((i as f64 * 0.7311 + phase).sin() * 0.97) as f32).collect()
}

impl Feed {
    pub fn new(sizes: Sizes, order: Order, only: Option<usize>) -> Self {
        Self { device: Device::flex().autodiff(), order, sizes, only, gradients: RefCell::default() }
    }

    fn values<const D: usize>(&self, shape: [usize; D], phase: f64) -> Tensor<D> {
        let values = wave(shape.iter().product(), phase);
        Tensor::from_data(TensorData::new(values, shape), &self.device)
    }

    /// A leaf that all batch items share.
    fn shared<const D: usize>(&self, shape: [usize; D], phase: f64) -> Tensor<D> {
        self.leaf(self.values(shape, phase))
    }

    /// A leaf with the batch items along the first axis.
    fn batched<const D: usize>(&self, shape: [usize; D], phase: f64) -> Tensor<D> {
        self.leaf(self.chosen(self.values(shape, phase)))
    }

    fn mask<const D: usize>(&self, shape: [usize; D], phase: f64) -> Tensor<D, Bool> {
        self.chosen(self.values(shape, phase)).greater_elem(-0.2)
    }

    fn chosen<const D: usize>(&self, x: Tensor<D>) -> Tensor<D> {
        match self.only {
            Some(item) => x.narrow(0, item, 1),
            None => x,
        }
    }

    fn leaf<const D: usize>(&self, x: Tensor<D>) -> Tensor<D> {
        let reversed: [isize; D] = std::array::from_fn(|axis| (D - 1 - axis) as isize);
        let permute = move |x: Tensor<D>, order: Order| if order == Order::Turned { x.permute(reversed) } else { x };
        let order = self.order;
        let leaf = Tensor::<D>::from_data(permute(x, order).into_data(), &self.device).require_grad();
        let kept = leaf.clone();
        let gradient = move |gradients: &Gradients| {
            let gradient = kept.grad(gradients).expect("a leaf of the output");
            permute(gradient, order).into_data().try_to_vec::<f32>().expect("f32 values")
        };
        self.gradients.borrow_mut().push(Box::new(gradient));
        permute(leaf, order)
    }

    /// Computes the case's output.
    pub fn forward(&self, case: &Case) {
        drop((case.run)(self));
    }

    /// The case's output and the gradients of all its inputs, row-major.
    pub fn run(&self, case: &Case) -> Vec<Vec<f32>> {
        let y = (case.run)(self);
        let upstream = self.values(y.dims(), 0.3);
        let upstream = match (self.only, y.dims()[0]) {
            (Some(item), length) => {
                let all = self.values([length * self.sizes.items], 0.3);
                all.narrow(0, item * length, length)
            }
            _ => upstream,
        };
        let gradients = (y.clone() * upstream).sum().backward();
        let mut all = vec![y.into_data().try_to_vec::<f32>().expect("f32 values")];
        all.extend(self.gradients.borrow().iter().map(|gradient| gradient(&gradients)));
        all
    }
}

/// An operation; its output is given flat, batch items first.
pub struct Case {
    pub name: &'static str,
    run: Box<dyn Fn(&Feed) -> Tensor<1> + Send + Sync>,
}

fn flat<const D: usize>(x: Tensor<D>) -> Tensor<1> {
    x.flatten(0, D - 1)
}

fn case<const D: usize>(
    cases: &mut Vec<Case>,
    name: &'static str,
    run: impl Fn(&Feed) -> Tensor<D> + Send + Sync + 'static,
) {
    cases.push(Case { name, run: Box::new(move |feed| flat(run(feed))) });
}

pub fn all() -> Vec<Case> {
    let mut cases = Vec::new();
    elementwise(&mut cases);
    norms(&mut cases);
    products(&mut cases);
    pictures(&mut cases);
    sampling(&mut cases);
    cases
}

fn tokens(feed: &Feed, phase: f64) -> Tensor<3> {
    let s = feed.sizes;
    feed.batched([s.items, s.tokens, s.width], phase)
}

fn elementwise(c: &mut Vec<Case>) {
    case(c, "gelu", |feed| ops::gelu(tokens(feed, 0.0) * 4.0));
    case(c, "gelu_tanh", |feed| ops::gelu_tanh(tokens(feed, 0.0) * 4.0));
    case(c, "silu", |feed| ops::silu(tokens(feed, 0.0) * 4.0));
    case(c, "softmax", |feed| ops::softmax(tokens(feed, 0.0) * 4.0));
}

fn norms(c: &mut Vec<Case>) {
    case(c, "layer_norm", |feed| {
        let (gain, bias) = (feed.shared([feed.sizes.width], 1.0), feed.shared([feed.sizes.width], 2.0));
        ops::layer_norm(tokens(feed, 0.0), Some(gain), Some(bias), 1e-5)
    });
    case(c, "modulated_layer_norm", |feed| {
        let [shift, scale] = [1.0, 2.0].map(|phase| feed.batched([feed.sizes.items, 1, feed.sizes.width], phase));
        ops::modulated_layer_norm(tokens(feed, 0.0), shift, scale, 1e-6)
    });
    case(c, "rms_norm", |feed| ops::rms_norm(tokens(feed, 0.0), feed.shared([feed.sizes.width], 1.0), 1e-6));
    case(c, "group_norm_silu", |feed| {
        let s = feed.sizes;
        let x = feed.batched([s.items, s.width, s.height, s.columns], 0.0);
        ops::group_norm_silu(x, 4, feed.shared([s.width], 1.0), feed.shared([s.width], 2.0), 1e-5)
    });
}

fn products(c: &mut Vec<Case>) {
    case(c, "linear", |feed| {
        let width = feed.sizes.width;
        ops::linear(tokens(feed, 0.0), feed.shared([24, width], 1.0), Some(feed.shared([24], 2.0)))
    });
    case(c, "rotary", |feed| {
        let s = feed.sizes;
        let angles = feed.values([2, s.tokens, s.width / 2], 0.2) * 3.0;
        let x = feed.batched([s.items, 2, s.tokens, s.width], 0.0);
        ops::rotary(x, angles.clone().cos(), angles.sin())
    });
    case(c, "attention", |feed| {
        let s = feed.sizes;
        let [q, k, v] = [0.0, 1.0, 2.0].map(|phase| feed.batched([s.items, 2, s.tokens, s.width], phase));
        ops::attention(q, k, v, Some(feed.mask([s.items, 1, s.tokens, s.tokens], 0.4)))
    });
    case(c, "rotary_attention", |feed| {
        let s = feed.sizes;
        let angles = feed.values([1, s.tokens, s.width / 2], 0.2) * 3.0;
        let gains = [1.0, 2.0].map(|phase| feed.shared([s.width], phase));
        let qkv = feed.batched([s.items, s.tokens, 6 * s.width], 0.0);
        ops::rotary_attention(qkv, gains, [angles.clone().cos(), angles.sin()], 2, 1e-6)
    });
}

fn pictures(c: &mut Vec<Case>) {
    for (name, stride) in [("conv2d", 1), ("conv2d, stride 2", 2)] {
        case(c, name, move |feed| {
            let s = feed.sizes;
            let x = feed.batched([s.items, s.width, s.height, s.columns], 0.0);
            let weight = feed.shared([6, s.width, 3, 3], 1.0);
            ops::conv2d(x, weight, Some(feed.shared([6], 2.0)), [stride; 2], [1; 2])
        });
    }
    case(c, "conv3d", |feed| {
        let s = feed.sizes;
        let x = feed.batched([s.items, s.width, 3, s.height, s.columns], 0.0);
        let weight = feed.shared([6, s.width, 3, 3, 3], 1.0);
        ops::conv3d(x, weight, Some(feed.shared([6], 2.0)), [1; 3], [1; 3])
    });
    case(c, "resize_bilinear", |feed| {
        let s = feed.sizes;
        let x = feed.batched([s.items, s.width, s.height, s.columns], 0.0);
        ops::resize_bilinear(x, [s.height + 3, 2 * s.columns], PixelCentres::Half)
    });
}

fn sampling(c: &mut Vec<Case>) {
    case(c, "grid_sample_2d", |feed| {
        let s = feed.sizes;
        let x = feed.batched([s.items, s.width, s.height, s.columns], 0.0);
        let grid = feed.batched([s.items, 1, s.points, 2], 1.0) * 1.2;
        ops::grid_sample_2d(x, grid, false, Interpolation::Bilinear)
    });
    case(c, "grid_sample_3d", |feed| {
        let s = feed.sizes;
        let x = feed.batched([s.items, s.width, 3, s.height, s.columns], 0.0);
        ops::grid_sample_3d(x, feed.batched([s.items, 1, 1, s.points, 3], 1.0) * 1.2)
    });
    case(c, "deformable_views_2d", |feed| {
        let s = feed.sizes;
        let shapes = [[s.height, s.columns], [1, 2]];
        let values = feed.batched([s.items, 2, s.height * s.columns + 2, 2, s.width], 0.0);
        let reference = feed.chosen(feed.values([s.items, 2, s.points, 2], 3.0)) * 0.6 + 0.5;
        let visible = feed.mask([s.items, 2, s.points], 0.1);
        let offsets = feed.batched([s.items, s.points, 2, 2, 3, 2], 1.0) * 2.0;
        let weights = feed.batched([s.items, s.points, 2, 2, 3], 2.0);
        ops::deformable_views_2d(values, &shapes, reference, visible, offsets, weights)
    });
    case(c, "deformable_rays_3d", |feed| {
        let s = feed.sizes;
        let shapes = [[2, s.height, s.columns]];
        let values = feed.batched([s.items, 2 * s.height * s.columns, 2, s.width], 0.0);
        let reference = feed.chosen(feed.values([s.items, 2, s.points, 3], 3.0)) * 0.6 + 0.5;
        let valid = feed.mask([s.items, 2, s.points], 0.1);
        let offsets = feed.batched([s.items, 2 * s.points, 2, 1, 3, 3], 1.0) * 2.0;
        let weights = feed.batched([s.items, 2 * s.points, 2, 1, 3], 2.0);
        ops::deformable_rays_3d(values, &shapes, reference, valid, offsets, weights)
    });
}
