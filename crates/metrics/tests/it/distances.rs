//! Fréchet distance and KID against SVD and explicit kernel sums in f64.

use std::path::Path;

use metrics::{FeatureRows, FeatureStatistics, Moments, frechet_distance, polynomial_mmd};
use safetensors::SafeTensors;
use serde_json::Value;

use crate::golden::{assert_close, folder, json, rows};

/// Of the golden's README for an implementation by singular values, times the trace sum.
const BY_SINGULAR_VALUES: f64 = 1e-8;

fn statistics((width, values): &(usize, Vec<f32>)) -> FeatureStatistics {
    let mut moments = Moments::new(*width);
    // Uneven batches, as a data set has them.
    values.chunks(7 * width).for_each(|batch| moments.update(batch).unwrap());
    moments.statistics("golden").unwrap()
}

fn features(folder: &Path) -> Vec<u8> {
    std::fs::read(folder.join("io.safetensors")).unwrap()
}

#[test]
fn frechet_distance_of_every_case() {
    let Some(folder) = folder("inception_fid") else { return };
    let bytes = features(&folder);
    let file = SafeTensors::deserialize(&bytes).unwrap();
    let cases = json(&folder.join("frechet_kid.json"));
    let cases = cases.as_object().unwrap();
    let mut identical = 0;
    for (case, values) in cases {
        let [a, b] = ["a", "b"].map(|side| rows(&file, &format!("fd/{case}/{side}")));
        let found = frechet_distance(&statistics(&a), &statistics(&b)).unwrap();
        let expected = values["fd_svd"].as_f64().unwrap();
        let scale = found.trace_sum + found.mean_part;
        assert_close(case, found.value, expected, BY_SINGULAR_VALUES * scale);
        for (set, rank) in [(&a, found.ranks[0]), (&b, found.ranks[1])] {
            let count = set.1.len() / set.0;
            assert!(rank <= set.0.min(count - 1), "{case}: rank {rank} of {count} samples");
        }
        if a == b {
            identical += 1;
            assert!(found.value < 1e-6 * scale, "{case}: {found:?}");
        }
    }
    assert!(cases.len() > 1 && identical > 0);
}

#[test]
fn kernel_distance_of_every_case() {
    let Some(folder) = folder("inception_fid") else { return };
    let bytes = features(&folder);
    let file = SafeTensors::deserialize(&bytes).unwrap();
    let cases = json(&folder.join("frechet_kid.json"));
    for (case, values) in cases.as_object().unwrap() {
        let [a, b] = ["a", "b"].map(|side| {
            let (width, values) = rows(&file, &format!("fd/{case}/{side}"));
            FeatureRows::new(width, values).unwrap()
        });
        let scale = [(&a, &a), (&b, &b)].map(|(x, _)| largest_kernel(x)).into_iter().fold(1.0, f64::max);
        if let Some(expected) = values["kid_full_unbiased"].as_f64() {
            assert_close(case, polynomial_mmd(&a, &b).unwrap(), expected, 1e-10 * scale);
        }
        for subset in values["kid_subsets"].as_array().into_iter().flatten() {
            let indices = |key: &str| -> Vec<usize> {
                let list = subset[key].as_array().unwrap();
                list.iter().map(|index| Value::as_u64(index).unwrap() as usize).collect()
            };
            let found = polynomial_mmd(&a.select(&indices("index_a")), &b.select(&indices("index_b"))).unwrap();
            assert_close(case, found, subset["mmd2"].as_f64().unwrap(), 1e-10 * scale);
        }
    }
}

/// No kernel value exceeds it: the longest row with itself.
fn largest_kernel(rows: &FeatureRows) -> f64 {
    let longest = (0..rows.len()).map(|i| {
        let one = rows.select(&[i, i]);
        // k(x, x) + k(0, 0) - 2 k(x, 0) is k(x, x) - 1.
        let zero = FeatureRows::new(rows.width(), vec![0.0; 2 * rows.width()]).unwrap();
        polynomial_mmd(&one, &zero).unwrap() + 1.0
    });
    longest.fold(1.0, f64::max)
}

#[test]
fn video_distance_with_fewer_clips_than_features() {
    let Some(folder) = folder("i3d_fvd") else { return };
    let bytes = features(&folder);
    let file = SafeTensors::deserialize(&bytes).unwrap();
    let [a, b] = ["fvd/a", "fvd/b"].map(|name| rows(&file, name));
    let found = frechet_distance(&statistics(&a), &statistics(&b)).unwrap();
    let expected = json(&folder.join("values.json"))["fvd"]["fd_svd_f64"].as_f64().unwrap();
    assert_close("fvd", found.value, expected, 1e-8 * expected);
    assert_eq!(found.ranks, [&a, &b].map(|(width, values)| (values.len() / width - 1).min(*width)));
}
