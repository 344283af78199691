//! Pictures of one scene, their stamps, and which of them belong to one instant.

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

use geometry::{Intrinsics, Lens, Rigid};

use super::config::TimeUnit;
use crate::{DataError, colmap};

/// Time between the sets of the release.
const SET_INTERVAL_NS: f64 = 1e8;
/// By how much the median interval may differ from it.
const INTERVAL_TOLERANCE: f64 = 0.2;

/// A registered picture.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Picture {
    /// The integer of its name, as text.
    pub stamp: String,
    pub time_ns: i64,
    /// Path below the scene's `images`.
    pub name: String,
    pub intrinsics: Intrinsics,
    pub lens: Lens,
    /// In COLMAP's world and unit until the scene is measured.
    pub world_from_cam: Rigid,
}

/// The pictures of one instant, by channel.
pub(super) type Set = BTreeMap<String, Picture>;

/// All pictures by channel, in time order.
pub(super) fn pictures(
    model: &colmap::Model,
    unit: TimeUnit,
    path: &Path,
) -> Result<BTreeMap<String, Vec<Picture>>, DataError> {
    let cameras: BTreeMap<u32, &colmap::Camera> = model.cameras.iter().map(|camera| (camera.id, camera)).collect();
    let mut channels: BTreeMap<String, Vec<(i64, Picture)>> = BTreeMap::new();
    for image in &model.images {
        let (channel, stamp, count) = split_name(&image.name, path)?;
        let camera = cameras.get(&image.camera_id).ok_or_else(|| DataError::Dangling {
            table: "images",
            token: image.name.clone(),
            field: "camera_id",
            path: path.to_owned(),
        })?;
        let calibration = |source| DataError::Calibration { row: image.name.clone(), source, path: path.to_owned() };
        let picture = Picture {
            stamp: stamp.to_owned(),
            time_ns: 0,
            name: image.name.clone(),
            intrinsics: camera.intrinsics(),
            lens: camera.model.lens(),
            world_from_cam: image.cam_from_world().map_err(calibration)?.inverse(),
        };
        channels.entry(channel.to_owned()).or_default().push((count, picture));
    }
    for rows in channels.values_mut() {
        rows.sort_by_key(|row| row.0);
    }
    let unit_ns = unit.nanoseconds().map_or_else(|| infer_unit_ns(&channels, path), Ok)?;
    let in_time = |(channel, rows): (String, Vec<(i64, Picture)>)| {
        let rows: Result<Vec<Picture>, DataError> = rows
            .into_iter()
            .map(|(count, picture)| {
                let time_ns = count.checked_mul(unit_ns);
                let time_ns = time_ns.ok_or_else(|| bad(format!("{} is later than any clock", picture.name), path))?;
                Ok(Picture { time_ns, ..picture })
            })
            .collect();
        let rows = rows?;
        match rows.windows(2).find(|pair| pair[0].time_ns == pair[1].time_ns) {
            Some(pair) => Err(bad(format!("{} and {} have one stamp", pair[0].name, pair[1].name), path)),
            None => Ok((channel, rows)),
        }
    };
    channels.into_iter().map(in_time).collect()
}

fn bad(why: String, path: &Path) -> DataError {
    DataError::Format { format: "WayveScenes101", why, path: path.to_owned() }
}

/// `<channel>/<integer>.<extension>`.
fn split_name<'a>(name: &'a str, path: &Path) -> Result<(&'a str, &'a str, i64), DataError> {
    let parts = name.split_once('/').and_then(|(channel, file)| {
        let (stamp, extension) = file.split_once('.')?;
        let plain = !channel.is_empty() && !extension.contains(['.', '/']);
        let digits = !stamp.is_empty() && stamp.bytes().all(|byte| byte.is_ascii_digit());
        (plain && digits).then_some((channel, stamp, stamp.parse().ok()?))
    });
    parts.ok_or_else(|| bad(format!("picture name {name:?} is not <camera>/<integer>.jpeg"), path))
}

/// The unit in which the camera with the most pictures runs at 10 Hz.
fn infer_unit_ns(channels: &BTreeMap<String, Vec<(i64, Picture)>>, path: &Path) -> Result<i64, DataError> {
    let longest = channels.values().max_by_key(|rows| rows.len()).map(Vec::as_slice).unwrap_or_default();
    let mut steps: Vec<i64> = longest.windows(2).map(|pair| pair[1].0.saturating_sub(pair[0].0)).collect();
    steps.sort_unstable();
    // The lower of two middle ones: lost pictures only widen intervals.
    let Some(step) = steps.get(steps.len().saturating_sub(1) / 2) else {
        return Err(bad(
            "the time unit cannot be inferred from less than two stamps; set `time_unit`".to_owned(),
            path,
        ));
    };
    let units = [TimeUnit::Milliseconds, TimeUnit::Microseconds, TimeUnit::Nanoseconds];
    let fits = |unit_ns: &i64| (*step as f64 * *unit_ns as f64 / SET_INTERVAL_NS - 1.0).abs() <= INTERVAL_TOLERANCE;
    units
        .into_iter()
        .filter_map(TimeUnit::nanoseconds)
        .find(fits)
        .ok_or_else(|| bad(format!("the stamps are {step} apart, which is 0.1 s in no unit; set `time_unit`"), path))
}

/// Groups pictures by stamp: a set holds each camera once and spans at most the window.
pub(super) fn sets(channels: &BTreeMap<String, Vec<Picture>>, window_ns: i64) -> Vec<Set> {
    let mut all: Vec<(&String, &Picture)> =
        channels.iter().flat_map(|(channel, rows)| rows.iter().map(move |row| (channel, row))).collect();
    all.sort_by_key(|(_, picture)| picture.time_ns);
    let mut sets: Vec<Set> = Vec::new();
    let mut first_ns = 0;
    for (channel, picture) in all {
        match sets.last_mut() {
            Some(set) if picture.time_ns - first_ns <= window_ns && !set.contains_key(channel) => {
                set.insert(channel.clone(), picture.clone());
            }
            _ => {
                first_ns = picture.time_ns;
                sets.push(Set::from([(channel.clone(), picture.clone())]));
            }
        }
    }
    sets
}

/// Channels that never share a set with this one.
pub(super) fn strangers(sets: &[Set], channel: &str) -> BTreeSet<String> {
    let near: BTreeSet<&String> =
        sets.iter().filter(|set| set.contains_key(channel)).flat_map(|set| set.keys()).collect();
    sets.iter().flat_map(|set| set.keys()).filter(|other| !near.contains(other)).cloned().collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn model(names: &[&str]) -> colmap::Model {
        let image = |(id, name): (u32, &&str)| colmap::Image {
            id,
            rotation_wxyz: [1.0, 0.0, 0.0, 0.0],
            translation: [0.0; 3],
            camera_id: 1,
            name: (*name).to_owned(),
            points: vec![],
        };
        let camera = colmap::CameraModel::Pinhole([10.0, 10.0, 5.0, 5.0]);
        colmap::Model {
            cameras: vec![colmap::Camera { id: 1, width: 10, height: 10, model: camera }],
            images: (1..).zip(names).map(image).collect(),
            points: vec![],
        }
    }

    fn times(names: &[&str], unit: TimeUnit) -> Result<Vec<i64>, String> {
        let found = pictures(&model(names), unit, Path::new("images.bin")).map_err(|error| error.to_string())?;
        Ok(found.values().flatten().map(|picture| picture.time_ns).collect())
    }

    #[test]
    fn the_unit_is_the_one_that_gives_ten_hertz() {
        for (names, unit_ns) in [
            (["a/1000.jpeg", "a/1100.jpeg", "a/1200.jpeg"], 1_000_000),
            (["a/1000000.jpeg", "a/1101000.jpeg", "a/1200000.jpeg"], 1_000),
            (["a/1000000000.jpeg", "a/1100000000.jpeg", "a/1299000000.jpeg"], 1),
        ] {
            let found = times(&names, TimeUnit::Infer).unwrap();
            let stamps = names.map(|name| name[2..name.len() - 5].parse::<i64>().unwrap() * unit_ns);
            assert_eq!(found, stamps);
        }
        assert_eq!(times(&["a/7.jpeg"], TimeUnit::Milliseconds).unwrap(), [7_000_000]);
        assert!(times(&["a/7.jpeg"], TimeUnit::Infer).unwrap_err().contains("set `time_unit`"));
        assert!(times(&["a/7.jpeg", "a/8.jpeg"], TimeUnit::Infer).unwrap_err().contains("1 apart"));
        assert!(times(&[], TimeUnit::Infer).is_err());
    }

    #[test]
    fn names_of_another_form_are_refused() {
        for name in
            ["7.jpeg", "a/b.jpeg", "a/7", "a/-7.jpeg", "a/b/7.jpeg", "a/7.tar.gz", "a/99999999999999999999.jpeg"]
        {
            let error = times(&[name], TimeUnit::Nanoseconds).unwrap_err();
            assert!(error.contains(name) && error.ends_with("images.bin"), "{error}");
        }
        assert!(times(&["a/7.jpeg", "a/07.jpeg"], TimeUnit::Nanoseconds).unwrap_err().contains("one stamp"));
        assert!(times(&["a/9223372036854775807.jpeg"], TimeUnit::Milliseconds).unwrap_err().contains("later"));
    }

    #[test]
    fn sets_hold_every_camera_once_and_span_the_window() {
        let model = model(&["b/102.jpeg", "a/100.jpeg", "a/200.jpeg", "b/140.jpeg", "a/110.jpeg"]);
        let found = pictures(&model, TimeUnit::Nanoseconds, Path::new("images.bin")).unwrap();
        let names = |window| {
            let sets = sets(&found, window);
            sets.iter()
                .map(|set| set.values().map(|p| p.stamp.clone()).collect::<Vec<_>>().join("+"))
                .collect::<Vec<_>>()
        };
        assert_eq!(names(0), ["100", "102", "110", "140", "200"]);
        assert_eq!(names(20), ["100+102", "110", "140", "200"]);
        assert_eq!(names(30), ["100+102", "110+140", "200"]);
        assert_eq!(strangers(&sets(&found, 0), "a"), BTreeSet::from(["b".to_owned()]));
        assert!(strangers(&sets(&found, 30), "a").is_empty());
    }
}
