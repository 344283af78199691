//! Occupancy labels of the samples, and what frames between them get.

use geometry::Rigid;

use super::NuScenes;
use super::pictures::LidarRow;
use super::sets::PictureSet;
use super::tables::Sensor;
use crate::occupancy::{
    BetweenKeyFrames, Occ3d, OccupancyConfig, OccupancyKind, read_open_occupancy, read_surround_occ,
};
use crate::store::{Store, checked_name};
use crate::{DataError, OccupancyGrid, SceneDataset};

/// An opened set of labels.
#[derive(Debug)]
pub(super) struct Attached {
    between: BetweenKeyFrames,
    labels: Labels,
}

#[derive(Debug)]
enum Labels {
    Occ3d(Occ3d),
    OpenOccupancy(Store),
    /// With the folder the files lie in.
    SurroundOcc(Store, &'static str),
}

impl Attached {
    pub(super) fn open(config: &OccupancyConfig) -> Result<Self, DataError> {
        let labels = match config.kind {
            OccupancyKind::Occ3d => Labels::Occ3d(Occ3d::open(config.root.clone(), config.masks)?),
            OccupancyKind::OpenOccupancy => Labels::OpenOccupancy(Store::open_all(&config.root)?),
            OccupancyKind::SurroundOcc => {
                let store = Store::open_all(&config.root)?;
                let folder = if store.list("samples")?.is_empty() { "" } else { "samples/" };
                Labels::SurroundOcc(store, folder)
            }
        };
        Ok(Self { between: config.between, labels })
    }
}

impl NuScenes {
    pub(super) fn occupancy_of(&self, set: &PictureSet) -> Result<OccupancyGrid, DataError> {
        let attached = self.occupancy.as_ref().ok_or_else(|| self.unsupported("occupancy"))?;
        if let Some(sample) = set.sample {
            return self.labels_of(&attached.labels, sample as usize);
        }
        let samples = self.base.scenes[set.scene as usize].samples.clone();
        let nearest = samples.min_by_key(|sample| (self.base.samples[*sample].time_ns - set.time_ns).abs());
        let sample = nearest.filter(|_| attached.between != BetweenKeyFrames::Missing).ok_or_else(|| {
            let what = format!("occupancy labels of {}, which is no key frame", set.name(&self.base));
            DataError::Missing { what, path: self.base.path("sample") }
        })?;
        let mut grid = self.labels_of(&attached.labels, sample)?;
        if attached.between == BetweenKeyFrames::Moved {
            let (_, world_from_ego) = self.reference(set)?;
            grid.ego_from_grid = world_from_ego.inverse() * self.sample_pose(sample)? * grid.ego_from_grid;
        }
        Ok(grid)
    }

    fn labels_of(&self, labels: &Labels, sample: usize) -> Result<OccupancyGrid, DataError> {
        let token = &self.base.samples[sample].token;
        let scene = &self.base.scenes[self.base.samples[sample].scene as usize];
        match labels {
            Labels::Occ3d(set) => set.read(&scene.name, token),
            Labels::OpenOccupancy(store) => {
                let (row, ego_from_lidar) = self.lidar(sample)?;
                let name = format!("scene_{}/occupancy/{}.npy", scene.token, row.token);
                let name = checked_name(&name, &self.base.path("sample_data"))?;
                read_open_occupancy(&store.file(name, "occupancy labels")?, ego_from_lidar)
            }
            Labels::SurroundOcc(store, folder) => {
                let (row, ego_from_lidar) = self.lidar(sample)?;
                let file_name = row.file_name.rsplit('/').next().unwrap_or_default();
                let name = format!("{folder}{file_name}.npy");
                let name = checked_name(&name, &self.base.path("sample_data"))?;
                read_surround_occ(&store.file(name, "occupancy labels")?, ego_from_lidar)
            }
        }
    }

    /// The lidar key row of a sample and its mounting.
    fn lidar(&self, sample: usize) -> Result<(&LidarRow, Rigid), DataError> {
        let row = self.pictures.lidar[sample].as_ref();
        let mounted = row.and_then(|row| match self.base.sensors[row.sensor as usize] {
            Sensor::Lidar { ego_from_lidar } => Some((row, ego_from_lidar)),
            Sensor::Camera { .. } | Sensor::Unwanted => None,
        });
        mounted.ok_or_else(|| {
            let what = format!("lidar row of sample {}", self.base.samples[sample].token);
            DataError::Missing { what, path: self.base.path("sample_data") }
        })
    }

    /// The car at a sample: the pose its labels are made in.
    fn sample_pose(&self, sample: usize) -> Result<Rigid, DataError> {
        match &self.pictures.lidar[sample] {
            Some(row) => Ok(self.pictures.poses[row.pose as usize].world_from_ego),
            None => {
                let found = &self.base.samples[sample];
                Ok(self.pose_near(found.scene, found.time_ns)?.1)
            }
        }
    }
}
