//! Native dataset readers and writers, mixtures of rigs, conditions, batches and the loader.

pub mod argoverse2;
mod argoverse2_writer;
mod augment;
mod batch;
mod caption;
pub mod check;
mod clip;
pub mod colmap;
pub mod conditions;
mod embedded;
mod error;
pub mod export;
mod frame;
mod image_source;
mod jpeg;
pub mod latents;
pub mod layout;
mod lidar;
mod loader;
mod local_map;
mod manifest;
mod mixture;
pub mod npz;
pub mod nuplan;
mod nuplan_writer;
pub mod nuscenes;
mod nuscenes_writer;
pub mod occupancy;
mod parquet_file;
mod pass;
mod permutation;
mod polygon;
mod procedural;
mod procedural_cache;
mod registry;
mod resample;
mod rig_file;
mod sample;
mod seeding;
mod staging;
pub mod store;
pub mod taxonomy;
pub mod tfrecord;
mod undistort;
pub mod waymo;
mod waymo_writer;
pub mod wayvescenes;
mod wayvescenes_writer;

pub use argoverse2_writer::{
    Argoverse2Log, Argoverse2Manifest, Argoverse2WriterConfig, CategoryRule, ManifestLog, write_argoverse2,
};
pub use augment::{AugmentConfig, ColorJitter, RigMotion};
pub use batch::{ClipArrays, PadViews, SceneBatch, ViewArrays, assemble, assemble_clips, novel_targets};
pub use check::{BatchMemory, CheckOptions, CheckReport, batch_memory, check, check_all};
pub use clip::{Clip, ClipConfig, ClipMode, Clips};
pub use embedded::EmbeddedPicture;
pub use error::DataError;
pub use frame::{
    Capabilities, FrameId, FrameOutline, LocalMap, MapArea, MapKind, MapLine, ObjectBox, OccupancyGrid,
    OccupancyLabels, SceneDataset, SceneFrame, View,
};
pub use image_source::ImageSource;
pub use loader::{Loader, LoaderConfig};
pub use manifest::WriterManifest;
pub use mixture::{FrameSampling, Mixture, MixtureConfig, MixtureOrder, MixtureWeights};
pub use nuplan_writer::{NuPlanManifest, NuPlanManifestFrame, NuPlanManifestLog, NuPlanWriterConfig, write_nuplan};
pub use nuscenes_writer::{Manifest, ManifestScene, NuScenesWriterConfig, write_nuscenes};
pub use pass::InOrder;
pub use procedural::{Procedural, ProceduralConfig, RigSource};
pub use registry::{DatasetConfig, open};
pub use rig_file::read_rig;
pub use sample::{ImageSize, PoseMode, Sample, SampleOptions, SampleView, rerig};
pub use taxonomy::{ClassRule, ObjectClass};
pub use waymo_writer::{WaymoManifest, WaymoManifestScene, WaymoWriterConfig, write_waymo};
pub use wayvescenes_writer::{
    WayveScenesManifest, WayveScenesManifestScene, WayveScenesWriterConfig, write_wayvescenes,
};
