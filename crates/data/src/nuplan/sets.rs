//! Picture sets of a log: rows paired by time, each picture with its own pose, each set with its lidar turn.

use std::collections::HashMap;
use std::sync::Arc;

use geometry::{PoseTrack, Rigid};

use super::config::{NuPlanConfig, ns};
use super::database::Database;
use super::pairing::{Pairing, assign_lidar, pair};
use super::token::Token;
use crate::DataError;

/// A picture whose file exists.
#[derive(Debug, Clone)]
pub(super) struct Picture {
    pub token: Token,
    /// Its file name where it is not the usual one.
    pub name: Option<Box<str>>,
}

/// One camera of a set.
#[derive(Debug, Clone)]
pub(super) struct SetView {
    pub time_ns: i64,
    pub world_from_ego: Rigid,
    pub picture: Option<Picture>,
}

/// The pictures of one instant.
#[derive(Debug, Clone)]
pub(super) struct PictureSet {
    /// Stamp of the lidar turn, or the middle of the exposures.
    pub time_ns: i64,
    pub world_from_ego: Rigid,
    pub lidar: Option<Token>,
    pub text: Option<Arc<str>>,
    /// In the order of the log's cameras.
    pub views: Vec<SetView>,
}

/// A row of the `image` table of a wanted camera.
pub(super) struct ImageRow {
    pub token: Token,
    /// Position among the wanted cameras.
    pub camera: usize,
    pub time_ns: i64,
    /// Its file name where it is not the usual one.
    pub name: Option<Box<str>>,
    pub exists: bool,
}

/// Turns rows into sets with poses.
pub(super) struct SetMaker<'a> {
    pub config: &'a NuPlanConfig,
    pub database: &'a Database,
    pub images: &'a [ImageRow],
    pub tags: &'a HashMap<Token, Arc<str>>,
}

impl SetMaker<'_> {
    /// The sets that have a picture, in time order.
    pub fn sets(&self, cameras: usize) -> Result<Vec<PictureSet>, DataError> {
        let poses = self.poses()?;
        let lidar = self.lidar()?;
        let rows: Vec<(usize, i64)> = self.images.iter().map(|image| (image.camera, image.time_ns)).collect();
        let Pairing { mut sets, offsets_ns } = pair(&rows, cameras, ns(self.config.pairing_window_ms));
        let exists = |at: &Option<usize>| at.and_then(|at| self.images.get(at)).is_some_and(|image| image.exists);
        sets.retain(|set| set.pictures.iter().any(exists));
        let instants: Vec<i64> = sets.iter().map(|set| set.time_ns).collect();
        let stamps: Vec<i64> = lidar.iter().map(|turn| turn.0).collect();
        let turns = assign_lidar(&instants, &stamps, ns(self.config.box_window_ms));
        let mut made = Vec::new();
        for (set, turn) in sets.iter().zip(turns) {
            let turn = turn.and_then(|at| lidar.get(at));
            let name = turn.map_or_else(|| set.time_ns.to_string(), |turn| turn.1.to_string());
            let incomplete = self.config.require_all_views && !set.pictures.iter().all(exists);
            if incomplete || self.config.exclude.contains(&name) {
                continue;
            }
            let time_ns = turn.map_or(set.time_ns, |turn| turn.0);
            let world_from_ego = self.pose(&poses, time_ns, || format!("frame {name}"))?;
            let views = set.pictures.iter().zip(&offsets_ns);
            let views = views.map(|(at, offset)| {
                let expected_ns = set.time_ns.saturating_add(*offset);
                self.view(at.and_then(|at| self.images.get(at)), expected_ns, &world_from_ego, &poses, &name)
            });
            let views = views.collect::<Result<_, _>>()?;
            let text = turn.and_then(|turn| self.tags.get(&turn.1).cloned());
            made.push(PictureSet { time_ns, world_from_ego, lidar: turn.map(|turn| turn.1), text, views });
        }
        made.sort_by_key(|set| set.time_ns);
        Ok(made)
    }

    fn view(
        &self,
        image: Option<&ImageRow>,
        expected_ns: i64,
        reference: &Rigid,
        poses: &PoseTrack,
        frame: &str,
    ) -> Result<SetView, DataError> {
        let time_ns = image.map_or(expected_ns, |image| image.time_ns);
        let world_from_ego = match image.filter(|image| image.exists) {
            Some(image) => self.pose(poses, time_ns, || format!("image {} of frame {frame}", image.token))?,
            // Its pose only places the camera, so the reference pose serves where none is known.
            None => poses.at(time_ns).unwrap_or(*reference),
        };
        let picture = image.filter(|image| image.exists);
        let picture = picture.map(|image| Picture { token: image.token, name: image.name.clone() });
        Ok(SetView { time_ns, world_from_ego, picture })
    }

    fn pose(&self, poses: &PoseTrack, time_ns: i64, row: impl FnOnce() -> String) -> Result<Rigid, DataError> {
        let path = self.database.path();
        poses.at(time_ns).map_err(|source| DataError::Calibration { row: row(), source, path: path.to_owned() })
    }

    fn poses(&self) -> Result<PoseTrack, DataError> {
        let columns = ["token", "timestamp", "x", "y", "z", "qw", "qx", "qy", "qz"];
        let mut rows =
            self.database.read("ego_pose", &columns, |row| {
                let token = row.token(0)?;
                let pose = Rigid::from_wxyz(row.numbers(5)?, row.numbers(2)?).map_err(|source| {
                    DataError::Calibration { row: token.to_string(), source, path: row.path().to_owned() }
                })?;
                Ok((row.time_ns(1)?, token, pose))
            })?;
        // Rows of one stamp in the order of their tokens, whatever the order of the file.
        rows.sort_by_key(|row| (row.0, row.1));
        Ok(PoseTrack::new(rows.into_iter().map(|row| (row.0, row.2)).collect(), ns(self.config.max_pose_gap_ms)))
    }

    /// Lidar turns in time order; none where the log has no table of them.
    fn lidar(&self) -> Result<Vec<(i64, Token)>, DataError> {
        if !self.database.has_table("lidar_pc")? {
            return Ok(Vec::new());
        }
        let mut turns =
            self.database.read("lidar_pc", &["token", "timestamp"], |row| Ok((row.time_ns(1)?, row.token(0)?)))?;
        turns.sort_unstable();
        Ok(turns)
    }
}
