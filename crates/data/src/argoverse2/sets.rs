//! Which pictures belong to one instant.
//!
//! A lidar stamp takes the nearest picture of each camera. What is left over lies between two lidar stamps: it is freed of its
//! camera's typical offset, then pictures of one turn lie together.

use super::config::FrameChoice;

/// The pictures of one instant.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct PictureSet {
    /// Reference instant.
    pub time_ns: i64,
    /// For each camera of the rig, the picture's stamp.
    pub pictures: Vec<Option<i64>>,
}

/// All sets of a log, and the typical picture stamp minus reference instant of every camera.
#[derive(Debug, PartialEq, Eq)]
pub(super) struct Grouped {
    pub sets: Vec<PictureSet>,
    pub offsets_ns: Vec<i64>,
}

/// What a log's files say about time, all ascending.
#[derive(Debug)]
pub(super) struct Stamps<'a> {
    /// Pictures of each camera.
    pub pictures: &'a [Vec<i64>],
    /// Instants with annotations.
    pub annotated: &'a [i64],
    /// Instants with annotations or a lidar sweep.
    pub lidar: &'a [i64],
}

/// Forms the sets of a log in time order; also those without any picture.
pub(super) fn group(stamps: &Stamps<'_>, choice: FrameChoice, window_ns: i64) -> Grouped {
    let of_lidar: Vec<PictureSet> =
        stamps.lidar.iter().map(|time_ns| nearest(stamps.pictures, *time_ns, window_ns)).collect();
    let offsets_ns = offsets(stamps.pictures, &of_lidar, window_ns);
    let only_annotated = choice == FrameChoice::Annotated;
    let mut sets = match (only_annotated, stamps.annotated, stamps.lidar) {
        (true, [_, ..], _) => {
            of_lidar.into_iter().filter(|set| stamps.annotated.binary_search(&set.time_ns).is_ok()).collect()
        }
        (true, [], [_, ..]) => of_lidar,
        _ => {
            let rest = leftover(stamps.pictures, &of_lidar, &offsets_ns, window_ns);
            [of_lidar, rest].concat()
        }
    };
    sets.sort_by_key(|set| set.time_ns);
    Grouped { sets, offsets_ns }
}

/// The nearest picture of each camera, within the window.
fn nearest(pictures: &[Vec<i64>], time_ns: i64, window_ns: i64) -> PictureSet {
    let nearest = |stamps: &Vec<i64>| {
        nearest_stamp(stamps, time_ns).filter(|found| found.abs_diff(time_ns) <= window_ns.unsigned_abs())
    };
    PictureSet { time_ns, pictures: pictures.iter().map(nearest).collect() }
}

fn nearest_stamp(stamps: &[i64], time_ns: i64) -> Option<i64> {
    let next = stamps.partition_point(|stamp| *stamp < time_ns);
    let around = [next.checked_sub(1).and_then(|before| stamps.get(before)), stamps.get(next)];
    around.into_iter().flatten().copied().min_by_key(|stamp| stamp.abs_diff(time_ns))
}

/// Median over the lidar's sets; without any, over the pictures of the first camera that has some.
fn offsets(pictures: &[Vec<i64>], of_lidar: &[PictureSet], window_ns: i64) -> Vec<i64> {
    let of_anchor: Vec<PictureSet>;
    let any = |sets: &[PictureSet]| sets.iter().any(|set| set.pictures.iter().any(Option::is_some));
    let sets = if any(of_lidar) {
        of_lidar
    } else {
        let anchor = pictures.iter().find(|stamps| !stamps.is_empty());
        of_anchor = anchor.into_iter().flatten().map(|time_ns| nearest(pictures, *time_ns, window_ns)).collect();
        &of_anchor
    };
    let of_camera = |camera: usize| {
        let found = |set: &PictureSet| set.pictures.get(camera).copied().flatten().map(|stamp| stamp - set.time_ns);
        median(sets.iter().filter_map(found).collect()).unwrap_or(0)
    };
    (0..pictures.len()).map(of_camera).collect()
}

fn median(mut values: Vec<i64>) -> Option<i64> {
    values.sort_unstable();
    values.get(values.len() / 2).copied()
}

/// Sets of the pictures that no lidar stamp took.
fn leftover(pictures: &[Vec<i64>], taken: &[PictureSet], offsets_ns: &[i64], window_ns: i64) -> Vec<PictureSet> {
    let mut free: Vec<(i64, usize, i64)> = Vec::new();
    for (camera, (stamps, offset_ns)) in pictures.iter().zip(offsets_ns).enumerate() {
        let mut used: Vec<i64> = taken.iter().filter_map(|set| set.pictures.get(camera).copied().flatten()).collect();
        used.sort_unstable();
        let left = stamps.iter().filter(|stamp| used.binary_search(stamp).is_err());
        free.extend(left.map(|stamp| (stamp.saturating_sub(*offset_ns), camera, *stamp)));
    }
    free.sort_unstable();
    let mut sets = Vec::new();
    let mut open: Vec<(i64, usize, i64)> = Vec::new();
    for picture in free {
        let ends = open.first().is_some_and(|first| picture.0.abs_diff(first.0) > window_ns.unsigned_abs())
            || open.iter().any(|other| other.1 == picture.1);
        if ends {
            sets.extend(close(&open, pictures.len()));
            open.clear();
        }
        open.push(picture);
    }
    sets.extend(close(&open, pictures.len()));
    sets
}

/// One set of compensated stamps, cameras and stamps; its reference is the median of the compensated stamps.
fn close(open: &[(i64, usize, i64)], cameras: usize) -> Option<PictureSet> {
    let time_ns = median(open.iter().map(|picture| picture.0).collect())?;
    let of_camera = |camera: usize| open.iter().find(|picture| picture.1 == camera).map(|picture| picture.2);
    Some(PictureSet { time_ns, pictures: (0..cameras).map(of_camera).collect() })
}

#[cfg(test)]
mod tests {
    use super::*;

    const MS: i64 = 1_000_000;
    const WINDOW: i64 = 25 * MS;

    /// Two cameras at 20 Hz, 10 ms before and 20 ms after the lidar at 10 Hz.
    fn pictures() -> Vec<Vec<i64>> {
        [-10, 20].map(|offset| (0..6).map(|turn| (1000 + 50 * turn + offset) * MS).collect()).to_vec()
    }

    fn times(grouped: &Grouped) -> Vec<i64> {
        grouped.sets.iter().map(|set| set.time_ns / MS).collect()
    }

    #[test]
    fn lidar_stamps_take_the_nearest_pictures_and_the_rest_lies_between() {
        let (pictures, lidar) = (pictures(), [1000 * MS, 1100 * MS, 1200 * MS]);
        let stamps = Stamps { pictures: &pictures, annotated: &lidar[..2], lidar: &lidar };
        let annotated = group(&stamps, FrameChoice::Annotated, WINDOW);
        assert_eq!(times(&annotated), [1000, 1100]);
        assert_eq!(annotated.offsets_ns, [-10 * MS, 20 * MS]);
        let all = group(&stamps, FrameChoice::AllPictures, WINDOW);
        assert_eq!(times(&all), [1000, 1050, 1100, 1150, 1200, 1250]);
        for set in &all.sets {
            assert_eq!(set.pictures, [Some(set.time_ns - 10 * MS), Some(set.time_ns + 20 * MS)]);
        }
    }

    #[test]
    fn a_lost_picture_leaves_its_place_empty_and_moves_nothing() {
        let mut pictures = pictures();
        pictures[1].remove(1);
        let stamps = Stamps { pictures: &pictures, annotated: &[], lidar: &[1000 * MS, 1100 * MS, 1200 * MS] };
        let all = group(&stamps, FrameChoice::AllPictures, WINDOW);
        assert_eq!(times(&all), [1000, 1050, 1100, 1150, 1200, 1250]);
        assert_eq!(all.sets[1].pictures, [Some(1040 * MS), None]);
        assert_eq!(all.sets[2].pictures, [Some(1090 * MS), Some(1120 * MS)]);
    }

    #[test]
    fn without_lidar_and_annotations_the_first_camera_sets_the_pace() {
        // 30 ms apart, but 20 ms when paired with the neighbouring turn: the pair is off by one, never mixed.
        let pictures = pictures();
        let stamps = Stamps { pictures: &pictures, annotated: &[], lidar: &[] };
        for choice in [FrameChoice::Annotated, FrameChoice::AllPictures] {
            let all = group(&stamps, choice, WINDOW);
            assert_eq!(all.offsets_ns, [0, -20 * MS]);
            assert_eq!(all.sets.iter().filter(|set| set.pictures.iter().all(Option::is_some)).count(), 5);
        }
        let none = Stamps { pictures: &[vec![], vec![]], annotated: &[], lidar: &[] };
        assert!(group(&none, FrameChoice::AllPictures, WINDOW).sets.is_empty());
    }
}
