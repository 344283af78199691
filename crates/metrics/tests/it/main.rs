//! Parity of the image metrics with scikit-image's numbers, which it computed in f64 on `byte / 255`.

use std::path::{Path, PathBuf};

use metrics::{ImageSize, Psnr, SsimWindow, image_mse, psnr_db, ssim};
use safetensors::SafeTensors;

/// Our inputs are `byte / 255` rounded to f32, so a pixel's difference is at most this far from the reference's.
const ROUNDING: f64 = 6e-8;

/// What that rounding may move an SSIM by; measured: 1e-8.
const SSIM_TOLERANCE: f64 = 1e-7;

/// The folder of one topic. Without `RIGSCAPE_GOLDEN` an absent folder is none, with it a failure.
fn golden_folder(topic: &str) -> Option<PathBuf> {
    let (root, required) = match std::env::var_os("RIGSCAPE_GOLDEN") {
        Some(root) => (PathBuf::from(root), true),
        None => (Path::new(env!("CARGO_MANIFEST_DIR")).join("../../tests/golden"), false),
    };
    let folder = root.join(topic);
    if folder.is_dir() {
        return Some(folder);
    }
    assert!(!required, "RIGSCAPE_GOLDEN has no folder {topic}");
    eprintln!("golden folder {topic} is absent and RIGSCAPE_GOLDEN is not set: this test did not run");
    None
}

fn picture(file: &SafeTensors<'_>, name: &str) -> (ImageSize, Vec<f32>) {
    let view = file.tensor(name).unwrap();
    let &[channels, height, width] = view.shape() else { panic!("{name} has shape {:?}", view.shape()) };
    let values = view.data().iter().map(|&byte| f32::from(byte) / 255.0).collect();
    (ImageSize { channels, height, width }, values)
}

fn assert_close(what: &str, actual: f64, expected: f64, tolerance: f64) {
    assert!((actual - expected).abs() <= tolerance, "{what}: {actual} against {expected}");
}

#[test]
fn psnr_and_ssim_of_every_pair() {
    let Some(folder) = golden_folder("image_metrics") else { return };
    let bytes = std::fs::read(folder.join("io.safetensors")).unwrap();
    let file = SafeTensors::deserialize(&bytes).unwrap();
    let text = std::fs::read_to_string(folder.join("values.json")).unwrap();
    let cases: serde_json::Map<String, serde_json::Value> = serde_json::from_str(&text).unwrap();
    assert!(!cases.is_empty());

    let mut all = Psnr::default();
    let (mut sum_db, mut differing, mut worst_db) = (0.0, 0, 0.0_f64);
    for (case, values) in &cases {
        let (size, a) = picture(&file, &format!("{case}/a_u8"));
        let (_, b) = picture(&file, &format!("{case}/b_u8"));
        let number = |key: &str| values[key].as_f64();
        let mse = number("mse").unwrap();
        // |Δ mean d²| ≤ 2 · mean |d| · |Δd| ≤ 2 · rms · |Δd|, and the PSNR moves by 10 / ln 10 of its relative change.
        let rms = mse.sqrt();
        assert_close(&format!("{case} mse"), image_mse(&b, &a), mse, 2.0 * rms * ROUNDING);
        let db = all.update(&b, &a);
        match number("psnr") {
            Some(expected) => {
                let tolerance = 8.7 * ROUNDING / rms;
                worst_db = tolerance.max(worst_db);
                assert_close(&format!("{case} psnr"), db, expected, tolerance);
                assert_close(&format!("{case} psnr of mse"), psnr_db(mse), expected, 1e-9);
                sum_db += expected;
                differing += 1;
            }
            None => assert_eq!(db, f64::INFINITY, "{case}"),
        }
        for (window, key) in
            [(SsimWindow::Uniform7, "ssim_skimage_uniform7"), (SsimWindow::Gauss11, "ssim_skimage_gauss11")]
        {
            let actual = ssim(&b, &a, size, window);
            assert_close(&format!("{case} {key}"), actual, number(key).unwrap(), SSIM_TOLERANCE);
        }
    }
    let summary = all.summary();
    assert_eq!((summary.images, summary.identical), (cases.len(), cases.len() - differing));
    assert!(differing > 0);
    assert_close("mean psnr", summary.mean_db.unwrap(), sum_db / differing as f64, worst_db);
}
