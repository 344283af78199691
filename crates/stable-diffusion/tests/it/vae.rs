//! AutoencoderKL against golden numbers, chunks and tiles.

use burn::optim::GradientsParams;
use burn::tensor::{Device, Tensor};
use nn::Init;
use stable_diffusion::layout::Network;
use stable_diffusion::vae::pixels_from_network;
use stable_diffusion::{AutoencoderKL, Posterior, Preset, Tiling, VaeConfig};

use crate::golden::{
    GRADIENT_TOLERANCE, Golden, TOLERANCE, check_derivative, check_gradients, folder, golden_weights, json,
    named_gradients, noise, values_of,
};

fn config(folder: &std::path::Path) -> VaeConfig {
    AutoencoderKL::config_from_json(json(&folder.join("config.json")).as_object().unwrap()).unwrap()
}

fn debug(device: &Device) -> AutoencoderKL {
    golden_weights(AutoencoderKL::new(&Preset::Debug.vae().checked().unwrap(), &mut Init::lazy(0, device)))
}

#[test]
fn encoder_posterior_and_decoder_equal_the_reference() {
    let Some(folder) = folder("vae") else { return };
    let (golden, device) = (Golden::open(&folder.join("io.safetensors")), Device::flex());
    let vae = golden_weights(AutoencoderKL::new(&config(&folder), &mut Init::lazy(0, &device)));
    let image = golden.tensor::<4>("encode/image", &device);
    let moments = golden.check("encode/output", vae.moments(image.clone()), TOLERANCE);
    let posterior = vae.encode(image);
    golden.check("encode/mean", posterior.mean.clone(), TOLERANCE);
    golden.check("encode/std", posterior.std(), TOLERANCE);
    golden.check("encode/kl", posterior.kl(), TOLERANCE);
    let noise = golden.tensor("encode/noise", &device);
    golden.check("encode/posterior_sample", posterior.sample(noise), TOLERANCE);
    let decoded = golden.check("decode/output", vae.decode(golden.tensor("decode/latents", &device)), TOLERANCE);
    eprintln!("vae: encode off by {moments:.1e}, decode by {decoded:.1e}");
}

#[test]
fn gradients_equal_the_reference() {
    let Some(folder) = folder("vae") else { return };
    let golden = Golden::open(&folder.join("io.safetensors"));
    let device = Device::flex().autodiff();
    let vae = golden_weights(AutoencoderKL::new(&config(&folder), &mut Init::lazy(0, &device)));
    type Pass = fn(&AutoencoderKL, Tensor<4>) -> Tensor<4>;
    let passes: [(&str, &str, Pass); 2] =
        [("encode", "image", AutoencoderKL::moments), ("decode", "latents", AutoencoderKL::decode)];
    for (pass, input, forward) in passes {
        let x = golden.tensor::<4>(&format!("{pass}/{input}"), &device).require_grad();
        let upstream = golden.tensor::<4>(&format!("{pass}/upstream"), &device);
        let mut grads = (forward(&vae, x.clone()) * upstream).sum().backward();
        let dx = x.grad_remove(&mut grads).unwrap();
        let at_input = golden.check(&format!("{pass}/grad/{input}"), dx, GRADIENT_TOLERANCE);
        let ours = named_gradients(&vae, &GradientsParams::from_grads(grads, &vae));
        let at_params = check_gradients(&golden, &format!("{pass}/grad/param/"), &ours);
        eprintln!("vae {pass}: gradients off by {at_input:.1e} at the input, {at_params:.1e} at parameters");
    }
}

#[test]
fn the_derivative_of_the_whole_autoencoder_equals_differences() {
    let device = Device::flex().autodiff();
    let image = noise("image", [1, 3, 8, 12], &device);
    let (eps, weights) = (noise("eps", [1, 4, 2, 3], &device), noise("weights", [1, 3, 8, 12], &device));
    check_derivative(&debug(&device), |vae| {
        let posterior = vae.encode(image.clone());
        (vae.decode(posterior.sample(eps.clone())) * weights.clone()).sum() + posterior.kl().sum() * 0.1
    });
}

#[test]
fn the_log_variance_is_clamped() {
    let device = Device::flex();
    let moments = Tensor::<1>::from_floats([1.0, 2.0, 3.0, -100.0, 100.0, 0.5], &device).reshape([1, 6, 1, 1]);
    let posterior = Posterior::from_moments(moments);
    assert_eq!(values_of(posterior.mean), [1.0, 2.0, 3.0]);
    assert_eq!(values_of(posterior.log_var), [-30.0, 20.0, 0.5]);
}

#[test]
fn scaling_is_that_of_the_config_and_colours_end_in_the_unit_range() {
    let device = Device::flex();
    let config = VaeConfig { scaling_factor: 0.25, ..Preset::Debug.vae() };
    let vae = AutoencoderKL::new(&config, &mut Init::lazy(0, &device));
    let z = Tensor::<4>::ones([1, 4, 2, 2], &device) * 8.0;
    assert_eq!(values_of(vae.scale(z.clone())), vec![2.0; 16]);
    assert_eq!(values_of(vae.unscale(vae.scale(z.clone()))), values_of(z));
    let colours = Tensor::<1>::from_floats([-3.0, -1.0, 0.0, 1.0, 2.0], &device);
    assert_eq!(values_of(pixels_from_network(colours)), [0.0, 0.0, 0.5, 1.0, 1.0]);
}

#[test]
fn chunks_and_a_single_tile_decode_as_the_whole() {
    let device = Device::flex();
    let vae = debug(&device);
    let latents = noise("latents", [5, 4, 3, 4], &device);
    let whole = values_of(vae.decode(latents.clone()));
    for items in [1, 2, 5, 9] {
        let chunks = values_of(vae.decode_in_chunks(latents.clone(), items));
        let worst = whole.iter().zip(&chunks).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
        assert!(worst < 1e-5, "{items} at a time: off by {worst:e}");
    }
    let tiled = vae.decode_in_tiles(latents, &Tiling::new(4, 2).unwrap());
    assert_eq!(values_of(tiled), whole);
}

/// Largest step across the columns where tiles begin or end, in the difference of a tiled from the whole picture.
fn seam(tiled: &Tensor<4>, whole: &Tensor<4>, columns: &[usize]) -> f32 {
    let error = tiled.clone() - whole.clone();
    let step = |x: usize| error.clone().narrow(3, x, 1) - error.clone().narrow(3, x - 1, 1);
    let steps = columns.iter().map(|x| values_of(step(*x).abs()).into_iter().fold(0.0, f32::max));
    steps.fold(0.0, f32::max)
}

#[test]
fn overlapping_tiles_leave_no_seam() {
    let device = Device::flex();
    let vae = debug(&device);
    let latents = noise("wide", [1, 4, 16, 40], &device);
    let whole = vae.decode(latents.clone());
    // Factor 4: tiles of 16 cells begin at 0, 16, 24 without overlap and at 0, 8, 16, 24 with half of it.
    let cut = vae.decode_in_tiles(latents.clone(), &Tiling::new(16, 0).unwrap());
    let blended = vae.decode_in_tiles(latents, &Tiling::new(16, 8).unwrap());
    assert_eq!(blended.dims(), whole.dims());
    let (hard, soft) = (seam(&cut, &whole, &[64, 96]), seam(&blended, &whole, &[32, 64, 96]));
    eprintln!("largest step at a seam: {hard:.3} cut, {soft:.3} blended");
    assert!(hard > 0.05, "tiles that differ this little ({hard}) test nothing");
    assert!(soft < 0.25 * hard, "seams of {soft} against {hard} without blending");
}

#[test]
#[should_panic(expected = "multiples of 4")]
fn pictures_that_do_not_divide_are_refused() {
    let device = Device::flex();
    debug(&device).encode(Tensor::zeros([1, 3, 8, 10], &device));
}
