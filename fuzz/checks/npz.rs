//! Any bytes are refused or give arrays no larger than their bytes can hold, and what they hold survives being written again.

use std::path::Path;

use data::npz::{Dtype, Npz, Want, npz_bytes};

const WANT: Want<'static> = Want { dtypes: &Dtype::ALL, shape: &[None, None] };

/// What must hold for any bytes.
pub fn check(bytes: &[u8]) {
    let path = Path::new("x.npz");
    let Ok(mut npz) = Npz::parse(bytes.to_vec(), path) else { return };
    for name in ["semantics", "mask_camera", "a"] {
        let Ok(array) = npz.array(name, &WANT) else { continue };
        assert_eq!(array.shape().iter().product::<usize>(), array.len());
        // Deflate packs at most about a thousand to one.
        assert!(array.len() * array.dtype().size() <= bytes.len() * 1100);
        let (shape, floats) = (array.shape().to_vec(), array.to_f64());
        let raw: Vec<u8> = floats.iter().flat_map(|value| value.to_le_bytes()).collect();
        let again = npz_bytes(&[("a", Dtype::F64, &shape, &raw)]).expect("an array that was read");
        let again = Npz::parse(again, path).and_then(|mut npz| npz.array("a", &WANT)).expect("what is written is read");
        let bits = |values: &[f64]| values.iter().map(|value| value.to_bits()).collect::<Vec<_>>();
        assert_eq!(bits(&again.to_f64()), bits(&floats));
    }
}
