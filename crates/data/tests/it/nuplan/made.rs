//! Datasets written here, and changes to their databases.

use std::path::{Path, PathBuf};
use std::sync::LazyLock;

use data::nuplan::NuPlanConfig;
use data::{NuPlanWriterConfig, Procedural, ProceduralConfig, RigSource, SceneDataset, SceneFrame, write_nuplan};
use geometry::RigPreset;
use rusqlite::Connection;
use tempfile::TempDir;
use world::WorldConfig;

pub(super) const SIZE: (u32, u32) = (64, 36);

/// Frames of a procedural world seen by the layout's own rig, half a second apart.
pub(super) fn world_frames(scenes: usize, frames_per_scene: usize) -> Vec<SceneFrame> {
    let config = ProceduralConfig {
        seed: 5,
        scenes,
        frames_per_scene,
        rig: RigSource::Preset(RigPreset::NuPlan),
        world: WorldConfig { duration_secs: 0.5 * frames_per_scene as f64, ..WorldConfig::default() },
        ..ProceduralConfig::default()
    };
    let dataset = Procedural::open(&config).unwrap();
    (0..dataset.len()).map(|index| dataset.frame(index).unwrap()).collect()
}

pub(super) fn writer(out: PathBuf) -> NuPlanWriterConfig {
    NuPlanWriterConfig { image_size: Some(SIZE), ..NuPlanWriterConfig::new(out) }
}

/// Written once: rendering costs more than copying.
static TWO_FRAMES: LazyLock<Made> = LazyLock::new(|| Made::of(&world_frames(1, 2)));

fn copy(from: &Path, to: &Path) {
    std::fs::create_dir_all(to).unwrap();
    for entry in std::fs::read_dir(from).unwrap() {
        let (path, name) = entry.map(|entry| (entry.path(), entry.file_name())).unwrap();
        if path.is_dir() { copy(&path, &to.join(name)) } else { _ = std::fs::copy(&path, to.join(name)).unwrap() }
    }
}

/// A written dataset in a folder of its own.
pub(super) struct Made {
    folder: TempDir,
}

impl Made {
    /// One log, `scene-0000`, of two frames half a second apart.
    pub fn new() -> Self {
        let folder = tempfile::tempdir().unwrap();
        copy(&TWO_FRAMES.root(), &folder.path().join("set"));
        Self { folder }
    }

    pub fn of(frames: &[SceneFrame]) -> Self {
        let folder = tempfile::tempdir().unwrap();
        write_nuplan(frames, &writer(folder.path().join("set")), &mut |_, _| {}).unwrap();
        Self { folder }
    }

    pub fn root(&self) -> PathBuf {
        self.folder.path().join("set")
    }

    pub fn config(&self) -> NuPlanConfig {
        NuPlanConfig::new(self.root())
    }

    pub fn database(&self) -> PathBuf {
        self.root().join("nuplan-v1.1/splits/mini/scene-0000.db")
    }

    pub fn blobs(&self) -> PathBuf {
        self.root().join("nuplan-v1.1/sensor_blobs")
    }

    /// Runs statements on the database.
    pub fn change(&self, sql: &str) -> &Self {
        run(&self.database(), sql);
        self
    }

    /// Sets a blob of every camera row.
    pub fn set_camera(&self, column: &str, bytes: &[u8]) -> &Self {
        let connection = Connection::open(self.database()).unwrap();
        connection.execute(&format!("UPDATE camera SET {column} = ?1"), [bytes]).unwrap();
        self
    }
}

fn run(path: &Path, sql: &str) {
    Connection::open(path).unwrap().execute_batch(sql).unwrap_or_else(|error| panic!("{sql}: {error}"));
}
