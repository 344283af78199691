//! Convolutions in two and three dimensions.

mod kernel;
mod layout;
mod window;

use burn::tensor::Tensor;
use burn::tensor::module::{conv2d as stock_conv2d, conv3d as stock_conv3d};
use burn::tensor::ops::ConvOptions;

use crate::fused::{fused_2, fused_3, on_flex};
use kernel::Convolution;
use window::Window;

/// 2-D convolution (cross-correlation) with zeros around the picture.
///
/// # Shapes
/// - x: `[B, C, H, W]`
/// - weight: `[O, C, h, w]`
/// - bias: `[O]`; absent means 0
/// - output: `[B, O, (H + 2p - h)/s + 1, (W + 2p - w)/s + 1]` with stride s and padding p, rounded down
///
/// # Panics
/// If the shapes disagree, the stride is 0, or the padded picture is smaller than the kernel.
#[must_use]
pub fn conv2d(
    x: Tensor<4>,
    weight: Tensor<4>,
    bias: Option<Tensor<1>>,
    stride: [usize; 2],
    padding: [usize; 2],
) -> Tensor<4> {
    let ([b, c_in, h, w], [c_out, weight_in, kh, kw]) = (x.dims(), weight.dims());
    check(c_in, weight_in, c_out, bias.as_ref());
    if !on_flex(&x) {
        return stock_conv2d(x, weight, bias, ConvOptions::new(stride, padding, [1, 1], 1));
    }
    let window = Window::new([1, h, w], [1, kh, kw], [1, stride[0], stride[1]], [0, padding[0], padding[1]]);
    let [_, out_h, out_w] = window.output;
    let kernel = Convolution { output_shape: vec![b, c_out, out_h, out_w], c_in, c_out, window };
    match bias {
        Some(bias) => fused_3(kernel, x, weight, bias),
        None => fused_2(kernel, x, weight),
    }
}

/// 3-D convolution (cross-correlation) with zeros around the volume.
///
/// # Shapes
/// - x: `[B, C, D, H, W]`
/// - weight: `[O, C, d, h, w]`
/// - bias: `[O]`; absent means 0
/// - output: `[B, O, (D + 2p - d)/s + 1, …]` with stride s and padding p, rounded down
///
/// # Panics
/// If the shapes disagree, the stride is 0, or the padded volume is smaller than the kernel.
#[must_use]
pub fn conv3d(
    x: Tensor<5>,
    weight: Tensor<5>,
    bias: Option<Tensor<1>>,
    stride: [usize; 3],
    padding: [usize; 3],
) -> Tensor<5> {
    let ([b, c_in, size @ ..], [c_out, weight_in, taps @ ..]) = (x.dims(), weight.dims());
    check(c_in, weight_in, c_out, bias.as_ref());
    if !on_flex(&x) {
        return stock_conv3d(x, weight, bias, ConvOptions::new(stride, padding, [1, 1, 1], 1));
    }
    let window = Window::new(size, taps, stride, padding);
    let [out_d, out_h, out_w] = window.output;
    let kernel = Convolution { output_shape: vec![b, c_out, out_d, out_h, out_w], c_in, c_out, window };
    match bias {
        Some(bias) => fused_3(kernel, x, weight, bias),
        None => fused_2(kernel, x, weight),
    }
}

fn check(c_in: usize, weight_in: usize, c_out: usize, bias: Option<&Tensor<1>>) {
    assert_eq!(c_in, weight_in, "input channels of the map and of the kernel");
    if let Some(bias) = bias {
        assert_eq!(bias.dims(), [c_out], "one bias per output channel");
    }
}

#[cfg(test)]
mod tests {
    use burn::tensor::{Device, Int, Tensor, TensorData};

    use super::*;
    use crate::composed_only;

    fn wave<const R: usize>(shape: [usize; R], phase: f32, device: &Device) -> Tensor<R> {
        let count = shape.iter().product::<usize>() as i64;
        (Tensor::<1, Int>::arange(0..count, device).float() * 0.37 + phase).sin().reshape(shape)
    }

    fn assert_close(fused: Vec<TensorData>, composed: Vec<TensorData>, what: &str) {
        for (fused, composed) in fused.into_iter().zip(composed) {
            assert_eq!(fused.shape(), composed.shape(), "{what}");
            let values = |data: TensorData| data.try_to_vec::<f32>().unwrap();
            for (a, b) in values(fused).into_iter().zip(values(composed)) {
                assert!((a - b).abs() <= 2e-5 * (1.0 + b.abs()), "{what}: {a} {b}");
            }
        }
    }

    #[test]
    fn planes_equal_the_stock_convolution() {
        let device = Device::flex().autodiff();
        // (batch, in, out, picture, kernel, stride, padding)
        let cases = [
            (2, 3, 4, [5, 7], [3, 3], [1, 1], [1, 1]),
            (1, 1, 1, [1, 1], [1, 1], [1, 1], [0, 0]),
            (3, 5, 2, [6, 4], [1, 1], [1, 1], [0, 0]),
            (2, 4, 6, [8, 9], [3, 3], [2, 2], [1, 1]),
            (1, 2, 3, [7, 6], [2, 5], [1, 3], [0, 2]),
            (2, 3, 2, [9, 9], [4, 4], [4, 4], [0, 0]),
            (2, 3, 2, [8, 8], [3, 3], [2, 2], [0, 0]),
            (1, 24, 24, [32, 32], [3, 3], [1, 1], [1, 1]),
        ];
        for (b, c, o, [h, w], [kh, kw], stride, padding) in cases {
            let x = wave([b, c, h, w], 0.0, &device).require_grad();
            let weight = wave([o, c, kh, kw], 1.0, &device).require_grad();
            let bias = wave([o], 2.0, &device).require_grad();
            for with_bias in [false, true] {
                let run = || {
                    let y = conv2d(x.clone(), weight.clone(), with_bias.then(|| bias.clone()), stride, padding);
                    let gradients = (y.clone() * wave(y.dims(), 0.5, &device)).sum().backward();
                    let mut all = vec![y.into_data(), x.grad(&gradients).unwrap().into_data()];
                    all.push(weight.grad(&gradients).unwrap().into_data());
                    all.extend(with_bias.then(|| bias.grad(&gradients).unwrap().into_data()));
                    all
                };
                let what = format!("{b}x{c}x{h}x{w} {o}x{kh}x{kw} stride {stride:?} padding {padding:?}");
                assert_close(run(), composed_only(run), &what);
            }
        }
    }

    #[test]
    fn volumes_equal_the_stock_convolution() {
        let device = Device::flex().autodiff();
        let cases = [
            (2, 3, 4, [3, 5, 4], [3, 3, 3], [1, 1, 1], [1, 1, 1]),
            (1, 2, 3, [4, 6, 5], [2, 2, 2], [2, 2, 2], [0, 0, 0]),
            (1, 2, 2, [5, 3, 3], [3, 1, 1], [1, 1, 1], [1, 0, 0]),
            (2, 2, 2, [5, 7, 6], [3, 3, 3], [1, 2, 2], [0, 1, 1]),
        ];
        for (b, c, o, [d, h, w], [kd, kh, kw], stride, padding) in cases {
            let x = wave([b, c, d, h, w], 0.0, &device).require_grad();
            let weight = wave([o, c, kd, kh, kw], 1.0, &device).require_grad();
            let bias = wave([o], 2.0, &device).require_grad();
            let run = || {
                let y = conv3d(x.clone(), weight.clone(), Some(bias.clone()), stride, padding);
                let gradients = (y.clone() * wave(y.dims(), 0.5, &device)).sum().backward();
                let mut all = vec![y.into_data(), x.grad(&gradients).unwrap().into_data()];
                all.push(weight.grad(&gradients).unwrap().into_data());
                all.push(bias.grad(&gradients).unwrap().into_data());
                all
            };
            assert_close(run(), composed_only(run), &format!("{d}x{h}x{w} stride {stride:?} padding {padding:?}"));
        }
    }

    #[test]
    fn bits_do_not_depend_on_the_number_of_threads() {
        let run = |threads: usize| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
            pool.install(|| {
                let device = Device::flex().autodiff();
                let x = wave([3, 16, 40, 44], 0.0, &device).require_grad();
                let weight = wave([24, 16, 3, 3], 1.0, &device).require_grad();
                let y = conv2d(x.clone(), weight.clone(), None, [1, 1], [1, 1]);
                let gradients = (y.clone() * y.clone()).sum().backward();
                [y, x.grad(&gradients).unwrap(), weight.grad(&gradients).unwrap()]
                    .map(|t| t.into_data().try_to_vec::<f32>().unwrap())
            })
        };
        let one = run(1);
        assert!(one == run(2) && one == run(3));
    }
}
