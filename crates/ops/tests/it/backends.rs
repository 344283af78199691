//! Every operation on another device against the fused CPU kernels, forward and gradients.
//!
//! Without further features the "other device" is the composition on `flex`; the features `ndarray` and `wgpu` add theirs.

use burn::tensor::{Bool, Device, Tensor, TensorData};
use ops::{Interpolation, PixelCentres};

/// Smooth values in [-1, 1] without a random generator, which would differ between backends.
fn wave<const D: usize>(shape: [usize; D], phase: f64) -> TensorData {
    let count = shape.iter().product::<usize>();
    let values: Vec<f32> = (0..count).map(|i| ((i as f64 * 0.7311 + phase).sin() * 0.97) as f32).collect();
    TensorData::new(values, shape)
}

/// Operations on one device; collects outputs and gradients as host vectors, in order.
struct Probe {
    device: Device,
    results: Vec<(String, Vec<f32>)>,
}

impl Probe {
    /// A flat leaf and its shaped form; flat, so that leaves of different ranks fit one list.
    fn leaf<const D: usize>(&self, shape: [usize; D], phase: f64) -> (Tensor<1>, Tensor<D>) {
        let data = wave([shape.iter().product()], phase);
        let leaf = Tensor::<1>::from_data(data, &self.device).require_grad();
        (leaf.clone(), leaf.reshape(shape))
    }

    fn mask<const D: usize>(&self, shape: [usize; D], phase: f64) -> Tensor<D, Bool> {
        Tensor::<D>::from_data(wave(shape, phase), &self.device).greater_elem(-0.2)
    }

    fn keep<const D: usize>(&mut self, name: String, x: Tensor<D>) {
        let values = x.into_data().convert::<f32>().try_to_vec::<f32>().expect("f32 values");
        self.results.push((name, values));
    }

    /// Records an output and the gradients of `inputs` under a fixed upstream gradient.
    fn record<const O: usize>(&mut self, name: &str, inputs: &[&Tensor<1>], output: Tensor<O>) {
        let upstream = Tensor::<O>::from_data(wave(output.dims(), 0.3), &self.device);
        self.keep(format!("{name}: output"), output.clone());
        let gradients = (output * upstream).sum().backward();
        for (i, input) in inputs.iter().enumerate() {
            let gradient = input.grad(&gradients).expect("every input is a leaf of the output");
            self.keep(format!("{name}: gradient {i}"), gradient);
        }
    }

    fn run(mut self) -> Vec<(String, Vec<f32>)> {
        self.elementwise_and_norms();
        self.affine();
        self.attention();
        self.grids();
        self.resizing();
        self.deformable();
        self.sums();
        self.results
    }

    fn elementwise_and_norms(&mut self) {
        for function in [ops::gelu, ops::gelu_tanh, ops::silu, ops::softmax] {
            let (leaf, x) = self.leaf([3, 5, 24], 0.0);
            self.record("activation", &[&leaf], function(x * 4.0));
        }
        for (with_gain, with_bias) in [(false, false), (true, false), (true, true)] {
            let (leaf, x) = self.leaf([3, 5, 24], 0.0);
            let ((gain_leaf, gain), (bias_leaf, bias)) = (self.leaf([24], 1.0), self.leaf([24], 2.0));
            let y = ops::layer_norm(x, with_gain.then_some(gain), with_bias.then_some(bias), 1e-5);
            let inputs = [&leaf, &gain_leaf, &bias_leaf];
            self.record("layer_norm", &inputs[..1 + with_gain as usize + with_bias as usize], y);
        }
        let ((leaf, x), (shift_leaf, shift)) = (self.leaf([3, 5, 24], 0.0), self.leaf([3, 1, 24], 1.0));
        let (scale_leaf, scale) = self.leaf([3, 1, 24], 2.0);
        let y = ops::modulated_layer_norm(x, shift, scale, 1e-6);
        self.record("modulated_layer_norm", &[&leaf, &shift_leaf, &scale_leaf], y);
        let ((leaf, x), (gain_leaf, gain)) = (self.leaf([3, 5, 24], 0.0), self.leaf([24], 1.0));
        self.record("rms_norm", &[&leaf, &gain_leaf], ops::rms_norm(x, gain, 1e-6));
        for norm in [ops::group_norm, ops::group_norm_silu] {
            let (leaf, x) = self.leaf([2, 24, 3, 5], 0.5);
            let ((gain_leaf, gain), (bias_leaf, bias)) = (self.leaf([24], 1.0), self.leaf([24], 2.0));
            self.record("group_norm", &[&leaf, &gain_leaf, &bias_leaf], norm(x, 8, gain, bias, 1e-5));
        }
    }

    fn affine(&mut self) {
        for with_bias in [false, true] {
            let ((leaf, x), (weight_leaf, weight)) = (self.leaf([2, 7, 24], 0.0), self.leaf([5, 24], 1.0));
            let (bias_leaf, bias) = self.leaf([5], 2.0);
            let y = ops::linear(x, weight, with_bias.then_some(bias));
            self.record("linear", &[&leaf, &weight_leaf, &bias_leaf][..2 + with_bias as usize], y);
        }
        for (stride, padding) in [(1, 1), (2, 1)] {
            let ((leaf, x), (weight_leaf, weight)) = (self.leaf([2, 3, 6, 8], 0.0), self.leaf([4, 3, 3, 3], 1.0));
            let (bias_leaf, bias) = self.leaf([4], 2.0);
            let y = ops::conv2d(x, weight, Some(bias), [stride; 2], [padding; 2]);
            self.record("conv2d", &[&leaf, &weight_leaf, &bias_leaf], y);
        }
        let ((leaf, x), (weight_leaf, weight)) = (self.leaf([1, 3, 3, 4, 5], 0.0), self.leaf([2, 3, 3, 3, 3], 1.0));
        let (bias_leaf, bias) = self.leaf([2], 2.0);
        let y = ops::conv3d(x, weight, Some(bias), [1; 3], [1; 3]);
        self.record("conv3d", &[&leaf, &weight_leaf, &bias_leaf], y);
    }

    fn attention(&mut self) {
        let ((leaf, qkv), (query_leaf, query_gain)) = (self.leaf([2, 5, 48], 0.0), self.leaf([8], 1.0));
        let (key_leaf, key_gain) = self.leaf([8], 2.0);
        let angles = Tensor::<3>::from_data(wave([2, 5, 4], 0.2), &self.device);
        let y = ops::rotary_attention(qkv, [query_gain, key_gain], [angles.clone().cos(), angles.sin()], 2, 1e-6);
        self.record("rotary_attention", &[&leaf, &query_leaf, &key_leaf], y);
        let mask = self.mask([2, 1, 5, 7], 0.4);
        let some_rows_empty = mask.clone().bool_and(self.mask([2, 1, 5, 1], 9.0).expand([2, 1, 5, 7]));
        for mask in [None, Some(mask), Some(some_rows_empty)] {
            let ((q_leaf, q), (k_leaf, k)) = (self.leaf([2, 3, 5, 8], 0.0), self.leaf([2, 3, 7, 8], 1.0));
            let (v_leaf, v) = self.leaf([2, 3, 7, 8], 2.0);
            let angles = Tensor::<3>::from_data(wave([3, 5, 4], 0.2), &self.device);
            let q = ops::rotary(q, angles.clone().cos(), angles.sin());
            self.record("rotary and attention", &[&q_leaf, &k_leaf, &v_leaf], ops::attention(q, k, v, mask));
        }
    }

    fn grids(&mut self) {
        for (align, mode) in [
            (false, Interpolation::Bilinear),
            (true, Interpolation::Bilinear),
            (false, Interpolation::Nearest),
            (true, Interpolation::Nearest),
        ] {
            let ((leaf, input), (grid_leaf, grid)) = (self.leaf([2, 3, 4, 6], 0.0), self.leaf([2, 3, 5, 2], 1.0));
            let y = ops::grid_sample_2d(input, grid * 1.2, align, mode);
            let inputs = [&leaf, &grid_leaf];
            self.record("grid_sample_2d", if mode == Interpolation::Nearest { &inputs[..1] } else { &inputs }, y);
        }
        // Odd and even numbers of points: only even ones are computed in vectors on GPUs.
        for points in [[1, 3, 5], [2, 3, 5], [2, 2, 4]] {
            let [z, y, x] = points;
            let (leaf, input) = self.leaf([2, 3, 3, 4, 5], 0.0);
            let (grid_leaf, grid) = self.leaf([2, z, y, x, 3], 1.0);
            self.record("grid_sample_3d", &[&leaf, &grid_leaf], ops::grid_sample_3d(input, grid * 1.2));
            let (leaf, input) = self.leaf([2, 4, 4, 6], 0.0);
            let (grid_leaf, grid) = self.leaf([2, z * y, x, 2], 1.0);
            let y = ops::grid_sample_2d(input, grid * 1.2, false, Interpolation::Bilinear);
            self.record("grid_sample_2d", &[&leaf, &grid_leaf], y);
        }
    }

    fn resizing(&mut self) {
        for (size, centres) in [([7, 3], PixelCentres::Half), ([2, 9], PixelCentres::Corner)] {
            let (leaf, x) = self.leaf([2, 3, 4, 6], 0.0);
            self.record("resize_bilinear", &[&leaf], ops::resize_bilinear(x, size, centres));
        }
    }

    fn sums(&mut self) {
        for function in [ops::sum_dim, ops::mean_dim] {
            let (leaf, x) = self.leaf([2, 3, 16, 4], 0.0);
            let y = function(x, 1).reshape([2, 16, 4]).swap_dims(1, 2).reshape([2, 4, 4, 4]);
            self.record("sum along an axis, gradient permuted", &[&leaf], y);
        }
    }

    fn deformable(&mut self) {
        let (b, v, q, m, c, p) = (2, 3, 10, 2, 8, 3);
        let (values_leaf, values) = self.leaf([b, v, 30, m, c], 0.0);
        let (offsets_leaf, offsets) = self.leaf([b, q, m, 2, p, 2], 1.0);
        let (weights_leaf, weights) = self.leaf([b, q, m, 2, p], 2.0);
        let reference = Tensor::<4>::from_data(wave([b, v, q, 2], 3.0), &self.device) * 0.6 + 0.5;
        let visible = self.mask([b, v, q], 0.1);
        let y = ops::deformable_views_2d(values, &[[4, 6], [2, 3]], reference, visible, offsets * 2.0, weights);
        self.record("deformable_views_2d", &[&values_leaf, &offsets_leaf, &weights_leaf], y);

        let (values_leaf, values) = self.leaf([b, 54, m, c], 0.0);
        let (offsets_leaf, offsets) = self.leaf([b, v * q, m, 2, p, 3], 1.0);
        let (weights_leaf, weights) = self.leaf([b, v * q, m, 2, p], 2.0);
        let reference = Tensor::<4>::from_data(wave([b, v, q, 3], 3.0), &self.device) * 0.6 + 0.5;
        let valid = self.mask([b, v, q], 0.1);
        let y = ops::deformable_rays_3d(values, &[[2, 4, 6], [1, 2, 3]], reference, valid, offsets * 2.0, weights);
        self.record("deformable_rays_3d", &[&values_leaf, &offsets_leaf, &weights_leaf], y);
    }
}

fn probe(device: Device) -> Vec<(String, Vec<f32>)> {
    Probe { device: device.autodiff(), results: Vec::new() }.run()
}

/// All values are of order 1 and at most some hundred f32 products are summed, so 2e-5 leaves an order of magnitude over
/// rounding; sampling positions are the same f32 numbers on every backend.
fn compare(other: Vec<(String, Vec<f32>)>) {
    let fused = probe(Device::flex());
    assert_eq!(fused.len(), other.len());
    let mut wrong = Vec::new();
    for ((name, a), (_, b)) in fused.iter().zip(&other) {
        assert_eq!(a.len(), b.len(), "{name}");
        let excess = |(a, b): (&f32, &f32)| (a - b).abs() / (2e-5 * (1.0 + a.abs()));
        let worst = a.iter().zip(b).map(excess).fold(0.0, f32::max);
        if worst.is_nan() || worst > 1.0 {
            wrong.push(format!("{name}: {worst:.1} times the tolerance"));
        }
    }
    assert!(wrong.is_empty(), "{}", wrong.join("\n"));
}

#[test]
fn composition_agrees() {
    compare(ops::composed_only(|| probe(Device::flex())));
}

#[cfg(feature = "ndarray")]
#[test]
fn ndarray_agrees() {
    // Deprecated upstream, still a supported choice here.
    #[allow(deprecated)]
    compare(probe(Device::ndarray()));
}

#[cfg(feature = "wgpu")]
#[test]
fn wgpu_agrees() {
    compare(probe(Device::wgpu(burn::tensor::DeviceKind::DefaultDevice)));
}
