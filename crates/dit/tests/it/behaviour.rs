//! What holds for any weights.

use burn::module::Module;
use burn::optim::GradientsParams;
use burn::tensor::{Device, Int, Tensor};
use dit::{Condition, ConditionConfig, Dit, DitConfig, Preset};
use nn::Init;
use nn::golden::golden_values;
use nn::weights::fill_params;

const LAYOUT: ConditionConfig = ConditionConfig::Layout { classes: 3, slices: 4, patch: 2 };

fn wave<const D: usize>(shape: [usize; D], phase: f32, device: &Device) -> Tensor<D> {
    let count = shape.iter().product::<usize>() as i64;
    (Tensor::<1, Int>::arange(0..count, device).float() * 0.37 + phase).sin().reshape(shape)
}

fn config() -> DitConfig {
    Preset::Debug.config([4, 4, 6], LAYOUT).checked().unwrap()
}

/// Weights without zeros, so that every path counts.
fn filled(device: &Device) -> Dit {
    let model = Dit::new(&config(), &mut Init::new(0, device));
    fill_params(model, |path, shape| Ok(golden_values(path, shape))).unwrap()
}

fn occupancy(batch: usize, device: &Device) -> Tensor<5> {
    wave([batch, 3, 4, 8, 12], 1.0, device).greater_elem(0.7).float()
}

fn values<const D: usize>(x: Tensor<D>) -> Vec<f32> {
    x.into_data().try_to_vec::<f32>().unwrap()
}

#[test]
fn a_fresh_network_gives_zero() {
    let device = Device::flex();
    let model = Dit::new(&config(), &mut Init::new(3, &device));
    let condition = Condition::Layout { occupancy: occupancy(2, &device), strength: &[1.0, 0.0] };
    let output = model.forward(wave([2, 4, 4, 6], 0.0, &device), &[3.0, 900.0], &condition);
    assert!(values(output).iter().all(|v| *v == 0.0));
}

#[test]
fn an_empty_layout_is_not_no_layout_and_strength_scales_it() {
    let device = Device::flex();
    let model = filled(&device);
    let x = wave([1, 4, 4, 6], 0.0, &device);
    let run = |occupancy: Tensor<5>, strength: f64| {
        values(model.forward(x.clone(), &[500.0], &Condition::Layout { occupancy, strength: &[strength] }))
    };
    let (full, empty) = (occupancy(1, &device), Tensor::zeros([1, 3, 4, 8, 12], &device));
    assert_ne!(run(empty.clone(), 1.0), run(empty.clone(), 0.0));
    assert_ne!(run(full.clone(), 1.0), run(empty.clone(), 1.0));
    assert_eq!(run(full.clone(), 0.0), run(empty, 0.0), "strength 0 leaves the layout out");
    assert_ne!(run(full.clone(), 2.0), run(full, 1.0));
}

#[test]
fn a_sample_does_not_see_its_neighbours() {
    let device = Device::flex();
    let model = filled(&device);
    let (x, boxes) = (wave([3, 4, 4, 6], 0.0, &device), occupancy(3, &device));
    let (times, strength) = ([3.0, 500.0, 999.0], [1.0, 0.0, 2.5]);
    let condition = Condition::Layout { occupancy: boxes.clone(), strength: &strength };
    let together = model.forward(x.clone(), &times, &condition);
    for i in 0..3 {
        let condition = Condition::Layout { occupancy: boxes.clone().narrow(0, i, 1), strength: &strength[i..=i] };
        let alone = model.forward(x.clone().narrow(0, i, 1), &times[i..=i], &condition);
        let distance = (alone - together.clone().narrow(0, i, 1)).abs().max().into_scalar::<f32>();
        assert!(distance < 1e-5, "sample {i}: {distance:e}");
    }
}

/// A token's layout vector depends on the cells of that token alone: one voxel changes one token before attention mixes them.
#[test]
fn a_voxel_reaches_its_own_token_with_x_along_columns() {
    let device = Device::flex();
    let model = filled(&device);
    let layout = model.layout.as_ref().unwrap();
    let empty = layout.forward(Tensor::zeros([1, 3, 4, 8, 12], &device));
    let mut cells = vec![0.0_f32; 3 * 4 * 8 * 12];
    let (class, z, y, x) = (2, 1, 5, 8);
    cells[((class * 4 + z) * 8 + y) * 12 + x] = 1.0;
    let one = Tensor::<1>::from_floats(cells.as_slice(), &device).reshape([1, 3, 4, 8, 12]);
    let change = values(ops::sum_dim((layout.forward(one) - empty).abs(), 2));
    let changed: Vec<usize> = (0..change.len()).filter(|&i| change[i] > 0.0).collect();
    assert_eq!(changed, [(y / 2) * 6 + x / 2]);
}

#[test]
fn central_differences_through_a_block() {
    let device = Device::flex().autodiff();
    let model = filled(&device);
    let boxes = occupancy(1, &device);
    let loss = |x: Tensor<4>| {
        let condition = Condition::Layout { occupancy: boxes.clone(), strength: &[1.0] };
        let output = model.forward(x, &[321.0], &condition);
        (output * wave([1, 4, 4, 6], 0.4, &device)).sum()
    };
    let x = wave([1, 4, 4, 6], 0.0, &device).require_grad();
    let gradient = values(x.grad(&loss(x.clone()).backward()).unwrap());
    let scale = gradient.iter().fold(0.0_f32, |scale, g| scale.max(g.abs()));
    for i in [0, 17, 50, 95] {
        const STEP: f32 = 1e-2;
        let moved = |by: f32| {
            let mut shifted = values(x.clone().inner());
            shifted[i] += by;
            let shifted = Tensor::<1>::from_floats(shifted.as_slice(), &device).reshape([1, 4, 4, 6]);
            loss(shifted).into_scalar::<f32>()
        };
        let difference = (moved(STEP) - moved(-STEP)) / (2.0 * STEP);
        assert!((difference - gradient[i]).abs() < 5e-3 * scale, "{i}: {difference} {}", gradient[i]);
    }
}

#[test]
fn every_parameter_learns() {
    let device = Device::flex().autodiff();
    let model = filled(&device);
    let condition = Condition::Layout { occupancy: occupancy(2, &device), strength: &[1.0, 1.0] };
    let output = model.forward(wave([2, 4, 4, 6], 0.0, &device), &[10.0, 700.0], &condition);
    let mut gradients = output.square().sum().backward();
    let count = GradientsParams::from_module(&mut gradients, &model).len();
    assert_eq!(count, nn::weights::param_shapes(&model).len());
    assert!(model.num_params() > 0);
}
