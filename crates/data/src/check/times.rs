//! Rhythm of the frames and holes in it.

use serde::Serialize;

use super::frames::FrameFacts;
use crate::SceneDataset;

/// An interval this many times the scene's median is a hole.
const GAP_FACTOR: f64 = 1.5;
/// A picture further from the reference instant than this is odd: no dataset's cameras need longer for one turn, seconds.
const MOST_OFFSET_SECS: f64 = 0.25;

/// Time between frames of the same scene, seconds. All zero where no scene has two frames.
#[derive(Debug, Clone, PartialEq, Default, Serialize)]
pub struct TimeReport {
    /// Shortest interval.
    pub shortest_secs: f64,
    /// Median over all intervals.
    pub median_secs: f64,
    /// Longest interval.
    pub longest_secs: f64,
    /// Every interval longer than 1.5 times the median of its scene.
    pub gaps: Vec<Gap>,
    /// Longest time between a picture and the reference instant of its frame.
    pub longest_picture_offset_secs: f64,
    /// Longest way of the car in that time, metres.
    pub longest_picture_way_m: f64,
}

/// A hole in a scene.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Gap {
    /// The scene.
    pub scene: String,
    /// Index of the frame before the hole.
    pub after_frame: usize,
    /// Its length.
    pub secs: f64,
}

#[derive(Debug, Default)]
pub(super) struct Times {
    intervals_ns: Vec<i64>,
    gaps: Vec<Gap>,
    disorder: Vec<usize>,
    longest_offset_ns: i64,
    longest_way_m: f64,
}

impl Times {
    pub(super) fn pictures(&mut self, facts: &FrameFacts) {
        self.longest_offset_ns = self.longest_offset_ns.max(facts.longest_offset_ns);
        self.longest_way_m = self.longest_way_m.max(facts.longest_way_m);
    }

    /// Index and stamp of the readable frames of one scene, in order.
    pub(super) fn scene(&mut self, dataset: &dyn SceneDataset, stamps: &[(usize, i64)]) {
        let pairs = stamps.iter().zip(stamps.iter().skip(1));
        let steps: Vec<(usize, i64)> = pairs.map(|(a, b)| (a.0, b.1.saturating_sub(a.1))).collect();
        let intervals = || steps.iter().map(|step| step.1);
        let usual = median(intervals().collect()) as f64;
        self.disorder.extend(steps.iter().filter(|step| step.1 <= 0).map(|step| step.0));
        for (index, step) in steps.iter().filter(|step| step.1 as f64 > GAP_FACTOR * usual) {
            let scene = dataset.frame(*index).map_or_else(|_| String::new(), |frame| frame.id.scene);
            self.gaps.push(Gap { scene, after_frame: *index, secs: secs(*step) });
        }
        self.intervals_ns.extend(intervals());
    }

    pub(super) fn finish(self, warnings: &mut Vec<String>) -> TimeReport {
        if let Some(first) = self.disorder.first() {
            warnings.push(format!(
                "time does not ascend after {} frames of their scenes, first after frame {first}",
                self.disorder.len()
            ));
        }
        let longest_picture_offset_secs = secs(self.longest_offset_ns);
        if longest_picture_offset_secs > MOST_OFFSET_SECS {
            warnings.push(format!("a picture was taken {longest_picture_offset_secs:.3} s from its frame's instant"));
        }
        TimeReport {
            shortest_secs: secs(self.intervals_ns.iter().copied().min().unwrap_or(0)),
            longest_secs: secs(self.intervals_ns.iter().copied().max().unwrap_or(0)),
            median_secs: secs(median(self.intervals_ns)),
            gaps: self.gaps,
            longest_picture_offset_secs,
            longest_picture_way_m: self.longest_way_m,
        }
    }
}

fn secs(ns: i64) -> f64 {
    ns as f64 * 1e-9
}

/// The upper of the two middle values; 0 of nothing.
fn median(mut values: Vec<i64>) -> i64 {
    values.sort_unstable();
    values.get(values.len() / 2).copied().unwrap_or(0)
}
