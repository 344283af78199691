//! Sums without rounding, so that shards merge to the same bits in any order.
//!
//! A fixed-point number as wide as the range of f64 (Kulisch, "Computer Arithmetic and Validity", chapter 8).

use serde::{Deserialize, Serialize};

/// Bits of a digit.
const DIGIT: u32 = 32;
/// Digits from 2^-1074 to beyond 2^1024 times 2^62 addends.
const DIGITS: usize = 69;
/// Addends between two carries; a digit grows by less than 2^32 with each.
const BETWEEN_CARRIES: u32 = 1 << 29;
/// Exponent of the lowest bit.
const LOWEST: i32 = -1074;

/// The exact sum of any number of f64, rounded once when it is [read](ExactSum::value).
#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(try_from = "Stored", into = "Stored")]
pub struct ExactSum {
    /// Base 2^32, lowest first; between carries digits may be negative or too large.
    digits: Vec<i64>,
    uncarried: u32,
    /// What NaN and infinities among the addends come to; 0 without any.
    special: f64,
}

/// The carried digits as they are stored.
#[derive(Clone, Serialize, Deserialize)]
struct Stored {
    digits: Vec<i64>,
    special: f64,
}

impl Default for ExactSum {
    fn default() -> Self {
        Self { digits: vec![0; DIGITS], uncarried: 0, special: 0.0 }
    }
}

impl ExactSum {
    /// Adds one number.
    pub fn add(&mut self, value: f64) {
        if !value.is_finite() {
            self.special += value;
            return;
        }
        let bits = value.to_bits();
        let exponent = (bits >> 52 & 0x7ff) as u32;
        let fraction = bits & ((1 << 52) - 1);
        // Subnormal numbers have the exponent of the smallest normal ones and no hidden bit.
        let (place, mantissa) = if exponent == 0 { (0, fraction) } else { (exponent - 1, fraction | 1 << 52) };
        let mut wide = u128::from(mantissa) << (place % DIGIT);
        let first = (place / DIGIT) as usize;
        let negative = value.is_sign_negative();
        for digit in self.digits.iter_mut().skip(first).take(3) {
            let part = (wide & 0xffff_ffff) as i64;
            *digit += if negative { -part } else { part };
            wide >>= DIGIT;
        }
        self.uncarried += 1;
        if self.uncarried >= BETWEEN_CARRIES {
            self.carry();
        }
    }

    /// Adds another sum.
    pub fn merge(&mut self, other: &Self) {
        self.carry();
        let mut other = other.clone();
        other.carry();
        self.digits.iter_mut().zip(&other.digits).for_each(|(a, b)| *a += b);
        self.special += other.special;
        self.carry();
    }

    /// The sum, rounded to the nearest f64.
    #[must_use]
    pub fn value(&self) -> f64 {
        if self.special != 0.0 {
            return self.special;
        }
        let mut sum = self.clone();
        sum.carry();
        let negative = sum.digits.last().is_some_and(|top| *top < 0);
        if negative {
            sum.digits.iter_mut().for_each(|digit| *digit = -*digit);
            sum.carry();
        }
        let Some(top) = sum.digits.iter().rposition(|digit| *digit != 0) else { return 0.0 };
        let low = top.saturating_sub(2);
        let (below, leading) = sum.digits.split_at(low);
        let mut wide = leading.iter().rev().fold(0_u128, |wide, digit| wide << DIGIT | *digit as u128);
        // A set lowest bit tells the rounding that something lies below.
        wide |= u128::from(below.iter().any(|digit| *digit != 0));
        let exponent = LOWEST + (low as u32 * DIGIT) as i32;
        // In two steps, because 2^exponent alone may leave the range.
        let magnitude = wide as f64 * 2.0_f64.powi(exponent / 2) * 2.0_f64.powi(exponent - exponent / 2);
        if negative { -magnitude } else { magnitude }
    }

    /// Brings every digit but the top one into [0, 2^32): one representation per value.
    fn carry(&mut self) {
        let mut carried = 0;
        let Some((top, rest)) = self.digits.split_last_mut() else { return };
        for digit in rest {
            let sum = *digit + carried;
            carried = sum >> DIGIT;
            *digit = sum & 0xffff_ffff;
        }
        *top += carried;
        self.uncarried = 0;
    }
}

impl PartialEq for ExactSum {
    fn eq(&self, other: &Self) -> bool {
        let (mut a, mut b) = (self.clone(), other.clone());
        a.carry();
        b.carry();
        a.digits == b.digits && a.special.to_bits() == b.special.to_bits()
    }
}

impl From<ExactSum> for Stored {
    fn from(mut sum: ExactSum) -> Self {
        sum.carry();
        Self { digits: sum.digits, special: sum.special }
    }
}

impl TryFrom<Stored> for ExactSum {
    type Error = String;

    fn try_from(stored: Stored) -> Result<Self, String> {
        let carried = stored.digits.iter().rev().skip(1).all(|digit| (0..1 << DIGIT).contains(digit));
        if stored.digits.len() != DIGITS || !carried {
            return Err(format!("a stored sum has {DIGITS} digits of {DIGIT} bits"));
        }
        Ok(Self { digits: stored.digits, uncarried: 0, special: stored.special })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn sum(values: &[f64]) -> ExactSum {
        let mut sum = ExactSum::default();
        values.iter().for_each(|value| sum.add(*value));
        sum
    }

    #[test]
    fn nothing_is_lost_between_large_and_small() {
        assert_eq!(sum(&[1e300, 1.0, -1e300]).value(), 1.0);
        assert_eq!(sum(&[0.1, 0.2, -0.3]).value(), 2.0_f64.powi(-55), "the sum of the three doubles");
        assert_eq!(sum(&[5e-324, 5e-324]).value(), 1e-323);
        assert_eq!(sum(&[-1.5, 0.25]).value(), -1.25);
        assert_eq!(sum(&[f64::MAX, f64::MAX, -f64::MAX]).value(), f64::MAX);
        assert_eq!(sum(&[]).value(), 0.0);
        // A tie that the last addend breaks: round to even would drop it.
        assert_eq!(sum(&[1.0, 2.0_f64.powi(-53), 1e-300]).value(), 1.0 + f64::EPSILON);
    }

    #[test]
    fn order_and_shards_do_not_change_a_bit() {
        let values: Vec<f64> = (0..500).map(|i| (f64::from(i) * 1.7).sin() * 10.0_f64.powi(i % 40 - 20)).collect();
        let whole = sum(&values);
        let mut backwards = values.clone();
        backwards.reverse();
        assert_eq!(sum(&backwards).value().to_bits(), whole.value().to_bits());
        for split in [0, 3, 499] {
            let mut merged = sum(&values[split..]);
            merged.merge(&sum(&values[..split]));
            assert_eq!(merged, whole);
        }
        let text = serde_json::to_string(&whole).unwrap();
        assert_eq!(serde_json::from_str::<ExactSum>(&text).unwrap(), whole);
        assert!(serde_json::from_str::<ExactSum>("{\"digits\":[1],\"special\":0.0}").is_err());
    }

    #[test]
    fn nan_and_infinity_stay_visible() {
        assert!(sum(&[1.0, f64::NAN]).value().is_nan());
        assert_eq!(sum(&[1.0, f64::INFINITY]).value(), f64::INFINITY);
        assert!(sum(&[f64::NEG_INFINITY, f64::INFINITY]).value().is_nan());
    }
}
