//! Which sample comes when, whatever the threads do.

use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::Duration;

use data::{
    AugmentConfig, ColorJitter, DataError, ImageSize, InOrder, Loader, LoaderConfig, Mixture, MixtureConfig,
    MixtureOrder, MixtureWeights, PadViews, PoseMode, RigMotion, SampleOptions, SceneBatch, SceneDataset,
};

use super::fake::Ring;

const SIZE: ImageSize = ImageSize { height: 12, width: 16 };

fn config() -> LoaderConfig {
    LoaderConfig { batch_size: 3, workers: 2, size: SIZE, seed: 11, ..LoaderConfig::default() }
}

fn everything_on() -> AugmentConfig {
    AugmentConfig {
        flip_probability: 0.5,
        color_jitter: ColorJitter { probability: 0.8, ..ColorJitter::default() },
        grayscale_probability: 0.2,
        rig_motion: RigMotion { probability: 0.5, ..RigMotion::default() },
        drop_view_probability: 0.2,
    }
}

fn three_rigs(folder: &std::path::Path, lens: [usize; 3]) -> Vec<Arc<dyn SceneDataset>> {
    let rigs = [("four", 4), ("six", 6), ("seven", 7)];
    let make = |((name, views), frames)| Arc::new(Ring::new(folder, name, views, frames)) as Arc<dyn SceneDataset>;
    rigs.into_iter().zip(lens).map(make).collect()
}

fn mixture(datasets: Vec<Arc<dyn SceneDataset>>, config: &MixtureConfig) -> Arc<Mixture> {
    Arc::new(Mixture::new(datasets, config, 3, 5).unwrap())
}

fn take(loader: &mut Loader, count: usize) -> Vec<SceneBatch> {
    (0..count).map(|_| loader.next_batch().unwrap()).collect()
}

#[test]
fn order_does_not_depend_on_workers() {
    let folder = tempfile::tempdir().unwrap();
    let blend = mixture(three_rigs(folder.path(), [5, 4, 3]), &MixtureConfig::default());
    let run = |workers, prefetch| {
        let config = LoaderConfig { workers, prefetch, augment: everything_on(), ..config() };
        take(&mut Loader::new(blend.clone(), config, 0).unwrap(), 10)
    };
    let alone = run(1, 0);
    assert_eq!(alone, run(2, 3));
    assert_eq!(alone, run(5, 1));
    assert!(alone.iter().flat_map(|b| &b.ids).any(|id| id.dataset == "seven"));
}

#[test]
fn resuming_equals_going_on() {
    let folder = tempfile::tempdir().unwrap();
    let blend = mixture(three_rigs(folder.path(), [5, 4, 3]), &MixtureConfig::default());
    let config = LoaderConfig { augment: everything_on(), ..config() };
    let mut whole = Loader::new(blend.clone(), config.clone(), 0).unwrap();
    take(&mut whole, 4);
    let position = whole.position();
    assert_eq!(position, 4);
    let mut resumed = Loader::new(blend, config, position).unwrap();
    assert_eq!(take(&mut whole, 6), take(&mut resumed, 6));
    assert_eq!(resumed.position(), 10);
}

#[test]
fn work_ahead_is_bounded_and_nothing_is_loaded_twice() {
    for start in [0, 5] {
        let folder = tempfile::tempdir().unwrap();
        let ring = Ring::new(folder.path(), "ring", 2, 8);
        let asked = ring.asked.clone();
        let config = LoaderConfig { prefetch: 2, ..config() };
        let blend = mixture(vec![Arc::new(ring)], &MixtureConfig::default());
        let mut loader = Loader::new(blend, config, start).unwrap();
        for taken in 0..4 {
            std::thread::sleep(Duration::from_millis(50));
            // Two batches of three ahead of the one that comes next; the last sample asked for may still be loading.
            let count = asked.load(Ordering::Relaxed);
            let most = if taken == 0 { 9 } else { 3 * (taken - 1) + 9 };
            assert!((3 * taken..=most).contains(&count), "{count} samples after {taken} batches");
            loader.next_batch().unwrap();
        }
    }
}

#[test]
fn a_frame_is_augmented_anew_each_time() {
    let folder = tempfile::tempdir().unwrap();
    let blend = mixture(vec![Arc::new(Ring::new(folder.path(), "ring", 2, 1))], &MixtureConfig::default());
    let augment = AugmentConfig { flip_probability: 0.5, ..AugmentConfig::default() };
    let run = |seed| {
        let config = LoaderConfig { augment: augment.clone(), seed, ..config() };
        let batches = take(&mut Loader::new(blend.clone(), config, 0).unwrap(), 8);
        batches.iter().flat_map(|b| b.input.img_from_raw.chunks(9).map(|m| m[0] < 0.0)).collect::<Vec<bool>>()
    };
    let flips = run(1);
    assert!(flips.contains(&true) && flips.contains(&false), "{flips:?}");
    assert_ne!(flips, run(2));
}

#[test]
fn epochs_have_exact_counts_and_passes_no_repeats() {
    let folder = tempfile::tempdir().unwrap();
    let datasets = three_rigs(folder.path(), [10, 5, 2]);
    let cases = [
        (MixtureWeights::Proportional, vec![10, 5, 2]),
        (MixtureWeights::Balanced, vec![6, 6, 5]),
        (MixtureWeights::Explicit(vec![0.0, 3.0, 1.0]), vec![0, 13, 4]),
    ];
    for (weights, counts) in cases {
        let blend = mixture(datasets.clone(), &MixtureConfig { weights, ..MixtureConfig::default() });
        assert_eq!(blend.epoch_counts(), counts);
        assert_eq!(blend.epoch_len(), 17);
        let mut walked = vec![vec![]; 3];
        for epoch in 0..20 {
            let mut seen = vec![0; 3];
            for k in epoch * 17..(epoch + 1) * 17 {
                let (dataset, frame) = blend.item(k);
                seen[dataset] += 1;
                walked[dataset].push(frame);
            }
            assert_eq!(seen, counts, "epoch {epoch}");
        }
        for (dataset, frames) in walked.iter().enumerate() {
            let len = datasets[dataset].len();
            let mut uses = vec![0; len];
            frames.iter().for_each(|frame| uses[*frame] += 1);
            let (least, most) = (uses.iter().min().unwrap(), uses.iter().max().unwrap());
            assert!(most - least <= 1, "a dataset is walked pass by pass: {uses:?}");
        }
    }
}

#[test]
fn another_seed_or_epoch_is_another_order() {
    let folder = tempfile::tempdir().unwrap();
    let datasets = three_rigs(folder.path(), [10, 5, 2]);
    let order = |seed, epoch: u64| {
        let blend = Mixture::new(datasets.clone(), &MixtureConfig::default(), 3, seed).unwrap();
        (epoch * 17..(epoch + 1) * 17).map(|k| blend.item(k)).collect::<Vec<_>>()
    };
    assert_eq!(order(1, 0), order(1, 0));
    assert_ne!(order(1, 0), order(2, 0));
    assert_ne!(order(1, 0), order(1, 1));
}

#[test]
fn homogeneous_batches_hold_one_rig() {
    let folder = tempfile::tempdir().unwrap();
    let config = MixtureConfig { order: MixtureOrder::Homogeneous, ..MixtureConfig::default() };
    let blend = mixture(three_rigs(folder.path(), [9, 6, 4]), &config);
    assert_eq!(blend.epoch_len(), 21, "seven batches of three");
    let mut loader = Loader::new(blend.clone(), self::config(), 0).unwrap();
    for batch in take(&mut loader, 7) {
        assert!(batch.ids.iter().all(|id| id.dataset == batch.ids[0].dataset), "{:?}", batch.ids);
        assert!(batch.input.mask.iter().all(|m| *m), "no padding");
    }
    let refused = Loader::new(blend, LoaderConfig { batch_size: 2, ..self::config() }, 0);
    assert!(matches!(refused, Err(DataError::Config(_))));
}

#[test]
fn mixtures_without_a_meaning_are_refused() {
    let folder = tempfile::tempdir().unwrap();
    let datasets = three_rigs(folder.path(), [10, 5, 2]);
    let refused = |datasets: Vec<Arc<dyn SceneDataset>>, weights| {
        let config = MixtureConfig { weights, ..MixtureConfig::default() };
        matches!(Mixture::new(datasets, &config, 3, 0), Err(DataError::Config(_)))
    };
    assert!(refused(vec![], MixtureWeights::Proportional));
    assert!(refused(vec![Arc::new(Ring::new(folder.path(), "empty", 2, 0))], MixtureWeights::Proportional));
    for weights in [vec![1.0], vec![0.0; 3], vec![1.0, -1.0, 1.0], vec![1.0, f64::NAN, 1.0], vec![1.0, 1.0, 1e-6]] {
        assert!(refused(datasets.clone(), MixtureWeights::Explicit(weights.clone())), "{weights:?}");
    }
}

/// Runs until the first error; returns the batches before it.
fn until_error(datasets: Vec<Arc<dyn SceneDataset>>, workers: usize) -> (u64, DataError) {
    let mut loader =
        Loader::new(mixture(datasets, &MixtureConfig::default()), LoaderConfig { workers, ..config() }, 0).unwrap();
    loop {
        let batch = loader.next_batch();
        if let Err(error) = batch {
            assert!(loader.next_batch().is_err(), "it must not go on behind an error");
            return (loader.position(), error);
        }
        assert!(loader.position() < 10, "the fault was passed over");
    }
}

/// The batch of the item that shows this frame first.
fn batch_of(datasets: &[Arc<dyn SceneDataset>], wanted: usize) -> u64 {
    let blend = mixture(datasets.to_vec(), &MixtureConfig::default());
    (0..).find(|k| blend.item(*k).1 == wanted).unwrap() / 3
}

#[test]
fn an_unreadable_picture_stops_the_run_at_its_batch() {
    for workers in [1, 3] {
        let folder = tempfile::tempdir().unwrap();
        let ring = Ring::new(folder.path(), "ring", 4, 12);
        let broken = ring.path(7, 2);
        std::fs::write(&broken, b"no picture").unwrap();
        let datasets: Vec<Arc<dyn SceneDataset>> = vec![Arc::new(ring)];
        let (position, error) = until_error(datasets.clone(), workers);
        assert_eq!(position, batch_of(&datasets, 7));
        let text = error.to_string();
        assert!(text.contains("frame 7 of ring") && text.ends_with(&broken.display().to_string()), "{text}");
        assert!(matches!(error, DataError::Frame { source, .. } if matches!(*source, DataError::Image { .. })));
    }
}

#[test]
fn bad_rows_and_panics_stop_the_run_too() {
    for panics in [false, true] {
        let folder = tempfile::tempdir().unwrap();
        let mut ring = Ring::new(folder.path(), "ring", 4, 12);
        *(if panics { &mut ring.panics } else { &mut ring.bad_rows }) = vec![5];
        let datasets: Vec<Arc<dyn SceneDataset>> = vec![Arc::new(ring)];
        let (position, error) = until_error(datasets.clone(), 2);
        assert_eq!(position, batch_of(&datasets, 5));
        let wanted = if panics { "this frame panics" } else { "these rows are bad" };
        assert!(error.to_string().contains("index 5") && error.to_string().contains(wanted), "{error}");
    }
}

#[test]
fn dropping_ends_the_threads() {
    let folder = tempfile::tempdir().unwrap();
    let datasets = three_rigs(folder.path(), [20, 20, 20]);
    let (done, wait) = crossbeam_channel::bounded(1);
    let background = std::thread::spawn(move || {
        let blend = mixture(datasets, &MixtureConfig::default());
        // Never asked; asked once, with much work still ahead.
        drop(Loader::new(blend.clone(), LoaderConfig { prefetch: 50, workers: 4, ..config() }, 0).unwrap());
        let mut loader = Loader::new(blend.clone(), LoaderConfig { prefetch: 50, workers: 4, ..config() }, 0).unwrap();
        loader.next_batch().unwrap();
        drop(loader);
        // All workers joined: nobody else holds the mixture.
        done.send(Arc::strong_count(&blend)).unwrap();
    });
    assert_eq!(wait.recv_timeout(Duration::from_secs(60)), Ok(1));
    background.join().unwrap();
}

#[test]
fn settings_without_a_meaning_are_refused() {
    let folder = tempfile::tempdir().unwrap();
    let blend = mixture(three_rigs(folder.path(), [2, 2, 2]), &MixtureConfig::default());
    let bad_jitter = ColorJitter { hue: 0.7, ..ColorJitter::default() };
    for refused in [
        LoaderConfig { batch_size: 0, ..config() },
        LoaderConfig { workers: 0, ..config() },
        LoaderConfig { size: ImageSize { height: 0, width: 4 }, ..config() },
        LoaderConfig { pad_views: PadViews::To(6), ..config() },
        LoaderConfig { augment: AugmentConfig { flip_probability: 1.5, ..Default::default() }, ..config() },
        LoaderConfig { augment: AugmentConfig { color_jitter: bad_jitter, ..Default::default() }, ..config() },
    ] {
        assert!(matches!(Loader::new(blend.clone(), refused.clone(), 0), Err(DataError::Config(_))), "{refused:?}");
    }
    Loader::new(blend, LoaderConfig { pad_views: PadViews::To(7), ..config() }, 0).unwrap();
}

#[test]
fn one_pass_shows_every_frame_once_in_order() {
    let folder = tempfile::tempdir().unwrap();
    let ring = Ring::new(folder.path(), "ring", 2, 7);
    let options = SampleOptions { size: SIZE, pose_mode: PoseMode::Static };
    let batches: Vec<SceneBatch> = InOrder::new(&ring, 3, PadViews::Largest, options).map(Result::unwrap).collect();
    assert_eq!(batches.iter().map(|b| b.ids.len()).collect::<Vec<_>>(), [3, 3, 1]);
    let frames: Vec<&str> = batches.iter().flat_map(|b| &b.ids).map(|id| id.frame.as_str()).collect();
    assert_eq!(frames, ["0", "1", "2", "3", "4", "5", "6"]);
}
