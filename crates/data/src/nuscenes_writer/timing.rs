//! When the sensors look: a 20 Hz lidar whose beam triggers the cameras as it sweeps past them.
//!
//! So exposures lie on a 50 ms grid, gaps between pictures of one camera are 50 or 100 ms, and every camera has its own offset to
//! the end of the lidar turn, which is the sample's time. Real key frame: front left -43.1 ms, front -35.5, front right -27.6,
//! back right -20.1, back -10.4, back left -0.5; that is one clockwise turn in 50 ms ending 104.4 degrees to the left.

use super::tokens::TokenSpace;

/// One lidar turn.
const TURN_US: i64 = 50_000;
/// Azimuth where a turn starts and ends, degrees, left positive (see above).
const SEAM_DEG: f64 = 104.4;
/// First sample after the start of the world: one turn and the largest deviation must fit before it.
pub(super) const LEAD_IN_US: i64 = 60_000;
/// Turns after a key frame whose pictures are kept: 12 Hz out of 20 Hz.
const SWEEP_TURNS: [i64; 5] = [2, 4, 5, 7, 9];
/// Largest deviation of a stamp from the grid.
const JITTER_US: f64 = 400.0;

/// One picture of one camera.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Exposure {
    /// After the start of the world.
    pub(super) time_us: i64,
    /// The key frame itself or, for a sweep, the key frame that follows.
    pub(super) sample: usize,
    pub(super) is_key_frame: bool,
}

/// Stamps of one scene, in microseconds after the start of its world.
#[derive(Debug)]
pub(super) struct Timetable {
    /// Times of the key frames.
    pub(super) samples_us: Vec<i64>,
    /// Per camera, ascending in time.
    pub(super) exposures: Vec<Vec<Exposure>>,
}

/// What shapes a timetable.
#[derive(Debug, Clone, Copy)]
pub(super) struct TimingPlan {
    pub(super) key_frames: usize,
    pub(super) sweeps: bool,
    /// Probability that a sweep is lost.
    pub(super) drop_share: f64,
}

/// Offset of a camera's exposure to the sample's time, from the azimuth of its optical axis.
pub(super) fn exposure_offset_us(azimuth_rad: f64) -> i64 {
    let swept_deg = (SEAM_DEG - azimuth_rad.to_degrees()).rem_euclid(360.0);
    ((swept_deg / 360.0 - 1.0) * TURN_US as f64).round() as i64
}

/// Turns between key frames: ten, but nine in every fifth interval, as key frames of the release are 450 or 500 ms apart.
fn turns_of_interval(interval: usize) -> i64 {
    if interval % 5 == 3 { 9 } else { 10 }
}

/// An upper bound of the last stamp of a scene.
pub(super) fn needed_secs(key_frames: usize) -> f64 {
    let turns: i64 = (0..key_frames.saturating_sub(1)).map(turns_of_interval).sum();
    ((LEAD_IN_US + turns * TURN_US) as f64 + JITTER_US) * 1e-6
}

/// The stamps of one scene. Deviations follow from `scene`, so they are the same in every run.
pub(super) fn timetable(tokens: &TokenSpace, scene: &str, azimuths_rad: &[f64], plan: TimingPlan) -> Timetable {
    let deviation = |what: &str, turn: i64| {
        let share = 2.0 * tokens.fraction("jitter", &format!("{scene}/{what}/{turn}")) - 1.0;
        (share * JITTER_US).round() as i64
    };
    let turn_us = |turn: i64| LEAD_IN_US + turn * TURN_US + deviation("turn", turn);
    let mut samples_us = vec![];
    // (turn, sample, key) of all kept turns.
    let mut kept = vec![];
    let mut turn = 0;
    for sample in 0..plan.key_frames {
        if sample > 0 {
            let length = turns_of_interval(sample - 1);
            if plan.sweeps {
                kept.extend(SWEEP_TURNS.iter().filter(|t| **t < length).map(|t| (turn + t, sample, false)));
            }
            turn += length;
        }
        samples_us.push(turn_us(turn));
        kept.push((turn, sample, true));
    }
    let camera = |(index, azimuth): (usize, &f64)| {
        let what = format!("camera{index}");
        let lost = |turn: i64| tokens.fraction("drop", &format!("{scene}/{what}/{turn}")) < plan.drop_share;
        kept.iter()
            .filter(|(turn, _, key)| *key || !lost(*turn))
            .map(|(turn, sample, key)| Exposure {
                // Half the deviation: the shutter follows the beam, it does not wander on its own.
                time_us: turn_us(*turn) + exposure_offset_us(*azimuth) + deviation(&what, *turn) / 2,
                sample: *sample,
                is_key_frame: *key,
            })
            .collect()
    };
    Timetable { samples_us, exposures: azimuths_rad.iter().enumerate().map(camera).collect() }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn offsets_are_those_of_a_real_key_frame() {
        // Azimuths and offsets of the nuScenes rig n015 and of the first key frame of scene-0061.
        let real =
            [(55.2, -43_100), (0.3, -35_500), (-56.4, -27_600), (-110.8, -20_100), (179.9, -10_400), (108.6, -500)];
        for (azimuth, offset) in real {
            let got = exposure_offset_us(f64::to_radians(azimuth));
            assert!((got - offset).abs() < 150, "azimuth {azimuth}: {got} against {offset}");
        }
    }

    #[test]
    fn pictures_lie_on_the_lidar_grid_and_sweeps_carry_the_following_sample() {
        let tokens = TokenSpace::new("v1.0-mini", 5);
        let plan = TimingPlan { key_frames: 6, sweeps: true, drop_share: 0.0 };
        let table = timetable(&tokens, "scene", &[0.0, 1.9], plan);
        assert_eq!(table.samples_us.len(), 6);
        assert!(table.samples_us.last().is_some_and(|t| *t as f64 * 1e-6 <= needed_secs(6)));
        for exposures in &table.exposures {
            // Four intervals of ten turns with five sweeps, one of nine with four.
            assert_eq!(exposures.len(), 6 + 4 * 5 + 4);
            assert!(exposures[0].time_us > 0);
            for pair in exposures.windows(2) {
                let gap = pair[1].time_us - pair[0].time_us;
                assert!((gap - 50_000).abs() < 1300 || (gap - 100_000).abs() < 1300, "gap of {gap} us");
                assert!(pair[1].sample == pair[0].sample + usize::from(pair[0].is_key_frame));
            }
            for exposure in exposures.iter().filter(|e| e.is_key_frame) {
                let before = table.samples_us[exposure.sample] - exposure.time_us;
                assert!((-700..51_000).contains(&before), "{before} us before its sample");
            }
        }
        let key_only = timetable(&tokens, "scene", &[0.0], TimingPlan { sweeps: false, ..plan });
        assert!(key_only.exposures[0].iter().all(|e| e.is_key_frame));
        let dropped = timetable(&tokens, "scene", &[0.0], TimingPlan { drop_share: 1.0, ..plan });
        assert_eq!(dropped.exposures, key_only.exposures);
    }
}
