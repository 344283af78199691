//! Every step of every stored trajectory.

use std::ops::ControlFlow;

use burn::tensor::{Device, Tensor};
use diffusion::{
    BetaSchedule, Ddim, Ddpm, DpmSolver, Euler, FinalLevel, FlowEuler, NoiseSchedule, Oracle, SamplerConfig,
    ScheduleConfig, Spacing, StepReport, Target, UniPc, Variance, flow_sigmas, guide, rescale_guidance,
};
use serde_json::Value;

use super::golden::{Golden, assert_close};

/// Suggested by the goldens' README.
const TOLERANCE: f32 = 1e-4;

/// The analytic network of the README.
fn eps(x: &Tensor<4>, t: f64) -> Tensor<4> {
    (x.clone() * 0.7).tanh() * (0.2 + 0.8 * t / 1000.0) + (x.clone() * 3.0).sin() * 0.05
}

fn output(case: &Value, x: &Tensor<4>, t: f64) -> Tensor<4> {
    match case["model"].as_str().unwrap() {
        "eps" => eps(x, t),
        "guided" => guide(eps(&(x.clone() * 0.5), t), eps(x, t), case["cfg_scale"].as_f64().unwrap()),
        "eps_and_variance" => Tensor::cat(vec![eps(x, t), (x.clone() * 2.0).sin() * (1.0 - 0.5 * t / 1000.0)], 1),
        other => panic!("unknown model {other}"),
    }
}

fn schedule(config: &Value) -> NoiseSchedule {
    let number = |name: &str| config[name].as_f64();
    let (start, end) = (number("beta_start").unwrap_or(1e-4), number("beta_end").unwrap_or(0.02));
    let beta = match config["beta_schedule"].as_str() {
        Some("scaled_linear") => BetaSchedule::ScaledLinear { start, end },
        Some("linear") | None => BetaSchedule::Linear { start, end },
        Some(other) => panic!("unknown schedule {other}"),
    };
    let timesteps = config["num_train_timesteps"].as_u64().unwrap() as usize;
    NoiseSchedule::new(&ScheduleConfig { beta, timesteps, zero_terminal_snr: false }).unwrap()
}

fn spacing(config: &Value, default: &str) -> Spacing {
    let offset = config["steps_offset"].as_u64().unwrap_or(0) as usize;
    match config["timestep_spacing"].as_str().unwrap_or(default) {
        "leading" => Spacing::Leading { offset },
        "linspace" => Spacing::Linspace,
        "trailing" => Spacing::Trailing,
        other => panic!("unknown spacing {other}"),
    }
}

fn sampler(case: &Value) -> SamplerConfig {
    let config = &case["config"];
    let steps = case["steps"].as_u64().unwrap() as usize;
    let clip = config["clip_sample"].as_bool().unwrap_or(false);
    let last = match config["final_sigmas_type"].as_str() {
        Some("sigma_min") => FinalLevel::SigmaMin,
        _ => FinalLevel::Zero,
    };
    match case["scheduler"].as_str().unwrap() {
        "DDPMScheduler" => {
            let variance = match config["variance_type"].as_str() {
                Some("fixed_large") => Variance::FixedLarge,
                Some("learned_range") => Variance::LearnedRange,
                _ => Variance::FixedSmall,
            };
            SamplerConfig::Ddpm(Ddpm { steps, spacing: spacing(config, "leading"), variance, clip })
        }
        "DDIMScheduler" => {
            let one = config["set_alpha_to_one"].as_bool().unwrap_or(true);
            let last = if one { FinalLevel::Zero } else { FinalLevel::SigmaMin };
            let eta = case["eta"].as_f64().unwrap_or(0.0);
            SamplerConfig::Ddim(Ddim { steps, eta, spacing: spacing(config, "leading"), last, clip })
        }
        "UniPCMultistepScheduler" => {
            let order = config["solver_order"].as_u64().unwrap() as usize;
            let spacing = spacing(config, "linspace");
            SamplerConfig::UniPc(UniPc { steps, order, variant: Default::default(), spacing, last })
        }
        "DPMSolverMultistepScheduler" => {
            SamplerConfig::DpmSolver(DpmSolver { steps, spacing: spacing(config, "linspace"), last })
        }
        "EulerDiscreteScheduler" => SamplerConfig::Euler(Euler { steps, spacing: spacing(config, "linspace") }),
        "FlowMatchEulerDiscreteScheduler" => {
            SamplerConfig::FlowEuler(FlowEuler { steps, shift: config["shift"].as_f64().unwrap_or(1.0) })
        }
        other => panic!("unknown scheduler {other}"),
    }
}

/// Checks every step and returns how many there were.
fn follow(golden: &Golden, name: &str, case: &Value, device: &Device) -> usize {
    let (schedule, mut sampler) = (schedule(&case["config"]), sampler(case));
    let target = match case["config"]["prediction_type"].as_str() {
        Some("v_prediction") => Target::Velocity,
        _ => Target::Noise,
    };
    let timesteps = golden.values(&format!("{name}/timesteps")).1;
    let (mut asked, mut drawn, mut checked) = (Vec::new(), 0, 0);
    let mut denoise = |x: Tensor<4>, t: f64| {
        asked.push(t);
        output(case, &x, t)
    };
    let mut noise = || {
        drawn += 1;
        golden.tensor("noises", Some(drawn - 1), device)
    };
    let mut watch = |report: StepReport<'_, 4>| {
        checked += 1;
        let want = golden.tensor(&format!("{name}/x"), Some(report.done), device);
        assert_close(report.x, &want, TOLERANCE, &format!("{name}, step {}", report.done));
        ControlFlow::Continue(())
    };
    let mut oracle = Oracle { denoise: &mut denoise, noise: &mut noise, watch: &mut watch };
    // A part of the full chain of training timesteps.
    let part = name.contains("_full_").then(|| {
        let first = schedule.len() - 1 - timesteps[0] as usize;
        first..first + timesteps.len()
    });
    let start = match &part {
        Some(_) => golden.tensor(&format!("{name}/x"), Some(0), device),
        None => golden.tensor("start", None, device),
    };
    let end = match (&mut sampler, part) {
        (SamplerConfig::Ddpm(ddpm), Some(part)) => {
            (ddpm.steps, ddpm.spacing) = (schedule.len(), Spacing::Leading { offset: 0 });
            ddpm.sample_part(&schedule, target, start, part, &mut oracle)
        }
        _ => {
            sampler.checked(&schedule, target).unwrap();
            sampler.sample(&schedule, target, start, &mut oracle)
        }
    };
    let exact = golden.tensor(&format!("{name}/x_final.f64"), None, device);
    assert_close(&end.unwrap(), &exact, TOLERANCE, &format!("{name}, end"));
    assert_eq!(checked, timesteps.len(), "{name}");
    for (got, want) in asked.iter().zip(&timesteps) {
        assert!((got - want).abs() < 1e-3, "{name}: timestep {got}, not {want}");
    }
    checked
}

#[test]
fn all_stored_trajectories_are_followed() {
    let Some(golden) = Golden::open() else { return };
    let device = Device::flex();
    let steps: usize =
        golden.cases.as_object().unwrap().iter().map(|(name, case)| follow(&golden, name, case, &device)).sum();
    assert!(steps >= 100, "only {steps} steps compared");
}

#[test]
fn tables_noising_and_guidance_equal_the_stored_ones() {
    let Some(golden) = Golden::open() else { return };
    let device = Device::flex();
    for (name, config) in [("sd", ScheduleConfig::STABLE_DIFFUSION), ("linear", ScheduleConfig::DDPM)] {
        let schedule = NoiseSchedule::new(&config).unwrap();
        let want = golden.values(&format!("tables/{name}/alphas_cumprod.f64")).1;
        assert_eq!(want.len(), schedule.len());
        for (got, want) in schedule.cumulative().iter().zip(&want) {
            assert!((got - want).abs() <= 1e-12, "{name}: {got} is not {want}");
        }
        let levels: Vec<_> = golden.values("forward/timesteps").1.iter().map(|t| schedule.level(*t as usize)).collect();
        let column = |value: fn(&diffusion::Level) -> f64| {
            let values: Vec<f32> = levels.iter().map(|level| value(level) as f32).collect();
            Tensor::<1>::from_floats(values.as_slice(), &device).reshape([levels.len(), 1, 1, 1])
        };
        let (alpha, sigma) = (column(|level| level.alpha), column(|level| level.sigma));
        let (x0, noise) = (golden.tensor("forward/x0", None, &device), golden.tensor("forward/noise", None, &device));
        let noised = x0.clone() * alpha.clone() + noise.clone() * sigma.clone();
        assert_close(&noised, &golden.tensor(&format!("forward/{name}/x_t.f64"), None, &device), 2e-5, name);
        let velocity = Target::Velocity.of(x0, noise, alpha, sigma);
        assert_close(&velocity, &golden.tensor(&format!("forward/{name}/velocity.f64"), None, &device), 2e-5, name);
    }
    let cond = golden.tensor("cfg/cond", None, &device);
    let scalar = |name: &str| golden.values(name).1[0];
    let guided = guide(golden.tensor("cfg/uncond", None, &device), cond.clone(), scalar("cfg/scale"));
    assert_close(&guided, &golden.tensor("cfg/output", None, &device), 2e-5, "guidance");
    let rescaled = rescale_guidance(guided, cond, scalar("cfg/rescale"));
    assert_close(&rescaled, &golden.tensor("cfg/output_rescaled", None, &device), 2e-5, "rescaled guidance");
}

#[test]
fn sigma_lists_equal_the_stored_ones() {
    let Some(golden) = Golden::open() else { return };
    for (name, case) in golden.cases.as_object().unwrap() {
        let schedule = schedule(&case["config"]);
        let sigmas = match sampler(case) {
            SamplerConfig::Euler(euler) => {
                let scale = golden.values(&format!("{name}/init_noise_sigma")).1[0];
                assert!((euler.start_scale(&schedule) - scale).abs() <= 1e-5 * scale);
                euler.sigmas(&schedule)
            }
            SamplerConfig::FlowEuler(flow) => flow_sigmas(flow.steps, flow.shift, schedule.len()),
            _ => continue,
        };
        let want = golden.values(&format!("{name}/sigmas")).1;
        assert_eq!(sigmas.len(), want.len());
        for (got, want) in sigmas.iter().zip(&want) {
            assert!((got - want).abs() <= 1e-5 * want.abs().max(1.0), "{name}: {got} is not {want}");
        }
    }
}
