//! Layouts and the scenes made of them, as a user meets the commands: `layout`, `synthesize`, `sweep-guidance`, `replace-history`.

use std::path::Path;

use data::SceneDataset;
use data::export::{ExportManifest, Generator};
use data::layout::{Layout, LayoutClasses, LayoutFile};
use data::nuscenes::{NuScenes, NuScenesConfig};
use serde_json::Value;

use crate::dit_place::{Place, refusal};
use crate::programs::{files_below, rigscape};
use crate::runs::must;

const PROCEDURAL: [&str; 8] =
    ["--kind", "procedural", "--set", "scenes=1", "--set", "frames_per_scene=2", "--set", "seed=9"];

fn text(path: &Path) -> String {
    path.to_string_lossy().into_owned()
}

fn run(parts: &[&[&str]]) -> String {
    must(rigscape(&parts.concat()))
}

fn refused(parts: &[&[&str]]) -> String {
    refusal(rigscape(&parts.concat()))
}

fn bytes(path: &Path) -> Vec<u8> {
    std::fs::read(path).unwrap_or_else(|error| panic!("{}: {error}", path.display()))
}

#[test]
fn layouts_are_listed_edited_mixed_and_drawn() {
    let folder = tempfile::tempdir().unwrap();
    let path = |name: &str| text(&folder.path().join(name));
    let listed = run(&[&["layout"], &PROCEDURAL]);
    assert!(listed.lines().any(|line| line.starts_with("car-1 ")), "{listed}");
    let (plain, edited, picture) = (path("plain.json"), path("new/edited.json"), path("edited.png"));
    run(&[&["layout"], &PROCEDURAL, &["--out", &plain]]);
    let edits = ["--edit", "remove:car-1", "--edit", "add:bus:x=12,y=4,yaw=90deg,id=new"];
    let said = run(&[&["layout"], &PROCEDURAL, &edits, &["--out", &edited, "--picture", &picture, "--width", "900"]]);
    assert!(said.contains("edited.json") && said.contains("edited.png"), "{said}");
    let classes = LayoutClasses::nuscenes();
    let (before, after) =
        (Layout::read(Path::new(&plain), &classes).unwrap(), Layout::read(Path::new(&edited), &classes).unwrap());
    assert_eq!(before.boxes.len(), after.boxes.len());
    assert!(after.boxes.iter().any(|found| found.id == "new") && after.boxes.iter().all(|found| found.id != "car-1"));
    assert!(LayoutFile::read(Path::new(&edited)).unwrap().source.is_some());
    assert_eq!(image::open(&picture).unwrap().width(), 900);
    // A file has no pictures of its own; half of the way to the edited one.
    let between = path("between.json");
    let towards = ["--towards", &edited, "--amount", "0.4", "--out", &between, "--picture", &picture];
    run(&[&["layout", "--layout", &plain], &towards]);
    assert_eq!(Layout::read(Path::new(&between), &classes).unwrap().boxes.len(), before.boxes.len());

    for (parts, names) in [
        (&["layout"][..], &["say which data"][..]),
        (&["layout", "--layout", "nowhere.json"], &["nowhere.json", "missing"]),
        (&["layout", "--layout", &plain, "--edit", "remove:cra-1"], &["cra-1", "car-1"]),
        (&["layout", "--layout", &plain, "--edit", "remvoe:car-1"], &["remvoe", "remove:ID"]),
        (&["layout", "--layout", &plain, "--towards", &edited, "--amount", "2"], &["0..=1"]),
        (&["layout", "--layout", &plain, "--classes", "waymo"], &["nuscenes"]),
        (&["layout", "--layout", &plain, "--index", "1"], &["--index"]),
    ] {
        let said = refused(&[parts]);
        assert!(names.iter().all(|name| said.contains(name)), "{parts:?}: {said}");
    }
}

/// A debug autoencoder and transformer, hardly trained.
fn model() -> Place {
    let place = Place::new("1");
    must(place.train(&["train.steps=2", "evaluation.generated=0", "evaluation.edits=0"], &[]));
    place
}

/// The same after it has learned two scenes, so that noise and layouts show in eight bits.
fn learned() -> Place {
    let place = Place::new("60");
    let set = [
        "data.train=[{ kind = \"procedural\", seed = 1, scenes = 2, frames_per_scene = 1 }]",
        "train.steps=150",
        "train.validate_every=0",
        "data.loader.batch_size=8",
        "optimizer.learning_rate=4e-3",
        "latents.posterior=mean",
        "diffusion={ schedule = { target = \"velocity\" } }",
        "evaluation.generated=0",
        "evaluation.edits=0",
    ];
    must(place.train(&set, &[]));
    place
}

#[test]
fn scenes_are_made_of_layouts_for_any_rig() {
    let place = learned();
    let checkpoint = place.text("runs/dit");
    let (street, out) = (place.text("street.json"), place.text("scenes"));
    let three =
        r#"{"boxes": [{"id": "car-1", "class": "car", "center": [12, 3, 0.8], "size": [4.5, 1.9, 1.6], "yaw": 0.2}]}"#;
    std::fs::write(&street, three).unwrap();
    let base = ["synthesize", "--checkpoint", &checkpoint, "--steps", "2"];
    let rigs = ["--layout", &street, "--rig", "nuscenes", "--rig", "argoverse2", "--count", "2", "--out", &out];
    let said = run(&[&base, &rigs]);
    assert!(said.contains("2 samples") && said.contains("scenes"), "{said}");
    assert_eq!(files_below(&place.path("scenes/nuscenes"), "png").len(), 2 + 2 * 6, "pages and pictures");
    assert_eq!(files_below(&place.path("scenes/argoverse2"), "png").len(), 2 + 2 * 7);
    let front = place.path("scenes/nuscenes/layout-000/CAM_FRONT.png");
    let (first, second) = (bytes(&front), bytes(&place.path("scenes/nuscenes/layout-001/CAM_FRONT.png")));
    assert_ne!(first, second, "each sample has its own noise");
    let manifest: Generator = serde_json::from_slice(&bytes(&place.path("scenes/synthesis.json"))).unwrap();
    assert!(manifest.checkpoint_sha256.is_some_and(|hash| hash.len() == 64) && manifest.sampler.contains("ddim"));

    let again = refused(&[&base, &rigs]);
    assert!(again.contains("--force") && again.contains("scenes"), "{again}");
    run(&[&base, &rigs, &["--force"]]);
    assert_eq!(bytes(&front), first, "equal seeds give equal pictures");
    run(&[&base, &rigs, &["--force", "--seed", "1"]]);
    assert_ne!(bytes(&front), first);

    // An edit changes what it touches by the layout alone: without guidance nothing changes.
    for (guidance, same) in [("0", true), ("3", false)] {
        let out = place.text(&format!("edit-{guidance}"));
        let edit = ["--layout", &street, "--edit", "move:car-1:dy=-6", "--guidance", guidance, "--out", &out];
        run(&[&base, &edit]);
        let file = |name: &str| bytes(&Path::new(&out).join(format!("nuscenes/{name}-000/CAM_FRONT.png")));
        assert_eq!(file("before") == file("after"), same, "guidance {guidance}");
    }
    // The way between two layouts.
    let (way, other) = (place.text("way"), place.text("edit-3/after.json"));
    run(&[&base, &["--interpolate", &street, &other, "--stops", "3", "--out", &way]]);
    assert_eq!(files_below(Path::new(&way), "json").len(), 3 + 1);
    // A frame's own cameras.
    let own = place.text("own");
    run(&[&base, &PROCEDURAL, &["--index", "1", "--out", &own]]);
    assert_eq!(files_below(&place.path("own/frame"), "png").len(), 1 + 6);
    mistakes_name_the_option_and_the_cure(&place, &base, &street);
    guidance_is_swept(&place, &checkpoint);
}

fn mistakes_name_the_option_and_the_cure(place: &Place, base: &[&str], street: &str) {
    let out = place.text("never");
    let foreign = place.text("runs");
    for (parts, names) in [
        (&["--layout", "nowhere.json", "--out", &out][..], &["nowhere.json"][..]),
        (&["--out", &out], &["say which data"]),
        (&["--layout", street, "--out", &foreign], &["did not make", "runs"]),
        (&["--layout", street, "--rig", "tricycle", "--out", &out], &["tricycle", "argoverse2"]),
        (&["--layout", street, "--guidance=-1", "--out", &out], &["--guidance"]),
        (&["--layout", street, "--sampler", "flow-euler", "--out", &out], &["rectified flow"]),
        (&["--layout", street, "--edit", "reclass:car-1:bus", "--out", &out], &["bus", "pedestrian"]),
        (&["--layout", street, "--export", "nuscenes", "--out", &out], &["--export"]),
        (&["--export", "nuscenes", "--shard", "0/2", "--out", &out], &["1/4"]),
    ] {
        let said = refused(&[base, parts]);
        assert!(names.iter().all(|name| said.contains(name)), "{parts:?}: {said}");
    }
    let lost = refused(&[&["synthesize", "--checkpoint", "nowhere", "--layout", street, "--out", &out]]);
    assert!(lost.contains("nowhere"), "{lost}");
    assert!(!Path::new(&out).exists());
}

fn guidance_is_swept(place: &Place, checkpoint: &str) {
    let out = place.text("sweep");
    let sweep = ["sweep-guidance", "--checkpoint", checkpoint, "--steps", "2", "--frames", "2", "--scales", "0,1,4"];
    let said = run(&[&sweep, &PROCEDURAL, &["--out", &out]]);
    assert!(said.contains("| guidance | distance | change |"), "{said}");
    let report: Value = serde_json::from_slice(&bytes(&place.path("sweep/sweep.json"))).unwrap();
    let points = report["points"].as_array().unwrap();
    let number = |at: usize, name: &str| points[at][name].as_f64().unwrap();
    assert_eq!((points.len(), number(0, "change")), (3, 0.0), "scale 0 is its own measure");
    assert!(number(2, "change") > 0.0 && (0..3).all(|at| number(at, "distance").is_finite()));
    assert!(image::open(place.path("sweep/sweep.png")).is_ok());
    let wrong = refused(&[&sweep, &PROCEDURAL, &["--out", &out, "--scales=-1"]]);
    assert!(wrong.contains("-1"), "{wrong}");
}

#[test]
fn a_dataset_is_painted_in_parts_and_becomes_somebodys_past() {
    let place = model();
    let checkpoint = place.text("runs/dit");
    let (real, made, mixed) = (place.text("real"), place.text("made"), place.text("mixed"));
    let make = ["make-data", "--format", "nuscenes", "--scenes", "2", "--key-frames", "2", "--size", "64x36", "--out"];
    run(&[&make, &[&real]]);
    let paint = ["synthesize", "--checkpoint", &checkpoint, "--steps", "2", "--nuscenes", &real, "--export"];
    let part = |shard: &str, out: &str| run(&[&paint, &["nuscenes", "--shard", shard, "--out", out]]);
    assert!(part("2/2", &made).contains("2 of 4 frames are finished"));
    assert!(!Path::new(&made).exists());
    assert!(part("1/2", &made).contains("4 frames written"));
    let whole = place.text("whole");
    part("1/1", &whole);
    for file in files_below(Path::new(&whole), "jpg") {
        let other = Path::new(&made).join(file.strip_prefix(&whole).unwrap());
        assert_eq!(bytes(&file), bytes(&other), "{}", file.display());
    }
    let manifest: ExportManifest = serde_json::from_slice(&bytes(&place.path("made/generated.json"))).unwrap();
    assert_eq!((manifest.frames.len(), manifest.generator.seed), (4, 0));
    let open = |root: &str| NuScenes::open(&NuScenesConfig::new(root, "v1.0-mini")).unwrap();
    let (was, is) = (open(&real).frame(1).unwrap(), open(&made).frame(1).unwrap());
    assert_eq!((&was.id, &was.boxes, was.rig()), (&is.id, &is.boxes, is.rig()));

    // Another rig and layout of files: only the boxes that pictures were made from are annotated.
    let other = place.text("other");
    run(&[&paint, &["argoverse2", "--rig", "argoverse2", "--edit", "remove:car-*", "--out", &other]]);
    let checked = run(&[&["check-data", "--kind", "argoverse2", "--root", &other, "--set", "split=train"]]);
    assert!(checked.contains("ring_front_center") || checked.contains("7 cameras"), "{checked}");
    assert!(!checked.contains("car "), "{checked}");

    let replace = ["replace-history", "--nuscenes", &real, "--generated", &made, "--out", &mixed];
    let said = run(&[&replace, &["--share", "1"]]);
    assert!(said.contains("2 of 2 past frames"), "{said}");
    let again = refused(&[&replace]);
    assert!(again.contains("exists already"), "{again}");
    assert!(refused(&[&replace, &["--share", "2", "--force"]]).contains("0..=1"));
    run(&[&["check-data", "--nuscenes", &mixed]]);
}
