//! Clipping, accumulation, walking and updating parameters on cases that can be worked out by hand.

use burn::module::{Module, Param};
use burn::optim::GradientsParams;
use burn::tensor::{Device, Tensor};
use train::{
    AdamW, GradientMean, OptimizerConfig, clip_global_norm, global_norm, list_parameters, map_parameters,
    named_parameters,
};

#[derive(Module, Debug)]
struct Pair {
    gain: Param<Tensor<1>>,
    table: Param<Tensor<2>>,
}

fn pair(device: &Device) -> Pair {
    let gain = Tensor::from_floats([1.0, -2.0], device);
    let table = Tensor::from_floats([[0.5, 1.5], [2.5, -3.5]], device);
    Pair { gain: Param::from_tensor(gain), table: Param::from_tensor(table) }
}

/// Gradients of `sum(gain · a) + sum(table · b)`, which are a and b.
fn gradients(pair: &Pair, a: [f32; 2], b: [[f32; 2]; 2]) -> GradientsParams {
    let device = pair.gain.device();
    let loss = (pair.gain.val() * Tensor::from_floats(a, &device)).sum()
        + (pair.table.val() * Tensor::from_floats(b, &device)).sum();
    GradientsParams::from_grads(loss.backward(), pair)
}

fn read(pair: &Pair, grads: &GradientsParams) -> Vec<f32> {
    let gain = grads.get::<1>(pair.gain.id).unwrap().into_data().try_to_vec::<f32>().unwrap();
    [gain, grads.get::<2>(pair.table.id).unwrap().into_data().try_to_vec::<f32>().unwrap()].concat()
}

#[test]
fn the_norm_is_over_all_parameters_and_clipping_scales_them_together() {
    let pair = pair(&Device::flex().autodiff());
    let (a, b) = ([3.0, 0.0], [[0.0, 4.0], [0.0, 12.0]]);
    let mut grads = gradients(&pair, a, b);
    let norm = clip_global_norm(&mut grads, &pair, 26.0);
    assert_eq!(norm.value, 13.0);
    assert_eq!(read(&pair, &grads), [3.0, 0.0, 0.0, 4.0, 0.0, 12.0], "below the limit nothing changes");
    assert_eq!(clip_global_norm(&mut grads, &pair, 6.5).value, 13.0);
    let clipped = read(&pair, &grads);
    for (value, expected) in clipped.iter().zip([1.5, 0.0, 0.0, 2.0, 0.0, 6.0]) {
        assert!((value - expected).abs() < 1e-6, "{clipped:?}");
    }
    assert!((global_norm(&grads, &pair).value - 6.5).abs() < 1e-5);
    assert_eq!(global_norm(&GradientsParams::new(), &pair).value, 0.0);
}

#[test]
fn a_bad_gradient_is_named_and_left_alone() {
    let pair = pair(&Device::flex().autodiff());
    let mut grads = gradients(&pair, [1.0, f32::INFINITY], [[1.0; 2]; 2]);
    let norm = clip_global_norm(&mut grads, &pair, 1.0);
    assert!(!norm.value.is_finite());
    assert_eq!(norm.nonfinite, ["gain"]);
    assert_eq!(read(&pair, &grads)[2..], [1.0; 4]);
}

#[test]
fn accumulation_is_the_mean_over_micro_batches() {
    let pair = pair(&Device::flex().autodiff());
    let mut mean = GradientMean::default();
    for factor in [1.0, 2.0, 6.0] {
        mean.add(&pair, gradients(&pair, [factor, 0.0], [[0.0, factor], [1.0, 1.0]]));
    }
    assert_eq!(read(&pair, &mean.take(&pair)), [3.0, 0.0, 0.0, 3.0, 1.0, 1.0]);
    mean.add(&pair, gradients(&pair, [5.0, 0.0], [[0.0; 2]; 2]));
    assert_eq!(read(&pair, &mean.take(&pair))[0], 5.0, "taking starts anew");
    assert!(mean.take(&pair).is_empty());
}

#[test]
fn an_update_keeps_tape_settings_and_untouched_parameters() {
    let device = Device::flex().autodiff().gradient_checkpointing();
    let mut pair = pair(&device);
    pair.gain = pair.gain.set_require_grad(false);
    let grads = || {
        let device = pair.table.device();
        let loss = (pair.table.val() * Tensor::from_floats([[1.0, -1.0], [0.0, 2.0]], &device)).sum();
        GradientsParams::from_grads(loss.backward(), &pair)
    };
    let config = OptimizerConfig { weight_decay: 0.5, eps: 0.0, ..OptimizerConfig::default() };
    let updated = AdamW::new(&config).step(pair.clone(), &mut grads(), 0.1);
    // First step of AdamW without eps: p·(1 - lr·wd) - lr·sign(g); a zero gradient gives 0/0.
    let table = updated.table.val().into_data().try_to_vec::<f32>().unwrap();
    for (value, expected) in [(table[0], 0.5 * 0.95 - 0.1), (table[1], 1.5 * 0.95 + 0.1), (table[3], -3.5 * 0.95 - 0.1)]
    {
        assert!((value - expected).abs() < 1e-6, "{table:?}");
    }
    assert_eq!(updated.gain.val().into_data(), pair.gain.val().into_data());
    assert!(updated.table.is_require_grad() && !updated.gain.is_require_grad());
    let strategy = updated.table.val().gradient_checkpointing_strategy();
    assert!(strategy.is_some() && strategy == device.gradient_checkpointing_strategy());
    let again = (updated.table.val() * Tensor::ones([2, 2], &device)).sum();
    assert_eq!(GradientsParams::from_grads(again.backward(), &updated).len(), 1);
}

#[test]
fn learning_rate_factors_reach_their_parameters_alone() {
    let device = Device::flex().autodiff();
    let pair = pair(&device);
    let config = |factors: &[(&str, f64)]| OptimizerConfig {
        eps: 0.0,
        weight_decay: 0.0,
        learning_rate_factors: factors.iter().map(|&(path, factor)| (path.to_string(), factor)).collect(),
        ..OptimizerConfig::default()
    };
    let tripled = config(&[("table", 3.0)]);
    tripled.check(&pair).unwrap();
    let loss = pair.table.val().sum() + pair.gain.val().sum();
    let mut grads = GradientsParams::from_grads(loss.backward(), &pair);
    let updated = AdamW::new(&tripled).step(pair.clone(), &mut grads, 0.1);
    // Without eps and decay the first step is lr·sign(g).
    let moved = |new: Vec<f32>, old: Vec<f32>| new.iter().zip(&old).map(|(new, old)| old - new).collect::<Vec<_>>();
    let values = |pair: &Pair| {
        let [table, gain] = [pair.table.val().into_data(), pair.gain.val().into_data()];
        (table.try_to_vec::<f32>().unwrap(), gain.try_to_vec::<f32>().unwrap())
    };
    let (before, after) = (values(&pair), values(&updated));
    assert!(moved(after.0, before.0).iter().all(|change| (change - 0.3).abs() < 1e-6));
    assert!(moved(after.1, before.1).iter().all(|change| (change - 0.1).abs() < 1e-6));
    // A part of a name is no path.
    for unknown in ["tab", "table.weight", ""] {
        let error = config(&[(unknown, 2.0)]).check(&pair).unwrap_err().to_string();
        assert!(error.contains("learning_rate_factors"), "{error}");
    }
    assert!(config(&[("table", f64::NAN)]).check(&pair).is_err());
}

#[test]
fn paths_and_shapes_follow_the_fields() {
    let pair = pair(&Device::flex());
    let listed: Vec<(String, Vec<usize>)> =
        list_parameters(&pair).into_iter().map(|info| (info.path, info.shape)).collect();
    assert_eq!(listed, [("gain".to_string(), vec![2]), ("table".to_string(), vec![2, 2])]);
    let doubled = map_parameters(pair, |_, values| values.mul_scalar(2.0));
    let table = &named_parameters(&doubled)["table"];
    assert_eq!(table.values.to_data().try_to_vec::<f32>().unwrap(), [1.0, 3.0, 5.0, -7.0]);
    assert_eq!(doubled.table.dims(), [2, 2]);
}
