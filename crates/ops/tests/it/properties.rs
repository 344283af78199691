//! What holds for every operation: on any shape, in any memory order, on any number of threads, beside any neighbours.

use burn::tensor::{Device, Tensor, TensorData};
use ops::Interpolation;

use super::cases::{Feed, Order, Sizes, all};

/// Several tasks per operation, and no size a multiple of a vector or a tile but the width.
const LARGE: Sizes = Sizes { items: 3, tokens: 203, width: 24, height: 27, columns: 21, points: 2203 };

fn bits(results: Vec<Vec<f32>>) -> Vec<Vec<u32>> {
    results.into_iter().map(|values| values.into_iter().map(f32::to_bits).collect()).collect()
}

#[test]
fn the_number_of_threads_changes_no_bit() {
    for case in all() {
        let on = |threads: usize| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().expect("a pool");
            pool.install(|| bits(Feed::new(LARGE, Order::Plain, None).run(&case)))
        };
        let one = on(1);
        assert!(one == on(2) && one == on(5), "{}", case.name);
    }
}

#[test]
fn memory_order_changes_no_bit() {
    for case in all() {
        let sizes = Sizes { points: 203, ..LARGE };
        let [plain, turned] = [Order::Plain, Order::Turned].map(|order| Feed::new(sizes, order, None).run(&case));
        assert!(bits(plain) == bits(turned), "{}", case.name);
    }
}

#[test]
fn batch_neighbours_change_no_bit() {
    for case in all() {
        let together = Feed::new(LARGE, Order::Plain, None).run(&case);
        for item in 0..LARGE.items {
            let alone = Feed::new(LARGE, Order::Plain, Some(item)).run(&case);
            let length = alone[0].len();
            let part = &together[0][item * length..][..length];
            let differing = part.iter().zip(&alone[0]).filter(|(a, b)| a.to_bits() != b.to_bits()).count();
            assert_eq!(differing, 0, "{}: item {item} of the output", case.name);
            // Gradients of what the items share are sums over them.
            for (together, alone) in together[1..].iter().zip(&alone[1..]) {
                if together.len() == LARGE.items * alone.len() {
                    let part = &together[item * alone.len()..][..alone.len()];
                    let same = part.iter().zip(alone).all(|(a, b)| a.to_bits() == b.to_bits());
                    assert!(same, "{}: item {item} of a gradient", case.name);
                }
            }
        }
    }
}

#[test]
fn an_empty_batch_gives_nothing_and_no_gradient() {
    for case in all() {
        let results = Feed::new(Sizes { items: 0, ..LARGE }, Order::Plain, None).run(&case);
        assert!(results[0].is_empty(), "{}", case.name);
        assert!(results[1..].iter().flatten().all(|&gradient| gradient == 0.0), "{}", case.name);
    }
}

#[test]
fn no_points_give_nothing_and_no_gradient() {
    for case in all().iter().filter(|case| case.name.contains("sample") || case.name.contains("deformable")) {
        let results = Feed::new(Sizes { points: 0, ..LARGE }, Order::Plain, None).run(case);
        assert!(results[0].is_empty(), "{}", case.name);
        assert!(results[1].iter().all(|&gradient| gradient == 0.0), "{}", case.name);
    }
}

/// Sizes from a generator of numbers without any meaning; the first are the smallest there are.
fn random_sizes(count: u64) -> impl Iterator<Item = Sizes> {
    let one = Sizes { items: 1, tokens: 1, width: 8, height: 1, columns: 1, points: 1 };
    let draws = (1..count).map(|seed| {
        let mut state = seed.wrapping_mul(0x9E37_79B9_7F4A_7C15);
        let mut draw = |to: u64| {
            state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
            1 + ((state >> 33) % to) as usize
        };
        Sizes {
            items: draw(3),
            tokens: draw(90),
            width: 8 * draw(5),
            height: draw(9),
            columns: draw(9),
            points: draw(150),
        }
    });
    std::iter::once(one).chain(draws)
}

/// Sums of up to some thousand products of numbers of order 1 in different orders; norms of two numbers lose a digit more.
#[test]
fn kernels_equal_compositions_on_random_shapes() {
    for sizes in random_sizes(8) {
        for case in all() {
            let run = || Feed::new(sizes, Order::Plain, None).run(&case);
            for (i, (fused, composed)) in run().into_iter().zip(ops::composed_only(run)).enumerate() {
                assert_eq!(fused.len(), composed.len(), "{} at {sizes:?}", case.name);
                let size = composed.iter().fold(1.0f32, |size, x| size.max(x.abs()));
                let worst = fused.iter().zip(&composed).map(|(a, b)| (a - b).abs() / size).fold(0.0, f32::max);
                assert!(worst <= 6e-5, "{}, result {i} at {sizes:?}: {worst:e}", case.name);
            }
        }
    }
}

fn constant<const D: usize>(value: f32, shape: [usize; D]) -> Tensor<D> {
    let values = vec![value; shape.iter().product()];
    Tensor::from_data(TensorData::new(values, shape), &Device::flex().autodiff()).require_grad()
}

fn all_zero<const D: usize>(x: Tensor<D>) -> bool {
    x.into_data().try_to_vec::<f32>().expect("f32 values").into_iter().all(|x| x == 0.0)
}

#[test]
fn where_everything_is_masked_all_is_zero() {
    let [q, k, v] = [0.5, 1.0, 2.0].map(|value| constant(value, [2, 3, 5, 8]));
    let y = ops::attention(q.clone(), k.clone(), v.clone(), Some(constant(0.0, [2, 1, 1, 5]).equal_elem(1.0)));
    let gradients = y.clone().backward();
    assert!(all_zero(y) && [q, k, v].into_iter().all(|x| all_zero(x.grad(&gradients).expect("a leaf"))));

    let (values, offsets) = (constant(1.0, [2, 3, 6, 2, 8]), constant(0.5, [2, 7, 2, 1, 4, 2]));
    let weights = constant(1.0, [2, 7, 2, 1, 4]);
    let unseen = constant(0.0, [2, 3, 7]).equal_elem(1.0);
    let reference = constant(0.5, [2, 3, 7, 2]);
    let y = ops::deformable_views_2d(values.clone(), &[[2, 3]], reference, unseen, offsets.clone(), weights.clone());
    let gradients = y.clone().backward();
    assert!(all_zero(y) && all_zero(values.grad(&gradients).expect("a leaf")));
    assert!(all_zero(offsets.grad(&gradients).expect("a leaf")));
    assert!(all_zero(weights.grad(&gradients).expect("a leaf")));
}

/// Central differences of `sum(output · upstream)` by input and grid, at points away from the kinks at pixel centres.
#[test]
fn gradients_of_grid_sampling_equal_finite_differences() {
    let device = Device::flex().autodiff();
    let x =
        Tensor::<1>::from_data(TensorData::new((0..40).map(|i| (i as f32).sin()).collect::<Vec<_>>(), [40]), &device)
            .reshape([1, 2, 4, 5]);
    // Pixels 1.3, 2.2 and so on: quarters between centres on a map of 5x4.
    let pixels = [1.3, 2.2, -0.6, 0.4, 4.4, 1.6, 3.7, 2.7];
    let grid: Vec<f32> = pixels.iter().enumerate().map(|(i, p)| (2.0 * p + 1.0) / [5.0, 4.0][i % 2] - 1.0).collect();
    let grid = Tensor::<4>::from_data(TensorData::new(grid, [1, 1, 4, 2]), &device);
    let upstream =
        Tensor::<4>::from_data(TensorData::new(vec![0.5, -1.0, 1.5, 2.0, 1.0, 0.7, -0.3, 0.9], [1, 2, 1, 4]), &device);
    let loss = |x: Tensor<4>, grid: Tensor<4>| {
        (ops::grid_sample_2d(x, grid, false, Interpolation::Bilinear) * upstream.clone()).sum()
    };
    let (x, grid) = (x.detach().require_grad(), grid.detach().require_grad());
    let gradients = loss(x.clone(), grid.clone()).backward();
    let floats = |x: Tensor<4>| x.into_data().try_to_vec::<f32>().expect("f32 values");
    let step = 1e-2;
    for (which, exact) in [floats(x.grad(&gradients).expect("a leaf")), floats(grid.grad(&gradients).expect("a leaf"))]
        .into_iter()
        .enumerate()
    {
        for (i, exact) in exact.into_iter().enumerate() {
            let at = |step: f32| {
                let shape = if which == 0 { x.dims() } else { grid.dims() };
                let mut bump = vec![0.0; shape.iter().product()];
                bump[i] = step;
                let bump = Tensor::<4>::from_data(TensorData::new(bump, shape), &device);
                let (x, grid) =
                    if which == 0 { (x.clone() + bump, grid.clone()) } else { (x.clone(), grid.clone() + bump) };
                loss(x, grid).into_scalar::<f32>()
            };
            let slope = (at(step) - at(-step)) / (2.0 * step);
            assert!((exact - slope).abs() < 2e-3 * (1.0 + exact.abs()), "{which} {i}: {exact} against {slope}");
        }
    }
}
