//! Vectorised inner loops without intrinsics.
//!
//! A loop over plain slices is compiled once per instruction set and the widest one the processor has is chosen at run
//! time. Additions and multiplications have a fixed order, and they are fused where the source says `mul_add` and nowhere
//! else, so that every instruction set gives the same bits.

/// Defines a function whose body is compiled for AVX-512, AVX2 and the portable baseline.
///
/// `vectorized! { fn name[const C: usize](x: &[f32]) -> f32 { … } }`; the brackets hold a lifetime or const parameters and may be empty.
macro_rules! vectorized {
    ($(#[$meta:meta])* $vis:vis fn $name:ident[$($life:lifetime)? $(const $param:ident: usize),*]($($arg:ident: $ty:ty),* $(,)?) $(-> $ret:ty)?
     $body:block) => {
        $(#[$meta])*
        #[allow(unsafe_code)]
        #[allow(clippy::too_many_arguments)]
        $vis fn $name<$($life,)? $(const $param: usize),*>($($arg: $ty),*) $(-> $ret)? {
            #[inline(always)]
            #[allow(clippy::too_many_arguments)]
            fn body<$($life,)? $(const $param: usize),*>($($arg: $ty),*) $(-> $ret)? $body

            #[cfg(target_arch = "x86_64")]
            {
                #[target_feature(enable = "avx2,fma")]
                #[allow(clippy::too_many_arguments)]
                fn avx2<$($life,)? $(const $param: usize),*>($($arg: $ty),*) $(-> $ret)? {
                    body::<$($param),*>($($arg),*)
                }
                #[target_feature(enable = "avx512f,avx512bw,avx512dq,avx512vl")]
                #[allow(clippy::too_many_arguments)]
                fn avx512<$($life,)? $(const $param: usize),*>($($arg: $ty),*) $(-> $ret)? {
                    body::<$($param),*>($($arg),*)
                }
                if $crate::fused::has_avx512() {
                    // SAFETY: the processor has just been found to have the enabled features.
                    return unsafe { avx512::<$($param),*>($($arg),*) };
                }
                if $crate::fused::has_avx2() {
                    // SAFETY: as above.
                    return unsafe { avx2::<$($param),*>($($arg),*) };
                }
            }
            body::<$($param),*>($($arg),*)
        }
    };
}
pub(crate) use vectorized;

/// Whether the processor has the parts of AVX-512 that [`vectorized`] enables.
#[cfg(target_arch = "x86_64")]
#[inline]
pub(crate) fn has_avx512() -> bool {
    std::arch::is_x86_feature_detected!("avx512f")
        && std::arch::is_x86_feature_detected!("avx512bw")
        && std::arch::is_x86_feature_detected!("avx512dq")
        && std::arch::is_x86_feature_detected!("avx512vl")
}

/// Whether the processor has AVX2 and fused multiplication and addition.
#[cfg(target_arch = "x86_64")]
#[inline]
pub(crate) fn has_avx2() -> bool {
    std::arch::is_x86_feature_detected!("avx2") && std::arch::is_x86_feature_detected!("fma")
}

/// Partial sums of a reduction: four vectors of 8, so that long sums are not bound by the latency of one addition.
const LANES: usize = 32;
/// Elements of the shorter blocks that follow; 8 channels per head are common.
const SHORT: usize = 8;

/// Sum of `term(a[i], b[i])` in an order that depends on the length alone.
#[inline(always)]
fn reduce(a: &[f32], b: &[f32], term: impl Fn(f32, f32) -> f32) -> f32 {
    let ((a_long, a), (b_long, b)) = (a.as_chunks::<LANES>(), b.as_chunks::<LANES>());
    let mut lanes = [0.0; SHORT];
    if !a_long.is_empty() {
        let mut long = [0.0; LANES];
        for (x, y) in a_long.iter().zip(b_long) {
            for i in 0..LANES {
                long[i] += term(x[i], y[i]);
            }
        }
        for i in 0..SHORT {
            lanes[i] = (long[i] + long[i + SHORT]) + (long[i + 2 * SHORT] + long[i + 3 * SHORT]);
        }
    }
    let ((a_short, a), (b_short, b)) = (a.as_chunks::<SHORT>(), b.as_chunks::<SHORT>());
    for (x, y) in a_short.iter().zip(b_short) {
        for i in 0..SHORT {
            lanes[i] += term(x[i], y[i]);
        }
    }
    for ((lane, &x), &y) in lanes.iter_mut().zip(a).zip(b) {
        *lane += term(x, y);
    }
    let [a, b, c, d, e, f, g, h] = lanes;
    ((a + e) + (b + f)) + ((c + g) + (d + h))
}

/// The largest element; NaN is passed over, and without any other element the result is -∞.
#[inline(always)]
pub(crate) fn largest(a: &[f32]) -> f32 {
    let (long, rest) = a.as_chunks::<LANES>();
    let mut lanes = [f32::NEG_INFINITY; LANES];
    for block in long {
        for i in 0..LANES {
            lanes[i] = if block[i] > lanes[i] { block[i] } else { lanes[i] };
        }
    }
    let mut length = LANES;
    while length > SHORT {
        length /= 2;
        for i in 0..length {
            lanes[i] = if lanes[i + length] > lanes[i] { lanes[i + length] } else { lanes[i] };
        }
    }
    let rest = rest.iter().chain(&lanes[..SHORT]);
    rest.fold(f32::NEG_INFINITY, |largest, &x| if x > largest { x } else { largest })
}

/// Sum of `a`.
#[inline(always)]
pub(crate) fn sum(a: &[f32]) -> f32 {
    reduce(a, a, |x, _| x)
}

/// Sum of `a[i]·b[i]`.
#[inline(always)]
pub(crate) fn sum_of_products(a: &[f32], b: &[f32]) -> f32 {
    reduce(a, b, |x, y| x * y)
}

/// Sum of `(a[i] - centre)²`.
#[inline(always)]
pub(crate) fn sum_of_squares(a: &[f32], centre: f32) -> f32 {
    reduce(a, a, |x, _| (x - centre) * (x - centre))
}

/// `exp(high - low)` for `high ≤ 0` and small `low`, relative error below 2e-7; 0 below -87.
///
/// Taking the exponent as a difference lets callers pass more digits than one f32 holds. Reduction to
/// `2^n · exp(r)`, `|r| ≤ ln 2 / 2`, with a degree-6 minimax polynomial (fitted in 40 digits, relative error 2e-8).
#[inline(always)]
pub(crate) fn exp_difference(high: f32, low: f32) -> f32 {
    /// Adding and subtracting 1.5·2²³ rounds to an integer without a library call on any instruction set.
    const ROUND: f32 = 12_582_912.0;
    const LN_2_HIGH: f32 = 0.693_359_4;
    const LN_2_LOW: f32 = -2.121_944_4e-4;
    let shifted = high.mul_add(std::f32::consts::LOG2_E, ROUND);
    let n = shifted - ROUND;
    let r = n.mul_add(-LN_2_LOW, n.mul_add(-LN_2_HIGH, high)) - low;
    let mut p = 0.001_394_110_8_f32;
    p = p.mul_add(r, 0.008_375_126);
    p = p.mul_add(r, 0.041_666_35);
    p = p.mul_add(r, 0.166_664_15);
    p = p.mul_add(r, 0.5);
    p = p.mul_add(r, 1.0);
    p = p.mul_add(r, 1.0);
    let exponent = (shifted.to_bits() as i32).wrapping_sub(ROUND.to_bits() as i32).wrapping_add(127);
    let scale = f32::from_bits((exponent << 23) as u32);
    // Written so that NaN fails the comparison and stays NaN.
    if high < -87.0 { 0.0 } else { p * scale }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn exponential_is_accurate() {
        for i in 0..=86_000 {
            let x = -(i as f32) * 1e-3;
            let expected = (x as f64).exp();
            let relative = (exp_difference(x, 0.0) as f64 - expected).abs() / expected;
            assert!(relative < 2e-7, "exp({x}): relative error {relative:e}");
        }
        assert_eq!(exp_difference(-1000.0, 0.0), 0.0);
        assert!(exp_difference(f32::NAN, 0.0).is_nan());
    }

    #[test]
    fn reductions_cover_every_element() {
        for length in 0..70 {
            let a: Vec<f32> = (0..length).map(|i| i as f32).collect();
            let expected: usize = (0..length).sum();
            assert_eq!(sum(&a), expected as f32);
            let expected: usize = (0..length).map(|i| i * i).sum();
            assert_eq!(sum_of_products(&a, &a), expected as f32);
            assert_eq!(largest(&a), a.last().copied().unwrap_or(f32::NEG_INFINITY));
        }
    }
}
