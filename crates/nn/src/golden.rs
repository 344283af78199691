//! Weights made from their own names, so that a parity test needs no weight file.
//!
//! The rule: FNV-1a 64 of the parameter's name seeds a splitmix64 stream, its upper 24 bits become `x` in [-1, 1), and
//! the name's ending together with the rank decides how `x` becomes a value. The same rule is a dozen lines in any
//! other framework, which is how the reference outputs under `tests/golden` were made.

/// FNV-1a 64 of the UTF-8 bytes of `text`.
#[must_use]
pub fn fnv1a64(text: &str) -> u64 {
    const OFFSET: u64 = 0xcbf2_9ce4_8422_2325;
    const PRIME: u64 = 0x0000_0100_0000_01b3;
    text.bytes().fold(OFFSET, |hash, byte| (hash ^ u64::from(byte)).wrapping_mul(PRIME))
}

/// Word `index` of the splitmix64 stream that starts at `seed`.
fn word(seed: u64, index: u64) -> u64 {
    let mut z = seed.wrapping_add((index.wrapping_add(1)).wrapping_mul(0x9E37_79B9_7F4A_7C15));
    z = (z ^ (z >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
    z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
    z ^ (z >> 31)
}

/// The first `n` raw values `x` of the stream of `name`, each in [-1, 1) with 24 significant bits (exact in f32).
#[must_use]
pub fn golden_stream(name: &str, n: usize) -> Vec<f64> {
    let seed = fnv1a64(name);
    (0..n as u64).map(|index| unit(word(seed, index))).collect()
}

fn unit(word: u64) -> f64 {
    // The shift leaves 24 bits, so both the conversion and the division by a power of two are exact.
    2.0 * ((word >> 40) as f64 / f64::from(1 << 24)) - 1.0
}

/// Golden values of a parameter under its PyTorch state-dict name.
///
/// # Shapes
/// - shape: the PyTorch shape (`Linear.weight` is `[out, in]`); a framework that stores the transpose computes these
///   values first and transposes afterwards
/// - output: row-major, `product(shape)` values
#[must_use]
pub fn golden_values(name: &str, shape: &[usize]) -> Vec<f32> {
    golden_values_with_gains(name, shape, &[])
}

/// As [`golden_values`], but vectors whose name ends in one of `gain_suffixes` are gains around one (`1 + 0.1 x`).
///
/// The BEV-VAE reference uses `[".scale"]`: with gains near zero its query and key norms would make attention uniform
/// and hide rotary position mistakes.
#[must_use]
pub fn golden_values_with_gains(name: &str, shape: &[usize], gain_suffixes: &[&str]) -> Vec<f32> {
    let rule = ValueRule::of(name, shape, gain_suffixes);
    let seed = fnv1a64(name);
    let count: usize = shape.iter().product();
    (0..count as u64).map(|index| rule.value(unit(word(seed, index))) as f32).collect()
}

/// How a raw `x` becomes a value.
enum ValueRule {
    /// `x` times this factor: matrices, kernels and tables keep unit variance through a sum over their fan-in.
    Scaled(f64),
    /// `1 + 0.1 x`
    Gain,
    /// `1 + 0.1 |x|`, never negative
    Variance,
    /// Integer counters stay at zero.
    Zero,
    /// `0.1 x`
    Small,
}

impl ValueRule {
    fn of(name: &str, shape: &[usize], gain_suffixes: &[&str]) -> Self {
        if shape.len() >= 2 {
            let fan_in: usize = shape[1..].iter().product();
            return Self::Scaled((3.0 / fan_in as f64).sqrt());
        }
        let is_gain = ["weight", "gamma"].iter().chain(gain_suffixes).any(|suffix| name.ends_with(suffix));
        if name.ends_with("running_var") {
            Self::Variance
        } else if name.ends_with("num_batches_tracked") {
            Self::Zero
        } else if is_gain {
            Self::Gain
        } else {
            Self::Small
        }
    }

    fn value(&self, x: f64) -> f64 {
        match self {
            Self::Scaled(factor) => x * factor,
            Self::Gain => 1.0 + 0.1 * x,
            Self::Variance => 1.0 + 0.1 * x.abs(),
            Self::Zero => 0.0,
            Self::Small => 0.1 * x,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn fnv_check_values() {
        assert_eq!(fnv1a64(""), 0xcbf2_9ce4_8422_2325);
        assert_eq!(fnv1a64("a"), 0xaf63_dc4c_8601_ec8c);
        assert_eq!(fnv1a64("foobar"), 0x8594_4171_f739_67e8);
    }

    #[test]
    fn self_test_table_is_bit_exact() {
        type Row = (&'static str, &'static [usize], usize, u64, u64, u32);
        let table: [Row; 10] = [
            ("weight", &[4], 0, 0x6911f8de1f27bf19, 0x0dcb1fdcb8faa6c0, 0x3f6928a0),
            ("bias", &[4], 3, 0xdeb23f9bd0a849a4, 0x194100e861155945, 0xbda464cd),
            ("conv_in.weight", &[32, 4, 3, 3], 0, 0x1ce69906bdc574a7, 0x923d71e7a6b08ca4, 0x3d287e74),
            ("conv_in.weight", &[32, 4, 3, 3], 1151, 0x1ce69906bdc574a7, 0x6af9f32c17e80e33, 0xbd423541),
            ("down_blocks.0.resnets.0.norm1.weight", &[32], 31, 0x77e2d8364af253ef, 0x4b5838b6eb8e025d, 0x3f75780b),
            ("bn.running_var", &[8], 5, 0xb775ae3b4fc2588a, 0x11ba8a345165bf43, 0x3f8b06f2),
            ("bn.num_batches_tracked", &[], 0, 0x43a1e0e13e115135, 0x846c644146960145, 0),
            ("layer.gamma", &[6], 2, 0x0fb65ccff6988539, 0x0c0874305702e8e3, 0x3f68ce7e),
            ("scale", &[], 0, 0x6aacb9fbb71a1d91, 0x896ef4129c73b7ce, 0x3bf17ecd),
            ("pos_embed", &[1, 16, 8], 77, 0x299f5568d6876baf, 0x8f2b43a0c37ea478, 0x3c94a00a),
        ];
        for (name, shape, index, seed, z, bits) in table {
            assert_eq!(fnv1a64(name), seed, "{name}");
            assert_eq!(word(seed, index as u64), z, "{name}");
            assert_eq!(golden_values(name, shape)[index].to_bits(), bits, "{name}[{index}]");
        }
    }

    #[test]
    fn gain_suffixes_touch_vectors_only() {
        let x = golden_stream("q_norm.scale", 3);
        let gains = golden_values_with_gains("q_norm.scale", &[3], &[".scale"]);
        let plain = golden_values("q_norm.scale", &[3]);
        for i in 0..3 {
            assert_eq!(gains[i], (1.0 + 0.1 * x[i]) as f32);
            assert_eq!(plain[i], (0.1 * x[i]) as f32);
        }
        let matrix = golden_values_with_gains("q_norm.scale", &[1, 3], &[".scale"]);
        assert_eq!(matrix, x.iter().map(|&x| x as f32).collect::<Vec<_>>());
    }
}
