//! `check-data` and `show-data` as a user meets them: every rig, real fixtures, typos, missing folders, broken pictures.

use std::path::{Path, PathBuf};
use std::process::Output;

use serde_json::Value;

use crate::programs::{data, files_below, rigscape};
use crate::runs::must;

fn text(path: &Path) -> String {
    path.to_string_lossy().into_owned()
}

fn shipped(name: &str) -> String {
    text(&Path::new(env!("CARGO_MANIFEST_DIR")).join("configs/data").join(name))
}

/// Exit code and everything that was said.
fn said(output: &Output) -> (i32, String) {
    let text = [&output.stdout, &output.stderr].map(|bytes| String::from_utf8_lossy(bytes).into_owned()).concat();
    assert!(!text.contains("panicked"), "{text}");
    (output.status.code().expect("an exit code"), text)
}

fn refused(args: &[&str], code: i32, names: &[&str]) {
    let (got, text) = said(&rigscape(args));
    assert_eq!(got, code, "{args:?}: {text}");
    for name in names {
        assert!(text.contains(name), "{args:?} should name {name}: {text}");
    }
}

/// A checked dataset's findings.
fn findings(args: &[&str], json: &Path) -> (i32, String, Value) {
    let (code, printed) = said(&rigscape(&[&["check-data", "--json", &text(json)], args].concat()));
    (code, printed, serde_json::from_str(&std::fs::read_to_string(json).unwrap()).unwrap())
}

/// Share of a page's pixels close to a colour.
fn share_of(page: &image::RgbImage, color: [u8; 3]) -> f64 {
    let near = |pixel: &&image::Rgb<u8>| pixel.0.iter().zip(color).all(|(a, b)| a.abs_diff(b) < 12);
    page.pixels().filter(near).count() as f64 / f64::from(page.width() * page.height())
}

const CAR: [u8; 3] = [255, 158, 0];
const BOUNDARY: [u8; 3] = [255, 75, 75];
const EMPTY_PANEL: [u8; 3] = [34, 36, 40];

#[test]
fn every_known_rig_is_checked_and_could_train() {
    let folder = tempfile::tempdir().unwrap();
    let json = folder.path().join("new/report.json");
    let (code, printed, found) = findings(&["--config", &shipped("procedural.toml")], &json);
    assert_eq!((code, &found["could_train"]), (0, &Value::Bool(true)), "{printed}");
    let datasets = found["datasets"].as_array().unwrap();
    assert_eq!(datasets.len(), 5);
    let cameras = |at: usize| datasets[at]["report"]["rigs"][0]["cameras"].as_array().unwrap().len();
    assert_eq!([0, 1, 2, 3, 4].map(cameras), [6, 7, 8, 5, 5]);
    for dataset in datasets {
        let report = &dataset["report"];
        assert_eq!((report["scenes"].as_u64(), report["frames"].as_u64()), (Some(2), Some(4)));
        assert!(report["boxes"]["count"].as_u64().unwrap() > 50 && report["warnings"].as_array().unwrap().is_empty());
        assert_eq!(report["rigs"][0]["closed"], Value::Bool(dataset["place"] != "data.validation.0"));
    }
    assert_eq!(found["memory"]["views"].as_u64(), Some(8), "the largest rig");
    for part in ["data.train.3: wayve_scenes101", "closed ring", "open chain", "kannala_brandt", "training could start"]
    {
        assert!(printed.contains(part), "{part}: {printed}");
    }
}

#[test]
fn an_experiment_is_checked_with_its_own_batches() {
    let folder = tempfile::tempdir().unwrap();
    let config = crate::runs::write_config(folder.path());
    let json = folder.path().join("report.json");
    let set = ["--set", "data.loader.batch_size=5"];
    let (code, printed, found) = findings(&[&["--config", &text(&config)], &set[..]].concat(), &json);
    assert_eq!(code, 0, "{printed}");
    assert_eq!(found["memory"]["batch_size"].as_u64(), Some(5));
    assert_eq!(found["memory"]["size"]["width"], found["memory"]["size"]["height"]);
    assert_eq!(found["datasets"].as_array().unwrap().len(), 4);
}

#[test]
fn pages_show_every_rig() {
    let folder = tempfile::tempdir().unwrap();
    let out = folder.path().join("pages/page.png");
    for rig in ["nuscenes", "argoverse2", "nuplan", "wayve_scenes101", "waymo"] {
        let rig = format!("rig.preset={rig}");
        let args = ["--kind", "procedural", "--set", &rig, "--set", "seed=3", "--index", "5", "--width", "900"];
        let show = |more: &[&str]| {
            must(rigscape(&[&["show-data", "--out", &text(&out)], &args[..], more].concat()));
            image::open(&out).unwrap().to_rgb8()
        };
        let page = show(&["--layers", "boxes,map"]);
        assert_eq!(page.width(), 900);
        assert!(share_of(&page, CAR) > 1e-3 && share_of(&page, BOUNDARY) > 5e-4, "{rig}");
        let bare = show(&["--layers", "masks"]);
        assert!(share_of(&bare, CAR) < 1e-4 && share_of(&bare, BOUNDARY) < 1e-4, "{rig}");
        assert!(share_of(&bare, EMPTY_PANEL) > 0.1, "{rig}: nothing but the views from above");
        let occupied = show(&["--layers", "occupancy,occupancy-in-views"]);
        assert!(share_of(&occupied, EMPTY_PANEL) < 0.8 * share_of(&bare, EMPTY_PANEL), "{rig}");
    }
}

#[test]
fn every_layout_that_is_made_is_found_sound() {
    let folder = tempfile::tempdir().unwrap();
    let small = ["--scenes", "1", "--key-frames", "12", "--scale", "0.05"];
    for (format, settings) in [
        ("nuscenes", &["version=v1.0-mini"][..]),
        ("argoverse2", &[]),
        ("nuplan", &["split=mini"]),
        ("wayve_scenes101", &["split=all"]),
        ("waymo", &["release=v2"]),
    ] {
        let out = text(&folder.path().join(format));
        must(rigscape(&[&["make-data", "--format", format, "--out", &out], &small[..]].concat()));
        let mut check = vec!["check-data", "--kind", format, "--root", &out, "--images", "3"];
        settings.iter().for_each(|setting| check.extend(["--set", setting]));
        let told = must(rigscape(&check));
        assert!(told.contains("training could start"), "{format}: {told}");
        let again = rigscape(&[&["make-data", "--format", format, "--out", &out], &small[..]].concat());
        assert!(!again.status.success(), "{format} was overwritten");
    }
    let refused =
        rigscape(&["make-data", "--format", "waymo", "--size", "64x36", "--out", &text(&folder.path().join("x"))]);
    assert!(String::from_utf8_lossy(&refused.stderr).contains("--scale"));
}

#[test]
fn frames_are_found_by_scene_and_time() {
    let folder = tempfile::tempdir().unwrap();
    let out = text(&folder.path().join("page.jpg"));
    let config = shipped("procedural.toml");
    let base = ["show-data", "--config", &config, "--width", "320", "--out", &out];
    let shown = |more: &[&str]| must(rigscape(&[&base[..], more].concat()));
    assert!(shown(&["--scene", "scene-0001", "--index", "1"]).contains("frame 3 of nuscenes"));
    assert!(shown(&["--dataset", "4", "--scene", "scene-0001", "--time", "0.1"]).contains("frame 2 of waymo"));
    assert!(shown(&["--time", "1000"]).contains("frame 1 of"), "the last of the first scene");
    for (wrong, names) in [
        (["--scene", "scene-7"], ["scene-7", "scene-0001"]),
        (["--index", "4"], ["no frame 4", "only 4"]),
        (["--dataset", "5"], ["no dataset 5", "only 5"]),
        (["--range", "0"], ["--range", "0"]),
    ] {
        refused(&[&base[..], &wrong].concat(), 2, &names);
    }
}

#[test]
fn mistakes_are_told_from_broken_data_by_the_exit_code() {
    let folder = tempfile::tempdir().unwrap();
    let out = text(&folder.path().join("page.png"));
    let write = |name: &str, content: &str| {
        std::fs::write(folder.path().join(name), content).unwrap();
        text(&folder.path().join(name))
    };
    let typo = write("typo.toml", "[[data]]\nkind = \"nuscenes\"\nroot = \"x\"\nsplitt = \"all\"\n");
    let gone = write("gone.toml", "kind = \"nuplan\"\nroot = \"no/such/folder\"\n");
    for command in [&["check-data"][..], &["show-data", "--out", &out]] {
        let with = |more: &[&'static str]| [command, more].concat();
        refused(&[command, &["--config", &typo]].concat(), 2, &["typo.toml", "splitt"]);
        refused(&with(&["--config", "absent.toml"]), 2, &["absent.toml"]);
        refused(&with(&["--kind", "nuscense", "--root", "x"]), 2, &["nuscense", "procedural"]);
        refused(&with(&["--kind", "procedural", "--set", "scnes=1"]), 2, &["scnes"]);
        refused(command, 2, &["--config"]);
        refused(&[command, &["--config", &gone]].concat(), 1, &["no/such/folder"]);
        refused(&with(&["--kind", "nuplan", "--root", "nowhere"]), 1, &["nowhere"]);
    }
    assert!(!Path::new(&out).exists());
    // One dataset that cannot be opened does not hide the others.
    let both = write(
        "both.toml",
        "[[data]]\nkind = \"nuplan\"\nroot = \"nowhere\"\n[[data]]\nkind = \"procedural\"\nscenes = 1\nframes_per_scene = 1\n",
    );
    refused(
        &["check-data", "--config", &both],
        1,
        &["data.0: cannot be opened", "data.1: procedural", "1 of 2 datasets"],
    );
}

#[test]
fn broken_pictures_are_all_listed_and_stop_a_page() {
    let folder = tempfile::tempdir().unwrap();
    let out = folder.path().join("made");
    let make = ["make-data", "--format", "nuscenes", "--scenes", "1", "--key-frames", "3", "--size", "64x36", "--out"];
    must(rigscape(&[&make[..], &[&text(&out)]].concat()));
    let json = folder.path().join("report.json");
    let (code, printed, found) = findings(&["--nuscenes", &text(&out)], &json);
    assert_eq!((code, found["datasets"][0]["report"]["pictures"].as_u64()), (0, Some(18)), "{printed}");

    let pictures: Vec<PathBuf> = files_below(&out.join("samples"), "jpg");
    let name = |at: usize| pictures[at].file_name().unwrap().to_string_lossy().into_owned();
    std::fs::remove_file(&pictures[0]).unwrap();
    let bytes = std::fs::read(&pictures[7]).unwrap();
    std::fs::write(&pictures[7], &bytes[..bytes.len() / 2]).unwrap();
    std::fs::write(&pictures[12], b"not a picture").unwrap();
    let (code, printed, found) = findings(&["--nuscenes", &text(&out), "--lines", "1"], &json);
    assert_eq!((code, &found["could_train"]), (1, &Value::Bool(false)));
    assert!(printed.contains("and 2 more") && printed.contains("1 files missing, 2 broken"), "{printed}");
    let listed = found["datasets"][0]["report"]["problems"].as_array().unwrap();
    assert_eq!(listed.len(), 3);
    for at in [0, 7, 12] {
        assert!(listed.iter().any(|problem| problem.as_str().unwrap().ends_with(&name(at))), "{listed:?}");
    }
    let page = text(&folder.path().join("page.png"));
    for index in ["0", "1", "2"] {
        let shown = rigscape(&["show-data", "--nuscenes", &text(&out), "--index", index, "--out", &page]);
        let (code, said) = said(&shown);
        let broken = [0, 7, 12].into_iter().any(|at| said.contains(&name(at)));
        assert_eq!(code == 1, broken, "{said}");
    }
}

#[test]
fn real_fixtures_are_sound_and_drawn() {
    let folder = tempfile::tempdir().unwrap();
    let (json, page) = (folder.path().join("report.json"), folder.path().join("page.png"));
    for (part, options, frames, boxes) in [
        ("nuscenes_keyframe", &["--kind", "nuscenes", "--set", "version=v1.0-mini"][..], 1, 68),
        ("nuscenes_chain", &["--kind", "nuscenes", "--set", "version=v1.0-mini"][..], 11, 24),
        ("nuplan", &["--kind", "nuplan"][..], 2, 10),
    ] {
        let Some(root) = data(part) else { return };
        let folder_text = text(&root);
        let args = [options, &["--root", &folder_text]].concat();
        let (code, printed, found) = findings(&[&args[..], &["--images", "100"]].concat(), &json);
        assert_eq!(code, 0, "{part}: {printed}");
        let report = &found["datasets"][0]["report"];
        assert_eq!(report["frames"].as_u64(), Some(frames), "{part}");
        assert_eq!(report["decoded"], report["pictures"], "{part}: all of them");
        assert_eq!(report["warnings"].as_array().unwrap().len(), 0, "{part}: {printed}");
        assert_eq!(report["rigs"][0]["closed"], Value::Bool(true));
        // 160 of the 176 picture rows of the nuPlan fixture have no file, as in the release.
        let notes = report["notes"].to_string();
        assert_eq!(notes.contains("160 rows"), part == "nuplan", "{part}: {notes}");
        let shown = must(rigscape(&[&["show-data", "--out", &text(&page), "--width", "1200"], &args[..]].concat()));
        assert!(shown.contains(&format!("{boxes} boxes")), "{part}: {shown}");
        assert!(share_of(&image::open(&page).unwrap().to_rgb8(), CAR) > 2e-4, "{part}");
    }
}

#[test]
fn occupancy_of_the_fixture_is_read_and_a_wrong_folder_is_refused() {
    let Some(root) = data("nuscenes_chain") else { return };
    let folder = tempfile::tempdir().unwrap();
    let json = folder.path().join("report.json");
    let labels = |below: &str| {
        let labels = root.join("Occpancy3D-nuScenes-V1.0").join(below);
        format!("occupancy={{ kind = \"occ3d\", root = {:?} }}", text(&labels))
    };
    let folder_text = text(&root);
    let base = ["--kind", "nuscenes", "--root", &folder_text, "--set", "version=v1.0-mini", "--set"];
    for frames in ["frames=key_frames", "frames={ all_pictures = {} }"] {
        let (code, printed, found) = findings(&[&base[..], &[&labels("mini"), "--set", frames]].concat(), &json);
        assert_eq!(code, 0, "{printed}");
        assert_eq!(found["datasets"][0]["report"]["occupancy_read"].as_u64(), Some(2), "one in each scene");
    }
    let (code, printed, _) = findings(&[&base[..], &[&labels("")]].concat(), &json);
    assert!(code == 1 && printed.contains("labels.npz"), "{printed}");
}
