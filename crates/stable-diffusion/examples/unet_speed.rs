//! Time of the UNet's forward and backward pass, for `benches/peer/unet_speed.py`.
//!
//! `unet_speed tiny DIR` writes the network as a folder, then answers each line on standard input with the seconds of one forward
//! and backward pass. `unet_speed full` builds SD 1.5 and runs one denoising step, `unet_speed gradients` one step with the gradients of
//! all parameters in segments, `unet_speed tape` the same on one tape; they print seconds and peak memory.

use std::error::Error;
use std::io::{BufRead, Write};
use std::path::Path;
use std::time::Instant;

use burn::module::Module;
use burn::optim::GradientsParams;
use burn::tensor::{Device, Tensor, TensorData};
use nn::Init;
use nn::golden::golden_stream;
use stable_diffusion::layout::save_folder;
use stable_diffusion::{Preset, UNet2DCondition, UNetInputs};

type Outcome<T> = Result<T, Box<dyn Error>>;

/// The views of two rigs of six cameras at the toy's latent size.
const ITEMS: usize = 12;

fn main() -> Outcome<()> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    match arguments.iter().map(String::as_str).collect::<Vec<_>>()[..] {
        ["tiny", folder] => tiny(Path::new(folder)),
        ["full"] => full(),
        ["gradients"] => gradients(true),
        ["tape"] => gradients(false),
        _ => Err("unet_speed tiny DIR | full | gradients | tape".into()),
    }
}

fn noise<const D: usize>(name: &str, shape: [usize; D], device: &Device) -> Tensor<D> {
    let values: Vec<f32> = golden_stream(name, shape.iter().product()).into_iter().map(|v| v as f32).collect();
    Tensor::from_data(TensorData::new(values, shape), device)
}

/// Seconds of one step and the mean square of the answer.
fn step(unet: &UNet2DCondition, sample: [usize; 4], tokens: usize, device: &Device) -> (f64, f32) {
    let width = unet.config().encoder.context_width;
    let (x, text) = (noise("sample", sample, device), noise("text", [sample[0], tokens, width], device));
    let times = vec![500.0; sample[0]];
    let started = Instant::now();
    let loss = unet.forward(x, &times, text).square().mean();
    let value = loss.clone().into_scalar::<f32>();
    let gradients = GradientsParams::from_grads(loss.backward(), unet);
    assert!(!gradients.is_empty());
    (started.elapsed().as_secs_f64(), value)
}

fn tiny(folder: &Path) -> Outcome<()> {
    let device = Device::flex().autodiff();
    let unet = UNet2DCondition::new(&Preset::Tiny.unet(), &mut Init::new(1, &device));
    save_folder(&unet, folder)?;
    let (mut out, input) = (std::io::stdout(), std::io::stdin());
    for line in input.lock().lines() {
        line?;
        let (seconds, value) = step(&unet, [ITEMS, 4, 8, 14], 77, &device);
        writeln!(out, "{seconds} {value}")?;
        out.flush()?;
    }
    Ok(())
}

fn full() -> Outcome<()> {
    let mut out = std::io::stdout();
    let plain = Device::flex();
    let started = Instant::now();
    let unet = UNet2DCondition::new(&Preset::Sd15.unet(), &mut Init::new(1, &plain));
    let x = noise("sample", [1, 4, 28, 50], &plain);
    writeln!(out, "initialised {} parameters in {:.1} s", unet.num_params(), started.elapsed().as_secs_f64())?;
    let started = Instant::now();
    let said = unet.forward(x.clone(), &[500.0], noise("text", [1, 77, 768], &plain)).square().mean();
    let value = said.into_scalar::<f32>();
    writeln!(out, "one denoising step {:.1} s, mean square {value}, peak {}", started.elapsed().as_secs_f64(), peak())?;
    Ok(())
}

/// One step of SD 1.5 with the gradients of all parameters.
fn gradients(segments: bool) -> Outcome<()> {
    let (plain, device) = (Device::flex(), Device::flex().autodiff());
    let unet = UNet2DCondition::new(&Preset::Sd15.unet(), &mut Init::new(1, &device));
    let (seconds, value) = if segments {
        let context = noise("text", [1, 77, 768], &plain);
        let inputs = UNetInputs { timesteps: &[500.0], context, views: None, control: None };
        let started = Instant::now();
        let pass = unet.forward_segments(noise("sample", [1, 4, 28, 50], &plain), &inputs);
        let answer = pass.output();
        let value = answer.clone().square().mean().into_scalar::<f32>();
        let upstream = answer.clone() * (2.0 / answer.shape().num_elements() as f64);
        let found = pass.backward(&unet, upstream);
        assert!(!found.params.is_empty());
        (started.elapsed().as_secs_f64(), value)
    } else {
        step(&unet, [1, 4, 28, 50], 77, &device)
    };
    let peak = peak();
    writeln!(std::io::stdout(), "one step with all gradients {seconds:.1} s, mean square {value}, peak {peak}")?;
    Ok(())
}

/// Peak resident memory of this process.
fn peak() -> String {
    let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    let line = status.lines().find_map(|line| line.strip_prefix("VmHWM:"));
    line.map_or_else(|| "unknown".to_owned(), |line| line.trim().to_owned())
}
