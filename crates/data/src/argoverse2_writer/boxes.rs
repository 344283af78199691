//! The annotation table.

use geometry::Rigid;

use super::config::Argoverse2WriterConfig;
use super::feather::Columns;
use super::sweep::Sweep;
use crate::{DataError, SceneFrame};

/// Rows of the table, by column.
#[derive(Debug, Default)]
pub(super) struct Boxes {
    stamps: Vec<i64>,
    tracks: Vec<String>,
    categories: Vec<String>,
    sizes: [Vec<f64>; 3],
    poses: Vec<Rigid>,
    points: Vec<i64>,
}

impl Boxes {
    /// Adds the boxes of a frame. A box whose points were never counted gets the number of the sweep's points inside it, and -1 without a sweep.
    pub(super) fn add(
        &mut self,
        frame: &SceneFrame,
        sweep: Option<&Sweep>,
        config: &Argoverse2WriterConfig,
    ) -> Result<(), DataError> {
        for found in frame.boxes.iter().flatten() {
            let Some(category) = config.category(&found.source_class, found.class)? else { continue };
            let inside =
                |sweep: &Sweep| sweep.points.iter().filter(|point| found.box3d.contains(**point)).count() as i64;
            self.stamps.push(frame.timestamp_ns);
            self.tracks.push(found.track.clone());
            self.categories.push(category.to_owned());
            for (column, value) in self.sizes.iter_mut().zip(found.box3d.size.to_array()) {
                column.push(value);
            }
            self.poses.push(Rigid::from_yaw(found.box3d.yaw, found.box3d.center));
            self.points.push(found.points.map_or_else(|| sweep.map_or(-1, inside), i64::from));
        }
        Ok(())
    }

    /// The file's bytes.
    pub(super) fn encode(self) -> Result<Vec<u8>, DataError> {
        let [length, width, height] = self.sizes;
        Columns::default()
            .i64("timestamp_ns", self.stamps)
            .text("track_uuid", self.tracks.iter().map(String::as_str).collect())
            .text("category", self.categories.iter().map(String::as_str).collect())
            .f64("length_m", length)
            .f64("width_m", width)
            .f64("height_m", height)
            .poses(&self.poses)
            .i64("num_interior_pts", self.points)
            .encode()
    }
}
