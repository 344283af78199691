//! PSNR, SSIM and MS-SSIM against scikit-image and pytorch-msssim, which computed in f64 on `byte / 255`.

use metrics::{ImageSize, Psnr, SsimWindow, image_mse, ms_ssim, psnr_db, ssim};
use safetensors::SafeTensors;

use crate::golden::{assert_close, folder, json};

/// Of the golden's README: closed formulas on identical inputs.
const TOLERANCE: f64 = 1e-9;

fn picture<'a>(file: &SafeTensors<'a>, name: &str) -> (ImageSize, &'a [u8]) {
    let view = file.tensor(name).unwrap();
    let &[channels, height, width] = view.shape() else { panic!("{name} has shape {:?}", view.shape()) };
    (ImageSize { channels, height, width }, view.data())
}

#[test]
fn psnr_ssim_and_ms_ssim_of_every_pair() {
    let Some(folder) = folder("image_metrics") else { return };
    let bytes = std::fs::read(folder.join("io.safetensors")).unwrap();
    let file = SafeTensors::deserialize(&bytes).unwrap();
    let cases = json(&folder.join("values.json"));
    let cases = cases.as_object().unwrap();
    assert!(!cases.is_empty());

    let mut all = Psnr::default();
    let (mut sum_db, mut differing, mut multi_scale) = (0.0, 0, 0);
    for (case, values) in cases {
        let (size, a) = picture(&file, &format!("{case}/a_u8"));
        let (_, b) = picture(&file, &format!("{case}/b_u8"));
        let number = |key: &str| values[key].as_f64();
        let close =
            |key: &str, actual: f64| assert_close(&format!("{case} {key}"), actual, number(key).unwrap(), TOLERANCE);
        close("mse", image_mse(b, a));
        let db = all.update(b, a);
        match number("psnr") {
            Some(expected) => {
                close("psnr", db);
                close("psnr", psnr_db(number("mse").unwrap()));
                sum_db += expected;
                differing += 1;
            }
            None => assert_eq!(db, f64::INFINITY, "{case}"),
        }
        close("ssim_skimage_uniform7", ssim(b, a, size, SsimWindow::Uniform7));
        close("ssim_skimage_gauss11", ssim(b, a, size, SsimWindow::Gauss11));
        match number("ms_ssim_f64_window") {
            Some(_) => {
                close("ms_ssim_f64_window", ms_ssim(b, a, size).unwrap());
                multi_scale += 1;
            }
            None => assert!(ms_ssim(b, a, size).is_err(), "{case} is too small for five scales"),
        }
    }
    let summary = all.summary();
    assert_eq!((summary.images, summary.identical), (cases.len(), cases.len() - differing));
    assert!(differing > 0 && multi_scale > 0);
    assert_close("mean psnr", summary.mean_db.unwrap(), sum_db / differing as f64, TOLERANCE);
}

#[test]
fn f32_pictures_differ_by_their_rounding_only() {
    let Some(folder) = folder("image_metrics") else { return };
    let bytes = std::fs::read(folder.join("io.safetensors")).unwrap();
    let file = SafeTensors::deserialize(&bytes).unwrap();
    for name in file.names().into_iter().filter_map(|name| name.strip_suffix("/a_u8")) {
        let (size, a) = picture(&file, &format!("{name}/a_u8"));
        let (_, b) = picture(&file, &format!("{name}/b_u8"));
        let floats = |bytes: &[u8]| -> Vec<f32> { bytes.iter().map(|byte| f32::from(*byte) / 255.0).collect() };
        for window in [SsimWindow::Uniform7, SsimWindow::Gauss11] {
            let exact = ssim(b, a, size, window);
            assert_close(name, ssim(&floats(b), &floats(a), size, window), exact, 1e-7);
        }
    }
}
