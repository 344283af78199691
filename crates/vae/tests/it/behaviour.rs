//! What must hold for any weights: samples do not see each other, padding is invisible, losses and gradients are what they say.

use burn::module::Module;
use burn::optim::GradientsParams;
use burn::tensor::{Bool, Device, Tensor, TensorData};
use geometry::glam::{DMat3, DMat4, DVec3};
use geometry::{CameraRig, ImageEdit, RigPreset, Rigid};
use nn::Init;
use nn::golden::{golden_stream, golden_values};
use nn::weights::fill_params;
use vae::losses::{adaptive_weight, adversarial, last_layer_gradient_norm, masked_l2, with_ignored_pixels_of};
use vae::sample_points::{rays_in_grid, voxels_in_views};
use vae::scene_decoder::depth_weights;
use vae::{BevVae, BevVaeConfig, Discriminator, Preset, ViewMatrices};

use crate::golden::HostValues;

fn device() -> Device {
    Device::flex()
}

/// Weights as after some training: fresh networks start with layers of zeros, under which much would hold by accident.
pub fn model(config: &BevVaeConfig, device: &Device) -> BevVae {
    let fresh = BevVae::new(config, &mut Init::new(7, device));
    fill_params(fresh, |path, shape| Ok(golden_values(path, shape))).unwrap()
}

/// The first `count` cameras of a real rig.
pub fn rig(preset: RigPreset, count: usize) -> CameraRig {
    let mut rig = preset.rig();
    rig.cameras.truncate(count);
    rig
}

/// Twelve numbers per camera, zeros for padding up to `views`.
fn rows(rig: &CameraRig, config: &BevVaeConfig, views: usize, lift: bool) -> Vec<f32> {
    let mut out = Vec::new();
    for camera in &rig.cameras {
        let raw = camera.intrinsics;
        let edit = ImageEdit::identity(raw.width, raw.height);
        let k = edit.resize(config.image.width as u32, config.image.height as u32).intrinsics(&raw).matrix();
        let pose = if lift { camera.ego_from_cam } else { camera.ego_from_cam.inverse() };
        let (linear, offset) = product(k, &pose, lift);
        for row in 0..3 {
            out.extend([0, 1, 2].map(|column| linear.col(column)[row] as f32));
            out.push(offset[row] as f32);
        }
    }
    out.resize(views * 12, 0.0);
    out
}

fn product(k: DMat3, pose: &Rigid, lift: bool) -> (DMat3, DVec3) {
    let matrix: DMat4 = pose.to_mat4();
    let rotation = DMat3::from_mat4(matrix);
    if lift { (rotation * k.inverse(), pose.translation) } else { (k * rotation, k * pose.translation) }
}

pub fn matrices(rigs: &[&CameraRig], config: &BevVaeConfig, views: usize, lift: bool, device: &Device) -> ViewMatrices {
    let values: Vec<f32> = rigs.iter().flat_map(|rig| rows(rig, config, views, lift)).collect();
    let mask: Vec<bool> = rigs.iter().flat_map(|rig| (0..views).map(|v| v < rig.len())).collect();
    ViewMatrices {
        matrices: Tensor::from_data(TensorData::new(values, [rigs.len(), views, 3, 4]), device),
        view_mask: Tensor::<2, Bool>::from_data(TensorData::new(mask, [rigs.len(), views]), device),
    }
}

pub fn noise<const D: usize>(name: &str, shape: [usize; D], device: &Device) -> Tensor<D> {
    let values: Vec<f32> = golden_stream(name, shape.iter().product()).into_iter().map(|v| v as f32).collect();
    Tensor::from_data(TensorData::new(values, shape), device)
}

/// Equal up to f32 rounding: matrix kernels block their sums by the number of rows, so the last bits may move with the batch.
fn assert_same<const D: usize>(got: Tensor<D>, want: Tensor<D>, what: &str) {
    assert_eq!(got.dims(), want.dims(), "{what}");
    let pairs = got.inner_values().into_iter().zip(want.inner_values());
    let worst = pairs.map(|(a, b)| (a - b).abs()).fold(0.0, f64::max);
    assert!(worst < 1e-5, "{what}: off by {worst:e}");
}

#[test]
fn a_sample_does_not_see_its_neighbours_and_padding_is_invisible() {
    let (device, config) = (device(), Preset::Debug.config());
    let model = model(&config, &device);
    let rigs = [rig(RigPreset::WayveScenes101, 4), rig(RigPreset::NuScenes, 6), rig(RigPreset::Argoverse2, 7)];
    let views = 7;
    let [h, w] = [config.image.height, config.image.width];
    let all: Vec<&CameraRig> = rigs.iter().collect();
    let images = noise("images", [3, views, 3, h, w], &device);
    let together = model.encode(images.clone(), &matrices(&all, &config, views, false, &device));
    let painted = model.decode(together.mean.clone(), &matrices(&all, &config, views, true, &device)).images;
    for (b, rig) in rigs.iter().enumerate() {
        let own = rig.len();
        let alone = images.clone().slice([b..b + 1, 0..own]);
        let posterior = model.encode(alone, &matrices(&[rig], &config, own, false, &device));
        let [_, n, l] = together.mean.dims();
        let shared = together.mean.clone().slice([b..b + 1, 0..n, 0..l]);
        assert_same(posterior.mean.clone(), shared, &format!("latent of the rig with {own} cameras"));
        let decoded = model.decode(posterior.mean, &matrices(&[rig], &config, own, true, &device)).images;
        assert_same(decoded, painted.clone().slice([b..b + 1, 0..own]), &format!("pictures of {own} cameras"));
    }
}

#[test]
fn a_voxel_may_be_seen_by_none_one_or_two_views() {
    let (device, config) = (device(), Preset::Tiny.config());
    let rig = RigPreset::NuScenes.rig();
    let points = voxels_in_views(&config, &matrices(&[&rig], &config, rig.len(), false, &device));
    let [_, v, q] = points.valid.dims();
    let seen: Vec<bool> = points.valid.into_data().iter::<bool>().collect();
    let mut histogram = [0usize; 4];
    for voxel in 0..q {
        histogram[(0..v).filter(|view| seen[view * q + voxel]).count().min(3)] += 1;
    }
    assert!(histogram[0] > 0 && histogram[1] > 0 && histogram[2] > 0, "{histogram:?}");
    assert_eq!(histogram[3], 0, "three cameras of this car never meet");
}

#[test]
fn a_ray_into_the_sky_adds_nothing_and_stays_finite() {
    let (device, config) = (device(), Preset::Debug.config());
    let mut rig = rig(RigPreset::NuScenes, 1);
    // Straight up from above the grid: no depth is inside.
    let up = geometry::glam::DQuat::from_rotation_arc(DVec3::Z, DVec3::Z);
    rig.cameras[0].ego_from_cam = Rigid::new(up, DVec3::new(0.0, 0.0, 10.0));
    let cameras = matrices(&[&rig], &config, 1, true, &device);
    let rays = rays_in_grid(&config, &cameras);
    assert_eq!(rays.valid.clone().int().sum().into_scalar::<i64>(), 0);
    let shares = depth_weights(noise("logits", [1, 4, 16], &device), rays.valid.reshape([1, 4, 16]));
    assert!(shares.inner_values().iter().all(|v| *v == 0.0));
    let latent = noise("latent", [1, 16, config.latent_channels], &device);
    let decoded = model(&config, &device).decode(latent, &cameras).images;
    assert!(decoded.inner_values().iter().all(|v| v.is_finite()));
}

#[test]
fn turning_the_rig_there_and_back_or_all_the_way_changes_nothing() {
    let (device, config) = (device(), Preset::Debug.config());
    let (model, own) = (model(&config, &device), RigPreset::NuScenes.rig());
    let latent = noise("latent", [1, 16, config.latent_channels], &device);
    let decode = |rig: &CameraRig| {
        let cameras = matrices(&[rig], &config, 6, true, &device);
        model.decode(latent.clone(), &cameras).images.inner_values()
    };
    let start = decode(&own);
    let largest = |other: Vec<f64>| start.iter().zip(other).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max);
    // f32 matrices differ in the last bit after the turns.
    assert!(largest(decode(&own.rotated(std::f64::consts::TAU))) < 1e-4);
    assert!(largest(decode(&own.rotated(0.5).rotated(-0.5))) < 1e-4);
    assert!(largest(decode(&own.rotated(0.5))) > 1e-2, "a turned rig must see something else");
}

/// Section 5.1: leaves, two norms and one backward pass give the gradients of the single graph with λ fixed.
#[test]
fn the_adaptive_weight_scheme_equals_the_single_graph() {
    let (plain, config) = (device(), Preset::Debug.config());
    let device = plain.clone().autodiff();
    let model = model(&config, &device);
    let discriminator = Discriminator::new(32, 32, 8, &mut Init::new(9, &device)).unwrap();
    let rig = RigPreset::NuScenes.rig();
    let (v, [h, w]) = (rig.len(), [config.image.height, config.image.width]);
    let cameras = [false, true].map(|lift| matrices(&[&rig], &config, v, lift, &device));
    let target = noise("target", [1, v, 3, h, w], &device);
    let mask = cameras[0].view_mask.clone();
    let forward = || {
        let posterior = model.encode(noise("images", [1, v, 3, h, w], &device), &cameras[0]);
        let decoded = model.decode(posterior.mean.clone(), &cameras[1]);
        (posterior.kl().mean() * 1e-3, decoded)
    };

    let (kl, decoded) = forward();
    let images = decoded.images.clone().inner();
    let leaf = Tensor::from_inner(images.clone()).require_grad();
    let g_rec = leaf.grad(&masked_l2(leaf.clone(), target.clone(), mask.clone(), None).backward()).unwrap();
    let leaf = Tensor::from_inner(images).require_grad();
    let score = adversarial(discriminator.clone().no_grad().forward(leaf.clone().reshape([v, 3, h, w])));
    let g_adv = leaf.grad(&score.backward()).unwrap();
    let tokens = decoded.last_tokens.clone().inner();
    let flat = |g: &Tensor<5>| g.clone().reshape([v, 3, h, w]);
    let norms = [&g_rec, &g_adv].map(|g| last_layer_gradient_norm(tokens.clone(), flat(g)));
    let lambda = adaptive_weight(norms[0].clone(), norms[1].clone()).into_scalar::<f32>();
    let upstream = g_rec + g_adv * f64::from(lambda) * 0.1;
    let scheme =
        GradientsParams::from_grads(((decoded.images * Tensor::from_inner(upstream)).sum() + kl).backward(), &model);

    let (kl, decoded) = forward();
    let score = adversarial(discriminator.no_grad().forward(decoded.images.clone().reshape([v, 3, h, w])));
    let total = masked_l2(decoded.images, target, mask, None) + score * f64::from(lambda) * 0.1 + kl;
    let single = GradientsParams::from_grads(total.backward(), &model);

    let last = model.decoder.image.pixels.weight.id;
    let compare = |scheme: Vec<f64>, single: Vec<f64>, what: &str| {
        let scale = single.iter().map(|v| v * v).sum::<f64>().sqrt();
        let off = scheme.iter().zip(&single).map(|(a, b)| (a - b).powi(2)).sum::<f64>().sqrt();
        assert!(off < 1e-5 * scale, "{what}: {off:e} of {scale:e}");
    };
    let get = |grads: &GradientsParams| grads.get::<4>(last).unwrap().inner_values();
    compare(get(&scheme), get(&single), "last layer");
    let first = model.encoder.image.patch.weight.id;
    let get = |grads: &GradientsParams| grads.get::<4>(first).unwrap().inner_values();
    compare(get(&scheme), get(&single), "first layer");
    // The norm found without a tape is the norm of the tape's gradient.
    let alone = last_layer_norm_from_the_tape(&model, &cameras, &device, config);
    assert!((alone.0 - alone.1).abs() < 1e-5 * alone.1, "{alone:?}");
}

fn last_layer_norm_from_the_tape(
    model: &BevVae,
    cameras: &[ViewMatrices; 2],
    device: &Device,
    config: BevVaeConfig,
) -> (f64, f64) {
    let [_, v] = cameras[0].view_mask.dims();
    let [h, w] = [config.image.height, config.image.width];
    let posterior = model.encode(noise("images", [1, v, 3, h, w], device), &cameras[0]);
    let decoded = model.decode(posterior.mean, &cameras[1]);
    let weights = noise("weights", decoded.images.dims(), device);
    let tokens = decoded.last_tokens.clone().inner();
    let without = last_layer_gradient_norm(tokens, weights.clone().inner().reshape([v, 3, h, w]));
    let grads = GradientsParams::from_grads((decoded.images * weights).sum().backward(), model);
    let gradient = grads.get::<4>(model.decoder.image.pixels.weight.id).unwrap().inner_values();
    let with = gradient.iter().map(|v| v * v).sum::<f64>().sqrt();
    (f64::from(without.into_scalar::<f32>()), with)
}

#[test]
fn presets_have_their_published_sizes() {
    let device = device();
    let sizes = [Preset::Debug, Preset::Tiny].map(|preset| model(&preset.config(), &device).num_params());
    assert!(sizes[0] < sizes[1]);
    let paper = BevVae::new(&Preset::Paper.config(), &mut Init::new(7, &device));
    // Counted from the layer shapes of the published code.
    assert_eq!(paper.encoder.num_params(), 132_748_614);
    assert_eq!(paper.decoder.num_params(), 130_046_409);
    assert_eq!((paper.pre_quant.num_params(), paper.post_quant.num_params()), (24_608, 13_056));
}

#[test]
fn the_discriminator_refuses_sizes_it_cannot_halve() {
    let device = device();
    for (h, w) in [(48, 48), (32, 36), (2, 2)] {
        assert!(Discriminator::new(h, w, 8, &mut Init::new(0, &device)).is_err(), "{w}x{h}");
    }
    let network = Discriminator::new(32, 64, 8, &mut Init::new(0, &device)).unwrap();
    let scores = network.forward(noise("pictures", [3, 3, 32, 64], &device));
    // No statistics across the batch: each picture's score is its own.
    let one = network.forward(noise("pictures", [3, 3, 32, 64], &device).narrow(0, 1, 1));
    assert_same(scores.narrow(0, 1, 1), one, "score of one picture");
}

#[test]
fn ignored_pixels_and_absent_views_do_not_enter_the_losses() {
    let device = device();
    let values = |f: fn(usize) -> f32| {
        let all: Vec<f32> = (0..2 * 3 * 4).map(f).collect();
        Tensor::<5>::from_data(TensorData::new(all, [1, 2, 3, 2, 2]), &device)
    };
    let (decoded, target) = (values(|i| if i % 4 == 1 { 100.0 } else { 0.5 }), values(|_| 0.0));
    let counted = Tensor::<5>::from_data(TensorData::new([1.0f32, 0.0, 1.0, 1.0].repeat(2), [1, 2, 1, 2, 2]), &device);
    let mask = |second: bool| Tensor::<2, Bool>::from_data(TensorData::new(vec![true, second], [1, 2]), &device);
    let loss = |mask, counted| masked_l2(decoded.clone(), target.clone(), mask, counted).into_scalar::<f32>();
    assert_eq!(loss(mask(true), Some(counted.clone())), 0.25);
    assert_eq!(loss(mask(false), Some(counted.clone())), 0.25);
    assert!(loss(mask(true), None) > 1000.0);
    // A view without any pixel that counts has no error.
    assert_eq!(loss(mask(true), Some(counted.zeros_like())), 0.0);
    let filled = with_ignored_pixels_of(decoded.clone(), &target, Some(&counted));
    assert_eq!(filled.max().into_scalar::<f32>(), 0.5);
}
