//! BEV-VAE's commands and options as a user meets them: other cars' cameras, reports, smooth discriminators, memory.

use std::path::Path;

use crate::programs::{files_below, refusal, rigscape};
use crate::runs::{assert_equal_parts, find_number, must, train, write_config};

const DATA: &str = "[[data]]\nkind = \"procedural\"\nseed = 4\nscenes = 1\nframes_per_scene = 2\n";

#[test]
fn what_one_car_saw_is_decoded_for_other_cars() {
    let folder = tempfile::tempdir().unwrap();
    let config = write_config(folder.path());
    must(train(&config, &["--set", "train.steps=1"]));
    let text = |name: &str| folder.path().join(name).to_string_lossy().into_owned();
    let (run, sheet, views) = (text("runs/run"), text("sheet.jpg"), text("views"));
    // A rig file starts from a built-in rig.
    let json = rigscape(&["info", "--rig", "nuplan"]);
    let mut rig: serde_json::Value = serde_json::from_slice(&json.stdout).unwrap();
    rig["cameras"].as_array_mut().unwrap().truncate(3);
    std::fs::write(text("three.json"), rig.to_string()).unwrap();
    let three = text("three.json");
    let common = ["--checkpoint", &run, "--frames", "1", "--out", &sheet];
    let asked = ["change-rig", "--rig", "waymo", "--rig", &three, "--yaw=20", "--pictures", &views, "--format", "jpg"];
    let said = must(rigscape(&[&asked[..], &common].concat()));
    for name in ["waymo: PSNR", "waymo yaw +20 deg: PSNR", "three: PSNR", "three yaw +20 deg: PSNR"] {
        assert!(said.contains(name), "{said}");
    }
    let sheet = image::open(sheet).unwrap();
    // Input, then two rigs twice, each over its truth, at 32 px.
    assert!(sheet.width() > 6 * 32 && sheet.height() > 9 * 32, "{}x{}", sheet.width(), sheet.height());
    assert_eq!(files_below(Path::new(&views), "jpg").len(), 2 * 5 + 2 * 3);
    let rigs = files_below(Path::new(&views), "json");
    assert_eq!(rigs.len(), 4);
    let shown = data::read_rig(&rigs[0]).unwrap();
    assert_eq!((shown.cameras[0].intrinsics.width, shown.cameras[0].lens), (32, geometry::Lens::Pinhole));

    for (rig, wanted) in [("nuscense", "nuscense"), ("nowhere.json", "nowhere.json"), ("nowhere.toml", "nowhere.toml")]
    {
        let text = refusal(rigscape(&["change-rig", "--checkpoint", &run, "--rig", rig, "--out", "x.png"]));
        assert!(text.contains(wanted), "{text}");
    }
    let ending = refusal(rigscape(&["change-rig", "--checkpoint", &run, "--rig", "waymo", "--out", "x.gif"]));
    assert!(ending.contains(".png or .jpg"), "{ending}");
    let nothing = refusal(rigscape(&["change-rig", "--checkpoint", &run, "--out", "x.png"]));
    assert!(nothing.contains("--rig"), "{nothing}");
}

#[test]
fn an_evaluation_speaks_of_each_dataset_camera_and_turn() {
    let folder = tempfile::tempdir().unwrap();
    must(train(&write_config(folder.path()), &["--set", "train.steps=1"]));
    let text = |name: &str| folder.path().join(name).to_string_lossy().into_owned();
    let (run, data, out) = (text("runs/run"), text("two.toml"), text("report"));
    let four = "cameras = [\"CAM_FRONT\", \"CAM_BACK\"]\n";
    std::fs::write(&data, format!("{DATA}{}{four}", DATA.replace("[[data]]", "[[data]]\nname = \"two\""))).unwrap();
    let common = ["evaluate", "--checkpoint", &run, "--data", &data, "--frames", "1", "--protocol", "psnr/bev-vae"];
    must(rigscape(&[&common[..], &["--yaw=-15,15", "--out", &out]].concat()));
    let read = |name: &str| std::fs::read_to_string(Path::new(&out).join(name)).unwrap();
    let all: serde_json::Value = serde_json::from_str(&read("report.json")).unwrap();
    let all = all["datasets"].as_array().unwrap();
    let cameras = |report: &serde_json::Value| report["metrics"][0]["cameras"].as_object().unwrap().len();
    assert_eq!(all.iter().map(cameras).collect::<Vec<_>>(), [6, 2]);
    let one: serde_json::Value = serde_json::from_str(&read("1/report.json")).unwrap();
    assert_eq!(one, all[1]);
    let turns = one["novel_views"].as_array().unwrap();
    assert_eq!(
        turns.iter().map(|turn| turn["motion"].as_str().unwrap()).collect::<Vec<_>>(),
        ["yaw +15 deg", "yaw -15 deg"]
    );
    assert!(turns[0]["psnr"]["mean_db"].is_number() && turns[0]["ssim"].is_number(), "{one}");
    let page = read("report.md");
    assert!(
        page.contains("| CAM_BACK | ") && page.contains("nvs/toy") && page.matches("# Evaluation").count() == 2,
        "{page}"
    );
    assert!(Path::new(&out).join("0/report.png").exists());
}

fn rows(run: &Path) -> Vec<serde_json::Value> {
    let text = std::fs::read_to_string(run.join("metrics.jsonl")).unwrap();
    text.lines().map(|row| serde_json::from_str(row).unwrap()).collect()
}

#[test]
fn computing_blocks_again_learns_the_same() {
    let folders = [tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap()];
    let losses = ["false", "true"].iter().zip(&folders).map(|(again, folder)| {
        must(train(&write_config(folder.path()), &["--set", &format!("checkpointing={again}")]));
        let rows = rows(&folder.path().join("runs/run"));
        rows.iter().filter_map(|row| find_number(row, "loss")).collect::<Vec<f64>>()
    });
    let losses: Vec<Vec<f64>> = losses.collect();
    assert!(losses[0].len() >= 8);
    for (kept, again) in losses[0].iter().zip(&losses[1]) {
        assert!((kept - again).abs() < 1e-3 * kept, "{losses:?}");
    }
}

#[test]
fn a_smooth_discriminator_is_part_of_the_step_and_of_the_checkpoint() {
    let regulariser = |value: &str| format!("loss.adversarial.hinge.regulariser={value}");
    let slope = regulariser("{ r1_finite_difference = { every = 2 } }");
    let folder = tempfile::tempdir().unwrap();
    must(train(&write_config(folder.path()), &["--set", &slope, "--set", "train.steps=4"]));
    let smoothed = rows(&folder.path().join("runs/run"));
    let smoothed = smoothed.iter().filter(|row| find_number(row, "discriminator_smoothing").is_some());
    assert_eq!(smoothed.count(), 2);

    let (whole, broken) = (tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap());
    let lecam = regulariser("{ lecam = { weight = 0.1 } }");
    must(train(&write_config(whole.path()), &["--set", &lecam]));
    let config = write_config(broken.path());
    must(train(&config, &["--set", &lecam, "--stop-after", "5"]));
    must(train(&config, &["--set", &lecam, "--resume"]));
    let run = |folder: &tempfile::TempDir| folder.path().join("runs/run");
    assert_equal_parts(&run(&whole), &run(&broken), &["model", "discriminator", "optimizer_discriminator"]);
    for (value, wanted) in [("{ lecam = { decay = 1.0 } }", "decay = 1"), ("{ lecam = { wieght = 1.0 } }", "wieght")] {
        let text = refusal(train(&config, &["--set", &regulariser(value)]));
        assert!(text.contains(wanted), "{text}");
    }
    let early = refusal(train(&config, &["--set", "loss.adversarial.hinge.discriminator_start=0.9"]));
    assert!(early.contains("generator_start"), "{early}");
}

#[test]
fn a_run_says_what_it_takes_and_one_that_cannot_fit_is_refused() {
    let folder = tempfile::tempdir().unwrap();
    let config = write_config(folder.path());
    let said = must(train(&config, &["--set", "train.steps=1"]));
    assert!(said.contains("estimate: about") && said.contains("for 1 steps"), "{said}");
    if Path::new("/proc/meminfo").exists() {
        let large = ["--set", "model.preset=paper", "--set", "data.loader.batch_size=512"];
        let text = refusal(train(&config, &large));
        assert!(
            text.contains("GB are free") && text.contains("checkpointing=true") && text.contains("--ignore-memory"),
            "{text}"
        );
    }
}
