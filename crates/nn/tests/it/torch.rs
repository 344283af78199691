//! Files that PyTorch wrote (`tests/peers/torch_fixtures.py`): every packing, element type and memory layout.

use std::path::{Path, PathBuf};

use nn::weights::{HostTensor, TensorGroup, TorchFault, WeightError, WeightFile, torch_groups};

pub fn fixture(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/fixtures").join(name)
}

fn open(name: &str) -> WeightFile {
    WeightFile::open(fixture(name)).unwrap()
}

#[test]
fn every_element_type_reads_in_every_packing() {
    for name in ["types.pth", "types_legacy.pth", "types_protocol4.bin"] {
        let file = open(name);
        for float in ["float64", "float32", "float16", "bfloat16"] {
            let tensor = file.tensor(float).unwrap();
            assert_eq!(tensor, HostTensor::new(&[4], vec![-2.0, 0.0, 1.5, 3.0]), "{name} {float}");
            assert!(matches!(file.integers(float), Err(WeightError::ElementType { .. })));
        }
        for integer in ["int64", "int32", "int16", "int8"] {
            assert_eq!(file.integers(integer).unwrap(), (vec![4], vec![-2, 0, 1, 3]), "{name} {integer}");
            assert!(matches!(file.tensor(integer), Err(WeightError::ElementType { .. })));
        }
        assert_eq!(file.integers("uint8").unwrap().1, [0, 1, 2, 255]);
        assert_eq!(file.integers("bool").unwrap().1, [1, 0]);
        assert_eq!(file.names().count(), 10);
        assert_eq!(file.read_all().unwrap().len(), 4, "integers are no weights");
        assert!(file.metadata().is_empty());
    }
}

#[test]
fn strided_shared_and_empty_tensors_become_row_major() {
    for name in ["layouts.pth", "layouts_legacy.pth"] {
        let file = open(name);
        let expect = |name: &str, shape: &[usize], values: &[f32]| {
            assert_eq!(file.tensor(name).unwrap(), HostTensor::new(shape, values.to_vec()), "{name}");
            assert_eq!(file.shape(name), Some(shape));
        };
        expect("whole", &[3, 4], &[0., 1., 2., 3., 4., 5., 6., 7., 8., 9., 10., 11.]);
        expect("transposed", &[4, 3], &[0., 4., 8., 1., 5., 9., 2., 6., 10., 3., 7., 11.]);
        expect("columns", &[3, 2], &[1., 2., 5., 6., 9., 10.]);
        expect("every_second", &[6], &[1., 3., 5., 7., 9., 11.]);
        expect("empty", &[0, 3], &[]);
        expect("scalar", &[], &[7.]);
        expect("parameter", &[2], &[1., 2.]);
        assert_eq!(file.others(), ["_extra_state"]);
    }
}

#[test]
fn a_lightning_checkpoint_gives_its_state_dict_and_leaves_the_rest_alone() {
    let file = open("lightning.ckpt");
    assert_eq!(file.names().collect::<Vec<_>>(), ["matcher.bias", "matcher.weight"]);
    let file = file.without_prefix("net.").without_prefix("matcher.");
    assert_eq!(file.tensor("weight").unwrap(), HostTensor::new(&[1, 2], vec![0.5, -0.5]));
    assert_eq!(file.tensor("bias").unwrap().data, [0.25]);
}

#[test]
fn a_nested_state_dict_is_found_by_its_keys() {
    assert_eq!(open("only_one.pt").tensor("w").unwrap().data, [1.0]);
    let error = WeightFile::open(fixture("several.pt")).unwrap_err().to_string();
    assert!(error.contains("name one of ema, net") && error.ends_with("several.pt"), "{error}");
    let inner = WeightFile::open_nested(fixture("several.pt"), &["model", "inner"]).unwrap();
    assert_eq!(inner.tensor("w").unwrap().data, [2.0]);
    let error = WeightFile::open_nested(fixture("several.pt"), &["model", "outer"]).unwrap_err().to_string();
    assert!(error.contains("no dictionary or list under model/outer; there are ema, model, net"), "{error}");
}

#[test]
fn every_place_of_tensors_is_listed_and_opens() {
    let path = fixture("lightning.ckpt");
    let groups = torch_groups(&path).unwrap();
    let place = |group: &TensorGroup| group.keys.join("/");
    let expected =
        ["state_dict", "optimizer_states/0/state/0", "optimizer_states/0/state/1", "callbacks/__main__.Node"];
    assert_eq!(groups.iter().map(place).collect::<Vec<_>>(), expected);
    assert_eq!(groups[0].names, ["matcher.weight", "matcher.bias"], "the order of the file");
    for group in &groups {
        let keys: Vec<&str> = group.keys.iter().map(String::as_str).collect();
        let file = WeightFile::open_nested(&path, &keys).unwrap();
        assert!(file.names_in_order().eq(group.names.iter().map(String::as_str)) && !group.is_list);
    }
    let own = Path::new(env!("CARGO_MANIFEST_DIR")).join("Cargo.toml");
    assert!(matches!(torch_groups(own), Err(WeightError::Layout { .. })));
}

fn fault(name: &str) -> TorchFault {
    match WeightFile::open(fixture(name)).unwrap_err() {
        WeightError::Torch { source, path } if path.ends_with(name) => source,
        other => panic!("{other}"),
    }
}

#[test]
fn what_is_no_state_dict_is_named() {
    let module = fault("module.pt").to_string();
    assert!(
        module.contains("an instance of torch.nn.modules.linear.Linear; save the model's state_dict()"),
        "{module}"
    );
    let script = fault("script.pt");
    assert!(matches!(&script, TorchFault::Container(reason) if reason.contains("TorchScript")), "{script}");
    let expanded = fault("expanded.pth");
    assert!(matches!(&expanded, TorchFault::Tensor { name, .. } if name == "w"), "{expanded}");
}
