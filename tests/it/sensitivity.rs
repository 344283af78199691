//! Every metric worsens as pictures get worse: blur, noise, JPEG and shuffled views on the real nuScenes frame.

use std::path::PathBuf;

use data::nuscenes::{NuScenes, NuScenesConfig};
use image::RgbImage;
use image::codecs::jpeg::JpegEncoder;
use metrics::{
    FeatureRows, Moments, Protocol, Raster, ResizeFilter, ViewConsistency, frechet_distance, polynomial_mmd, seam,
    seam_pairs,
};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rigscape::evaluate::{
    Curve, DatasetPictures, FeatureNetwork, Instant, Loaded, NetworkFolder, PictureSource, Pictures, ScalarMetric,
    SeamMatcher, Shot, draw_curves, network_input,
};
use rigscape::sheet::save_picture;

use crate::evaluate::weights;
use crate::programs::data;

/// Rows and columns at which pictures are compared.
const SIZE: (usize, usize) = (176, 320);
/// Rows and columns at which seams are matched.
const SEAM_SIZE: (usize, usize) = (128, 256);
/// Parts of every view that are samples of the set metrics: columns of tiles.
const TILES: usize = 3;

fn image_of(picture: &Raster<u8>) -> RgbImage {
    RgbImage::from_raw(picture.width as u32, picture.height as u32, picture.pixels.clone()).unwrap()
}

fn raster(picture: RgbImage) -> Raster<u8> {
    let (height, width) = (picture.height() as usize, picture.width() as usize);
    Raster { height, width, pixels: picture.into_raw() }
}

fn blurred(picture: &Raster<u8>, sigma: f64) -> Raster<u8> {
    raster(image::imageops::blur(&image_of(picture), sigma as f32))
}

fn noisy(picture: &Raster<u8>, amplitude: f64) -> Raster<u8> {
    let mut rng = ChaCha8Rng::seed_from_u64(1);
    let mut value = |value: u8| {
        // The sum of three is nearly normal.
        let noise: f64 = (0..3).map(|_| rng.random_range(-1.0..1.0)).sum();
        (f64::from(value) + amplitude * noise).round().clamp(0.0, 255.0) as u8
    };
    let pixels = picture.pixels.iter().map(|byte| value(*byte)).collect();
    Raster { pixels, ..*picture }
}

fn jpeg(picture: &Raster<u8>, loss: f64) -> Raster<u8> {
    let mut bytes = Vec::new();
    JpegEncoder::new_with_quality(&mut bytes, (100.0 - loss) as u8).encode_image(&image_of(picture)).unwrap();
    raster(image::load_from_memory(&bytes).unwrap().to_rgb8())
}

/// The first views of the ring in reverse order, each under its neighbour's name: 3, 1 and 0 of six seams stay whole for 2, 4 and 6 views.
fn shuffled(instant: &Instant, count: f64) -> Instant {
    let mut ring = vec![instant.front];
    while let Some(next) = instant.right_of[ring[ring.len() - 1]].filter(|next| *next != instant.front) {
        ring.push(next);
    }
    assert_eq!(ring.len(), instant.views.len());
    let (mut changed, count) = (instant.clone(), count as usize);
    for at in 0..count {
        changed.views[ring[at]].picture = instant.views[ring[count - 1 - at]].picture.clone();
    }
    changed
}

fn each(instant: &Instant, change: impl Fn(&Raster<u8>) -> Raster<u8>) -> Instant {
    let views = instant.views.iter().map(|shot| Shot { channel: shot.channel.clone(), picture: change(&shot.picture) });
    Instant { views: views.collect(), ..instant.clone() }
}

struct Instruments {
    pairs: Vec<ScalarMetric>,
    network: Loaded<dyn FeatureNetwork>,
    matcher: Loaded<dyn SeamMatcher>,
}

impl Instruments {
    fn rows(&self, instant: &Instant) -> Vec<f32> {
        let feature = self.network.network.feature();
        let mut values = Vec::new();
        let mut count = 0;
        for shot in &instant.views {
            let width = shot.picture.width / TILES;
            for tile in 0..TILES {
                let part = shot.picture.cropped(0, tile * width, shot.picture.height, width).unwrap();
                values.extend(network_input(&part, feature));
                count += 1;
            }
        }
        let [height, width] = feature.size;
        self.network.network.features(Pictures { count, height, width, values: &values }).unwrap()
    }

    /// Every seam of the one real frame as a sample of its own. The metric is a mean over matches, so within a sample a seam without any
    /// match would not count.
    fn consistency(&self, instant: &Instant) -> f64 {
        let (height, width) = SEAM_SIZE;
        let views = each(instant, |picture| picture.resized(height, width, ResizeFilter::PilBilinear)).views;
        let planes: Vec<Vec<f32>> =
            views.iter().map(|shot| shot.picture.map(|value| f32::from(value) / 255.0).planes()).collect();
        let size = metrics::ImageSize { channels: 3, height, width };
        let pairs = seam_pairs(&instant.right_of, &vec![true; views.len()]);
        assert_eq!(pairs.len(), views.len(), "six views close the ring");
        let seams: Vec<_> = pairs.iter().map(|(a, b)| seam(&planes[*a], &planes[*b], size).unwrap()).collect();
        let confidences = self.matcher.network.confidences(&seams).unwrap();
        let mut all = ViewConsistency::default();
        confidences.iter().for_each(|seam| _ = all.update([seam.as_slice()]));
        all.mean().unwrap()
    }

    /// Names, values, and whether higher is better.
    fn measure(&self, real: &Instant, changed: &Instant) -> Vec<(String, f64, bool)> {
        let mut found = Vec::new();
        for scalar in &self.pairs {
            let views = real.views.iter().zip(&changed.views);
            let values = views.map(|(real, changed)| scalar.measure(&real.picture, &changed.picture).unwrap());
            // Equal views have an infinite PSNR.
            let mean = values.map(|value| value.min(100.0)).sum::<f64>() / real.views.len() as f64;
            let stand_in = scalar.network.as_ref().and_then(|loaded| loaded.stand_in.clone());
            let name =
                stand_in.map_or(scalar.protocol.name.clone(), |network| format!("perceptual_distance({network})"));
            found.push((name, mean, scalar.network.is_none()));
        }
        let width = self.network.network.width();
        let (real_rows, changed_rows) = (self.rows(real), self.rows(changed));
        let statistics = |rows: &[f32]| {
            let mut moments = Moments::new(width);
            moments.update(rows).unwrap();
            moments.statistics("tiles").unwrap()
        };
        let network = self.network.stand_in.clone().unwrap_or_default();
        let distance = frechet_distance(&statistics(&changed_rows), &statistics(&real_rows)).unwrap();
        found.push((format!("fid-{network}"), distance.value, false));
        let table = |rows: Vec<f32>| FeatureRows::new(width, rows).unwrap();
        let kernel = polynomial_mmd(&table(changed_rows), &table(real_rows)).unwrap();
        found.push((format!("kid-{network}"), kernel, false));
        let matcher = self.matcher.stand_in.clone().unwrap_or_default();
        found.push((format!("mvsc_proxy({matcher})"), self.consistency(changed) / self.consistency(real), true));
        found
    }
}

fn instruments() -> Option<(Instruments, Instant)> {
    let (weights, root) = (weights()?, data("nuscenes_keyframe")?);
    let version = std::fs::read_dir(&root).unwrap().map(|entry| entry.unwrap().file_name().into_string().unwrap());
    let version = version.into_iter().find(|name| name.starts_with("v1.0")).unwrap();
    let dataset = NuScenes::open(&NuScenesConfig::new(root, version)).unwrap();
    let pictures = DatasetPictures::new(std::sync::Arc::new(dataset), 0);
    let (height, width) = SIZE;
    let real = each(&pictures.instant(0).unwrap(), |picture| picture.resized(height, width, ResizeFilter::PilBicubic));
    let networks = NetworkFolder { folders: vec![weights], device: train::DeviceConfig::Flex.open().unwrap() };
    let names = ["psnr/bev-vae", "ssim/skimage7", "ssim/gauss11", "ms_ssim/gauss11", "lpips/squeeze"];
    let known = Protocol::built_in().unwrap();
    let named = |name: &&str| known.iter().find(|protocol| protocol.name == **name).unwrap().clone();
    let set = named(&"fid/plain");
    let scalar = |name: &&str| ScalarMetric::of(&named(name), 0, &networks).unwrap().unwrap();
    let pairs = names.iter().map(scalar).collect();
    let network = networks.pictures(set.feature().unwrap()).unwrap();
    let instruments = Instruments { pairs, network, matcher: networks.matcher().unwrap() };
    Some((instruments, real))
}

/// Damages a moment's pictures by so much.
type Damage<'a> = &'a dyn Fn(&Instant, f64) -> Instant;

fn worsens(curve: &Curve, higher_is_better: bool, damage: &str) -> bool {
    let values: Vec<f64> =
        curve.points.iter().map(|point| if higher_is_better { point[1] } else { -point[1] }).collect();
    if damage.starts_with("views") && (curve.name.starts_with("fid") || curve.name.starts_with("kid")) {
        // A set of pictures is the same set in any order.
        return values.windows(2).all(|pair| (pair[0] - pair[1]).abs() < 1e-6);
    }
    if damage.starts_with("views") && curve.name.starts_with("mvsc_proxy") {
        // Not every seam of the real frame has matches that can be lost.
        return values.windows(2).all(|pair| pair[0] >= pair[1]) && values[0] > values[values.len() - 1];
    }
    if damage.starts_with("JPEG") && curve.name.starts_with("mvsc_proxy") {
        // The edges of JPEG's blocks lie on the stand-in matcher's grid and match each other, until nothing else is left.
        return values[0] > values[values.len() - 1];
    }
    values.windows(2).all(|pair| pair[0] > pair[1])
}

#[test]
fn every_metric_worsens_with_growing_damage() {
    let Some((instruments, real)) = instruments() else { return };
    let damages: [(&str, &[f64], Damage<'_>); 4] = [
        ("blur, deviation in px", &[0.5, 1.0, 2.0, 4.0], &|real, level| each(real, |picture| blurred(picture, level))),
        ("noise, amplitude of 255", &[6.0, 12.0, 24.0, 48.0], &|real, level| {
            each(real, |picture| noisy(picture, level))
        }),
        ("JPEG, 100 - quality", &[10.0, 50.0, 80.0, 95.0], &|real, level| each(real, |picture| jpeg(picture, level))),
        ("views in reverse order", &[2.0, 4.0, 6.0], &shuffled),
    ];
    let (mut charts, mut violations) = (Vec::new(), Vec::new());
    for (damage, levels, apply) in damages {
        let (mut curves, mut directions) = (Vec::<Curve>::new(), Vec::new());
        for level in levels {
            let found = instruments.measure(&real, &apply(&real, *level));
            directions = found.iter().map(|(_, _, higher_is_better)| *higher_is_better).collect();
            for (at, (name, value, _)) in found.iter().enumerate() {
                if curves.len() <= at {
                    curves.push(Curve { name: name.clone(), points: Vec::new() });
                }
                curves[at].points.push([*level, *value]);
            }
        }
        for (at, curve) in curves.iter().enumerate() {
            if !worsens(curve, directions[at], damage) {
                violations.push(format!("{} under {damage}: {:?}", curve.name, curve.points));
            }
        }
        charts.push((damage.to_owned(), curves));
    }
    let picture = draw_curves("Real nuScenes frame, six views: every curve scaled to its own range", &charts);
    let folder = tempfile::tempdir().unwrap();
    let path =
        std::env::var_os("RIGSCAPE_SENSITIVITY_PNG").map_or(folder.path().join("sensitivity.png"), PathBuf::from);
    save_picture(&picture, &path).unwrap();
    assert!(image::open(&path).unwrap().width() > 1000);
    assert!(violations.is_empty(), "{violations:#?}");
}
