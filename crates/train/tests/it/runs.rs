//! The loop around a task: interruption, best checkpoint, non-finite guard, logs, refusals.

use std::collections::BTreeMap;
use std::path::Path;

use train::{
    BestRule, CheckpointStore, Goal, Interrupt, OnExisting, Outcome, RunDir, RunSetup, StepContext, StepOutput, Task,
    TrainConfig, TrainError, named_parameters, train,
};

use crate::resume::{config, part};
use crate::toy::{Numbers, Toy};

fn run(toy: &mut Toy, root: &Path, config: &TrainConfig, seed: u64, resume: bool) -> Result<Outcome, TrainError> {
    let run_dir = RunDir::create(root, "run", OnExisting::Resume).unwrap();
    let (interrupt, config_text) = (Interrupt::default(), "");
    let setup = RunSetup { config, run_dir: &run_dir, seed, config_text, resume, interrupt, pause_after: None };
    train(toy, |position| Ok(Numbers { seed, position }), &setup)
}

fn weights(toy: &Toy) -> Vec<Vec<f32>> {
    named_parameters(&toy.generator).into_values().map(|t| t.values.into_data().try_to_vec().unwrap()).collect()
}

#[test]
fn a_request_to_stop_finishes_the_step_saves_and_says_so() {
    struct Stopping(Toy, Interrupt);
    impl Task for Stopping {
        type Batch = Vec<f32>;
        fn train_step(&mut self, batches: Vec<Vec<f32>>, ctx: &StepContext) -> Result<StepOutput, TrainError> {
            if ctx.step == 6 {
                self.1.request();
            }
            self.0.train_step(batches, ctx)
        }
        fn validate(&mut self, ctx: &StepContext) -> Result<train::Scalars, TrainError> {
            self.0.validate(ctx)
        }
        fn preview(&mut self, folder: &Path, ctx: &StepContext) -> Result<(), TrainError> {
            self.0.preview(folder, ctx)
        }
        fn save(&self, writer: &mut train::CheckpointWriter) -> Result<(), TrainError> {
            self.0.save(writer)
        }
        fn load(&mut self, reader: &train::CheckpointReader) -> Result<(), TrainError> {
            self.0.load(reader)
        }
    }
    let root = tempfile::tempdir().unwrap();
    let run_dir = RunDir::create(root.path(), "run", OnExisting::Refuse).unwrap();
    let interrupt = Interrupt::default();
    let mut task = Stopping(Toy::new(1), interrupt.clone());
    let config = config();
    let setup = RunSetup {
        config: &config,
        run_dir: &run_dir,
        seed: 1,
        config_text: "",
        resume: false,
        interrupt,
        pause_after: None,
    };
    let outcome = train(&mut task, |position| Ok(Numbers { seed: 1, position }), &setup).unwrap();
    assert_eq!((outcome.steps, outcome.interrupted), (7, true));
    let saved = CheckpointStore::open(run_dir.path(), 3).unwrap().latest().unwrap().unwrap();
    assert_eq!((saved.state().step, saved.state().position), (7, 14));
}

#[test]
fn a_bad_update_is_skipped_and_too_many_end_the_run() {
    let root = tempfile::tempdir().unwrap();
    let mut toy = Toy::new(1);
    toy.poisoned = vec![2, 3];
    let config = TrainConfig { stop_after_nonfinite: 3, ..config() };
    let outcome = run(&mut toy, root.path(), &config, 1, false).unwrap();
    assert_eq!(outcome.steps, 20);
    assert_eq!((toy.optimizers[0].guard().total(), toy.optimizers[1].guard().total()), (2, 0));
    assert!(weights(&toy).concat().iter().all(|value| value.is_finite()));

    let root = tempfile::tempdir().unwrap();
    let mut toy = Toy::new(1);
    toy.poisoned = vec![7, 8, 9];
    let error = run(&mut toy, root.path(), &config, 1, false).unwrap_err();
    let TrainError::NonFinite { step, in_a_row, culprit } = &error else { panic!("{error}") };
    assert_eq!((*step, *in_a_row), (9, 3));
    assert!(culprit.contains("hidden") || culprit.contains("output"), "{culprit}");
    let saved = CheckpointStore::open(&root.path().join("run"), 3).unwrap().latest().unwrap().unwrap();
    assert_eq!(saved.state().step, 5, "the checkpoint from before is still there");
}

#[test]
fn skipped_steps_leave_everything_as_it_was() {
    let mut toy = Toy::new(1);
    let ctx = StepContext { step: 0, total_steps: 9, seed: 1, log: true, stop_after_nonfinite: 0 };
    let before = (weights(&toy), toy.ema.decay());
    toy.poisoned = vec![0];
    toy.train_step(vec![vec![0.5; 24]], &ctx).unwrap();
    assert_eq!((weights(&toy), toy.ema.decay()), before);
    toy.poisoned.clear();
    toy.train_step(vec![vec![0.5; 24]], &ctx).unwrap();
    assert_ne!(weights(&toy), before.0);
    assert_ne!(toy.ema.decay(), before.1);
}

#[test]
fn the_best_checkpoint_is_kept_and_survives_a_resume() {
    let scripted = BTreeMap::from([(4, 3.0), (8, 1.0), (12, f64::NAN), (16, 2.0), (20, 1.5)]);
    let rule = |goal| Some(BestRule { scalar: "distance".into(), goal });
    for (goal, expected) in [(Goal::Min, (8, 1.0)), (Goal::Max, (4, 3.0))] {
        let root = tempfile::tempdir().unwrap();
        let config = TrainConfig { best: rule(goal), keep_last: 1, ..config() };
        let mut toy = Toy::new(1);
        toy.scripted = scripted.clone();
        let outcome = run(&mut toy, root.path(), &config, 1, false).unwrap();
        let best = outcome.best.unwrap();
        assert_eq!((best.step, best.value), expected);
        let store = CheckpointStore::open(&root.path().join("run"), 1).unwrap();
        assert_eq!(store.best().unwrap(), Some(best.clone()));
        let folder = root.path().join(format!("run/checkpoints/step_{:08}", best.step));
        assert_eq!(train::find_checkpoint(&folder).unwrap().state().step, best.step);
        let outcome = run(&mut Toy::new(2), root.path(), &config, 1, true).unwrap();
        assert_eq!(outcome.best, Some(best));
    }
    let config = TrainConfig { best: Some(BestRule { scalar: "psnr".into(), goal: Goal::Max }), ..config() };
    let error = run(&mut Toy::new(1), tempfile::tempdir().unwrap().path(), &config, 1, false).unwrap_err().to_string();
    assert!(error.contains("psnr") && error.contains("distance"), "{error}");
}

#[test]
fn logs_are_complete_and_numbers_plausible() {
    let root = tempfile::tempdir().unwrap();
    let (_, outcome) = part(root.path(), &config(), 1, false, None);
    assert!((0.0..=1.0).contains(&outcome.data_wait_fraction) && outcome.images_per_second > 0.0);
    assert!(outcome.seconds > 0.0);
    if cfg!(target_os = "linux") {
        let peak = outcome.peak_rss_bytes.unwrap();
        assert!((1 << 20..1 << 40).contains(&peak), "{peak}");
    }
    let text = std::fs::read_to_string(root.path().join("run/metrics.jsonl")).unwrap();
    let rows: Vec<serde_json::Value> = text.lines().map(|line| serde_json::from_str(line).unwrap()).collect();
    let of = |split: &str| {
        rows.iter().filter(|row| row["split"] == split).map(|row| row["step"].as_u64().unwrap()).collect()
    };
    let (trained, validated): (Vec<u64>, Vec<u64>) = (of("train"), of("validation"));
    assert_eq!(trained, [3, 6, 9, 12, 15, 18, 20]);
    assert_eq!(validated, [4, 8, 12, 16, 20]);
    for key in ["loss", "critic", "gradient_norm", "images_per_second", "data_wait_fraction"] {
        assert!(rows[0][key].is_number(), "{key} in {}", rows[0]);
    }
}

#[test]
fn another_seed_is_refused() {
    let root = tempfile::tempdir().unwrap();
    run(&mut Toy::new(1), root.path(), &config(), 1, false).unwrap();
    let error = run(&mut Toy::new(1), root.path(), &config(), 2, true).unwrap_err().to_string();
    assert!(error.contains("seed 1") && error.contains("seed 2"), "{error}");
}

#[test]
fn the_config_is_strict_and_complete() {
    let config: TrainConfig = toml::from_str("steps = 5\nbest = { scalar = \"psnr\", goal = \"max\" }").unwrap();
    assert_eq!((config.steps, config.log_every), (5, 10));
    assert!(toml::from_str::<TrainConfig>("step = 5").is_err());
    assert!(toml::from_str::<TrainConfig>("best = { scalar = \"psnr\", goal = \"max\", x = 1 }").is_err());
    let full = toml::to_string(&TrainConfig::default()).unwrap();
    assert_eq!(toml::from_str::<TrainConfig>(&full).unwrap(), TrainConfig::default());
}

#[test]
fn optimizer_settings_survive_the_written_config() {
    let config = train::OptimizerConfig::default();
    let text = toml::to_string(&config).unwrap();
    assert_eq!(toml::from_str::<train::OptimizerConfig>(&text).unwrap(), config);
    let other: train::OptimizerConfig = toml::from_str("gradient_clip = \"off\"\ndecay_scope = \"all\"").unwrap();
    assert_eq!((other.gradient_clip, other.decay_scope), (train::GradientClip::Off, train::DecayScope::All));
    let other: train::OptimizerConfig = toml::from_str("gradient_clip = { global_norm = 2.5 }").unwrap();
    assert_eq!(other.gradient_clip, train::GradientClip::GlobalNorm(2.5));
    assert!(toml::from_str::<train::OptimizerConfig>("lr = 1.0").is_err());
}
