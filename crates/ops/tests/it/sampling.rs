//! `sampling_ops`: grid sampling and multi-scale deformable sampling. Tolerances are those of its README: both sides round
//! the pixel coordinate differently and a coordinate's gradient is multiplied by the map size.

use burn::tensor::{Tensor, activation};
use ops::Interpolation;

use super::golden::{Golden, open};

const OUTPUT: f64 = 2e-5;
const GRADIENT: f64 = 1e-4;

#[test]
fn grids_of_maps() {
    let Some(golden) = open("sampling_ops") else { return };
    for run in golden.cases("grid2d", "output") {
        let (case, options) = run.split_once('/').unwrap();
        let (mode, align) = options.split_once(".align_").unwrap();
        let mode = match mode {
            "bilinear" => Interpolation::Bilinear,
            "nearest" => Interpolation::Nearest,
            other => panic!("mode {other}"),
        };
        let input = golden.leaf::<4>(&format!("{case}/input"));
        let grid = golden.leaf::<4>(&format!("{case}/grid"));
        let output = ops::grid_sample_2d(input.clone(), grid.clone(), align.parse().unwrap(), mode);
        golden.check(&format!("{run}/output"), output.clone(), OUTPUT);
        let mut gradients = (output * golden.tensor(&format!("{case}/upstream"))).sum().backward();
        golden.check(&format!("{run}/grad_input"), to_tape(input.grad_remove(&mut gradients).unwrap()), GRADIENT);
        let grad_grid = grid.grad_remove(&mut gradients).map_or(grid.zeros_like(), to_tape);
        golden.check(&format!("{run}/grad_grid"), grad_grid, GRADIENT);
    }
}

#[test]
fn grids_of_volumes() {
    let Some(golden) = open("sampling_ops") else { return };
    for run in golden.cases("grid3d", "output") {
        let (case, options) = run.split_once('/').unwrap();
        assert_eq!(options, "bilinear.align_false", "the only option of volumes");
        let input = golden.leaf::<5>(&format!("{case}/input"));
        let grid = golden.leaf::<5>(&format!("{case}/grid"));
        let output = ops::grid_sample_3d(input.clone(), grid.clone());
        golden.check(&format!("{run}/output"), output.clone(), OUTPUT);
        let gradients = (output * golden.tensor(&format!("{case}/upstream"))).sum().backward();
        golden.check(&format!("{run}/grad_input"), input.grad(&gradients).unwrap(), GRADIENT);
        golden.check(&format!("{run}/grad_grid"), grid.grad(&gradients).unwrap(), GRADIENT);
    }
}

fn to_tape<const D: usize>(x: Tensor<D>) -> Tensor<D> {
    Tensor::from_data(x.into_data(), &super::golden::device())
}

#[test]
fn deformable_maps() {
    let Some(golden) = open("sampling_ops") else { return };
    for case in golden.cases("deform2d", "values") {
        let shapes = shapes::<2>(&golden, &case);
        deformable(&golden, &case, |values, locations, weights| {
            ops::deformable_sample_2d(values, &shapes, locations, weights, None)
        });
    }
}

#[test]
fn deformable_volumes() {
    let Some(golden) = open("sampling_ops") else { return };
    for case in golden.cases("deform3d", "values") {
        let shapes = shapes::<3>(&golden, &case);
        deformable(&golden, &case, |values, locations, weights| {
            ops::deformable_sample_3d(values, &shapes, locations, weights, None)
        });
    }
}

fn shapes<const A: usize>(golden: &Golden, case: &str) -> Vec<[usize; A]> {
    let stored = golden.get(&format!("{case}/spatial_shapes"));
    let sizes: Vec<usize> = stored.values.iter().map(|&v| v as usize).collect();
    sizes.as_chunks::<A>().0.to_vec()
}

fn deformable(golden: &Golden, case: &str, sample: impl Fn(Tensor<4>, Tensor<6>, Tensor<5>) -> Tensor<3>) {
    let values = golden.leaf::<4>(&format!("{case}/values"));
    let locations = golden.leaf::<6>(&format!("{case}/locations"));
    let logits = golden.leaf::<4>(&format!("{case}/weight_logits"));
    let weights =
        activation::softmax(logits.clone(), 3).reshape(<[usize; 5]>::try_from(&locations.dims()[..5]).unwrap());
    let output = sample(values.clone(), locations.clone(), weights.clone());
    golden.check(&format!("{case}/output"), output.clone(), OUTPUT);
    let upstream = golden.tensor(&format!("{case}/upstream"));
    let gradients = (output * upstream.clone()).sum().backward();
    golden.check(&format!("{case}/grad_values"), values.grad(&gradients).unwrap(), GRADIENT);
    golden.check(&format!("{case}/grad_locations"), locations.grad(&gradients).unwrap(), GRADIENT);
    golden.check(&format!("{case}/grad_weight_logits"), logits.grad(&gradients).unwrap(), GRADIENT);

    // The gradient at the softmax output, with the stored weights as leaves.
    let weights = golden.leaf::<5>(&format!("{case}/weights"));
    let gradients = (sample(values, locations, weights.clone()) * upstream).sum().backward();
    golden.check(&format!("{case}/grad_weights"), weights.grad(&gradients).unwrap(), GRADIENT);
}
