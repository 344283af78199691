//! Every stage of the network against the published inference code's numbers (golden weights, no weight files).

use std::path::Path;

use burn::module::Module;
use burn::optim::GradientsParams;
use burn::tensor::{Bool, Device, Tensor, TensorData};
use geometry::{BevGrid, Frustum, FrustumPixels};
use glam::{DMat3, DMat4};
use nn::golden::{golden_stream, golden_values_with_gains};
use nn::weights::fill_params;
use nn::{Init, sincos_3d};
use serde_json::Value;
use vae::official::{is_ignored, official_name, official_shape};
use vae::sample_points::{rays_in_grid, voxels_in_views};
use vae::scene_decoder::flatten_volumes;
use vae::scene_encoder::flatten_levels;
use vae::state_coder::DiagonalGaussian;
use vae::{BevVae, BevVaeConfig, ImageConfig, SceneConfig, StateConfig, ViewMatrices};

use crate::golden::{Golden, HostValues, folder, json};

/// f32 against f32 with another order of sums; the golden run itself lies 1.5e-5 from its f64 twin.
pub const TOLERANCE: f64 = 1e-4;

pub fn number(value: &Value) -> usize {
    value.as_u64().unwrap() as usize
}

fn numbers<const N: usize>(value: &Value) -> [usize; N] {
    let list: Vec<usize> = value.as_array().unwrap().iter().map(number).collect();
    list.try_into().unwrap()
}

pub fn config_of(case: &Value) -> BevVaeConfig {
    let c = &case["config"];
    let [height, width] = numbers(&c["image_size"]);
    let [depths, rows, columns] = numbers(&c["frustum_size"]);
    let pc: Vec<f64> = c["pc"].as_array().unwrap().iter().map(|v| v.as_f64().unwrap()).collect();
    let blocks = number(&c["scene"]["blocks"]);
    BevVaeConfig {
        image: ImageConfig {
            height,
            width,
            patch: number(&c["patch_size"]),
            channels: number(&c["image"]["ch"]),
            heads: number(&c["image"]["heads"]),
            encoder_blocks: number(&c["image"]["blocks"]),
            decoder_blocks: number(&c["image"]["blocks"]),
        },
        scene: SceneConfig {
            channels: number(&c["scene"]["ch"]),
            heads: number(&c["scene"]["heads"]),
            norm_groups: 32,
            encoder_blocks: blocks,
            decoder_blocks: blocks,
            encoder_points: number(&c["scene"]["enc_points"]),
            decoder_points: number(&c["scene"]["dec_points"]),
        },
        grid: BevGrid {
            x_range: [pc[0], pc[3]],
            y_range: [pc[1], pc[4]],
            z_range: [pc[2], pc[5]],
            cells: numbers(&c["scene_size"]),
        },
        state: StateConfig {
            patch: number(&c["state"]["patch_size"]),
            channels_per_height: number(&c["state"]["ch_per_height"]),
            squeeze_channels: number(&c["state"]["mid_ch"]),
            blocks: number(&c["state"]["blocks"]),
        },
        latent_channels: number(&c["latent_ch"]),
        frustum: Frustum { depths, bin_m: 1.0, rows, columns, pixels: FrustumPixels::EndToEnd },
    }
}

fn golden_model(config: &BevVaeConfig, device: &Device) -> BevVae {
    let model = BevVae::new(config, &mut Init::new(0, device));
    fill_params(model, |path, shape| Ok(golden_values_with_gains(&official_name(path), shape, &[".scale"]))).unwrap()
}

fn rows<const N: usize>(values: &[f64]) -> [[f64; N]; N] {
    std::array::from_fn(|i| std::array::from_fn(|j| values[i * N + j]))
}

/// `img_from_ego` and `ego_from_img` of all views, the rig repeated for every sample.
pub fn matrices(golden: &Golden, case: &str, batch: usize, device: &Device) -> (ViewMatrices, ViewMatrices) {
    let k = &golden.get(&format!("{case}/in/intrinsic")).values;
    let pose = &golden.get(&format!("{case}/in/extrinsic")).values;
    let edit = &golden.get(&format!("{case}/in/geometric")).values;
    let views = k.len() / 9;
    let (mut forward, mut backward) = (Vec::new(), Vec::new());
    for v in 0..views {
        let k = DMat3::from_cols_array_2d(&rows::<3>(&k[v * 9..])).transpose();
        let edit = DMat3::from_cols_array_2d(&rows::<3>(&edit[v * 9..])).transpose();
        let ego_from_cam = DMat4::from_cols_array_2d(&rows::<4>(&pose[v * 16..])).transpose();
        let cam_from_ego = ego_from_cam.inverse();
        push_rows(&mut forward, edit * k, &cam_from_ego, true);
        push_rows(&mut backward, (edit * k).inverse(), &ego_from_cam, false);
    }
    let tensor = |values: Vec<f32>| {
        let one = Tensor::<4>::from_data(TensorData::new(values, [1, views, 3, 4]), device).repeat_dim(0, batch);
        let mask = Tensor::<2, Bool>::from_data(TensorData::new(vec![true; batch * views], [batch, views]), device);
        ViewMatrices { matrices: one, view_mask: mask }
    };
    (tensor(forward), tensor(backward))
}

/// `projection · pose` (projecting) or `pose · projection⁻¹` (lifting) as twelve row-major numbers.
fn push_rows(out: &mut Vec<f32>, projection: DMat3, pose: &DMat4, projecting: bool) {
    let rotation = DMat3::from_mat4(*pose);
    let (linear, offset) = if projecting {
        (projection * rotation, projection * pose.w_axis.truncate())
    } else {
        (rotation * projection, pose.w_axis.truncate())
    };
    for row in 0..3 {
        out.extend([0, 1, 2].map(|column| linear.col(column)[row] as f32));
        out.push(offset[row] as f32);
    }
}

pub fn images(golden: &Golden, case: &str, batch: usize, device: &Device) -> Tensor<5> {
    let stored = golden.get(&format!("{case}/in/images_u8"));
    let [n, c, h, w] = stored.shape.clone().try_into().unwrap();
    let rgb: Vec<f32> = stored.values.iter().map(|v| (*v / 255.0) as f32).collect();
    let rgb = Tensor::from_data(TensorData::new(rgb, [batch, n / batch, c, h, w]), device);
    vae::pixels::normalise(rgb)
}

fn check_mask(golden: &Golden, name: &str, got: Tensor<3, Bool>) {
    // Files hold [V, B, N].
    let got: Vec<bool> = got.swap_dims(0, 1).into_data().iter::<bool>().collect();
    let want = golden.bits(name, got.len());
    let wrong = got.iter().zip(&want).filter(|(a, b)| a != b).count();
    assert_eq!(wrong, 0, "{name}: {wrong} mask entries differ");
}

#[test]
fn every_stage_equals_the_published_inference_code() {
    let Some(folder) = folder("bev_vae_official") else { return };
    let golden = Golden::open(&folder, "io.safetensors");
    let cases = json(&folder.join("cases.json"));
    let small = json(&folder.join("manifest.json"));
    for case in small.as_object().unwrap().keys() {
        let config = config_of(&cases[case]).checked().unwrap();
        let batch = number(&cases[case]["batch"]);
        parameters_match_the_manifest(&config, &small[case]);
        encoder_stages(&golden, case, &config, batch);
        decoder_stages(&golden, case, &config, batch);
        gradients(&golden, &folder, case, &config, batch);
    }
}

pub fn parameters_match_the_manifest(config: &BevVaeConfig, manifest: &Value) {
    let model = BevVae::new(config, &mut Init::lazy(0, &Device::flex()));
    let mut ours: Vec<(String, Vec<usize>)> = nn::weights::param_shapes(&model)
        .into_iter()
        .map(|(path, shape)| (official_name(&path), official_shape(&path, &shape)))
        .collect();
    let mut theirs: Vec<(String, Vec<usize>)> = manifest["parameters"]
        .as_array()
        .unwrap()
        .iter()
        .filter(|p| p["kind"] != "buffer")
        .map(|p| {
            let shape = p["shape"].as_array().unwrap();
            (p["name"].as_str().unwrap().to_owned(), shape.iter().map(number).collect())
        })
        .collect();
    ours.sort();
    theirs.sort();
    assert_eq!(ours, theirs);
    assert_eq!(model.num_params(), number(&manifest["parameter_count"]));
    for p in manifest["parameters"].as_array().unwrap() {
        let name = p["name"].as_str().unwrap();
        assert_eq!(is_ignored(name), p["kind"] == "buffer", "{name}");
    }
}

fn encoder_stages(golden: &Golden, case: &str, config: &BevVaeConfig, batch: usize) {
    let device = Device::flex();
    let model = golden_model(config, &device);
    let (cameras, _) = matrices(golden, case, batch, &device);
    let images = images(golden, case, batch, &device);
    let check = |name: &str, worst: f64| eprintln!("{case}/{name}: largest difference {worst:.1e}");
    let [b, v, c, h, w] = images.dims();
    let flat = images.clone().reshape([b * v, c, h, w]);
    let encoder = &model.encoder;

    let patch = encoder.image.patch.forward(flat.clone());
    check("enc/image/patch", golden.check(&format!("{case}/enc/image/patch"), patch, TOLERANCE));
    let features = encoder.image.forward(flat, config);
    check("enc/image/out", golden.check(&format!("{case}/enc/image/out"), features.clone(), TOLERANCE));
    let levels = encoder.scene.pyramid.forward(features.clone());
    for (i, level) in levels.iter().enumerate() {
        golden.check(&format!("{case}/enc/fpn/{}", i + 1), level.clone(), TOLERANCE);
    }
    let points = voxels_in_views(config, &cameras);
    let reference = points.reference.clone().swap_dims(0, 1);
    golden.check(&format!("{case}/enc/scene/points"), reference, 1e-5);
    check_mask(golden, &format!("{case}/enc/scene/valid"), points.valid.clone());
    let values = flatten_levels(levels, b, v);
    let block = &encoder.scene.blocks[0];
    let sizes = config.image_levels();
    let attended = block.attend(encoder.scene.queries(b, config), values.clone(), &points, &sizes);
    golden.check(&format!("{case}/enc/scene/block0_attn"), attended, TOLERANCE);
    let after = block.forward(encoder.scene.queries(b, config), values, &points, &sizes);
    golden.check(&format!("{case}/enc/scene/block0"), after, TOLERANCE);
    let scene = encoder.scene.forward(features, &points, config);
    check("enc/scene/out", golden.check(&format!("{case}/enc/scene/out"), scene.clone(), TOLERANCE));
    let state = encoder.state.forward(scene, config);
    golden.check(&format!("{case}/enc/state/out"), state.clone(), TOLERANCE);
    let moments = model.pre_quant.forward(state);
    golden.check(&format!("{case}/moments"), moments.clone(), TOLERANCE);
    let posterior = DiagonalGaussian::from_moments(moments);
    golden.check(&format!("{case}/latent/logvar"), posterior.log_var.clone(), TOLERANCE);
    let kl = golden.get(&format!("{case}/latent/kl")).values.clone();
    for (got, want) in posterior.kl().inner_values().iter().zip(kl) {
        assert!((got - want).abs() <= 1e-5 * want.abs(), "{case}: KL {got} against {want}");
    }
    let whole = model.encode(images, &cameras).mean;
    check("latent/mean", golden.check(&format!("{case}/latent/mean"), whole, TOLERANCE));
}

fn decoder_stages(golden: &Golden, case: &str, config: &BevVaeConfig, batch: usize) {
    let device = Device::flex();
    let model = golden_model(config, &device);
    let (_, cameras) = matrices(golden, case, batch, &device);
    let stored = golden.get(&format!("{case}/latent/mean"));
    let shape: [usize; 3] = stored.shape.clone().try_into().unwrap();
    let values: Vec<f32> = stored.values.iter().map(|v| *v as f32).collect();
    let latent = Tensor::<3>::from_data(TensorData::new(values, shape), &device);
    let decoder = &model.decoder;

    let state = model.post_quant.forward(latent.clone());
    golden.check(&format!("{case}/dec/post_quant"), state.clone(), TOLERANCE);
    let scene = decoder.state.forward(state, config);
    golden.check(&format!("{case}/dec/state/out"), scene.clone(), TOLERANCE);
    let levels = decoder.scene.pyramid.forward(scene.clone());
    for (i, level) in levels.iter().enumerate() {
        golden.check(&format!("{case}/dec/fpn/{}", i + 1), level.clone(), TOLERANCE);
    }
    let rays = rays_in_grid(config, &cameras);
    // The file keeps coordinates of invalid points too; ours are zero there.
    let valid: Vec<bool> = rays.valid.clone().swap_dims(0, 1).into_data().iter::<bool>().collect();
    let reference = rays.reference.clone().swap_dims(0, 1);
    golden.check_where(&format!("{case}/dec/scene/points"), reference, 1e-5, |i| valid[i / 3]);
    check_mask(golden, &format!("{case}/dec/scene/valid"), rays.valid.clone());
    let values = flatten_volumes(levels);
    let [b, v, _] = rays.valid.dims();
    let depths = config.frustum.depths;
    let block = &decoder.scene.blocks[0];
    let queries = decoder.scene.queries(b, v, config);
    let after = block.forward(queries, values, &rays, &config.scene_levels(), depths);
    golden.check(&format!("{case}/dec/scene/block0"), after, TOLERANCE);
    let decoded = model.decode(latent, &cameras);
    let worst = golden.check(&format!("{case}/dec/image/out"), decoded.images, TOLERANCE);
    eprintln!("{case}/dec/image/out: largest difference {worst:.1e}");
    let code = sincos_3d(config.grid.cells, config.scene.channels, &device);
    golden.check(&format!("{case}/tables/sincos_scene"), code, 1e-6);
}

fn gradients(golden: &Golden, folder: &Path, case: &str, config: &BevVaeConfig, batch: usize) {
    let device = Device::flex().autodiff();
    let model = golden_model(config, &device);
    let (encode, decode) = matrices(golden, case, batch, &device);
    let posterior = model.encode(images(golden, case, batch, &device), &encode);
    let decoded = model.decode(posterior.mean.clone(), &decode).images;
    let weights: Vec<f32> =
        golden_stream("bev_vae/grad_weight", decoded.dims().iter().product()).into_iter().map(|v| v as f32).collect();
    let weights = Tensor::<5>::from_data(TensorData::new(weights, decoded.dims()), &device);
    let loss = (decoded * weights).mean() + posterior.kl().mean() * 1e-3;
    let grads = GradientsParams::from_grads(loss.backward(), &model);
    let file = std::fs::File::open(folder.join("gradients.json.gz")).unwrap();
    let all: Value = serde_json::from_reader(flate2::read::GzDecoder::new(file)).unwrap();
    let ours = named_gradients(&model, &grads);
    let mut worst: f64 = 0.0;
    for want in all[case].as_array().unwrap() {
        let name = want["name"].as_str().unwrap();
        let got = ours.get(name).unwrap_or_else(|| panic!("no gradient for {name}"));
        let l2 = want["l2"].as_f64().unwrap();
        let norm = got.iter().map(|v| v * v).sum::<f64>().sqrt();
        // A bias in front of a one-channel group has no gradient but rounding noise, hence the floor.
        assert!((norm - l2).abs() <= 1e-3 * l2 + 1e-6, "{case} {name}: gradient norm {norm} against {l2}");
        let tolerance = 1e-3 * l2 / (got.len() as f64).sqrt() + 1e-6;
        let probes = want["probe_index"].as_array().unwrap().iter().zip(want["probe_value"].as_array().unwrap());
        for (index, value) in probes {
            let difference = (got[number(index)] - value.as_f64().unwrap()).abs();
            worst = worst.max(difference / tolerance);
            assert!(difference <= tolerance, "{case} {name}[{index}]: off by {difference:e}, tolerance {tolerance:e}");
        }
    }
    eprintln!("{case}: gradients of {} parameters, worst probe at {worst:.2} of its tolerance", ours.len());
}

pub fn named_gradients(model: &BevVae, grads: &GradientsParams) -> std::collections::HashMap<String, Vec<f64>> {
    struct Visitor<'a> {
        grads: &'a GradientsParams,
        found: std::collections::HashMap<String, Vec<f64>>,
        path: Vec<String>,
    }
    impl burn::module::ModuleVisitor for Visitor<'_> {
        fn enter_module(&mut self, name: &str, _container: &str) {
            self.path.push(name.to_owned());
        }
        fn exit_module(&mut self, _name: &str, _container: &str) {
            self.path.pop();
        }
        fn visit_float<const D: usize>(&mut self, param: &burn::module::Param<Tensor<D>>) {
            if let Some(gradient) = self.grads.get::<D>(param.id) {
                self.found.insert(official_name(&self.path.join(".")), gradient.inner_values());
            }
        }
    }
    let mut visitor = Visitor { grads, found: Default::default(), path: Vec::new() };
    model.visit(&mut visitor);
    visitor.found
}
