//! `rigscape evaluate` as a user meets it: folders, datasets, statistics, and what it refuses.

use std::path::{Path, PathBuf};

use serde_json::Value;

use crate::programs::{data, rigscape};
use crate::runs::{must, train, write_config};

/// Weights for networks, when there are any.
pub fn weights() -> Option<PathBuf> {
    let Some(root) = std::env::var_os("RIGSCAPE_WEIGHTS") else {
        eprintln!("did not run: set RIGSCAPE_WEIGHTS for the checks with networks");
        return None;
    };
    let path = PathBuf::from(root);
    assert!(path.is_dir(), "{} is missing", path.display());
    Some(path)
}

fn text(path: &Path) -> String {
    path.to_string_lossy().into_owned()
}

/// Smooth pictures with a little texture; `shift` moves every value.
fn write_pictures(folder: &Path, names: &[&str], (width, height): (u32, u32), shift: u8) {
    for (place, name) in names.iter().enumerate() {
        let picture = image::RgbImage::from_fn(width, height, |x, y| {
            let value = |c: u32| ((x * (3 + c) + y * 5 + 31 * place as u32) % 200) as u8;
            image::Rgb([0, 1, 2].map(|c| value(c).saturating_add(shift)))
        });
        let path = folder.join(name);
        std::fs::create_dir_all(path.parent().unwrap()).unwrap();
        picture.save(path).unwrap();
    }
}

const NAMES: [&str; 4] = ["a/0.png", "a/1.png", "b/0.png", "b/1.png"];

struct Sets {
    folder: tempfile::TempDir,
    real: String,
    generated: String,
    out: PathBuf,
}

fn sets() -> Sets {
    let folder = tempfile::tempdir().unwrap();
    let (real, generated) = (folder.path().join("real"), folder.path().join("generated"));
    write_pictures(&real, &NAMES, (64, 48), 0);
    write_pictures(&generated, &NAMES, (64, 48), 8);
    let out = folder.path().join("out");
    Sets { real: text(&real), generated: text(&generated), out, folder }
}

fn report(out: &Path) -> Value {
    assert!(image::open(out.join("report.png")).unwrap().width() > 1000);
    let markdown = std::fs::read_to_string(out.join("report.md")).unwrap();
    assert!(markdown.contains("| metric |"), "{markdown}");
    serde_json::from_str(&std::fs::read_to_string(out.join("report.json")).unwrap()).unwrap()
}

fn metric<'a>(report: &'a Value, name: &str) -> &'a Value {
    let all = report["metrics"].as_array().unwrap();
    all.iter().find(|one| one["name"] == name).unwrap_or_else(|| panic!("no {name} in {report}"))
}

/// The message of a command that must fail, without a panic.
fn refusal(args: &[&str]) -> String {
    let output = rigscape(args);
    let text = String::from_utf8_lossy(&output.stderr).into_owned();
    assert!(!output.status.success() && !text.contains("panicked"), "should have been refused: {text}");
    text
}

#[test]
fn two_folders_pair_by_name() {
    let sets = sets();
    let args = ["evaluate", "--real", &sets.real, "--generated", &sets.generated, "--out", &text(&sets.out)];
    must(rigscape(&[&args[..], &["--protocol", "psnr/bev-vae,ssim/skimage7,ssim/gauss11"]].concat()));
    let found = report(&sets.out);
    assert_eq!((found["pictures"].as_u64(), found["frames"].as_u64()), (Some(4), Some(4)));
    let psnr = metric(&found, "psnr")["value"].as_f64().unwrap();
    assert!((psnr - 20.0 * (255.0_f64 / 8.0).log10()).abs() < 1e-9, "every value is moved by 8 of 255: {psnr}");
    let ssim = metric(&found, "ssim");
    assert!(ssim["value"].as_f64().unwrap() > 0.9 && ssim["samples"] == 4);
    assert_eq!(ssim["settings"]["metric"]["window"], "uniform7");
    assert!(found["code"].as_str().unwrap().contains("commit"));
}

#[test]
fn identical_folders_are_told_apart_from_good_ones() {
    let sets = sets();
    let args = ["evaluate", "--real", &sets.real, "--generated", &sets.real, "--out", &text(&sets.out)];
    must(rigscape(&[&args[..], &["--protocol", "psnr/bev-vae,ssim/gauss11"]].concat()));
    let found = report(&sets.out);
    let psnr = metric(&found, "psnr");
    assert!(psnr["value"].is_null() && psnr["skipped"] == 4, "{psnr}");
    assert_eq!(metric(&found, "ssim")["value"].as_f64(), Some(1.0));
}

#[test]
fn mistakes_are_refused_with_the_place_and_the_cure() {
    let sets = sets();
    let with = |more: &[&str]| {
        let args = ["evaluate", "--real", &sets.real, "--generated", &sets.generated];
        refusal(&[&args[..], more].concat())
    };
    assert!(with(&["--protocol", "psnr/unknown"]).contains("--list"));
    assert!(with(&["--size", "0x5"]).contains("256x256"));
    let empty = text(&sets.folder.path().join("empty"));
    std::fs::create_dir_all(&empty).unwrap();
    let missing = with(&["--protocol", "fid/plain", "--weights", &empty]);
    assert!(missing.contains("no weights") && missing.contains("empty"), "{missing}");
    std::fs::write(Path::new(&empty).join("efficientnet_lite0_imagenet.safetensors"), b"these are no weights").unwrap();
    let wrong = with(&["--protocol", "fid/plain", "--weights", &empty]);
    assert!(wrong.contains("efficientnet_lite0_imagenet.safetensors"), "{wrong}");

    std::fs::write(Path::new(&empty).join("pt_inception-2015-12-05-6726825d.pth"), b"another file").unwrap();
    let wrong = with(&["--protocol", "fid/plain", "--weights", &empty]);
    assert!(wrong.contains("pt_inception"), "{wrong}");

    let other = sets.folder.path().join("other");
    write_pictures(&other, &NAMES, (32, 48), 0);
    let args = ["evaluate", "--real", &sets.real, "--protocol", "psnr/bev-vae", "--generated"];
    let size = refusal(&[&args[..], &[&text(&other)]].concat());
    assert!(size.contains("48x64") && size.contains("48x32") && size.contains("--size"), "{size}");
    std::fs::remove_file(other.join(NAMES[0])).unwrap();
    let fewer = refusal(&[&args[..], &[&text(&other)]].concat());
    assert!(fewer.contains("--unpaired"), "{fewer}");
    let broken = other.join(NAMES[0]);
    std::fs::write(&broken, b"no picture").unwrap();
    assert!(refusal(&[&args[..], &[&text(&other)]].concat()).contains("0.png"));
    let small = refusal(&[&args[..], &[&text(&other), "--unpaired"]].concat());
    assert!(small.contains("pairs"), "{small}");
    let nothing = refusal(&["evaluate", "--real", &sets.real]);
    assert!(nothing.contains("--generated"), "{nothing}");
    let protocols = sets.folder.path().join("mine.toml");
    std::fs::write(&protocols, "[[protocol]]\nname = \"x\"\n").unwrap();
    assert!(with(&["--protocols", &text(&protocols)]).contains("mine.toml"));
}

#[test]
fn stand_in_weights_give_the_distance_another_name_and_statistics_come_back() {
    let Some(weights) = weights() else { return };
    let sets = sets();
    let weights = ["--weights".to_owned(), text(&weights), "--protocol".to_owned(), "fid/plain".to_owned()];
    let weights: Vec<&str> = weights.iter().map(String::as_str).collect();
    let args = ["evaluate", "--real", &sets.real, "--generated", &sets.generated, "--out", &text(&sets.out)];
    must(rigscape(&[&args[..], &weights].concat()));
    let found = report(&sets.out);
    let names: Vec<&str> = found["metrics"].as_array().unwrap().iter().filter_map(|one| one["name"].as_str()).collect();
    assert!(names.iter().all(|name| name.starts_with("fid-")), "{names:?}");
    let whole = metric(&found, names[0]);
    assert!(whole["is_proxy"] == true && whole["weights"]["sha256"].as_str().unwrap().len() == 64);
    let notes = whole["notes"].to_string();
    assert!(notes.contains("rank 3 and 3") && notes.contains("stand-in"), "{notes}");

    for ending in ["safetensors", "npz"] {
        let file = text(&sets.folder.path().join(format!("real.{ending}")));
        must(rigscape(&[&["evaluate", "--generated", &sets.real, "--save-stats", &file], &weights[..]].concat()));
        let args = ["evaluate", "--real-stats", &file, "--generated", &sets.generated, "--out", &text(&sets.out)];
        must(rigscape(&[&args[..], &weights].concat()));
        let again = metric(&report(&sets.out), names[0])["value"].as_f64().unwrap();
        let value = whole["value"].as_f64().unwrap();
        assert!((again - value).abs() < 1e-9 * value, "{ending}: {again} against {value}");
    }
    let file = text(&sets.folder.path().join("real.safetensors"));
    let args = ["evaluate", "--real-stats", &file, "--generated", &sets.generated, "--size", "32x32"];
    let other = refusal(&[&args[..], &weights].concat());
    assert!(other.contains("as stored") && other.contains("32x32"), "{other}");
    let lonely = sets.folder.path().join("lonely");
    write_pictures(&lonely, &NAMES[..1], (64, 48), 0);
    let args = ["evaluate", "--unpaired", "--real", &sets.real, "--generated", &text(&lonely)];
    let few = refusal(&[&args[..], &weights].concat());
    assert!(few.contains("the generated set has 1 samples"), "{few}");
}

#[test]
fn a_dataset_against_itself_has_consistent_views() {
    let Some(weights) = weights() else { return };
    let folder = tempfile::tempdir().unwrap();
    let data = folder.path().join("data.toml");
    let table = "[[data]]\nkind = \"procedural\"\nseed = 4\nscenes = 1\nframes_per_scene = 2\nrig = { preset = \"nuscenes\" }\n";
    std::fs::write(&data, table).unwrap();
    let (data, out) = (text(&data), folder.path().join("out"));
    let args = ["evaluate", "--real-data", &data, "--generated-data", &data, "--size", "64x128", "--out", &text(&out)];
    let more = ["--weights", &text(&weights), "--protocol", "mvsc/v1,vms/ours,psnr/bev-vae"];
    must(rigscape(&[&args[..], &more].concat()));
    let found = report(&out);
    assert_eq!((found["frames"].as_u64(), found["pictures"].as_u64()), (Some(2), Some(12)));
    let mvsc = found["metrics"][0].clone();
    assert!(mvsc["name"].as_str().unwrap().starts_with("mvsc_proxy("), "{mvsc}");
    assert!(mvsc["notes"].to_string().contains("24 pairs of views"), "{mvsc}");
    let same = mvsc["value"].is_null() || mvsc["value"].as_f64() == Some(1.0);
    assert!(same, "equal sides: {mvsc}");
}

#[test]
fn a_checkpoint_is_measured_against_what_it_was_shown() {
    let folder = tempfile::tempdir().unwrap();
    must(train(&write_config(folder.path()), &["--set", "train.steps=2"]));
    let (run, out) = (text(&folder.path().join("runs/run")), folder.path().join("out"));
    let args = ["evaluate", "--checkpoint", &run, "--protocol", "psnr/bev-vae,ssim/gauss11", "--out", &text(&out)];
    must(rigscape(&args));
    let found = report(&out);
    assert_eq!((found["frames"].as_u64(), found["pictures"].as_u64()), (Some(2), Some(12)));
    assert!(metric(&found, "psnr")["value"].as_f64().unwrap() > 3.0);
    assert!(found["model"]["checkpoint"].as_str().unwrap().contains("runs/run"), "{found}");
}

#[test]
fn detections_must_hold_every_sample_of_the_split() {
    let Some(root) = data("nuscenes_chain") else { return };
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("detections.json");
    let meta = "{\"use_camera\":true,\"use_lidar\":false,\"use_radar\":false,\"use_map\":false,\"use_external\":false}";
    std::fs::write(&path, format!("{{\"meta\":{meta},\"results\":{{}}}}")).unwrap();
    let (path, root) = (text(&path), text(&root));
    let args =
        ["evaluate", "--detections", &path, "--nuscenes", &root, "--version", "v1.0-mini", "--split", "mini_val"];
    let missing = refusal(&args);
    assert!(missing.contains("has no sample"), "{missing}");
    assert!(refusal(&args[..3]).contains("--nuscenes"));
    let fvd = refusal(&["evaluate", "--wcoda-fvd", "200"]);
    assert!(fvd.contains("--detections") && fvd.contains("--segmentation"), "{fvd}");
    let alone = refusal(&["evaluate", "--segmentation", &text(folder.path())]);
    assert!(alone.contains("--nuscenes DIR or --data FILE"), "{alone}");
}
