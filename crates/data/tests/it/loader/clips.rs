//! Batches of clips: what lies where, in which order, and that a run goes on from its position.

use std::sync::Arc;

use data::{
    AugmentConfig, ClipConfig, Clips, ImageSize, Loader, LoaderConfig, Mixture, MixtureConfig, MixtureOrder,
    SceneBatch, SceneDataset,
};
use geometry::Rigid;
use geometry::glam::DMat4;

use super::fake::{RAW, Ring, car};

fn clips(ring: Ring, frames: usize) -> Arc<Clips> {
    let config = ClipConfig { frames, rate_hz: 2.0, ..ClipConfig::default() };
    Arc::new(Clips::new(Arc::new(ring), config).unwrap())
}

fn config(workers: usize) -> LoaderConfig {
    LoaderConfig { workers, size: ImageSize { height: 6, width: 8 }, seed: 3, ..LoaderConfig::default() }
}

fn batches(mixture: &Arc<Mixture>, config: LoaderConfig, start: u64, count: usize) -> Vec<SceneBatch> {
    let mut loader = Loader::new(mixture.clone(), config, start).unwrap();
    (0..count).map(|_| loader.next_batch().unwrap()).collect()
}

/// Index of a sample's frame in the ring.
fn index(batch: &SceneBatch, sample: usize) -> usize {
    batch.ids[sample].frame.parse().unwrap()
}

#[test]
fn a_clip_is_consecutive_frames_with_their_times_and_motion() {
    let folder = tempfile::tempdir().unwrap();
    let mixture =
        Mixture::of_clips(vec![clips(Ring::new(folder.path(), "a", 2, 7), 3)], &MixtureConfig::default(), 2, 1);
    let mixture = Arc::new(mixture.unwrap());
    assert_eq!((mixture.epoch_len(), mixture.item_frames(0)), (5, 3));
    let mut starts = Vec::new();
    for batch in batches(&mixture, config(3), 0, 5) {
        let found = batch.clips.as_ref().unwrap();
        assert_eq!((found.clips, found.frames), (2, 3));
        assert_eq!((batch.input.batch, batch.input.views, batch.ids.len()), (6, 2, 6));
        assert_eq!(found.elapsed_secs, [0.0, 0.5, 1.0, 0.0, 0.5, 1.0]);
        for clip in 0..2 {
            let first = index(&batch, 3 * clip);
            starts.push(first);
            for at in 0..3 {
                let sample = 3 * clip + at;
                assert_eq!(index(&batch, sample), first + at);
                let [now, before] = [at, at.saturating_sub(1)].map(|at| car((first + at) as f64 * 0.5));
                let want = (now.inverse() * before).to_rows();
                let got = &found.ego_from_previous_ego[16 * sample..][..16];
                assert!(got.iter().zip(want.as_flattened()).all(|(a, b)| (f64::from(*a) - b).abs() < 1e-5), "{got:?}");
            }
        }
    }
    // Two epochs of five clips: each twice.
    starts.sort_unstable();
    assert_eq!(starts, [0, 0, 1, 1, 2, 2, 3, 3, 4, 4]);
}

#[test]
fn clips_do_not_depend_on_workers_and_go_on_from_their_position() {
    let folder = tempfile::tempdir().unwrap();
    let rings =
        [("a", 2, 9), ("b", 3, 8)].map(|(name, views, frames)| clips(Ring::new(folder.path(), name, views, frames), 4));
    let mixture = Arc::new(Mixture::of_clips(rings.to_vec(), &MixtureConfig::default(), 2, 5).unwrap());
    let augment = AugmentConfig { flip_probability: 0.5, drop_view_probability: 0.3, ..AugmentConfig::default() };
    let config = |workers| LoaderConfig { augment: augment.clone(), ..config(workers) };
    let whole = batches(&mixture, config(1), 0, 9);
    assert_eq!(whole, batches(&mixture, config(4), 0, 9));
    assert_eq!(whole[4..], batches(&mixture, config(2), 4, 5));
    assert!(whole.iter().any(|batch| batch.ids.iter().any(|id| id.dataset == "a") && batch.input.views == 3));
}

#[test]
fn all_frames_of_a_clip_are_changed_alike_and_motion_follows_the_moved_rig() {
    let folder = tempfile::tempdir().unwrap();
    let mixture =
        Mixture::of_clips(vec![clips(Ring::new(folder.path(), "a", 2, 6), 3)], &MixtureConfig::default(), 1, 1);
    let mut augment = AugmentConfig { flip_probability: 0.5, ..AugmentConfig::default() };
    augment.rig_motion.probability = 1.0;
    let config = LoaderConfig { augment, batch_size: 1, ..config(2) };
    for batch in batches(&Arc::new(mixture.unwrap()), config, 0, 4) {
        let motions = &batch.clips.as_ref().unwrap().ego_from_previous_ego;
        let edits = batch.input.img_from_raw.chunks_exact(2 * 9).collect::<Vec<_>>();
        assert!(edits.iter().all(|edit| *edit == edits[0]));
        // ego_from_cam is one rigid motion times the mounting pose; the car's motion is seen from the moved frame.
        let pose = |rows: &[f32]| {
            let numbers: Vec<f64> = rows.iter().map(|value| f64::from(*value)).collect();
            Rigid::from_mat4(&DMat4::from_cols_slice(&numbers).transpose())
        };
        let ring = Ring::new(folder.path(), "a", 2, 1);
        let frame = index(&batch, 0);
        let [first, second] = [0, 1].map(|at| ring.frame(frame + at).unwrap());
        let static_pose = first.views[0].ref_ego_from_cam(&first.world_from_ego);
        let moved = pose(&batch.input.ego_from_cam[..16]) * static_pose.inverse();
        let want = moved * second.world_from_ego.inverse() * first.world_from_ego * moved.inverse();
        let got = pose(&motions[16..32]);
        assert!((got.translation - want.translation).length() < 1e-3 && got.angle_to(&want) < 1e-4);
    }
}

#[test]
fn batches_of_one_length_are_made_where_lengths_differ() {
    let folder = tempfile::tempdir().unwrap();
    let both = || vec![clips(Ring::new(folder.path(), "a", 2, 9), 2), clips(Ring::new(folder.path(), "b", 2, 9), 5)];
    let refused = Mixture::of_clips(both(), &MixtureConfig::default(), 2, 1).unwrap_err().to_string();
    assert!(refused.contains("[2, 5]") && refused.contains("homogeneous"), "{refused}");
    let uniform = MixtureConfig { order: MixtureOrder::Homogeneous, ..MixtureConfig::default() };
    let mixture = Arc::new(Mixture::of_clips(both(), &uniform, 2, 1).unwrap());
    let mut seen = Vec::new();
    for batch in batches(&mixture, config(2), 0, 12) {
        let frames = batch.clips.as_ref().unwrap().frames;
        assert_eq!((batch.ids.len(), batch.input.images.len()), (2 * frames, 2 * frames * 2 * 3 * 6 * 8));
        assert!(batch.ids.iter().all(|id| (id.dataset == "a") == (frames == 2)));
        seen.push(frames);
    }
    assert!(seen.contains(&2) && seen.contains(&5), "{seen:?}");
    assert_eq!((RAW.width, RAW.height), (64, 48));
}
