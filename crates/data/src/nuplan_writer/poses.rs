//! The car's pose rows: exact at every stamp that matters, at 100 Hz between them.

use std::collections::BTreeMap;

use geometry::glam::DVec3;
use geometry::{PoseTrack, Rigid};

use crate::DataError;

/// Distance of pose rows in the release.
const PERIOD_US: i64 = 10_000;
/// Longer intervals between stamps stay empty: nobody asks for poses there, and a straight line says nothing about them.
const LONGEST_FILLED_US: i64 = 10_000_000;
/// Two poses of one stamp that differ by less are one pose: stamps are rounded to microseconds, a car at 40 m/s moves 0.04 mm in one.
const SAME_PLACE_M: f64 = 1e-3;
const SAME_HEADING_RAD: f64 = 1e-4;

/// Poses at stamps, microseconds; world is UTM.
#[derive(Debug, Default)]
pub(super) struct Poses(BTreeMap<i64, Rigid>);

/// One row with its derivatives in the axes of the car.
#[derive(Debug)]
pub(super) struct PoseRow {
    pub time_us: i64,
    pub world_from_ego: Rigid,
    pub velocity: DVec3,
    pub acceleration: DVec3,
    pub angular_rate: DVec3,
}

impl Poses {
    /// # Errors
    /// Another pose at the same stamp.
    pub fn add(&mut self, time_us: i64, world_from_ego: Rigid, scene: &str) -> Result<(), DataError> {
        let known = self.0.entry(time_us).or_insert(world_from_ego);
        let moved = known.translation.distance(world_from_ego.translation);
        if moved <= SAME_PLACE_M && known.angle_to(&world_from_ego) <= SAME_HEADING_RAD {
            return Ok(());
        }
        Err(DataError::Config(format!(
            "{scene} has two poses at {time_us} us, {moved:.3} m apart; the layout holds one"
        )))
    }

    /// All rows in time order.
    pub fn rows(&self) -> Vec<PoseRow> {
        let knots: Vec<(i64, Rigid)> = self.0.iter().map(|(time, pose)| (*time, *pose)).collect();
        let track = PoseTrack::new(knots.clone(), LONGEST_FILLED_US);
        let mut dense = Vec::with_capacity(knots.len());
        for pair in knots.windows(2) {
            dense.push(pair[0]);
            let (from, to) = (pair[0].0, pair[1].0);
            if to - from > LONGEST_FILLED_US {
                continue;
            }
            // On the grid, but no row closer to a knot than half a period.
            let first = (from + PERIOD_US / 2).div_euclid(PERIOD_US) + 1;
            let grid = (first..).map(|step| step * PERIOD_US).take_while(|time| *time < to - PERIOD_US / 2);
            dense.extend(grid.filter_map(|time| Some((time, track.at(time).ok()?))));
        }
        dense.extend(knots.last());
        derive(&dense)
    }
}

/// Derivatives by central differences, one-sided at the ends.
fn derive(rows: &[(i64, Rigid)]) -> Vec<PoseRow> {
    let around = |at: usize| (at.saturating_sub(1), (at + 1).min(rows.len() - 1));
    let secs = |from: usize, to: usize| (rows[to].0 - rows[from].0) as f64 * 1e-6;
    let rate = |difference: DVec3, secs: f64| if secs > 0.0 { difference / secs } else { DVec3::ZERO };
    let velocity = |at: usize| {
        let (from, to) = around(at);
        rate(rows[to].1.translation - rows[from].1.translation, secs(from, to))
    };
    let velocities: Vec<DVec3> = (0..rows.len()).map(velocity).collect();
    let row = |at: usize| {
        let (from, to) = around(at);
        let pose = rows[at].1;
        let in_car = |vector: DVec3| pose.rotation.inverse() * vector;
        let turn = rows[from].1.rotation.inverse() * rows[to].1.rotation;
        // The short way round: q and -q are one rotation.
        let turn = if turn.w < 0.0 { -turn } else { turn };
        PoseRow {
            time_us: rows[at].0,
            world_from_ego: pose,
            velocity: in_car(velocities[at]),
            acceleration: in_car(rate(velocities[to] - velocities[from], secs(from, to))),
            angular_rate: rate(turn.to_scaled_axis(), secs(from, to)),
        }
    };
    (0..rows.len()).map(row).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// 8 m/s on a circle of 40 m to the left.
    fn circle(time_us: i64) -> Rigid {
        let angle = 0.2 * time_us as f64 * 1e-6;
        Rigid::from_yaw(angle, 40.0 * DVec3::new(angle.sin(), 1.0 - angle.cos(), 0.0))
    }

    #[test]
    fn rows_are_a_hundred_a_second_and_hold_the_knots_exactly() {
        let mut poses = Poses::default();
        let knots = [0, 12_345, 100_000, 103_000, 200_000, 60_000_000];
        knots.iter().for_each(|time| poses.add(*time, circle(*time), "s").unwrap());
        let rows = poses.rows();
        for knot in knots {
            let row = rows.iter().find(|row| row.time_us == knot).unwrap();
            assert_eq!(row.world_from_ego, circle(knot));
        }
        let gaps: Vec<i64> = rows.windows(2).map(|pair| pair[1].time_us - pair[0].time_us).collect();
        let (last, others) = gaps.split_last().unwrap();
        assert_eq!(*last, 59_800_000);
        assert!(others.iter().all(|gap| (3_000..=20_000).contains(gap)), "{others:?}");
        let row = rows.iter().find(|row| row.time_us == 60_000).unwrap();
        assert!((row.velocity - DVec3::new(8.0, 0.0, 0.0)).length() < 0.1, "{}", row.velocity);
        assert!((row.angular_rate.z - 0.2).abs() < 1e-6, "{}", row.angular_rate);
    }

    #[test]
    fn one_stamp_has_one_pose() {
        let mut poses = Poses::default();
        poses.add(5, circle(5), "s").unwrap();
        poses.add(5, circle(6), "s").unwrap();
        let error = poses.add(5, circle(5_000), "s").unwrap_err().to_string();
        assert!(error.contains("two poses at 5 us"), "{error}");
        assert!(Poses::default().rows().is_empty());
    }
}
