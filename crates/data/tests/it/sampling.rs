//! Frames with rare classes, and batches of one number of views.

use std::collections::BTreeMap;
use std::sync::Arc;

use data::{
    DataError, FrameSampling, ImageSize, Loader, LoaderConfig, Mixture, MixtureConfig, MixtureOrder, MixtureWeights,
    ObjectClass, SceneDataset,
};

use super::listed::{Listed, Listing};
use ObjectClass::{Bicycle, Bus, Car};

fn frames(classes: &[&[ObjectClass]], views: &[usize]) -> Arc<dyn SceneDataset> {
    let listing = |(at, (classes, views)): (usize, (&&[ObjectClass], &usize))| Listing {
        classes: Some(classes.to_vec()),
        views: *views,
        ..Listing::at(at as i64 * 500)
    };
    let views = views.iter().cycle();
    Arc::new(Listed::new(vec![classes.iter().zip(views).enumerate().map(listing).collect()]))
}

fn counts(blend: &Mixture, epoch: u64) -> BTreeMap<(usize, usize), u64> {
    let mut seen = BTreeMap::new();
    for k in epoch * blend.epoch_len()..(epoch + 1) * blend.epoch_len() {
        *seen.entry(blend.item(k)).or_default() += 1;
    }
    seen
}

/// Twelve frames: cars in ten, a bus in three of them, one bicycle alone, one frame with nothing.
fn street() -> Arc<dyn SceneDataset> {
    let both: &[ObjectClass] = &[Car, Bus, Car];
    let car: &[ObjectClass] = &[Car];
    frames(&[car, both, car, car, both, car, &[], car, both, &[Bicycle], car, car], &[2])
}

fn balanced(share: f64, max_repeats: f64) -> MixtureConfig {
    MixtureConfig { frames: FrameSampling::ClassBalanced { share, max_repeats }, ..MixtureConfig::default() }
}

#[test]
fn rare_classes_come_as_often_as_common_ones() {
    let blend = Mixture::new(vec![street()], &balanced(1.0, 100.0), 2, 7).unwrap();
    assert_eq!((blend.epoch_len(), blend.epoch_counts()), (12, vec![12]));
    // Four draws for each of three classes.
    let expected = |frame: usize| -> f64 {
        match frame {
            1 | 4 | 8 => 4.0 / 10.0 + 4.0 / 3.0,
            9 => 4.0,
            6 => 0.0,
            _ => 4.0 / 10.0,
        }
    };
    let mut total = [0; 12];
    for epoch in 0..100 {
        for ((_, frame), count) in counts(&blend, epoch) {
            let want: f64 = expected(frame);
            assert!((want.floor()..=want.ceil()).contains(&(count as f64)), "frame {frame}: {count} draws of {want}");
            total[frame] += count;
        }
    }
    for (frame, total) in total.into_iter().enumerate() {
        assert!((total as f64 - 100.0 * expected(frame)).abs() < 3.0, "frame {frame}: {total} draws");
    }
    // With half of the draws spread evenly, the empty frame comes in every second pass.
    let blend = Mixture::new(vec![street()], &balanced(0.5, 100.0), 2, 7).unwrap();
    let empty: u64 = (0..100).map(|epoch| counts(&blend, epoch).get(&(0, 6)).copied().unwrap_or(0)).sum();
    assert!((48..=52).contains(&empty), "{empty}");
    let blend = Mixture::new(vec![street()], &balanced(1.0, 2.0), 2, 7).unwrap();
    assert!((0..100).all(|epoch| counts(&blend, epoch).values().all(|count| *count <= 2)));
}

#[test]
fn an_even_share_is_the_plain_mixture_of_every_frame_once() {
    let blend = Mixture::new(vec![street(), street()], &balanced(0.0, 1.0), 2, 7).unwrap();
    for epoch in 0..5 {
        assert_eq!(counts(&blend, epoch).values().copied().collect::<Vec<u64>>(), [1; 24]);
    }
}

#[test]
fn datasets_without_boxes_are_drawn_evenly_beside_others() {
    let bare = || {
        let listing = |at: i64| Listing { classes: None, ..Listing::at(at * 100) };
        Arc::new(Listed::new(vec![(0..6).map(listing).collect()])) as Arc<dyn SceneDataset>
    };
    let config = MixtureConfig { weights: MixtureWeights::Explicit(vec![2.0, 1.0]), ..balanced(1.0, 100.0) };
    let blend = Mixture::new(vec![street(), bare()], &config, 2, 7).unwrap();
    assert_eq!(blend.epoch_counts(), [12, 6]);
    for epoch in 0..10 {
        let seen = counts(&blend, epoch);
        assert!((0..6).all(|frame| seen[&(1, frame)] == 1), "{seen:?}");
        assert_eq!(seen[&(0, 9)], 4);
    }
    assert!(matches!(Mixture::new(vec![bare()], &balanced(1.0, 2.0), 2, 7), Err(DataError::Config(_))));
    for (share, max_repeats) in [(1.5, 2.0), (-0.1, 2.0), (f64::NAN, 2.0), (0.5, 0.5), (0.5, f64::NAN)] {
        let refused = Mixture::new(vec![street()], &balanced(share, max_repeats), 2, 7);
        assert!(matches!(refused, Err(DataError::Config(_))), "{share} {max_repeats}");
    }
}

/// Two datasets with frames of four, five and six views: 4 5 6 4 5 6 ..., and 6 6 5 6 6 5 ...
fn mixed_rigs() -> Vec<Arc<dyn SceneDataset>> {
    let car: &[ObjectClass] = &[Car];
    let bus: &[ObjectClass] = &[Bus];
    let mut classes = vec![car; 24];
    classes[5] = bus;
    vec![frames(&classes, &[4, 5, 6]), frames(&classes[..12], &[6, 6, 5])]
}

fn views(datasets: &[Arc<dyn SceneDataset>], item: (usize, usize)) -> usize {
    datasets[item.0].outline(item.1).unwrap().rig.len()
}

#[test]
fn batches_hold_one_number_of_views_in_exact_shares() {
    for frames in [FrameSampling::Uniform, FrameSampling::class_balanced()] {
        let config = MixtureConfig { order: MixtureOrder::SameViews, frames, ..MixtureConfig::default() };
        let blend = Mixture::new(mixed_rigs(), &config, 4, 11).unwrap();
        let datasets = mixed_rigs();
        assert_eq!((blend.epoch_len(), blend.block_len()), (36, 4));
        let mut batches_by_views: Vec<BTreeMap<usize, u64>> = Vec::new();
        let mut mixed = 0;
        for epoch in 0..20 {
            let mut batches = BTreeMap::new();
            let mut per_dataset = [0; 2];
            for batch in 0..9 {
                let items: Vec<_> = (0..4).map(|k| blend.item(epoch * 36 + batch * 4 + k)).collect();
                let count = views(&datasets, items[0]);
                assert!(items.iter().all(|item| views(&datasets, *item) == count), "{items:?}");
                mixed += usize::from(items.iter().any(|item| item.0 != items[0].0));
                items.iter().for_each(|item| per_dataset[item.0] += 1);
                *batches.entry(count).or_default() += 1;
            }
            assert_eq!(per_dataset.to_vec(), blend.epoch_counts(), "epoch {epoch}");
            batches_by_views.push(batches);
        }
        assert!(mixed > 40, "datasets with equal rigs share batches: {mixed}");
        assert!(batches_by_views.windows(2).all(|pair| pair[0] == pair[1]), "exact in every epoch");
        if frames == FrameSampling::Uniform {
            // 8, 12 and 16 frames of four, five and six views.
            assert_eq!(batches_by_views[0], BTreeMap::from([(4, 2), (5, 3), (6, 4)]));
            let whole = counts(&blend, 3);
            assert_eq!((whole.len(), whole.values().max()), (36, Some(&1)), "an epoch shows every frame once");
        }
    }
}

#[test]
fn weights_hold_within_batches_of_one_number_of_views() {
    let config =
        MixtureConfig { order: MixtureOrder::SameViews, weights: MixtureWeights::Balanced, ..MixtureConfig::default() };
    let blend = Mixture::new(mixed_rigs(), &config, 4, 11).unwrap();
    // Half of the draws each: a third of the first half has four views, a third five, a third six; of the other half a third five.
    let [first, second] = blend.epoch_counts().try_into().unwrap();
    assert_eq!(first + second, 36);
    assert!(first.abs_diff(18) <= 2, "{first}");
    let only = MixtureConfig { weights: MixtureWeights::Explicit(vec![0.0, 1.0]), ..config };
    assert_eq!(Mixture::new(mixed_rigs(), &only, 4, 11).unwrap().epoch_counts(), [0, 36]);
    let starved = MixtureConfig { weights: MixtureWeights::Explicit(vec![1.0, 1e-4]), ..only };
    let error = Mixture::new(mixed_rigs(), &starved, 4, 11).unwrap_err();
    assert!(error.to_string().contains("views"), "{error}");
}

#[test]
fn every_option_is_a_function_of_seed_and_position() {
    for order in [MixtureOrder::Shuffled, MixtureOrder::Homogeneous, MixtureOrder::SameViews] {
        for frames in [FrameSampling::Uniform, FrameSampling::class_balanced()] {
            let config = MixtureConfig { order, frames, ..MixtureConfig::default() };
            let make = |seed| Mixture::new(mixed_rigs(), &config, 4, seed).unwrap();
            let (a, b) = (make(3), make(3));
            let run: Vec<_> = (0..200).map(|k| a.item(k)).collect();
            // Looked up backwards and from the middle.
            let again: Vec<_> = (0..200).rev().map(|k| b.item(k)).rev().collect();
            assert_eq!(run, again);
            assert_ne!(run, (0..200).map(|k| make(4).item(k)).collect::<Vec<_>>());
            assert_ne!(run[..36], run[36..72], "epochs differ");
            // The loader goes on at a position as if it had never stopped.
            let loader = |start| {
                let size = ImageSize::square(4);
                let config = LoaderConfig { batch_size: 4, size, ..LoaderConfig::default() };
                Loader::new(Arc::new(make(3)), config, start).unwrap()
            };
            let (mut whole, mut resumed) = (loader(0), loader(13));
            for batch in 0..20 {
                let next = whole.next_batch().unwrap();
                let frames: Vec<String> = (0..4).map(|k| run[batch * 4 + k].1.to_string()).collect();
                assert!(next.ids.iter().map(|id| &id.frame).eq(&frames));
                if batch >= 13 {
                    assert_eq!(next, resumed.next_batch().unwrap());
                }
            }
        }
    }
}

#[test]
fn configs_name_the_options() {
    let parse = |text: &str| toml::from_str::<MixtureConfig>(text);
    let config = parse("order = \"same_views\"\nframes = { class_balanced = { share = 1.0 } }").unwrap();
    assert_eq!(config.order, MixtureOrder::SameViews);
    assert_eq!(config.frames, FrameSampling::ClassBalanced { share: 1.0, max_repeats: 10.0 });
    assert_eq!(parse("frames = \"uniform\"").unwrap(), MixtureConfig::default());
    assert_eq!(parse("weights = { explicit = [1.0, 2.0] }").unwrap().weights, MixtureWeights::Explicit(vec![1.0, 2.0]));
    assert!(parse("frames = { class_balanced = { shares = 1.0 } }").is_err());
}

#[test]
fn plain_mixtures_keep_the_order_that_older_runs_saw() {
    // Taken from the mixture as it was before frames could be weighted: a run resumed across that change sees the same frames.
    let even = |len: i64| Arc::new(Listed::new(vec![(0..len).map(Listing::at).collect()])) as Arc<dyn SceneDataset>;
    let shuffled = [(2, 13), (2, 17), (1, 1), (2, 16), (0, 7), (0, 6), (2, 19), (1, 7), (2, 2), (0, 0), (1, 7), (1, 5)];
    let homogeneous =
        [(1, 7), (1, 2), (1, 1), (2, 11), (2, 0), (2, 9), (1, 4), (1, 1), (1, 5), (2, 19), (2, 4), (2, 10)];
    for (order, want) in [(MixtureOrder::Shuffled, shuffled), (MixtureOrder::Homogeneous, homogeneous)] {
        let weights = MixtureWeights::Explicit(vec![0.3, 2.0, 1.1]);
        let config = MixtureConfig { weights, order, ..MixtureConfig::default() };
        let blend = Mixture::new(vec![even(15), even(8), even(21)], &config, 3, 2).unwrap();
        assert_eq!((0..12).map(|k| blend.item(k)).collect::<Vec<_>>(), want);
    }
}
