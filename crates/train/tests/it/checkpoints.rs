//! Damaged and unfinished checkpoints are never loaded; the right ones are kept; loading is strict.

use std::fs;
use std::path::{Path, PathBuf};

use burn::module::Module;
use burn::nn::{Linear, LinearConfig};
use burn::tensor::Device;
use train::{
    Best, CheckpointReader, CheckpointState, CheckpointStore, TrainError, count_parameters, find_checkpoint,
    load_named, named_parameters, read_config_text, save_named,
};

use crate::toy::filled;

fn module(seed: u64) -> Linear {
    filled(LinearConfig::new(3, 5).init(&Device::flex()), seed)
}

fn save(store: &CheckpointStore, step: u64) -> PathBuf {
    let state = CheckpointState { step, position: 2 * step, seed: 7, ..CheckpointState::default() };
    let saved = store.save(state, "preset = \"toy\"", |writer| {
        writer.module("model", &module(step))?;
        writer.tensors("optimizer", &named_parameters(&module(step + 1)))?;
        writer.value("note", &step)
    });
    saved.unwrap()
}

fn values<M: Module>(module: &M) -> Vec<(String, Vec<f32>)> {
    named_parameters(module).into_iter().map(|(path, t)| (path, t.values.into_data().try_to_vec().unwrap())).collect()
}

fn names(folder: &Path) -> Vec<String> {
    let mut names: Vec<String> =
        fs::read_dir(folder).unwrap().map(|entry| entry.unwrap().file_name().into_string().unwrap()).collect();
    names.sort();
    names
}

#[test]
fn what_was_saved_comes_back() {
    let run = tempfile::tempdir().unwrap();
    let store = CheckpointStore::open(run.path(), 2).unwrap();
    assert!(store.latest().unwrap().is_none());
    assert!(matches!(find_checkpoint(run.path()), Err(TrainError::NoCheckpoint { .. })));
    let folder = save(&store, 10);
    for reader in
        [store.latest().unwrap().unwrap(), find_checkpoint(&folder).unwrap(), find_checkpoint(run.path()).unwrap()]
    {
        assert_eq!((reader.state().step, reader.state().position, reader.state().seed), (10, 20, 7));
        assert_eq!(values(&reader.module("model", module(99)).unwrap()), values(&module(10)));
        assert_eq!(reader.tensors("optimizer", &Device::flex()).unwrap()["weight"].shape, [3, 5]);
        assert_eq!(reader.value::<u64>("note").unwrap(), 10);
        assert_eq!(reader.config_text("model").unwrap(), "preset = \"toy\"");
        assert!(reader.has("model") && !reader.has("ema"));
        assert!(reader.module("ema", module(0)).is_err());
        assert!(reader.value::<u64>("absent").is_err());
    }
}

#[test]
fn every_kind_of_damage_is_refused_and_an_older_checkpoint_taken() {
    type Damage = fn(&Path);
    let truncate: Damage = |path| {
        let bytes = fs::read(path).unwrap();
        fs::write(path, &bytes[..bytes.len() / 2]).unwrap();
    };
    let flip: Damage = |path| {
        let mut bytes = fs::read(path).unwrap();
        let last = bytes.len() - 3;
        bytes[last] ^= 4;
        fs::write(path, bytes).unwrap();
    };
    let change_number: Damage = |path| {
        let text = fs::read_to_string(path).unwrap_or_default();
        fs::write(path, text.replace("\"position\": 40", "\"position\": 41")).unwrap();
    };
    let empty: Damage = |path| fs::write(path, b"").unwrap();
    let delete: Damage = |path| fs::remove_file(path).unwrap();
    let mut cases: Vec<(&str, Damage)> = vec![("state.json", change_number)];
    for file in ["model.safetensors", "optimizer.safetensors", "state.json"] {
        cases.extend([truncate, flip, empty, delete].map(|damage| (file, damage)));
    }
    for (file, damage) in cases {
        let run = tempfile::tempdir().unwrap();
        let store = CheckpointStore::open(run.path(), 3).unwrap();
        save(&store, 10);
        let newest = save(&store, 20);
        damage(&newest.join(file));
        let error = CheckpointReader::open(&newest).unwrap_err().to_string();
        assert!(error.contains(file), "{error}");
        assert_eq!(store.latest().unwrap().unwrap().state().step, 10, "{file}");
        // The run goes on from 10 and reaches 20 again.
        save(&store, 20);
        assert_eq!(store.latest().unwrap().unwrap().state().step, 20);
        assert_eq!(names(&run.path().join("checkpoints")), ["step_00000010", "step_00000020"]);
    }
}

#[test]
fn a_run_with_only_damaged_checkpoints_does_not_start_over() {
    let run = tempfile::tempdir().unwrap();
    let store = CheckpointStore::open(run.path(), 3).unwrap();
    fs::remove_file(save(&store, 10).join("model.safetensors")).unwrap();
    let error = store.latest().unwrap_err();
    assert!(matches!(error, TrainError::NoCheckpoint { .. }));
    assert!(error.to_string().contains("model.safetensors"), "{error}");
}

#[test]
fn leftovers_of_a_killed_save_are_ignored_and_cleaned() {
    let run = tempfile::tempdir().unwrap();
    let store = CheckpointStore::open(run.path(), 3).unwrap();
    let whole = save(&store, 10);
    let folder = run.path().join("checkpoints");
    // Killed before the rename: all files there, but under the unfinished name.
    fs::create_dir(folder.join(".tmp-step_00000020")).unwrap();
    for name in names(&whole) {
        fs::copy(whole.join(&name), folder.join(".tmp-step_00000020").join(&name)).unwrap();
    }
    fs::create_dir(folder.join(".old-step_00000005")).unwrap();
    fs::write(folder.join(".tmp-best.json"), "{").unwrap();
    assert_eq!(find_checkpoint(run.path()).unwrap().state().step, 10);
    assert!(folder.join(".tmp-step_00000020").exists(), "reading cleans nothing");
    let store = CheckpointStore::open(run.path(), 3).unwrap();
    assert_eq!(names(&folder), ["step_00000010"]);
    assert_eq!(store.latest().unwrap().unwrap().state().step, 10);
}

#[test]
fn a_save_that_fails_leaves_the_earlier_ones() {
    let run = tempfile::tempdir().unwrap();
    let store = CheckpointStore::open(run.path(), 1).unwrap();
    save(&store, 10);
    let state = CheckpointState { step: 20, ..CheckpointState::default() };
    let failed = store.save(state, "", |_| Err(TrainError::Config("disk on fire".into())));
    assert!(failed.unwrap_err().to_string().contains("disk on fire"));
    assert_eq!(store.latest().unwrap().unwrap().state().step, 10);
}

#[test]
fn the_last_ones_and_the_best_are_kept() {
    let run = tempfile::tempdir().unwrap();
    let store = CheckpointStore::open(run.path(), 2).unwrap();
    save(&store, 1);
    save(&store, 2);
    let best = Best { step: 2, scalar: "psnr".into(), value: 20.5 };
    store.restore_best(Some(&best)).unwrap();
    for step in 3..=6 {
        save(&store, step);
    }
    let folder = run.path().join("checkpoints");
    assert_eq!(names(&folder), ["best.json", "step_00000002", "step_00000005", "step_00000006"]);
    assert_eq!(store.best().unwrap(), Some(best));
    store.restore_best(None).unwrap();
    save(&store, 7);
    assert_eq!(names(&folder), ["step_00000006", "step_00000007"]);
}

#[derive(Module, Debug)]
struct Before {
    stem: Linear,
    blocks: Vec<Linear>,
    head: Linear,
}

#[derive(Module, Debug)]
struct After {
    stem: Linear,
    blocks: Vec<Linear>,
    tail: Linear,
}

#[test]
fn a_strict_load_lists_every_difference() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("weights.safetensors");
    let device = Device::flex();
    let linear = |i, o| LinearConfig::new(i, o).init(&device);
    let before = Before { stem: linear(2, 3), blocks: vec![linear(3, 3)], head: linear(3, 1) };
    assert_eq!(count_parameters(&before), 9 + 12 + 4);
    save_named(&before, &path, Some("[model]")).unwrap();
    assert_eq!(read_config_text(&path).unwrap().as_deref(), Some("[model]"));
    assert_eq!(values(&load_named(filled(before.clone(), 5), &path).unwrap()), values(&before));
    let after = After { stem: linear(2, 4), blocks: vec![linear(3, 3)], tail: linear(3, 1) };
    let error = load_named(after, &path).unwrap_err();
    let text = error.to_string();
    for line in [
        "missing in the file: tail.weight",
        "missing in the file: tail.bias",
        "unknown to the model: head.weight",
        "unknown to the model: head.bias",
        "wrong shape: stem.weight is [2, 4] in the model, [2, 3] in the file",
        "wrong shape: stem.bias is [4] in the model, [3] in the file",
        "weights.safetensors",
    ] {
        assert!(text.contains(line), "{line:?} is not in:\n{text}");
    }
    assert!(!text.contains("blocks"), "{text}");
    fs::write(&path, b"not a weight file").unwrap();
    assert!(matches!(load_named(before, &path), Err(TrainError::Damaged { .. })));
}
