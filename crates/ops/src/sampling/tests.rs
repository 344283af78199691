//! Analytic cases, finite differences, kernel against composition, independence of the thread count.

use burn::tensor::{Bool, Device, Tensor, TensorData};

use super::core::{Levels, Sampling, sample_views};
use super::{deformable_rays_3d, deformable_sample_2d, deformable_views_2d};
use crate::composed_only;

fn device() -> Device {
    Device::flex().autodiff()
}

fn normal<const D: usize>(shape: [usize; D]) -> Tensor<D> {
    crate::noise::normal(shape, 0.0, 1.0, &device())
}

fn uniform<const D: usize>(shape: [usize; D], from: f64, to: f64) -> Tensor<D> {
    crate::noise::uniform(shape, from, to, &device())
}

fn constant<const D: usize>(values: &[f32], shape: [usize; D]) -> Tensor<D> {
    Tensor::from_data(TensorData::new(values.to_vec(), shape), &device())
}

fn mask<const D: usize>(values: &[bool], shape: [usize; D]) -> Tensor<D, Bool> {
    Tensor::from_data(TensorData::new(values.to_vec(), shape), &device())
}

fn floats<const D: usize>(x: Tensor<D>) -> Vec<f32> {
    x.into_data().try_to_vec().unwrap()
}

/// Output and the gradients of values, offsets and weights.
fn run(levels: &Levels, sampling: &Sampling, upstream: &Tensor<3>) -> [Vec<f32>; 4] {
    let leaves = Sampling {
        values: sampling.values.clone().require_grad(),
        offsets: sampling.offsets.clone().require_grad(),
        weights: sampling.weights.clone().require_grad(),
        ..sampling.clone()
    };
    let output = sample_views(levels, leaves.clone());
    let gradients = (output.clone() * upstream.clone()).sum().backward();
    [
        floats(output),
        floats(leaves.values.grad(&gradients).unwrap()),
        floats(leaves.offsets.grad(&gradients).unwrap()),
        floats(leaves.weights.grad(&gradients).unwrap()),
    ]
}

/// A case with points inside, at the border and far outside, and queries that 0 to V views see.
fn case(levels: &Levels, [n, v, q, m, c, p]: [usize; 6]) -> (Sampling, Tensor<3>) {
    let (l, d) = (levels.extents.len(), levels.axes);
    let sampling = Sampling {
        values: normal([n, v, levels.total(), m, c]),
        reference: uniform([n, v, q, d], -0.2, 1.2),
        visible: uniform([n, v, q], 0.0, 1.0).lower_elem(0.5),
        offsets: normal([n, q, m, l, p, d]) * 2.0,
        weights: normal([n, q, m, l, p]),
    };
    (sampling, normal([n, q, m * c]))
}

fn all_levels() -> [Levels; 3] {
    [
        Levels::maps(&[[5, 9], [3, 4], [1, 2]], 0.5),
        Levels::volumes(&[[3, 5, 4], [2, 1, 3]], 0.5),
        Levels::maps(&[[4, 7]], 0.0),
    ]
}

#[test]
fn kernel_equals_the_composition() {
    for levels in all_levels() {
        for c in [1, 3, 8, 16, 24, 32] {
            let (sampling, upstream) = case(&levels, [2, 3, 300, 2, c, 3]);
            let fused = run(&levels, &sampling, &upstream);
            let composed = composed_only(|| run(&levels, &sampling, &upstream));
            for (name, (a, b)) in ["output", "values", "offsets", "weights"].iter().zip(fused.iter().zip(&composed)) {
                let error = a.iter().zip(b).map(|(a, b)| (a - b).abs() / (1.0 + b.abs())).fold(0.0, f32::max);
                assert!(error < 1e-5, "{name} with {c} channels on {levels:?}: {error:e}");
            }
        }
    }
}

#[test]
fn bits_do_not_depend_on_the_thread_count() {
    for levels in all_levels() {
        // Long enough for several runs of queries per slice.
        let (sampling, upstream) = case(&levels, [1, 2, 5000, 2, 8, 2]);
        let on = |threads| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
            pool.install(|| run(&levels, &sampling, &upstream))
        };
        let bits = |result: [Vec<f32>; 4]| result.map(|x| x.into_iter().map(f32::to_bits).collect::<Vec<u32>>());
        let one = bits(on(1));
        assert!(one == bits(on(4)) && one == bits(on(7)));
    }
}

/// Central differences of `sum(output · upstream)`, away from the kinks at pixel centres.
#[test]
fn gradients_equal_finite_differences() {
    for levels in [Levels::maps(&[[3, 4], [2, 2]], 0.5), Levels::volumes(&[[2, 3, 4]], 0.5)] {
        let (mut sampling, upstream) = case(&levels, [1, 2, 3, 2, 3, 2]);
        // References on pixel borders of every level and offsets of 0.1 to 0.4 pixels: no step crosses a centre.
        sampling.reference = sampling.reference.zeros_like() + 0.5;
        sampling.offsets = uniform(sampling.offsets.dims(), 0.1, 0.4);
        let [_, values, offsets, weights] = run(&levels, &sampling, &upstream);
        let loss = |sampling: Sampling| (sample_views(&levels, sampling) * upstream.clone()).sum().into_scalar::<f32>();
        let step = 1e-2f32;
        let slope = |x: &Tensor<1>, i: usize, with: &dyn Fn(Tensor<1>) -> Sampling| {
            let mut bump = vec![0.0; x.dims()[0]];
            bump[i] = step;
            let bump = constant(&bump, x.dims());
            (loss(with(x.clone() + bump.clone())) - loss(with(x.clone() - bump))) / (2.0 * step)
        };
        let check = |name: &str, exact: &[f32], x: Tensor<1>, with: &dyn Fn(Tensor<1>) -> Sampling| {
            for (i, &exact) in exact.iter().enumerate().step_by(3) {
                let slope = slope(&x, i, with);
                // The loss is linear in each single argument here; what is left is f32 rounding over the step.
                assert!((exact - slope).abs() < 2e-3 * (1.0 + exact.abs()), "{name}[{i}]: {exact} against {slope}");
            }
        };
        let s = &sampling;
        let (v, o, w) = (s.values.dims(), s.offsets.dims(), s.weights.dims());
        check("values", &values, flat(&s.values), &|x| Sampling { values: x.reshape(v), ..s.clone() });
        check("offsets", &offsets, flat(&s.offsets), &|x| Sampling { offsets: x.reshape(o), ..s.clone() });
        check("weights", &weights, flat(&s.weights), &|x| Sampling { weights: x.reshape(w), ..s.clone() });
    }
}

fn flat<const D: usize>(x: &Tensor<D>) -> Tensor<1> {
    x.clone().reshape([x.dims().iter().product::<usize>()])
}

/// Runs a check with the kernel and with the composition.
fn both(check: impl Fn()) {
    check();
    composed_only(check);
}

#[test]
fn mean_over_no_one_and_two_views() {
    both(|| {
        // One pixel per view: view 0 holds 2, view 1 holds 6.
        let values = constant(&[2.0, 6.0], [1, 2, 1, 1, 1]);
        let reference = constant(&[0.5; 12], [1, 2, 3, 2]);
        let visible = mask(&[false, true, true, false, false, true], [1, 2, 3]);
        let offsets = constant(&[0.0; 6], [1, 3, 1, 1, 1, 2]);
        let weights = constant(&[1.0; 3], [1, 3, 1, 1, 1]);
        let output = deformable_views_2d(values, &[[1, 1]], reference, visible, offsets, weights);
        assert_eq!(floats(output), [0.0, 2.0, 4.0]);
    });
}

#[test]
fn pixel_centres_return_the_index_and_axes_do_not_swap() {
    both(|| {
        let (h, w) = (3, 5);
        let index: Vec<f32> = (0..h * w).map(|i| i as f32).collect();
        let centres: Vec<f32> = (0..h * w).flat_map(|i| [(i % w) as f32 + 0.5, (i / w) as f32 + 0.5]).collect();
        let q = h * w;
        // The whole coordinate as offset: reference 0 is the border, so offset x + 0.5 is the centre of column x.
        let output = deformable_views_2d(
            constant(&index, [1, 1, q, 1, 1]),
            &[[h, w]],
            constant(&vec![0.0; 2 * q], [1, 1, q, 2]),
            mask(&vec![true; q], [1, 1, q]),
            constant(&centres, [1, q, 1, 1, 1, 2]),
            constant(&vec![1.0; q], [1, q, 1, 1, 1]),
        );
        assert_eq!(floats(output), index);
    });
}

#[test]
fn unit_coordinates_scale_by_their_own_axis() {
    both(|| {
        // value = 100·z + 10·y + x on a 2×3×4 volume, sampled between centres: linear interpolation is exact.
        let shape = [2, 3, 4];
        let values: Vec<f32> = (0..24).map(|i| (100 * (i / 12) + 10 * (i / 4 % 3) + i % 4) as f32).collect();
        let (x, y, z) = (2.25f32, 0.75, 0.5);
        let reference = [(x + 0.5) / 4.0, (y + 0.5) / 3.0, (z + 0.5) / 2.0, 0.5, 0.5, 0.5];
        let output = deformable_rays_3d(
            constant(&values, [1, 24, 1, 1]),
            &[shape],
            constant(&reference, [1, 1, 2, 3]),
            mask(&[true, false], [1, 1, 2]),
            constant(&[0.0; 6], [1, 2, 1, 1, 1, 3]),
            constant(&[1.0; 2], [1, 2, 1, 1, 1]),
        );
        let output = floats(output);
        assert!((output[0] - (100.0 * z + 10.0 * y + x)).abs() < 1e-4 && output[1] == 0.0, "{output:?}");
    });
}

#[test]
fn masked_queries_give_nothing_and_get_nothing() {
    both(|| {
        let values = normal([1, 6, 2, 4]).require_grad();
        let locations = uniform([1, 3, 2, 1, 2, 2], 0.2, 0.8).require_grad();
        let weights = uniform([1, 3, 2, 1, 2], 0.1, 1.0).require_grad();
        let sample = |mask| deformable_sample_2d(values.clone(), &[[2, 3]], locations.clone(), weights.clone(), mask);
        let masked = sample(Some(mask(&[true, false, true], [1, 3])));
        let full = sample(None);
        assert_eq!(floats(masked.clone().narrow(1, 0, 1)), floats(full.clone().narrow(1, 0, 1)));
        assert!(floats(masked.clone().narrow(1, 1, 1)).iter().all(|&x| x == 0.0));
        assert_eq!(floats(masked.clone().narrow(1, 2, 1)), floats(full.narrow(1, 2, 1)));
        let gradients = masked.sum().backward();
        for gradient in
            [locations.grad(&gradients).unwrap().reshape([3, 8]), weights.grad(&gradients).unwrap().reshape([3, 4])]
        {
            let used = crate::sum_dim(gradient.abs(), 1);
            let used = used.into_data().try_to_vec::<f32>().unwrap();
            assert!(used[0] > 0.0 && used[1] == 0.0 && used[2] > 0.0, "{used:?}");
        }
    });
}

#[test]
fn nan_locations_are_not_hidden() {
    both(|| {
        let output = deformable_sample_2d(
            normal([1, 6, 1, 2]),
            &[[2, 3]],
            constant(&[f32::NAN, 0.5], [1, 1, 1, 1, 1, 2]),
            constant(&[1.0], [1, 1, 1, 1, 1]),
            None,
        );
        assert!(floats(output).iter().all(|x| x.is_nan()));
    });
}
