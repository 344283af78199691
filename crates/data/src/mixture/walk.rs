//! The endless walk through the frames of one dataset, or of a part of it: pass after pass, each a shuffled list of its own.

use crate::permutation::Permutation;
use crate::seeding::{Purpose, rng};

/// One draw in fixed point: sums of parts of draws must be exact on every machine.
const DRAW: u64 = 1 << 32;
/// 2^32 divided by the golden ratio, odd: the fractions of its multiples fill [0, 1) as evenly as a sequence can.
const GOLDEN: u64 = 2_654_435_769;

/// Which frame comes when. A pass has as many draws as there are frames.
#[derive(Debug, Clone)]
pub(super) struct Walk {
    /// Frames by position; `None` where they are all frames of the dataset.
    frames: Option<Vec<usize>>,
    len: u64,
    /// Where each position's draws end, in fixed point, when positions are not drawn alike; the last is `len` draws.
    ends: Option<Vec<u64>>,
    /// Distinguishes the walks of a mixture.
    stream: u64,
}

impl Walk {
    /// Every frame once in each pass.
    pub fn even(frames: Option<Vec<usize>>, len: usize, stream: u64) -> Self {
        Self { frames, len: len as u64, ends: None, stream }
    }

    /// Positions drawn in proportion to `draws`, which must not all be 0: in each pass every one of them the whole number below or
    /// above its share, and over many passes its share exactly.
    pub fn weighted(frames: Option<Vec<usize>>, draws: &[f64], stream: u64) -> Self {
        let len = draws.len() as u64;
        let unit = (len * DRAW) as f64 / draws.iter().sum::<f64>();
        let mut sum = 0.0;
        let end = |draw: &f64| {
            sum += draw;
            ((sum * unit).round() as u64).min(len * DRAW)
        };
        let mut ends: Vec<u64> = draws.iter().map(end).collect();
        // Rounding must not leave the last draws of a pass without a frame; those behind the last drawn frame are empty.
        if let Some(last) = draws.iter().rposition(|draw| *draw > 0.0) {
            ends[last..].fill(len * DRAW);
        }
        Self { frames, len, ends: Some(ends), stream }
    }

    /// The frame of a draw; draws count on across passes.
    pub fn frame(&self, drawn: u64, seed: u64) -> usize {
        let (pass, offset) = (drawn / self.len, drawn % self.len);
        let shuffled = Permutation::new(self.len, &mut rng(seed, Purpose::FrameOrder, self.stream, pass)).apply(offset);
        let position = match &self.ends {
            None => shuffled as usize,
            Some(ends) => {
                // Systematic sampling: draws stand one unit apart on the line of all shares, from an offset that moves with the pass.
                let first = rand::Rng::next_u64(&mut rng(seed, Purpose::DrawOffset, self.stream, 0));
                let begin = first.wrapping_add(pass.wrapping_mul(GOLDEN)) % DRAW;
                let point = shuffled * DRAW + begin;
                ends.partition_point(|end| *end <= point)
            }
        };
        self.frames.as_ref().map_or(position, |frames| frames[position])
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_pass_keeps_to_the_shares() {
        let draws = [0.25, 3.5, 0.0, 1.0, 0.25, 1.0, 0.0];
        let sum: f64 = draws.iter().sum();
        let walk = Walk::weighted(None, &draws, 4);
        let mut total = [0u64; 7];
        for pass in 0..400 {
            let mut seen = [0u64; 7];
            (pass * 7..(pass + 1) * 7).for_each(|drawn| seen[walk.frame(drawn, 9)] += 1);
            for (seen, draw) in seen.iter().zip(draws) {
                let share = draw * 7.0 / sum;
                assert!((share.floor()..=share.ceil()).contains(&(*seen as f64)), "{seen} draws of {share}");
            }
            total.iter_mut().zip(seen).for_each(|(total, seen)| *total += seen);
        }
        for (total, draw) in total.iter().zip(draws) {
            let share = 400.0 * draw * 7.0 / sum;
            // The golden ratio's fractions stay within a few draws of evenness for 400 passes.
            assert!((*total as f64 - share).abs() < 4.0, "{total} draws of {share}");
        }
    }

    #[test]
    fn equal_shares_give_every_frame_once() {
        let walk = Walk::weighted(Some((10..110).collect()), &[0.3; 100], 0);
        for pass in 0..5 {
            let mut seen: Vec<usize> = (pass * 100..(pass + 1) * 100).map(|drawn| walk.frame(drawn, 1)).collect();
            seen.sort_unstable();
            assert!(seen.iter().copied().eq(10..110));
        }
    }
}
