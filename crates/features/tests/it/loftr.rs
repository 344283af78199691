//! LoFTR's coarse path against kornia with golden weights: features, similarity, confidence, matches.

use std::path::Path;

use burn::tensor::{Device, Tensor, TensorData};
use features::{LOFTR_CELL, Loftr, MatchRules, mutual_matches};
use nn::weights::WeightError;

use crate::common::{assert_missing, file_of, host};
use crate::golden::{self, Golden};

fn image(io: &Golden, name: &str) -> Tensor<4> {
    let shape: [usize; 4] = io.shape(name).try_into().unwrap();
    Tensor::from_data(TensorData::new(io.floats(name).unwrap(), shape), &Device::flex())
}

fn network(io: &Golden) -> Loftr {
    Loftr::from_values(&Device::flex(), |name, shape| Ok(io.parameter(name, shape))).unwrap()
}

#[test]
fn features_agree_from_the_backbone_to_the_similarity() {
    let Some(folder) = golden::folder("loftr") else { return };
    let io = Golden::open(&folder.join("io.safetensors"));
    let (network, first, second) = (network(&io), image(&io, "image0"), image(&io, "image1"));
    let both = network.backbone(Tensor::cat(vec![first.clone(), second.clone()], 0));
    io.check_absolute("backbone/coarse", &host(both.clone()), 1e-3);
    io.check_absolute("pos_encoded", &host(network.positioned(both)), 1e-3);
    let (a, b) = network.coarse_features(first.clone(), second.clone());
    io.check_absolute("coarse/feat0", &host(a), 1e-3);
    io.check_absolute("coarse/feat1", &host(b), 1e-3);
    io.check_absolute("similarity", &host(network.similarity(first, second)), 5e-3);
}

#[test]
fn confidences_and_matches_agree() {
    let Some(folder) = golden::folder("loftr") else { return };
    let io = Golden::open(&folder.join("io.safetensors"));
    let (first, second) = (image(&io, "image0"), image(&io, "image1"));
    let grids = [&first, &second].map(|image| [image.dims()[2] / LOFTR_CELL, image.dims()[3] / LOFTR_CELL]);
    let confidence = host(network(&io).confidence(first, second));
    io.check("conf_matrix", &confidence, 2e-2);
    let cells = grids[1][0] * grids[1][1];
    let row_max: Vec<f32> = confidence.chunks(cells).map(|row| row.iter().copied().fold(0.0, f32::max)).collect();
    io.check("conf_row_max", &row_max, 2e-2);

    let text = std::fs::read_to_string(folder.join("values.json")).unwrap();
    let values: serde_json::Value = serde_json::from_str(&text).unwrap();
    for case in ["default", "low_threshold"] {
        let rules = MatchRules {
            threshold: values[case]["thr"].as_f64().unwrap() as f32,
            border: values[case]["border_rm"].as_u64().unwrap() as usize,
        };
        let matches = mutual_matches(&confidence, grids, rules);
        let found: Vec<_> = matches.iter().map(|found| (found.first, found.second)).collect();
        let expected = io.indices(&format!("{case}/i_ids")).into_iter().zip(io.indices(&format!("{case}/j_ids")));
        assert_eq!(found, expected.collect::<Vec<_>>(), "{case}");
        let stored = io.floats(&format!("{case}/confidence")).unwrap();
        for (found, stored) in matches.iter().zip(stored) {
            assert!((found.confidence / stored - 1.0).abs() <= 2e-2, "{case}: {found:?} against {stored}");
        }
    }
    assert_eq!(MatchRules::default(), MatchRules { threshold: 0.2, border: 2 });
}

#[test]
fn a_pair_does_not_see_its_neighbours_and_the_order_of_images_matters() {
    let Some(folder) = golden::folder("loftr") else { return };
    let io = Golden::open(&folder.join("io.safetensors"));
    let (network, first, second) = (network(&io), image(&io, "image0"), image(&io, "image1"));
    let alone = network.similarity(first.clone(), second.clone());
    let swapped = network.similarity(second.clone(), first.clone());
    let pair = |a: &Tensor<4>, b: &Tensor<4>| Tensor::cat(vec![a.clone(), b.clone()], 0);
    let together = network.similarity(pair(&first, &second), pair(&second, &first));
    let distance = |a: Tensor<3>, b: Tensor<3>| host((a - b).abs().max())[0];
    assert!(distance(together.clone().narrow(0, 0, 1), alone.clone()) < 1e-3);
    assert!(distance(together.narrow(0, 1, 1), swapped.clone()) < 1e-3);
    assert!(distance(swapped.swap_dims(1, 2), alone) > 1e-2);
}

#[test]
fn mutual_matches_by_hand() {
    // 3×3 cells each; the centre is the only one that is one cell from the border.
    let mut confidence = vec![0.0; 81];
    confidence[4 * 9 + 4] = 0.5;
    let rules = MatchRules { threshold: 0.2, border: 1 };
    let found = mutual_matches(&confidence, [[3, 3]; 2], rules);
    assert_eq!(
        found.iter().map(|found| (found.first, found.second, found.confidence)).collect::<Vec<_>>(),
        [(4, 4, 0.5)]
    );
    assert!(mutual_matches(&confidence, [[3, 3]; 2], MatchRules { border: 2, ..rules }).is_empty());
    assert!(mutual_matches(&confidence, [[3, 3]; 2], MatchRules { threshold: 0.5, ..rules }).is_empty());
    // A better column takes the second cell away.
    confidence[4] = 0.6;
    assert!(mutual_matches(&confidence, [[3, 3]; 2], rules).is_empty());
    assert!(mutual_matches(&[], [[3, 3], [0, 0]], rules).is_empty());
}

#[test]
fn names_are_those_of_the_published_checkpoint() {
    let device = Device::flex();
    // A Lightning checkpoint of another network: its prefix is taken off, its names are listed.
    let other = Path::new(env!("CARGO_MANIFEST_DIR")).join("../nn/tests/fixtures/lightning.ckpt");
    let WeightError::Mismatch(mismatch) = Loftr::load(other, &device).unwrap_err() else { panic!("loaded") };
    assert_eq!(mismatch.unexpected, ["bias", "weight"]);
    let Some(folder) = golden::folder("loftr") else { return };
    let mut wanted = golden::manifest(&folder);
    let refinement = ["fine_preprocess.", "loftr_fine.", "backbone.layer1_outconv", "backbone.layer2_outconv"];
    wanted.retain(|name, _| !refinement.iter().any(|prefix| name.starts_with(prefix)));
    let present = "backbone.bn1.weight";
    assert_missing(Loftr::load(file_of(present, &[128]).path(), &device).unwrap_err(), wanted, present);
}
