//! The nuScenes writer: identical bytes, no debris, and our reader sees the world that was written.

mod maps;

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::LazyLock;

use data::nuscenes::{BoxMode, FrameChoice, NuScenes, NuScenesConfig};
use data::{DataError, Manifest, NuScenesWriterConfig, ObjectBox, SceneDataset, SceneFrame, write_nuscenes};
use geometry::{RigPreset, Rigid};
use glam::DVec3;
use tempfile::TempDir;
use world::{ActorState, RenderOptions, World};

const SIZE: (u32, u32) = (96, 54);
const KEY_FRAMES: usize = 3;
/// Key frames, five sweeps after each but the last.
const PICTURES_PER_CAMERA: usize = KEY_FRAMES + 5 * (KEY_FRAMES - 1);

fn config(out: PathBuf) -> NuScenesWriterConfig {
    NuScenesWriterConfig {
        scenes: 2,
        seed: 7,
        key_frames_per_scene: KEY_FRAMES,
        sweeps: true,
        image_size: Some(SIZE),
        lidar_columns: 90,
        ..NuScenesWriterConfig::new(out, RigPreset::NuScenes.rig())
    }
}

fn quiet() -> impl FnMut(usize, usize) {
    |_, _| {}
}

/// Written once for all tests that only read.
static DATASET: LazyLock<(TempDir, Manifest)> = LazyLock::new(|| {
    let dir = tempfile::tempdir().unwrap();
    let manifest = write_nuscenes(&config(dir.path().join("set")), &mut quiet()).unwrap();
    (dir, manifest)
});

fn root() -> PathBuf {
    DATASET.0.path().join("set")
}

/// A written scene's world and the way from its clock and place to those of the tables.
struct Truth {
    world: World,
    map_from_world: Rigid,
    start_us: i64,
}

impl Truth {
    fn of(scene: &str) -> Self {
        let manifest = &DATASET.1;
        let row = manifest.scenes.iter().find(|row| row.name == scene).unwrap();
        let config = world::WorldConfig { duration_secs: row.world_duration_secs, ..manifest.config.world.clone() };
        let [x, y] = row.map_from_world;
        Self {
            world: World::generate(row.world_seed, &config),
            map_from_world: Rigid::from_yaw(0.0, DVec3::new(x, y, 0.0)),
            start_us: row.start_us,
        }
    }

    fn secs(&self, timestamp_ns: i64) -> f64 {
        (timestamp_ns / 1000 - self.start_us) as f64 * 1e-6
    }

    fn map_from_ego(&self, timestamp_ns: i64) -> Rigid {
        self.map_from_world * self.world.world_from_ego(self.secs(timestamp_ns))
    }
}

fn open(frames: FrameChoice) -> NuScenes {
    NuScenes::open(&NuScenesConfig { frames, ..NuScenesConfig::new(root(), "v1.0-mini") }).unwrap()
}

fn frames(dataset: &NuScenes) -> Vec<SceneFrame> {
    (0..dataset.len()).map(|i| dataset.frame(i).unwrap()).collect()
}

fn files(folder: &Path) -> BTreeMap<PathBuf, Vec<u8>> {
    let mut found = BTreeMap::new();
    let mut open = vec![folder.to_owned()];
    while let Some(next) = open.pop() {
        for entry in std::fs::read_dir(next).unwrap() {
            let path = entry.unwrap().path();
            if path.is_dir() {
                open.push(path);
            } else {
                found.insert(path.strip_prefix(folder).unwrap().to_owned(), std::fs::read(&path).unwrap());
            }
        }
    }
    found
}

fn assert_close(a: &Rigid, b: &Rigid, tolerance: f64) {
    assert!(a.translation.distance(b.translation) < tolerance, "{a:?} against {b:?}");
    assert!(1.0 - a.rotation.dot(b.rotation).abs() < tolerance, "{a:?} against {b:?}");
}

#[test]
fn two_runs_give_identical_bytes() {
    let dir = tempfile::tempdir().unwrap();
    let mut calls = vec![];
    let pool = rayon_of_one();
    let again = config(dir.path().join("elsewhere"));
    let manifest = pool.install(|| write_nuscenes(&again, &mut |done, total| calls.push((done, total)))).unwrap();
    assert_eq!(manifest, Manifest { config: again, ..DATASET.1.clone() });
    let (first, second) = (files(&root()), files(&dir.path().join("elsewhere")));
    assert_eq!(first.keys().collect::<Vec<_>>(), second.keys().collect::<Vec<_>>());
    for (path, bytes) in &first {
        assert!(bytes == &second[path], "{} differs", path.display());
    }
    let files_per_scene = 6 * PICTURES_PER_CAMERA + KEY_FRAMES;
    assert_eq!(calls.last(), Some(&(2 * files_per_scene, 2 * files_per_scene)));
    assert!(calls.windows(2).all(|pair| pair[0].0 < pair[1].0));
    assert_eq!(manifest.picture_count, 2 * 6 * PICTURES_PER_CAMERA);
    // Another seed gives other worlds and other tokens.
    let other =
        NuScenesWriterConfig { seed: 8, scenes: 1, key_frames_per_scene: 1, ..config(dir.path().join("other")) };
    write_nuscenes(&other, &mut quiet()).unwrap();
    let other = files(&dir.path().join("other"));
    assert_ne!(first[Path::new("v1.0-mini/sensor.json")], other[Path::new("v1.0-mini/sensor.json")]);
}

fn rayon_of_one() -> rayon::ThreadPool {
    rayon::ThreadPoolBuilder::new().num_threads(1).build().unwrap()
}

#[test]
fn an_existing_folder_is_kept_unless_forced() {
    let dir = tempfile::tempdir().unwrap();
    let small =
        NuScenesWriterConfig { scenes: 1, key_frames_per_scene: 1, sweeps: false, ..config(dir.path().join("set")) };
    write_nuscenes(&small, &mut quiet()).unwrap();
    let before = files(&small.out);
    let error = write_nuscenes(&small, &mut quiet()).unwrap_err();
    assert!(matches!(error, DataError::Config(_)), "{error}");
    assert!(error.to_string().ends_with("set"), "{error}");
    assert_eq!(files(&small.out), before);
    let forced = NuScenesWriterConfig { force: true, seed: 9, ..small.clone() };
    write_nuscenes(&forced, &mut quiet()).unwrap();
    assert_ne!(files(&small.out), before);
    assert_eq!(std::fs::read_dir(dir.path()).unwrap().count(), 1, "debris beside the output");
}

#[test]
fn a_failed_run_leaves_nothing() {
    let dir = tempfile::tempdir().unwrap();
    let mut broken = config(dir.path().join("set"));
    // No file system takes such a name, and only writing finds out.
    broken.rig.cameras[5].channel = "C".repeat(300);
    let error = write_nuscenes(&broken, &mut quiet()).unwrap_err();
    assert!(matches!(error, DataError::Io { .. }), "{error}");
    assert_eq!(std::fs::read_dir(dir.path()).unwrap().count(), 0);
}

#[test]
fn the_layout_cannot_hold_lenses() {
    let dir = tempfile::tempdir().unwrap();
    let config = NuScenesWriterConfig { rig: RigPreset::NuPlan.rig(), ..config(dir.path().join("set")) };
    let error = write_nuscenes(&config, &mut quiet()).unwrap_err();
    assert!(error.to_string().contains("pinhole"), "{error}");
}

#[test]
fn official_split_names_select_the_scenes() {
    for (split, scene) in [("mini_train", "scene-0061"), ("mini_val", "scene-0103")] {
        let config = NuScenesConfig { split: split.to_owned(), ..NuScenesConfig::new(root(), "v1.0-mini") };
        let dataset = NuScenes::open(&config).unwrap();
        assert_eq!(dataset.len(), KEY_FRAMES);
        assert_eq!(dataset.frame(0).unwrap().id.scene, scene);
    }
}

#[test]
fn reading_back_gives_the_poses_and_calibration_of_the_world() {
    let dataset = open(FrameChoice::all_pictures());
    assert_eq!(dataset.len(), 2 * PICTURES_PER_CAMERA);
    let rig = DATASET.1.config.rig.clone();
    for scene in &DATASET.1.scenes {
        let truth = Truth::of(&scene.name);
        let frames: Vec<SceneFrame> = frames(&dataset).into_iter().filter(|f| f.id.scene == scene.name).collect();
        assert_eq!(frames.len(), PICTURES_PER_CAMERA);
        for frame in &frames {
            assert_eq!(frame.scene_text, Some(truth.world.caption()));
            assert_eq!(frame.views.len(), rig.len());
            for (view, camera) in frame.views.iter().zip(&rig.cameras) {
                assert_eq!(view.channel, camera.channel);
                assert!(view.image.is_some());
                assert_close(&view.world_from_ego, &truth.map_from_ego(view.timestamp_ns), 1e-9);
                assert_close(&view.ego_from_cam, &camera.ego_from_cam, 1e-9);
                let (sx, sy) = (f64::from(SIZE.0) / 1600.0, f64::from(SIZE.1) / 900.0);
                let (got, raw) = (view.intrinsics, camera.intrinsics);
                for (got, want) in
                    [(got.fx, raw.fx * sx), (got.fy, raw.fy * sy), (got.cx, raw.cx * sx), (got.cy, raw.cy * sy)]
                {
                    assert!((got - want).abs() < 1e-9, "{got} against {want}");
                }
                assert_eq!((got.width, got.height), SIZE);
            }
        }
    }
    for frame in frames(&open(FrameChoice::KeyFrames)) {
        let truth = Truth::of(&frame.id.scene);
        assert_close(&frame.world_from_ego, &truth.map_from_ego(frame.timestamp_ns), 1e-9);
        // The car moves and the cameras look one after another.
        assert!(frame.views.iter().all(|view| (frame.timestamp_ns - view.timestamp_ns).abs() < 51_000_000));
        let late = frame.views.iter().filter(|view| frame.timestamp_ns - view.timestamp_ns > 20_000_000);
        assert!(late.count() >= 3);
    }
}

/// The actor that an annotation describes.
fn actor_of<'a>(annotated: &ObjectBox, actors: &'a [ActorState], ego_from_world: &Rigid) -> &'a ActorState {
    let distance = |actor: &ActorState| (*ego_from_world * actor.world_box.center).distance(annotated.box3d.center);
    let nearest = actors.iter().min_by(|a, b| distance(a).total_cmp(&distance(b))).unwrap();
    assert!(distance(nearest) < 1e-6, "no actor at {annotated:?}");
    nearest
}

#[test]
fn reading_back_gives_the_boxes_of_the_world() {
    let (mut boxes, mut with_velocity, mut levels, mut points) = (0, 0, BTreeMap::<u8, usize>::new(), 0);
    for frame in frames(&open(FrameChoice::KeyFrames)) {
        let truth = Truth::of(&frame.id.scene);
        let secs = truth.secs(frame.timestamp_ns);
        let actors = truth.world.actors_at(secs);
        let world_from_ego = truth.world.world_from_ego(secs);
        let ego_from_world = world_from_ego.inverse();
        let annotated = frame.boxes.unwrap();
        assert!(annotated.len() <= actors.len());
        for object in &annotated {
            let actor = actor_of(object, &actors, &ego_from_world);
            let want = actor.world_box.transformed(&ego_from_world);
            assert!(object.box3d.size.distance(want.size) < 1e-6);
            let turn = geometry::wrap_angle(object.box3d.yaw - want.yaw).abs();
            assert!(turn < 1e-6, "yaw {} against {}", object.box3d.yaw, want.yaw);
            assert_eq!(object.class.index(), actor.class.index());
            if let Some([x, y]) = object.velocity {
                with_velocity += 1;
                // Differences over half a second follow braking and turning only roughly.
                let got = world_from_ego.transform_vector(DVec3::new(x, y, 0.0)).truncate();
                assert!(got.distance(actor.velocity) < 1.5, "{got} against {}", actor.velocity);
                assert!(!actor.parked || got.length() < 1e-6);
            }
            boxes += 1;
            *levels.entry(object.visibility.unwrap()).or_default() += 1;
            points += object.points.unwrap();
        }
    }
    assert!(boxes >= 20, "{boxes} boxes");
    assert!(with_velocity * 10 >= boxes * 8, "{with_velocity} of {boxes} boxes have velocities");
    assert!(levels.len() > 1 && levels.keys().all(|level| (1..=4).contains(level)), "{levels:?}");
    assert!(points > 0);
}

#[test]
fn pictures_show_the_world_at_their_own_instant() {
    let dataset = open(FrameChoice::all_pictures());
    for index in [0, 4, dataset.len() - 1] {
        let frame = dataset.frame(index).unwrap();
        let truth = Truth::of(&frame.id.scene);
        for view in &frame.views {
            let secs = truth.secs(view.timestamp_ns);
            let world_from_cam = truth.world.world_from_ego(secs) * view.ego_from_cam;
            let rendering =
                truth.world.snapshot(secs).render(&view.camera().unwrap(), &world_from_cam, &RenderOptions::default());
            let picture = view.image.as_ref().unwrap().decode().unwrap();
            assert_eq!(picture.dimensions(), SIZE);
            let difference = |(a, b): (&u8, &u8)| f64::from(a.abs_diff(*b));
            let sum: f64 = picture.as_raw().iter().zip(&rendering.rgb).map(difference).sum();
            let mean = sum / rendering.rgb.len() as f64;
            // JPEG at quality 95 on noisy textures; a picture of another instant or camera is off by more than ten.
            assert!(mean < 5.0, "{} differs by {mean} on average", view.channel);
        }
    }
}

#[test]
fn centres_of_visible_boxes_lie_on_their_actors_pixels() {
    let dataset = open(FrameChoice::KeyFrames);
    let (mut asked, mut hit) = (0, 0);
    for index in 0..dataset.len() {
        let frame = dataset.frame(index).unwrap();
        let truth = Truth::of(&frame.id.scene);
        let secs = truth.secs(frame.timestamp_ns);
        let ego_from_world = truth.world.world_from_ego(secs).inverse();
        let actors = truth.world.actors_at(secs);
        for view in &frame.views {
            let camera = view.camera().unwrap();
            let world_from_cam = truth.map_from_world.inverse() * view.world_from_ego * view.ego_from_cam;
            let rendering = truth.world.snapshot(truth.secs(view.timestamp_ns)).render(
                &camera,
                &world_from_cam,
                &RenderOptions { samples_per_pixel: 1 },
            );
            let cam_from_ego = view.ref_ego_from_cam(&frame.world_from_ego).inverse();
            for object in frame.boxes.as_ref().unwrap().iter().filter(|object| object.visibility == Some(4)) {
                let point = cam_from_ego * object.box3d.center;
                let Some(pixel) = camera.project(point).filter(|pixel| camera.intrinsics.contains(*pixel)) else {
                    continue;
                };
                let id = actor_of(object, &actors, &ego_from_world).id;
                // A moving actor and the picture differ by up to 50 ms: a pixel around counts too.
                let near = |step: i64, at: f64, size: u32| (at as i64 + step).clamp(0, i64::from(size) - 1) as usize;
                let shows = (-1..=1).flat_map(|dy| (-1..=1).map(move |dx| (dx, dy))).any(|(dx, dy)| {
                    let (column, row) = (near(dx, pixel.x, SIZE.0), near(dy, pixel.y, SIZE.1));
                    rendering.instance[row * SIZE.0 as usize + column] == id + 1
                });
                asked += 1;
                hit += usize::from(shows);
            }
        }
    }
    assert!(asked >= 10, "only {asked} boxes to ask");
    assert!(hit * 10 >= asked * 9, "{hit} of {asked} centres lie on their actors");
}

#[test]
fn boxes_between_key_frames_follow_the_world() {
    let dataset = open(FrameChoice::AllPictures { pairing_window_ms: 25.0, boxes: BoxMode::Both });
    let mut compared = 0;
    for frame in frames(&dataset) {
        let truth = Truth::of(&frame.id.scene);
        let secs = truth.secs(frame.timestamp_ns);
        let ego_from_world = truth.world.world_from_ego(secs).inverse();
        let actors = truth.world.actors_at(secs);
        for object in frame.boxes.iter().flatten().filter(|object| object.interpolated) {
            let distance = |actor: &ActorState| (ego_from_world * actor.world_box.center).distance(object.box3d.center);
            let nearest = actors.iter().map(distance).fold(f64::INFINITY, f64::min);
            // Half a second of braking at 4 m/s2 bends a track by 0.125 m; the reference pose is interpolated too.
            assert!(nearest < 0.4, "{object:?} is {nearest} m from every actor");
            compared += 1;
        }
    }
    assert!(compared > 20, "{compared}");
}
