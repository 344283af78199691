//! Element types of stored tensors and their conversion.

use half::{bf16, f16};
use safetensors::Dtype;

/// Bytes of one element; types of less than a byte are never read.
pub(super) fn width(dtype: Dtype) -> usize {
    dtype.bitsize() / 8
}

/// Appends the elements of some bytes.
pub(super) type Widen<T> = fn(&[u8], &mut Vec<T>);

/// How elements of a float type become f32; none for other types.
pub(super) fn widen(dtype: Dtype) -> Option<Widen<f32>> {
    Some(match dtype {
        Dtype::F64 => |bytes, out| out.extend(bytes.as_chunks().0.iter().map(|b| f64::from_le_bytes(*b) as f32)),
        Dtype::F32 => |bytes, out| out.extend(bytes.as_chunks().0.iter().map(|b| f32::from_le_bytes(*b))),
        Dtype::F16 => |bytes, out| out.extend(bytes.as_chunks().0.iter().map(|b| f16::from_le_bytes(*b).to_f32())),
        Dtype::BF16 => |bytes, out| out.extend(bytes.as_chunks().0.iter().map(|b| bf16::from_le_bytes(*b).to_f32())),
        _ => return None,
    })
}

/// How elements of an integer type become i64; none for other types.
pub(super) fn integers_of(dtype: Dtype) -> Option<Widen<i64>> {
    Some(match dtype {
        Dtype::BOOL | Dtype::U8 => |bytes, out| out.extend(bytes.iter().map(|b| i64::from(*b))),
        Dtype::I8 => |bytes, out| out.extend(bytes.iter().map(|b| i64::from(b.cast_signed()))),
        Dtype::I16 => |bytes, out| out.extend(bytes.as_chunks().0.iter().map(|b| i64::from(i16::from_le_bytes(*b)))),
        Dtype::I32 => |bytes, out| out.extend(bytes.as_chunks().0.iter().map(|b| i64::from(i32::from_le_bytes(*b)))),
        Dtype::I64 => |bytes, out| out.extend(bytes.as_chunks().0.iter().map(|b| i64::from_le_bytes(*b))),
        _ => return None,
    })
}
