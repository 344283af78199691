//! Boxes of one lidar turn, and the classes of a log.

use std::collections::BTreeMap;

use geometry::glam::DVec3;
use geometry::{Box3d, Rigid};

use super::config::NuPlanConfig;
use super::database::{Database, Row};
use super::token::Token;
use crate::taxonomy::{ClassRule, from_nuplan};
use crate::{DataError, ObjectBox, ObjectClass};

/// Classes by native name; `None` is dropped.
pub(super) type Classes = BTreeMap<String, Option<ObjectClass>>;

const TRACK: [&str; 2] = ["token", "category_token"];
const CATEGORY: [&str; 2] = ["token", "name"];
const BOX: [&str; 12] = ["token", "track_token", "x", "y", "z", "length", "width", "height", "vx", "vy", "vz", "yaw"];

/// The classes of a log's tracks; `None` for a log that is not annotated: without a table of boxes, or with neither boxes nor categories.
pub(super) fn read_classes(database: &Database, config: &NuPlanConfig) -> Result<Option<Classes>, DataError> {
    if !database.has_table("lidar_box")? {
        return Ok(None);
    }
    let categories = database.read("category", &CATEGORY, |row| Ok((row.token(0)?, row.text(1)?.to_owned())))?;
    let categories: BTreeMap<Token, String> = categories.into_iter().collect();
    let tracks = database.read("track", &TRACK, |row| Ok((row.token(0)?, row.token(1)?)))?;
    if categories.is_empty() && tracks.is_empty() && database.is_empty("lidar_box")? {
        return Ok(None);
    }
    let mut classes = Classes::new();
    for (track, category) in tracks {
        let name = categories.get(&category).ok_or_else(|| dangling(database, "track", track, "category_token"))?;
        if !classes.contains_key(name) {
            classes.insert(name.clone(), class_of(name, config)?);
        }
    }
    Ok(Some(classes))
}

fn class_of(name: &str, config: &NuPlanConfig) -> Result<Option<ObjectClass>, DataError> {
    match config.classes.get(name) {
        Some(ClassRule::Drop) => Ok(None),
        Some(ClassRule::As(class)) => Ok(Some(*class)),
        None => from_nuplan(name)
            .map(Some)
            .ok_or_else(|| DataError::UnknownClass { dataset: config.name.clone(), name: name.to_owned() }),
    }
}

fn dangling(database: &Database, table: &'static str, token: Token, field: &'static str) -> DataError {
    DataError::Dangling { table, token: token.to_string(), field, path: database.path().to_owned() }
}

/// The boxes of a lidar turn in the ego frame of its instant, in the order of their tracks.
pub(super) fn read_boxes(
    database: &Database,
    lidar: Token,
    ego_from_world: &Rigid,
    classes: &Classes,
) -> Result<Vec<ObjectBox>, DataError> {
    let columns = [BOX.as_slice(), &["track", "category"]].concat();
    let wanted = BOX.map(|column| format!("b.{column}")).join(", ");
    let sql = format!(
        "SELECT {wanted}, t.token, c.name FROM lidar_box b LEFT JOIN track t ON t.token = b.track_token \
         LEFT JOIN category c ON c.token = t.category_token WHERE b.lidar_pc_token = ?1"
    );
    let mut boxes = database.query(&sql, [lidar.0.as_slice()], "lidar_box", &columns, |row| {
        let track = row.token(1)?;
        if row.maybe_token(12)?.is_none() {
            return Err(dangling(database, "lidar_box", row.token(0)?, "track_token"));
        }
        let name = row.text(13)?;
        let (box3d, velocity) = read_box(row, ego_from_world)?;
        let class = classes.get(name).copied().flatten();
        Ok(class.map(|class| ObjectBox {
            box3d,
            class,
            track: track.to_string(),
            source_class: name.to_owned(),
            velocity,
            attributes: Vec::new(),
            points: None,
            visibility: None,
            interpolated: false,
        }))
    })?;
    boxes.sort_by(|a, b| track_of(a).cmp(&track_of(b)));
    Ok(boxes.into_iter().flatten().collect())
}

fn track_of(found: &Option<ObjectBox>) -> Option<&str> {
    found.as_ref().map(|found| found.track.as_str())
}

/// A box and its velocity over ground in the axes of the ego frame, m/s.
type Moving = (Box3d, Option<[f64; 2]>);

fn read_box(row: &Row<'_>, ego_from_world: &Rigid) -> Result<Moving, DataError> {
    let refuse = |why: &str| {
        let token = row.token(0)?.to_string();
        Err(DataError::Annotation { token, why: why.to_owned(), path: row.path().to_owned() })
    };
    let (center, size, yaw) = (row.numbers::<3>(2)?, row.numbers::<3>(5)?, row.number(11)?);
    if center.iter().chain([&yaw]).any(|value| !value.is_finite()) {
        return refuse("its pose is not finite");
    }
    if size.iter().any(|side| !(side.is_finite() && *side > 0.0)) {
        return refuse(&format!("its length, width and height {size:?} are not all positive"));
    }
    let velocity = match (row.maybe_number(8)?, row.maybe_number(9)?, row.maybe_number(10)?) {
        (Some(x), Some(y), z) => {
            let velocity = ego_from_world.transform_vector(DVec3::new(x, y, z.unwrap_or(0.0)));
            if !velocity.is_finite() {
                return refuse("its velocity is not finite");
            }
            Some([velocity.x, velocity.y])
        }
        _ => None,
    };
    let in_world = Box3d { center: DVec3::from_array(center), size: DVec3::from_array(size), yaw };
    Ok((in_world.transformed(ego_from_world), velocity))
}

/// That the columns a frame's boxes need exist, so that a broken table shows when the log is opened.
pub(super) fn check_boxes(database: &Database) -> Result<(), DataError> {
    database.check_columns("lidar_box", &[BOX.as_slice(), &["lidar_pc_token"]].concat())
}
