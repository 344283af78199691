//! Pictures that belong to one instant.
//!
//! Each camera exposes at its own offset within the common period and single pictures get lost, so neither position nor nearest time
//! pairs them: each stamp is first freed of its camera's typical offset, then pictures that lie close together form a set.

/// Pictures of one instant, by position in the list that was paired.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct Paired {
    /// Middle of the exposures.
    pub time_ns: i64,
    /// For each camera, its picture.
    pub pictures: Vec<Option<usize>>,
}

/// What [`pair`] found.
#[derive(Debug)]
pub(crate) struct Pairing {
    /// In time order.
    pub sets: Vec<Paired>,
    /// For each camera, its typical stamp minus the set's.
    pub offsets_ns: Vec<i64>,
}

/// Groups (camera, stamp) rows of `cameras` cameras. Pictures join a set within `window_ns` of its middle, one per camera.
pub(crate) fn pair(rows: &[(usize, i64)], cameras: usize, window_ns: i64) -> Pairing {
    let offsets_ns = offsets(rows, cameras);
    let shifted = rows
        .iter()
        .enumerate()
        .filter_map(|(at, (camera, time_ns))| Some((time_ns.saturating_sub(*offsets_ns.get(*camera)?), *camera, at)));
    let mut shifted: Vec<(i64, usize, usize)> = shifted.collect();
    shifted.sort_unstable();
    let mut sets = Vec::new();
    let mut open: Vec<(i64, usize, usize)> = Vec::new();
    for picture in shifted {
        let joins = middle(open.iter().map(|other| other.0).collect()).is_some_and(|middle| {
            picture.0.abs_diff(middle) <= window_ns.unsigned_abs() && open.iter().all(|other| other.1 != picture.1)
        });
        if !joins {
            sets.extend(close(&mut open, cameras));
        }
        open.push(picture);
    }
    sets.extend(close(&mut open, cameras));
    Pairing { sets, offsets_ns }
}

fn close(open: &mut Vec<(i64, usize, usize)>, cameras: usize) -> Option<Paired> {
    let time_ns = middle(open.iter().map(|picture| picture.0).collect())?;
    let mut pictures = vec![None; cameras];
    for (_, camera, at) in open.drain(..) {
        if let Some(slot) = pictures.get_mut(camera) {
            *slot = Some(at);
        }
    }
    Some(Paired { time_ns, pictures })
}

/// Typical distance of each camera's stamps from those of the camera with most pictures, then freed of their own middle.
fn offsets(rows: &[(usize, i64)], cameras: usize) -> Vec<i64> {
    let mut stamps = vec![Vec::new(); cameras];
    for (camera, time_ns) in rows {
        if let Some(list) = stamps.get_mut(*camera) {
            list.push(*time_ns);
        }
    }
    stamps.iter_mut().for_each(|list| list.sort_unstable());
    // The first of several with equally many, so that the order of the rows does not matter.
    let anchor = stamps.iter().rev().max_by_key(|list| list.len()).cloned().unwrap_or_default();
    let typical = |list: &Vec<i64>| {
        middle(
            list.iter().filter_map(|time| nearest(&anchor, *time).map(|at| time.saturating_sub(anchor[at]))).collect(),
        )
    };
    let found: Vec<Option<i64>> = stamps.iter().map(typical).collect();
    let center = middle(found.iter().flatten().copied().collect()).unwrap_or(0);
    found.into_iter().map(|offset| offset.map_or(0, |offset| offset.saturating_sub(center))).collect()
}

/// Position of the closest of ascending stamps, the earlier of two.
pub(crate) fn nearest(ascending: &[i64], time_ns: i64) -> Option<usize> {
    let after = ascending.partition_point(|stamp| *stamp < time_ns);
    let around = [after.checked_sub(1), (after < ascending.len()).then_some(after)];
    around.into_iter().flatten().min_by_key(|at| ascending[*at].abs_diff(time_ns))
}

/// The middle value, or the mean of the two middle ones.
fn middle(mut values: Vec<i64>) -> Option<i64> {
    values.sort_unstable();
    let half = values.len() / 2;
    let upper = *values.get(half)?;
    let lower = if values.len() % 2 == 1 { upper } else { values[half - 1] };
    Some(((i128::from(lower) + i128::from(upper)).div_euclid(2)) as i64)
}

/// For each instant its closest lidar stamp within `window_ns`. A stamp serves only the instant closest to it, so that no two frames
/// have one reference.
pub(crate) fn assign_lidar(instants_ns: &[i64], lidar_ns: &[i64], window_ns: i64) -> Vec<Option<usize>> {
    let close = |time_ns: &i64| {
        nearest(lidar_ns, *time_ns).filter(|at| lidar_ns[*at].abs_diff(*time_ns) <= window_ns.unsigned_abs())
    };
    let mut found: Vec<Option<usize>> = instants_ns.iter().map(close).collect();
    for at in 1..found.len() {
        let Some(lidar) = found[at].filter(|lidar| found[at - 1] == Some(*lidar)) else { continue };
        let distance = |instant: usize| lidar_ns[lidar].abs_diff(instants_ns[instant]);
        let further = if distance(at) < distance(at - 1) { at - 1 } else { at };
        found[further] = None;
    }
    found
}

#[cfg(test)]
mod tests {
    use super::*;

    const MS: i64 = 1_000_000;

    /// Three cameras at -20, 0 and +15 ms around every 100 ms, rows in a scrambled order.
    fn rows(sets: i64) -> Vec<(usize, i64)> {
        let mut rows: Vec<_> = (0..sets)
            .flat_map(|set| {
                [-20, 0, 15].into_iter().enumerate().map(move |(camera, ms)| (camera, (100 * set + ms) * MS))
            })
            .collect();
        rows.reverse();
        rows
    }

    #[test]
    fn offsets_are_removed_and_lost_pictures_leave_holes() {
        let mut rows = rows(6);
        // Camera 2 loses the picture of set 3; pairing by position would shift all later ones.
        rows.retain(|row| *row != (2, 315 * MS));
        let pairing = pair(&rows, 3, 25 * MS);
        assert_eq!(pairing.offsets_ns, [-20 * MS, 0, 15 * MS]);
        assert_eq!(pairing.sets.len(), 6);
        for (set, paired) in pairing.sets.iter().enumerate() {
            assert_eq!(paired.time_ns, 100 * set as i64 * MS);
            for (camera, picture) in paired.pictures.iter().enumerate() {
                match picture {
                    Some(at) => assert_eq!(rows[*at], (camera, (100 * set as i64 + [-20, 0, 15][camera]) * MS)),
                    None => assert_eq!((set, camera), (3, 2)),
                }
            }
        }
    }

    #[test]
    fn nothing_and_extreme_stamps_are_survived() {
        assert!(pair(&[], 8, 25 * MS).sets.is_empty());
        let sets = pair(&[(0, i64::MIN), (1, i64::MAX), (0, 0), (9, 5)], 2, 25 * MS).sets;
        assert_eq!(sets.iter().map(|set| set.pictures.iter().flatten().count()).sum::<usize>(), 3);
        assert_eq!(middle(vec![i64::MAX, i64::MAX]), Some(i64::MAX));
    }

    #[test]
    fn a_lidar_stamp_serves_one_instant() {
        let found = assign_lidar(&[0, 40 * MS, 200 * MS, 300 * MS], &[-10 * MS, 30 * MS, 240 * MS, 290 * MS], 50 * MS);
        assert_eq!(found, [Some(0), Some(1), Some(2), Some(3)]);
        assert_eq!(assign_lidar(&[0, 40 * MS], &[30 * MS], 50 * MS), [None, Some(0)]);
        assert_eq!(assign_lidar(&[0], &[51 * MS], 50 * MS), [None]);
        assert_eq!(assign_lidar(&[0], &[], 50 * MS), [None]);
    }
}
