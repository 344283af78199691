//! Broken scenes, which are written ones with a fault: every error names its file.

use std::path::{Path, PathBuf};
use std::sync::LazyLock;

use data::wayvescenes::{WayveScenes, WayveScenesConfig};
use data::{DataError, ImageSource, SceneDataset, SceneFrame, colmap, store::Store};
use geometry::RigPreset;
use tempfile::TempDir;

use super::made::{FRAMES, frames as made_frames, write};
use super::{CHANNELS, open};

static MADE: LazyLock<Vec<SceneFrame>> = LazyLock::new(|| made_frames(RigPreset::WayveScenes101)[..FRAMES].to_vec());

/// A written scene with a fault.
fn broken(fault: impl FnOnce(&Path)) -> (TempDir, WayveScenesConfig) {
    let dir = tempfile::tempdir().unwrap();
    write(&dir.path().join("set"), &MADE, |_| {});
    let scene = dir.path().join("set").join(&MADE[0].id.scene);
    fault(&scene);
    let config = WayveScenesConfig::new(dir.path().join("set"));
    (dir, config)
}

/// Rewrites the model of a scene.
fn with_model(scene: &Path, change: impl FnOnce(&mut colmap::Model)) {
    let store = Store::open(scene).unwrap();
    let mut model = colmap::Model::read(&store, "colmap_sparse/rig", colmap::Detail::Whole).unwrap();
    change(&mut model);
    model.write(&scene.join("colmap_sparse/rig")).unwrap();
}

fn refusal(fault: impl FnOnce(&Path)) -> DataError {
    let (_dir, config) = broken(fault);
    WayveScenes::open(&config).expect_err("a broken scene opens")
}

type Fault = Box<dyn Fn(&Path)>;

#[test]
fn broken_scenes_name_their_file() {
    let name_of = |image: &colmap::Image| image.name.clone();
    let faults: [(&str, &str, Fault); 9] = [
        ("images.bin", "missing", Box::new(|s| std::fs::remove_file(s.join("colmap_sparse/rig/images.bin")).unwrap())),
        (
            "points3D.bin",
            "missing",
            Box::new(|s| std::fs::remove_file(s.join("colmap_sparse/rig/points3D.bin")).unwrap()),
        ),
        (
            "images.bin",
            "disagree about the metric scale",
            Box::new(|s| {
                with_model(s, |m| {
                    m.images.iter_mut().filter(|i| i.camera_id == 2).for_each(|i| i.translation[0] += 0.4)
                });
            }),
        ),
        (
            "images.bin",
            "front-forward",
            Box::new(|s| {
                with_model(s, |m| {
                    m.points.clear();
                    m.images.iter_mut().for_each(|image| image.points.clear());
                    m.images.retain(|image| !image.name.starts_with("front-forward"));
                })
            }),
        ),
        (
            "images.bin",
            "which is 0.1 s in no unit",
            Box::new(|s| {
                with_model(s, |m| {
                    for image in &mut m.images {
                        let (channel, stamp) = image.name.trim_end_matches(".jpeg").split_once('/').unwrap();
                        image.name = format!("{channel}/{}.jpeg", stamp.parse::<i64>().unwrap() * 2);
                    }
                })
            }),
        ),
        (
            "images.bin",
            "belongs to one of front-forward",
            Box::new(|s| {
                with_model(s, |m| {
                    for image in m.images.iter_mut().filter(|image| image.name.starts_with("left-backward")) {
                        let stamp: i64 = image.name.trim_end_matches(".jpeg")[14..].parse().unwrap();
                        image.name = format!("left-backward/{}.jpeg", stamp + 45_000_000);
                    }
                })
            }),
        ),
        (
            "images.bin",
            "is not <camera>/<integer>.jpeg",
            Box::new(move |s| {
                with_model(s, |m| {
                    m.images[3].name = format!("x-{}", name_of(&m.images[3]).replace('/', "-"));
                })
            }),
        ),
        (
            "cameras.bin",
            "focal length",
            Box::new(|s| {
                with_model(s, |m| {
                    m.cameras[0].model = colmap::CameraModel::Pinhole([-1.0, 1.0, 0.0, 0.0]);
                })
            }),
        ),
        ("images.bin", "camera_id", Box::new(|s| with_model(s, |m| m.images[7].camera_id = 77))),
    ];
    for (file, word, fault) in faults {
        let text = refusal(fault).to_string();
        assert!(text.contains(word) && text.ends_with(file), "{text:?} should say {word:?} and end with {file}");
    }
}

#[test]
fn broken_metadata_and_pictures_name_their_file() {
    let table = |name: &'static str, text: &'static str| {
        refusal(move |scene| std::fs::write(scene.parent().unwrap().join(name), text).unwrap())
    };
    let error = table("baselines.json", "{\"us\": 3}");
    assert!(matches!(&error, DataError::Json { .. }) && error.to_string().ends_with("baselines.json"), "{error:?}");
    let error = table("baselines.json", "{\"us\": {\"dist_ff_to_rf_m\": -1.0}}");
    assert!(matches!(&error, DataError::Json { .. }), "{error:?}");
    let error = table("scene_metadata.csv", "scene,Weather\na,b\n");
    assert!(matches!(&error, DataError::Column { .. }) && error.to_string().ends_with(".csv"), "{error:?}");
    let picture = |frame: &SceneFrame| frame.views[2].image.as_ref().unwrap().decode().unwrap_err();
    let jpeg = |scene: &Path| {
        let folder = scene.join("images").join(CHANNELS[2]);
        let mut names: Vec<PathBuf> = std::fs::read_dir(folder).unwrap().map(|entry| entry.unwrap().path()).collect();
        names.sort();
        names.remove(0)
    };
    let (_dir, config) = broken(|scene| std::fs::remove_file(jpeg(scene)).unwrap());
    let error = picture(&open(&config).frame(0).unwrap());
    assert!(matches!(error, DataError::Missing { .. }) && error.to_string().ends_with(".jpeg"), "{error}");
    let (_dir, config) = broken(|scene| {
        let bytes = std::fs::read(jpeg(scene)).unwrap();
        std::fs::write(jpeg(scene), &bytes[..bytes.len() / 2]).unwrap();
    });
    assert!(matches!(picture(&open(&config).frame(0).unwrap()), DataError::Image { .. }));
    // A camera with a folder of masks must have one for every picture, of the picture's size.
    let (_dir, config) = broken(|scene| std::fs::create_dir_all(scene.join("masks").join(CHANNELS[2])).unwrap());
    let frame = open(&config).frame(0).unwrap();
    assert!(frame.views[0].mask.is_none());
    let mask = frame.views[2].mask.clone().unwrap();
    assert!(matches!(mask.decode(), Err(DataError::Missing { .. })));
    let ImageSource::File { file, .. } = &mask else { panic!("no file") };
    image::GrayImage::new(3, 2).save(file.path()).unwrap();
    assert!(matches!(mask.decode(), Err(DataError::ImageSize { got: (3, 2), .. })));
}

#[test]
fn a_scene_without_ground_assumes_the_height() {
    let (_dir, config) = broken(|scene| {
        with_model(scene, |model| {
            model.points.clear();
            model.images.iter_mut().for_each(|image| image.points.clear());
        });
    });
    let info = &open(&config).scenes()[0];
    assert_eq!((info.camera_height_m, info.ground_points), (1.5, None));
}
