//! 2N steps equal N steps, a new process and N more, byte for byte; also after `kill -9`.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};

use train::{Interrupt, OnExisting, Outcome, RunDir, RunSetup, TrainConfig, train};

use crate::toy::{Numbers, Toy};

const SEED: u64 = 11;

pub fn config() -> TrainConfig {
    TrainConfig {
        steps: 20,
        accumulate: 2,
        log_every: 3,
        validate_every: 4,
        preview_every: 10,
        checkpoint_every: 5,
        ..TrainConfig::default()
    }
}

/// One process's part of a run. Every part starts from a task with other random parameters, so that anything the
/// checkpoint forgot would show.
pub fn part(root: &Path, config: &TrainConfig, init: u64, resume: bool, pause_after: Option<u64>) -> (Toy, Outcome) {
    let run_dir = RunDir::create(root, "run", OnExisting::Resume).unwrap();
    let setup = RunSetup {
        config,
        run_dir: &run_dir,
        seed: SEED,
        config_text: "kind = \"toy\"\n",
        resume,
        interrupt: Interrupt::default(),
        pause_after,
    };
    let mut toy = Toy::new(init);
    let outcome = train(&mut toy, |position| Ok(Numbers { seed: SEED, position }), &setup).unwrap();
    (toy, outcome)
}

fn final_checkpoint(root: &Path, steps: u64) -> PathBuf {
    root.join(format!("run/checkpoints/step_{steps:08}"))
}

/// Content of every file in a folder.
fn content(folder: &Path) -> BTreeMap<String, Vec<u8>> {
    let entries = std::fs::read_dir(folder).unwrap().map(|entry| entry.unwrap());
    entries.map(|e| (e.file_name().into_string().unwrap(), std::fs::read(e.path()).unwrap())).collect()
}

fn assert_same_checkpoint(ours: &Path, expected: &Path) {
    let (ours, expected) = (content(ours), content(expected));
    assert_eq!(ours.keys().collect::<Vec<_>>(), expected.keys().collect::<Vec<_>>());
    assert_eq!(expected.len(), 6, "model, discriminator, ema, two optimizers, state");
    for (name, bytes) in &expected {
        assert_eq!(&ours[name], bytes, "{name} differs");
    }
}

fn metric_rows(root: &Path) -> Vec<String> {
    let text = std::fs::read_to_string(root.join("run/metrics.jsonl")).unwrap();
    let rows = text.lines().map(|line| {
        let mut row: serde_json::Value = serde_json::from_str(line).unwrap();
        let row = row.as_object_mut().unwrap();
        row.remove("images_per_second"); // the clock's
        row.remove("data_wait_fraction");
        format!("{row:?}")
    });
    rows.collect()
}

#[test]
fn stopping_and_going_on_changes_nothing() {
    let (straight, parted) = (tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap());
    let config = config();
    let (whole, outcome) = part(straight.path(), &config, 1, false, None);
    assert_eq!((outcome.steps, outcome.interrupted), (20, false));

    let (first, outcome) = part(parted.path(), &config, 1, false, Some(10));
    assert_eq!((outcome.steps, outcome.interrupted), (10, true));
    let (middle, _) = part(parted.path(), &config, 2, true, Some(13)); // not a checkpoint step of the straight run
    let (last, outcome) = part(parted.path(), &config, 3, true, None);
    assert_eq!((outcome.steps, outcome.interrupted), (20, false));

    assert_same_checkpoint(&final_checkpoint(parted.path(), 20), &final_checkpoint(straight.path(), 20));
    let seen = [first.seen, middle.seen, last.seen].concat();
    assert_eq!(seen, whole.seen, "data order");
    assert_eq!(seen.len(), 40);
    assert_eq!(metric_rows(parted.path()), metric_rows(straight.path()));
    for step in [10, 20] {
        let preview = format!("run/previews/step_{step:08}/preview.txt");
        assert_eq!(std::fs::read_to_string(parted.path().join(&preview)).unwrap(), step.to_string());
    }
}

#[test]
fn a_finished_run_resumes_to_the_same_end() {
    let root = tempfile::tempdir().unwrap();
    part(root.path(), &config(), 1, false, None);
    let before = content(&final_checkpoint(root.path(), 20));
    let (toy, outcome) = part(root.path(), &config(), 2, true, None);
    assert_eq!((outcome.steps, toy.seen.len(), outcome.interrupted), (20, 0, false));
    assert_eq!(outcome.validation[0].0, "distance");
    assert_eq!(content(&final_checkpoint(root.path(), 20)), before);
}

#[test]
fn a_resume_without_a_checkpoint_starts_at_zero() {
    let root = tempfile::tempdir().unwrap();
    let (toy, outcome) = part(root.path(), &config(), 1, true, Some(2));
    assert_eq!((outcome.steps, toy.seen.len()), (2, 4));
}

/// The child side of the test below: trains into the folder named in this variable.
const CHILD_FOLDER: &str = "RIGSCAPE_TEST_TRAIN_CHILD";

/// Long enough to be killed in the middle, with a checkpoint after every step.
fn killed_config() -> TrainConfig {
    TrainConfig { steps: 100, checkpoint_every: 1, validate_every: 25, ..config() }
}

#[test]
fn kill_9_at_any_moment_loses_at_most_the_last_steps() {
    if let Some(folder) = std::env::var_os(CHILD_FOLDER) {
        part(Path::new(&folder), &killed_config(), 1, true, None);
        return;
    }
    let (straight, killed) = (tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap());
    part(straight.path(), &killed_config(), 1, false, None);
    let mut kills = 0;
    for round in 0..6_u64 {
        let mut child = Command::new(std::env::current_exe().unwrap())
            .args(["--exact", "resume::kill_9_at_any_moment_loses_at_most_the_last_steps"])
            .env(CHILD_FOLDER, killed.path())
            .stdout(Stdio::null())
            .stderr(Stdio::null())
            .spawn()
            .unwrap();
        let before = newest_step(killed.path());
        let begun = Instant::now();
        while newest_step(killed.path()) < before + 4 && begun.elapsed() < Duration::from_secs(60) {
            if child.try_wait().unwrap().is_some() {
                break;
            }
            std::thread::sleep(Duration::from_millis(1));
        }
        std::thread::sleep(Duration::from_micros(700 * round));
        kills += u32::from(child.try_wait().unwrap().is_none());
        child.kill().unwrap(); // SIGKILL on Unix
        child.wait().unwrap();
        assert!(newest_step(killed.path()) > before, "round {round} made no progress");
    }
    assert!(kills >= 3, "only {kills} rounds were cut short; the run is too short for this test");
    part(killed.path(), &killed_config(), 9, true, None);
    assert_same_checkpoint(&final_checkpoint(killed.path(), 100), &final_checkpoint(straight.path(), 100));
    let names = std::fs::read_dir(killed.path().join("run/checkpoints")).unwrap();
    assert!(names.map(|e| e.unwrap().file_name().into_string().unwrap()).all(|name| !name.starts_with('.')));
    assert_eq!(metric_rows(killed.path()), metric_rows(straight.path()));
}

fn newest_step(root: &Path) -> u64 {
    let Ok(entries) = std::fs::read_dir(root.join("run/checkpoints")) else { return 0 };
    let names = entries.filter_map(|entry| entry.ok()?.file_name().into_string().ok());
    names.filter_map(|name| name.strip_prefix("step_")?.parse().ok()).max().unwrap_or(0)
}
