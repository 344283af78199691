//! Datasets in several pieces, folders and archives mixed: every reader finds the frames of the whole folder.

use std::path::Path;

use data::argoverse2::{Argoverse2, Argoverse2Config};
use data::nuplan::{NuPlan, NuPlanConfig};
use data::store::Roots;
use data::waymo::{Waymo, WaymoConfig, WaymoRelease};
use data::wayvescenes::{WayveScenes, WayveScenesConfig};
use data::{ImageSource, SceneDataset};

use super::super::nuscenes::folder;
use super::{borrowed, files_below, roots, stored, tar_bytes, write, zip_bytes};

/// The files that `is_first` names in a folder, the others in an archive of both kinds, one after the other.
fn pieces(whole: &Path, is_first: impl Fn(&str) -> bool, check: impl Fn(Roots)) {
    let target = tempfile::tempdir().unwrap();
    let (first, second): (Vec<_>, Vec<_>) = files_below(whole).into_iter().partition(|file| is_first(&file.0));
    assert!(!first.is_empty() && !second.is_empty());
    let folder = target.path().join("folder");
    for (name, bytes) in &first {
        let path = folder.join(name);
        std::fs::create_dir_all(path.parent().unwrap()).unwrap();
        std::fs::write(path, bytes).unwrap();
    }
    for (name, bytes) in [("b.tar", tar_bytes(&borrowed(&second))), ("b.zip", zip_bytes(&borrowed(&second), stored()))]
    {
        let archive = write(target.path(), name, &bytes);
        check(roots([folder.clone(), archive.clone()]));
        check(roots([archive, folder.clone()]));
    }
}

/// Everything but the pictures' places is equal, and so are the pictures.
fn same(a: &dyn SceneDataset, b: &dyn SceneDataset) {
    assert!(!a.is_empty());
    assert_eq!((a.len(), a.scene_ranges(), a.capabilities()), (b.len(), b.scene_ranges(), b.capabilities()));
    for index in 0..a.len() {
        let (a, b) = (a.frame(index).unwrap(), b.frame(index).unwrap());
        assert_eq!((&a.id, &a.boxes, &a.scene_text, a.rig()), (&b.id, &b.boxes, &b.scene_text, b.rig()));
        let decoded = |view: &data::View| view.image.as_ref().map(ImageSource::decode).transpose().unwrap();
        assert!(a.views.iter().zip(&b.views).all(|(a, b)| decoded(a) == decoded(b)));
    }
}

#[test]
fn argoverse_tables_and_pictures() {
    let Some(root) = folder("RIGSCAPE_DATA", "argoverse2") else { return };
    let open = |roots: Roots| Argoverse2::open(&Argoverse2Config::new(roots)).unwrap();
    let whole = open(root.as_path().into());
    pieces(&root, |name| !name.contains("/cameras/ring_s"), |roots| same(&whole, &open(roots)));
}

#[test]
fn nuplan_databases_and_blobs() {
    let Some(root) = folder("RIGSCAPE_DATA", "nuplan") else { return };
    let open = |roots: Roots| NuPlan::open(&NuPlanConfig::new(roots)).unwrap();
    let whole = open(root.as_path().into());
    pieces(&root, |name| name.ends_with(".db") || name.contains("CAM_F0"), |roots| same(&whole, &open(roots)));
    pieces(&root, |name| name.contains("sensor_blobs"), |roots| same(&whole, &open(roots)));
}

#[test]
fn wayve_scenes_one_by_one() {
    let Some(root) = folder("RIGSCAPE_DATA", "wayve101") else { return };
    let open = |root: Roots, data: &Path| {
        let metadata = Some(data.join("repo_data"));
        WayveScenes::open(&WayveScenesConfig { metadata, ..WayveScenesConfig::new(root) }).unwrap()
    };
    let whole = open(root.as_path().into(), &root);
    pieces(&root, |name| name.starts_with("scene_901"), |roots| same(&whole, &open(roots, &root)));
}

#[test]
fn waymo_segments_and_components() {
    let Some(root) = folder("RIGSCAPE_DATA", "waymo") else { return };
    let open = |root: Roots| {
        let config = WaymoConfig { split: "validation".to_owned(), ..WaymoConfig::new(root, WaymoRelease::V2) };
        Waymo::open(&config).unwrap()
    };
    let made = root.join("v2_made");
    let whole = open(made.as_path().into());
    pieces(&made, |name| name.contains("camera_image"), |roots| same(&whole, &open(roots)));
}
