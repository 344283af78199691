//! The boxes of a log, linked along their tracks.

use std::collections::HashMap;
use std::ops::Range;

use geometry::glam::DVec3;
use geometry::{Box3d, Rigid};

use super::config::Argoverse2Config;
use super::feather::{Table, Texts};
use super::poses::{Poses, pose_columns};
use crate::store::{Store, StoredFile};
use crate::taxonomy::{self, ClassRule};
use crate::{DataError, ObjectBox, ObjectClass};

/// Longest time between two annotations whose difference still is a velocity, doubled when the box lies between.
const MAX_STEP_SECS: f64 = 1.5;
/// Categories whose box holds the person only ...
const RIDERS: [&str; 3] = ["BICYCLIST", "MOTORCYCLIST", "WHEELED_RIDER"];
/// ... beside the box of one of these.
const TWO_WHEELERS: [&str; 3] = ["BICYCLE", "MOTORCYCLE", "WHEELED_DEVICE"];

/// The annotations of one log.
#[derive(Debug)]
pub(super) struct Annotations {
    /// In time order, the file's order within one stamp.
    rows: Vec<Annotation>,
    /// Ascending, with their rows.
    stamps: Vec<(i64, Range<usize>)>,
    tracks: Vec<String>,
    /// Native name, and the shared class unless the config drops it.
    categories: Vec<(String, Option<ObjectClass>)>,
}

#[derive(Debug, Clone, Copy)]
struct Annotation {
    track: u32,
    category: u32,
    /// Ego frame at the row's own stamp.
    box3d: Box3d,
    points: Option<u32>,
    /// Centre in the city.
    world_center: DVec3,
    time_ns: i64,
    before: Option<u32>,
    after: Option<u32>,
}

impl Annotations {
    /// # Errors
    /// Broken tables; a box that cannot be one; a stamp without a pose; a category without a rule.
    pub fn read(file: &StoredFile, poses: &Poses, config: &Argoverse2Config, store: &Store) -> Result<Self, DataError> {
        let table = Table::read(file, &COLUMNS)?;
        let (tracks, categories) = (table.texts("track_uuid")?, table.texts("category")?);
        let rows = read_rows(&table, &tracks, &categories, poses, store)?;
        let categories = categories.values.into_iter().map(|name| classify(name, config));
        let mut found =
            Self { rows, stamps: Vec::new(), categories: categories.collect::<Result<_, _>>()?, tracks: tracks.values };
        found.link();
        Ok(found)
    }

    /// True for a file without a row.
    pub fn is_empty(&self) -> bool {
        self.rows.is_empty()
    }

    /// The annotated instants, ascending.
    pub fn stamps(&self) -> impl Iterator<Item = i64> + '_ {
        self.stamps.iter().map(|stamp| stamp.0)
    }

    /// The boxes of an annotated instant, in its own ego frame; `None` for any other instant.
    pub fn at(&self, time_ns: i64, world_from_ego: &Rigid, config: &Argoverse2Config) -> Option<Vec<ObjectBox>> {
        if self.is_empty() {
            return Some(Vec::new());
        }
        let at = self.stamps.binary_search_by_key(&time_ns, |stamp| stamp.0).ok()?;
        let rows = self.rows.get(self.stamps.get(at)?.1.clone())?;
        let wheels: Vec<Box3d> =
            rows.iter().filter(|row| TWO_WHEELERS.contains(&self.category(row))).map(|row| row.box3d).collect();
        let wanted = |row: &&Annotation| {
            let in_range = config.max_range_m.is_none_or(|most| row.box3d.center.truncate().length() <= most);
            // An unknown count is no reason to leave a box out.
            let seen = row.points.is_none_or(|points| points >= config.min_points);
            let merged = config.merge_riders
                && RIDERS.contains(&self.category(row))
                && wheels.iter().any(|other| overlap(&row.box3d, other));
            in_range && seen && !merged
        };
        let ego_from_world = world_from_ego.inverse();
        Some(rows.iter().filter(wanted).filter_map(|row| self.object(row, &ego_from_world)).collect())
    }

    fn category(&self, row: &Annotation) -> &str {
        self.categories.get(row.category as usize).map_or("", |category| &category.0)
    }

    /// `None` for a class that the config drops.
    fn object(&self, row: &Annotation, ego_from_world: &Rigid) -> Option<ObjectBox> {
        let (source_class, class) = self.categories.get(row.category as usize)?;
        let velocity = self.velocity(row).map(|velocity| {
            let velocity = ego_from_world.transform_vector(velocity);
            [velocity.x, velocity.y]
        });
        Some(ObjectBox {
            box3d: row.box3d,
            class: (*class)?,
            track: self.tracks.get(row.track as usize)?.clone(),
            source_class: source_class.clone(),
            velocity,
            attributes: Vec::new(),
            points: row.points,
            visibility: None,
            interpolated: false,
        })
    }

    /// City axes, from the neighbours in the track, one-sided at its ends.
    fn velocity(&self, row: &Annotation) -> Option<DVec3> {
        let at = |link: Option<u32>| link.and_then(|link| self.rows.get(link as usize)).unwrap_or(row);
        let (first, last) = (at(row.before), at(row.after));
        let secs = (last.time_ns - first.time_ns) as f64 * 1e-9;
        let limit = if row.before.is_some() && row.after.is_some() { 2.0 * MAX_STEP_SECS } else { MAX_STEP_SECS };
        (secs > 0.0 && secs <= limit).then(|| (last.world_center - first.world_center) / secs)
    }

    fn link(&mut self) {
        self.rows.sort_by_key(|row| row.time_ns);
        let mut start = 0;
        for rows in self.rows.chunk_by(|a, b| a.time_ns == b.time_ns) {
            self.stamps.extend(rows.first().map(|row| (row.time_ns, start..start + rows.len())));
            start += rows.len();
        }
        let mut latest: HashMap<u32, u32> = HashMap::new();
        let mut links = Vec::new();
        for (at, row) in (0_u32..).zip(&mut self.rows) {
            row.before = latest.insert(row.track, at);
            links.extend(row.before.map(|before| (before as usize, at)));
        }
        for (before, at) in links {
            if let Some(row) = self.rows.get_mut(before) {
                row.after = Some(at);
            }
        }
    }
}

const COLUMNS: [&str; 14] = [
    "timestamp_ns",
    "track_uuid",
    "category",
    "length_m",
    "width_m",
    "height_m",
    "qw",
    "qx",
    "qy",
    "qz",
    "tx_m",
    "ty_m",
    "tz_m",
    "num_interior_pts",
];

fn read_rows(
    table: &Table,
    tracks: &Texts,
    categories: &Texts,
    poses: &Poses,
    store: &Store,
) -> Result<Vec<Annotation>, DataError> {
    let stamps = table.integers("timestamp_ns")?;
    let points = table.integers("num_interior_pts")?;
    let [length, width, height] = ["length_m", "width_m", "height_m"].map(|name| table.floats(name));
    let sizes = length?.into_iter().zip(width?).zip(height?).map(|((l, w), h)| DVec3::new(l, w, h));
    let boxes = pose_columns(table)?.into_iter().zip(sizes);
    let keys = tracks.rows.iter().zip(&categories.rows);
    let mut rows: Vec<Annotation> = Vec::with_capacity(table.len());
    let mut last: Option<(i64, Rigid)> = None;
    for (at, ((time_ns, points), ((pose, size), (track, category)))) in
        stamps.into_iter().zip(points).zip(boxes.zip(keys)).enumerate()
    {
        let world_from_ego = match last.filter(|last| last.0 == time_ns) {
            Some((_, pose)) => pose,
            None => poses.of(&format!("annotation {at}"), time_ns, store)?,
        };
        last = Some((time_ns, world_from_ego));
        if !(size.is_finite() && size.min_element() > 0.0) {
            let token = format!("{at} of track {}", tracks.get(at));
            let why = format!("its size is {size}");
            return Err(DataError::Annotation { token, why, path: table.path().to_owned() });
        }
        rows.push(Annotation {
            track: *track,
            category: *category,
            box3d: Box3d { center: pose.translation, size, yaw: pose.yaw() },
            points: u32::try_from(points).ok(),
            world_center: world_from_ego * pose.translation,
            time_ns,
            before: None,
            after: None,
        });
    }
    Ok(rows)
}

fn classify(name: String, config: &Argoverse2Config) -> Result<(String, Option<ObjectClass>), DataError> {
    let class = match config.classes.get(&name) {
        Some(ClassRule::Drop) => None,
        Some(ClassRule::As(class)) => Some(*class),
        None => Some(
            taxonomy::from_argoverse2(&name)
                .ok_or_else(|| DataError::UnknownClass { dataset: config.name.clone(), name: name.clone() })?,
        ),
    };
    Ok((name, class))
}

/// Whether two upright boxes share a point: no axis of either separates them.
fn overlap(a: &Box3d, b: &Box3d) -> bool {
    if (a.center.z - b.center.z).abs() > 0.5 * (a.size.z + b.size.z) {
        return false;
    }
    let axes = [a.yaw, a.yaw + std::f64::consts::FRAC_PI_2, b.yaw, b.yaw + std::f64::consts::FRAC_PI_2];
    axes.into_iter().all(|angle| {
        let axis = DVec3::new(angle.cos(), angle.sin(), 0.0);
        let reach = |found: &Box3d| {
            let (along, across) = ((angle - found.yaw).cos().abs(), (angle - found.yaw).sin().abs());
            0.5 * (along * found.size.x + across * found.size.y)
        };
        (a.center - b.center).dot(axis).abs() <= reach(a) + reach(b)
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn flat(x: f64, y: f64, yaw: f64) -> Box3d {
        Box3d { center: DVec3::new(x, y, 0.0), size: DVec3::new(4.0, 1.0, 2.0), yaw }
    }

    #[test]
    fn boxes_overlap_when_no_axis_separates_them() {
        let a = flat(0.0, 0.0, 0.0);
        assert!(overlap(&a, &flat(3.9, 0.0, 0.0)) && !overlap(&a, &flat(4.1, 0.0, 0.0)));
        assert!(overlap(&a, &flat(0.0, 2.4, std::f64::consts::FRAC_PI_2)));
        assert!(!overlap(&a, &flat(0.0, 2.6, std::f64::consts::FRAC_PI_2)));
        // Their axis-parallel hulls meet, they do not.
        assert!(!overlap(&flat(0.0, 0.0, 0.785), &flat(2.0, -2.0, 0.785)));
        let above = Box3d { center: DVec3::new(0.0, 0.0, 2.1), ..a };
        assert!(!overlap(&a, &above));
    }
}
