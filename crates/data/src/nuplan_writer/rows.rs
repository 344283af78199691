//! Fills the tables of one log. The database is made in memory, so that its bytes depend on nothing but its rows.

use std::collections::BTreeMap;
use std::path::Path;

use geometry::{Lens, RigCamera};
use rusqlite::types::Value;
use rusqlite::{Connection, MAIN_DB, params_from_iter};

use super::annotations;
use super::config::NuPlanWriterConfig;
use super::plan::{Plan, Tokens, utm};
use super::poses::Poses;
use super::schema::{CATEGORIES, TABLES, ddl};
use crate::DataError;
use crate::nuplan::{Token, sqlite};
use pickle::{encode_floats, encode_rows};

/// A row's values in the order of its table's columns.
macro_rules! row {
    ($($value:expr),* $(,)?) => { vec![$(rusqlite::types::Value::from($value)),*] };
}
pub(super) use row;

impl From<Token> for Value {
    fn from(token: Token) -> Self {
        Self::Blob(token.0.to_vec())
    }
}

/// Stale bytes in free space would differ between runs.
const SETTINGS: &str = "PRAGMA page_size = 4096; PRAGMA secure_delete = ON; PRAGMA journal_mode = OFF;";

/// The rows of one log, table by table.
#[derive(Debug, Default)]
pub(super) struct Rows(BTreeMap<&'static str, Vec<Vec<Value>>>);

impl Rows {
    pub fn push(&mut self, table: &'static str, row: Vec<Value>) {
        self.0.entry(table).or_default().push(row);
    }

    /// The database file; `path` is for errors.
    fn database(&self, path: &Path) -> Result<Vec<u8>, DataError> {
        let mut connection = Connection::open_in_memory().map_err(sqlite(path))?;
        connection.execute_batch(SETTINGS).map_err(sqlite(path))?;
        connection.execute_batch(&format!("BEGIN;\n{}", ddl())).map_err(sqlite(path))?;
        for (table, columns) in TABLES {
            let marks = vec!["?"; columns.split(',').count()].join(", ");
            let insert = format!("INSERT INTO {table} VALUES ({marks})");
            let mut statement = connection.prepare(&insert).map_err(sqlite(path))?;
            for row in self.0.get(table).into_iter().flatten() {
                statement.execute(params_from_iter(row)).map_err(sqlite(path))?;
            }
        }
        connection.execute_batch("COMMIT;").map_err(sqlite(path))?;
        let bytes = connection.serialize(MAIN_DB).map_err(sqlite(path))?;
        Ok(bytes.to_vec())
    }
}

/// The database of one log.
pub(super) fn database(plan: &Plan<'_>, config: &NuPlanWriterConfig, path: &Path) -> Result<Vec<u8>, DataError> {
    let tokens = Tokens { seed: config.seed };
    let log = tokens.of("log", &plan.name);
    let mut rows = Rows::default();
    let start_us = plan.frames.first().map_or(0, |frame| frame.time_us);
    let (city, date) = (config.location.clone(), date_of(start_us));
    rows.push("log", row![log, config.vehicle.clone(), date, start_us, plan.name.clone(), city.clone(), city]);
    for camera in &plan.cameras {
        rows.push("camera", camera_row(camera, tokens.of("camera", &format!("{}/{}", plan.name, camera.channel)), log));
    }
    let lidar = tokens.of("lidar", &plan.name);
    let unturned = encode_floats(&[1.0, 0.0, 0.0, 0.0]);
    let mounted = encode_floats(&[0.0; 3]);
    rows.push("lidar", row![lidar, log, "MergedPointCloud".to_owned(), String::new(), mounted, unturned]);
    if plan.annotated {
        for name in CATEGORIES {
            rows.push("category", row![tokens.of("category", name), name.to_owned(), String::new()]);
        }
    }
    let last_pose = add_poses(plan, config, tokens, log, &mut rows)?;
    let scene = tokens.of("scene", &plan.name);
    rows.push("scene", row![scene, log, "scene-001".to_owned(), last_pose, String::new()]);
    add_images(plan, tokens, &mut rows);
    add_lidar(plan, tokens, lidar, scene, &mut rows);
    annotations::add(plan, tokens, &mut rows)?;
    rows.database(path)
}

/// Calibration as plain lists; the file follows OpenCV: integer coordinates are pixel centres.
fn camera_row(camera: &RigCamera, token: Token, log: Token) -> Vec<Value> {
    let i = &camera.intrinsics;
    let k = [[i.fx, 0.0, i.cx - 0.5], [0.0, i.fy, i.cy - 0.5], [0.0, 0.0, 1.0]];
    let distortion = match camera.lens {
        Lens::BrownConrady { k: [k1, k2, k3], p: [p1, p2] } => [k1, k2, p1, p2, k3],
        Lens::Pinhole | Lens::KannalaBrandt { .. } => [0.0; 5],
    };
    row![
        token,
        log,
        camera.channel.clone(),
        String::new(),
        encode_floats(&camera.ego_from_cam.translation.to_array()),
        encode_floats(&camera.ego_from_cam.wxyz()),
        encode_rows(&k.each_ref().map(|row| row.as_slice())),
        encode_floats(&distortion),
        i64::from(i.width),
        i64::from(i.height),
    ]
}

fn pose_token(plan: &Plan<'_>, tokens: Tokens, time_us: i64) -> Token {
    tokens.of("ego_pose", &format!("{}/{time_us}", plan.name))
}

/// Returns the last row's token.
fn add_poses(
    plan: &Plan<'_>,
    config: &NuPlanWriterConfig,
    tokens: Tokens,
    log: Token,
    rows: &mut Rows,
) -> Result<Option<Token>, DataError> {
    let mut poses = Poses::default();
    for planned in &plan.frames {
        poses.add(planned.time_us, planned.utm_from_ego, &plan.name)?;
    }
    for image in &plan.images {
        let Some(planned) = plan.frames.get(image.frame) else { continue };
        poses.add(image.time_us, utm(&image.view.world_from_ego, config, planned.frame)?, &plan.name)?;
    }
    let mut last = None;
    for pose in poses.rows() {
        let token = pose_token(plan, tokens, pose.time_us);
        let [w, x, y, z] = pose.world_from_ego.wxyz();
        let at = pose.world_from_ego.translation;
        let (v, a, r) = (pose.velocity, pose.acceleration, pose.angular_rate);
        let place = row![token, pose.time_us, at.x, at.y, at.z, w, x, y, z];
        let motion = row![v.x, v.y, v.z, a.x, a.y, a.z, r.x, r.y, r.z, i64::from(config.epsg), log];
        rows.push("ego_pose", [place, motion].concat());
        last = Some(token);
    }
    Ok(last)
}

fn add_images(plan: &Plan<'_>, tokens: Tokens, rows: &mut Rows) {
    for (camera, mounted) in plan.cameras.iter().enumerate() {
        let camera_token = tokens.of("camera", &format!("{}/{}", plan.name, mounted.channel));
        let chain: Vec<_> = plan.images.iter().filter(|image| image.camera == camera).collect();
        for (at, image) in chain.iter().enumerate() {
            let neighbour = |at: Option<usize>| at.and_then(|at| chain.get(at)).map(|image| image.token);
            let (next, previous) = (neighbour(Some(at + 1)), neighbour(at.checked_sub(1)));
            let pose = pose_token(plan, tokens, image.time_us);
            rows.push(
                "image",
                row![image.token, next, previous, pose, camera_token, image.name.clone(), image.time_us],
            );
        }
    }
}

/// Rows of the lidar turns and the words about them. No point clouds are written.
fn add_lidar(plan: &Plan<'_>, tokens: Tokens, lidar: Token, scene: Token, rows: &mut Rows) {
    let chain: Vec<_> = plan.frames.iter().filter_map(|planned| planned.lidar.map(|token| (token, planned))).collect();
    for (at, (token, planned)) in chain.iter().enumerate() {
        let neighbour = |at: Option<usize>| at.and_then(|at| chain.get(at)).map(|turn| turn.0);
        let (next, previous) = (neighbour(Some(at + 1)), neighbour(at.checked_sub(1)));
        let pose = pose_token(plan, tokens, planned.time_us);
        let file = format!("{}/MergedPointCloud/{token}.pcd", plan.name);
        rows.push("lidar_pc", row![*token, next, previous, pose, lidar, scene, file, planned.time_us]);
        for tag in tags(planned.frame.scene_text.as_deref()) {
            let tag_token = tokens.of("scenario_tag", &format!("{}/{token}/{tag}", plan.name));
            rows.push("scenario_tag", row![tag_token, *token, tag.to_owned(), Value::Null]);
        }
    }
}

/// Native tags, sorted and joined by the reader, become rows of their own again; any other text is one tag.
fn tags(text: Option<&str>) -> Vec<&str> {
    let Some(text) = text.filter(|text| !text.is_empty()) else { return Vec::new() };
    let parts: Vec<&str> = text.split(", ").collect();
    let native =
        |part: &&str| !part.is_empty() && part.bytes().all(|byte| matches!(byte, b'a'..=b'z' | b'0'..=b'9' | b'_'));
    if parts.iter().all(native) && parts.windows(2).all(|pair| pair[0] < pair[1]) { parts } else { vec![text] }
}

/// The UTC date of a stamp, as the release writes it.
fn date_of(time_us: i64) -> String {
    // Howard Hinnant's days-to-civil: years begin in March, so that leap days come last.
    let days = time_us.div_euclid(86_400_000_000) + 719_468;
    let era = days.div_euclid(146_097);
    let of_era = days.rem_euclid(146_097);
    let year_of_era = (of_era - of_era / 1_460 + of_era / 36_524 - of_era / 146_096) / 365;
    let of_year = of_era - (365 * year_of_era + year_of_era / 4 - year_of_era / 100);
    let from_march = (5 * of_year + 2) / 153;
    let (day, month) = (of_year - (153 * from_march + 2) / 5 + 1, (from_march + 2) % 12 + 1);
    let year = year_of_era + 400 * era + i64::from(month <= 2);
    format!("{year:04}-{month:02}-{day:02}")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn dates_are_those_of_the_calendar() {
        let day = 86_400_000_000;
        for (time_us, date) in [
            (0, "1970-01-01"),
            (-1, "1969-12-31"),
            (1_620_857_889_950_000, "2021-05-12"),
            (59 * day, "1970-03-01"),
            (11_016 * day, "2000-02-29"),
            (1_924_992_000_000_000, "2031-01-01"),
        ] {
            assert_eq!(date_of(time_us), date);
        }
    }

    #[test]
    fn tags_are_split_only_where_the_reader_joins_them() {
        assert_eq!(tags(Some("a_b, c")), ["a_b", "c"]);
        assert_eq!(tags(Some("c, a_b")), ["c, a_b"]);
        assert_eq!(tags(Some("A sunny street, light traffic")), ["A sunny street, light traffic"]);
        assert!(tags(Some("")).is_empty() && tags(None).is_empty());
    }
}
