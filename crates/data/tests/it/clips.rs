//! Clips of any dataset: rates, gaps, rigs, motion, order.

use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::Ordering;

use data::nuscenes::{BoxMode, FrameChoice, NuScenes, NuScenesConfig};
use data::{
    Clip, ClipConfig, ClipMode, Clips, DataError, FrameOutline, Procedural, ProceduralConfig, SceneDataset, View,
};
use geometry::Rigid;
use geometry::glam::DVec3;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

use super::listed::{Listed, Listing};
use super::nuscenes::made::{CAMERAS, START_US, Tables};
use super::nuscenes::{floats, folder, image_path, json};

fn chain(root: &Path, boxes: BoxMode, require_all_views: bool) -> Arc<NuScenes> {
    let frames = FrameChoice::AllPictures { pairing_window_ms: 25.0, boxes };
    let config =
        NuScenesConfig { frames, require_all_views, ..NuScenesConfig::new(root.join("nuscenes_chain"), "v1.0-mini") };
    Arc::new(NuScenes::open(&config).unwrap())
}

fn config(frames: usize, rate_hz: f64, mode: ClipMode) -> ClipConfig {
    ClipConfig { frames, rate_hz, mode, ..ClipConfig::default() }
}

fn indices(clips: &Clips) -> Vec<Vec<usize>> {
    (0..clips.len()).map(|clip| clips.frame_indices(clip).unwrap().to_vec()).collect()
}

fn steps_ms(clip: &Clip) -> Vec<f64> {
    clip.frames.windows(2).map(|pair| (pair[1].timestamp_ns - pair[0].timestamp_ns) as f64 * 1e-6).collect()
}

#[test]
fn outlines_equal_those_of_the_frames() {
    let worlds =
        ProceduralConfig { scenes: 3, frames_per_scene: 4, yaw_jitter_deg: 5.0, ..ProceduralConfig::default() };
    let mut datasets: Vec<Arc<dyn SceneDataset>> = vec![Arc::new(Procedural::open(&worlds).unwrap())];
    if let Some(root) = folder("RIGSCAPE_DATA", "") {
        datasets
            .extend([BoxMode::Both, BoxMode::Devkit].map(|mode| chain(&root, mode, false) as Arc<dyn SceneDataset>));
        for version in ["v1.0-mini", "interp_12Hz_mini"] {
            let config = NuScenesConfig::new(root.join("nuscenes_chain"), version);
            datasets.push(Arc::new(NuScenes::open(&config).unwrap()));
        }
    }
    for dataset in datasets {
        let mut unannotated = 0;
        for index in 0..dataset.len() {
            let frame = dataset.frame(index).unwrap();
            assert_eq!(dataset.outline(index).unwrap(), FrameOutline::of(&frame));
            let classes: Vec<_> = frame.boxes.iter().flatten().map(|found| found.class).collect();
            assert_eq!(dataset.box_classes(index).unwrap(), classes);
            unannotated += usize::from(frame.boxes.is_none());
        }
        assert!(unannotated < dataset.len());
        assert!(dataset.outline(dataset.len()).is_err() && dataset.box_classes(dataset.len()).is_err());
    }
}

#[test]
fn twelve_hertz_clips_keep_the_true_stamps_and_do_not_cross_scenes_or_gaps() {
    let Some(root) = folder("RIGSCAPE_DATA", "") else { return };
    let clips = Clips::new(chain(&root, BoxMode::Both, false), config(8, 12.0, ClipMode::Native)).unwrap();
    let want: Vec<Vec<usize>> = (0..35).chain(42..48).map(|start| (start..start + 8).collect()).collect();
    assert_eq!(indices(&clips), want, "42 and 13 frames");
    let mut uneven = 0;
    for index in 0..clips.len() {
        let clip = clips.clip(index).unwrap();
        assert_eq!((clip.frames.len(), clip.rate_hz), (8, 12.0));
        assert!(clip.frames.iter().all(|frame| frame.id.scene == clip.frames[0].id.scene));
        assert!(clip.frames.iter().all(|frame| frame.rig() == clip.frames[0].rig()));
        assert!(steps_ms(&clip).iter().all(|step| (48.0..103.0).contains(step)), "{:?}", steps_ms(&clip));
        uneven += usize::from(steps_ms(&clip).iter().any(|step| *step < 60.0));
    }
    assert!(uneven > 30, "exposures follow a faster lidar: {uneven}");
    // Without the three sets that lack a picture there are gaps of 150 to 250 ms, which no clip crosses.
    let whole = chain(&root, BoxMode::Both, true);
    let times: Vec<i64> = (0..whole.len()).map(|index| whole.frame(index).unwrap().timestamp_ns).collect();
    let scenes = whole.scene_ranges();
    let clips = Clips::new(whole, config(8, 12.0, ClipMode::Native)).unwrap();
    let sound = |start: &usize| {
        let scene = scenes.iter().find(|scene| scene.contains(start)).unwrap();
        start + 8 <= scene.end && (*start..start + 7).all(|at| times[at + 1] - times[at] <= 125_000_000)
    };
    let want: Vec<Vec<usize>> = (0..times.len()).filter(sound).map(|start| (start..start + 8).collect()).collect();
    assert!(want.len() < 30 && indices(&clips) == want, "{want:?}");
}

#[test]
fn key_frames_are_two_hertz_and_the_wrong_rate_is_refused() {
    let Some(root) = folder("RIGSCAPE_DATA", "") else { return };
    let open = |frames| {
        let config = NuScenesConfig { frames, ..NuScenesConfig::new(root.join("nuscenes_chain"), "v1.0-mini") };
        Arc::new(NuScenes::open(&config).unwrap())
    };
    let keys = Clips::new(open(FrameChoice::KeyFrames), config(3, 2.0, ClipMode::Native)).unwrap();
    assert_eq!(keys.len(), 6 + 1);
    assert!(Clips::new(open(FrameChoice::KeyFrames), config(3, 12.0, ClipMode::Native)).unwrap().is_empty());
    let error = Clips::new(open(FrameChoice::all_pictures()), config(3, 2.0, ClipMode::Native)).unwrap_err();
    assert!(error.to_string().contains("11.9 Hz") && error.to_string().contains("grid"), "{error}");
    // On a grid of 2 Hz the same sets give clips, and those that begin at a key frame hold key frames.
    let grid = Clips::new(open(FrameChoice::all_pictures()), config(3, 2.0, ClipMode::Grid)).unwrap();
    for index in 0..grid.len() {
        let clip = grid.clip(index).unwrap();
        let off = |(k, secs): (usize, &f64)| (secs - k as f64 * 0.5).abs();
        let worst = clip.elapsed_secs().iter().enumerate().map(off).fold(0.0, f64::max);
        // The last frame of a scene serves all instants of the quarter second around it.
        let is_last = [41, 54].contains(&grid.frame_indices(index).unwrap()[2]);
        assert!(worst < if is_last { 0.25 } else { 0.051 }, "{:?}", clip.elapsed_secs());
    }
    assert_eq!(grid.frame_indices(0).unwrap(), [0, 6, 12]);
}

/// The view of a clip that shows this picture, with its frame's number in the clip.
fn find<'c>(clip: &'c Clip, name: &str) -> Option<(usize, &'c View)> {
    let is_it = |view: &&View| image_path(view.image.as_ref()).is_some_and(|path| path.ends_with(name));
    clip.frames.iter().enumerate().find_map(|(at, frame)| Some((at, frame.views.iter().find(is_it)?)))
}

fn pose(rows: &serde_json::Value) -> Rigid {
    let rows: Vec<[f64; 4]> = rows.as_array().unwrap().iter().map(floats).collect();
    let columns: [f64; 16] = std::array::from_fn(|i| rows[i % 4][i / 4]);
    Rigid::from_mat4(&geometry::glam::DMat4::from_cols_array(&columns))
}

#[test]
fn poses_motion_and_boxes_of_clips_agree_with_the_devkit() {
    let Some(root) = folder("RIGSCAPE_DATA", "") else { return };
    let golden = json(&root.join("golden/nuscenes_chain.json"));
    let pictures = golden["frames"].as_array().unwrap();
    let clips = Clips::new(chain(&root, BoxMode::Devkit, false), config(42, 12.0, ClipMode::Native)).unwrap();
    // One clip holds the whole first scene.
    let clip = clips.clip(0).unwrap();
    let both = Clips::new(chain(&root, BoxMode::Both, false), clips.config().clone()).unwrap().clip(0).unwrap();
    let motion = clip.ego_from_previous_ego();
    let (mut compared, mut moved) = (0, 0);
    for picture in pictures {
        let (at, view) = find(&clip, picture["filename"].as_str().unwrap()).unwrap();
        let frame = &clip.frames[at];
        assert!((view.world_from_ego.translation - pose(&picture["world_from_ego"]).translation).length() < 2e-6);
        // The devkit's boxes stand where they are when this picture is taken, the clip's at the frame's own instant, up to 43 ms off; both
        // lie on one line between samples, so the velocity leads from one to the other.
        let key = picture["is_key_frame"].as_bool().unwrap();
        let lag = (picture["timestamp_us"].as_i64().unwrap() * 1000 - frame.timestamp_ns) as f64 * 1e-9;
        for want in picture["boxes"].as_array().unwrap() {
            let want_center = DVec3::from_array(floats(&want["center_world"]));
            let near = |found: &&data::ObjectBox| {
                let center = frame.world_from_ego.transform_point(found.box3d.center);
                let velocity = found
                    .velocity
                    .map_or(DVec3::ZERO, |v| frame.world_from_ego.transform_vector(DVec3::new(v[0], v[1], 0.0)));
                // A key picture shows the boxes of its sample as annotated, and what only the sample behind has stands still.
                let moves = !key && both.frames[at].boxes.iter().flatten().any(|other| other.track == found.track);
                let shift = if moves { velocity * lag } else { DVec3::ZERO };
                let off = center + shift - want_center;
                found.source_class == want["category"] && off.truncate().length() < 2e-3
            };
            let found = frame.boxes.as_ref().unwrap().iter().find(near);
            let name = &want["annotation_token"];
            assert!(found.is_some(), "no box of the clip is {} {name} of {}", want["category"], picture["filename"]);
            assert_eq!(found.unwrap().interpolated, !key);
            compared += 1;
        }
        // Motion between the instants of two pictures of one camera, and between the reference instants of their frames.
        let next = pictures.iter().find(|next| {
            let after = find(&clip, next["filename"].as_str().unwrap()).unwrap().0;
            after == at + 1 && next["channel"] == picture["channel"]
        });
        if let Some(next) = next {
            let want = pose(&next["world_from_ego"]).inverse() * pose(&picture["world_from_ego"]);
            let difference = motion[at] * want.inverse();
            assert!(difference.translation.length() < 0.01 && difference.angle_to(&Rigid::IDENTITY) < 2e-3);
            // 9 m/s for a tenth of a second, backwards as seen from the later frame.
            assert!((want.translation.x + 0.9).abs() < 0.02, "{:?}", want.translation);
            moved += 1;
        }
    }
    let listed: usize = pictures.iter().map(|picture| picture["boxes"].as_array().unwrap().len()).sum();
    assert!(listed > 200 && compared == listed && moved == 2, "{compared} boxes, {moved} motions");
    let last = motion.iter().fold(Rigid::IDENTITY, |sum, step| *step * sum);
    let want = clip.frames[41].world_from_ego.inverse() * clip.frames[0].world_from_ego;
    assert!((last.translation - want.translation).length() < 1e-9 && last.angle_to(&want) < 1e-9);
}

#[test]
fn clips_of_boxes_leave_out_what_is_not_annotated() {
    let mut tables = Tables::new();
    tables.scene("scene-0001", &[START_US, START_US + 500_000, START_US + 1_000_000]);
    let car = "vehicle.car";
    (0..3).for_each(|sample| tables.annotate("scene-0001", sample, "car", car, [110.0, 52.0, 0.8], 0.1));
    // Sweeps every 100 ms, two before the first sample and one behind the last.
    for tenth in (-2..12).filter(|tenth| ![0, 5, 10].contains(tenth)) {
        let sample = if tenth < 0 { 0 } else { (tenth as usize).div_ceil(5).min(2) };
        for (channel, _, offset_us) in CAMERAS {
            tables.picture("scene-0001", channel, sample, START_US + tenth * 100_000 + offset_us, false);
        }
    }
    let target = tempfile::tempdir().unwrap();
    let config_with = |boxes| NuScenesConfig {
        frames: FrameChoice::AllPictures { pairing_window_ms: 25.0, boxes },
        ..tables.write(target.path())
    };
    for (mode, want) in [(BoxMode::Both, 2..13), (BoxMode::Devkit, 0..13)] {
        let dataset = Arc::new(NuScenes::open(&config_with(mode)).unwrap());
        assert_eq!(dataset.len(), 14);
        for index in 0..14 {
            let frame = dataset.frame(index).unwrap();
            assert_eq!(dataset.outline(index).unwrap(), FrameOutline::of(&frame));
            assert_eq!(frame.boxes.is_some(), want.contains(&index), "{mode:?} {index}");
        }
        let clips = |require_boxes| {
            let settings = ClipConfig { require_boxes, ..config(5, 10.0, ClipMode::Native) };
            Clips::new(dataset.clone(), settings).unwrap()
        };
        assert_eq!(clips(false).len(), 10);
        let starts: Vec<usize> = indices(&clips(true)).iter().map(|clip| clip[0]).collect();
        assert!(starts.iter().copied().eq(want.start..want.end - 4), "{starts:?}");
    }
}

#[test]
fn clips_of_the_procedural_world_move_as_its_car_does() {
    let worlds = ProceduralConfig { scenes: 4, frames_per_scene: 10, ..ProceduralConfig::default() };
    let rate_hz = 10.0 / worlds.world.duration_secs;
    let dataset = Arc::new(Procedural::open(&worlds).unwrap());
    let settings = ClipConfig { stride: 4, ..config(4, rate_hz, ClipMode::Native) };
    let clips = Clips::new(dataset.clone(), settings.clone()).unwrap();
    let want: Vec<Vec<usize>> =
        (0..4).flat_map(|scene| [0, 4].map(|start| (scene * 10 + start..scene * 10 + start + 4).collect())).collect();
    assert_eq!(indices(&clips), want);
    assert_eq!(indices(&Clips::new(dataset.clone(), ClipConfig { mode: ClipMode::Grid, ..settings }).unwrap()), want);
    for index in 0..clips.len() {
        let clip = clips.clip(index).unwrap();
        let motion = clip.ego_from_previous_ego();
        assert_eq!((motion.len(), clip.elapsed_secs().len()), (3, 4));
        for (k, motion) in motion.iter().enumerate() {
            let (scene, secs) = dataset.instant(clips.frame_indices(index).unwrap()[k]);
            let world = dataset.world(scene);
            let fixed = DVec3::new(12.0, -3.0, 0.5);
            let before = world.world_from_ego(secs).inverse() * fixed;
            let after = world.world_from_ego(secs + 1.0 / rate_hz).inverse() * fixed;
            assert!((motion.transform_point(before) - after).length() < 1e-6);
        }
    }
    // Every frame has a rig of its own: no two make a clip.
    let jitter = Procedural::open(&ProceduralConfig { yaw_jitter_deg: 3.0, ..worlds }).unwrap();
    assert!(Clips::new(Arc::new(jitter), config(2, rate_hz, ClipMode::Native)).unwrap().is_empty());
}

/// Scenes of random steps, now and then a hole, another rig or a frame without boxes.
fn random_scenes(rng: &mut ChaCha8Rng) -> Vec<Vec<Listing>> {
    let scene = |rng: &mut ChaCha8Rng| {
        let (mut time_ms, mut focal) = (rng.random_range(-5000..5000), 100.0);
        let len = rng.random_range(0..30);
        let listing = |_| {
            time_ms +=
                if rng.random_bool(0.1) { rng.random_range(150..900) } else { [50, 100][rng.random_range(0..2)] };
            focal += f64::from(u8::from(rng.random_bool(0.04)));
            let classes = rng.random_bool(0.9).then(Vec::new);
            Listing { focal, classes, ..Listing::at(time_ms) }
        };
        (0..len).map(listing).collect::<Vec<Listing>>()
    };
    (0..rng.random_range(1..5)).map(|_| scene(rng)).collect()
}

/// Of the steps that are no gaps at 12 Hz.
fn mean_step_ms(scenes: &[Vec<Listing>]) -> f64 {
    let steps = scenes.iter().flat_map(|scene| scene.windows(2)).map(|pair| pair[1].time_ms - pair[0].time_ms);
    let steps: Vec<i64> = steps.filter(|step| *step <= 125).collect();
    steps.iter().sum::<i64>() as f64 / steps.len() as f64
}

/// The definition, tried on every sequence of frames that could be one.
fn is_clip(scene: &[Listing], frames: &[usize], config: &ClipConfig) -> bool {
    let time = |at: usize| scene[at].time_ms as f64;
    let step = 1000.0 / config.rate_hz;
    let limit = config.max_gap_ms.unwrap_or(if config.mode == ClipMode::Native { 1.5 * step } else { 2.0 * step });
    let (first, last) = (frames[0], frames[frames.len() - 1]);
    let nearest = |k: usize| {
        let want = time(first) + k as f64 * step;
        let off = (time(frames[k]) - want).abs();
        // A hundred-thousandth of a millisecond: instants are rounded to nanoseconds.
        off <= 0.5 * step + 1e-5 && (0..scene.len()).all(|other| (time(other) - want).abs() >= off - 1e-5)
    };
    let fits = match config.mode {
        ClipMode::Native => frames.windows(2).all(|pair| pair[1] == pair[0] + 1),
        ClipMode::Grid => frames.windows(2).all(|pair| pair[1] > pair[0]) && (0..frames.len()).all(nearest),
    };
    fits && scene[first..=last].iter().all(|listing| listing.focal == scene[first].focal)
        && frames.windows(2).all(|pair| time(pair[1]) - time(pair[0]) <= limit)
        && (!config.require_boxes || frames.iter().all(|at| scene[*at].classes.is_some()))
}

#[test]
fn clips_of_random_scenes_are_exactly_those_of_the_definition() {
    let mut rng = ChaCha8Rng::seed_from_u64(2);
    let mut found = [0; 2];
    for round in 0..400 {
        let scenes = random_scenes(&mut rng);
        let native = round % 2 == 0;
        let settings = ClipConfig {
            frames: rng.random_range(1..6),
            rate_hz: if native { 12.0 } else { [2.0, 4.0, 7.0, 12.0, 30.0][rng.random_range(0..5)] },
            mode: if native { ClipMode::Native } else { ClipMode::Grid },
            stride: rng.random_range(1..5),
            max_gap_ms: rng.random_bool(0.3).then(|| f64::from(rng.random_range(40..400))),
            require_boxes: rng.random_bool(0.5),
        };
        let dataset = Arc::new(Listed::new(scenes.clone()));
        let clips = match Clips::new(dataset.clone(), settings.clone()) {
            Ok(clips) => clips,
            Err(error) => {
                // Only where most steps are of the shorter kind.
                assert!(native && mean_step_ms(&scenes) * 1.5 < 1000.0 / 12.0, "{error}");
                continue;
            }
        };
        assert_eq!(dataset.made.load(Ordering::Relaxed), 0, "indexing makes no frames");
        assert_eq!(indices(&clips), indices(&Clips::new(dataset.clone(), settings.clone()).unwrap()));
        let (mut left, clip_list) = (0, indices(&clips));
        for (range, scene) in dataset.scene_ranges().into_iter().zip(&scenes) {
            let mut next = 0;
            while next < scene.len() {
                let here = clip_list.get(left).filter(|clip| clip[0] == range.start + next);
                match here {
                    Some(clip) => {
                        assert!(clip.iter().all(|frame| range.contains(frame)), "{clip:?} leaves its scene");
                        let local: Vec<usize> = clip.iter().map(|frame| frame - range.start).collect();
                        assert!(is_clip(scene, &local, &settings), "{local:?} is no clip of {settings:?}");
                        left += 1;
                        next += settings.stride;
                        found[usize::from(native)] += 1;
                    }
                    None => {
                        if native && next + settings.frames <= scene.len() {
                            let run: Vec<usize> = (next..next + settings.frames).collect();
                            assert!(!is_clip(scene, &run, &settings), "a clip at {next} is missing");
                        }
                        if !native {
                            assert!(!grid_exists(scene, next, &settings), "a clip at {next} is missing");
                        }
                        next += 1;
                    }
                }
            }
        }
        assert_eq!(left, clip_list.len(), "clips in order and no others");
        if !clips.is_empty() {
            clips.clip(clips.len() - 1).unwrap();
        }
        assert!(matches!(clips.clip(clips.len()), Err(DataError::Config(_))));
    }
    assert!(found.iter().all(|count| *count > 500), "{found:?}");
}

/// Whether some choice of frames from `start` on is a clip; the grid's instants leave at most two frames to choose from.
fn grid_exists(scene: &[Listing], start: usize, config: &ClipConfig) -> bool {
    let step = 1000.0 / config.rate_hz;
    let mut frames = vec![start];
    for k in 1..config.frames {
        let want = scene[start].time_ms as f64 + k as f64 * step;
        let off = |at: &usize| (scene[*at].time_ms as f64 - want).abs();
        let nearest = (0..scene.len()).min_by(|a, b| off(a).total_cmp(&off(b))).unwrap();
        // Closer to the limit than a microsecond, rounding decides.
        if off(&nearest) > 0.5 * step - 1e-3 {
            return false;
        }
        frames.push(nearest);
    }
    is_clip(scene, &frames, config)
}

#[test]
fn settings_without_a_meaning_and_times_that_stand_still_are_refused() {
    let dataset = Arc::new(Listed::new(vec![(0..9).map(|i| Listing::at(i * 100)).collect()]));
    let sound = config(3, 10.0, ClipMode::Native);
    assert_eq!(Clips::new(dataset.clone(), sound.clone()).unwrap().len(), 7);
    for refused in [
        ClipConfig { frames: 0, ..sound.clone() },
        ClipConfig { stride: 0, ..sound.clone() },
        ClipConfig { rate_hz: 0.0, ..sound.clone() },
        ClipConfig { rate_hz: f64::NAN, ..sound.clone() },
        ClipConfig { max_gap_ms: Some(-1.0), ..sound.clone() },
        ClipConfig { rate_hz: 5.0, max_gap_ms: Some(400.0), ..sound.clone() },
    ] {
        assert!(matches!(Clips::new(dataset.clone(), refused.clone()), Err(DataError::Config(_))), "{refused:?}");
    }
    let still = Arc::new(Listed::new(vec![vec![Listing::at(0), Listing::at(100), Listing::at(100)]]));
    let error = Clips::new(still, sound).unwrap_err();
    assert!(error.to_string().contains("frame 2 of listed"), "{error}");
    let text = "frames = 6\nrate_hz = 2.0\nmode = \"grid\"\n";
    let parsed: ClipConfig = toml::from_str(text).unwrap();
    assert_eq!(parsed, config(6, 2.0, ClipMode::Grid));
    assert!(toml::from_str::<ClipConfig>("frame = 6").is_err());
}
