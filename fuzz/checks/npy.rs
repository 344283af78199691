//! Any bytes are refused or give an array whose elements are all there, and what it holds survives being written again.

use std::path::Path;

use data::npz::{Dtype, Want, npy_bytes, parse_npy};

const SHAPES: [&[Option<usize>]; 5] = [&[], &[None], &[None, None], &[None, Some(3)], &[None, Some(4), None, None]];

/// What must hold for any bytes.
pub fn check(bytes: &[u8]) {
    let path = Path::new("x.npy");
    for shape in SHAPES {
        let Ok(array) = parse_npy(bytes, path, &Want { dtypes: &Dtype::ALL, shape }) else { continue };
        let (dtype, shape) = (array.dtype(), array.shape().to_vec());
        assert_eq!(shape.iter().product::<usize>(), array.len());
        assert!(array.len() * dtype.size() < bytes.len());
        let floats = array.to_f64();
        assert_eq!(floats.len(), array.len());
        if let Ok(integers) = array.to_i64() {
            assert_eq!(integers.len(), array.len());
        }
        let Ok(elements) = array.into_u8() else { continue };
        let lengths: Vec<Option<usize>> = shape.iter().copied().map(Some).collect();
        let again = npy_bytes(dtype, &shape, &elements).expect("an array that was read");
        let again =
            parse_npy(&again, path, &Want { dtypes: &[dtype], shape: &lengths }).expect("what is written is read");
        assert_eq!(again.into_u8().expect("bytes"), elements);
    }
}
