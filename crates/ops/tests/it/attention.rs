//! `attention`: norms, activations, rotary embedding and attention. Tolerances are those of its README: both sides differ
//! only in the order of f32 sums.

use std::collections::BTreeMap;

use burn::tensor::{Bool, Tensor};

use super::golden::{Golden, device, open};

const OUTPUT: f64 = 1e-5;
const GRADIENT: f64 = 5e-5;

/// Runs one case: leaves by name, output against the file, gradients of all leaves against the file.
struct Case<'a> {
    golden: &'a Golden,
    name: &'a str,
    vectors: BTreeMap<&'a str, Tensor<1>>,
    matrices: BTreeMap<&'a str, Tensor<2>>,
}

impl<'a> Case<'a> {
    fn new(golden: &'a Golden, name: &'a str) -> Self {
        Self { golden, name, vectors: BTreeMap::new(), matrices: BTreeMap::new() }
    }

    fn vector(&mut self, name: &'a str) -> Tensor<1> {
        self.vectors.entry(name).or_insert_with(|| self.golden.leaf(&format!("{}/{name}", self.name))).clone()
    }

    fn vector_if_stored(&mut self, name: &'a str) -> Option<Tensor<1>> {
        self.golden.has(&format!("{}/{name}", self.name)).then(|| self.vector(name))
    }

    fn matrix(&mut self, name: &'a str) -> Tensor<2> {
        self.matrices.entry(name).or_insert_with(|| self.golden.leaf(&format!("{}/{name}", self.name))).clone()
    }

    fn check<const D: usize, const E: usize>(self, inputs: &[(&str, &Tensor<D>)], output: Tensor<E>) {
        let at = |tensor: &str| format!("{}/{tensor}", self.name);
        self.golden.check(&at("output"), output.clone(), OUTPUT);
        let gradients = (output * self.golden.tensor(&at("upstream"))).sum().backward();
        for (name, input) in inputs {
            self.golden.check(&at(&format!("grad_{name}")), input.grad(&gradients).unwrap(), GRADIENT);
        }
        for (name, vector) in &self.vectors {
            self.golden.check(&at(&format!("grad_{name}")), vector.grad(&gradients).unwrap(), GRADIENT);
        }
        for (name, matrix) in &self.matrices {
            self.golden.check(&at(&format!("grad_{name}")), matrix.grad(&gradients).unwrap(), GRADIENT);
        }
    }
}

fn eps(case: &str) -> f32 {
    case.rsplit_once('_').unwrap().1.parse().unwrap()
}

#[test]
fn activations() {
    let Some(golden) = open("attention") else { return };
    for (prefix, function) in [("gelu_exact", ops::gelu as fn(Tensor<1>) -> Tensor<1>), ("silu", ops::silu)] {
        for name in golden.cases(prefix, "x") {
            let x = golden.leaf::<1>(&format!("{name}/x"));
            Case::new(&golden, &name).check(&[("x", &x)], function(x.clone()));
        }
    }
    for name in golden.cases("geglu", "x") {
        let x = golden.leaf::<3>(&format!("{name}/x"));
        let half = x.dims()[2] / 2;
        let output = x.clone().narrow(2, 0, half) * ops::gelu(x.clone().narrow(2, half, half));
        Case::new(&golden, &name).check(&[("x", &x)], output);
    }
}

/// Relative error of GELU against the f64 run, also far in the negative tail where `1 + erf` alone would cancel.
#[test]
fn gelu_is_accurate_in_relative_terms() {
    let Some(golden) = open("attention") else { return };
    for name in golden.cases("gelu_exact", "x") {
        let output = ops::gelu(golden.tensor::<1>(&format!("{name}/x"))).into_data().try_to_vec::<f32>().unwrap();
        let inputs = &golden.get(&format!("{name}/x")).values;
        let expected = &golden.get(&format!("{name}/output.f64")).values;
        for ((&x, &a), &b) in inputs.iter().zip(&output).zip(expected) {
            // Below about -5 the f64 reference itself loses digits to 1 + erf.
            let relative = ((a as f64 - b) / b).abs();
            assert!(
                x < -5.0 || b == 0.0 || relative <= 1e-6,
                "gelu({x}) = {a}, expected {b}, relative error {relative:e}"
            );
        }
    }
}

#[test]
fn norms_over_the_last_axis() {
    let Some(golden) = open("attention") else { return };
    for name in golden.cases("layer_norm", "x") {
        let mut case = Case::new(&golden, &name);
        let x = golden.leaf::<3>(&format!("{name}/x"));
        let (gain, bias) = (case.vector_if_stored("weight"), case.vector_if_stored("bias"));
        case.check(&[("x", &x)], ops::layer_norm(x.clone(), gain, bias, eps(&name)));
    }
    for name in golden.cases("rms_norm", "x") {
        let mut case = Case::new(&golden, &name);
        let x = golden.leaf::<3>(&format!("{name}/x"));
        let gain = case.vector("weight");
        case.check(&[("x", &x)], ops::rms_norm(x.clone(), gain, eps(&name)));
    }
}

#[test]
fn group_norms() {
    let Some(golden) = open("attention") else { return };
    for name in golden.cases("group_norm", "x") {
        let mut case = Case::new(&golden, &name);
        let groups = name.trim_start_matches("group_norm").split('_').next().unwrap().parse().unwrap();
        let x = golden.leaf::<4>(&format!("{name}/x"));
        let (gain, bias) = (case.vector("weight"), case.vector("bias"));
        case.check(&[("x", &x)], ops::group_norm(x.clone(), groups, gain, bias, eps(&name)));
    }
}

/// Tables `[1, N, D/2]` of the stored angles.
fn tables(golden: &Golden, case: &str) -> (Tensor<3>, Tensor<3>) {
    let angles = golden.tensor::<2>(&format!("{case}/angles.f64")).unsqueeze::<3>();
    (angles.clone().cos(), angles.sin())
}

fn interleaved(golden: &Golden) -> Vec<String> {
    let cases = golden.cases("rope_", "x");
    let cases: Vec<String> = cases.into_iter().filter(|name| name.contains("interleaved")).collect();
    assert!(!cases.is_empty());
    cases
}

#[test]
fn rotary_embedding() {
    let Some(golden) = open("attention") else { return };
    for name in interleaved(&golden) {
        let x = golden.leaf::<4>(&format!("{name}/x"));
        let (cos, sin) = tables(&golden, &name);
        Case::new(&golden, &name).check(&[("x", &x)], ops::rotary(x.clone(), cos, sin));
    }
}

fn linear(case: &mut Case, weight: &'static str, bias: &'static str, x: Tensor<3>) -> Tensor<3> {
    let y = x.matmul(case.matrix(weight).transpose().unsqueeze());
    match case.vector_if_stored(bias) {
        Some(bias) => y + bias.unsqueeze(),
        None => y,
    }
}

fn split(x: Tensor<3>, heads: usize) -> Tensor<4> {
    let [b, n, width] = x.dims();
    x.reshape([b, n, heads, width / heads]).swap_dims(1, 2)
}

fn merge(x: Tensor<4>) -> Tensor<3> {
    let [b, heads, n, width] = x.dims();
    x.swap_dims(1, 2).reshape([b, n, heads * width])
}

/// `mask` as `[B, 1, N or 1, K]`.
fn mask(golden: &Golden, case: &str) -> Option<Tensor<4, Bool>> {
    let name = format!("{case}/mask");
    match golden.has(&name).then(|| golden.get(&name).shape.len())? {
        2 => Some(golden.mask::<2>(&name).unsqueeze_dims(&[1, 2])),
        3 => Some(golden.mask::<3>(&name).unsqueeze_dim(1)),
        rank => panic!("mask of rank {rank}"),
    }
}

/// Number of heads, which only the README of the golden folder states.
fn heads(golden: &Golden) -> usize {
    let text = golden.text("README.md");
    let tail = text.split_once("are split into ").expect("the README names the number of heads").1;
    tail.split_whitespace().next().unwrap().parse().unwrap()
}

#[test]
fn attention_with_and_without_masks() {
    let Some(golden) = open("attention") else { return };
    let heads = heads(&golden);
    let mut names = golden.cases("cross", "x");
    names.push("self".to_owned());
    for name in names {
        let mut case = Case::new(&golden, &name);
        let x = golden.leaf::<3>(&format!("{name}/x"));
        let stored_context = format!("{name}/context");
        let context = if golden.has(&stored_context) { golden.leaf(&stored_context) } else { x.clone() };
        let q = split(linear(&mut case, "to_q.weight", "to_q.bias", x.clone()), heads);
        let k = split(linear(&mut case, "to_k.weight", "to_k.bias", context.clone()), heads);
        let v = split(linear(&mut case, "to_v.weight", "to_v.bias", context.clone()), heads);
        let attended = merge(ops::attention(q, k, v, mask(&golden, &name)));
        golden.check(&format!("{name}/attended"), attended.clone(), OUTPUT);
        let output = linear(&mut case, "to_out.weight", "to_out.bias", attended);
        let mut inputs = vec![("x", &x)];
        if golden.has(&stored_context) {
            inputs.push(("context", &context));
        }
        case.check(&inputs, output);
    }
}

#[test]
fn attention_with_rms_and_rotary() {
    let Some(golden) = open("attention") else { return };
    let name = "self_rms_rope";
    let mut case = Case::new(&golden, name);
    let x = golden.leaf::<3>(&format!("{name}/x"));
    let (q_gain, k_gain) = (case.vector("q_norm.weight"), case.vector("k_norm.weight"));
    let heads = x.dims()[2] / q_gain.dims()[0];
    let (cos, sin) = tables(&golden, "rope_yx_interleaved_10000");
    let turn = |x: Tensor<3>, gain| ops::rotary(ops::rms_norm(split(x, heads), gain, 1e-6), cos.clone(), sin.clone());
    let q = turn(linear(&mut case, "to_q.weight", "to_q.bias", x.clone()), q_gain);
    let k = turn(linear(&mut case, "to_k.weight", "to_k.bias", x.clone()), k_gain);
    let v = split(linear(&mut case, "to_v.weight", "to_v.bias", x.clone()), heads);
    let attended = merge(ops::attention(q, k, v, None));
    golden.check(&format!("{name}/attended"), attended.clone(), OUTPUT);
    let output = linear(&mut case, "to_out.weight", "to_out.bias", attended);
    case.check(&[("x", &x)], output);
    assert_eq!(x.device(), device());
}
