//! Cross-view attention: identity at the start, neighbours only, open rigs, padding, and a naive loop.

use burn::module::Module;
use burn::tensor::{Device, Tensor, TensorData};
use nn::Init;
use stable_diffusion::{
    Adjacency, ControlInputs, ControlNet, CrossView, NeighbourMerge, Panels, Preset, UNet2DCondition, UNetConfig,
    UNetInputs,
};

use crate::golden::{check_derivative, golden_weights, noise, values_of};

const BOTH: [NeighbourMerge; 2] = [NeighbourMerge::Sum, NeighbourMerge::Concat];

fn config(merge: Option<NeighbourMerge>) -> UNetConfig {
    let mut config = Preset::Debug.unet();
    config.encoder.cross_view = merge;
    config.checked().unwrap()
}

fn unet(merge: NeighbourMerge, device: &Device) -> UNet2DCondition {
    golden_weights(UNet2DCondition::new(&config(Some(merge)), &mut Init::lazy(0, device)))
}

fn predict(unet: &UNet2DCondition, sample: Tensor<4>, views: &Adjacency) -> Tensor<4> {
    let (n, device) = (sample.dims()[0], sample.device());
    let context = noise("text", [1, 3, 16], &device).repeat_dim(0, n);
    let timesteps = vec![400.0; n];
    unet.forward_with(sample, &UNetInputs { timesteps: &timesteps, context, views: Some(views), control: None })
}

/// Which items' predictions change when one item's input does.
fn reached(unet: &UNet2DCondition, views: &Adjacency, moved: usize) -> Vec<usize> {
    let device = Device::flex();
    let sample = noise("views", [views.items(), 4, 4, 4], &device);
    let one = [moved..moved + 1, 0..4, 0..4, 0..4];
    let other = sample.clone().slice_assign(one, noise("other", [1, 4, 4, 4], &device));
    let (a, b) = (predict(unet, sample, views), predict(unet, other, views));
    let difference = values_of((a - b).abs());
    let per_item = difference.len() / views.items();
    (0..views.items()).filter(|i| difference[i * per_item..][..per_item].iter().any(|d| *d > 1e-6)).collect()
}

#[test]
fn a_fresh_block_changes_nothing() {
    let device = Device::flex();
    let plain = UNet2DCondition::new(&config(None), &mut Init::lazy(0, &device));
    let plain = golden_weights(plain);
    let sample = noise("views", [6, 4, 8, 8], &device);
    let context = noise("text", [1, 3, 16], &device).repeat_dim(0, 6);
    let expected = plain.forward(sample.clone(), &[400.0; 6], context).into_data();
    for merge in BOTH {
        let fresh = UNet2DCondition::new(&config(Some(merge)), &mut Init::new(0, &device));
        let fresh = nn::weights::fill_params(fresh, |path, shape| {
            let name = stable_diffusion::layout::state_dict_name(path);
            // Everything but the last layer of the new branch.
            let zero = name.contains(".connector.");
            Ok(if zero { vec![0.0; shape.iter().product()] } else { nn::golden::golden_values(&name, shape) })
        });
        assert_eq!(predict(&fresh.unwrap(), sample.clone(), &Adjacency::ring(1, 6)).into_data(), expected);
        let block = CrossView::new(16, 2, merge, &mut Init::new(0, &device));
        let x = noise("tokens", [6, 5, 16], &device);
        assert_eq!(block.forward(x.clone(), &Adjacency::ring(1, 6)).into_data(), x.into_data());
    }
}

#[test]
fn rings_wrap_and_chains_do_not() {
    // One cross-view layer: what moves in one view reaches its neighbours only.
    let device = Device::flex();
    for merge in BOTH {
        let block = golden_weights(CrossView::new(16, 2, merge, &mut Init::lazy(0, &device)));
        let reached = |views: &Adjacency, moved: usize| -> Vec<usize> {
            let x = noise("tokens", [views.items(), 5, 16], &device);
            let other = x.clone().slice_assign([moved..moved + 1, 0..5, 0..16], noise("other", [1, 5, 16], &device));
            let difference = values_of((block.forward(x, views) - block.forward(other, views)).abs());
            (0..views.items()).filter(|i| difference[i * 80..][..80].iter().any(|d| *d > 1e-6)).collect()
        };
        assert_eq!(reached(&Adjacency::ring(1, 6), 5), [0, 4, 5]);
        assert_eq!(reached(&Adjacency::ring(1, 6), 2), [1, 2, 3]);
        assert_eq!(reached(&Adjacency::chain(1, 5), 4), [3, 4]);
        assert_eq!(reached(&Adjacency::chain(1, 5), 0), [0, 1]);
        assert_eq!(reached(&Adjacency::ring(2, 3), 3), [3, 4, 5], "samples do not meet");
        // A rig of three with a padded fourth view.
        let padded = Adjacency::new(&[vec![vec![2, 1], vec![0, 2], vec![1, 0], vec![]]]).unwrap();
        assert_eq!(reached(&padded, 3), [3]);
        assert_eq!(reached(&padded, 0), [0, 1, 2]);
    }
    // Through a whole network with several layers an open rig of two halves stays in two halves.
    let apart = Adjacency::new(&[vec![vec![1], vec![0], vec![3], vec![2]]]).unwrap();
    for merge in BOTH {
        let unet = unet(merge, &device);
        assert_eq!(reached(&unet, &apart, 0), [0, 1]);
        assert_eq!(reached(&unet, &Adjacency::chain(1, 4), 3), [0, 1, 2, 3]);
    }
}

/// One row of attention by hand: heads of width d over [N, D] queries and [K, D] keys and values.
fn by_hand(q: &[Vec<f64>], k: &[Vec<f64>], v: &[Vec<f64>], heads: usize) -> Vec<Vec<f64>> {
    let width = q[0].len();
    let d = width / heads;
    let mut out = vec![vec![0.0; width]; q.len()];
    for (row, q) in out.iter_mut().zip(q) {
        for head in 0..heads {
            let range = head * d..(head + 1) * d;
            let dot = |k: &Vec<f64>| range.clone().map(|i| q[i] * k[i]).sum::<f64>() / (d as f64).sqrt();
            let scores: Vec<f64> = k.iter().map(|k| dot(k).exp()).collect();
            let total: f64 = scores.iter().sum();
            for i in range {
                row[i] = scores.iter().zip(v).map(|(s, v)| s * v[i]).sum::<f64>() / total;
            }
        }
    }
    out
}

fn rows(tensor: Tensor<3>) -> Vec<Vec<Vec<f64>>> {
    let [b, n, d] = tensor.dims();
    let values = values_of(tensor);
    let row = |b: usize, i: usize| values[(b * n + i) * d..][..d].iter().map(|v| f64::from(*v)).collect();
    (0..b).map(|b| (0..n).map(|i| row(b, i)).collect()).collect()
}

#[test]
fn both_merges_equal_a_naive_loop() {
    let device = Device::flex();
    let (items, n, width, heads) = (4, 3, 8, 2);
    let lists = vec![vec![1, 3], vec![0, 2, 3], vec![1], vec![]];
    let views = Adjacency::new(std::slice::from_ref(&lists)).unwrap();
    let x = noise("tokens", [items, n, width], &device);
    for merge in BOTH {
        let block = golden_weights(CrossView::new(width, heads, merge, &mut Init::lazy(0, &device)));
        let got = rows(block.forward(x.clone(), &views));
        let normed = block.norm4.forward(x.clone());
        let [q, k, v] =
            [&block.attn4.to_q, &block.attn4.to_k, &block.attn4.to_v].map(|l| rows(l.forward(normed.clone())));
        for (item, list) in lists.iter().enumerate() {
            let mut seen = Tensor::<2>::zeros([n, width], &device);
            let pass = |keys: &[Vec<f64>], values: &[Vec<f64>]| {
                let flat: Vec<f32> =
                    by_hand(&q[item], keys, values, heads).concat().iter().map(|v| *v as f32).collect();
                block.attn4.to_out.forward(Tensor::<2>::from_data(TensorData::new(flat, [n, width]), &device))
            };
            match merge {
                NeighbourMerge::Sum => list.iter().for_each(|u| seen = seen.clone() + pass(&k[*u], &v[*u])),
                NeighbourMerge::Concat if list.is_empty() => {}
                NeighbourMerge::Concat => {
                    let of = |t: &[Vec<Vec<f64>>]| list.iter().flat_map(|u| t[*u].clone()).collect::<Vec<_>>();
                    seen = pass(&of(&k), &of(&v));
                }
            }
            let own = x.clone().narrow(0, item, 1).reshape([n, width]);
            let want = if list.is_empty() { own } else { own + block.connector.forward(seen) };
            for (got, want) in got[item].concat().iter().zip(values_of(want)) {
                assert!((got - f64::from(want)).abs() < 1e-5, "{merge:?} view {item}: {got} against {want}");
            }
        }
    }
}

#[test]
fn the_derivative_equals_differences() {
    let device = Device::flex().autodiff();
    let views = Adjacency::new(&[vec![vec![1, 2], vec![0], vec![]]]).unwrap();
    let (x, weights) = (noise("tokens", [3, 4, 8], &device), noise("weights", [3, 4, 8], &device));
    for merge in BOTH {
        let block = golden_weights(CrossView::new(8, 2, merge, &mut Init::lazy(0, &device)));
        check_derivative(&block, |block| (block.forward(x.clone(), &views) * weights.clone()).sum());
        assert_eq!(block.num_params(), 16 + 3 * 64 + 72 + 72);
    }
}

#[test]
fn samples_may_be_permuted() {
    let device = Device::flex();
    let unet = unet(NeighbourMerge::Sum, &device);
    let sample = noise("views", [6, 4, 4, 4], &device);
    let views = Adjacency::chain(2, 3);
    let order = |t: Tensor<4>| Tensor::cat(vec![t.clone().narrow(0, 3, 3), t.narrow(0, 0, 3)], 0);
    let (a, b) = (predict(&unet, sample.clone(), &views), order(predict(&unet, order(sample), &views)));
    assert!(a.all_close(b, Some(1e-5), Some(1e-5)));
}

#[test]
fn impossible_neighbours_are_refused() {
    assert!(Adjacency::new(&[vec![vec![1], vec![2]]]).is_err());
    assert!(Adjacency::new(&[vec![vec![], vec![]], vec![vec![]]]).is_err());
    assert_eq!(Adjacency::ring(1, 2), Adjacency::chain(1, 2));
    assert_eq!(Adjacency::ring(1, 1), Adjacency::new(&[vec![vec![]]]).unwrap());
    let ring = Adjacency::new(&[vec![vec![2, 1], vec![0, 2], vec![1, 0]]]).unwrap();
    assert_eq!(Adjacency::ring(1, 3), ring);
}

fn panorama(device: &Device) -> UNet2DCondition {
    let mut config = Preset::Debug.unet();
    config.encoder.panels = Panels::JointWidth;
    golden_weights(UNet2DCondition::new(&config.checked().unwrap(), &mut Init::lazy(0, device)))
}

#[test]
fn a_panorama_of_one_view_is_that_view_and_of_several_mixes_them() {
    let device = Device::flex();
    let alone = golden_weights(UNet2DCondition::new(&config(None), &mut Init::lazy(0, &device)));
    let sample = noise("views", [3, 4, 4, 4], &device);
    let context = noise("text", [1, 3, 16], &device).repeat_dim(0, 3);
    let expected = alone.forward(sample.clone(), &[400.0; 3], context).into_data();
    let joint = panorama(&device);
    assert_eq!(predict(&joint, sample.clone(), &Adjacency::chain(3, 1)).into_data(), expected);
    assert_ne!(predict(&joint, sample, &Adjacency::chain(1, 3)).into_data(), expected);
    assert_eq!(reached(&joint, &Adjacency::chain(2, 3), 1), [0, 1, 2], "samples do not meet");
}

/// The first convolution of a panorama continues across the seam; everything before the first norm is local.
#[test]
fn convolutions_of_a_panorama_cross_its_seams() {
    let device = Device::flex();
    let unet = panorama(&device);
    let x = noise("views", [2, 4, 4, 4], &device);
    let joined = stable_diffusion::join_width(x.clone(), 2);
    let whole = stable_diffusion::split_width(unet.conv_in.forward(joined), 2);
    let parts = unet.conv_in.forward(x);
    let column = |t: &Tensor<4>, view: usize, x: usize| t.clone().narrow(0, view, 1).narrow(3, x, 1);
    let differs = |view: usize, x: usize| !column(&whole, view, x).all_close(column(&parts, view, x), None, Some(1e-5));
    assert_eq!([0, 1, 2, 3].map(|x| differs(0, x)), [false, false, false, true]);
    assert_eq!([0, 1, 2, 3].map(|x| differs(1, x)), [true, false, false, false]);
}

#[test]
fn a_controlnet_of_a_panorama_fits_its_unet() {
    let device = Device::flex().autodiff();
    let unet = panorama(&device);
    let mut config = Preset::Debug.controlnet(3);
    config.encoder.panels = Panels::JointWidth;
    let control = golden_weights(ControlNet::new(&config.checked().unwrap(), &mut Init::lazy(0, &device)));
    let views = Adjacency::ring(1, 2);
    let (sample, weights) = (noise("sample", [2, 4, 2, 4], &device), noise("weights", [2, 4, 2, 4], &device));
    let (context, condition) = (noise("text", [2, 3, 16], &device), noise("condition", [2, 3, 8, 16], &device));
    let timesteps = [400.0; 2];
    check_derivative(&control, |control| {
        let (context, condition) = (context.clone(), condition.clone());
        let told = ControlInputs {
            timesteps: &timesteps,
            context: context.clone(),
            condition,
            views: Some(&views),
            scale: 1.0,
        };
        let residuals = control.forward(sample.clone(), &told);
        let told = UNetInputs { timesteps: &timesteps, context, views: Some(&views), control: Some(&residuals) };
        (unet.forward_with(sample.clone(), &told) * weights.clone()).sum()
    });
}

#[test]
#[should_panic(expected = "multiple of 2 wide")]
fn a_view_of_a_panorama_must_divide() {
    let device = Device::flex();
    predict(&panorama(&device), noise("views", [2, 4, 4, 5], &device), &Adjacency::ring(1, 2));
}

#[test]
#[should_panic(expected = "networks that let views meet")]
fn a_missing_adjacency_is_no_silent_skip() {
    let device = Device::flex();
    let unet = unet(NeighbourMerge::Sum, &device);
    unet.forward(noise("views", [2, 4, 4, 4], &device), &[1.0; 2], noise("text", [2, 3, 16], &device));
}
